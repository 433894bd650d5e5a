"""The exchange by which a ring agrees who takes which animal, and knows that it has agreed
(docs/assignment.md).

Every packet is whole state: which rows, choices, confirmations and releases the sender holds, all choices,
and a window of rows that goes round. Losing, repeating or reordering packets costs time and nothing else.
An agent decides when it holds every living member's row: all solve the same table and find the same answer.
It moves only with the certificate: it holds every member's choice, no two are the same, and who watched the
animal until now has let go of it. A holder lets go when everybody has confirmed that all choices are held
and distinct; so nobody takes an animal that its holder may still watch, and nobody gives one up for an
exchange that never ends.

In a large fleet a row lists the nearest animals only (rule.py); packets.py has the wire format.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from procs.assigner.costs import FORBIDDEN, cost_codes, solve_table
from procs.assigner.packets import MOST_LISTED, NO_ID, SAID_HEADER, Packet, Row, decode, encode, row_room
from procs.assigner.rounds import RoundTalk, learned_bytes
from procs.assigner.solve import Method, agent_for

__all__ = ["Agent"]

REPEAT_S = 1.0  # pace once every neighbour holds everything; before that each step speaks
UNHEARD = -2


class Agent:
    """One member's side of the exchange for one episode.

    index, n_members: its place among the episode's members, in ring order, 0 first. own_costs (G,): metres
    on the ground to each of `goals` (G animal ids, 0-254); inf forbids. previous: the animal that it
    watches already, -1 none. forbidden: ids that it must not take (ordered to leave, or watched by a drone
    that is no member). threshold_m: gain for which it is worth to change. listed: it tells the others of so
    many animals, the nearest, and of its own and the forbidden ones; None: of all. method: what decides,
    the same for all members; with a learned one rows name the animal watched so far and nothing else.
    Raises ValueError for arguments that cannot be: an index outside the members, costs and goals of
    different lengths, an id outside 0-254 or named twice, a row or a learned message too long for a packet.
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
        listed: int | None = None,
        method: Method = "exact",
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
        previous = previous if previous not in forbidden else -1
        is_exact = method == "exact"
        row = (
            _own_row(costs, [int(goal) for goal in goals], previous, listed)
            if is_exact
            else Row((), (), previous)
        )
        self._may_take = sorted(
            int(goal) for goal, cost in zip(goals, costs, strict=True) if np.isfinite(cost)
        )
        self._room = row_room(n_members)
        if row.n_bytes > self._room or len(row.ids) > MOST_LISTED:
            most = min((self._room - 3) // 3, MOST_LISTED)
            raise ValueError(
                f"{len(row.ids)} goals: a packet for {n_members} members has room for {most}; list fewer"
            )
        self._talk = None if is_exact else self._learned(costs, goals, previous, method)
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

    def _learned(
        self, costs: NDArray[np.float64], goals: Sequence[int], previous: int, method: Method
    ) -> RoundTalk:
        """The rounds of a learned method; columns in the order of the ids. The animal held counts as
        cheaper.
        """
        order = np.argsort(goals)
        self._ids = [int(goals[k]) for k in order]
        held = np.array([goal == previous for goal in goals], dtype=bool)
        costs = np.where(held, np.maximum(costs - self.threshold_m, 0.0), costs)
        longest = learned_bytes(len(goals))
        if longest > self._room:
            raise ValueError(
                f"{len(goals)} goals: a message of {method} takes {longest} bytes and a packet for "
                f"{self.n_members} members has room for {self._room}; use the exact method"
            )
        learner = agent_for(method, costs[order], self.index, self.n_members)
        return RoundTalk(learner, self.index, self.n_members, self._ids)

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
        if self._talk is not None:
            self._talk.drop(index)
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
        if self._talk is not None and self.choice is None:
            self._talk.step(now_s)
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
        for to, number, data in packet.said:
            if self._talk is not None and to == self.index:
                self._talk.hear(packet.sender, number, data)
        for member, animal in packet.choices.items():
            known = self._choices.setdefault(member, animal)
            self.clash = self.clash or known != animal
        self._confirmed |= packet.confirmed
        self._released |= packet.released

    def _advance(self) -> None:
        """Decide once every living member's row is here, or the learned rounds are over; a decision is
        never changed, for others may have moved on it.
        """
        if self.choice is not None:
            pass
        elif self._talk is not None and self._talk.is_over:
            self._choices[self.index] = self._ids[self._talk.goal] if self._talk.goal >= 0 else -1
        elif self._talk is None and all(k in self.rows for k in self.living):
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
        unlisted = np.zeros(codes.shape, dtype=bool)
        previous = np.full(len(members), -1, dtype=np.int64)
        for k, member in enumerate(members):
            row = self.rows[member]
            listed = [column[animal] for animal in row.ids]
            unlisted[k] = row.is_cut
            unlisted[k, listed] = False
            codes[k, listed] = row.codes
            previous[k] = column.get(row.previous, -1)
        chosen = solve_table(codes, previous, self.threshold_m, unlisted)
        mine = int(chosen[members.index(self.index)])
        return ids[mine] if mine >= 0 else self._spare(chosen, ids)

    def _spare(self, chosen: NDArray[np.int64], ids: list[int]) -> int:
        """An animal that no row lists, for an agent that gets none of those that are: the first such agent
        takes the first such animal, the second the second. -1 where that is none.
        """
        left_over = [
            member
            for k, member in enumerate(self.living)
            if chosen[k] < 0 and self.rows[member].is_cut and member <= self.index
        ]
        spare = [animal for animal in self._may_take if animal not in ids]
        is_cut = self.rows[self.index].is_cut
        return spare[len(left_over) - 1] if is_cut and len(left_over) <= len(spare) else -1

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
        said: list[tuple[int, int, bytes]] = []
        room = self._room
        if self._talk is not None:
            decided = [k for k, packet in self._heard.items() if k in packet.choices]
            for message in self._talk.to_say(decided):
                size = SAID_HEADER + len(message[2])
                if size <= room:
                    said.append(message)
                    room -= size
        held = frozenset(self.rows)
        confirmed, released = frozenset(self._confirmed), frozenset(self._released)
        rows = self._window(room)
        return Packet(
            self.index, self.n_members, held, dict(self._choices), confirmed, released, rows, tuple(said)
        )

    def _window(self, room: int) -> dict[int, Row]:
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
        for k in wanted[start:] + wanted[:start]:
            if self.rows[k].n_bytes > room:
                break
            window[k] = self.rows[k]
            room -= self.rows[k].n_bytes
            self._next_row = k + 1
        return window


def _own_row(costs: NDArray[np.float64], goals: list[int], previous: int, listed: int | None) -> Row:
    """The row that an agent says of itself; `listed`: as in Agent."""
    kept = list(range(len(goals)))
    if listed is not None and listed < len(goals):
        must = [k for k in kept if goals[k] == previous or np.isinf(costs[k])]
        near = [k for k in np.argsort(costs, kind="stable").tolist() if k not in must]
        kept = sorted(must + near[: max(0, listed - len(must))])
    codes = tuple(int(code) for code in cost_codes(costs[kept]))
    return Row(tuple(goals[k] for k in kept), codes, previous, is_cut=len(kept) < len(goals))
