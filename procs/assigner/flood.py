"""Rows of costs that flood a ring in rounds: one agent of the exact method.

Without loss a row travels once over each link: every round an agent passes on what came in from the other
side. A message is rows, each behind its agent's index (1 byte). With loss each message is the whole table,
less what the neighbour said that it holds: sender, bitmaps of the rows held and of the rows that follow, the
rows. It goes out twice a round.
"""

import numpy as np
from numpy.typing import NDArray

from procs.assigner.costs import NONE, cost_codes, solve_table

__all__ = ["COPIES", "RowAgent", "rounds_needed"]

COPIES = 2  # of a message where messages are lost: with one, 0.4 % of rings of five miss a row at 20 %


def rounds_needed(n_agents: int, lossy: bool) -> int:
    """Rounds after which every row is everywhere; with loss, all but surely."""
    if n_agents < 2:
        return 0
    return n_agents // 2 + (max(3, n_agents // 4) if lossy else 0)


class RowAgent:
    """One agent on a ring of n, `index` in ring order: own_costs (n_goals,) >= 0, inf forbids.

    `step` is called rounds + 1 times: the first takes nothing, the last says nothing. Raises ValueError for a
    NaN or negative cost.
    """

    def __init__(
        self, own_costs: NDArray[np.float64], index: int, n_agents: int, *, lossy: bool = False
    ) -> None:
        codes = cost_codes(np.asarray(own_costs, dtype=np.float64))
        self.index, self.n_agents, self.lossy, self.n_goals = index, n_agents, lossy, len(codes)
        self.rounds = rounds_needed(n_agents, lossy)
        self.rows: dict[int, bytes] = {index: codes.astype("<u2").tobytes()}
        self._number = 0
        self._news: tuple[list[int], list[int]] = ([index], [index])  # to the left, to the right
        self._known: dict[int, int] = {}  # neighbour -> bitmap of the rows that it said it holds

    @property
    def goal(self) -> int:
        """Its column in the exact solution of the whole table; -1 while a row is missing: never a guess."""
        if len(self.rows) < self.n_agents or self.n_goals == 0:
            return NONE
        table = np.frombuffer(b"".join(self.rows[k] for k in range(self.n_agents)), dtype="<u2")
        return int(solve_table(table.reshape(self.n_agents, self.n_goals))[self.index])

    def step(self, inbox: list[bytes]) -> list[bytes]:
        """One round: take what came -> messages to the left and the right neighbour in turn (to the one
        neighbour of a pair); empty bytes say nothing.
        """
        if self.lossy:
            for data in inbox:
                self._take_table(data)
        elif inbox:
            from_left: list[int] = []
            from_right: list[int] = []
            for data in inbox:
                self._take_rows(data, from_left, from_right)
            self._news = (from_right, from_left)
        self._number += 1
        if self._number > self.rounds:
            return []
        sides = (self.index - 1) % self.n_agents, (self.index + 1) % self.n_agents
        if self.lossy:
            messages = [self._table(neighbour) for neighbour in sides] * COPIES
            return messages[::2] if self.n_agents == 2 else messages
        left, right = (b"".join(bytes([k]) + self.rows[k] for k in news) for news in self._news)
        # In an even ring the row of the agent opposite comes both ways: one way is enough.
        last_of_even = self._number == self.rounds and self.n_agents % 2 == 0
        return [right] if self.n_agents == 2 else [b"" if last_of_even else left, right]

    def _take_rows(self, data: bytes, from_left: list[int], from_right: list[int]) -> None:
        size = 1 + 2 * self.n_goals
        for start in range(0, len(data) - size + 1, size):
            k = data[start]
            if k >= self.n_agents or k in self.rows:
                continue
            self.rows[k] = data[start + 1 : start + size]
            # A row comes the shorter way; the one from opposite comes from the left.
            apart = (self.index - k) % self.n_agents
            (from_left if 2 * apart <= self.n_agents else from_right).append(k)

    def _table(self, neighbour: int) -> bytes:
        size = (self.n_agents + 7) // 8
        held = sum(1 << k for k in self.rows)
        known = self._known.get(neighbour, 0)
        rows = [k for k in sorted(self.rows) if not known >> k & 1]
        bitmaps = held.to_bytes(size, "little") + sum(1 << k for k in rows).to_bytes(size, "little")
        return bytes([self.index]) + bitmaps + b"".join(self.rows[k] for k in rows)

    def _take_table(self, data: bytes) -> None:
        """Take a neighbour's table; one that is cut short or names what there is not counts as not come."""
        size, row_size = (self.n_agents + 7) // 8, 2 * self.n_goals
        start = 1 + 2 * size
        if len(data) < start:
            return
        held = int.from_bytes(data[1 : 1 + size], "little")
        bits = int.from_bytes(data[1 + size : start], "little")
        if (held | bits) >> self.n_agents or len(data) != start + bits.bit_count() * row_size:
            return
        self._known[data[0]] = self._known.get(data[0], 0) | held
        for k in range(self.n_agents):
            if bits >> k & 1:
                self.rows.setdefault(k, data[start : start + row_size])
                start += row_size
