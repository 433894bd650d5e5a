"""What a detector found against what there is: which boxes are right at IoU 0.5, and average precision."""

import numpy as np
from numpy.typing import NDArray

from procs.detector.yolo import Detections

__all__ = ["average_precision", "box_iou", "match", "match_animals"]

Array = NDArray[np.float64]

MATCH_IOU = 0.5
FAINT_SHARE = 0.5  # a detection this far inside an animal too faint to count is no false alarm


def box_iou(first: NDArray[np.float32], second: NDArray[np.float32]) -> Array:
    """IoU of (N, 4) with (M, 4) boxes xyxy -> (N, M)."""
    shared = _shared(first, second)
    return np.asarray(shared / np.maximum(_area(first)[:, None] + _area(second)[None] - shared, 1e-9))


def _area(boxes: NDArray[np.float32]) -> Array:
    return np.asarray(np.prod(np.clip(boxes[:, 2:4] - boxes[:, :2], 0, None).astype(float), axis=1))


def _shared(first: NDArray[np.float32], second: NDArray[np.float32]) -> Array:
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:4], second[None, :, 2:4])
    return np.asarray(np.prod(np.clip(high - low, 0, None).astype(float), axis=2))


def match(
    found: Detections, known: NDArray[np.float32], extras_allowed: bool = False
) -> list[tuple[float, bool]]:
    """(score, is right) of each detection that counts, best first; each animal is found once.

    known (N, 5): xyxy px and 1 where the animal counts. `extras_allowed` leaves unmatched boxes out: the
    picture is known to show animals that have no box.
    """
    return match_animals(found, known, extras_allowed)[0]


def match_animals(
    found: Detections, known: NDArray[np.float32], extras_allowed: bool = False
) -> tuple[list[tuple[float, bool]], NDArray[np.float32]]:
    """The same, and the score with which each animal that counts was found (N,), 0 where it was not."""
    counted, faint = known[known[:, 4] > 0, :4], known[known[:, 4] == 0, :4]
    overlap = box_iou(found.boxes, counted)
    inside = _shared(found.boxes, faint) / np.maximum(_area(found.boxes)[:, None], 1e-9)
    scores = np.zeros(len(counted), np.float32)
    results: list[tuple[float, bool]] = []
    for index in np.argsort(-found.scores, kind="stable"):
        best = int(np.argmax(overlap[index] * (scores == 0))) if len(counted) else -1
        if best >= 0 and scores[best] == 0 and overlap[index, best] >= MATCH_IOU:
            scores[best] = found.scores[index]
            results.append((float(found.scores[index]), True))
        elif not extras_allowed and not np.any(inside[index] >= FAINT_SHARE):
            results.append((float(found.scores[index]), False))
    return results, scores


def average_precision(results: list[tuple[float, bool]], animals: int) -> float:
    """Area under the precision-recall curve, precision made monotone, all points (as PASCAL VOC 2010 and COCO
    do).
    """
    if animals == 0 or not results:
        return 0.0
    right = np.array([is_right for _, is_right in sorted(results, key=lambda item: -item[0])], float)
    found = np.cumsum(right)
    precision = found / np.arange(1, len(right) + 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(precision * right) / animals)
