"""One row of the fleet table on the wire: 15 bytes, 22 with a marker (docs/relay.md, Fleet state).

    bits       1 byte    mission state (5 bits), found, on station, wants an episode
    bits       1 byte    battery (6 bits, 0-63), its ring is a line, coarse
    animal     1 byte    255 none
    position   6 bytes   north, east, down: int16 decimetres, or metres where `coarse` (beyond 3276 m)
    velocity   3 bytes   int8 of 0.2 m/s, held at +-25.4
    age        1 byte    of the position, steps of 50 ms rounded up, 255 for more
    counter    2 bytes   of the row (15 bits), and whether a marker follows
    marker     7 bytes   the find north and east (as position), its radius (half metres), the scout's last
                         waypoint (int16)

The place of a row in the roster is said by the table's bitmap, so a row needs no id.
"""

import math
import struct
from dataclasses import dataclass

from procs.relay.members import age_byte

__all__ = [
    "COUNTER_RANGE",
    "NO_MARKER",
    "Marker",
    "Row",
    "RowError",
    "pack_row",
    "position_unit_m",
    "unpack_row",
    "with_age",
]

ROW = struct.Struct(">BBBhhhbbbBH")
MARKER = struct.Struct(">hhBh")
AGE_AT = 12  # place of the age in a row
COUNTER_RANGE = 1 << 15
HAS_MARKER = 1 << 15
FINE_M, COARSE_M = 0.1, 1.0
INT16 = 32767
VELOCITY_M_S = 0.2
RADIUS_M = 0.5
NO_ANIMAL = 255


class RowError(ValueError):
    """Bytes that are no row of a fleet table, or a state that a row cannot hold."""


@dataclass(frozen=True)
class Marker:
    """What few rows have to say: where a pod was found and which waypoint the scout reached."""

    found_n_m: float = 0.0
    found_e_m: float = 0.0
    pod_radius_m: float = 0.0
    waypoint: int = 0


NO_MARKER = Marker()


@dataclass(frozen=True)
class Row:
    """One drone, as the table carries it; positions in m of the fleet's frame, velocities in m/s."""

    counter: int
    state: int
    animal: int  # -1 none
    battery: float  # 0-1
    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]
    found: bool = False
    on_station: bool = False
    wants_episode: bool = False
    is_line: bool = False  # a link of this drone to a living neighbour is silent
    marker: Marker | None = None


def position_unit_m(row: Row) -> float:
    """The unit in which the row's positions travel: 0.1 m, or 1 m where one of them is too far for that."""
    marker = row.marker or NO_MARKER
    farthest_m = max(abs(value) for value in (*row.position_m, marker.found_n_m, marker.found_e_m))
    return FINE_M if farthest_m <= INT16 * FINE_M else COARSE_M


def pack_row(row: Row, age_us: int) -> bytes:
    """15 or 22 bytes. Values beyond their range are held at its ends; RowError for a state or animal that
    does not fit."""
    if not 0 <= row.state < 32 or not -1 <= row.animal < NO_ANIMAL:
        raise RowError(
            f"state {row.state} (0-31) or animal {row.animal} (-1-254) does not fit a row of the fleet table"
        )
    unit_m = position_unit_m(row)
    flags = row.state << 3 | row.found << 2 | row.on_station << 1 | row.wants_episode
    health = _held(row.battery * 63, 0, 63) << 2 | row.is_line << 1 | (unit_m == COARSE_M)
    wire = ROW.pack(
        flags,
        health,
        NO_ANIMAL if row.animal < 0 else row.animal,
        *(_held(value / unit_m, -INT16, INT16) for value in row.position_m),
        *(_held(value / VELOCITY_M_S, -127, 127) for value in row.velocity_m_s),
        age_byte(age_us),
        row.counter % COUNTER_RANGE | (HAS_MARKER if row.marker else 0),
    )
    if row.marker is None:
        return wire
    return wire + MARKER.pack(
        _held(row.marker.found_n_m / unit_m, -INT16, INT16),
        _held(row.marker.found_e_m / unit_m, -INT16, INT16),
        _held(row.marker.pod_radius_m / RADIUS_M, 0, 255),
        _held(row.marker.waypoint, -INT16, INT16),
    )


def unpack_row(data: bytes) -> tuple[Row, int, int]:
    """(row, its age byte, bytes used) of the row that `data` begins with. Raises RowError where it is cut
    short."""
    if len(data) < ROW.size:
        raise RowError(f"a row of {len(data)} bytes: it needs {ROW.size}")
    flags, health, animal, n, e, d, vn, ve, vd, age, counter = ROW.unpack_from(data)
    unit_m = COARSE_M if health & 1 else FINE_M
    marker, used = None, ROW.size
    if counter & HAS_MARKER:
        used += MARKER.size
        if len(data) < used:
            raise RowError(f"a row of {len(data)} bytes: with its marker it needs {used}")
        found_n, found_e, radius, waypoint = MARKER.unpack_from(data, ROW.size)
        marker = Marker(found_n * unit_m, found_e * unit_m, radius * RADIUS_M, waypoint)
    row = Row(
        counter=counter % COUNTER_RANGE,
        state=flags >> 3,
        animal=-1 if animal == NO_ANIMAL else animal,
        battery=(health >> 2) / 63,
        position_m=(n * unit_m, e * unit_m, d * unit_m),
        velocity_m_s=(vn * VELOCITY_M_S, ve * VELOCITY_M_S, vd * VELOCITY_M_S),
        found=bool(flags & 4),
        on_station=bool(flags & 2),
        wants_episode=bool(flags & 1),
        is_line=bool(health & 2),
        marker=marker,
    )
    return row, age, used


def with_age(wire: bytes, age_us: int) -> bytes:
    """A row's bytes with another age: how a row is passed on, otherwise untouched."""
    return wire[:AGE_AT] + bytes([age_byte(age_us)]) + wire[AGE_AT + 1 :]


def _held(value: float, low: int, high: int) -> int:
    """Rounded and held in its range; a value that is no number becomes 0."""
    return (
        max(low, min(high, round(value)))
        if math.isfinite(value)
        else (high if value > 0 else low if value < 0 else 0)
    )
