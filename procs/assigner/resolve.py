"""The learned method with a vote: a few learned rounds, then each agent's three likeliest goals flood for the
rounds that are left, and every agent solves what it holds. Where that is the whole ring, all solve the same
lists and no two choose the same goal.

A message: sender, round (1 byte each); then lists, each its agent (1 byte) and for each goal listed the
goal's number (1 byte; 2 where there are more than 255) and 2 bytes of worth. The worth is the goal's 16-bit
cost where lists come to everybody, so that the answer is the best that the lists hold; it is the network's
float16 logit where they do not, since that knows something of the agents beyond.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from procs.assigner.costs import FORBIDDEN, NONE, code_values, cost_codes
from procs.assigner.gnn import GnnAgent
from procs.assigner.learned import Network

__all__ = ["Lists", "ResolveAgent", "choose", "left_over", "split_rounds", "wanted_goals"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Codes = NDArray[np.uint16]

LISTED = 3  # goals an agent names
LEARNED_ROUNDS = 3
FLOOD_ROUNDS = 2
UNLISTED = 2.0**45  # above any worth, yet sums over 255 agents stay exact


def split_rounds(rounds: int, n_agents: int) -> tuple[int, int]:
    """(learned, flooding): of five rounds two flood, of more than five three are learned, of fewer the last
    two flood.
    """
    if n_agents < 2:
        return 0, 0
    flooding = min(rounds, max(FLOOD_ROUNDS, rounds - LEARNED_ROUNDS))
    return rounds - flooding, flooding


class Lists:
    """How lists are made, written and read on a ring of n_agents where they flood for `flooding` rounds."""

    def __init__(self, n_agents: int, n_goals: int, flooding: int) -> None:
        self.n_agents, self.n_goals = n_agents, n_goals
        self.reach_all = n_agents // 2 <= flooding
        # Going without is a choice of its own only where nobody solves for all.
        self.n_columns = n_goals + (n_agents > n_goals and not self.reach_all)
        self.length = min(LISTED, self.n_columns)
        self._goal_type = np.dtype("u1" if self.n_columns <= 255 else "<u2")
        self.n_bytes = 1 + self.length * (self._goal_type.itemsize + 2)

    def make(self, wanted: Floats, codes: Codes) -> tuple[Ints, Codes]:
        """(goals, worth as it travels) (..., length) from logits (..., >= n_columns) and cost codes
        (..., n_goals).
        """
        order = np.argsort(-wanted[..., : self.n_columns], axis=-1, kind="stable")[..., : self.length]
        if self.reach_all:
            return order, np.take_along_axis(codes, order, axis=-1)
        logits = np.take_along_axis(wanted, order, axis=-1).astype(np.float16)
        return order, logits.view(np.uint16)

    def penalty(self, worth: Codes) -> Floats:
        """What choosing a listed goal costs, UNLISTED where it is forbidden."""
        if self.reach_all:
            return np.where(worth == FORBIDDEN, UNLISTED, code_values(worth))
        logits = worth.view(np.float16).astype(np.float64)
        return np.where(np.isfinite(logits), 1e5 - logits, UNLISTED)

    def write(self, agent: int, goals: Ints, worth: Codes) -> bytes:
        return bytes([agent]) + goals.astype(self._goal_type).tobytes() + worth.astype("<u2").tobytes()

    def read(self, data: bytes) -> tuple[Ints, Codes] | None:
        """(goals, worth) of one list, None where it names a goal that there is not."""
        goals = np.frombuffer(data, dtype=self._goal_type, count=self.length, offset=1).astype(np.int64)
        worth = np.frombuffer(data, dtype="<u2", count=self.length, offset=len(data) - 2 * self.length)
        return (goals, worth.astype(np.uint16)) if (goals < self.n_columns).all() else None


def choose(lists: Lists, goals: Ints, worth: Codes) -> tuple[Ints, list[int]]:
    """The cheapest choice of distinct goals from W lists (W, length) -> (goal column of each, -1 where its
    list leaves none, n_goals for one that goes without by choice; the free goals in order).
    """
    n_lists = len(goals)
    table = np.full((n_lists, lists.n_goals + n_lists * (lists.n_columns > lists.n_goals)), UNLISTED)
    rows = np.arange(n_lists)
    # Each list has a column of its own for going without.
    columns = np.where(goals == lists.n_goals, lists.n_goals + rows[:, None], goals)
    table[rows[:, None], columns] = lists.penalty(worth)
    rows, columns = linear_sum_assignment(table)
    chosen = np.full(n_lists, NONE, dtype=np.int64)
    listed = table[rows, columns] < UNLISTED
    chosen[rows[listed]] = np.minimum(columns[listed], lists.n_goals)
    free = np.setdiff1d(np.arange(lists.n_goals), chosen)
    return chosen, [int(goal) for goal in free]


def left_over(chosen: Ints, place: int, free: list[int], wanted: Floats) -> int:
    """What the list at `place`, which `choose` left with nothing, takes of the free goals: the one that it
    wants most (n_goals,) where nobody else is left over, else the free goals go in order; -1 for none.
    """
    others = np.flatnonzero(chosen == NONE)
    if len(others) > 1:
        rank = int(np.searchsorted(others, place))
        goal = free[rank] if rank < len(free) else NONE
    else:
        goal = max(free, key=lambda goal: wanted[goal], default=NONE)
    return goal if goal != NONE and np.isfinite(wanted[goal]) else NONE


def wanted_goals(lists: Lists, logits: Floats, codes: Codes) -> Floats:
    """(..., n_goals) how much an agent wants each goal, -inf what is forbidden: by cost where all solve for
    all, else by the network.
    """
    return np.where(codes == FORBIDDEN, -np.inf, -code_values(codes)) if lists.reach_all else logits


class ResolveAgent:
    """One agent of a ring of n, `index` in ring order: own_costs (n_goals,) >= 0, inf forbids.

    `step` is called rounds + 1 times: the first takes nothing, the last says nothing. `lossy`: all lists
    held are said again each round. Raises ValueError for a NaN or negative cost, or rounds outside 1 to 127.
    """

    def __init__(
        self,
        own_costs: NDArray[np.float64],
        index: int,
        n_agents: int,
        rounds: int = 5,
        *,
        lossy: bool = False,
        weights: Network | None = None,
    ) -> None:
        self._learner = GnnAgent(own_costs, index, n_agents, rounds, weights)
        self._codes = cost_codes(np.asarray(own_costs, dtype=np.float64))
        self.index, self.n_agents, self.lossy = index, n_agents, lossy
        self._learned, self._flooding = split_rounds(rounds, n_agents)
        self._learner.rounds = self._learned
        self.rounds = self._learned + self._flooding
        self._lists = Lists(n_agents, len(self._codes), self._flooding)
        self._held: dict[int, tuple[Ints, Codes]] = {}
        self._news: tuple[list[int], list[int]] = ([], [])  # to the left, to the right
        self._number = -1

    @property
    def goal(self) -> int:
        """The column that the lists held give it, -1 for none and before all rounds are over."""
        n_goals = len(self._codes)
        if self._number < self.rounds or n_goals == 0:
            return NONE
        members = sorted(self._held)
        goals, worth = (np.array([self._held[k][part] for k in members]) for part in range(2))
        chosen, free = choose(self._lists, goals, worth)
        place = members.index(self.index)
        if chosen[place] == NONE:
            wanted = wanted_goals(self._lists, self._learner.logits[:n_goals], self._codes)
            return left_over(chosen, place, free, wanted)
        return int(chosen[place]) if chosen[place] < n_goals else NONE

    def step(self, inbox: list[bytes]) -> list[bytes]:
        """One round: take what the neighbours sent -> messages to the left and to the right neighbour (to
        the one neighbour of a pair); empty bytes say nothing.
        """
        if len(self._codes) == 0:
            return []
        self._number += 1
        if self._number <= self._learned:
            messages = self._learner.step(inbox)
            if self._number < self._learned:
                return messages
            self._held[self.index] = self._lists.make(self._learner.logits, self._codes)
            self._news = ([self.index], [self.index])
        else:
            self._listen(inbox)
        return self._say() if self._number < self.rounds else []

    def _listen(self, inbox: list[bytes]) -> None:
        left, right = (self.index - 1) % self.n_agents, (self.index + 1) % self.n_agents
        news: tuple[list[int], list[int]] = ([], [])
        size = self._lists.n_bytes
        for data in inbox:
            if len(data) < 2 or data[0] not in (left, right) or data[1] <= self._learned:
                continue
            for start in range(2, len(data) - size + 1, size):
                member = data[start]
                found = self._lists.read(data[start : start + size])
                if found is not None and member < self.n_agents and member not in self._held:
                    self._held[member] = found
                    # What came from the left goes on to the right.
                    news[1 if data[0] == left else 0].append(member)
        self._news = news

    def _say(self) -> list[bytes]:
        flooded = self._number - self._learned
        if flooded >= self.n_agents // 2 and not self.lossy:
            return []  # every list has come to everybody
        # In an even ring the list of the agent opposite comes both ways: one way is enough.
        one_way = 2 * (flooded + 1) == self.n_agents and not self.lossy
        messages = []
        for side in range(2):
            members = sorted(self._held) if self.lossy else self._news[side]
            body = b"".join(self._lists.write(k, *self._held[k]) for k in members)
            header = bytes([self.index, self._number + 1])
            messages.append(header + body if body and not (side == 0 and one_way) else b"")
        return messages[1:] if self.n_agents == 2 else messages
