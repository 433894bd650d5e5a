"""Is a pod in view, and where is its middle: the presence gate and the filtered barycentre (paper,
Scouting).
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Barycentre", "PresenceGate"]

Array = NDArray[np.float64]

PLACE_GAIN = 0.4  # of a new sight in an animal's place
SURE_SIGHTS = 3  # fewer may be a false alarm
GONE_MISSES = 8  # frames in which an animal was not where it should be seen: it dived or swam off
FORGET_S = 20.0  # an animal out of the picture for longer may be anywhere


class PresenceGate:
    """Present when at least `share` of the last `frames` frames had detections; hysteresis on both edges.

    It opens only on a full buffer at `share` and closes only when the share falls below `share` -
    `hysteresis`.
    """

    def __init__(self, frames: int, share: float, hysteresis: float = 0.3) -> None:
        if frames < 1 or not 0 < share <= 1:
            raise ValueError(f"frames {frames} must be at least 1 and share {share} in (0, 1]")
        self.threshold = share
        self.lower = max(share - hysteresis, 0.0)
        self.present = False
        self._seen: deque[bool] = deque(maxlen=frames)

    @property
    def share(self) -> float:
        """Share of the whole buffer that had detections; frames not yet taken count as empty."""
        return sum(self._seen) / (self._seen.maxlen or 1)

    def update(self, seen: bool) -> bool:
        """Take one frame (`seen`: it had boxes) and say whether animals are present."""
        self._seen.append(seen)
        # A billionth guards 0.8 x 15 = 12 frames against rounding.
        threshold = self.lower if self.present else self.threshold
        self.present = self.share >= threshold - 1e-9 and self.share > 0
        return self.present

    def reset(self) -> None:
        self._seen.clear()
        self.present = False


@dataclass
class _Place:
    """Where one animal was seen."""

    ne: Array
    seen_us: int
    sights: int = 1
    misses: int = 0  # frames running in which it should have been seen and was not


class Barycentre:
    """Low-pass filter of a pod's middle on the ground and of its radius, over all animals seen of late.

    An animal that has slipped out of the picture still counts: were the middle that of the boxes in view
    alone, the camera would follow a part of the pod and lose the rest.
    """

    def __init__(self, reach_m: float = 6.0, gain: float = 0.2) -> None:
        self.reach_m = reach_m  # a sight so near to a place is of the same animal
        self.gain = gain
        self.centre_ne: Array | None = None
        self.radius_m = 0.0
        self._places: list[_Place] = []

    def update(
        self, utime: int, points_ne: Array, view_ne: Array | None = None, margin_m: float = 0.0
    ) -> None:
        """Take one frame's animals, (N, 2) on the ground, at `utime` us.

        view_ne: (4, 2) corners of the ground that the frame shows well, in order; None where that is not
        known. `margin_m` (half a body) is added to the radius.
        """
        self._remember(utime, points_ne, view_ne)
        sure = [place for place in self._places if place.sights >= SURE_SIGHTS] or self._places
        if not sure:
            return
        places = np.array([place.ne for place in sure])
        middle = places.mean(axis=0)
        is_first = self.centre_ne is None
        centre = middle if self.centre_ne is None else self.centre_ne + self.gain * (middle - self.centre_ne)
        reach_m = float(np.linalg.norm(places - centre, axis=1).max()) + margin_m
        # A growth counts sooner than a shrinking: an animal that dives is still of the pod.
        gain = 1.0 if is_first else 0.3 if reach_m > self.radius_m else 0.05
        self.centre_ne = centre
        self.radius_m += gain * (reach_m - self.radius_m)

    def start_at(self, centre_ne: Array, radius_m: float) -> None:
        """Take the middle and the radius of a drone that sees the pod better."""
        self.centre_ne = np.asarray(centre_ne, dtype=np.float64)
        self.radius_m = radius_m

    def reset(self) -> None:
        self.centre_ne = None
        self.radius_m = 0.0
        self._places = []

    def _remember(self, utime: int, points_ne: Array, view_ne: Array | None) -> None:
        """Put a frame's animals to the places that they were seen at before."""
        pairs = _nearest_pairs(points_ne, [place.ne for place in self._places], self.reach_m)
        for index, place in enumerate(self._places):
            if index in pairs:
                place.ne = place.ne + PLACE_GAIN * (points_ne[pairs[index]] - place.ne)
                place.seen_us, place.sights, place.misses = utime, place.sights + 1, 0
            elif view_ne is not None and len(view_ne) == 4 and _is_inside(place.ne, view_ne):
                place.misses += 1
        self._places = [
            place
            for place in self._places
            if place.misses < min(place.sights, GONE_MISSES) + 1
            and (utime - place.seen_us) * 1e-6 <= FORGET_S
        ]
        taken = list(pairs.values())
        self._places += [
            _Place(np.array(point, dtype=np.float64), utime)
            for row, point in enumerate(points_ne)
            if row not in taken
        ]


def _nearest_pairs(points: Array, places: list[Array], reach_m: float) -> dict[int, int]:
    """Index of a place -> row of the point that lies there; the nearest pairs first, each used once."""
    if not len(points) or not places:
        return {}
    distance = np.linalg.norm(np.array(places)[:, None] - points[None], axis=2)
    pairs: dict[int, int] = {}
    for flat in np.argsort(distance, axis=None, kind="stable"):
        place, point = divmod(int(flat), len(points))
        if distance[place, point] > reach_m:
            break
        if place not in pairs and point not in pairs.values():
            pairs[place] = point
    return pairs


def _is_inside(point: Array, corners: Array) -> bool:
    """Whether a point lies in the convex polygon of `corners` (K, 2), in order."""
    edge, to_point = np.roll(corners, -1, axis=0) - corners, point - corners
    side = edge[:, 0] * to_point[:, 1] - edge[:, 1] * to_point[:, 0]
    return bool((side >= 0).all() or (side <= 0).all())
