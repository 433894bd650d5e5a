"""From similarities to homographies and matchings: assignment with a dustbin, then a ridge fit, from wide
to narrow.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from procs.registrar._pair import Pair, apply_homographies, similarity_part

__all__ = ["Candidate", "refine"]

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

# Body sizes. An animal's own motion between two frames and the box's jitter both count; the widest is a pod
# that moved.
SIGMAS = (0.8, 0.4, 0.2, 0.1, 0.06)
SIGMA_PRICES = (12.0, 8.0, 3.0, 0.0, 0.0)  # nats: most views of one instant agree within a tenth of a body
KEPT_AFTER = (10, 8, 6, 4, 4)  # starting points that go on to the next sigma
FITS_PER_SIGMA = 1
SHEAR_STD = 0.07  # of what two tilted cameras shear, as a share of the scale
PERSPECTIVE_STD = 0.16  # of the perspective terms of two tilted cameras, over the width of a view
SCALE_SLACK_STD = 0.5  # keeps scale and turn where too few matches fix them


@dataclass(frozen=True)
class Candidate:
    """One matching: `columns` (N1,) target of each source or -1, its log evidence, its homography in body
    units, the log-likelihood gain (N1, N2) of every match under it, and the sigma that explains it best."""

    columns: Ints
    score: float
    homography: Array
    gains: Array
    sigma: float


def _carried_shapes(jacobians: Array, shapes: Array) -> tuple[Array, NDArray[np.complex128]]:
    """Jacobians (K, N, 2, 2) on shapes (N, 2, 2, 2) -> trace and doubled axis angle, (K, N, 2) each; written
    out, since this is the inner loop.
    """
    a, b, c, d = (jacobians[:, :, row, column, None] for row in (0, 1) for column in (0, 1))
    width2, cross, height2 = shapes[:, :, 0, 0], shapes[:, :, 0, 1], shapes[:, :, 1, 1]
    across = a * a * width2 + 2 * a * b * cross + b * b * height2
    down = c * c * width2 + 2 * c * d * cross + d * d * height2
    both = a * c * width2 + (a * d + b * c) * cross + b * d * height2
    trace = np.maximum(across + down, 1e-12)
    return trace, ((across - down) + 2j * both) / trace


def _evaluate(pair: Pair, homographies: Array, sigma: Array) -> tuple[Array, Array]:
    """Gains (K, N1, N2) of matching over leaving alone, and the score (K,) of leaving everything alone."""
    mapped, jacobians = apply_homographies(homographies, pair.source.centres)
    trace, axes = _carried_shapes(jacobians, pair.source.shapes)
    inside_source, inside_target = pair.insideness(homographies, mapped)
    price_source, price_target = inside_source * pair.source.prices, inside_target * pair.target.prices
    gains = pair.position_ratio(mapped, sigma) + pair.axis_ratio(axes)
    gains += pair.size_ratio(np.log(trace.mean(axis=2)) / 2)
    gains += price_source[:, :, None] + price_target[:, None, :]
    return gains, -(price_source.sum(axis=1) + price_target.sum(axis=1))


def _assign(gains: Array) -> Ints:
    """(K, N1, N2) -> (K, N1) column of each row in the best matching with a dustbin, -1 for the dustbin."""
    columns = np.full(gains.shape[:2], -1, dtype=np.intp)
    for index, gain in enumerate(np.maximum(gains, 0.0)):
        rows, chosen = linear_sum_assignment(gain, maximize=True)
        real = gain[rows, chosen] > 0
        columns[index, rows[real]] = chosen[real]
    return columns


def _normal_equations(
    pair: Pair, homographies: Array, columns: Ints, sigma: Array
) -> tuple[Array, Array, Array]:
    """The ridge fit's matrix (K, 8, 8), right side (K, 8) and the ridge of its four deviations from
    similarity (K,).
    """
    x = pair.source.centres
    matched = columns >= 0
    goal = pair.target.centres[columns]
    mapped, _ = apply_homographies(homographies, x)
    scale2 = (sigma[:, None] * np.exp(pair.log_size_target)[columns]) ** 2
    chi2 = ((mapped - goal) ** 2).sum(axis=2) / scale2
    weights = np.where(matched, 1 / (scale2 * (1 + chi2 / 20)), 0.0)  # one that moved far pulls less
    design = np.zeros((*columns.shape, 2, 8))
    design[:, :, 0, 0] = design[:, :, 1, 1] = design[:, :, 0, 4] = design[:, :, 1, 5] = x[:, 0]
    design[:, :, 1, 0] = design[:, :, 0, 5] = x[:, 1]
    design[:, :, 0, 1] = design[:, :, 1, 4] = -x[:, 1]
    design[:, :, 0, 2] = design[:, :, 1, 3] = 1.0
    design[:, :, :, 6:] = -goal[:, :, :, None] * x[None, :, None, :]
    weighted = (design * weights[:, :, None, None]).reshape(len(columns), -1, 8).transpose(0, 2, 1)
    matrix = weighted @ design.reshape(len(columns), -1, 8)
    right = (weighted @ goal.reshape(len(columns), -1, 1))[:, :, 0]
    return matrix, right, weights


def _ridge(pair: Pair, alpha: NDArray[np.complex128]) -> Array:
    """(K, 8) inverse variances of scale and turn, shift, shear, perspective."""
    width = np.sqrt(2 * pair.area)
    ridge = np.zeros((len(alpha), 8))
    ridge[:, :2] = 1 / (SCALE_SLACK_STD * np.abs(alpha)[:, None]) ** 2
    ridge[:, 2:4] = 1e-6
    ridge[:, 4:6] = 1 / (SHEAR_STD * np.abs(alpha)[:, None]) ** 2
    ridge[:, 6:] = (width / PERSPECTIVE_STD) ** 2
    return ridge


def _fit(pair: Pair, homographies: Array, columns: Ints, sigma: Array) -> tuple[Array, Array]:
    """New homographies (K, 3, 3) and the log evidence (K,) of their parameters against the ridge."""
    alpha = similarity_part(homographies)
    matrix, right, _ = _normal_equations(pair, homographies, columns, sigma)
    ridge = _ridge(pair, alpha)
    centre = np.zeros((len(alpha), 8))
    centre[:, 0], centre[:, 1] = alpha.real, alpha.imag
    centre[:, 2:4] = homographies[:, :2, 2]
    full = matrix + ridge[:, :, None] * np.eye(8)
    solved: Array = np.linalg.solve(full, (right + ridge * centre)[:, :, None])[:, :, 0].astype(np.float64)
    penalty = (ridge[:, 4:] * solved[:, 4:] ** 2).sum(axis=1) / 2
    volume = (np.linalg.slogdet(full)[1] - np.log(ridge[:, 4:]).sum(axis=1)) / 2
    new_alpha2 = np.maximum(solved[:, 0] ** 2 + solved[:, 1] ** 2, 1e-12)
    flat = np.log(pair.area) + np.log(2 * np.pi * new_alpha2)
    return _compose(solved), 2 * np.log(2 * np.pi) - penalty - volume - flat


def _compose(parameters: Array) -> Array:
    p, q, tx, ty, e, f, g, h = parameters.T
    result = np.empty((len(parameters), 3, 3))
    result[:, 0] = np.column_stack([p + e, f - q, tx])
    result[:, 1] = np.column_stack([q + f, p - e, ty])
    result[:, 2] = np.column_stack([g, h, np.ones_like(g)])
    return result


def _best_distinct(columns: Ints, scores: Array, n_kept: int) -> list[int]:
    """Rows of the best-scored starting points, one for each matching: those that agree end alike."""
    seen: dict[tuple[int, ...], int] = {}
    for row in np.argsort(-scores, kind="stable").tolist():
        seen.setdefault(tuple(columns[row].tolist()), row)
    return list(seen.values())[:n_kept]


def refine(pair: Pair, homographies: Array) -> list[Candidate]:
    """Distinct matchings from starting similarities (K, 3, 3), by falling log evidence."""
    best: dict[tuple[int, ...], Candidate] = {}
    for level, price, n_kept in zip(SIGMAS, SIGMA_PRICES, KEPT_AFTER, strict=True):
        sigma = np.full(len(homographies), level)
        for _ in range(FITS_PER_SIGMA):
            gains, _ = _evaluate(pair, homographies, sigma)
            columns = _assign(gains)
            homographies, evidence = _fit(pair, homographies, columns, sigma)
        gains, alone = _evaluate(pair, homographies, sigma)
        columns = _assign(gains)
        kept = np.where(
            columns >= 0, np.take_along_axis(gains, np.maximum(columns, 0)[:, :, None], axis=2)[:, :, 0], 0.0
        )
        scores = kept.sum(axis=1) + alone + evidence + pair.transform_prior(homographies) - price
        for index in range(len(homographies)):
            if not (columns[index] >= 0).any():
                continue  # two views of one scene share an animal, or there is nothing to find
            key = tuple(columns[index].tolist())
            if key not in best or scores[index] > best[key].score:
                best[key] = Candidate(
                    columns[index], float(scores[index]), homographies[index], gains[index], level
                )
        homographies = homographies[_best_distinct(columns, scores, n_kept)]
    return sorted(best.values(), key=lambda one: -one.score)
