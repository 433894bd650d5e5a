"""Where the trainer's pictures come from, and how a batch of one step is put together from them."""

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import torch

from drivers.sim.render import Image
from drivers.sim.render.clutter import add_clutter
from tools.train.detector.photographs import empty_seas, photograph_sample
from tools.train.detector.samples import (
    WITH_EXTRAS,
    Sample,
    augment,
    cache_files,
    cached_scenes,
    held_out,
    letterboxed,
    read_yolo,
    real_data,
    scene_sample,
)

__all__ = ["Batches", "Mixture", "photographs"]

ENDLESS = 100_000_000  # batches; the trainer stops before
CLUTTER, CLUTTER_WHALE_PX = 2.0, (20.0, 200.0)  # times the scenes' chances; beside whales of such lengths
SCENES_A_FILE = 500  # rendered at a time: a killed run loses no more


@dataclass(frozen=True)
class Mixture:
    """What a batch is made of."""

    seed: int = 0
    batch: int = 16  # the smallest whose normalisation statistics are steady; larger ones cost steps
    side: int = 320  # what the exported network takes
    photograph_share: float = 0.25  # of the samples; the rest are rendered
    own_share: float = 0.5  # of the samples are the user's own pictures, where there are any
    empty_share: float = 0.12  # of the rendered samples at least: boats and foam must not pass for whales
    clutter_share: float = 0.5  # get new boats, logs, foam: the scenes' own would be learnt by heart
    letterbox_share: float = 0.4  # cameras are wide, the network's input is square
    scenes: int = 8000  # rendered once: more of them cost disk and time, crops vary them
    scenes_on_photographs: int = 2000  # of them in addition: rendered animals on real water
    scenes_seed: int = 0


class Batches(torch.utils.data.Dataset[tuple[torch.Tensor, list[torch.Tensor]]]):
    """Batch number k: images (B, side, side, 3) uint8 RGB, and (N, 5) boxes an image; of (seed, k) alone."""

    def __init__(
        self, mixture: Mixture, cache: Path, own: Sequence[Sample] = (), steps: int = ENDLESS
    ) -> None:
        self.mixture, self.own, self.steps = mixture, own, steps
        self.photographs = photographs()
        self.rendered = _rendered(cache, mixture, _seas(self.photographs))
        self.empty = [sample for sample in self.rendered if len(sample.boxes) == 0]

    def __len__(self) -> int:
        return self.steps

    def __getitem__(self, step: int) -> tuple[torch.Tensor, list[torch.Tensor]]:
        rng = np.random.default_rng([self.mixture.seed, step])
        side, count = self.mixture.side, self.mixture.batch
        images, boxes = np.empty((count, side, side, 3), np.uint8), []
        for index in range(count):
            sample = self._sample(rng)
            if rng.random() < self.mixture.clutter_share:
                length_px = float(np.exp(rng.uniform(*np.log(CLUTTER_WHALE_PX)))) * side / 320
                add_clutter(sample.image, rng, length_px, share=CLUTTER, keep_clear=sample.boxes)
            sample = Sample(augment(sample.image, rng), sample.boxes)
            if rng.random() < self.mixture.letterbox_share:
                sample = letterboxed(sample, rng)
            images[index] = sample.image[..., ::-1]
            boxes.append(torch.from_numpy(sample.boxes.astype(np.float32)))
        return torch.from_numpy(images), boxes

    def _sample(self, rng: np.random.Generator) -> Sample:
        m = self.mixture
        if self.own and rng.random() < m.own_share:
            return photograph_sample(self.own, self.empty, rng, m.side)
        if self.photographs and rng.random() < m.photograph_share:
            return photograph_sample(self.photographs, self.empty, rng, m.side)
        pool = self.empty if self.empty and rng.random() < m.empty_share else self.rendered
        return scene_sample(pool[int(rng.integers(len(pool)))], rng, m.side)


def _rendered(cache: Path, mixture: Mixture, seas: Sequence[Image]) -> list[Sample]:
    """All rendered scenes; those that are not in the cache are made on all processors."""
    chunks = [
        (min(SCENES_A_FILE, count - start), mixture.scenes_seed + start // SCENES_A_FILE, on_photographs)
        for count, on_photographs in ((mixture.scenes, False), (mixture.scenes_on_photographs, True))
        for start in range(0, count if seas or not on_photographs else 0, SCENES_A_FILE)
    ]
    missing = [
        chunk for chunk in chunks if not cache_files(cache, *chunk[:2], "train", chunk[2])[1].is_file()
    ]
    if len(missing) > 1:
        # New processes, not copies of this one: it may have threads, which do not survive copying.
        with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
            list(pool.map(_make_chunk, [cache] * len(missing), missing))
    return [
        sample
        for count, seed, on_photographs in chunks
        for sample in _chunk(cache, count, seed, seas if on_photographs else [])
    ]


def _make_chunk(cache: Path, chunk: tuple[int, int, bool]) -> None:
    cv2.setNumThreads(1)
    count, seed, on_photographs = chunk
    _chunk(cache, count, seed, _seas(photographs()) if on_photographs else [])


def _chunk(cache: Path, count: int, seed: int, seas: Sequence[Image]) -> list[Sample]:
    outlines = real_data() / "whale_outlines" / "outlines.csv"
    return cached_scenes(cache, count, seed, "train", outlines, seas)


def _seas(photos: Sequence[Sample]) -> list[Image]:
    """Empty water of those photographs that show no animal without a box."""
    return empty_seas([photo for photo in photos if photo.name not in WITH_EXTRAS])


def photographs() -> list[Sample]:
    """Four fifths of the right whales and the minke of ../shared/data; empty where it is missing."""
    root, photos = real_data(), []
    folder = root / "right_whales"
    if folder.is_dir():
        chosen, _ = held_out(sorted((folder / "images").glob("*.jpg")))
        photos += read_yolo(chosen, folder / "labels")
    minke = root / "minke_photogrammetry" / "minke.jpg"
    image = cv2.imread(str(minke), cv2.IMREAD_COLOR) if minke.is_file() else None
    if image is not None:
        # The box was measured by eye, snout to flukes; the caption below is cut off.
        small = cv2.resize(image[:1900], None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA)
        box = np.array([[82, 256, 1080, 544, 1]], np.float32)
        photos.append(Sample(np.asarray(small, np.uint8), box))
    return photos
