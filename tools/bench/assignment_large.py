"""Larger rings: every method at five rounds, at the floor(n/2) rounds that reach the whole ring, and at the
bytes that the learned method sends in five; and what loss does to them.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from procs.assigner.solve import Method
from tools.bench import assignment_peers as peers
from tools.bench.assignment_bars import Measures, percent
from tools.bench.assignment_cases import Cases, Scores, score
from tools.bench.table import Row

__all__ = ["LargeRings", "Point"]

SIZES = (10, 20, 50, 100)
RATIOS = (1.0, 1.5, 2.0)
COUNTS = {10: 2000, 20: 500, 50: 60, 100: 10}  # of cases: what minutes allow
QUICK_COUNTS = {10: 100, 20: 20}
WINDOW_COUNTS = {20: 100, 50: 16, 100: 4}
LOSS_COUNTS = {5: 1000, 10: 400, 20: 100}
LOSSES = (0.0, 0.05, 0.1, 0.2, 0.3)
LOSS_SIZES = ((5, 10), (10, 15), (20, 30))
LEARNED: tuple[Method, ...] = ("gnn", "gnn+resolve")
OURS: tuple[Method, ...] = (*LEARNED, "exact")
AT_FIVE, AT_RING, AT_BYTES = "5 rounds", "floor(n/2) rounds", "equal bytes"


@dataclass(frozen=True)
class Point:
    """One method, size, budget and loss."""

    method: str
    n_agents: int
    n_goals: int
    budget: str
    loss: float
    rounds: int
    scores: Scores
    bytes_sent: float
    count: int

    def row(self, seed: int) -> Row:
        lost = f", {100 * self.loss:.0f} % lost" if self.budget == "loss" else f", {self.budget}"
        name = f"{self.method}, n = {self.n_agents}, n_g = {self.n_goals}{lost}: D / O1 / Q0, %"
        scores = self.scores
        figure = percent(scores.distinct, scores.agreeing, scores.quality)
        spent = f"{self.bytes_sent:.0f} B, " if np.isfinite(self.bytes_sent) else ""
        return Row(name, self.count, str(seed), f"{figure} ({spent}{self.rounds} rounds)")


Peer = Callable[[NDArray[np.float64], int, float, np.random.Generator], peers.PeerResult]

PEERS: dict[str, Peer] = {
    "flooding": lambda costs, rounds, loss, random: peers.flood(costs, rounds, loss, random),
    "nearest top 3": lambda costs, rounds, loss, random: peers.flood_nearest(costs, rounds, 3, loss, random),
    "CBAA": lambda costs, rounds, loss, random: peers.cbaa(costs, rounds, loss, random),
    "auction 0.02": lambda costs, rounds, loss, random: peers.distributed_auction(
        costs, rounds, 0.02, loss, random
    ),
}


class LargeRings:
    """Measures once and keeps the points for the figures and for the rule."""

    def __init__(self, seed: int, *, quick: bool) -> None:
        self.measures = Measures(seed, 0)
        self.counts = QUICK_COUNTS if quick else COUNTS
        self.quick = quick
        self.points: list[Point] = []

    def rows(self) -> Iterator[Row]:
        for n_agents, count in self.counts.items():
            for ratio in RATIOS:
                given = self.measures.given(n_agents, round(ratio * n_agents), count)
                for point in self._points(given):
                    self.points.append(point)
                    yield point.row(self.measures.seed)

    def loss_rows(self) -> Iterator[Row]:
        for n_agents, n_goals in LOSS_SIZES[: 1 if self.quick else None]:
            count = self.counts.get(n_agents, 50) if self.quick else LOSS_COUNTS[n_agents]
            given = self.measures.given(n_agents, n_goals, count)
            for loss in LOSSES:
                for point in self._lossy(given, loss):
                    self.points.append(point)
                    yield point.row(self.measures.seed)

    def _points(self, given: Cases) -> Iterator[Point]:
        n_agents, n_goals = given.costs.shape[1:]
        whole = n_agents // 2
        afford = 0.0
        for method in LEARNED:
            point = self._learned(given, method, AT_FIVE, 5, 0.0)
            afford = afford or point.bytes_sent
            yield point
            yield (
                replace(point, budget=AT_RING)
                if whole == 5
                else self._learned(given, method, AT_RING, whole, 0.0)
            )
        yield self._learned(given, "exact", AT_RING, whole, 0.0)
        for name in PEERS:
            budgets = ((AT_FIVE, 5), (AT_RING, whole), (AT_BYTES, self._rounds_for(name, given, afford)))
            for budget, rounds in budgets:
                yield self._peer(given, name, budget, rounds, 0.0)
        if n_agents > 11:
            few = Cases(*(part[: self._window_count(n_agents)] for part in vars(given).values()))
            random = np.random.default_rng([self.measures.seed, n_agents, n_goals, 1])
            chosen = peers.best_of_window(few.agents, few.goals, 5, random)
            yield Point(
                "best of a window",
                n_agents,
                n_goals,
                AT_FIVE,
                0.0,
                5,
                score(few, chosen),
                np.inf,
                len(chosen),
            )

    def _window_count(self, n_agents: int) -> int:
        return 4 if self.quick else WINDOW_COUNTS[n_agents]

    def _rounds_for(self, name: str, given: Cases, afford: float) -> int:
        """Rounds that a peer can pay for with `afford` bytes, at most those that reach the whole ring for
        the floods.
        """
        n_goals: int = given.costs.shape[2]
        most: int = given.costs.shape[1] // 2
        each = {"flooding": 2 * (1 + 2 * n_goals), "nearest top 3": 2 * (1 + 9)}
        if name in each:
            return max(1, min(most, int(afford // each[name])))
        return max(1, int(afford // (2 * peers.BID_BYTES * n_goals)))

    def _learned(self, given: Cases, method: Method, budget: str, rounds: int, loss: float) -> Point:
        got = self.measures.run(given, method, rounds, loss)  # with the network that flies
        n_agents, n_goals = given.costs.shape[1:]
        return Point(
            method, n_agents, n_goals, budget, loss, got.rounds, got.scores, got.bytes_sent, len(given.costs)
        )

    def _peer(self, given: Cases, name: str, budget: str, rounds: int, loss: float) -> Point:
        n_agents, n_goals = given.costs.shape[1:]
        random = np.random.default_rng([self.measures.seed, n_agents, n_goals, 2])
        got = PEERS[name](given.costs, rounds, loss, random)
        scores = score(given, got.goals)
        return Point(name, n_agents, n_goals, budget, loss, rounds, scores, got.bytes_sent, len(got.goals))

    def _lossy(self, given: Cases, loss: float) -> Iterator[Point]:
        rounds = max(5, given.costs.shape[1] // 2)
        for method in OURS:
            yield self._learned(given, method, "loss", rounds, loss)
        for name in PEERS:
            yield self._peer(given, name, "loss", rounds, loss)
