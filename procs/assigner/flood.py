"""Rows of costs that flood a ring in rounds: what `solve.assign` drives to count rounds and bytes of the
exact method.

Without loss a row travels once over each link: every round an agent passes on what came in from the other
side. With loss each message is the whole table behind a bitmap of the rows held.
"""

import numpy as np
from numpy.typing import NDArray

from procs.assigner.costs import NONE, solve_table

__all__ = ["RowAgent"]

Codes = NDArray[np.uint16]


class RowAgent:
    """One agent on a ring of n: knows its own row (n_goals,) of codes, and what its two neighbours hand
    it.
    """

    def __init__(self, index: int, n: int, own_codes: Codes, whole_tables: bool) -> None:
        self.index, self.n, self.whole_tables = index, n, whole_tables
        self.n_goals = len(own_codes)
        self.rows: dict[int, bytes] = {index: own_codes.astype("<u2").tobytes()}
        self._to_left = [index]  # rows to pass on in the next round
        self._to_right = [index]

    def step(
        self, from_left: list[bytes], from_right: list[bytes], last_round: bool = False
    ) -> tuple[bytes, bytes]:
        """One round: take what came, say what goes (to the left, to the right); empty bytes say nothing."""
        news_left = self._take(from_left)
        news_right = self._take(from_right)
        if self.whole_tables:
            table = self._table()
            return table, table
        if from_left or from_right:
            self._to_right, self._to_left = news_left, news_right
        left = b"".join(bytes([k]) + self.rows[k] for k in self._to_left)
        right = b"".join(bytes([k]) + self.rows[k] for k in self._to_right)
        # In an even ring the row of the agent opposite comes both ways: one way is enough.
        return (b"" if last_round and self.n % 2 == 0 else left), right

    def receive(self, from_left: list[bytes], from_right: list[bytes]) -> None:
        """Take the last round's messages."""
        self._take(from_left)
        self._take(from_right)

    def goal(self) -> int:
        """Its column in the exact solution of the whole table; NONE while a row is missing: it never
        guesses.
        """
        if len(self.rows) < self.n:
            return NONE
        table = np.array([np.frombuffer(self.rows[k], dtype="<u2") for k in range(self.n)], dtype=np.uint16)
        return int(solve_table(table.reshape(self.n, self.n_goals))[self.index])

    def _table(self) -> bytes:
        held = sorted(self.rows)
        bitmap = sum(1 << k for k in held).to_bytes((self.n + 7) // 8, "little")
        return bitmap + b"".join(self.rows[k] for k in held)

    def _take(self, messages: list[bytes]) -> list[int]:
        """Rows that were new, in the order in which they came."""
        size = 2 * self.n_goals
        news = []
        for data in messages:
            if self.whole_tables:
                start = (self.n + 7) // 8
                bits = int.from_bytes(data[:start], "little")
                held = [k for k in range(self.n) if bits >> k & 1]
                rows = {k: data[start + i * size : start + (i + 1) * size] for i, k in enumerate(held)}
            else:
                rows = {data[i]: data[i + 1 : i + 1 + size] for i in range(0, len(data), 1 + size)}
            for k, row in rows.items():
                if k not in self.rows:
                    self.rows[k] = row
                    news.append(k)
        return news
