"""From similarities to homographies and matchings: assignment with a dustbin, then a ridge fit, from wide
to narrow.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import betaln

from procs.registrar._marks import DETECTION_PRICE
from procs.registrar._pair import Pair, apply_homographies, similarity_part

__all__ = ["Candidate", "refine"]

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

# Body sizes. An animal's own motion between two frames and the box's jitter both count; the widest is a pod
# that moved.
SIGMAS = (0.8, 0.4, 0.2, 0.1, 0.06)
SIGMA_PRICES = (12.0, 8.0, 3.0, 0.0, 0.0)  # nats: most views of one instant agree within a tenth of a body
KEPT_AFTER = (10, 8, 6, 4, 4)  # starting points that go on to the next sigma
N_DOUBTED, DOUBTS, LEAST_DOUBTED = 3, 4, 3  # matchings, matches of each, and how many it needs for that
DOUBTED_GAIN = 14.0  # nats; a match that gains more is no chance
DOUBT_LEVELS = (3, 4)  # of SIGMAS
RELIABILITY = (4.0, 0.5)  # of the detector beforehand, as boxes with and without a partner
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
    trace = np.asarray(np.maximum(across + down, 1e-12), dtype=np.float64)
    return trace, np.asarray(((across - down) + 2j * both) / trace)


def _evaluate(pair: Pair, homographies: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Gains (K, N1, N2) of matching over leaving alone, and the prices of leaving alone, (K, N1), (K, N2)."""
    mapped, jacobians = apply_homographies(homographies, pair.source.centres)
    trace, axes = _carried_shapes(jacobians, pair.source.shapes)
    inside_source, inside_target = pair.insideness(homographies, mapped)
    price_source, price_target = inside_source * pair.source.prices, inside_target * pair.target.prices
    gains = pair.position_ratio(mapped, sigma) + pair.axis_ratio(axes)
    gains += pair.size_ratio(np.log(trace.mean(axis=2)) / 2)
    gains += price_source[:, :, None] + price_target[:, None, :]
    return gains, price_source, price_target


def _count_evidence(columns: Ints, price_source: Array, price_target: Array) -> Array:
    """(K,) log evidence of how many boxes found a partner and how many did not, for a detector of unknown
    reliability: the first miss costs the most, for each makes the next more credible. Boxes outside the
    other view count as little as their price says.
    """
    is_source = columns >= 0
    is_target = (columns[:, :, None] == np.arange(price_target.shape[1])).any(axis=1)
    both = np.concatenate([price_source, price_target], axis=1) / DETECTION_PRICE
    is_matched = np.concatenate([is_source, is_target], axis=1)
    matched, alone = np.where(is_matched, both, 0.0).sum(axis=1), np.where(is_matched, 0.0, both).sum(axis=1)
    seen, missed = RELIABILITY
    return np.asarray(betaln(matched + seen, alone + missed) - betaln(seen, missed))


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


class _Found:
    """The matchings that were met, each with its best score."""

    def __init__(self, pair: Pair) -> None:
        self._pair = pair
        self.best: dict[tuple[int, ...], Candidate] = {}

    def settle(self, homographies: Array, columns: Ints, level: int) -> tuple[Array, Ints, Array]:
        """Fit, match anew and note what was found -> homographies (K, 3, 3), columns (K, N1), scores (K,)."""
        pair = self._pair
        sigma = np.full(len(homographies), SIGMAS[level])
        homographies, evidence = _fit(pair, homographies, columns, sigma)
        gains, price_source, price_target = _evaluate(pair, homographies, sigma)
        columns = _assign(gains)
        likelihood = gains - price_source[:, :, None] - price_target[:, None, :]
        kept = np.take_along_axis(likelihood, np.maximum(columns, 0)[:, :, None], axis=2)[:, :, 0]
        scores = np.where(columns >= 0, kept, 0.0).sum(axis=1) + evidence + pair.transform_prior(homographies)
        scores = scores + _count_evidence(columns, price_source, price_target)
        scores = scores - SIGMA_PRICES[level]
        for index in range(len(homographies)):
            if not (columns[index] >= 0).any():
                continue  # two views of one scene share an animal, or there is nothing to find
            key = tuple(columns[index].tolist())
            if key not in self.best or scores[index] > self.best[key].score:
                self.best[key] = Candidate(
                    columns[index], float(scores[index]), homographies[index], gains[index], SIGMAS[level]
                )
        return homographies, columns, scores

    def ordered(self) -> list[Candidate]:
        return sorted(self.best.values(), key=lambda one: -one.score)


def refine(pair: Pair, homographies: Array) -> list[Candidate]:
    """Distinct matchings from starting similarities (K, 3, 3), by falling log evidence."""
    found = _Found(pair)
    for level, n_kept in enumerate(KEPT_AFTER):
        sigma = np.full(len(homographies), SIGMAS[level])
        columns = _assign(_evaluate(pair, homographies, sigma)[0])
        homographies, columns, scores = found.settle(homographies, columns, level)
        homographies = homographies[_best_distinct(columns, scores, n_kept)]
    _without_one(found)
    return found.ordered()


def _without_one(found: _Found) -> None:
    """The best matchings again, each without one of its least likely matches: one false match bends the
    fit towards itself and so hides how ill it suits the others."""
    starts, columns = [], []
    for one in found.ordered()[:N_DOUBTED]:
        rows = np.flatnonzero(one.columns >= 0)
        if len(rows) < LEAST_DOUBTED:
            continue
        gains = one.gains[rows, one.columns[rows]]
        for row in rows[np.argsort(gains, kind="stable")[: min(DOUBTS, (gains < DOUBTED_GAIN).sum())]]:
            starts.append(one.homography)
            columns.append(np.where(np.arange(len(one.columns)) == row, -1, one.columns))
    if not starts:
        return
    for level in DOUBT_LEVELS:
        homographies, again, _ = found.settle(np.array(starts), np.array(columns), level)
        found.settle(homographies, again, level)
