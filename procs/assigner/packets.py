"""What travels in RING_ASSIGN: one member's whole state as bytes (docs/assignment.md).

Packet: version, sender, n_members (1 byte each); four bitmaps by member index (rows, choices, confirmed,
released), lowest bit first; 1 byte an animal id for each choice held, 255 for none; the number of messages
of a learned method's rounds (1 byte), each its receiver, round (1 byte each), length (2 bytes) and bytes;
then rows up to the end: member, previous animal (255 none), n (1 byte each; its highest bit says that the
row is cut), n ids (1 byte), n costs (2 bytes, little-endian, costs.py).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

__all__ = ["MAX_PACKET_BYTES", "NO_ID", "SAID_HEADER", "Packet", "Row", "decode", "encode", "row_room"]

MAX_PACKET_BYTES = 308  # the paper's bound on what a neighbour is sent
VERSION = 2
NO_ID = 255
CUT = 0x80
MOST_LISTED = 0x7F
SAID_HEADER = 4


@dataclass(frozen=True)
class Row:
    """One member's costs: `codes` for the animals `ids`, and the animal that it watches already (-1 none).

    is_cut: it lists its nearest animals only; the others would do too, at more than the dearest listed.
    What a whole row does not list, its drone does not know.
    """

    ids: tuple[int, ...]
    codes: tuple[int, ...]
    previous: int = -1
    is_cut: bool = False

    @property
    def n_bytes(self) -> int:
        return 3 + 3 * len(self.ids)


@dataclass(frozen=True)
class Packet:
    """What one member says it holds; `rows` are a window of the rows in `rows_held`; `said`: to whom,
    round, bytes.
    """

    sender: int
    n_members: int
    rows_held: frozenset[int]
    choices: dict[int, int]  # member -> animal id, -1 none
    confirmed: frozenset[int]  # they hold every member's choice, all distinct
    released: frozenset[int]  # they have let go of the animal that they watched before
    rows: dict[int, Row]
    said: tuple[tuple[int, int, bytes], ...] = ()


def row_room(n_members: int) -> int:
    """Bytes that a packet leaves for rows once all members' choices are held."""
    return MAX_PACKET_BYTES - 4 - 4 * ((n_members + 7) // 8) - n_members


def _bitmap(indices: Iterable[int], n: int) -> bytes:
    bits = sum(1 << index for index in indices)
    return bits.to_bytes((n + 7) // 8, "little")


def encode(packet: Packet) -> bytes:
    """The packet's bytes; `decode` gives it back."""
    n = packet.n_members
    parts = [bytes([VERSION, packet.sender, n])]
    parts += [
        _bitmap(held, n) for held in (packet.rows_held, packet.choices, packet.confirmed, packet.released)
    ]
    parts.append(bytes(packet.choices[k] % 256 for k in sorted(packet.choices)))
    parts.append(bytes([len(packet.said)]))
    parts += [
        bytes([to, number]) + len(data).to_bytes(2, "little") + data for to, number, data in packet.said
    ]
    for member in sorted(packet.rows):
        row = packet.rows[member]
        count = len(row.ids) | (CUT if row.is_cut else 0)
        parts.append(bytes([member, row.previous % 256, count, *row.ids]))
        parts.append(np.array(row.codes, dtype="<u2").tobytes())
    return b"".join(parts)


class _Reader:
    """Takes bytes from the front and says what was missing when they run out."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def take(self, count: int, what: str) -> bytes:
        piece = self.data[self.at : self.at + count]
        if len(piece) < count:
            raise ValueError(
                f"packet of {len(self.data)} bytes ends inside {what}: {count} bytes from {self.at} wanted"
            )
        self.at += count
        return piece

    def members(self, n: int, what: str) -> list[int]:
        bits = int.from_bytes(self.take((n + 7) // 8, what), "little")
        if bits >> n:
            raise ValueError(f"{what}: names a member beyond the {n} of this episode")
        return [k for k in range(n) if bits >> k & 1]


def decode(data: bytes) -> Packet:
    """A packet from its bytes; ValueError says what is wrong with one that `encode` did not make."""
    reader = _Reader(data)
    version, sender, n = reader.take(3, "the header")
    if version != VERSION:
        raise ValueError(
            f"version {version}: this drone speaks version {VERSION}; use one release in the whole fleet"
        )
    if not sender < n:
        raise ValueError(f"sender {sender} is not one of the {n} members")
    rows_held = reader.members(n, "the rows' bitmap")
    chosen = reader.members(n, "the choices' bitmap")
    confirmed = reader.members(n, "the confirmations' bitmap")
    released = reader.members(n, "the releases' bitmap")
    ids = reader.take(len(chosen), "the choices")
    said = tuple(_said(reader, n) for _ in range(reader.take(1, "the rounds")[0]))
    rows = {}
    while reader.at < len(data):
        member, row = _row(reader, n)
        rows[member] = row
    choices = {k: -1 if animal == NO_ID else animal for k, animal in zip(chosen, ids, strict=True)}
    held = frozenset(rows_held)
    return Packet(sender, n, held, choices, frozenset(confirmed), frozenset(released), rows, said)


def _said(reader: _Reader, n: int) -> tuple[int, int, bytes]:
    to, number, *size = reader.take(SAID_HEADER, "a round's header")
    if to >= n:
        raise ValueError(f"message of a round to member {to}: there are only {n}")
    return to, number, reader.take(int.from_bytes(bytes(size), "little"), "a round's message")


def _row(reader: _Reader, n: int) -> tuple[int, Row]:
    member, previous, count = reader.take(3, "a row's header")
    if member >= n:
        raise ValueError(f"row of member {member}: there are only {n}")
    is_cut, count = bool(count & CUT), count & MOST_LISTED
    ids = tuple(reader.take(count, "a row's ids"))
    codes = np.frombuffer(reader.take(2 * count, "a row's costs"), dtype="<u2")
    if len(set(ids)) != count or NO_ID in ids:
        raise ValueError(f"row of member {member}: ids {ids} repeat or hold {NO_ID}, which means none")
    return member, Row(ids, tuple(map(int, codes)), -1 if previous == NO_ID else previous, is_cut)
