"""Trains the whale detector on rendered scenes and photographs, exports it to ONNX, and measures it.

    podwatch train detector --out runs/detector            trains (goes on where a killed run stopped) and
    exports podwatch train detector --smoke                        a few steps, an export and its check, under
    two minutes podwatch train detector --data my/data.yaml            adds pictures of your own in the YOLO
    layout

Needs the `train` extra (torch, onnx). Every sample depends on (seed, step) alone, so a resumed run sees what
an uninterrupted one would have seen.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from procs.detector.yolo import Detector
from tools.train.detector.export import check_export, export
from tools.train.detector.loss import detection_loss
from tools.train.detector.model import WhaleDetector, cell_centres, decode
from tools.train.detector.samples import (
    Sample,
    augment,
    cached_scenes,
    held_out,
    letterboxed,
    photograph_sample,
    read_yolo,
    real_data,
    scene_sample,
)
from tools.train.detector.scores import Score, recall_by_length, score

__all__ = ["Settings", "command", "evaluate", "held_out", "real_data", "train"]

# Photographs that show a second animal in part, without a box: boxes on it are neither right nor wrong.
WITH_EXTRAS = ("w_6", "w_23", "w_33", "w_94")


@dataclass(frozen=True)
class Settings:
    """What shapes a training, each with its reason."""

    seed: int = 0
    steps: int = 6000  # 50 minutes on one idle core, 80 on a busy one; more steps still help
    batch: int = 16  # the smallest whose normalisation statistics are steady; larger ones cost steps
    rate: float = 2e-3  # the highest that never diverged with AdamW on this network
    last_rate_share: float = 0.02  # a cosine down to this settles the boxes
    warmup_steps: int = 200  # assignment is random before the boxes mean anything
    weight_decay: float = 0.03  # the photographs are few
    average_decay: float = 0.998  # the exported weights are a running mean over about 500 steps
    early_side: int = 256  # smaller pictures first: half again as many steps for the time
    side: int = 320  # what the exported network takes
    early_share: float = 0.6  # of the steps, at the early side
    photograph_share: float = 0.5  # of the samples; the rest are rendered
    empty_share: float = 0.2  # of the rendered samples at least: boats and foam must not pass for whales
    letterbox_share: float = 0.35  # cameras are wide, the network's input is square
    scenes: int = 3000  # rendered once: more of them cost disk and time, crops vary them
    scenes_seed: int = 0
    save_every_steps: int = 100  # a kill loses a minute


def _photographs(data: Path | None) -> list[Sample]:
    """All photographs to learn from: four fifths of the right whales, the minke, and the user's own."""
    root, photos = real_data(), []
    folder = root / "right_whales"
    if folder.is_dir():
        chosen, _ = held_out(sorted((folder / "images").glob("*.jpg")))
        photos += read_yolo(chosen, folder / "labels")
    minke = root / "minke_photogrammetry" / "minke.jpg"
    if minke.is_file():
        image = cv2.imread(str(minke), cv2.IMREAD_COLOR)
        if image is not None:
            # The box was measured by eye, snout to flukes; the caption below is cut off.
            small = cv2.resize(image[:1900], None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA)
            box = np.array([[82, 256, 1080, 544, 1]], np.float32)
            photos.append(Sample(np.asarray(small, np.uint8), box))
    if data is not None:
        photos += _own_pictures(data)
    return photos


def _own_pictures(data_yaml: Path) -> list[Sample]:
    """The `train` pictures of a YOLO data.yaml whose labels lie in labels/ beside images/."""
    if not data_yaml.is_file():
        raise ValueError(f"{data_yaml}: no such file; give the data.yaml of a YOLO data set")
    entries: dict[str, str] = {}
    for line in data_yaml.read_text().splitlines():
        key, colon, value = line.partition(":")
        if colon and not line.startswith((" ", "#")):
            entries[key.strip()] = value.strip()
    if "train" not in entries:
        raise ValueError(
            f"{data_yaml}: has no entry 'train'; it must name the folder of the training pictures"
        )
    images = (data_yaml.parent / entries.get("path", ".") / entries["train"]).resolve()
    found = sorted(
        path for path in images.glob("*") if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".bmp")
    )
    if not found:
        raise ValueError(f"{data_yaml}: no JPEG, PNG or BMP pictures in {images}")
    parts = list(images.parts)
    where = max((i for i, part in enumerate(parts) if part == "images"), default=-1)
    labels = Path(*parts[:where], "labels", *parts[where + 1 :]) if where >= 0 else images
    return read_yolo(found, labels)


def _batch(
    settings: Settings,
    step: int,
    side: int,
    rendered: Sequence[Sample],
    photos: Sequence[Sample],
    empty: Sequence[Sample],
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Images (B, 3, side, side) RGB in 0-1 and a tensor (N, 5) of boxes an image, for one step."""
    rng = np.random.default_rng([settings.seed, step])
    images = np.empty((settings.batch, side, side, 3), np.uint8)
    boxes = []
    for index in range(settings.batch):
        if photos and rng.random() < settings.photograph_share:
            sample = photograph_sample(photos, empty, rng, side)
        else:
            pool = empty if empty and rng.random() < settings.empty_share else rendered
            sample = scene_sample(pool[int(rng.integers(len(pool)))], rng, side)
        sample = Sample(augment(sample.image, rng), sample.boxes)
        if rng.random() < settings.letterbox_share:
            sample = letterboxed(sample, rng)
        images[index] = sample.image
        boxes.append(torch.from_numpy(sample.boxes.astype(np.float32)))
    rgb = torch.from_numpy(np.ascontiguousarray(images[..., ::-1])).permute(0, 3, 1, 2)  # (B, 3, side, side)
    return rgb.float().div(255).contiguous(memory_format=torch.channels_last), boxes


def _rate(settings: Settings, step: int) -> float:
    if step < settings.warmup_steps:
        return settings.rate * (step + 1) / settings.warmup_steps
    progress = (step - settings.warmup_steps) / max(settings.steps - settings.warmup_steps, 1)
    low = settings.last_rate_share
    return settings.rate * (low + (1 - low) * 0.5 * (1 + float(np.cos(np.pi * progress))))


@dataclass
class _Run:
    """All that a checkpoint holds."""

    network: WhaleDetector
    average: dict[str, torch.Tensor]
    optimiser: torch.optim.AdamW
    step: int = 0
    seconds: float = 0.0

    def save(self, path: Path, settings: Settings) -> None:
        state = {
            "network": self.network.state_dict(),
            "average": self.average,
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "settings": asdict(settings),
        }
        part = path.with_suffix(".part")
        torch.save(state, part)
        part.replace(path)  # whole or not at all: a kill while writing keeps the last one

    def load(self, path: Path, settings: Settings) -> None:
        """Take up a checkpoint; says so where it was made with other settings, since the run is then not
        repeatable.
        """
        state = torch.load(path, weights_only=True)
        for name, now in asdict(settings).items():
            before = state["settings"].get(name)
            if before != now:
                print(f"{path}: {name} was {before} up to step {state['step']}, now {now}", flush=True)
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.average, self.step, self.seconds = state["average"], state["step"], state["seconds"]

    def follow(self, decay: float) -> None:
        """Move the running mean of the weights a step towards them; faster while they are young."""
        decay = min(decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for name, value in self.network.state_dict().items():
                if value.dtype.is_floating_point:
                    self.average[name].lerp_(value, 1 - decay)
                else:
                    self.average[name].copy_(value)


def _start(settings: Settings) -> _Run:
    torch.manual_seed(settings.seed)
    network = WhaleDetector()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    decayed = [p for p in network.parameters() if p.ndim > 1]
    rest = [p for p in network.parameters() if p.ndim <= 1]  # norms and biases are not pulled to zero
    groups = [
        {"params": decayed, "weight_decay": settings.weight_decay},
        {"params": rest, "weight_decay": 0.0},
    ]
    average = {name: value.clone() for name, value in network.state_dict().items()}
    return _Run(network, average, torch.optim.AdamW(groups, lr=settings.rate))


def averaged(run_folder: Path) -> WhaleDetector:
    """The running mean of the weights of the newest checkpoint, ready to export."""
    network = WhaleDetector()
    network.load_state_dict(torch.load(run_folder / "checkpoint.pt", weights_only=True)["average"])
    return network.eval()


def train(out: Path, settings: Settings, data: Path | None = None, stop_after: int | None = None) -> Path:
    """Train into the folder `out`, from its checkpoint if there is one, and export; returns the ONNX file's
    path.

    `stop_after` ends the run at that step, as a kill would; the next call goes on from the last checkpoint.
    """
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    out.mkdir(parents=True, exist_ok=True)
    outlines = real_data() / "whale_outlines" / "outlines.csv"
    cache = out.parent / "detector_cache"
    rendered = cached_scenes(cache, settings.scenes, settings.scenes_seed, "train", outlines)
    empty = [sample for sample in rendered if len(sample.boxes) == 0]
    photos = _photographs(data)
    print(f"{len(rendered)} rendered scenes ({len(empty)} empty), {len(photos)} photographs", flush=True)
    run, checkpoint, log = _start(settings), out / "checkpoint.pt", out / "log.csv"
    if checkpoint.is_file():
        run.load(checkpoint, settings)
        print(f"goes on at step {run.step} of {settings.steps}", flush=True)
    grids = {side: cell_centres(side, side) for side in (settings.early_side, settings.side)}
    run.network.train()
    sums, begun = np.zeros(2), time.monotonic() - run.seconds
    for step in range(run.step, min(settings.steps, stop_after or settings.steps)):
        side = settings.early_side if step < settings.early_share * settings.steps else settings.side
        images, boxes = _batch(settings, step, side, rendered, photos, empty)
        sums += _step(run, settings, step, images, boxes, grids[side])
        run.step, run.seconds = step + 1, time.monotonic() - begun
        if run.step % 50 == 0:
            losses = ",".join(f"{value / 50:.4f}" for value in sums)
            line = f"{run.step},{losses},{_rate(settings, step):.6f},{run.seconds:.0f}"
            print(f"step,score_loss,box_loss,rate,seconds {line}", flush=True)
            with log.open("a") as file:
                file.write(line + "\n")
            sums[:] = 0
        if run.step % settings.save_every_steps == 0 or run.step == settings.steps:
            run.save(checkpoint, settings)
    run.save(checkpoint, settings)
    return export(averaged(out), out / "detector.onnx", settings.side)


def _step(
    run: _Run,
    settings: Settings,
    step: int,
    images: torch.Tensor,
    boxes: list[torch.Tensor],
    grid: tuple[torch.Tensor, torch.Tensor],
) -> NDArray[np.float64]:
    """One step of the optimiser; returns (score loss, box loss)."""
    for group in run.optimiser.param_groups:
        group["lr"] = _rate(settings, step)
    logits, distances = run.network(images)  # (B, 1, A), (B, 4, A)
    score_loss, box_loss = detection_loss(logits, decode(distances, *grid), *grid, boxes)
    loss = score_loss + box_loss
    if not torch.isfinite(loss):
        raise FloatingPointError(
            f"the loss is {loss.item()} at step {step}: lower Settings.rate ({settings.rate})"
        )
    run.optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(run.network.parameters(), 10.0)
    run.optimiser.step()
    run.follow(settings.average_decay)
    return np.array([score_loss.item(), box_loss.item()])


def evaluate(
    model: Path | None = None,
    cache: Path = Path("runs/detector_cache"),
    scenes: int = 300,
    seed: int = 1,
    confidence: float = 0.25,
) -> dict[str, Score]:
    """Measure a detector (None: the one that ships) on what it never saw, print the figures and return them.

    Seed 1: seed 0 showed, while the trainer was being set up, that boats and foam passed for whales.

    The held-out fifth of the photographs (left out where ../shared/data is missing), rendered scenes of
    species that the trainer never draws, of sperm whales in seas that it never draws, and empty seas.
    """
    cv2.setNumThreads(1)

    def detector(least: float) -> Detector:
        return Detector(model, confidence=least)

    results: dict[str, Score] = {}
    folder = real_data() / "right_whales"
    if folder.is_dir():
        _, kept = held_out(sorted((folder / "images").glob("*.jpg")))
        extras = frozenset(place for place, path in enumerate(kept) if path.stem in WITH_EXTRAS)
        results["photographs, held-out fifth"] = score(
            detector, read_yolo(kept, folder / "labels"), confidence, extras
        )
    else:
        print(
            f"photographs: MISSING, there is no {folder}; PODWATCH_REAL_DATA may name the folder of real data"
        )
    outlines = real_data() / "whale_outlines" / "outlines.csv"
    for split, name in (
        ("val", "rendered, species never drawn"),
        ("val_sperm", "rendered, sperm whales"),
        ("empty", "rendered, no animal"),
    ):
        results[name] = score(detector, cached_scenes(cache, scenes, seed, split, outlines), confidence)
    for name, result in results.items():
        print(f"{name}: {result.line()}", flush=True)
    sperm = cached_scenes(cache, scenes, seed, "val_sperm", outlines)
    for length, (hits, total) in recall_by_length(detector(confidence), sperm).items():
        print(f"rendered, sperm whales of {length} in the input: recall {hits}/{total}", flush=True)
    return results


def command(
    out: Path = Path("runs/detector"),
    data: Path | None = None,
    steps: int = Settings.steps,
    seed: int = 0,
    smoke: bool = False,
) -> None:
    """Train the detector into OUT and export OUT/detector.onnx; --smoke does a few steps and checks the
    export.
    """
    settings = Settings(seed=seed, steps=steps)
    if smoke:
        out = out / "smoke"
        (out / "checkpoint.pt").unlink(missing_ok=True)  # always from the beginning
        settings = Settings(
            seed=seed, steps=6, batch=4, scenes=12, early_side=128, warmup_steps=2, save_every_steps=3
        )
    begun = time.monotonic()
    model = train(out, settings, data)
    checked = check_export(averaged(out), model, settings.side)
    print(f"{model}: {checked}; {time.monotonic() - begun:.0f} s in all")
