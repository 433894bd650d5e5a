"""`--sensor boxes`: a detector and a tracker with calibrated errors in place of pixels, for large batches of
runs.

They read the table that `drivers.sim.camera.BoxPainter` wrote into the image. The errors are those of our own
detector on rendered seas: each edge off by a share of the side, a few animals missed, a few false alarms.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.sim.camera import BoxPainter

__all__ = ["BoxDetector", "BoxTracker", "read_boxes"]

Array = NDArray[np.float64]
JITTER_SHARE = 0.03
MISSED_SHARE = 0.02
FALSE_SHARE = 0.005
CENTRE_NOISE_PX = 1.5
CATCH_RADIUS_SHARE = 0.7
LOST_AFTER_S = 2.0


def read_boxes(image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Array]:
    """(ids (N,), boxes (N, 4) px) of the image's table; empty where it has none."""
    flat = image.reshape(-1)
    if bytes(flat[:4]) != BoxPainter.MARK:
        return np.zeros(0, np.int64), np.zeros((0, 4))
    (count,) = struct.unpack("<i", bytes(flat[4:8]))
    size = BoxPainter.ROW.size
    rows = [BoxPainter.ROW.unpack(bytes(flat[8 + k * size : 8 + (k + 1) * size])) for k in range(count)]
    return np.array([row[0] for row in rows], np.int64), np.array([row[1:] for row in rows]).reshape(-1, 4)


@dataclass
class BoxDetections:
    """What `Detector.detect` gives: boxes (N, 4) float32 px, scores (N,), classes (N,)."""

    boxes: NDArray[np.float32]
    scores: NDArray[np.float32]
    classes: NDArray[np.int64]
    names: dict[int, str] = field(default_factory=lambda: {0: "whale"})
    timings: dict[str, float] = field(default_factory=dict)


class BoxDetector:
    """True boxes with jitter, misses and false alarms."""

    def __init__(self, seed: int = 0) -> None:
        self._random = np.random.default_rng(seed)

    def detect(self, image: NDArray[np.uint8]) -> BoxDetections:
        """The image's boxes as a detector would give them."""
        _, boxes = read_boxes(image)
        sides = np.column_stack([boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]])
        boxes = boxes + self._random.normal(0, 1, boxes.shape) * JITTER_SHARE * np.tile(sides, 2)
        boxes = boxes[self._random.random(len(boxes)) >= MISSED_SHARE]
        if len(boxes) and self._random.random() < FALSE_SHARE:
            height, width = image.shape[:2]
            corner = self._random.uniform((0, 0), (width * 0.8, height * 0.8))
            boxes = np.vstack([boxes, [*corner, *(corner + sides.mean(axis=0))]])
        order = self._random.permutation(len(boxes))
        scores = self._random.uniform(0.5, 0.95, len(boxes)).astype(np.float32)
        return BoxDetections(boxes[order].astype(np.float32), scores, np.zeros(len(boxes), np.int64))


@dataclass
class BoxTrack:
    """What `MaskTracker` gives."""

    mask: NDArray[np.bool_]
    centre: Array
    box: Array
    state: str
    score: float
    outline: NDArray[np.int64]


class BoxTracker:
    """Follows the animal whose true box held the starting point; never leaps to another."""

    def __init__(self, seed: int = 0) -> None:
        self._random = np.random.default_rng([seed, 1])
        self.reset()

    def reset(self) -> None:
        """Forget the animal."""
        self._animal = -1
        self._last = BoxTrack(
            np.zeros((1, 1), np.bool_), np.zeros(2), np.zeros(4), "lost", 0.0, np.zeros((0, 2), np.int64)
        )
        self._unseen_s = 0.0

    def start(
        self,
        image: NDArray[np.uint8],
        point: Sequence[float],
        box: Any = None,
        companions: Sequence[Any] = (),
    ) -> BoxTrack:
        """Take up the animal at `point` (u, v) px."""
        ids, boxes = read_boxes(image)
        self.reset()
        if len(boxes):
            centres = (boxes[:, :2] + boxes[:, 2:]) / 2
            distance = np.linalg.norm(centres - np.asarray(point), axis=1)
            nearest = int(np.argmin(distance))
            reach = CATCH_RADIUS_SHARE * float(np.linalg.norm(boxes[nearest, 2:] - boxes[nearest, :2]))
            if distance[nearest] <= reach:
                self._animal = int(ids[nearest])
        return self.update(image)

    def update(self, image: NDArray[np.uint8], dt_s: float = 0.05, **_unused: Any) -> BoxTrack:
        """The animal in this image, or a prediction while it is away."""
        ids, boxes = read_boxes(image)
        found = np.flatnonzero(ids == self._animal)
        if len(found):
            box = boxes[found[0]]
            centre = (box[:2] + box[2:]) / 2 + self._random.normal(0, CENTRE_NOISE_PX, 2)
            self._unseen_s = 0.0
            self._last = BoxTrack(self._last.mask, centre, box, "tracking", 0.9, np.zeros((0, 2), np.int64))
        else:
            self._unseen_s += dt_s
            self._last.state = "predicted" if self._unseen_s < LOST_AFTER_S and self._animal >= 0 else "lost"
            self._last.score = 0.0
        return self._last
