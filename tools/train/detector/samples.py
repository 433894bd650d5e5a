"""What the detector learns from: rendered scenes kept in a cache, photographs cut, mosaicked and pasted, and
noise.

A sample is an RGB-ready BGR image and its boxes (N, 5): xyxy px and 1 where the box counts, 0 where the
animal is too faint or too far outside to be learnt either way.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.render import Image
from tools.render import measured_right_whales, scenes

__all__ = [
    "Sample",
    "augment",
    "cached_scenes",
    "held_out",
    "letterboxed",
    "numbered",
    "photograph_sample",
    "read_yolo",
    "real_data",
    "scene_sample",
]

Boxes = NDArray[np.float32]

CACHE_SIDE = 384  # a little over the network's 320, so that crops and scales vary
PAD_GREY = 114  # what the detector puts round pictures that are not square
LEAST_SHARE = 0.35  # of a box that a crop must keep for the animal to count


@dataclass(frozen=True)
class Sample:
    image: Image  # (H, W, 3) BGR
    boxes: Boxes  # (N, 5)
    half: "Sample | None" = None  # the same at half the size: shrinking by much is slow and aliases the waves


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


def cached_scenes(folder: Path, count: int, seed: int, split: str, outlines_csv: Path) -> list[Sample]:
    """`count` rendered scenes, from `folder` where they were made before, else made and kept there."""
    name = f"{split}_{seed}_{count}"
    images_path, boxes_path = folder / f"{name}.images.npy", folder / f"{name}.boxes.npz"
    if not boxes_path.is_file():  # written last: a killed run leaves none and begins again
        folder.mkdir(parents=True, exist_ok=True)
        shape = (count, CACHE_SIDE, CACHE_SIDE, 3)
        images = np.lib.format.open_memmap(images_path, "w+", np.uint8, shape)
        boxes, owner = [np.zeros((0, 5), np.float32)], [np.zeros(0, np.int64)]
        side = (CACHE_SIDE, CACHE_SIDE)
        for index, scene in enumerate(scenes(count, seed, split, side, measured_right_whales(outlines_csv))):
            images[index] = scene.image
            for found, counts in ((scene.boxes, 1), (scene.faint, 0)):
                boxes.append(np.column_stack([found, np.full(len(found), counts)]).astype(np.float32))
                owner.append(np.full(len(found), index))
        images.flush()
        np.savez(boxes_path, boxes=np.concatenate(boxes), owner=np.concatenate(owner))
    images = np.load(images_path, mmap_mode="r")
    with np.load(boxes_path) as kept:
        all_boxes, owner_of = kept["boxes"], kept["owner"]
    return [Sample(images[index], all_boxes[owner_of == index]) for index in range(len(images))]


def read_yolo(images: Sequence[Path], labels: Path) -> list[Sample]:
    """Pictures with YOLO text labels (class x y w h, shares of the picture); no file there means no animal.

    Raises ValueError naming a picture that cannot be read or a label line that is not five numbers.
    """
    samples = []
    for path in images:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise ValueError(f"{path}: not a picture that OpenCV reads; remove it or replace it")
        height, width = image.shape[:2]
        label_path, boxes = labels / f"{path.stem}.txt", []
        for line in label_path.read_text().splitlines() if label_path.is_file() else []:
            try:
                _, x, y, w, h = (float(value) for value in line.split())
            except ValueError:
                raise ValueError(
                    f"{label_path}: line {line!r} is not 'class x y w h'; five numbers are needed"
                ) from None
            boxes.append(
                [(x - w / 2) * width, (y - h / 2) * height, (x + w / 2) * width, (y + h / 2) * height, 1.0]
            )
        samples.append(_with_halves(np.asarray(image, np.uint8), np.array(boxes, np.float32).reshape(-1, 5)))
    return samples


def _with_halves(image: Image, boxes: Boxes, levels: int = 4) -> Sample:
    if levels == 0 or min(image.shape[:2]) < 4:
        return Sample(image, boxes)
    half = np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
    return Sample(image, boxes, _with_halves(half, boxes * _row([0.5, 0.5, 0.5, 0.5, 1]), levels - 1))


def _reduced(sample: Sample, scale: float) -> Sample:
    """The smallest of the sample's halves that `scale` need not enlarge."""
    while scale <= 0.5 and sample.half is not None:
        sample, scale = sample.half, scale * 2
    return sample


def _row(values: list[float]) -> Boxes:
    return np.array(values, np.float32)


def _place(sample: Sample, canvas: Image, scale: float, shift: tuple[float, float]) -> Boxes:
    """Draw the picture at `scale` with its corner at `shift` (u, v) onto the canvas; its boxes there,
    clipped.
    """
    height, width = canvas.shape[:2]
    move = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    cv2.warpAffine(sample.image, move, (width, height), dst=canvas, borderMode=cv2.BORDER_TRANSPARENT)
    return _clipped(sample.boxes * _row([scale] * 4 + [1]) + _row([*shift, *shift, 0]), (0, 0, width, height))


def _clipped(boxes: Boxes, window: tuple[int, int, int, int]) -> Boxes:
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


def _turned(sample: Sample, rng: np.random.Generator) -> Sample:
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
    turned = _turned(scene, rng)
    smallest = side / max(turned.image.shape[:2])
    scale = float(np.exp(rng.uniform(np.log(max(smallest, 0.7)), np.log(max(smallest, 0.7) * 1.5))))
    canvas = np.full((side, side, 3), PAD_GREY, np.uint8)
    room = side - scale * np.array(turned.image.shape[1::-1])
    shift = tuple((rng.uniform(0, 1, 2) * room).tolist())
    return Sample(canvas, _place(turned, canvas, scale, (shift[0], shift[1])))


def _window(
    photo: Sample, rng: np.random.Generator, size: tuple[int, int], animal_px: float | None
) -> Sample:
    """A (width, height) window of a photograph in which its animal is about `animal_px` long, or has none
    (None).

    The window is always full: where the photograph would be too small it is shown larger.
    """
    width, height = size
    longest = _longest_side(photo)
    needed = max(max(width, height) / min(photo.image.shape[:2]), (animal_px or 120.0) / longest)
    photo = _turned(_reduced(photo, needed), rng)
    source_height, source_width = photo.image.shape[:2]
    fill = max(width / source_width, height / source_height)
    box = photo.boxes[0] if len(photo.boxes) else None
    scale = max(fill, (animal_px or 120.0) / _longest_side(photo))
    room = np.array([width - scale * source_width, height - scale * source_height])  # at most 0
    shift = rng.uniform(0, 1, 2) * room
    if box is not None:
        for _ in range(12):
            shown = _clipped(box[None] * _row([scale] * 4 + [1]) + _row([*shift, *shift, 0]), (0, 0, *size))
            if (animal_px is None and len(shown) == 0) or (animal_px is not None and shown[:, 4].any()):
                break
            shift = rng.uniform(0, 1, 2) * room
    canvas = np.empty((height, width, 3), np.uint8)
    return Sample(canvas, _place(photo, canvas, scale, (float(shift[0]), float(shift[1]))))


def _longest_side(photo: Sample) -> float:
    """Of the first animal's box, px; a picture without one is taken to show animals a third of its width."""
    if not len(photo.boxes):
        return float(photo.image.shape[1] / 3)
    return float(np.max(photo.boxes[0, 2:4] - photo.boxes[0, :2]))


def _length_px(rng: np.random.Generator, side: int) -> float:
    return float(np.exp(rng.uniform(np.log(20), np.log(250)))) * side / 320


def _mosaic(photos: Sequence[Sample], rng: np.random.Generator, side: int) -> Sample:
    """Two to four by two to four windows of different photographs, side by side."""
    canvas, boxes = np.empty((side, side, 3), np.uint8), [np.zeros((0, 5), np.float32)]
    columns, rows = (
        [
            0,
            *np.sort(np.round((np.arange(1, n) + rng.uniform(-0.25, 0.25, n - 1)) * side / n))
            .astype(int)
            .tolist(),
            side,
        ]
        for n in rng.integers(2, 5, 2).tolist()
    )
    for left, right in pairwise(columns):
        for top, bottom in pairwise(rows):
            photo = photos[int(rng.integers(len(photos)))]
            animal_px = (
                None
                if rng.random() < 0.2
                else float(rng.uniform(0.25, 1.0)) * max(right - left, bottom - top)
            )
            window = _window(photo, rng, (right - left, bottom - top), animal_px)
            canvas[top:bottom, left:right] = window.image
            boxes.append(window.boxes + _row([left, top, left, top, 0]))
    return Sample(canvas, np.concatenate(boxes))


def _pasted(photos: Sequence[Sample], seas: Sequence[Sample], rng: np.random.Generator, side: int) -> Sample:
    """One to nine animals cut from photographs, feathered onto one empty sea: a pod that never was."""
    if seas and rng.random() < 0.5:
        canvas = scene_sample(
            Sample(seas[int(rng.integers(len(seas)))].image, np.zeros((0, 5), np.float32)), rng, side
        ).image
        boxes = np.zeros((0, 5), np.float32)
    else:
        sea = _window(photos[int(rng.integers(len(photos)))], rng, (side, side), None)
        canvas, boxes = sea.image, sea.boxes
    typical_px = min(_length_px(rng, side), 0.6 * side)
    for _ in range(int(rng.integers(1, 10))):
        photo = photos[int(rng.integers(len(photos)))]
        if not len(photo.boxes):
            continue
        length_px = typical_px * float(rng.uniform(0.7, 1.2))
        photo = _turned(_reduced(photo, length_px / _longest_side(photo)), rng)
        x0, y0, x1, y1 = photo.boxes[0, :4]
        margin = 0.16 * max(x1 - x0, y1 - y0)
        height, width = photo.image.shape[:2]
        left, top = int(max(x0 - margin, 0)), int(max(y0 - margin, 0))
        right, bottom = int(min(x1 + margin, width)), int(min(y1 + margin, height))
        scale = length_px / _longest_side(photo)
        size = (max(round((right - left) * scale), 6), max(round((bottom - top) * scale), 6))
        if size[0] >= side or size[1] >= side:
            continue
        u, v = int(rng.integers(0, side - size[0])), int(rng.integers(0, side - size[1]))
        box = (photo.boxes[0, :4] - _row([left, top, left, top])) * np.float32(scale) + _row([u, v, u, v])
        if any(_overlap(box, other) > 0.02 for other in boxes[:, :4]):
            continue
        piece = cv2.resize(photo.image[top:bottom, left:right], size, interpolation=cv2.INTER_AREA).astype(
            np.float32
        )
        _feather(canvas[v : v + size[1], u : u + size[0]], piece)
        boxes = np.concatenate([boxes, np.append(box, 1.0)[None].astype(np.float32)])
    return Sample(canvas, boxes)


def _overlap(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Intersection over the smaller area of two boxes xyxy."""
    shared = np.clip(np.minimum(first[2:], second[2:]) - np.maximum(first[:2], second[:2]), 0, None).prod()
    return float(shared / max(min((first[2:] - first[:2]).prod(), (second[2:] - second[:2]).prod()), 1e-6))


def _feather(region: Image, piece: NDArray[np.float32]) -> None:
    """Blend a cut-out into a region of the same size, its water shifted to the region's colour."""
    height, width = piece.shape[:2]
    rim = max(min(height, width) // 8, 1)
    border = np.ones((height, width), bool)
    border[rim:-rim, rim:-rim] = False
    piece = piece + (np.median(region[border], axis=0) - np.median(piece[border], axis=0)).astype(np.float32)
    y, x = np.mgrid[0:height, 0:width]
    edge = np.minimum(np.minimum(x, width - 1 - x), np.minimum(y, height - 1 - y)) / rim
    share = np.clip(edge * 0.9, 0, 1)[..., None]
    region[:] = np.clip(region + share * (piece - region), 0, 255).astype(np.uint8)


def photograph_sample(
    photos: Sequence[Sample], seas: Sequence[Sample], rng: np.random.Generator, side: int
) -> Sample:
    """A training picture (side, side) made of photographs: one, many side by side, or a pasted pod."""
    kind = rng.random()
    if kind < 0.4:
        animal_px = None if rng.random() < 0.12 else _length_px(rng, side)
        return _window(photos[int(rng.integers(len(photos)))], rng, (side, side), animal_px)
    if kind < 0.65:
        return _mosaic(photos, rng, side)
    return _pasted(photos, seas, rng, side)


def letterboxed(sample: Sample, rng: np.random.Generator) -> Sample:
    """Grey bars above and below, as the detector gets a camera's wide picture; done last, the bars never
    vary.
    """
    height = sample.image.shape[0]
    bar = int(height * rng.uniform(0.1, 0.2))
    image = sample.image.copy()
    image[:bar], image[height - bar :] = PAD_GREY, PAD_GREY
    return Sample(image, _clipped(sample.boxes, (0, bar, sample.image.shape[1], height - bar)))


def augment(image: Image, rng: np.random.Generator) -> Image:
    """Light, haze, blur, noise and compression as cameras add them; geometry stays."""
    picture = image.astype(np.float32)
    picture *= (rng.uniform(0.85, 1.15, 3) * np.exp(rng.normal(0, 0.3))).astype(np.float32)
    if rng.random() < 0.3:
        middle = picture.mean()
        picture = middle + (picture - middle) * np.float32(rng.uniform(0.5, 1.5))
    if rng.random() < 0.2:  # saturation, down to grey
        grey = picture.mean(axis=2, keepdims=True)
        picture = grey + (picture - grey) * np.float32(rng.uniform(0, 1.5))
    if rng.random() < 0.12:  # haze
        share = np.float32(rng.uniform(0, 0.5))
        picture = picture * (1 - share) + share * np.float32(rng.uniform(150, 220))
    if rng.random() < 0.1:  # dusk
        picture *= np.float32(rng.uniform(0.15, 0.5))
    blur = rng.random()
    if blur < 0.15:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.4, 1.4))), np.float32)
    elif blur < 0.22:  # the drone moves while the shutter is open
        length = int(rng.integers(3, 8))
        kernel = np.zeros((length, length), np.float32)
        angle, middle_px = rng.uniform(0, np.pi), (length - 1) / 2
        for step in np.linspace(-middle_px, middle_px, 2 * length):
            kernel[round(middle_px + step * np.sin(angle)), round(middle_px + step * np.cos(angle))] = 1
        picture = np.asarray(cv2.filter2D(picture, -1, kernel / kernel.sum()), np.float32)
    if rng.random() < 0.3:
        picture = picture + np.float32(rng.uniform(1, 9)) * rng.standard_normal(
            picture.shape, dtype=np.float32
        )
    result = np.clip(picture, 0, 255).astype(np.uint8)
    if rng.random() < 0.25:
        _, coded = cv2.imencode(".jpg", result, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 90))])
        result = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
    return result
