"""What a large picture is kept as: no finer than training shows it; where that is still much, in parts."""

import numpy as np

from tools.train.detector.photographs import LONGEST_PX, SHORTEST_PX, USUAL_LENGTH_PX
from tools.train.detector.samples import Sample, clipped, row, with_halves

__all__ = ["useful"]

MOST_PX = 4_000_000  # of a picture that is kept whole: 16 MB with its halves
PART_SIDE_PX = 1024  # round an animal: it fills a window of 320 px even where the animal is 32 px long in it


def useful(picture: Sample, side: int) -> list[Sample]:
    """What training pictures of `side` px can show of a picture: itself, one of its halves, or parts of it.

    Sizes that are never asked for are left out, which changes nothing. What is then still larger than MOST_PX
    is cut round its animals, and kept whole only as small as MOST_PX (not where its animals would be too
    short); but where the parts would be no less than the picture, it stays.
    """
    while picture.half is not None and _largest_scale(picture, side) <= 0.5:
        picture = picture.half
    if _pixels(picture) <= MOST_PX:
        return [picture]
    parts = _round_animals(picture)
    if sum(map(_pixels, parts)) >= _pixels(picture):
        return [picture]
    while picture.half is not None and _pixels(picture) > MOST_PX:
        picture = picture.half
    return parts if parts and _shortest_px(picture) < SHORTEST_PX else [*parts, picture]


def _pixels(picture: Sample) -> int:
    return int(np.prod(picture.image.shape[:2]))


def _shortest_px(picture: Sample) -> float:
    """Length of the smallest animal; without one as windows of empty pictures take it, however they turn."""
    if not len(picture.boxes):
        return float(min(picture.image.shape[:2]) / 3)
    return float((picture.boxes[:, 2:4] - picture.boxes[:, :2]).max(axis=1).min())


def _largest_scale(picture: Sample, side: int) -> float:
    """At which a window may show the picture: filled by it, or with its smallest animal at its longest."""
    longest_px = max(LONGEST_PX * side / 320, USUAL_LENGTH_PX)
    return float(max(side / min(picture.image.shape[:2]), longest_px / _shortest_px(picture)))


def _round_animals(picture: Sample) -> list[Sample]:
    """Parts at full size in which each animal lies whole, with its neighbours."""
    height, width = picture.image.shape[:2]
    parts: list[Sample] = []
    windows = np.zeros((0, 4), np.float32)
    for box in picture.boxes:
        inside = (windows[:, :2] <= box[:2]).all(axis=1) & (windows[:, 2:] >= box[2:4]).all(axis=1)
        if inside.any():
            continue
        part_px = max(PART_SIDE_PX, 2 * float((box[2:4] - box[:2]).max()))
        left, top = (
            int(np.clip((low + high - part_px) / 2, 0, max(size - part_px, 0)))
            for low, high, size in ((box[0], box[2], width), (box[1], box[3], height))
        )
        right, bottom = min(left + int(part_px), width), min(top + int(part_px), height)
        windows = np.concatenate([windows, row([left, top, right, bottom])[None]])
        boxes = clipped(picture.boxes, (left, top, right, bottom)) - row([left, top, left, top, 0])
        image = picture.image[top:bottom, left:right].copy()  # a view would keep the whole picture
        parts.append(with_halves(image, boxes, picture.name))
    return parts
