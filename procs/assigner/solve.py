"""Assignment round the ring as one call: build the agents, let them talk, report what they decided and what
it cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from procs.assigner.costs import NONE
from procs.assigner.flood import COPIES, RowAgent
from procs.assigner.gnn import MOST_ROUNDS, GnnAgent
from procs.assigner.learned import TRAINING_SEEDS, Network, network
from procs.assigner.many import Assignments, exact_rings, gnn_rings, resolve_rings
from procs.assigner.resolve import ResolveAgent

__all__ = [
    "METHODS",
    "TRAINING_SEEDS",
    "Assignment",
    "Assignments",
    "Method",
    "RingAgent",
    "agent_for",
    "agents_of",
    "assign",
    "assign_many",
    "is_distinct",
    "talk",
]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

Method = Literal["gnn", "gnn+resolve", "exact"]
MOST_AGENTS = 255  # an agent is named by one byte
METHODS: tuple[Method, ...] = ("gnn", "gnn+resolve", "exact")


@dataclass(frozen=True)
class Assignment:
    """Who takes which goal, and what it took to agree."""

    goals: Ints  # (n_agents,) goal column, -1 holds
    is_distinct: bool  # as many different goals are taken as can be: nobody clashes, nobody was left waiting
    rounds: int
    bytes_sent: Ints  # (n_agents,) of encoded messages, both sides


class RingAgent(Protocol):
    """One agent of any method: it knows its own costs and what its neighbours handed to it.

    `step` is called rounds + 1 times and returns the messages of one round: first to the left, then to the
    right neighbour, and so on in turn where there are more; a pair has one neighbour. The first call takes
    nothing, the last says nothing. Messages may be missing, repeated or in any order.
    """

    rounds: int

    @property
    def goal(self) -> int:
        """The column that it takes, -1 while it holds."""

    def step(self, inbox: list[bytes]) -> list[bytes]:
        """Take what neighbours sent, say what to send to each."""


def agent_for(
    method: Method,
    own_costs: Floats,
    index: int,
    n_agents: int,
    *,
    rounds: int = 5,
    lossy: bool = False,
    weights: Network | None = None,
) -> RingAgent:
    """The agent at `index` of n_agents in ring order: own_costs (n_goals,) >= 0, inf forbids. `lossy`: say
    more than once what may be lost; all agents of a ring must have it the same.

    Raises ValueError for an unknown method, a cost that is NaN or negative, rounds that the method cannot
    take.
    """
    if method == "exact":
        return RowAgent(own_costs, index, n_agents, lossy=lossy)
    if method == "gnn":
        return GnnAgent(own_costs, index, n_agents, rounds, weights)
    if method == "gnn+resolve":
        return ResolveAgent(own_costs, index, n_agents, rounds, lossy=lossy, weights=weights)
    raise ValueError(f"method {method!r} is not known; this release has: {', '.join(METHODS)}")


def assign(
    costs: Floats,
    method: Method = "exact",
    rounds: int = 5,
    loss: float = 0.0,
    seed: int = 0,
    *,
    training_seed: int = 0,
) -> Assignment:
    """Give each agent a goal of its own: costs (n_agents, n_goals) >= 0, inf forbids; agents in ring order.

    "gnn": `rounds` rounds of learned messages; two agents may still choose the same. "gnn+resolve": learned
    rounds, then flooded lists of each agent's three likeliest goals, solved by all alike. "exact": every
    agent's row of 16-bit costs floods the ring in floor(n/2) rounds (docs/assignment.md), whatever `rounds`
    says; with `loss`, the share of messages that never arrive, whole tables travel for
    floor(n/2) + max(3, n/4) rounds, and an agent whose table stays incomplete holds (-1). More agents than
    goals: the rest get -1. Messages are lost by a generator seeded with `seed`; `training_seed` picks the
    network of the learned methods.

    Raises ValueError for an unknown method, costs that are not a table of numbers >= 0, loss outside 0 to 1,
    rounds below 1 (learned: above 127).
    """
    costs = np.asarray(costs, dtype=np.float64)
    if costs.ndim != 2 or len(costs) > MOST_AGENTS:
        raise ValueError(
            f"costs of shape {costs.shape}: a table (n_agents <= {MOST_AGENTS}, n_goals) is needed"
        )
    _check(method, rounds, loss)
    agents = agents_of(costs, method, rounds, lossy=loss > 0, training_seed=training_seed)
    needed = agents[0].rounds if agents else 0
    delivered = np.random.default_rng(seed).random((needed, COPIES, 2, len(agents))) >= loss
    bytes_sent = talk(agents, delivered)
    goals = np.array([agent.goal for agent in agents], dtype=np.int64)
    return Assignment(goals, is_distinct(goals, costs.shape[1]), needed, bytes_sent)


def assign_many(
    costs: Floats,
    method: Method = "exact",
    rounds: int = 5,
    loss: float = 0.0,
    seed: int = 0,
    *,
    training_seed: int = 0,
) -> Assignments:
    """`assign` for many rings of one size: costs (B, n_agents, n_goals). Without loss each gets the goals and
    the bytes that `assign` gives it; with loss that holds for the first.

    Raises ValueError as `assign` does.
    """
    costs = np.asarray(costs, dtype=np.float64)
    if costs.ndim != 3 or not 1 <= costs.shape[1] <= MOST_AGENTS:
        raise ValueError(
            f"costs of shape {costs.shape}: tables (B, 1 <= n_agents <= {MOST_AGENTS}, n_goals) are needed"
        )
    _check(method, rounds, loss)
    random = np.random.default_rng(seed)
    if method == "exact":
        return exact_rings(costs, loss, random)
    rings = gnn_rings if method == "gnn" else resolve_rings
    return rings(costs, rounds, loss, random, network(training_seed))


def agents_of(
    costs: Floats, method: Method, rounds: int = 5, *, lossy: bool = False, training_seed: int = 0
) -> list[RingAgent]:
    """The agents of one ring, in order: costs (n_agents, n_goals)."""
    weights = None if method == "exact" else network(training_seed)
    n = len(costs)
    return [agent_for(method, costs[k], k, n, rounds=rounds, lossy=lossy, weights=weights) for k in range(n)]


def _check(method: str, rounds: int, loss: float) -> None:
    if method not in METHODS:
        raise ValueError(f"method {method!r} is not known; this release has: {', '.join(METHODS)}")
    if not 0 <= loss <= 1 or rounds < 1 or (rounds > MOST_ROUNDS and method != "exact"):
        raise ValueError(
            f"loss {loss} must lie in 0 to 1 and rounds {rounds} be at least 1, learned at most {MOST_ROUNDS}"
        )


def talk(agents: Sequence[RingAgent], delivered: Bools) -> Ints:
    """Hand messages from neighbour to neighbour -> (n,) bytes that each agent sent.

    delivered (rounds, copies, 2, n): whether what agent k is sent from the left (0) and from the right (1)
    arrives; a pair's messages come from the left.
    """
    n = len(agents)
    sent = np.zeros(n, dtype=np.int64)
    inboxes: list[list[bytes]] = [[] for _ in agents]
    for arrives in delivered:
        said = [agent.step(inbox) for agent, inbox in zip(agents, inboxes, strict=True)]
        inboxes = [[] for _ in agents]
        for k, messages in enumerate(said):
            sent[k] += sum(len(data) for data in messages)
            for place, data in enumerate(messages):
                copy, side = (place, 1) if n == 2 else divmod(place, 2)
                to = (k + (1 if side else -1)) % n
                if data and arrives[copy, 1 - side, to]:
                    inboxes[to].append(data)
    for agent, inbox in zip(agents, inboxes, strict=True):
        agent.step(inbox)
    return sent


def is_distinct(goals: Ints, n_goals: int) -> bool:
    """Whether as many different goals are taken as can be, and none twice: goals (n_agents,), -1 holds."""
    taken = goals[goals != NONE]
    return bool(len(np.unique(taken)) == len(taken) == min(len(goals), n_goals))
