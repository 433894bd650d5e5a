"""What the methods are judged on: points drawn once for each (seed, agents, goals), the optimum of each
case, and the four scores.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

__all__ = ["Cases", "Scores", "cases", "distinct", "points", "score"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Cases:
    """C instances of one size: agents in ring order (by angle round the middle of the unit square)."""

    agents: Array  # (C, n_agents, 2)
    goals: Array  # (C, n_goals, 2)
    costs: Array  # (C, n_agents, n_goals), the distance between them
    best: Ints  # (C, n_agents) goal column of the optimum, -1 for who gets none
    best_cost: Array  # (C,)


@dataclass(frozen=True)
class Scores:
    """Shares of 1 over all cases of a size."""

    distinct: float  # D: every agent that can have a goal has one, and no two the same
    agreeing: float  # O1: agents whose goal is the optimum's
    quality: float  # Q0: mean of optimum / cost, 0 where not distinct
    exact: float  # the whole answer is the optimum


def points(seed: int, n_agents: int, n_goals: int, count: int) -> tuple[Array, Array]:
    """The first `count` of the 5000 cases of this seed and size -> agents (C, n_agents, 2) in ring order,
    goals (C, n_goals, 2).
    """
    drawn = np.random.default_rng([seed, n_agents, n_goals]).random((max(count, 1), n_agents + n_goals, 2))
    agents, goals = drawn[:count, :n_agents], drawn[:count, n_agents:]
    angle = np.arctan2(agents[..., 1] - 0.5, agents[..., 0] - 0.5)
    order = np.argsort(angle, axis=1)
    return np.take_along_axis(agents, order[..., None], axis=1), goals


def cases(seed: int, n_agents: int, n_goals: int, count: int = 5000) -> Cases:
    """The cases of `points` with their costs and their optimum."""
    agents, goals = points(seed, n_agents, n_goals, count)
    costs = np.linalg.norm(agents[:, :, None] - goals[:, None], axis=-1)
    best = np.full((count, n_agents), -1, dtype=np.int64)
    for number, table in enumerate(costs):
        rows, columns = linear_sum_assignment(table)
        best[number, rows] = columns
    return Cases(agents, goals, costs, best, total(costs, best))


def total(costs: Array, chosen: Ints) -> Array:
    """(C,) what the choices cost together; who has none costs nothing."""
    taken = np.take_along_axis(costs, np.maximum(chosen, 0)[..., None], axis=2)[..., 0]
    return np.asarray(np.where(chosen >= 0, taken, 0.0).sum(axis=1))


def distinct(chosen: Ints, n_goals: int) -> NDArray[np.bool_]:
    """(C,) whether as many different goals are taken as can be, and none twice; chosen (C, n_agents), -1
    none.
    """
    ordered = np.sort(chosen, axis=1)
    twice = ((ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any(axis=1)
    enough = (chosen >= 0).sum(axis=1) == min(chosen.shape[1], n_goals)
    return np.asarray(~twice & enough)


def score(given: Cases, chosen: Ints) -> Scores:
    """The four scores of `chosen` (C, n_agents) goal columns, -1 none."""
    whole = distinct(chosen, given.costs.shape[2])
    cost = total(given.costs, chosen)
    quality = np.where(whole, given.best_cost / np.maximum(cost, 1e-300), 0.0)
    same = chosen == given.best
    return Scores(
        float(whole.mean()), float(same.mean()), float(quality.mean()), float(same.all(axis=1).mean())
    )
