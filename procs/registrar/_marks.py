"""What registration knows of each animal in a view or in a map: centre, shape up to a mirror, and what its
absence costs.

An axis-aligned box of a long body tells the body's axis up to a mirror. Taking the body for an ellipse of
fixed width, the box gives the ellipse's second-moment matrix but for the sign of its off-diagonal term;
both candidates are kept, and any homography carries them through its Jacobian. An animal seen from two
headings has one candidate left.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Marks", "check_boxes", "ellipse_shapes", "marks_from_boxes", "rectangle"]

Array = NDArray[np.float64]

BODY_WIDTH = 0.22  # width over length of the animal taken for an ellipse; whales lie between 0.18 and 0.3
NEARLY_SQUARE, LIES_ACROSS = 0.6, 0.35  # short over long side, and the share of long bodies' boxes above it
ROUND_BODIES = 0.05  # chance beforehand that a pod's boxes tell no axis
DETECTION_PRICE = (
    2.4  # nats, ln(0.92 / 0.08): a box that should have a partner in the other view and has none
)


@dataclass(frozen=True)
class Marks:
    """Animals as one view or one map knows them, in that frame's own length unit.

    `centres` (N, 2); `shapes` (N, 2, 2, 2), two candidates of the matrix whose diagonal is the box's
    squared width and height; `prices` (N,) nats, the price of a mark without a partner although it lies in
    the other's `window`; `window` (M, 2), the convex outline of what the view covers, or None where nobody
    said; `axis_known` (N,) 0 to 1, 0 where the shapes say nothing of the axis (None: all known).
    """

    centres: Array
    shapes: Array
    prices: Array
    window: Array | None = None
    axis_known: Array | None = None

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def sizes(self) -> Array:
        """(N,) sqrt(width^2 + height^2), which hardly changes with heading."""
        return np.asarray(np.sqrt(np.trace(self.shapes, axis1=2, axis2=3).mean(axis=1)))

    def through(self, homography: Array) -> "Marks":
        """The same marks in another frame, by a (3, 3) homography of this frame into that one."""
        flat = np.column_stack([self.centres, np.ones(len(self))]) @ homography.T
        centres = flat[:, :2] / flat[:, 2:]
        jacobians = (homography[None, :2, :2] - centres[:, :, None] * homography[None, 2:, :2]) / flat[
            :, 2, None, None
        ]
        shapes = np.einsum("nab,ncbd,ned->ncae", jacobians, self.shapes, jacobians)
        window = None
        if self.window is not None:
            corners = np.column_stack([self.window, np.ones(len(self.window))]) @ homography.T
            window = corners[:, :2] / corners[:, 2:]
        return replace(self, centres=centres, shapes=shapes, window=window)


def ellipse_shapes(sizes: Array, axes_rad: Array) -> Array:
    """(N,) sizes and (N, 2) candidate axes, radians from the frame's first coordinate to its second -> (N,
    2, 2, 2) shapes.
    """
    long = (1 - BODY_WIDTH**2) / (1 + BODY_WIDTH**2)
    shapes = np.empty((len(sizes), 2, 2, 2))
    shapes[..., 0, 0] = 1 + long * np.cos(2 * axes_rad)
    shapes[..., 1, 1] = 1 - long * np.cos(2 * axes_rad)
    shapes[..., 0, 1] = shapes[..., 1, 0] = long * np.sin(2 * axes_rad)
    return np.asarray(shapes * (sizes**2 / 2)[:, None, None, None])


def rectangle(width: float, height: float) -> Array:
    """(4, 2) corners of an image."""
    return np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])


def check_boxes(boxes: ArrayLike, name: str) -> Array:
    """(N, 4) finite xyxy boxes as float64. Raises ValueError that names the first bad row and its values."""
    array = np.asarray(boxes, dtype=np.float64)
    if array.size == 0:
        return np.zeros((0, 4))
    if array.ndim != 2 or array.shape[1] != 4:
        raise ValueError(
            f"{name} has shape {array.shape}: give (N, 4) boxes as left, top, right, bottom in pixels"
        )
    for row in np.flatnonzero(~np.isfinite(array).all(axis=1)):
        raise ValueError(
            f"{name} row {row} is {array[row].tolist()}: every edge must be a finite number; drop the row"
        )
    for row in np.flatnonzero((array[:, 2] < array[:, 0]) | (array[:, 3] < array[:, 1])):
        raise ValueError(
            f"{name} row {row} is {array[row].tolist()}: edges must stand as left, top, right, bottom; "
            "right must not be less than left, nor bottom less than top"
        )
    return array


def marks_from_boxes(boxes: Array, image_size: tuple[float, float] | None) -> Marks:
    """(N, 4) checked xyxy boxes px -> their marks in pixels."""
    centres = (boxes[:, :2] + boxes[:, 2:]) / 2
    spread = float(np.ptp(centres, axis=0).max()) if len(boxes) else 0.0
    # A box without extent says nothing of size; the floor keeps logarithms finite and the gates open.
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], max(1e-3 * spread, 1e-3))
    squares = sides**2
    length2 = squares.sum(axis=1) / (1 + BODY_WIDTH**2)
    cross = np.sqrt(np.maximum(squares.prod(axis=1) - (BODY_WIDTH * length2) ** 2, 0.0))
    shapes = np.zeros((len(boxes), 2, 2, 2))
    shapes[:, :, 0, 0] = squares[:, :1]
    shapes[:, :, 1, 1] = squares[:, 1:]
    for candidate, sign in enumerate((1.0, -1.0)):
        shapes[:, candidate, 0, 1] = shapes[:, candidate, 1, 0] = sign * cross
    window = None if image_size is None else rectangle(float(image_size[0]), float(image_size[1]))
    known = np.full(len(boxes), _longness(sides))
    return Marks(centres, shapes, np.full(len(boxes), DETECTION_PRICE), window, known)


def _longness(sides: Array) -> float:
    """(N, 2) box sides -> the chance that the bodies are long. Round ones make every box nearly square,
    long ones only where all of them happen to lie across.
    """
    if not len(sides) or (sides.min(axis=1) / sides.max(axis=1)).min() < NEARLY_SQUARE:
        return 1.0
    long = (1 - ROUND_BODIES) * LIES_ACROSS ** len(sides)
    return float(long / (long + ROUND_BODIES))
