"""From a detection network's output to boxes: the layouts of exported ONNX files (docs/detector.md)."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Candidates", "ModelError", "decode_finished", "decode_raw", "layout_of", "suppress"]

MOST_BOXES = 300  # far above any pod; bounds the time that a shouting network can cost
MOST_REFUSED_SHARE = 0.5  # of the output's rows that may be NaN or infinite before the model counts as broken


class ModelError(Exception):
    """A model that cannot be used; the message names the file, what is wrong and the remedy."""


class Candidates(NamedTuple):
    """Boxes in the network's pixels."""

    boxes: NDArray[np.float32]  # (N, 4) xyxy
    scores: NDArray[np.float32]  # (N,)
    classes: NDArray[np.int64]  # (N,)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "Candidates":
        """Those of `rows`, a mask or indices."""
        return Candidates(self.boxes[rows], self.scores[rows], self.classes[rows])


def layout_of(
    shape: Sequence[int], class_count: int | None, task: str = "detect"
) -> Literal["raw", "finished"]:
    """Which layout an output of `shape` has; ValueError names the shape when it is neither.

    raw: (1, 4 + nc, A), one more row for the angle of an oriented box. finished: (1, N, 6), or 7 with an
    angle. The finished one is tried first: no network has 6 or 7 cells, but many have two or three classes.
    """
    extra = 1 if task == "obb" else 0
    if len(shape) == 3 and shape[0] == 1:
        if shape[2] == 6 + extra:
            return "finished"
        rows = shape[1]
        if (class_count is None and rows > 4 + extra) or rows == 4 + extra + (class_count or 0):
            return "raw"
    expected = "4 + classes" if class_count is None else str(4 + extra + class_count)
    raise ValueError(f"output shape {tuple(shape)} is neither (1, {expected}, A) nor (1, N, {6 + extra})")


def _upright(boxes: NDArray[np.float32], angle_rad: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """(N, 4) centre x, y, width, height -> xyxy; an oriented box becomes the upright one round it."""
    centre, size = boxes[:, :2], boxes[:, 2:4]
    if angle_rad is not None:
        cosine, sine = np.abs(np.cos(angle_rad))[:, None], np.abs(np.sin(angle_rad))[:, None]
        size = size * cosine + size[:, ::-1] * sine
    return np.concatenate([centre - size / 2, centre + size / 2], axis=1)


def _finite(candidates: Candidates, total: int) -> Candidates:
    """Without rows that hold NaN or infinity; ModelError when they are most of the output."""
    good = np.isfinite(candidates.scores) & np.isfinite(candidates.boxes).all(axis=1)
    refused = int(len(good) - good.sum())
    if refused > MOST_REFUSED_SHARE * max(total, 1):
        raise ModelError(
            f"{refused} of {total} rows of the output are NaN or infinite; export the model again, in float32"
        )
    return candidates.take(good)


def decode_raw(output: NDArray[np.float32], confidence: float, task: str = "detect") -> Candidates:
    """Rows above `confidence` of a raw output (1, 4 + nc [+ 1], A): one class each, the likeliest."""
    rows = output[0]
    angle = rows[-1] if task == "obb" else None
    scores = rows[4:-1] if task == "obb" else rows[4:]
    best = scores.max(axis=0)
    keep = ~(best < confidence)  # NaN stays in, to be counted
    kept = rows[:4, keep].T
    boxes = _upright(kept, None if angle is None else angle[keep])
    return _finite(Candidates(boxes, best[keep], scores[:, keep].argmax(axis=0)), rows.shape[1])


def decode_finished(output: NDArray[np.float32], confidence: float, task: str = "detect") -> Candidates:
    """Rows above `confidence` of a finished output (1, N, 6): x0, y0, x1, y1, score, class.

    An oriented box has centre x, y, width, height, score, class, angle.
    """
    rows = output[0]
    rows = rows[~(rows[:, 4] < confidence)]
    boxes = _upright(rows[:, :4], rows[:, 6]) if task == "obb" else rows[:, :4]
    classes = np.nan_to_num(rows[:, 5]).astype(np.int64)
    return _finite(Candidates(boxes, rows[:, 4], classes), output.shape[1])


def suppress(candidates: Candidates, confidence: float, iou: float) -> Candidates:
    """Without the lesser of two boxes of one class that overlap by more than `iou`, best first."""
    if len(candidates.scores) == 0:
        return candidates
    sizes = np.concatenate(
        [candidates.boxes[:, :2], candidates.boxes[:, 2:] - candidates.boxes[:, :2]], axis=1
    )
    # Lists, not arrays: the binding converts an array element by element, four times slower.
    kept = cv2.dnn.NMSBoxesBatched(
        sizes.tolist(), candidates.scores.tolist(), candidates.classes.tolist(), confidence, iou
    )
    order = np.asarray(kept, np.int64).reshape(-1)
    order = order[np.argsort(-candidates.scores[order], kind="stable")][:MOST_BOXES]
    return candidates.take(order)
