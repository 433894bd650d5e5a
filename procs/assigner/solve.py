"""Assignment round the ring as one call: build the agents, let them talk, report what they decided and what
it cost.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from procs.assigner.costs import NONE, cost_codes
from procs.assigner.flood import RowAgent

__all__ = ["METHODS", "Assignment", "assign"]

METHODS = ("exact",)


@dataclass(frozen=True)
class Assignment:
    """Who takes which goal, and what it took to agree."""

    goals: NDArray[np.int64]  # (n_agents,) goal column, -1 holds
    is_distinct: bool  # as many different goals are taken as can be: nobody clashes, nobody was left waiting
    rounds: int
    bytes_sent: NDArray[np.int64]  # (n_agents,) of encoded messages, both sides


def assign(
    costs: NDArray[np.float64], method: str = "exact", rounds: int = 5, loss: float = 0.0, seed: int = 0
) -> Assignment:
    """Give each agent a goal of its own: costs (n_agents, n_goals) >= 0, inf forbids; agents in ring order.

    "exact": every agent's row of 16-bit costs floods the ring in floor(n/2) rounds (DESIGN section 7). With
    `loss`, the share of messages that never arrive, whole tables travel for floor(n/2) + max(3, n/4) rounds,
    and an agent whose table stays incomplete holds (-1). It takes the rounds that it needs; `rounds` bounds
    methods that may stop early, and must be at least 1. More agents than goals: the rest get -1. Messages are
    lost by a generator seeded with `seed`.

    Raises ValueError for an unknown method, costs that are not a table of
    numbers >= 0, loss outside 0 to 1, rounds below 1.
    """
    if method not in METHODS:
        raise ValueError(f"method {method!r} is not known; this release has: {', '.join(METHODS)}")
    costs = np.asarray(costs, dtype=np.float64)
    if costs.ndim != 2 or len(costs) > 255:
        raise ValueError(f"costs of shape {costs.shape}: a table (n_agents <= 255, n_goals) is needed")
    if not 0 <= loss <= 1 or rounds < 1:
        raise ValueError(f"loss {loss} must lie in 0 to 1 and rounds {rounds} be at least 1")
    n = len(costs)
    codes = cost_codes(costs)
    agents = [RowAgent(k, n, codes[k], whole_tables=loss > 0) for k in range(n)]
    needed = n // 2 + (max(3, n // 4) if loss > 0 else 0) if n > 1 else 0
    bytes_sent = _talk(agents, needed, loss, np.random.default_rng(seed))
    goals = np.array([agent.goal() for agent in agents], dtype=np.int64)
    return Assignment(goals, _is_distinct(goals, costs), needed, bytes_sent)


def _talk(agents: list[RowAgent], rounds: int, loss: float, random: np.random.Generator) -> NDArray[np.int64]:
    """Hand messages from neighbour to neighbour for `rounds` rounds -> (n,) bytes that each agent sent."""
    n = len(agents)
    sent = np.zeros(n, dtype=np.int64)
    from_left: list[list[bytes]] = [[] for _ in agents]
    from_right: list[list[bytes]] = [[] for _ in agents]
    for number in range(rounds):
        said = [
            agent.step(from_left[k], from_right[k], last_round=number == rounds - 1)
            for k, agent in enumerate(agents)
        ]
        from_left, from_right = [[] for _ in agents], [[] for _ in agents]
        for k, (left, right) in enumerate(said):
            # In a pair the one neighbour stands on both sides and is told once.
            ways = (
                ((right, from_left[(k + 1) % n]),)
                if n == 2
                else (
                    (left, from_right[k - 1]),
                    (right, from_left[(k + 1) % n]),
                )
            )
            for data, inbox in ways:
                sent[k] += len(data)
                if data and random.random() >= loss:
                    inbox.append(data)
    for k, agent in enumerate(agents):
        agent.receive(from_left[k], from_right[k])
    return sent


def _is_distinct(goals: NDArray[np.int64], costs: NDArray[np.float64]) -> bool:
    taken = goals[goals != NONE]
    return bool(len(np.unique(taken)) == len(taken) == min(costs.shape))
