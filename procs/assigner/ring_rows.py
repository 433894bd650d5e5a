"""Whole rings at once: the rows that every agent holds after each round, for training and for the vectorised
evaluator.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from procs.assigner.window import bid, features, hops_relayed, observe, temperature

__all__ = ["Seen", "seen_by_round"]

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class Seen(NamedTuple):
    """What B rings of n agents see after a round."""

    features: Floats  # (B, n, g, FEATURES)
    allowed: Bools  # (B, n, g) goals that an agent may take; the last may stand for none
    to_hand_on: tuple[Bools, Bools]  # (B, n) whether it holds the newest row on its left, on its right


def seen_by_round(rows: Floats, delivered: Bools) -> Iterator[Seen]:
    """What is seen after 0, 1, ... rounds: rows (B, n, n_goals) every agent's costs as they travel, inf
    forbids; delivered (rounds, 2, B, n) whether the round's message from the left (0) and the right (1) came.
    """
    n = rows.shape[1]
    window_rows, held = rows[:, :, None], np.ones((*rows.shape[:2], 1), dtype=bool)
    relayed = [held[..., 0], held[..., 0]]
    prices = None
    for number in range(len(delivered) + 1):
        if 0 < number <= hops_relayed(n):
            for side, shift in enumerate((1, -1)):
                if side == 1 and 2 * number == n:
                    break  # the agent opposite: one way is enough
                relayed[side] = np.roll(relayed[side], shift, axis=1) & delivered[number - 1, side]
                far = np.roll(rows, shift * number, axis=1)
                window_rows = np.concatenate([window_rows, far[:, :, None]], axis=2)
                held = np.concatenate([held, relayed[side][..., None]], axis=2)
        window = observe(window_rows, held, n)
        if prices is None:
            prices = np.zeros((*rows.shape[:2], window.costs.shape[-1]))
        prices, bids = bid(window, prices, temperature(number))
        yield Seen(features(window, prices, bids, n), window.allowed[..., 0, :], (relayed[0], relayed[1]))
