"""The exchange by which a ring agrees who takes which animal, and knows that it has agreed (DESIGN section
4).

Every packet is whole state: which rows, choices, confirmations and releases the sender holds, all choices,
and a window of rows that goes round. Losing, repeating or reordering packets costs time and nothing else. An
agent decides when it holds every living member's row: all solve the same table and find the same answer. It
moves only with the certificate: it holds every member's choice, no two are the same, and who watched the
animal until now has let go of it. A holder lets go when everybody has confirmed that all choices are held
and distinct; so nobody takes an animal that its holder may still watch, and nobody gives one up for an
exchange that never ends.

Packet: version, sender, n_members (1 byte each); four bitmaps by member index (rows, choices, confirmed,
released), lowest bit first; 1 byte an animal id for each choice held, 255 for none; then rows up to the end:
member, previous animal (255 none), n (1 byte each), n ids (1 byte), n costs (2 bytes, little-endian,
costs.py).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from procs.assigner.costs import FORBIDDEN, cost_codes, solve_table

__all__ = ["MAX_PACKET_BYTES", "Agent", "Packet", "Row", "decode", "encode"]

MAX_PACKET_BYTES = 308  # the paper's bound on what a neighbour is sent
VERSION = 1
NO_ID = 255
REPEAT_S = 1.0  # pace once every neighbour holds everything; before that each step speaks
UNHEARD = -2


@dataclass(frozen=True)
class Row:
    """One member's costs: `codes` for the animals `ids`, and the animal that it watches already (-1 none)."""

    ids: tuple[int, ...]
    codes: tuple[int, ...]
    previous: int = -1

    @property
    def n_bytes(self) -> int:
        return 3 + 3 * len(self.ids)


@dataclass(frozen=True)
class Packet:
    """What one member says it holds; `rows` are a window of the rows in `rows_held`."""

    sender: int
    n_members: int
    rows_held: frozenset[int]
    choices: dict[int, int]  # member -> animal id, -1 none
    confirmed: frozenset[int]  # they hold every member's choice, all distinct
    released: frozenset[int]  # they have let go of the animal that they watched before
    rows: dict[int, Row]


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
    for member in sorted(packet.rows):
        row = packet.rows[member]
        parts.append(bytes([member, row.previous % 256, len(row.ids), *row.ids]))
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
    rows = {}
    while reader.at < len(data):
        member, previous, count = reader.take(3, "a row's header")
        if member >= n:
            raise ValueError(f"row of member {member}: there are only {n}")
        row_ids = tuple(reader.take(count, "a row's ids"))
        codes = tuple(
            int(code) for code in np.frombuffer(reader.take(2 * count, "a row's costs"), dtype="<u2")
        )
        if len(set(row_ids)) != count or NO_ID in row_ids:
            raise ValueError(
                f"row of member {member}: ids {row_ids} repeat or hold {NO_ID}, which means none"
            )
        rows[member] = Row(row_ids, codes, -1 if previous == NO_ID else previous)
    choices = {k: -1 if animal == NO_ID else animal for k, animal in zip(chosen, ids, strict=True)}
    return Packet(sender, n, frozenset(rows_held), choices, frozenset(confirmed), frozenset(released), rows)


class Agent:
    """One member's side of the exchange for one episode.

    index, n_members: its place among the episode's members, in ring order, 0 first. own_costs (G,): metres
    on the ground to each of `goals` (G animal ids, 0-254); inf forbids. previous: the animal that it watches
    already, -1 none. forbidden: ids that it must not take (ordered to leave, or watched by a drone that is
    no member). threshold_m: gain for which it is worth to change. Raises ValueError for arguments that
    cannot be: an index outside the members, costs and goals of different lengths, an id outside 0-254 or
    named twice, a row too long for a packet.
    """

    def __init__(
        self,
        index: int,
        n_members: int,
        own_costs: Sequence[float] | NDArray[np.float64],
        goals: Sequence[int],
        *,
        previous: int = -1,
        forbidden: Sequence[int] = (),
        threshold_m: float = 5.0,
    ) -> None:
        if not 0 <= index < n_members <= 99:
            raise ValueError(f"index {index} of {n_members} members: there are 1 to 99, counted from 0")
        costs = np.array(own_costs, dtype=np.float64).reshape(-1)
        if (
            len(costs) != len(goals)
            or len(set(goals)) != len(goals)
            or not all(0 <= g < NO_ID for g in goals)
        ):
            raise ValueError(
                f"goals {list(goals)}: need {len(costs)} different ids from 0 to 254, one a cost"
            )
        costs[[k for k, goal in enumerate(goals) if goal in forbidden]] = np.inf
        self.index, self.n_members, self.threshold_m = index, n_members, threshold_m
        codes = tuple(int(code) for code in cost_codes(costs))
        row = Row(tuple(int(goal) for goal in goals), codes, previous if previous not in forbidden else -1)
        self._room = MAX_PACKET_BYTES - 3 - 4 * ((n_members + 7) // 8) - n_members
        if row.n_bytes > self._room:
            most = (self._room - 3) // 3
            raise ValueError(
                f"{len(goals)} goals: a packet for {n_members} members has room for {most}; split the pod"
            )
        self.rows: dict[int, Row] = {index: row}
        self._choices: dict[int, int] = {}
        self._confirmed: set[int] = set()
        self._released: set[int] = set()
        self._certified = False
        self._dropped: set[int] = set()
        self._heard: dict[int, Packet] = {}  # the newest packet of each sender, for what it lacks
        self._next_row = 0
        self._spoke_s = -np.inf
        self.n_bad = 0
        self.clash = False  # two members chose one animal: this episode ends without a certificate

    @property
    def living(self) -> list[int]:
        return [k for k in range(self.n_members) if k not in self._dropped]

    @property
    def choice(self) -> int | None:
        """Its own choice: an animal id, -1 for none left; None while it has not decided."""
        return self._choices.get(self.index)

    @property
    def choices(self) -> NDArray[np.int64]:
        """(n_members,) every member's choice: animal id, -1 none, -2 not heard."""
        return np.array([self._choices.get(k, UNHEARD) for k in range(self.n_members)], dtype=np.int64)

    @property
    def surplus(self) -> bool:
        """It decided, and there is no animal for it."""
        return self.choice == -1

    @property
    def certified(self) -> bool:
        """It may take its choice: all choices are held and distinct, and who held that animal has let it
        go.
        """
        return self._certified

    @property
    def animal(self) -> int:
        """What it shall watch now, -1 none: its choice once certified, before that what it watched until
        now.
        """
        if self._certified:
            return self._choices[self.index]
        return -1 if self.index in self._released else self.rows[self.index].previous

    def drop_member(self, index: int) -> None:
        """A member is lost: its row, choice and confirmation are waited for no more. One's own index is
        refused.
        """
        if index == self.index:
            raise ValueError(f"member {index} is this agent itself; it cannot drop itself")
        self._dropped.add(index)
        self._heard.pop(index, None)
        self._advance()

    def step(self, inbox: Sequence[bytes], now_s: float) -> list[bytes]:
        """Take what neighbours sent, and say what to send to both neighbours: one packet, or none.

        Bytes that are no packet of this episode's size are counted in n_bad and left out.
        """
        for data in inbox:
            try:
                packet = decode(data)
            except ValueError:
                self.n_bad += 1
                continue
            if packet.n_members == self.n_members and packet.sender != self.index:
                self._take(packet)
            else:
                self.n_bad += 1
        self._advance()
        if self.n_members == 1 or (self._all_told() and now_s - self._spoke_s < REPEAT_S):
            return []
        self._spoke_s = now_s
        return [encode(self._packet())]

    def _take(self, packet: Packet) -> None:
        self._heard[packet.sender] = packet
        for member, row in packet.rows.items():
            if member not in self.rows or (member == self.index and self.choice is None):
                # One's own row from a neighbour is the row of before a restart: the fleet may have decided
                # on it.
                self.rows[member] = row
        for member, animal in packet.choices.items():
            known = self._choices.setdefault(member, animal)
            self.clash = self.clash or known != animal
        self._confirmed |= packet.confirmed
        self._released |= packet.released

    def _advance(self) -> None:
        """Decide once every living member's row is here; a decision is never changed, for others may have
        moved on it.
        """
        if self.choice is None and all(k in self.rows for k in self.living):
            self._choices[self.index] = self._solve()
        if not self._all_distinct():
            return
        self._confirmed.add(self.index)
        if self._is_taken_from() and all(k in self._confirmed for k in self.living):
            self._released.add(self.index)
        # Once given, a certificate stands: others rest on it.
        self._certified = self._certified or self._is_free()

    def _solve(self) -> int:
        members = self.living
        ids = sorted({animal for k in members for animal in self.rows[k].ids})
        column = {animal: k for k, animal in enumerate(ids)}
        codes = np.full((len(members), len(ids)), FORBIDDEN, dtype=np.uint16)
        previous = np.full(len(members), -1, dtype=np.int64)
        for k, member in enumerate(members):
            row = self.rows[member]
            codes[k, [column[animal] for animal in row.ids]] = row.codes
            previous[k] = column.get(row.previous, -1)
        mine = solve_table(codes, previous, self.threshold_m)[members.index(self.index)]
        return ids[mine] if mine >= 0 else -1

    def _all_distinct(self) -> bool:
        if self.clash or any(k not in self._choices for k in self.living):
            return False
        taken = [self._choices[k] for k in self.living if self._choices[k] >= 0]
        return len(taken) == len(set(taken))

    def _is_taken_from(self) -> bool:
        """Another member takes the animal that this one watched until now."""
        before = self.rows[self.index].previous
        return before >= 0 and any(self._choices[k] == before for k in self.living if k != self.index)

    def _is_free(self) -> bool:
        """Nobody else may still watch the animal of its choice. A row that is not held may hide a holder."""
        choice, members = self._choices[self.index], self.living
        if choice < 0:
            return True
        others = [k for k in members if k != self.index and k not in self._released]
        return all(k in self.rows and self.rows[k].previous != choice for k in others)

    def _all_told(self) -> bool:
        """All who were heard hold every row, choice and confirmation that a living member has to give."""
        needed = set(self.living)
        return bool(self._heard) and all(
            needed <= p.rows_held
            and needed <= p.choices.keys()
            and needed <= p.confirmed
            and self._released <= p.released
            for p in self._heard.values()
        )

    def _packet(self) -> Packet:
        return Packet(
            self.index,
            self.n_members,
            frozenset(self.rows),
            dict(self._choices),
            frozenset(self._confirmed),
            frozenset(self._released),
            self._window(),
        )

    def _window(self) -> dict[int, Row]:
        """Rows that some neighbour lacks, as many as fit, from where the last packet ended; its own where
        nobody was heard.
        """
        heard = self._heard.values()
        lacking = {k for k in self.rows if any(k not in packet.rows_held for packet in heard)}
        # A neighbour that has not chosen hears its own row back: after a restart it may have said another.
        echoed = {p.sender for p in heard if p.sender in self.rows and p.sender not in p.choices}
        wanted = sorted(lacking | echoed if self._heard else self.rows)
        start = next((i for i, k in enumerate(wanted) if k >= self._next_row), 0)
        window: dict[int, Row] = {}
        room = self._room
        for k in wanted[start:] + wanted[:start]:
            if self.rows[k].n_bytes > room:
                break
            window[k] = self.rows[k]
            room -= self.rows[k].n_bytes
            self._next_row = k + 1
        return window
