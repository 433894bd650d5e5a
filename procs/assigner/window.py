"""What one agent of the learned methods makes of the rows of costs that it holds: a price for each goal, and
features of its own goals for the network.

Rows lie in the order own, left 1, right 1, left 2, right 2, ...; all functions take any number of leading
axes, so that one agent, a ring of them or thousands of rings go through the same code. Where there are more
agents than goals a last column stands for "no goal", with room for all who must go without.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["FEATURES", "Window", "bid", "features", "hops_relayed", "observe", "temperature"]

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FEATURES = 12  # a goal, as `features` gives them
ITERATIONS = 5  # price updates a round: all that a round's 0.2 ms leave room for
RELAXATION = 1.8  # how far beyond Sinkhorn's own step prices move: 1 needs twice the updates, 3 swings
# Softness of the bids at 0, 1, 2, ... rounds, in spreads of a row of costs; the last stays.
TEMPERATURES = (0.5, 0.35, 0.22, 0.14, 0.09, 0.06)
LEAST = 1e-9  # of an agent: a goal that is wanted less has no price
TINY = 1e-290  # where a row is not held, or all in it forbidden
MOST_HOPS = 8  # the widest window in training; farther rows would cost time and change little
FAR = 8.0  # spreads: what lies farther, or is forbidden, looks as far as this


class Window(NamedTuple):
    """The held rows, made comparable: in these units metres and unit squares look alike."""

    costs: Floats  # (..., W, g) above the row's least, in spreads; FAR where forbidden or not held
    held: Bools  # (..., W)
    allowed: Bools  # (..., W, g)
    scale: Floats  # (...,) cost units a spread
    room: Floats  # (g,) how many agents a goal takes: 1, and for "no goal" all that go without
    n_goals: int  # without "no goal"


def temperature(number: int) -> float:
    """Softness of the bids after `number` rounds."""
    return TEMPERATURES[min(number, len(TEMPERATURES) - 1)]


def hops_relayed(n_agents: int) -> int:
    """How many hops a row of costs is handed on, to each side."""
    return min(n_agents // 2, MOST_HOPS)


def observe(rows: Floats, held: Bools, n_agents: int) -> Window:
    """The window of rows (..., W, n_goals) in cost units (inf forbids); `held` (..., W) are there."""
    n_goals = rows.shape[-1]
    allowed = np.isfinite(rows) & held[..., None]
    room = np.ones(n_goals)
    if n_agents > n_goals:
        finite = np.maximum(allowed.sum(axis=(-2, -1)), 1)
        middle = np.where(allowed, rows, 0.0).sum(axis=(-2, -1)) / finite
        none = np.broadcast_to(middle[..., None, None], (*held.shape, 1))
        rows = np.concatenate([rows, none], axis=-1)
        allowed = np.concatenate([allowed, held[..., None]], axis=-1)
        room = np.append(room, n_agents - n_goals)
    least = np.where(allowed, rows, np.inf).min(axis=-1, keepdims=True)
    above = np.where(allowed, rows - np.where(np.isfinite(least), least, 0.0), 0.0)
    count = np.maximum(allowed.sum(axis=-1), 1)
    mean = above.sum(axis=-1) / count
    variance = np.maximum((above**2).sum(axis=-1) / count - mean**2, 0.0)
    scale = np.sqrt(variance).sum(axis=-1) / np.maximum(held.sum(axis=-1), 1)
    scale = np.where(scale > 0, scale, 1.0)
    costs = np.where(allowed, np.minimum(above / scale[..., None, None], FAR), FAR)
    return Window(costs, held, allowed, scale, room, n_goals)


def bid(window: Window, prices: Floats, softness: float) -> tuple[Floats, Floats]:
    """Move prices (..., g), in cost units, until soft bids of all held rows fit the room -> (prices, bids
    (..., W, g)).

    Sinkhorn's scaling with columns that may stay empty: prices never fall below 0.
    """
    # In Sinkhorn's own form, as factors exp(-price / softness): a few small products an update.
    lure = np.exp(window.costs / -softness) * window.allowed  # (..., W, g)
    factor = np.exp(prices / (window.scale[..., None] * -softness))
    least = np.exp(FAR / -softness)
    for _ in range(ITERATIONS):
        wanted = factor * np.vecmat(1.0 / np.maximum(np.matvec(lure, factor), TINY), lure)
        factor = factor * np.maximum(wanted / window.room, LEAST) ** -RELAXATION
        factor = np.minimum(np.maximum(factor, least), 1.0)
    bids = lure * factor[..., None, :] / np.maximum(np.matvec(lure, factor), TINY)[..., None]
    return np.log(factor) * window.scale[..., None] * -softness, bids


def features(window: Window, prices: Floats, bids: Floats, n_agents: int) -> Floats:
    """What the network sees of each of the agent's own goals -> (..., g, FEATURES)."""
    shape = prices.shape
    price = prices / window.scale[..., None]
    net = window.costs + price[..., None, :]
    net = np.minimum(net - net.min(axis=-1, keepdims=True), FAR)  # by how much worse than the row's best goal
    rivals = np.where(window.held[..., 1:, None], net[..., 1:, :], FAR)
    rival = rivals.min(axis=-2, initial=FAR)  # 0: somebody else's best goal
    is_none = np.zeros(shape)
    is_none[..., window.n_goals :] = 1.0
    share = window.held.sum(axis=-1) / n_agents
    found = np.empty((*shape, FEATURES))
    for column, value in enumerate(
        (
            window.costs[..., 0, :],
            net[..., 0, :],
            price,
            bids[..., 0, :],
            bids[..., 1::2, :].sum(axis=-2),  # wanted on the left
            bids[..., 2::2, :].sum(axis=-2),  # wanted on the right
            rival,
            window.allowed[..., 0, :],
            is_none,
            np.full(shape, n_agents / window.n_goals),
            np.full(shape, 1.0 / n_agents),
            np.broadcast_to(share[..., None], shape),
        )
    ):
        found[..., column] = value
    return found
