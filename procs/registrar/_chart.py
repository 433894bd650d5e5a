"""Between one drone's view and the map: a view's boxes in metres, the map's animals as marks, and what a
sight adds to them.

Chart coordinates are metres (north, east) from the map's origin; local ones are metres (north, east) from
the point under the drone, as the drone believes its own height, heading and tilt to be.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose
from procs.registrar._marks import DETECTION_PRICE, Marks, ellipse_shapes, marks_from_boxes
from procs.registrar._pair import apply_homographies, wrap_angle
from procs.registrar.map import COUNTER_LIMIT, MAX_SIZE_M, REACH_M, AxisState, MapAnimal

__all__ = ["ViewGeometry", "fits_map", "local_view", "map_marks", "merge_sight", "new_animal", "shifted"]

Array = NDArray[np.float64]

NOMINAL_EXTENT_M = 100.0  # what a picture without geometry is taken to be across
UNCONFIRMED_PRICE = 0.5  # nats: a remembered animal may have dived, one that only one view saw may be false
AXIS_TELLS_RAD = 0.35  # doubled angle by which the better of two mirror images must win to settle the axis
GRAZING = 0.2  # least cosine between a corner's ray and the vertical for which tilt is used


@dataclass(frozen=True)
class ViewGeometry:
    """What a drone believes of its camera at the instant of an episode: height above the surface and focal
    length, yaw of the image's top clockwise from north, position in the fleet's NED frame, tilt as roll and
    pitch."""

    height_m: float
    yaw_rad: float
    n_m: float
    e_m: float
    focal_px: float
    roll_rad: float = 0.0
    pitch_rad: float = 0.0

    def __post_init__(self) -> None:
        for name in ("height_m", "focal_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}: must be above 0 for a view of the ground")


def local_view(
    boxes: Array, image_size: tuple[int, int] | None, view: ViewGeometry | None
) -> tuple[Marks, Array]:
    """(N, 4) boxes px -> their marks in local metres, and the homography (3, 3) of pixels into local
    metres.
    """
    marks = marks_from_boxes(boxes, image_size)
    if view is None:
        homography = _nominal(boxes, image_size)
    else:
        width, height = image_size if image_size is not None else _extent(boxes)
        homography = _ground(view, width, height)
    return marks.through(homography), homography


def _extent(boxes: Array) -> tuple[float, float]:
    high = boxes.max(axis=0) if len(boxes) else np.ones(4)
    return max(float(high[2]), 1.0), max(float(high[3]), 1.0)


def _nominal(boxes: Array, image_size: tuple[int, int] | None) -> Array:
    width, height = image_size if image_size is not None else _extent(boxes)
    scale = NOMINAL_EXTENT_M / max(width, height)
    return np.array([[0.0, -scale, scale * height / 2], [scale, 0.0, -scale * width / 2], [0.0, 0.0, 1.0]])


def _ground(view: ViewGeometry, width: float, height: float) -> Array:
    camera = Pinhole((int(width), int(height)), 2 * float(np.arctan2(height / 2, view.focal_px)))
    pose = Pose(0.0, 0.0, -view.height_m, view.roll_rad, view.pitch_rad, view.yaw_rad)
    homography = camera.image_to_ground(pose)
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1.0]])
    depth = corners @ homography[2]
    middle = float(np.array([width / 2, height / 2, 1.0]) @ homography[2])
    if (depth / middle < GRAZING).any():
        # The horizon is in the picture, or nearly: take the camera to look straight down and leave the tilt
        # to the fit.
        homography = camera.image_to_ground(replace(pose, roll_rad=0.0, pitch_rad=0.0))
    return np.asarray(homography / homography[2, 2])


def map_marks(animals: Sequence[MapAnimal], origin: Array, yaw_rad: float) -> Marks:
    """The map's animals as marks in chart coordinates; `yaw_rad` is the first view's, about which unsettled
    axes mirror.
    """
    centres = np.array([[one.n_m, one.e_m] for one in animals]).reshape(-1, 2) - origin
    axes = np.array([[one.axis_rad, one.axis_rad] for one in animals]).reshape(-1, 2)
    for row, one in enumerate(animals):
        if one.axis_state == AxisState.MIRRORED:
            axes[row, 1] = 2 * yaw_rad - one.axis_rad
    sizes = np.maximum([one.size_m for one in animals], 0.01)
    confirmed = [one.hits >= 2 or (one.hits == 1 and not one.misses) for one in animals]
    return Marks(
        centres,
        ellipse_shapes(np.asarray(sizes), axes),
        np.where(confirmed, DETECTION_PRICE, UNCONFIRMED_PRICE),
        None,
        np.array([float(one.axis_state != AxisState.UNKNOWN) for one in animals]),
    )


def fits_map(centre: Array, size_m: float) -> bool:
    """Whether an animal at chart coordinates (2,) can be said in a packet."""
    return bool(np.abs(centre).max() < REACH_M - 1 and 0 < size_m < MAX_SIZE_M)


def _candidate_axes(marks: Marks, row: int) -> Array:
    shapes = marks.shapes[row]
    return np.asarray(np.arctan2(2 * shapes[:, 0, 1], shapes[:, 0, 0] - shapes[:, 1, 1]) / 2 % np.pi)


def new_animal(marks: Marks, row: int, origin: Array, number: int, is_first_view: bool) -> MapAnimal:
    """The animal that a mark in chart coordinates adds to the map. Only the first view's mirror is known to
    everybody.
    """
    centre = marks.centres[row] + origin
    state = AxisState.MIRRORED if is_first_view else AxisState.UNKNOWN
    axis = float(_candidate_axes(marks, row)[0])
    return MapAnimal(float(centre[0]), float(centre[1]), float(marks.sizes[row]), axis, 1, 0, number, state)


def merge_sight(animal: MapAnimal, marks: Marks, row: int, origin: Array, yaw_rad: float) -> MapAnimal:
    """The animal after one more view of it: a running mean, and the axis settled where two headings tell
    the mirror.
    """
    share = 1.0 / (animal.hits + 1)
    centre = marks.centres[row] + origin
    axis, state = _settled_axis(animal, _candidate_axes(marks, row), yaw_rad)
    return replace(
        animal,
        n_m=animal.n_m + share * (float(centre[0]) - animal.n_m),
        e_m=animal.e_m + share * (float(centre[1]) - animal.e_m),
        size_m=min(animal.size_m + share * (float(marks.sizes[row]) - animal.size_m), MAX_SIZE_M),
        axis_rad=axis,
        axis_state=state,
        hits=min(animal.hits + 1, COUNTER_LIMIT),
    )


def _settled_axis(animal: MapAnimal, seen: Array, yaw_rad: float) -> tuple[float, int]:
    """The map's axis and this view's two candidates -> the better axis and how well it is known now."""
    if animal.axis_state == AxisState.UNKNOWN:
        return animal.axis_rad, AxisState.UNKNOWN
    known = np.array([animal.axis_rad])
    if animal.axis_state == AxisState.MIRRORED:
        known = np.array([animal.axis_rad, 2 * yaw_rad - animal.axis_rad])
    apart = wrap_angle(2 * (seen[None, :] - known[:, None]))  # doubled angles: an axis has no front
    best = np.unravel_index(np.abs(apart).argmin(), apart.shape)
    blended = float((known[best[0]] + apart[best] / 2 / (animal.hits + 1)) % np.pi)
    if animal.axis_state == AxisState.KNOWN:
        return blended, AxisState.KNOWN
    per_mirror = np.abs(apart).min(axis=1)
    if abs(per_mirror[0] - per_mirror[1]) > AXIS_TELLS_RAD:
        return blended, AxisState.KNOWN
    return animal.axis_rad, AxisState.MIRRORED


def shifted(n_m: float, e_m: float) -> Array:
    """(3, 3) homography that adds (n_m, e_m)."""
    return np.array([[1.0, 0.0, n_m], [0.0, 1.0, e_m], [0.0, 0.0, 1.0]])


def mapped_point(homography: Array, point: Array) -> Array:
    """(2,) point through a (3, 3) homography."""
    return np.asarray(apply_homographies(homography[None], point[None])[0][0, 0])
