"""Rounds of a learned method over links that lose, repeat and delay: who has heard both neighbours'
messages of a round goes on to the next.

A message is said again until the neighbour's own messages show that it arrived: who says its message of
round r has heard ours of round r - 1. A neighbour that is lost is waited for no more, one that is silent
for PATIENCE_S is passed over for that round, as the method allows.
"""

import zlib
from collections.abc import Sequence

from procs.assigner.packets import SAID_HEADER
from procs.assigner.solve import RingAgent

__all__ = ["RoundTalk", "learned_bytes"]

PATIENCE_S = 2.0  # ten packets of a neighbour, all lost, or a link that is cut

Message = tuple[int, int, bytes]  # to whom, number of the round, bytes


def learned_bytes(n_goals: int) -> int:
    """What the longest message of a learned round takes in a packet: digest, sender and round, then a row of
    costs and two numbers a goal, or three, with a column more where there are fewer goals than agents.
    """
    return SAID_HEADER + 3 + 6 * (n_goals + 1)


class RoundTalk:
    """One member's rounds: `learner` has its costs for the animals `ids`, in this order, at `index`."""

    def __init__(self, learner: RingAgent, index: int, n_members: int, ids: Sequence[int]) -> None:
        self._learner = learner
        left, right = (index - 1) % n_members, (index + 1) % n_members
        # In the order in which the learner says its messages: a pair has one neighbour, one alone has none.
        self._neighbours = [] if n_members == 1 else [left] if left == right else [left, right]
        # Columns mean the same animals to all who say so; another map's numbers are left out.
        self._digest = bytes([zlib.crc32(bytes(ids)) & 0xFF])
        self._heard: dict[tuple[int, int], bytes] = {}
        self._said: dict[tuple[int, int], bytes] = {}
        self._number = 0  # the round whose messages are waited for
        self._since_s = 0.0
        self._lost: list[int] = []

    @property
    def is_over(self) -> bool:
        """All rounds are done; the goal stands."""
        return self._number > self._learner.rounds

    @property
    def goal(self) -> int:
        """The learner's column, -1 for none."""
        return self._learner.goal

    def drop(self, neighbour: int) -> None:
        """It is lost: its messages are waited for no more."""
        self._lost.append(neighbour)

    def hear(self, sender: int, number: int, data: bytes) -> None:
        """Keep a neighbour's message of a round; repeats and those of strangers change nothing."""
        if sender in self._neighbours and data[:1] == self._digest:
            self._heard.setdefault((sender, number), data[1:])

    def step(self, now_s: float) -> None:
        """Go on as far as what was heard allows."""
        if self._number == 0:
            self._next([], now_s)
        while not self.is_over:
            awaited = [(k, self._number) for k in self._neighbours if k not in self._lost]
            if now_s - self._since_s < PATIENCE_S and not all(key in self._heard for key in awaited):
                return
            self._next([self._heard[key] for key in awaited if self._heard.get(key)], now_s)

    def _next(self, inbox: list[bytes], now_s: float) -> None:
        messages = self._learner.step(inbox)
        self._number += 1
        self._since_s = now_s
        if not self.is_over:
            messages = messages or [b""] * len(self._neighbours)
            for to, data in zip(self._neighbours, messages, strict=True):
                self._said[to, self._number] = self._digest + data

    def to_say(self, decided: Sequence[int]) -> list[Message]:
        """Messages that a neighbour may still lack, the oldest first; `decided`: members that lack none."""
        lacking = []
        for (to, number), data in self._said.items():
            heard = max((of for sender, of in self._heard if sender == to), default=0)
            if number >= heard and to not in decided and to not in self._lost:
                lacking.append((to, number, data))
        return sorted(lacking, key=lambda message: message[1])
