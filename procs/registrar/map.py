"""The fleet's map of animals: what travels the ring in 9 bytes an animal, and what is remembered between
episodes.

A packet is a header of 16 bytes and 9 bytes an animal (paper, Communication Bandwidth; docs/registration.md),
big endian:

    header  version B, episode H, proposer B, lap B, rank B, flags B, confidence B (in 255ths), origin north
            and east h (m of the fleet's frame), yaw of the first view B (256ths of a turn), animals B,
            checksum H
    animal  north and east h (cm from the origin), axis state 2 bits and size 14 bits (cm), axis B (256ths
            of half a turn), hits and misses 4 bits each, id B (255: none)
"""

import binascii
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "ANIMAL_BYTES",
    "HEADER_BYTES",
    "NO_ID",
    "REUSE_AFTER_S",
    "AxisState",
    "MapAnimal",
    "MapHeader",
    "Memory",
    "PacketError",
    "decode_map",
    "encode_map",
]

VERSION = 1
HEADER = struct.Struct(">BHBBBBBhhBBH")
ANIMAL = struct.Struct(">hhHBBB")
HEADER_BYTES, ANIMAL_BYTES = HEADER.size, ANIMAL.size
NO_ID = 255
MAX_ANIMALS = 32  # 304 bytes: beyond the paper's 20, and still within its 308
REACH_M = 327.0  # int16 centimetres
MAX_SIZE_M = 163.83  # 14 bits of centimetres
COUNTER_LIMIT = 15
REUSE_AFTER_S = 600.0  # an id is given to another animal only after this long unseen (docs/registration.md)


class PacketError(ValueError):
    """A packet that is no map: wrong length, version, checksum or value."""


class AxisState:
    """How well an animal's axis is known: by two headings, by one (up to a mirror), or not at all."""

    KNOWN, MIRRORED, UNKNOWN = 0, 1, 2


@dataclass(frozen=True)
class MapAnimal:
    """One animal in the map's frame: metres north and east in the fleet's frame (view pixels where no view
    geometry was given).

    `size_m` sqrt(a^2 + b^2) of its box on the ground; `axis_rad` heading of its axis, clockwise from north,
    in [0, pi); `hits` views that saw it, `misses` views that should have and did not, 0-15; `id` 0-254, or
    NO_ID.
    """

    n_m: float
    e_m: float
    size_m: float
    axis_rad: float
    hits: int
    misses: int
    id: int
    axis_state: int = AxisState.KNOWN


@dataclass(frozen=True)
class MapHeader:
    """Whose turn made this map and what the ring knows so far; `confidence` 0-1 is the least of the edges
    of this lap.
    """

    episode: int
    proposer: int
    lap: int
    rank: int
    flags: int
    confidence: float
    origin_n_m: float
    origin_e_m: float
    yaw_rad: float

    @property
    def origin(self) -> NDArray[np.float64]:
        """(2,) metres north and east of the fleet's origin."""
        return np.array([self.origin_n_m, self.origin_e_m])


def encode_map(header: MapHeader, animals: Sequence[MapAnimal]) -> bytes:
    """The packet of a map. Raises ValueError for what does not fit, naming it."""
    if len(animals) > MAX_ANIMALS:
        raise ValueError(
            f"{len(animals)} animals: a map packet holds {MAX_ANIMALS}; leave the least seen out"
        )
    origin = (round(header.origin_n_m), round(header.origin_e_m))
    if max(abs(value) for value in origin) > 32767:
        raise ValueError(
            f"map origin {origin} m: must be within 32767 m of the fleet's origin; move the fleet's origin"
        )
    body = b"".join(_encode_animal(one, *origin) for one in animals)
    values = (
        *(VERSION, header.episode & 0xFFFF, header.proposer, header.lap, header.rank, header.flags),
        *(round(np.clip(header.confidence, 0, 1) * 255), *origin),
        *(round(header.yaw_rad / (2 * np.pi) * 256) % 256, len(animals)),
    )
    checksum = binascii.crc_hqx(HEADER.pack(*values, 0)[:-2] + body, 0xFFFF)
    return HEADER.pack(*values, checksum) + body


def decode_map(packet: bytes) -> tuple[MapHeader, list[MapAnimal]]:
    """The map in a packet. Raises PacketError for anything that `encode_map` did not make."""
    if len(packet) < HEADER_BYTES:
        raise PacketError(f"map packet of {len(packet)} bytes: at least {HEADER_BYTES} are needed")
    version, episode, proposer, lap, rank, flags, confidence, north, east, yaw, count, checksum = (
        HEADER.unpack_from(packet)
    )
    if version != VERSION:
        raise PacketError(
            f"map packet of version {version}: this drone reads {VERSION}; update the older one"
        )
    wanted = HEADER_BYTES + count * ANIMAL_BYTES
    if len(packet) != wanted:
        raise PacketError(
            f"map packet of {len(packet)} bytes: the {count} animals that it announces take {wanted}"
        )
    body = packet[HEADER_BYTES:]
    if binascii.crc_hqx(packet[: HEADER_BYTES - 2] + body, 0xFFFF) != checksum:
        raise PacketError(f"map packet with checksum {checksum:#06x} was altered on its way")
    header = MapHeader(
        *(episode, proposer, lap, rank, flags, confidence / 255, north, east, yaw / 256 * 2 * np.pi)
    )
    chunks = (body[start : start + ANIMAL_BYTES] for start in range(0, len(body), ANIMAL_BYTES))
    return header, [_decode_animal(chunk, north, east) for chunk in chunks]


def _encode_animal(animal: MapAnimal, origin_n_m: float, origin_e_m: float) -> bytes:
    north, east = animal.n_m - origin_n_m, animal.e_m - origin_e_m
    if not (abs(north) <= REACH_M and abs(east) <= REACH_M and 0 <= animal.size_m <= MAX_SIZE_M):
        raise ValueError(
            f"animal {animal.id} at ({north:.1f}, {east:.1f}) m from the map's origin, "
            f"size {animal.size_m:.1f} m: must be within {REACH_M} m and no longer than "
            f"{MAX_SIZE_M} m; leave it out of the map"
        )
    if not (
        0 <= animal.id <= NO_ID and 0 <= animal.hits <= COUNTER_LIMIT and 0 <= animal.misses <= COUNTER_LIMIT
    ):
        raise ValueError(
            f"animal id {animal.id}, hits {animal.hits}, misses {animal.misses}: ids are 0 to {NO_ID}, "
            "counters 0 to 15"
        )
    return ANIMAL.pack(
        *(round(north * 100), round(east * 100), animal.axis_state << 14 | round(animal.size_m * 100)),
        *(round(animal.axis_rad / np.pi * 256) % 256, animal.hits << 4 | animal.misses, animal.id),
    )


def _decode_animal(chunk: bytes, origin_n_m: float, origin_e_m: float) -> MapAnimal:
    north, east, size, axis, counters, number = ANIMAL.unpack(chunk)
    if size >> 14 > AxisState.UNKNOWN:
        raise PacketError(f"axis state {size >> 14} of animal {number}: 0 to {AxisState.UNKNOWN} are defined")
    return MapAnimal(
        n_m=origin_n_m + north / 100,
        e_m=origin_e_m + east / 100,
        size_m=(size & 0x3FFF) / 100,
        axis_rad=axis / 256 * np.pi,
        hits=counters >> 4,
        misses=counters & 15,
        id=number,
        axis_state=size >> 14,
    )


@dataclass(frozen=True)
class Memory:
    """Animals with ids from earlier episodes and when each was last seen, seconds of the clock that `now_s`
    comes from.
    """

    animals: tuple[MapAnimal, ...] = ()
    last_seen_s: tuple[float, ...] = ()

    def known_at(self, now_s: float) -> "Memory":
        """Only the animals whose id may not yet be given to another."""
        kept = [row for row, seen in enumerate(self.last_seen_s) if now_s - seen < REUSE_AFTER_S]
        return Memory(tuple(self.animals[row] for row in kept), tuple(self.last_seen_s[row] for row in kept))

    def after(self, animals: Iterable[MapAnimal], now_s: float) -> "Memory":
        """The memory after an episode's map: animals it saw are fresh, those it only carried along keep
        their age.
        """
        seen_before = {one.id: seen for one, seen in zip(self.animals, self.last_seen_s, strict=True)}
        rows = {one.id: (one, seen_before[one.id]) for one in self.animals}
        for one in animals:
            if one.hits > 0 or one.id in seen_before:
                rows[one.id] = (one, now_s if one.hits > 0 else seen_before[one.id])
        kept = Memory(tuple(one for one, _ in rows.values()), tuple(seen for _, seen in rows.values()))
        return kept.known_at(now_s)

    def refreshed(self, sights: Iterable[tuple[MapAnimal, float]]) -> "Memory":
        """The memory with newer sights of its animals, each with the second it was seen; a pod that was
        watched for minutes is not where the last episode left it.
        """
        rows = {one.id: (one, seen) for one, seen in zip(self.animals, self.last_seen_s, strict=True)}
        for one, seen_s in sights:
            if one.id in rows and seen_s > rows[one.id][1]:
                rows[one.id] = (one, seen_s)
        return Memory(tuple(one for one, _ in rows.values()), tuple(seen for _, seen in rows.values()))

    def newest_first(self) -> "Memory":
        """The same animals, the latest seen at the head: what a map has no room for is the longest unseen."""
        order = sorted(range(len(self.animals)), key=lambda row: -self.last_seen_s[row])
        return Memory(
            tuple(self.animals[row] for row in order), tuple(self.last_seen_s[row] for row in order)
        )

    def forgotten_counts(self) -> tuple[MapAnimal, ...]:
        """The animals with no view counted yet, as a new episode starts from them; a mirrored axis is
        lost."""
        return tuple(
            replace(
                one,
                hits=0,
                misses=0,
                axis_state=AxisState.KNOWN if one.axis_state == AxisState.KNOWN else AxisState.UNKNOWN,
            )
            for one in self.animals
        )
