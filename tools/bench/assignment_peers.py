"""Other ways to agree round a ring, short and honest, all cases of a size at once: consensus auction
(CBAA), distributed auction, flooding of rows, flooding of each agent's nearest three, and the best that a
window of the ring allows.

Every peer takes costs (C, n_agents, n_goals), agents in ring order, and the rounds that it may speak; in a
round each agent tells both neighbours. `loss` is the share of messages that never arrive. Bytes are what
one agent sends in all, the mean over agents and cases.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from procs.assigner.costs import cost_codes

__all__ = [
    "PeerResult",
    "best_of_window",
    "cbaa",
    "distributed_auction",
    "flood",
    "flood_nearest",
    "held_rows",
]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

BID_BYTES = 3  # a goal: 16-bit bid or price, and who gave it
UNLISTED = 1e3  # far above any cost on the unit square, yet exact beside them


@dataclass(frozen=True)
class PeerResult:
    goals: Ints  # (C, n_agents) goal column, -1 none
    bytes_sent: float  # by one agent, in all


def _heard(shape: tuple[int, int], loss: float, random: np.random.Generator) -> tuple[Bools, Bools]:
    """Who hears its left and its right neighbour this round, (C, n_agents) each."""
    return random.random(shape) >= loss, random.random(shape) >= loss


def cbaa(
    costs: Array, rounds: int, loss: float = 0.0, random: np.random.Generator | None = None
) -> PeerResult:
    """Consensus-based auction of one goal an agent (Choi, Brunet, How 2009, algorithms 1 and 2).

    An agent without a goal bids its own cost where that beats the best bid it knows, the cheapest first;
    neighbours keep the better bid a goal, the lower agent where two are equal; who is outbid bids again.
    """
    random = random if random is not None else np.random.default_rng(0)
    count, n, n_goals = costs.shape
    # A lower key is a better bid: 16-bit cost first, then the agent.
    own = cost_codes(costs).astype(np.int64) * n + np.arange(n)[:, None]
    nobody = np.iinfo(np.int64).max
    best = np.full((count, n, n_goals), nobody)
    chosen = np.full((count, n), -1, dtype=np.int64)

    def bid() -> None:
        open_to = np.where((own < best) & (chosen < 0)[..., None], own, nobody)
        pick = open_to.argmin(axis=2)
        at = (*np.nonzero(open_to.min(axis=2) < nobody),)
        chosen[at] = pick[at]
        best[(*at, pick[at])] = own[(*at, pick[at])]

    for _ in range(rounds):
        bid()
        from_left, from_right = _heard((count, n), loss, random)
        left = np.where(from_left[..., None], np.roll(best, 1, axis=1), nobody)
        right = np.where(from_right[..., None], np.roll(best, -1, axis=1), nobody)
        best = np.minimum(best, np.minimum(left, right))
        mine = np.take_along_axis(best == own, np.maximum(chosen, 0)[..., None], axis=2)[..., 0]
        chosen[~mine] = -1
    bid()
    return PeerResult(chosen, 2.0 * BID_BYTES * n_goals * rounds)


def distributed_auction(
    costs: Array,
    rounds: int,
    epsilon: float = 0.02,
    loss: float = 0.0,
    random: np.random.Generator | None = None,
) -> PeerResult:
    """Auction with local prices (Zavlanos, Spesivtsev, Pappas 2008): neighbours keep the higher price a
    goal, the higher agent where two are equal; who is outbid raises the price of its best goal by its
    margin and `epsilon`. Prices travel as float16.
    """
    random = random if random is not None else np.random.default_rng(0)
    count, n, n_goals = costs.shape
    # A higher key is a higher price; the bits of a float16 that is not negative are in its own order.
    keys = np.zeros((count, n, n_goals), dtype=np.int64)
    names = np.arange(1, n + 1)
    chosen = np.full((count, n), -1, dtype=np.int64)

    def bid() -> None:
        prices = (keys // (n + 1)).astype(np.uint16).view(np.float16).astype(np.float64)
        gain = -costs - prices
        pick = gain.argmax(axis=2)
        ordered = np.partition(gain, n_goals - 2, axis=2) if n_goals > 1 else None
        margin = ordered[..., -1] - ordered[..., -2] if ordered is not None else np.zeros((count, n))
        raised = np.take_along_axis(prices, pick[..., None], axis=2)[..., 0] + margin + epsilon
        bits = raised.astype(np.float16).view(np.uint16).astype(np.int64)
        at = (*np.nonzero(chosen < 0),)
        chosen[at] = pick[at]
        keys[(*at, pick[at])] = (bits * (n + 1) + names)[at]

    for _ in range(rounds):
        bid()
        from_left, from_right = _heard((count, n), loss, random)
        left = np.where(from_left[..., None], np.roll(keys, 1, axis=1), 0)
        right = np.where(from_right[..., None], np.roll(keys, -1, axis=1), 0)
        keys = np.maximum(keys, np.maximum(left, right))
        bidder = np.take_along_axis(keys % (n + 1), np.maximum(chosen, 0)[..., None], axis=2)[..., 0]
        chosen[bidder != names] = -1
    bid()
    return PeerResult(chosen, 2.0 * BID_BYTES * n_goals * rounds)


def held_rows(
    count: int, n: int, rounds: int, row_bytes: int, loss: float, random: np.random.Generator
) -> tuple[Bools, float]:
    """Flooding -> (C, n, n) which rows each agent holds after `rounds`, and the bytes that one agent sent.

    Without loss a row (its agent in 1 byte, then `row_bytes`) goes once over each link; with loss each
    message is all that is held, behind a bitmap.
    """
    if loss == 0:
        apart = np.abs(np.arange(n)[:, None] - np.arange(n))
        held = np.broadcast_to(np.minimum(apart, n - apart) <= rounds, (count, n, n))
        return held, float(min(2 * rounds, n - 1) * (1 + row_bytes))
    held = np.broadcast_to(np.eye(n, dtype=bool), (count, n, n)).copy()
    sent = 0.0
    for _ in range(rounds):
        sent += 2 * ((n + 7) // 8 + float(held.sum(axis=2).mean()) * row_bytes)
        from_left, from_right = _heard((count, n), loss, random)
        left = np.roll(held, 1, axis=1) & from_left[..., None]
        right = np.roll(held, -1, axis=1) & from_right[..., None]
        held = held | left | right
    return held, sent


def flood(
    costs: Array, rounds: int, loss: float = 0.0, random: np.random.Generator | None = None
) -> PeerResult:
    """Whole rows of 16-bit costs flood for `rounds`; each agent solves the rows that it holds, whole ring
    or not.
    """
    random = random if random is not None else np.random.default_rng(0)
    count, n, n_goals = costs.shape
    held, sent = held_rows(count, n, rounds, 2 * n_goals, loss, random)
    return PeerResult(_solve_held(costs, held), sent)


def flood_nearest(
    costs: Array, rounds: int, nearest: int = 3, loss: float = 0.0, random: np.random.Generator | None = None
) -> PeerResult:
    """Each agent's `nearest` goals (1 byte a goal, 2 its cost) flood for `rounds`; each solves what it
    holds. Who is left over alone takes the nearest goal that nobody has; several take what is left in a
    fixed order.
    """
    random = random if random is not None else np.random.default_rng(0)
    count, n, n_goals = costs.shape
    nearest = min(nearest, n_goals)
    held, sent = held_rows(count, n, rounds, 3 * nearest, loss, random)
    limit = np.partition(costs, nearest - 1, axis=2)[..., nearest - 1 : nearest]
    listed = np.where(costs <= limit, costs, UNLISTED)
    chosen = _solve_held(listed, held)
    lists = np.take_along_axis(listed, np.maximum(chosen, 0)[..., None], axis=2)[..., 0] < UNLISTED
    over = ~lists & (chosen >= 0)
    for case, agent in np.argwhere(over & (over.sum(axis=1) == 1)[:, None]):
        free = np.ones(n_goals, dtype=bool)
        known = [k for k in np.flatnonzero(held[case, agent]) if k != agent]
        rows, columns = linear_sum_assignment(listed[case, known])
        free[columns[listed[case, known][rows, columns] < UNLISTED]] = False
        if free.any():
            chosen[case, agent] = int(np.where(free, costs[case, agent], np.inf).argmin())
    return PeerResult(chosen, sent)


def _solve_held(costs: Array, held: Bools) -> Ints:
    """(C, n) each agent's own column in the optimum of the rows that it holds; the rows keep their order,
    so agents with equal rows agree.
    """
    count, n, _ = costs.shape
    chosen = np.full((count, n), -1, dtype=np.int64)
    for case in range(count):
        if held[case].all():
            rows, columns = linear_sum_assignment(costs[case])
            chosen[case, rows] = columns
            continue
        for agent in range(n):
            known = np.flatnonzero(held[case, agent])
            rows, columns = linear_sum_assignment(costs[case, known])
            mine = np.flatnonzero(known[rows] == agent)
            chosen[case, agent] = columns[mine[0]] if len(mine) else -1
    return chosen


def best_of_window(
    agents: Array, goals: Array, rounds: int, random: np.random.Generator, completions: int = 40
) -> Ints:
    """(C, n_agents) what an agent could best do that knows the exact places of all goals and of the agents
    within `rounds` hops, and how agents are drawn, but nothing of the others: the goal that the optimum
    gives it most often, over `completions` drawings of the agents that it does not see.

    No method can agree with the optimum more often from such a window, but for the noise of the drawings.
    """
    count, n = agents.shape[:2]
    hidden = n - (2 * rounds + 1)
    chosen = np.full((count, n), -1, dtype=np.int64)
    for case in range(count):
        pool = random.random((4000, 2))
        pool_angle = np.arctan2(pool[:, 1] - 0.5, pool[:, 0] - 0.5)
        angle = np.arctan2(agents[case, :, 1] - 0.5, agents[case, :, 0] - 0.5)
        for agent in range(n):
            if hidden <= 0:
                table = np.linalg.norm(agents[case][:, None] - goals[case], axis=-1)
                chosen[case] = linear_sum_assignment(table)[1]
                break
            seen = agents[case, np.arange(agent - rounds, agent + rounds + 1) % n]
            # From the window's last agent on, anticlockwise, to its first: there are the others.
            first, last = angle[(agent - rounds) % n], angle[(agent + rounds) % n]
            gap = (first - last) % (2 * np.pi)
            inside = pool[(pool_angle - last) % (2 * np.pi) < gap]
            if len(inside) == 0:
                inside = agents[case, [(agent + rounds) % n]]
            votes = np.zeros(goals.shape[1], dtype=np.int64)
            seen_costs = np.linalg.norm(seen[:, None] - goals[case], axis=-1)
            for _ in range(completions):
                others = inside[random.integers(0, len(inside), hidden)]
                other_costs = np.linalg.norm(others[:, None] - goals[case], axis=-1)
                _, columns = linear_sum_assignment(np.vstack([seen_costs, other_costs]))
                votes[columns[rounds]] += 1
            chosen[case, agent] = int(votes.argmax())
    return chosen
