"""From a detection network's output to boxes: the layouts of exported ONNX files (docs/detector.md)."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Candidates", "Layout", "ModelError", "best_first", "decode", "layout_of", "suppress"]

MOST_BOXES = 300  # far above any pod
MOST_CANDIDATES = 1000  # compared with each other: bounds the time that a shouting network can cost
MOST_REFUSED_SHARE = 0.5  # of an output's rows that may be odd before the model counts as broken
MOST_SCORE = 1.01  # half precision rounds up; a score above that was never a probability
MOST_FINISHED_ROWS = 3000  # ten times what any exporter keeps where overlaps are gone
YOLOV5 = (
    "centre, size, objectness and a score a class, as YOLOv5 exports; train a yolov5nu or a later model with "
    "Ultralytics 8 or newer and export that"
)
NORMALISED_BELOW = 2.0  # no finished box in pixels has all its numbers below this


class ModelError(Exception):
    """A model that cannot be used; the message names the file, what is wrong and the remedy."""


class Candidates(NamedTuple):
    """Boxes in the pixels of what the network was shown."""

    boxes: NDArray[np.float32]  # (N, 4) xyxy
    scores: NDArray[np.float32]  # (N,)
    classes: NDArray[np.int64]  # (N,)
    turned: NDArray[np.float32] | None = None  # (N, 5) centre x, y, width, height, angle rad: oriented boxes

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "Candidates":
        """Those of `rows`, a mask or indices."""
        turned = None if self.turned is None else self.turned[rows]
        return Candidates(self.boxes[rows], self.scores[rows], self.classes[rows], turned)


class Layout(NamedTuple):
    """raw: (1, 4 + nc [+ 1], A), overlapping boxes. finished: (1, N, 6), or 7 where oriented, overlaps gone.
    queries: RT-DETR's (1, N, 6) or (1, N, 4 + nc), overlaps gone, boxes as shares of the input's sides.
    """

    kind: Literal["raw", "finished", "queries"]
    oriented: bool = False


def layout_of(
    shape: Sequence[int], class_count: int | None, task: str | None = None, head: str = ""
) -> Layout:
    """The layout of an output of `shape`; ValueError names the shape when it has none that is known.

    class_count: None where the metadata names no classes. task, head: as the metadata says. The order of the
    questions is that of docs/detector.md: RT-DETR's output looks like a finished one, and a finished one is
    told from a raw one by its last dimension, since no network has six or seven cells.
    """
    oriented = task == "obb"
    extra = 1 if oriented else 0
    if len(shape) == 3 and shape[0] == 1:
        _, rows, columns = shape
        if "DETR" in head.upper():
            if columns == 6 or columns == 4 + (class_count or 0):
                return Layout("queries")
        elif task is None and columns in (6, 7) and rows > MOST_FINISHED_ROWS:
            raise ValueError(f"output shape {tuple(shape)} is {YOLOV5}")
        elif columns == 7 and task != "detect":
            return Layout("finished", oriented=True)
        elif columns == 6 and not oriented:
            return Layout("finished")
        elif class_count is not None:
            if rows == 4 + extra + class_count:
                return Layout("raw", oriented)
            if columns == 5 + class_count and not oriented:  # an oriented one with so many lies on its side
                raise ValueError(f"output shape {tuple(shape)} is {YOLOV5}")
        elif rows > 4 + extra and not rows > max(columns, 100):  # more rows than cells: turned on its side
            return Layout("raw", oriented)
    expected = "4 + classes" if class_count is None else str(4 + class_count)
    plus = " + 1" if oriented else ""
    raise ValueError(
        f"output shape {tuple(shape)} is neither (1, {expected}{plus}, A) nor (1, N, {6 + extra})"
    )


def decode(
    output: NDArray[np.float32], layout: Layout, confidence: float, size: tuple[int, int]
) -> Candidates:
    """The rows of `output` above `confidence`, in px of the network's input of `size` (width, height).

    Raises ModelError where most rows are no numbers, most scores are above 1, or the boxes are no pixels.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # what comes of infinities is NaN, and is left out
        if layout.kind == "raw":
            return _raw(output, layout.oriented, confidence)
        if layout.kind == "queries":
            return _queries(output, confidence, size)
        return _finished(output, layout.oriented, confidence)


def _raw(output: NDArray[np.float32], oriented: bool, confidence: float) -> Candidates:
    """Centre x, y, width, height, a score a class [, angle]: one class for each cell, the likeliest."""
    rows = output[0]
    scores = rows[4:-1] if oriented else rows[4:]
    best = scores[0] if len(scores) == 1 else scores.max(axis=0)
    # Threshold, then gather: few of some thousand cells have anything to say. NaN stays in, to be counted.
    kept = (~(best < confidence)).nonzero()[0]
    classes = np.zeros(len(kept), np.int64) if len(scores) == 1 else scores[:, kept].argmax(axis=0)
    angle_rad = rows[-1, kept] if oriented else None
    return _sound(_upright(rows[:4, kept].T, angle_rad, best[kept], classes), rows.shape[1])


def _finished(output: NDArray[np.float32], oriented: bool, confidence: float) -> Candidates:
    """x0, y0, x1, y1, score, class; an oriented box: centre x, y, width, height, score, class, angle."""
    rows = output[0]
    # Whatever the confidence, a score of 0 is a row that only fills the output up. NaN stays, to be counted.
    rows = rows[~((rows[:, 4] < confidence) | (rows[:, 4] <= 0))]
    classes = np.nan_to_num(rows[:, 5]).astype(np.int64)
    if oriented:
        found = _upright(rows[:, :4], rows[:, 6], rows[:, 4], classes)
    else:
        found = Candidates(rows[:, :4], rows[:, 4], classes)
    found = _sound(found, output.shape[1])
    _refuse_yolov5(rows, oriented)
    if len(found.scores) and np.abs(found.boxes).max() < NORMALISED_BELOW:
        raise ModelError(
            f"the boxes lie between {found.boxes.min():.2f} and {found.boxes.max():.2f}: shares of the "
            "picture, where pixels are needed; export the model again with a newer Ultralytics, which says "
            "in the metadata that its head is RT-DETR"
        )
    return found


def _refuse_yolov5(rows: NDArray[np.float32], oriented: bool) -> None:
    """ModelError where most of a finished output's rows above the confidence have no class or no corners."""
    odd = np.nan_to_num(rows[:, 5]) % 1 != 0
    if not oriented:
        odd |= np.any(rows[:, 2:4] < rows[:, :2], axis=1)
    if np.count_nonzero(odd) > MOST_REFUSED_SHARE * len(rows):
        raise ModelError(
            f"{np.count_nonzero(odd)} of {len(rows)} rows above the confidence have a class that is no whole "
            f"number, or a right side left of the left one: the output is {YOLOV5}"
        )


def _queries(output: NDArray[np.float32], confidence: float, size: tuple[int, int]) -> Candidates:
    """RT-DETR: centre x, y, width, height as shares of the input; score and class, or a score a class."""
    rows = output[0]
    best, classes = rows[:, 4], np.nan_to_num(rows[:, -1])
    # With two classes both are 6 columns: class numbers are whole, a column of scores is not.
    if rows.shape[1] != 6 or np.any(classes % 1):
        best, classes = rows[:, 4:].max(axis=1), rows[:, 4:].argmax(axis=1)
    kept = np.flatnonzero(~(best < confidence))
    boxes = rows[kept, :4] * np.array([*size, *size], np.float32)
    return _sound(_upright(boxes, None, best[kept], classes[kept].astype(np.int64)), len(rows))


def _upright(
    boxes: NDArray[np.float32],
    angle_rad: NDArray[np.float32] | None,
    scores: NDArray[np.float32],
    classes: NDArray[np.int64],
) -> Candidates:
    """(N, 4) centre x, y, width, height -> xyxy; an oriented box becomes the upright one round it."""
    centre, size = boxes[:, :2], boxes[:, 2:]
    turned = None
    if angle_rad is not None:
        turned = np.column_stack([boxes, angle_rad])
        cosine, sine = np.abs(np.cos(angle_rad))[:, None], np.abs(np.sin(angle_rad))[:, None]
        size = size * cosine + size[:, ::-1] * sine
    half = size * np.float32(0.5)
    return Candidates(np.concatenate([centre - half, centre + half], axis=1), scores, classes, turned)


def _sound(found: Candidates, total: int) -> Candidates:
    """Without rows that are no numbers or no scores; ModelError when they are most of `total`, or when most
    of those above the confidence have scores above 1.
    """
    # A sum is no number where any of its parts is none, and a greatest score is NaN where any of them is.
    if np.isfinite(found.boxes.sum()) and found.scores.max(initial=0) <= MOST_SCORE:
        return found
    n_loud = int(np.count_nonzero(np.isfinite(found.scores) & (found.scores > MOST_SCORE)))
    if n_loud > MOST_REFUSED_SHARE * len(found.scores):
        raise ModelError(
            f"{n_loud} of {len(found.scores)} rows above the confidence have scores above 1, as logits or "
            "percents; export the model again, with its scores from 0 to 1"
        )
    good = np.isfinite(found.boxes.sum(axis=1)) & (found.scores <= MOST_SCORE)
    n_refused = len(good) - int(np.count_nonzero(good))
    if n_refused > MOST_REFUSED_SHARE * total:
        raise ModelError(
            f"{n_refused} of {total} rows of the output are NaN, infinite or scores above 1; export the "
            "model again, in float32 and with its scores from 0 to 1"
        )
    return found.take(good)


def suppress(found: Candidates, iou: float) -> Candidates:
    """Without the lesser of two boxes of one class that overlap by more than `iou`, best first.

    Oriented boxes are compared as they lie: two whales side by side, seen aslant, have upright boxes that
    overlap.
    """
    if len(found.scores) > MOST_CANDIDATES:
        found = found.take(np.argpartition(-found.scores, MOST_CANDIDATES)[:MOST_CANDIDATES])
    if len(found.scores) < 2:
        return found
    if found.turned is not None:
        return best_first(found.take(_kept_turned(found, iou)))
    return found.take(_kept(found, iou)[:MOST_BOXES])


def best_first(found: Candidates) -> Candidates:
    """By score, and no more than any pod has."""
    return found.take(np.argsort(-found.scores, kind="stable")[:MOST_BOXES])


def _kept(found: Candidates, iou: float) -> NDArray[np.int64]:
    """Which upright boxes stay, best first."""
    sizes = found.boxes.copy()
    sizes[:, 2:] -= sizes[:, :2]
    # Lists, not arrays: the binding converts an array element by element, four times slower.
    kept = cv2.dnn.NMSBoxesBatched(sizes.tolist(), found.scores.tolist(), found.classes.tolist(), 0.0, iou)
    return np.asarray(kept, np.int64).reshape(-1)


def _kept_turned(found: Candidates, iou: float) -> NDArray[np.int64]:
    """Which oriented boxes stay, class by class."""
    assert found.turned is not None
    kept = []
    for number in np.unique(found.classes).tolist():
        rows = np.flatnonzero(found.classes == number)
        boxes = [
            ((x, y), (max(width, 0.0), max(height, 0.0)), float(np.degrees(angle_rad)))
            for x, y, width, height, angle_rad in found.turned[rows].tolist()
        ]
        chosen = cv2.dnn.NMSBoxesRotated(boxes, found.scores[rows].tolist(), 0.0, iou)
        kept.append(rows[np.asarray(chosen, np.int64).reshape(-1)])
    return np.concatenate(kept)
