"""The fleet's map between episodes: where each agreed animal was last seen, by anybody.

Each drone says all that it knows, 6 bytes an animal, again and again; the newest sight of an animal wins.
Positions are in the map's frame; `Correction` carries a point from a drone's own frame into it.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pose
from procs.registrar.map import AxisState, MapAnimal

__all__ = ["Correction", "MapBook", "MapEntry", "UpkeepError"]

Array = NDArray[np.float64]

HEADER = struct.Struct(">BB")  # format, number of rows
ROW = struct.Struct(
    ">BhhB"
)  # animal, n and e in decimetres, age in 0.2 s with the top bit for "I saw it myself"
FORMAT = 0x55
AGE_UNIT_US = 200_000
OLDEST = 127
SAW_IT = 0x80
MAX_ANIMALS = 20
OWN_FRESH_US = 1_500_000


class UpkeepError(ValueError):
    """A packet that is no upkeep packet."""


@dataclass(frozen=True)
class Correction:
    """Own frame to map frame: what to add to this drone's own position and heading."""

    n_m: float = 0.0
    e_m: float = 0.0
    yaw_rad: float = 0.0

    def pose(self, own: Pose) -> Pose:
        """The drone's pose in the map's frame."""
        return Pose(
            own.n_m + self.n_m,
            own.e_m + self.e_m,
            own.d_m,
            own.roll_rad,
            own.pitch_rad,
            own.yaw_rad + self.yaw_rad,
        )

    def to_own(self, point: Array, own: Pose) -> Array:
        """(2,) map frame -> this drone's own frame, turned about the drone."""
        return _turn(point - (own.n_m + self.n_m, own.e_m + self.e_m), -self.yaw_rad) + (own.n_m, own.e_m)

    def to_map(self, point: Array, own: Pose) -> Array:
        """(2,) own frame -> map frame."""
        return _turn(point - (own.n_m, own.e_m), self.yaw_rad) + (own.n_m + self.n_m, own.e_m + self.e_m)


@dataclass
class MapEntry:
    """One animal: map frame metres, fleet time of the newest sight, and whether it was ours."""

    animal: int
    position_m: Array
    seen_fleet_utime: int
    mine: bool
    size_m: float = 0.0
    axis_rad: float = 0.0
    hits: int = 0
    misses: int = 0
    theirs_m: Array | None = None  # the newest sight by another drone
    theirs_fleet_utime: int = 0

    def unturned(self) -> MapAnimal:
        """As an animal of the map without an axis: it turned since the episode, nobody knows how."""
        n_m, e_m = (float(x) for x in self.position_m)
        return MapAnimal(n_m, e_m, self.size_m, 0.0, self.hits, 0, self.animal, AxisState.UNKNOWN)


class MapBook:
    """All agreed animals as one drone holds them."""

    def __init__(self) -> None:
        self.entries: dict[int, MapEntry] = {}

    def replace(self, entries: list[MapEntry]) -> None:
        """A finished episode's map takes the place of what was held."""
        self.entries = {entry.animal: entry for entry in sorted(entries, key=lambda entry: entry.animal)}

    def saw(self, animal: int, position_m: Array, fleet_utime: int) -> float:
        """Our own sight of an animal -> its distance from the newest sight by another drone, 0 where there is
        no fresh one.
        """
        entry = self.entries.get(animal)
        if entry is None:
            return 0.0
        entry.position_m, entry.seen_fleet_utime, entry.mine = position_m, fleet_utime, True
        if entry.theirs_m is None or fleet_utime - entry.theirs_fleet_utime > OWN_FRESH_US:
            return 0.0
        return float(np.linalg.norm(position_m - entry.theirs_m))

    def encode(self, fleet_utime: int) -> bytes:
        """What to say to the neighbours now."""
        rows = []
        for entry in list(self.entries.values())[:MAX_ANIMALS]:
            # Rounded up: rounded to the nearest, an animal that nobody sees would grow younger as it goes
            # round.
            age = -(-max(fleet_utime - entry.seen_fleet_utime, 0) // AGE_UNIT_US)
            if age < OLDEST:
                age |= SAW_IT if entry.mine else 0
                n_dm, e_dm = (int(np.clip(round(float(x) * 10), -32767, 32767)) for x in entry.position_m)
                rows.append(ROW.pack(entry.animal, n_dm, e_dm, age))
        return HEADER.pack(FORMAT, len(rows)) + b"".join(rows)

    def merge(self, packet: bytes, fleet_utime: int) -> None:
        """Take a neighbour's newer sights. Raises UpkeepError for a packet of another form."""
        if (
            len(packet) < HEADER.size
            or packet[0] != FORMAT
            or len(packet) != HEADER.size + packet[1] * ROW.size
        ):
            raise UpkeepError(f"a packet of {len(packet)} bytes is no upkeep packet")
        for row in range(packet[1]):
            animal, n_dm, e_dm, age = ROW.unpack_from(packet, HEADER.size + row * ROW.size)
            entry = self.entries.get(animal)
            if entry is None:
                continue
            seen = fleet_utime - (age & ~SAW_IT) * AGE_UNIT_US
            position = np.array([n_dm, e_dm]) / 10
            if age & SAW_IT and (entry.theirs_m is None or seen >= entry.theirs_fleet_utime):
                entry.theirs_m, entry.theirs_fleet_utime = position, seen
            # Our own sight comes back to us from the neighbours, a little older: only a clearly newer one
            # counts.
            if seen > entry.seen_fleet_utime + AGE_UNIT_US:
                entry.position_m, entry.seen_fleet_utime, entry.mine = position, seen, False


def _turn(point: Array, angle_rad: float) -> Array:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]])
