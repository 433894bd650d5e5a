"""Costs as 16-bit codes, and the one exact solution that every drone finds from the same codes.

A code is an unsigned float of 5 bits exponent and 11 bits mantissa: one part in 4096 at any scale (2 cm at
100 m), so that metres and unit squares keep the same order without a common scale that all would first have
to agree on. FORBIDDEN says that the drone must not take the animal.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

__all__ = ["FORBIDDEN", "NONE", "UNIT", "code_values", "cost_codes", "solve_table"]

FORBIDDEN = 0xFFFF
NONE = -1
UNIT = 2.0**-27  # metres an integer step: codes reach from 15 nm to 65 km
_FORBIDDEN_VALUE = 2.0**45  # above any code, yet sums over 99 drones stay exact in a float64
_UNLISTED_MORE = 2.0**36  # 512 m more than the dearest goal that an agent told of

Ints = NDArray[np.int64]
Codes = NDArray[np.uint16]


def cost_codes(costs: NDArray[np.float64]) -> Codes:
    """Costs (any shape, >= 0, inf: forbidden) as 16-bit codes, rounded to nearest; what is too large takes
    the largest.

    Raises ValueError for NaN or a negative cost.
    """
    costs = np.asarray(costs, dtype=np.float64)
    if np.isnan(costs).any() or (costs < 0).any():
        bad = costs[np.isnan(costs) | (costs < 0)].flat[0]
        raise ValueError(
            f"cost {bad}: every cost must be a number of at least 0, or inf for a forbidden animal"
        )
    steps = np.minimum(np.where(np.isfinite(costs), costs, 0.0) / UNIT, 2.0**43)
    exponent = np.clip(np.floor(np.log2(np.maximum(steps, 1.0))) - 11, 1, 31)
    # Rounding up to 4096 carries into the exponent, which is the next code, as it must be.
    codes = (exponent - 1) * 2048 + np.round(steps / 2.0**exponent)
    codes = np.minimum(codes, FORBIDDEN - 1)
    return np.asarray(np.where(np.isfinite(costs), codes, FORBIDDEN), dtype=np.uint16)


def code_values(codes: Codes) -> NDArray[np.float64]:
    """The codes' integer values in units of UNIT, exact in float64; FORBIDDEN is 2**45."""
    wide = np.asarray(codes, dtype=np.int64)
    exponent = np.maximum(wide >> 11, 1)
    values = np.ldexp((wide - ((exponent - 1) << 11)).astype(np.float64), exponent.astype(np.int32))
    return np.asarray(np.where(wide == FORBIDDEN, _FORBIDDEN_VALUE, values))


def solve_table(
    codes: Codes,
    previous: Ints | None = None,
    threshold: float = 0.0,
    unlisted: NDArray[np.bool_] | None = None,
) -> Ints:
    """The cheapest choice of distinct goals: codes (n_agents, n_goals) -> (n_agents,) goal column, NONE for
    who gets none.

    `previous` (n_agents,) is each agent's column so far, or NONE; it counts as cheaper by `threshold` (in
    the costs' unit), so that an assignment changes only for a larger gain. `unlisted` (n_agents, n_goals):
    goals that an agent may take but of which it told no cost; they count as dearer than any it told. All
    sums are exact: agents with equal tables find equal answers.
    """
    n_agents, n_goals = codes.shape
    choice = np.full(n_agents, NONE, dtype=np.int64)
    if n_agents == 0 or n_goals == 0:
        return choice
    values = code_values(codes)
    may = codes != FORBIDDEN
    if unlisted is not None:
        dearest = np.where(may, values, 0.0).max(axis=1, keepdims=True)
        values = np.where(unlisted, np.minimum(dearest + _UNLISTED_MORE, _FORBIDDEN_VALUE / 128), values)
        may = may | unlisted
    if previous is not None and threshold > 0:
        kept = np.flatnonzero(previous >= 0)
        values[kept, previous[kept]] -= np.round(threshold / UNIT)
    rows, columns = linear_sum_assignment(values)
    allowed = may[rows, columns]
    choice[rows[allowed]] = columns[allowed]
    return choice
