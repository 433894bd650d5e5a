"""What the detector learns from: rendered scenes kept in a cache, pictures read from disk, light and noise.

A sample is an RGB-ready BGR image and its boxes (N, 5): xyxy px and 1 where the box counts, 0 where the
animal is too faint or too far outside to be learnt either way.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.render import Image
from drivers.sim.render.effects import (
    blurred,
    compressed,
    glittering,
    hazy,
    motion_blurred,
    noisy,
    vignetted,
)
from procs.detector.letterbox import PAD_GREY
from tools.errors import UnusableError
from tools.render import measured_right_whales, scenes
from tools.train.detector.labels import read_labels

__all__ = [
    "SCENES_VERSION",
    "WITH_EXTRAS",
    "Sample",
    "augment",
    "cache_files",
    "cached_scenes",
    "clipped",
    "held_out",
    "letterboxed",
    "numbered",
    "place",
    "read_yolo",
    "real_data",
    "reduced",
    "row",
    "scene_sample",
    "turned",
    "with_halves",
]

Boxes = NDArray[np.float32]

CACHE_SIDE = 384  # a little over the network's 320, so that crops and scales vary
# Photographs that show a second animal in part, without a box: boxes on it are neither right nor wrong.
WITH_EXTRAS = ("w_6", "w_23", "w_33", "w_94")
SCENES_VERSION = 2  # raised whenever the scenes change: what was kept of older ones is left alone
LEAST_PICTURE_PX = 32  # what is left of smaller ones is no picture
LEAST_SHARE = 0.35  # of a box that a crop must keep for the animal to count


@dataclass(frozen=True)
class Sample:
    image: Image  # (H, W, 3) BGR
    boxes: Boxes  # (N, 5)
    half: "Sample | None" = None  # the same at half the size: shrinking by much is slow and aliases the waves
    name: str = ""


def numbered(path: Path) -> tuple[int, str]:
    """Sort key: the number in a file's name, so that w_2 comes before w_10."""
    digits = "".join(letter for letter in path.stem if letter.isdigit())
    return (int(digits) if digits else -1, path.name)


def real_data() -> Path:
    """The folder of real pictures: PODWATCH_REAL_DATA, or ../shared/data beside the project; it may be
    missing.
    """
    beside = Path(__file__).resolve().parents[4] / "shared" / "data"
    return Path(os.environ.get("PODWATCH_REAL_DATA", str(beside)))


def held_out(images: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """(for training, held out): every fifth in the order of the numbers in their names, from the first, is
    held out.
    """
    ordered = sorted(images, key=numbered)
    return [path for i, path in enumerate(ordered) if i % 5], ordered[::5]


def cache_files(folder: Path, count: int, seed: int, split: str, on_photographs: bool) -> tuple[Path, Path]:
    """Where `cached_scenes` keeps pictures and boxes; the boxes are written last."""
    name = f"{split}{'_on_photographs' if on_photographs else ''}_{seed}_{count}_v{SCENES_VERSION}"
    return folder / f"{name}.images.npy", folder / f"{name}.boxes.npz"


def cached_scenes(
    folder: Path, count: int, seed: int, split: str, outlines_csv: Path, seas: Sequence[Image] = ()
) -> list[Sample]:
    """`count` rendered scenes, from `folder` where they were made before, else made and kept there.

    seas: photographs of water that take the place of the rendered one.
    """
    images_path, boxes_path = cache_files(folder, count, seed, split, bool(seas))
    if not boxes_path.is_file():  # written last: a killed run leaves none and begins again
        folder.mkdir(parents=True, exist_ok=True)
        shape = (count, CACHE_SIDE, CACHE_SIDE, 3)
        # Of this process alone: two trainings that begin together make the same scenes side by side.
        part = images_path.with_suffix(f".{os.getpid()}.part")
        images = np.lib.format.open_memmap(part, "w+", np.uint8, shape)
        boxes, owner = [np.zeros((0, 5), np.float32)], [np.zeros(0, np.int64)]
        side = (CACHE_SIDE, CACHE_SIDE)
        shapes = measured_right_whales(outlines_csv)
        for index, scene in enumerate(scenes(count, seed, split, side, shapes, seas=seas)):
            images[index] = scene.image
            for found, counts in ((scene.boxes, 1), (scene.faint, 0)):
                boxes.append(np.column_stack([found, np.full(len(found), counts)]).astype(np.float32))
                owner.append(np.full(len(found), index))
        images.flush()
        part.replace(images_path)
        with part.open("wb") as file:
            np.savez(file, boxes=np.concatenate(boxes), owner=np.concatenate(owner))
        part.replace(boxes_path)
    images = np.load(images_path, mmap_mode="r")
    with np.load(boxes_path) as kept:
        all_boxes, owner_of = kept["boxes"], kept["owner"]
    return [Sample(images[index], all_boxes[owner_of == index]) for index in range(len(images))]


def read_yolo(
    images: Sequence[Path], labels: Path, counted: Mapping[int, bool] | None = None
) -> list[Sample]:
    """Pictures with YOLO text labels (see `read_labels`) of the same names in the folder `labels`.

    Raises UnusableError naming a picture that cannot be read or is too small, or a label line of no use.
    """
    samples = []
    for path in images:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise UnusableError(f"{path}: not a picture that OpenCV reads; remove it or replace it")
        height, width = image.shape[:2]
        if min(width, height) < LEAST_PICTURE_PX:
            raise UnusableError(
                f"{path}: {width}x{height} px; a picture needs {LEAST_PICTURE_PX} px a side; remove it"
            )
        boxes = read_labels(labels / f"{path.stem}.txt", (width, height), counted)
        samples.append(with_halves(np.asarray(image, np.uint8), boxes, path.stem))
    return samples


def with_halves(image: Image, boxes: Boxes, name: str, levels: int = 4) -> Sample:
    """A sample with what it looks like at half its size, and at half of that, `levels` times."""
    if levels == 0 or min(image.shape[:2]) < 4:
        return Sample(image, boxes, name=name)
    half = np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
    halved = with_halves(half, boxes * row([0.5, 0.5, 0.5, 0.5, 1]), name, levels - 1)
    return Sample(image, boxes, halved, name)


def reduced(sample: Sample, scale: float) -> Sample:
    """The smallest of the sample's halves that `scale` need not enlarge."""
    while scale <= 0.5 and sample.half is not None:
        sample, scale = sample.half, scale * 2
    return sample


def row(values: list[float]) -> Boxes:
    return np.array(values, np.float32)


def place(
    sample: Sample,
    canvas: Image,
    scale: float,
    shift: tuple[float, float],
    border: int = cv2.BORDER_TRANSPARENT,
) -> Boxes:
    """Draw the picture at `scale` with its corner at `shift` (u, v) onto the canvas; its boxes there,
    clipped. border: OpenCV's word for what lies outside the picture.
    """
    height, width = canvas.shape[:2]
    move = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    cv2.warpAffine(sample.image, move, (width, height), dst=canvas, borderMode=border)
    return clipped(sample.boxes * row([scale] * 4 + [1]) + row([*shift, *shift, 0]), (0, 0, width, height))


def clipped(boxes: Boxes, window: tuple[int, int, int, int]) -> Boxes:
    """Boxes cut to a window (x0, y0, x1, y1); those cut too much no longer count, those outside are gone."""
    if len(boxes) == 0:
        return boxes
    cut = boxes.copy()
    cut[:, 0:4:2] = np.clip(boxes[:, 0:4:2], window[0], window[2])
    cut[:, 1:4:2] = np.clip(boxes[:, 1:4:2], window[1], window[3])
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    left = (cut[:, 2] - cut[:, 0]) * (cut[:, 3] - cut[:, 1])
    cut[(left < LEAST_SHARE * area) | (np.minimum(cut[:, 2] - cut[:, 0], cut[:, 3] - cut[:, 1]) < 3), 4] = 0
    return np.asarray(cut[left > 0], np.float32)


def turned(sample: Sample, rng: np.random.Generator) -> Sample:
    """Flipped and turned by quarters: a loose upright box stays one."""
    image, boxes = sample.image, sample.boxes.copy()
    if rng.random() < 0.5:
        image = np.asarray(cv2.flip(image, 1), np.uint8)
        boxes[:, [0, 2]] = image.shape[1] - boxes[:, [2, 0]]
    for _ in range(int(rng.integers(4))):  # each a quarter turn to the left: (u, v) -> (v, W - u)
        width = image.shape[1]
        image = np.asarray(cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE), np.uint8)
        boxes = np.column_stack(
            [boxes[:, 1], width - boxes[:, 2], boxes[:, 3], width - boxes[:, 0], boxes[:, 4]]
        )
    return Sample(image, np.asarray(boxes, np.float32))


def scene_sample(scene: Sample, rng: np.random.Generator, side: int) -> Sample:
    """A random crop of a rendered scene at a random scale, (side, side)."""
    view = turned(scene, rng)
    smallest = side / max(view.image.shape[:2])
    scale = float(np.exp(rng.uniform(np.log(max(smallest, 0.7)), np.log(max(smallest, 0.7) * 1.5))))
    canvas = np.full((side, side, 3), PAD_GREY, np.uint8)
    room = side - scale * np.array(view.image.shape[1::-1])
    shift = tuple((rng.uniform(0, 1, 2) * room).tolist())
    return Sample(canvas, place(view, canvas, scale, (shift[0], shift[1])))


def letterboxed(sample: Sample, rng: np.random.Generator) -> Sample:
    """Grey bars above and below, as the detector gets a camera's wide picture; done last, the bars never
    vary.
    """
    height = sample.image.shape[0]
    bar = int(height * rng.uniform(0.1, 0.2))
    image = sample.image.copy()
    image[:bar], image[height - bar :] = PAD_GREY, PAD_GREY
    return Sample(image, clipped(sample.boxes, (0, bar, sample.image.shape[1], height - bar)))


def augment(image: Image, rng: np.random.Generator) -> Image:
    """Light, haze, glitter, blur, noise and compression as cameras see and add them; geometry stays."""
    picture = image.astype(np.float32)
    picture *= (rng.uniform(0.85, 1.15, 3) * np.exp(rng.normal(0, 0.3))).astype(np.float32)
    if rng.random() < 0.3:
        middle = picture.mean()
        picture = middle + (picture - middle) * np.float32(rng.uniform(0.5, 1.5))
    if rng.random() < 0.2:  # saturation, down to grey
        grey = picture.mean(axis=2, keepdims=True)
        picture = grey + (picture - grey) * np.float32(rng.uniform(0, 1.5))
    if rng.random() < 0.06:
        picture = glittering(picture, rng, float(rng.uniform(0.1, 0.7)))
    if rng.random() < 0.15:
        picture = hazy(picture, float(rng.uniform(0, 0.45)), float(rng.uniform(150, 220)))
    if rng.random() < 0.1:  # dusk
        picture *= np.float32(rng.uniform(0.15, 0.5))
    if rng.random() < 0.2:
        picture = vignetted(picture, float(rng.uniform(0, 0.4)))
    blur = rng.random()
    if blur < 0.15:
        picture = blurred(picture, float(rng.uniform(0.4, 1.2)))
    elif blur < 0.22:
        picture = motion_blurred(picture, int(rng.integers(3, 7)), float(rng.uniform(0, np.pi)))
    if rng.random() < 0.35:
        picture = noisy(picture, rng, float(rng.uniform(1, 8)))
    result = np.clip(picture, 0, 255).astype(np.uint8)
    return compressed(result, int(rng.integers(35, 92))) if rng.random() < 0.3 else result
