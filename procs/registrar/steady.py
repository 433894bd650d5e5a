"""What a camera saw at an instant, without the detector's blinks: the frames around it are witnesses.

A detector misses an animal now and then, and sees one where there is none. In one frame of each view either
is enough to make two views disagree for no reason.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from procs.registrar.carry import Followed, Sighting

__all__ = ["steady"]

Array = NDArray[np.float64]

WITHIN_US = 450_000  # of the instant: two frames on either side at 5 Hz
LEAST_WITNESSES = 2  # with fewer other frames nobody can say that a box is a false alarm


def steady(sightings: Iterable[Sighting], at: Sighting, whole: NDArray[np.bool_]) -> Sighting:
    """`at` with the animals that it missed between two sights of them, and without boxes that it alone has.

    whole (N,): False for a box that the picture's edge cuts; nobody is followed by it, so it stays.
    """
    near = [one for one in sightings if one is not at and abs(one.utime - at.utime) <= WITHIN_US]
    followed_near = {id(animal) for one in near for animal in one.followed}
    kept = [
        row
        for row, animal in enumerate(at.followed)
        if not whole[row] or len(near) < LEAST_WITNESSES or id(animal) in followed_near
    ]
    boxes, ground = [at.boxes[row] for row in kept], [at.ground_m[row] for row in kept]
    followed = [at.followed[row] for row in kept]
    for animal, box, position in _blinks(near, at):
        boxes.append(box)
        ground.append(position)
        followed.append(animal)
    return Sighting(
        at.utime, np.array(boxes).reshape(-1, 4), np.array(ground).reshape(-1, 2), tuple(followed)
    )


def _blinks(near: list[Sighting], at: Sighting) -> list[tuple[Followed, Array, Array]]:
    """Animals seen before and after `at` but not in it, with box (4,) and ground position (2,) in between."""
    before = [one for one in near if one.utime < at.utime]
    after = [one for one in reversed(near) if one.utime > at.utime]
    seen = {id(animal) for animal in at.followed}
    early, late = _last_of(before), _last_of(after)  # those nearest to the instant
    blinks = []
    for key, (first, first_row) in early.items():
        if key in seen or key not in late:
            continue
        second, second_row = late[key]
        share = (at.utime - first.utime) / (second.utime - first.utime)
        box = first.boxes[first_row] + share * (second.boxes[second_row] - first.boxes[first_row])
        place = first.ground_m[first_row]
        place = place + share * (second.ground_m[second_row] - place)
        blinks.append((first.followed[first_row], box, place))
    return blinks


def _last_of(sightings: list[Sighting]) -> dict[int, tuple[Sighting, int]]:
    """Each followed animal's last (sighting, row) among `sightings`, by the object's id."""
    return {
        id(animal): (sighting, row) for sighting in sightings for row, animal in enumerate(sighting.followed)
    }
