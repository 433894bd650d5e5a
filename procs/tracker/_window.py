"""A part of the frame at working resolution, and the way between its pixels and the frame's.

Coordinates are continuous, as in drivers.cameras.pinhole: the frame spans 0..width by 0..height, and the
pixel of column i covers i..i+1.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Window", "window_round"]

Array = NDArray[np.float64]
MIN_SIDE_PX = 8  # a sliver at the edge of the frame shows nothing that can be judged


@dataclass(frozen=True)
class Window:
    """Frame columns left..right and rows top..bottom (px, whole numbers), seen as `size` (width, height)
    px.
    """

    left: int
    top: int
    right: int
    bottom: int
    size: tuple[int, int]

    @property
    def scale(self) -> float:
        """Window px a frame px; never above 1."""
        return self.size[0] / (self.right - self.left)

    def cut(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """This window's pixels, (height, width, 3)."""
        part = image[self.top : self.bottom, self.left : self.right]
        if self.size == (self.right - self.left, self.bottom - self.top):
            return part
        return np.asarray(cv2.resize(part, self.size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def to_window(self, points: Array) -> Array:
        """(..., 2) frame px -> window px."""
        return np.asarray((points - np.array([self.left, self.top])) * self.scale)

    def to_frame(self, points: Array) -> Array:
        """(..., 2) window px -> frame px."""
        return np.asarray(points / self.scale + np.array([self.left, self.top]))

    def paste(self, mask: NDArray[np.bool_], frame_shape: tuple[int, int]) -> NDArray[np.bool_]:
        """A window mask as a mask of the whole frame, (height, width) bool."""
        whole = np.zeros(frame_shape, dtype=np.bool_)
        width, height = self.right - self.left, self.bottom - self.top
        if self.size != (width, height):
            # Linear, then cut at one half: a smooth edge instead of the window's coarse steps.
            soft = cv2.resize(mask.astype(np.uint8) * 255, (width, height), interpolation=cv2.INTER_LINEAR)
            mask = np.asarray(soft) > 127
        whole[self.top : self.bottom, self.left : self.right] = mask
        return whole

    def open_edges(self, frame_shape: tuple[int, int]) -> tuple[bool, bool, bool, bool]:
        """Which of left, top, right, bottom are the frame's own edges."""
        height, width = frame_shape
        return self.left <= 0, self.top <= 0, self.right >= width, self.bottom >= height


def window_round(centre: Array, half_px: float, scale: float, frame_shape: tuple[int, int]) -> Window | None:
    """The square of `half_px` round `centre` (2,), clipped to the frame; None when too little of it is in the
    frame.
    """
    height, width = frame_shape
    left, top = max(0, int(centre[0] - half_px)), max(0, int(centre[1] - half_px))
    right, bottom = min(width, int(centre[0] + half_px) + 1), min(height, int(centre[1] + half_px) + 1)
    if right - left < MIN_SIDE_PX or bottom - top < MIN_SIDE_PX:
        return None
    scale = min(1.0, scale)
    size = max(4, round((right - left) * scale)), max(4, round((bottom - top) * scale))
    return Window(left, top, right, bottom, size)
