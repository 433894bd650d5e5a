"""From the episode's instant to now: the same animal's box from frame to frame, on the ground.

Boxes are followed as points in the drone's own NED frame, so that its own motion drops out. An id given to a
box of an earlier frame (docs/registration.md) is then the id of that animal's box in the newest
frame.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

__all__ = ["BoxCarrier", "Sighting"]

Array = NDArray[np.float64]

KEEP_US = 8_000_000  # frames remembered, and how long an unseen animal is
# How far an animal may be from where it is expected, once the shift that all boxes share is out: a share of
# its length, and more the longer it was unseen. Tight, since a pod's animals lie about a length apart.
GATE_LENGTHS = 0.25
GATE_SPEED_M_S = 0.7
MAX_GATE_LENGTHS = 0.6
# A box that suits an animal that has none now nearly as well is neither's: when two come apart again, the
# first box to be seen lies between where they were.
AMBIGUOUS_LENGTHS, AMBIGUOUS_RATIO, NOISE_LENGTHS = 0.25, 2.0, 0.1
MAX_SHIFT_LENGTHS = 0.8  # shared by all boxes: an error of attitude, height or position
SHIFT_PRICE = 0.5  # of one matched animal, for the largest shift
VELOCITY_GAIN = 0.15
# Two animals that touch come as one box about twice as long, whose middle is neither's place. A size is
# learnt slowly, since an animal half under water is as long as ever; but a first box may have been such a
# one.
MERGED_SIZES = 1.4
SIZE_GAIN_UP, SIZE_GAIN_DOWN = 0.05, 0.03
FIRST_SIGHTS, FIRST_GAIN_DOWN = 10, 0.2
MAX_SPEED_M_S = 4.0


@dataclass
class Followed:
    """One animal that this camera follows."""

    position_m: Array  # (2,) n, e in the drone's own frame
    utime: int
    velocity_m_s: Array = field(default_factory=lambda: np.zeros(2))
    size_m: float = np.inf  # diagonal of its box on the ground
    n_sights: int = 0
    animal: int = -1
    candidate: int = -1  # an id that the map offers, and for how many sights running
    n_offers: int = 0

    def offered(self, animal_id: int) -> int:
        """The map offers an id (-1: none) -> for how many sights running it has been the same."""
        self.n_offers = self.n_offers + 1 if animal_id == self.candidate else 1
        self.candidate = animal_id
        return self.n_offers

    def predict(self, utime: int) -> Array:
        """(2,) where it should be at `utime`."""
        return self.position_m + self.velocity_m_s * (utime - self.utime) / 1e6


@dataclass(frozen=True)
class Sighting:
    """One detected frame: boxes (N, 4) px, ground positions (N, 2) m, and who each box is (index of a
    followed animal).
    """

    utime: int
    boxes: Array
    ground_m: Array
    followed: tuple[Followed, ...]

    @property
    def ids(self) -> list[int]:
        """The animal id of each box, -1 where none is known."""
        return [animal.animal for animal in self.followed]


class BoxCarrier:
    """Associates detections frame to frame and carries ids along."""

    def __init__(self, animal_length_m: float) -> None:
        self._length_m = animal_length_m
        self._followed: list[Followed] = []
        self.sightings: deque[Sighting] = deque()

    def update(
        self,
        utime: int,
        boxes: Array,
        ground_m: Array,
        whole: NDArray[np.bool_] | None = None,
        sizes_m: Array | None = None,
    ) -> Sighting:
        """Add one detected frame: boxes (N, 4) px and their centres on the ground (N, 2) m, own NED frame.

        whole (N,): False for a box that the picture's edge cuts: its centre is not the animal's, so nobody is
        followed by it. sizes_m (N,): diagonals on the ground; a box much larger than an animal's is not taken
        for that animal.
        """
        sizes = np.full(len(boxes), np.inf) if sizes_m is None else sizes_m
        self._followed = [animal for animal in self._followed if utime - animal.utime <= KEEP_US]
        rows = np.flatnonzero(whole) if whole is not None else np.arange(len(boxes))
        matches = {
            int(rows[k]): animal for k, animal in self._associate(utime, ground_m[rows], sizes[rows]).items()
        }
        is_whole = set(rows.tolist())
        seen: list[Followed] = []
        for row, position in enumerate(ground_m):
            animal = matches.get(row)
            if animal is None:
                animal = Followed(position.copy(), utime, size_m=float(sizes[row]))
                if row in is_whole:
                    self._followed.append(animal)
            else:
                _move(animal, position, utime)
                _grow(animal, float(sizes[row]))
            seen.append(animal)
        sighting = Sighting(utime, boxes, ground_m, tuple(seen))
        self.sightings.append(sighting)
        while self.sightings[0].utime < utime - KEEP_US:
            self.sightings.popleft()
        return sighting

    def nearest(self, utime: int, within_us: int) -> Sighting | None:
        """The sighting nearest to `utime`, None where none lies within `within_us`."""
        if not self.sightings:
            return None
        best = min(self.sightings, key=lambda sighting: abs(sighting.utime - utime))
        return best if abs(best.utime - utime) <= within_us else None

    def name(self, sighting: Sighting, ids: list[int]) -> None:
        """Give the boxes of an earlier sighting their ids in place of all that was believed; -1 is none."""
        for animal in self._followed:
            animal.animal = -1
        for animal, animal_id in zip(sighting.followed, ids, strict=True):
            animal.animal = animal_id

    def name_one(self, animal: Followed, animal_id: int) -> None:
        """Give one followed animal an id; another that held it loses it."""
        for other in self._followed:
            if other.animal == animal_id:
                other.animal = -1
        animal.animal = animal_id

    def held_ids(self, utime: int, within_us: int) -> list[int]:
        """Ids of animals seen within `within_us` of `utime`."""
        return sorted(a.animal for a in self._followed if a.animal >= 0 and utime - a.utime <= within_us)

    def _associate(self, utime: int, ground_m: Array, sizes_m: Array) -> dict[int, Followed]:
        """Row of `ground_m` -> the followed animal that it is."""
        if not len(ground_m) or not self._followed:
            return {}
        predicted = np.array([animal.predict(utime) for animal in self._followed])
        unseen_s = np.array([(utime - animal.utime) / 1e6 for animal in self._followed])
        gate = np.minimum(
            GATE_LENGTHS * self._length_m + GATE_SPEED_M_S * unseen_s, MAX_GATE_LENGTHS * self._length_m
        )
        fits = sizes_m[:, None] <= MERGED_SIZES * np.array([animal.size_m for animal in self._followed])
        shift = _shared_shift(ground_m, predicted, gate, fits, MAX_SHIFT_LENGTHS * self._length_m)
        distance = np.linalg.norm((ground_m - shift)[:, None] - predicted[None], axis=2)
        distance[~fits] = np.inf
        named = np.array([animal.animal >= 0 for animal in self._followed])
        rows, columns = _match(distance, gate, named, self._length_m)
        return {int(row): self._followed[column] for row, column in zip(rows, columns, strict=True)}


def _shared_shift(
    points: Array, predicted: Array, gate: Array, fits: NDArray[np.bool_], limit_m: float
) -> Array:
    """(2,) m: the shift of all points together under which most of them meet a prediction; none where it
    gains nothing. fits (points, predictions): which pairs may be one animal.

    An error of the drone's attitude or position moves all boxes alike, at times by more than half the
    distance between animals. Each pair (point, prediction) proposes one shift; a large one must earn its
    price in matches.
    """
    proposals = (points[:, None] - predicted[None])[fits]
    proposals = np.vstack([np.zeros(2), proposals[np.linalg.norm(proposals, axis=1) <= limit_m]])
    moved = points[None] - proposals[:, None]  # (shifts, points, 2)
    distance = np.linalg.norm(
        moved[:, :, None] - predicted[None, None], axis=3
    )  # (shifts, points, predictions)
    closeness = np.clip(1 - (distance / gate) ** 2, 0, None) * fits
    price = SHIFT_PRICE * (np.linalg.norm(proposals, axis=1) / limit_m) ** 2
    # The best match of a point and of a prediction, whichever says less: cheap, and no point counts for two.
    score = np.minimum(closeness.max(axis=2).sum(axis=1), closeness.max(axis=1).sum(axis=1)) - price
    return np.asarray(proposals[int(np.argmax(score))])


def _match(
    distance: Array, gate: Array, named: NDArray[np.bool_], length_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs (row, column) of least total distance (N, K) m, each within its column's gate (K,) m. A row gets
    no named column (K,) where another one without a row would suit it about as well.
    """
    while True:
        rows, columns = linear_sum_assignment(np.minimum(distance, gate[None] * 2))
        near = distance[rows, columns] <= gate[columns]
        rows, columns = rows[near], columns[near]
        waiting = distance.copy()
        waiting[:, columns] = np.inf
        waiting[:, ~named] = np.inf
        second, first = waiting[rows].min(axis=1, initial=np.inf), distance[rows, columns]
        is_near = second <= first + AMBIGUOUS_LENGTHS * length_m
        is_like = second <= AMBIGUOUS_RATIO * first + NOISE_LENGTHS * length_m
        refused = named[columns] & is_near & is_like
        if not refused.any():
            return rows, columns
        distance = distance.copy()
        distance[np.ix_(rows[refused], np.flatnonzero(named))] = np.inf


def _grow(animal: Followed, size_m: float) -> None:
    animal.n_sights += 1
    if not np.isfinite(animal.size_m):
        animal.size_m = size_m
    elif np.isfinite(size_m):
        gain_down = FIRST_GAIN_DOWN if animal.n_sights < FIRST_SIGHTS else SIZE_GAIN_DOWN
        gain = SIZE_GAIN_UP if size_m > animal.size_m else gain_down
        animal.size_m += gain * (size_m - animal.size_m)


def _move(animal: Followed, position: Array, utime: int) -> None:
    dt_s = (utime - animal.utime) / 1e6
    if dt_s > 0:
        seen = (position - animal.position_m) / dt_s
        speed = float(np.linalg.norm(seen))
        if speed > MAX_SPEED_M_S:
            seen = seen * MAX_SPEED_M_S / speed
        animal.velocity_m_s = animal.velocity_m_s + VELOCITY_GAIN * min(dt_s / 0.2, 1.0) * (
            seen - animal.velocity_m_s
        )
    animal.position_m = position.copy()
    animal.utime = utime
