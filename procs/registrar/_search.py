"""Where the transform might lie: similarities from pairs of boxes, all scored at once, the best few kept."""

import numpy as np
from numpy.typing import NDArray

from procs.registrar._pair import ANGLE_BINS, Pair, size_log_ratio, wrap_angle

__all__ = ["find_similarities"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

COARSE_SIGMA = (
    0.5  # body sizes: a similarity misses the tilt of two cameras by about this at the image's edge
)
MOST_GAINED = 2.5  # nats that the best size and axis add to a match
LOG_SCALE_GATE = 0.45  # |ln| between the scale of a pair's distance and of its sizes
MAX_SCORED = 500
MAX_KEPT = 48
KEPT_MARGIN = 30.0  # nats


def _complex(points: Array) -> Complex:
    return np.asarray(points[:, 0] + 1j * points[:, 1])


def _angle_bins(alpha: Complex) -> NDArray[np.intp]:
    return np.asarray(np.rint(np.angle(alpha) / np.pi * ANGLE_BINS).astype(np.intp) % ANGLE_BINS)


def _from_pairs(pair: Pair) -> tuple[Complex, Complex, Array]:
    """Similarities that carry two source marks onto two target marks: (H,) scale and turn, (H,) shift, (H,)
    own score.
    """
    zs, zt = _complex(pair.source.centres), _complex(pair.target.centres)
    i, j = np.triu_indices(len(zs), 1)
    k, m = np.nonzero(~np.eye(len(zt), dtype=bool))
    if not len(i) or not len(k):
        return np.zeros(0, complex), np.zeros(0, complex), np.zeros(0)
    apart_source, apart_target = zs[j] - zs[i], zt[m] - zt[k]
    near = np.abs(apart_source) < 1e-6
    alpha = apart_target[None, :] / np.where(near, 1.0, apart_source)[:, None]
    log_scale = np.log(np.maximum(np.abs(alpha), 1e-6))
    first = pair.log_size_target[k][None] - pair.log_size_source[i][:, None] - log_scale
    second = pair.log_size_target[m][None] - pair.log_size_source[j][:, None] - log_scale
    keep = (np.abs(first + second) / 2 < LOG_SCALE_GATE) & ~near[:, None]
    a, b = np.nonzero(keep)
    alpha = alpha[a, b]
    bins = _angle_bins(alpha)
    score = pair.axis_table[bins, i[a], k[b]] + pair.axis_table[bins, j[a], m[b]]
    score -= (first[a, b] ** 2 + second[a, b] ** 2) / (2 * 0.2**2)
    # Beyond a few body sizes a longer base only tells the turn better; a very short one tells nothing.
    score += np.log(np.minimum(np.abs(apart_source[a]), 4.0) + 0.1)
    return alpha, zt[k[b]] - alpha * zs[i[a]], score


def _from_whole_sets(pair: Pair) -> tuple[Complex, Complex]:
    """Turns of the centred and scaled sets, for views that hold the same animals however far each has
    moved.
    """
    zs, zt = _complex(pair.source.centres), _complex(pair.target.centres)
    spread_source, spread_target = np.std(zs), np.std(zt)
    scale = spread_target / spread_source if min(spread_source, spread_target) > 1e-6 else 1.0
    alpha = scale * np.exp(2j * np.pi * np.arange(36) / 36)
    return alpha, zt.mean() - alpha * zs.mean()


def _from_single_marks(pair: Pair) -> tuple[Complex, Complex]:
    """Each source mark laid on each target mark; the turn from the prior or from a coarse fan, the scale
    from sizes.
    """
    zs, zt = _complex(pair.source.centres), _complex(pair.target.centres)
    if pair.prior.rotation_rad is not None:
        mean, std = pair.prior.rotation_rad
        turns = np.exp(1j * (mean + std * np.linspace(-1.5, 1.5, 5)))
    else:
        turns = np.exp(2j * np.pi * np.arange(16) / 16)
    ratio = np.median(pair.log_size_target) - np.median(pair.log_size_source)
    if pair.prior.log_scale is not None:
        ratio = pair.prior.log_scale[0]
    alpha = np.exp(ratio) * np.broadcast_to(turns, (len(zs), len(zt), len(turns)))
    beta = zt[None, :, None] - alpha * zs[:, None, None]
    return alpha.ravel(), beta.ravel()


def _coarse_scores(pair: Pair, alpha: Complex, beta: Complex) -> Array:
    """(H,) sum over the marks of each view of the best log-likelihood ratio that another mark gives it."""
    zs, zt = _complex(pair.source.centres), _complex(pair.target.centres)
    mapped = alpha[:, None] * zs + beta[:, None]
    # Single precision, and the dear terms only for the few pairs that are near enough to gain anything.
    apart = mapped.astype(np.complex64)[:, :, None] - zt.astype(np.complex64)
    chi2 = apart.real**2 + apart.imag**2
    sigma2 = (COARSE_SIGMA * np.exp(pair.log_size_target)) ** 2
    chi2 /= 2 * sigma2.astype(np.float32)
    h, row, column = np.nonzero(chi2 < np.log(pair.area / (2 * np.pi * sigma2.min())) + MOST_GAINED)
    log_scale = np.log(np.maximum(np.abs(alpha), 1e-9))
    gain = np.log(pair.area / (2 * np.pi * sigma2))[column] - chi2[h, row, column]
    gain += pair.axis_table[_angle_bins(alpha)[h], row, column]
    gain += size_log_ratio(pair.log_size_source[row] + log_scale[h] - pair.log_size_target[column])
    ratio = np.zeros(chi2.shape, dtype=np.float32)
    ratio[h, row, column] = np.maximum(gain, 0.0)
    total = ratio.max(axis=2).sum(axis=1, dtype=np.float64) + ratio.max(axis=1).sum(axis=1, dtype=np.float64)
    return np.asarray(total / 2 + pair.transform_prior(_homographies(alpha, beta)))


def _homographies(alpha: Complex, beta: Complex) -> Array:
    result = np.zeros((len(alpha), 3, 3))
    result[:, 0, 0] = result[:, 1, 1] = alpha.real
    result[:, 1, 0], result[:, 0, 1] = alpha.imag, -alpha.imag
    result[:, 0, 2], result[:, 1, 2], result[:, 2, 2] = beta.real, beta.imag, 1.0
    return result


def find_similarities(pair: Pair) -> Array:
    """(K, 3, 3) promising similarities in body units, best first, near copies left out."""
    alpha, beta, score = _from_pairs(pair)
    if pair.prior.rotation_rad is not None and len(alpha):
        mean, std = pair.prior.rotation_rad
        score = score - np.minimum((wrap_angle(np.angle(alpha) - mean) / std) ** 2 / 2, 8.0)
    if len(alpha) > MAX_SCORED:
        best = np.sort(np.argpartition(-score, MAX_SCORED)[:MAX_SCORED])
        alpha, beta = alpha[best], beta[best]
    extra = (
        [_from_single_marks(pair)]
        if min(len(pair.source), len(pair.target)) <= 4 or pair.prior.position
        else []
    )
    if len(pair.source) == len(pair.target) > 1:
        extra.append(_from_whole_sets(pair))
    alpha = np.concatenate([alpha, *[one for one, _ in extra]])
    beta = np.concatenate([beta, *[one for _, one in extra]])
    scores = _coarse_scores(pair, alpha, beta)
    order = np.argsort(-scores, kind="stable")[: 8 * MAX_KEPT]
    order = order[scores[order] > scores[order[0]] - KEPT_MARGIN]
    return _homographies(*_distinct(pair, alpha[order], beta[order]))


def _distinct(pair: Pair, alpha: Complex, beta: Complex) -> tuple[Complex, Complex]:
    """The first MAX_KEPT similarities that are no near copy of one before: under half a body apart at the
    spread's edge.
    """
    spread = max(float(np.abs(_complex(pair.source.centres)).max()), 1.0)
    kept: list[int] = []
    for index in range(len(alpha)):
        if len(kept) == MAX_KEPT:
            break
        apart = np.abs(alpha[kept] - alpha[index]) * spread + np.abs(beta[kept] - beta[index])
        if not kept or float(apart.min()) > 0.6:
            kept.append(index)
    return alpha[kept], beta[kept]
