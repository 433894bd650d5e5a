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
PERMUTATIONS = np.array(
    list(permutations(range(4)))
)  # (24, 4): corner of the target for each corner of the source
ONE_HOT = np.zeros((16, 24))
for _column, _permutation in enumerate(PERMUTATIONS):
    ONE_HOT[np.arange(4) * 4 + _permutation, _column] = 1.0


def corners_of(boxes: Array) -> Array:
    """(N, 4) xyxy -> (N, 4, 2) corners, clockwise on the screen from the top left."""
    return np.asarray(boxes[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2))


def corner_costs(source: Array, target: Array) -> tuple[Array, NDArray[np.intp]]:
    """(N1, 4, 2) and (N2, 4, 2) corners -> the best total corner distance (N1, N2) and its permutation (N1,
    N2).
    """
    flat_source = source.reshape(-1, 2) @ np.array([1.0, 1.0j])
    flat_target = target.reshape(-1, 2) @ np.array([1.0, 1.0j])
    distances = np.abs(flat_source[:, None] - flat_target[None, :])
    blocks = distances.reshape(len(source), 4, len(target), 4).transpose(0, 2, 1, 3)
    totals = (blocks.reshape(-1, 16) @ ONE_HOT).reshape(len(source), len(target), 24)
    best = totals.argmin(axis=2)
    return np.take_along_axis(totals, best[:, :, None], axis=2)[:, :, 0], best


def literal_alignment(source: Array, target: Array) -> tuple[Array, NDArray[np.intp], Array, int]:
    """(N1, 4) and (N2, 4) boxes -> transform (3, 3), matches (K, 2), corner cost of each match (K,) px,
    iterations.
    """
    transform = np.eye(3)
    corners, goals = corners_of(source), corners_of(target)
    previous = None
    iterations = 0
    while iterations < MAX_ITERATIONS:
        iterations += 1
        costs, best = corner_costs(corners, goals)
        rows, columns = linear_sum_assignment(costs)
        points = corners[rows].reshape(-1, 2)
        wanted = np.take_along_axis(
            goals[columns], PERMUTATIONS[best[rows, columns]][:, :, None], axis=1
        ).reshape(-1, 2)
        design = np.column_stack([points, np.ones(len(points))])
        solution = np.linalg.lstsq(design, wanted, rcond=None)[0]
        step = np.eye(3)
        step[:2] = solution.T
        transform = step @ transform
        corners = corners @ step[:2, :2].T + step[:2, 2]
        state = (columns.tolist(), best[rows, columns].tolist())
        if state == previous and np.allclose(step, np.eye(3), atol=1e-6):
            break
        previous = state
    return transform, np.column_stack([rows, columns]), costs[rows, columns], iterations
