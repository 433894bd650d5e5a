"""How the whole picture moved since the frame before, seen in the picture itself.

Yaw and tilt move the sea and all animals alike; told apart from the animal's own motion, they neither spoil
its velocity nor carry a diving animal's prediction away. Used where the vehicle's state gives no image
motion.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["CameraMotion"]

Array = NDArray[np.float64]

WIDTH_MOST_PX = 400  # of the picture in which the sea is followed; a larger one is halved, which costs least
GRID = (8, 6)  # points across and down
LEAST_POINTS = 12  # fewer agreeing points than this say nothing
AGREE_PX = 1.0  # of the reduced picture: a point further off than this follows a wave or an animal
ROUNDS = 3


class CameraMotion:
    """Follows a fixed grid of points by sparse optical flow and fits turn, scale and shift to those that
    agree.
    """

    def __init__(self) -> None:
        self._before: NDArray[np.uint8] | None = None

    def forget(self) -> None:
        """The next frame has nothing before it."""
        self._before = None

    def between(self, image_bgr: NDArray[np.uint8]) -> Array:
        """(3, 3) homography from the frame of the last call to this one, px; the identity where it cannot be
        told.
        """
        small, scale = image_bgr, 1.0
        while small.shape[1] > WIDTH_MOST_PX:
            size = (small.shape[1] // 2, small.shape[0] // 2)
            small = np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
            scale /= 2
        now = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        before, self._before = self._before, now
        if before is None or before.shape != now.shape or _is_flat(before) or _is_flat(now):
            return np.eye(3)
        size = (now.shape[1], now.shape[0])
        columns = np.linspace(0.08, 0.92, GRID[0]) * size[0]
        rows = np.linspace(0.08, 0.92, GRID[1]) * size[1]
        start = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2).astype(np.float32)
        end, found, _ = cv2.calcOpticalFlowPyrLK(
            before, now, start, start.copy(), winSize=(13, 13), maxLevel=3, criteria=(3, 8, 0.05)
        )
        good = found.ravel() > 0
        similarity = _fit(start[good, 0].astype(np.float64), end[good, 0].astype(np.float64))
        if similarity is None:
            return np.eye(3)
        # The reduced picture's pixel centres lie half a pixel inside, the tracker's coordinates do not.
        similarity[:2, 2] = (similarity[:2, 2] + 0.5 - similarity[:2, :2] @ np.array([0.5, 0.5])) / scale
        return similarity


def _is_flat(picture: NDArray[np.uint8]) -> bool:
    return float(cv2.meanStdDev(picture)[1].max()) < 1.0


def _fit(start: Array, end: Array) -> Array | None:
    """(3, 3) similarity from the points that agree with the most, by least squares with trimming."""
    if len(start) < LEAST_POINTS:
        return None
    motion = np.median(end - start, axis=0)
    error = np.hypot(*(end - start - motion).T)
    kept = error <= max(AGREE_PX, float(np.median(error)) * 1.5)
    similarity = np.eye(3)
    for _ in range(ROUNDS):
        if int(kept.sum()) < LEAST_POINTS:
            return None
        similarity = _least_squares(start[kept], end[kept])
        error = np.hypot(*(end - start @ similarity[:2, :2].T - similarity[:2, 2]).T)
        kept = error <= AGREE_PX
    enough = int(kept.sum()) >= max(LEAST_POINTS, len(start) // 3)
    return similarity if enough else None


def _least_squares(start: Array, end: Array) -> Array:
    """The turn, scale and shift that take `start` (N, 2) to `end` (N, 2), as (3, 3)."""
    a, b = start - start.mean(axis=0), end - end.mean(axis=0)
    square = max(float((a * a).sum()), 1e-9)
    cosine = float((a * b).sum()) / square
    sine = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()) / square
    turned = np.array([[cosine, -sine], [sine, cosine]])
    similarity = np.eye(3)
    similarity[:2, :2] = turned
    similarity[:2, 2] = end.mean(axis=0) - turned @ start.mean(axis=0)
    return similarity
