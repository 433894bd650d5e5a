"""A picture made to fit a network: shrunk, set on grey, as planes of red, green and blue from 0 to 1."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Fitted", "Letterbox"]

PAD_GREY = 114  # round the picture, as in training
MOST_SHAPES = 8  # of pictures whose buffers are kept: the whole, its tiles, now and then another camera's


class Fitted(NamedTuple):
    """A picture as the network gets it. All arrays are kept buffers, good until the next picture."""

    tensor: NDArray[np.floating]  # (1, 3, height, width)
    planes: NDArray[np.uint8]  # (3, h, w) RGB: the shrunk picture without the grey
    scale: NDArray[np.float32]  # (4,) px of the input for each px of the picture, x and y twice
    corner: NDArray[np.float32]  # (4,) px of the input where the picture begins, x and y twice

    def to_picture(self, boxes: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N, 4) xyxy px of the input -> px of the picture."""
        return (boxes - self.corner) / self.scale


class Letterbox:
    """Fits pictures to `size` (width, height). `stretch`: each side by itself, in place of grey bars."""

    def __init__(self, size: tuple[int, int], dtype: type[np.floating], stretch: bool = False) -> None:
        self._size, self._dtype, self._stretch = size, dtype, stretch
        self._kept: dict[tuple[int, int], _Buffers] = {}

    def fit(self, image: NDArray[np.uint8]) -> Fitted:
        """(H, W, 3) uint8 BGR -> what the network gets."""
        height, width = image.shape[:2]
        buffers = self._kept.get((width, height))
        if buffers is None:
            if len(self._kept) >= MOST_SHAPES:
                self._kept.clear()
            buffers = _Buffers((width, height), self._size, self._dtype, self._stretch)
            self._kept[width, height] = buffers
        return buffers.fill(image)


class _Buffers:
    """Everything that pictures of one size need, made once."""

    def __init__(
        self, picture: tuple[int, int], size: tuple[int, int], dtype: type[np.floating], stretch: bool
    ) -> None:
        width, height = size
        ratio = min(width / picture[0], height / picture[1])
        inner = size if stretch else (max(round(picture[0] * ratio), 1), max(round(picture[1] * ratio), 1))
        left, top = (width - inner[0]) // 2, (height - inner[1]) // 2
        self._steps = [(np.empty((h, w, 3), np.uint8), how) for w, h, how in shrink_steps(picture, inner)]
        planes = np.empty((3, inner[1], inner[0]), np.uint8)
        self._split = [planes[2], planes[1], planes[0]]  # BGR comes, RGB goes
        self._scale = dtype(1 / 255)
        tensor = np.full((1, 3, height, width), PAD_GREY / 255, dtype)
        self._inner = tensor[0, :, top : top + inner[1], left : left + inner[0]]
        scale = (inner[0] / picture[0], inner[1] / picture[1])
        self._fitted = Fitted(
            tensor, planes, np.array(2 * scale, np.float32), np.array([left, top, left, top], np.float32)
        )

    def fill(self, image: NDArray[np.uint8]) -> Fitted:
        for buffer, how in self._steps:
            cv2.resize(image, (buffer.shape[1], buffer.shape[0]), dst=buffer, interpolation=how)
            image = buffer
        cv2.split(image, self._split)
        self._inner[...] = self._fitted.planes
        np.multiply(self._inner, self._scale, out=self._inner)
        return self._fitted


def shrink_steps(picture: tuple[int, int], inner: tuple[int, int]) -> list[tuple[int, int, int]]:
    """(width, height, interpolation) of each step from a picture's size to the size that it gets.

    Halves are means of four pixels, so that waves do not turn into false patterns; they are several times
    faster than shrinking by area in one step, which for odd sizes takes opencv 5.0 a third of a second. What
    is left is less than a half and is interpolated: after the halves, or before them where the picture's
    sides cannot be halved so often. All pixels keep their weight, so the way back to the picture is exact.
    """
    n_halves = 0
    while min(picture[0] / inner[0], picture[1] / inner[1]) >= 2 ** (n_halves + 1):
        n_halves += 1
    whole = 2**n_halves
    steps = []
    width, height = picture
    if width % whole or height % whole:
        width, height = inner[0] * whole, inner[1] * whole
        steps.append((width, height, cv2.INTER_LINEAR))
    for _ in range(n_halves):
        width, height = width // 2, height // 2
        steps.append((width, height, cv2.INTER_AREA))
    if (width, height) != inner:
        steps.append((*inner, cv2.INTER_LINEAR))
    return steps
