"""Box-ICP as the paper prints it (Algorithm 1), for reference: four corners a box, no re-boxing, from the
identity.

The one change is of speed, not of result: a 4x4 assignment has 24 permutations, so the inner problem of all
pairs of boxes is one product of the (N1*N2, 16) corner distances with a (16, 24) table of ones and zeros.
"""

from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

__all__ = ["corner_costs", "literal_alignment"]

Array = NDArray[np.float64]

MAX_ITERATIONS = 60
IDENTITY = np.eye(3)
SETTLED = 1e-5  # a step that turns, scales and shifts (px) by no more than this changes no assignment
PERMUTATIONS = np.array(
    list(permutations(range(4)))
)  # (24, 4): corner of the target for each corner of the source
ONE_HOT = np.zeros((16, 24))
for _column, _permutation in enumerate(PERMUTATIONS):
    ONE_HOT[np.arange(4) * 4 + _permutation, _column] = 1.0


def corners_of(boxes: Array) -> Array:
    """(N, 4) xyxy -> (N, 4, 2) corners, clockwise on the screen from the top left."""
    return np.asarray(boxes[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2))


def corner_costs(source: Array, target: Array) -> tuple[Array, Array]:
    """(N1, 4, 2) and (N2, 4, 2) corners -> the best total corner distance (N1, N2), and the totals of all
    permutations (24, N1, N2).
    """
    ours, theirs = source.transpose(2, 1, 0)[:, :, None, :, None], target.transpose(2, 1, 0)[:, None, :, None]
    across, down = ours[0] - theirs[0], ours[1] - theirs[1]
    across *= across
    down *= down
    across += down
    distances = np.sqrt(across, out=across).reshape(16, -1)
    totals = (ONE_HOT.T @ distances).reshape(24, len(source), len(target))
    return totals.min(axis=0), totals


def literal_alignment(source: Array, target: Array) -> tuple[Array, NDArray[np.intp], Array, int]:
    """(N1, 4) and (N2, 4) boxes -> transform (3, 3), matches (K, 2), corner cost of each match (K,) px,
    iterations.
    """
    transform, step = np.eye(3), np.eye(3)
    corners, goals = corners_of(source), corners_of(target)
    previous = None
    iterations = 0
    while iterations < MAX_ITERATIONS:
        iterations += 1
        costs, totals = corner_costs(corners, goals)
        rows, columns = linear_sum_assignment(costs)
        turned = totals[:, rows, columns].argmin(axis=0)
        wanted = goals[columns[:, None], PERMUTATIONS[turned]].reshape(-1, 2)
        design = np.ones((4 * len(rows), 3))
        design[:, :2] = corners[rows].reshape(-1, 2)
        step[:2] = np.linalg.lstsq(design, wanted, rcond=None)[0].T
        transform = step @ transform
        corners = corners @ step[:2, :2].T + step[:2, 2]
        state = (columns.tolist(), turned.tolist())
        if state == previous and np.abs(step - IDENTITY).max() < SETTLED:
            break
        previous = state
    return transform, np.column_stack([rows, columns]), costs[rows, columns], iterations
