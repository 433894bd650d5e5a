"""Training pictures made of photographs: one of them, many side by side, or animals cut out and pasted."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.render import Image
from tools.train.detector.samples import Sample, clipped, place, reduced, row, scene_sample, turned

__all__ = ["LONGEST_PX", "SHORTEST_PX", "USUAL_LENGTH_PX", "empty_seas", "photograph_sample"]

USUAL_LENGTH_PX = 120.0  # of the animals that an empty window does not show
SHORTEST_PX, LONGEST_PX = 20, 250  # of an animal in a picture of 320 px


def _window(
    photo: Sample, rng: np.random.Generator, size: tuple[int, int], animal_px: float | None
) -> Sample:
    """A (width, height) window of a photograph in which its animal is about `animal_px` long, or has none
    (None).

    The window is always full: where the photograph would be too small it is shown larger.
    """
    width, height = size
    longest = _longest_side(photo)
    needed = max(max(width, height) / min(photo.image.shape[:2]), (animal_px or USUAL_LENGTH_PX) / longest)
    photo = turned(reduced(photo, needed), rng)
    source_height, source_width = photo.image.shape[:2]
    fill = max(width / source_width, height / source_height)
    box = photo.boxes[0] if len(photo.boxes) else None
    scale = max(fill, (animal_px or USUAL_LENGTH_PX) / _longest_side(photo))
    room = np.array([width - scale * source_width, height - scale * source_height])  # at most 0
    shift = rng.uniform(0, 1, 2) * room
    if box is not None:
        for _ in range(12):
            shown = clipped(box[None] * row([scale] * 4 + [1]) + row([*shift, *shift, 0]), (0, 0, *size))
            if (animal_px is None and len(shown) == 0) or (animal_px is not None and shown[:, 4].any()):
                break
            shift = rng.uniform(0, 1, 2) * room
    canvas = np.empty((height, width, 3), np.uint8)
    # An enlarged picture ends half a pixel short of the rim.
    boxes = place(photo, canvas, scale, (float(shift[0]), float(shift[1])), cv2.BORDER_REPLICATE)
    return Sample(canvas, boxes)


def _picked(photos: Sequence[Sample], rng: np.random.Generator) -> Sample:
    """One of them, with any of its animals as the first one: the one that windows and cut-outs go by."""
    photo = photos[int(rng.integers(len(photos)))]
    return _with_first(photo, int(rng.integers(len(photo.boxes)))) if len(photo.boxes) > 1 else photo


def _with_first(photo: Sample, index: int) -> Sample:
    half = _with_first(photo.half, index) if photo.half is not None else None
    return replace(photo, boxes=np.roll(photo.boxes, -index, axis=0), half=half)


def empty_seas(photos: Sequence[Sample], least_px: int = 260) -> list[Image]:
    """Of each photograph the widest strip beside its animals, at least `least_px` wide and high."""
    seas = []
    for photo in photos:
        height, width = photo.image.shape[:2]
        if not len(photo.boxes):
            seas.append(photo.image)
            continue
        low, high = photo.boxes[:, :2].min(axis=0) - 25, photo.boxes[:, 2:4].max(axis=0) + 25
        left, top, right, bottom = (int(value) for value in (*low, *high))
        sides = [(0, 0, left, height), (right, 0, width, height)]
        strips = [*sides, (0, 0, width, top), (0, bottom, width, height)]
        x0, y0, x1, y1 = max(strips, key=lambda s: min(s[2] - s[0], s[3] - s[1]))
        if min(x1 - x0, y1 - y0) >= least_px:
            seas.append(photo.image[y0:y1, x0:x1])
    return seas


def _longest_side(photo: Sample) -> float:
    """Of the first animal's box, px; a picture without one is taken to show animals a third of its width."""
    if not len(photo.boxes):
        return float(photo.image.shape[1] / 3)
    return float(np.max(photo.boxes[0, 2:4] - photo.boxes[0, :2]))


def _length_px(rng: np.random.Generator, side: int) -> float:
    return float(np.exp(rng.uniform(np.log(SHORTEST_PX), np.log(LONGEST_PX)))) * side / 320


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
            photo = _picked(photos, rng)
            animal_px = (
                None
                if rng.random() < 0.2
                else float(rng.uniform(0.25, 1.0)) * max(right - left, bottom - top)
            )
            window = _window(photo, rng, (right - left, bottom - top), animal_px)
            canvas[top:bottom, left:right] = window.image
            boxes.append(window.boxes + row([left, top, left, top, 0]))
    return Sample(canvas, np.concatenate(boxes))


def _pasted(photos: Sequence[Sample], seas: Sequence[Sample], rng: np.random.Generator, side: int) -> Sample:
    """One to nine animals cut from photographs, feathered onto one empty sea: a pod that never was."""
    if seas and rng.random() < 0.5:
        canvas = scene_sample(
            Sample(seas[int(rng.integers(len(seas)))].image, np.zeros((0, 5), np.float32)), rng, side
        ).image
        boxes = np.zeros((0, 5), np.float32)
    else:
        sea = _window(_picked(photos, rng), rng, (side, side), None)
        canvas, boxes = sea.image, sea.boxes
    typical_px = min(_length_px(rng, side), 0.6 * side)
    for _ in range(int(rng.integers(1, 10))):
        photo = _picked(photos, rng)
        if not len(photo.boxes):
            continue
        length_px = typical_px * float(rng.uniform(0.7, 1.2))
        photo = turned(reduced(photo, length_px / _longest_side(photo)), rng)
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
        cut = (photo.boxes - row([left, top, left, top, 0])) * row([scale] * 4 + [1]) + row([u, v, u, v, 0])
        # Neighbours that the cut-out shows come with it.
        cut = np.concatenate([cut[:1], clipped(cut[1:], (u, v, u + size[0], v + size[1]))])
        if any(_overlap(box, other) > 0.02 for box in cut[:, :4] for other in boxes[:, :4]):
            continue
        piece = cv2.resize(photo.image[top:bottom, left:right], size, interpolation=cv2.INTER_AREA).astype(
            np.float32
        )
        _feather(canvas[v : v + size[1], u : u + size[0]], piece, rng)
        boxes = np.concatenate([boxes, cut])
    return Sample(canvas, boxes)


def _overlap(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Intersection over the smaller area of two boxes xyxy."""
    shared = np.clip(np.minimum(first[2:], second[2:]) - np.maximum(first[:2], second[:2]), 0, None).prod()
    return float(shared / max(min((first[2:] - first[:2]).prod(), (second[2:] - second[:2]).prod()), 1e-6))


def _unlike_water(piece: NDArray[np.float32], border: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Opacity (H, W): 1 where a cut-out is unlike the water of its border, so that its own water goes."""
    water, spread = np.median(piece[border], axis=0), piece[border].std(axis=0) + 3
    distance = cv2.GaussianBlur(np.sqrt((((piece - water) / spread) ** 2).mean(axis=2)), (0, 0), 1.2)
    limit = float(np.quantile(distance[border], 0.9))
    return np.asarray(np.clip((distance - 0.7 * limit) / max(0.6 * limit, 1e-6), 0, 1), np.float32)


def _feather(region: Image, piece: NDArray[np.float32], rng: np.random.Generator) -> None:
    """Blend a cut-out into a region of the same size, mostly with its colours shifted to the region's."""
    height, width = piece.shape[:2]
    rim = max(min(height, width) // 8, 1)
    border = np.ones((height, width), bool)
    border[rim:-rim, rim:-rim] = False
    y, x = np.mgrid[0:height, 0:width]
    edge = np.minimum(np.minimum(x, width - 1 - x), np.minimum(y, height - 1 - y)) / rim
    share = np.clip(edge * 0.9, 0, 1)[..., None]
    if rng.random() < 0.6:
        share = share * _unlike_water(piece, border)[..., None]
    if rng.random() < 0.75:
        shift = np.median(region[border], axis=0) - np.median(piece[border], axis=0)
        piece = piece + shift.astype(np.float32)
    if rng.random() < 0.3:  # another species, or another light on it
        piece = piece * np.exp(rng.normal(0, 0.2) + rng.normal(0, 0.06, 3)).astype(np.float32)
    share = share * rng.uniform(0.75, 1.0)
    region[:] = np.clip(region + share * (piece - region), 0, 255).astype(np.uint8)


def photograph_sample(
    photos: Sequence[Sample], seas: Sequence[Sample], rng: np.random.Generator, side: int
) -> Sample:
    """A training picture (side, side) made of photographs: one, many side by side, or a pasted pod."""
    kind = rng.random()
    if kind < 0.4:
        animal_px = None if rng.random() < 0.12 else _length_px(rng, side)
        return _window(_picked(photos, rng), rng, (side, side), animal_px)
    if kind < 0.65:
        return _mosaic(photos, rng, side)
    return _pasted(photos, seas, rng, side)
