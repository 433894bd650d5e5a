"""Instances to learn assignment from: agents round a middle, goals, costs, and the exact solver's answer."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

__all__ = ["Batch", "instances", "mixed_batch", "solved"]

Floats = NDArray[np.float64]

LONG_RING_SHARE = 0.08  # rings of 9 to 24: what 1 to 8 teaches must also hold on longer ones
POLISH_FIVE_SHARE = 0.8
POLISH_TIGHT_SHARE = 0.5  # of these, at most two goals to spare
FIVE_SHARE = 0.55  # five agents: the paper's fleet
SURPLUS_SHARE = 0.04  # fewer goals than agents
SLOT_SHARE = 0.08  # drones on the mission's slots round the pod instead of anywhere in the square
FORBIDDEN_SHARE = 0.05  # some goals forbidden to some agents
LOSS_SHARE = 0.10  # messages are lost
MOST_LOSS = 0.3
CELLS = 2560  # (agent, goal) pairs a batch: batches of all sizes cost alike


@dataclass(frozen=True)
class Batch:
    """Instances of one size."""

    costs: Floats  # (B, n, g), inf forbids
    labels: NDArray[np.int64]  # (B, n) goal of the optimum, n_goals for none
    loss: float  # share of messages that are lost
    rounds: int = 5


def instances(random: np.random.Generator, count: int, n_agents: int, n_goals: int) -> Floats:
    """Costs (count, n_agents, n_goals): points uniform on the unit square, agents in order of their angle
    round its middle, Euclid distances (paper, section 3).
    """
    points = random.random((count, n_agents + n_goals, 2))
    return _distances(points[:, :n_agents], points[:, n_agents:])


def _distances(agents: Floats, goals: Floats) -> Floats:
    order = np.argsort(np.arctan2(agents[..., 1] - 0.5, agents[..., 0] - 0.5), axis=1)
    agents = np.take_along_axis(agents, order[..., None], axis=1)
    return np.asarray(np.linalg.norm(agents[:, :, None] - goals[:, None], axis=-1), dtype=np.float64)


def solved(costs: Floats) -> NDArray[np.int64]:
    """(B, n) goal column of the optimum, n_goals for who gets none: costs (B, n, g), inf forbids."""
    n_goals = costs.shape[2]
    labels = np.full(costs.shape[:2], n_goals, dtype=np.int64)
    finite = np.where(np.isfinite(costs), costs, 1e6)
    for one, table, allowed in zip(labels, finite, np.isfinite(costs), strict=True):
        rows, columns = linear_sum_assignment(table)
        taken = allowed[rows, columns]
        one[rows[taken]] = columns[taken]
    return labels


def mixed_batch(random: np.random.Generator, polishing: bool = False) -> Batch:
    """A batch of one size, drawn from the mixture that the shares above describe; while polishing, mostly
    five agents with few goals to spare.
    """
    draw, rounds = random.random(), 5
    if draw < (POLISH_FIVE_SHARE if polishing else FIVE_SHARE):
        n_agents = 5
    elif draw < 1 - LONG_RING_SHARE:
        n_agents = int(random.integers(1, 9))
    else:
        n_agents = int(random.integers(9, 25))
        rounds = int(random.integers(5, 9))
    if random.random() < SURPLUS_SHARE:
        n_goals = int(random.integers(1, n_agents + 1))
    else:
        # Few spare goals are the hard case; up to twice as many goals as agents, and a few beyond.
        most = max(n_agents, 2) if random.random() < 0.9 else 15
        if polishing and n_agents == 5 and random.random() < POLISH_TIGHT_SHARE:
            most = 2
        spare = int(random.integers(0, most + 1))
        n_goals = n_agents + spare
    count = max(CELLS // (n_agents * n_goals), 8)
    if random.random() < SLOT_SHARE:
        costs = _round_the_pod(random, count, n_agents, n_goals)
    else:
        costs = instances(random, count, n_agents, n_goals)
    if random.random() < FORBIDDEN_SHARE:
        costs[random.random(costs.shape) < 0.15] = np.inf
    loss = float(random.uniform(0, MOST_LOSS)) if random.random() < LOSS_SHARE else 0.0
    return Batch(costs, solved(costs), loss, rounds)


def _round_the_pod(random: np.random.Generator, count: int, n_agents: int, n_goals: int) -> Floats:
    """Drones near evenly spaced slots, any turn, on a circle from inside the pod to far outside it."""
    turns = random.random((count, 1)) + np.arange(n_agents) / n_agents
    angles = 2 * np.pi * (turns + random.normal(0, 0.02, (count, n_agents)))
    radius = np.exp(random.uniform(np.log(0.15), np.log(3.0), (count, 1)))
    agents = 0.5 + radius[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return _distances(agents, random.random((count, n_goals, 2)))
