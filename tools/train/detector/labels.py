"""Labels as YOLO writes them: text beside a picture, a line an animal, in shares of the picture's sides."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.errors import UnusableError

__all__ = ["read_labels", "text_of"]

LEAST_BOX_PX = 1.0  # a slip of the mouse; the trainer divides by a box's sides


def text_of(path: Path) -> str:
    """The file's text, with or without a byte order mark; what is no UTF-8 is refused by whoever reads it."""
    return path.read_text("utf-8-sig", errors="replace")


def read_labels(
    path: Path, size: tuple[int, int], counted: Mapping[int, bool] | None = None
) -> NDArray[np.float32]:
    """Boxes (N, 5) of a picture of `size` (width, height): xyxy px, then 1; no file means no animal.

    A line is `class x y w h`, middle and sides, or `class x1 y1 x2 y2 x3 y3 ...`, a polygon, of which the box
    round it is taken; blank lines mean nothing. counted: whether a class number counts as an animal; None:
    all do. Raises UnusableError with file and line for anything else.
    """
    boxes = []
    for number, line in enumerate(text_of(path).splitlines() if path.is_file() else [], 1):
        if not line.strip():
            continue
        try:
            kind, *box = _numbers(line, size)
            if counted is not None and kind not in counted:
                raise ValueError(f"class {kind:g} is none of the data set's: {', '.join(map(str, counted))}")
        except ValueError as error:
            raise UnusableError(f"{path}: line {number} {line!r}: {error}") from None
        if counted is None or counted[int(kind)]:
            boxes.append([*box, 1.0])
    return np.array(boxes, np.float32).reshape(-1, 5)


def _numbers(line: str, size: tuple[int, int]) -> list[float]:
    """Class, x0, y0, x1, y1 px of a line. Raises ValueError saying what is wrong with it."""
    width, height = size
    try:
        kind, *values = (float(word) for word in line.split())
    except ValueError:
        raise ValueError("holds what is no number") from None
    if len(values) != 4 and (len(values) < 6 or len(values) % 2):
        raise ValueError("is neither 'class x y w h' nor 'class x1 y1 x2 y2 x3 y3 ...'")
    if not kind.is_integer():
        raise ValueError(f"class {kind} is no whole number")
    if not all(0 <= value <= 1 for value in values):  # nor is any of them nan
        raise ValueError("numbers must be shares of the picture's sides, 0 to 1; divide pixels by them")
    if len(values) == 4:
        x, y, w, h = values
        x0, y0, x1, y1 = x - w / 2, y - h / 2, x + w / 2, y + h / 2
    else:
        x0, y0, x1, y1 = min(values[::2]), min(values[1::2]), max(values[::2]), max(values[1::2])
    if min((x1 - x0) * width, (y1 - y0) * height) < LEAST_BOX_PX:
        raise ValueError(f"its box is under {LEAST_BOX_PX:g} px wide or high; remove the line")
    return [kind, x0 * width, y0 * height, x1 * width, y1 * height]
