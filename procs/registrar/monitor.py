"""MONITOR: which animal of the map is in each box, by the drone's own pose (docs/registration.md).

Each camera then stands over its own animal and sees few others, so that views can no longer be laid on
each other. The map can: a drone knows about where it is and which way it looks, and the boxes do the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from procs.registrar._chart import ViewGeometry, local_view, map_marks
from procs.registrar._marks import check_boxes
from procs.registrar.box_icp import HEADING_PRIOR_STD_RAD, Prior, align_marks
from procs.registrar.map import MapAnimal

__all__ = ["MapNames", "name_by_map"]

POSITION_STD_M = 2.5  # of GPS, attitude and what the animals swam since the map was made, together
FARTHEST_STDS = 3.0
SCALE_STD = 0.08  # of ln(height): barometers drift by metres


@dataclass(frozen=True)
class MapNames:
    """`identities` (N,) id of the animal in each box, -1 where the map has none there; `confidence` 0-1, the
    chance that all are right; `is_ambiguous` True where other names suit the boxes nearly as well."""

    identities: NDArray[np.intp]
    confidence: float
    is_ambiguous: bool


def name_by_map(
    boxes: ArrayLike,
    animals: Sequence[MapAnimal],
    view: ViewGeometry,
    *,
    image_size: tuple[int, int],
    position_std_m: float = POSITION_STD_M,
    heading_std_rad: float = HEADING_PRIOR_STD_RAD,
) -> MapNames:
    """Name one view's boxes (N, 4) px by the animals of the map, metres in the fleet's NED frame.

    `view` is where the drone believes its camera to be, in the same frame; `position_std_m` and
    `heading_std_rad` how far that may be off. Raises ValueError for a NaN or reversed box (naming the row)
    or a standard deviation that is not above 0.
    """
    if not (position_std_m > 0 and heading_std_rad > 0):
        raise ValueError(
            f"position_std_m is {position_std_m}, heading_std_rad {heading_std_rad}: both must be above 0"
        )
    checked = check_boxes(boxes, "boxes")
    identities = np.full(len(checked), -1, dtype=np.intp)
    if not len(checked) or not animals:
        return MapNames(identities, 0.0, False)
    here = np.array([view.n_m, view.e_m])
    marks, _ = local_view(checked, image_size, view)
    prior = Prior(
        (0.0, heading_std_rad), (0.0, SCALE_STD), position=(np.zeros(2), position_std_m), anchor=np.zeros(2)
    )
    target = map_marks(animals, here, view.yaw_rad)
    found = align_marks(marks, target, prior=prior)
    for row, column in found.matches:
        # Registration lays even a lone stranger on some animal; the pose says how far is too far.
        reach = FARTHEST_STDS * np.hypot(position_std_m, heading_std_rad * np.linalg.norm(marks.centres[row]))
        if np.linalg.norm(marks.centres[row] - target.centres[column]) <= reach:
            identities[row] = animals[column].id
    return MapNames(identities, found.confidence, found.is_ambiguous)
