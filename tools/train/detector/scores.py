"""Measures a detector: average precision, recall and precision at IoU 0.5, false alarms, milliseconds."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from procs.detector.yolo import Detections, Detector
from tools.train.detector.samples import Sample

__all__ = ["Score", "average_precision", "box_iou", "match", "recall_by_length", "score"]

Array = NDArray[np.float64]

MATCH_IOU = 0.5
FAINT_SHARE = 0.5  # a detection this far inside an animal too faint to count is no false alarm
LENGTHS_PX = (0, 12, 24, 48, 96, 400)
EVERY_SCORE = 0.01  # average precision needs the low scores too


@dataclass(frozen=True)
class Score:
    """What a detector makes of one set of pictures."""

    pictures: int
    animals: int
    average_precision: float  # AP50: area under precision over recall, all confidences
    recall: float  # at the detector's confidence
    precision: float
    false_alarms: float  # boxes on no animal, a picture
    exact_count_share: float  # pictures with exactly as many boxes as animals
    milliseconds: float  # a picture, the median

    def line(self) -> str:
        return (
            f"pictures {self.pictures}, animals {self.animals}: AP50 {self.average_precision:.3f}, "
            f"recall {self.recall:.3f}, precision {self.precision:.3f}, "
            f"false alarms a picture {self.false_alarms:.3f}, exact count {self.exact_count_share:.3f}, "
            f"{self.milliseconds:.1f} ms a picture"
        )


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
    counted, faint = known[known[:, 4] > 0, :4], known[known[:, 4] == 0, :4]
    overlap = box_iou(found.boxes, counted)
    inside = _shared(found.boxes, faint) / np.maximum(_area(found.boxes)[:, None], 1e-9)
    free = np.ones(len(counted), bool)
    results: list[tuple[float, bool]] = []
    for index in np.argsort(-found.scores, kind="stable"):
        best = int(np.argmax(overlap[index] * free)) if len(counted) else -1
        if best >= 0 and free[best] and overlap[index, best] >= MATCH_IOU:
            free[best] = False
            results.append((float(found.scores[index]), True))
        elif not extras_allowed and not np.any(inside[index] >= FAINT_SHARE):
            results.append((float(found.scores[index]), False))
    return results


def recall_by_length(detector: Detector, samples: Iterable[Sample]) -> dict[str, tuple[int, int]]:
    """(found, all) animals by the long side of their box, px of the detector's input, in LENGTHS_PX."""
    counts = {f"{low}-{high} px": [0, 0] for low, high in pairwise(LENGTHS_PX)}
    for sample in samples:
        known = sample.boxes[sample.boxes[:, 4] > 0, :4]
        overlap = box_iou(detector.detect(np.ascontiguousarray(sample.image)).boxes, known)
        width, height = detector.input_size
        scale = min(width / sample.image.shape[1], height / sample.image.shape[0])
        long_px = (known[:, 2:] - known[:, :2]).max(axis=1, initial=0) * scale
        for length_px, best in zip(long_px, overlap.max(axis=0, initial=0), strict=True):
            place = int(np.clip(np.searchsorted(LENGTHS_PX, length_px, "right") - 1, 0, len(LENGTHS_PX) - 2))
            count = list(counts.values())[place]
            count[0] += bool(best >= MATCH_IOU)
            count[1] += 1
    return {key: (hits, total) for key, (hits, total) in counts.items()}


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


def score(
    make_detector: Callable[[float], Detector],
    samples: Iterable[Sample],
    confidence: float = 0.25,
    extras_allowed: frozenset[int] = frozenset(),
) -> Score:
    """Score the detector that `make_detector(confidence)` builds; `extras_allowed` are places of samples, see
    `match`.
    """
    detector = make_detector(EVERY_SCORE)
    every: list[tuple[float, bool]] = []
    animals = pictures = exact = 0
    times_ms = []
    for place, sample in enumerate(samples):
        found = detector.detect(np.ascontiguousarray(sample.image))
        times_ms.append(sum(found.timings.values()))
        results = match(found, sample.boxes, place in extras_allowed)
        every += results
        count = int((sample.boxes[:, 4] > 0).sum())
        exact += sum(value >= confidence for value, _ in results) == count
        animals, pictures = animals + count, pictures + 1
    sure = [is_right for value, is_right in every if value >= confidence]
    return Score(
        pictures=pictures,
        animals=animals,
        average_precision=average_precision(every, animals),
        recall=sum(sure) / max(animals, 1),
        precision=sum(sure) / max(len(sure), 1),
        false_alarms=(len(sure) - sum(sure)) / max(pictures, 1),
        exact_count_share=exact / max(pictures, 1),
        milliseconds=float(np.median(times_ms)) if times_ms else 0.0,
    )
