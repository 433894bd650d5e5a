"""The likelihood of one pair of views: what it says for, and against, every match under a given transform.

Lengths are in median body sizes of each view, so that the altitude ratio leaves the numbers alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from procs.registrar._marks import Marks

__all__ = ["Pair", "Prior", "apply_homographies", "size_log_ratio", "wrap_angle"]

Array = NDArray[np.float64]

SIZE_SIGMA = 0.11  # of ln(size ratio): 5 % edge jitter in both views and what the ellipse leaves out
SIZE_SPREAD = 0.27  # of ln(size ratio) between two different animals of a pod of 7 to 13 m
SIZE_FLOOR = -6.0  # nats: the most that a size says against a match
AXIS_SIGMA = 0.22  # rad of the doubled axis angle between two sights of one animal
AXIS_OUTLIER = (
    0.06  # share of boxes whose proportions mislead: a turned fluke, a splash, another animal's back
)
FAR_SHARE, FAR_FACTOR = 0.01, 3.0  # share of animals that moved further than the rest, and by how much
BORDER = 0.25  # body sizes over which "inside the other image" fades at its border
# Share of view pairs that look at one place, and how far apart their middles lie then, in image sides.
OVERLAP_SHARE, OVERLAP_STD = 0.5, 0.15
HEADING_OUTLIER = 0.05  # chance that a heading prior is plain wrong
ANGLE_BINS = 60


def wrap_angle(angle: Array | float) -> Array:
    """Radians into [-pi, pi)."""
    return np.asarray((np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi)


def apply_homographies(homographies: Array, points: Array) -> tuple[Array, Array]:
    """(K, 3, 3) on (N, 2) -> points (K, N, 2) and Jacobians (K, N, 2, 2)."""
    flat = points @ homographies[:, :, :2].transpose(0, 2, 1) + homographies[:, None, :, 2]
    depth = flat[:, :, 2:]
    depth = np.where(np.abs(depth) < 1e-6, 1e-6, depth)
    mapped = flat[:, :, :2] / depth
    jacobians = homographies[:, None, :2, :2] - mapped[:, :, :, None] * homographies[:, None, 2:, :2]
    return mapped, jacobians / depth[:, :, :, None]


def size_log_ratio(apart: Array) -> Array:
    """Differences of ln size, any shape -> log-likelihood ratio of one animal against two, same shape."""
    apart2 = apart * apart
    far = np.minimum(apart2, 0.4) / (2 * SIZE_SPREAD**2)
    return np.asarray(
        np.maximum(np.log(SIZE_SPREAD / SIZE_SIGMA) - apart2 / (2 * SIZE_SIGMA**2) + far, SIZE_FLOOR)
    )


@dataclass(frozen=True)
class Prior:
    """What is known of the transform beforehand; every member may be None.

    `rotation_rad` (mean, std) of the turn from source axes to target axes; `log_scale` (mean, std) of
    ln(target length per source length); `position` (mean (2,), std) in target units of where the source's
    `anchor` (2,) comes to lie.
    """

    rotation_rad: tuple[float, float] | None = None
    log_scale: tuple[float, float] | None = None
    position: tuple[Array, float] | None = None
    anchor: Array | None = None


def _axis_vectors(shapes: Array) -> NDArray[np.complex128]:
    """(..., 2, 2) shapes -> the doubled axis angle as complex numbers, of length near 1 for a long body."""
    trace = shapes[..., 0, 0] + shapes[..., 1, 1]
    return np.asarray(((shapes[..., 0, 0] - shapes[..., 1, 1]) + 2j * shapes[..., 0, 1]) / trace)


class Pair:
    """Two sets of marks in body units with everything about them that no transform changes."""

    def __init__(self, source: Marks, target: Marks, prior: Prior) -> None:
        self.source_unit, self.source_origin = float(np.median(source.sizes)), source.centres.mean(axis=0)
        self.target_unit, self.target_origin = float(np.median(target.sizes)), target.centres.mean(axis=0)
        self.source = source.through(_normaliser(self.source_unit, self.source_origin))
        self.target = target.through(_normaliser(self.target_unit, self.target_origin))
        self.prior = self._normalised(prior)
        self.log_size_source, self.log_size_target = np.log(self.source.sizes), np.log(self.target.sizes)
        self.source_axes, self.target_axes = (
            _axis_vectors(self.source.shapes),
            _axis_vectors(self.target.shapes),
        )
        # Two cameras that look at one pod look at about one place; a map says nothing of where a view lies.
        self.views_overlap = source.window is not None and target.window is not None
        self.source_window, self.target_window = _window(self.source), _window(self.target)
        # The smaller of the two covers: where an unmatched box might be in either view.
        self.area = max(min(_polygon_area(self.source_window), _polygon_area(self.target_window)), 4.0)
        known = [np.ones(len(m)) if m.axis_known is None else m.axis_known for m in (source, target)]
        self.axis_weight = known[0][:, None] * known[1][None, :]
        self.axis_table = self._axis_table()

    def _normalised(self, prior: Prior) -> Prior:
        log_scale, position, anchor = prior.log_scale, prior.position, prior.anchor
        if log_scale is not None:
            log_scale = (log_scale[0] + float(np.log(self.source_unit / self.target_unit)), log_scale[1])
        if position is not None and anchor is not None:
            position = ((position[0] - self.target_origin) / self.target_unit, position[1] / self.target_unit)
            anchor = (anchor - self.source_origin) / self.source_unit
        return Prior(prior.rotation_rad, log_scale, position, anchor)

    def denormalised(self, homography: Array) -> Array:
        """(3, 3) in body units -> (3, 3) in the callers' units."""
        back = np.linalg.inv(_normaliser(self.target_unit, self.target_origin))
        full = back @ homography @ _normaliser(self.source_unit, self.source_origin)
        return np.asarray(full / full[2, 2])

    def _axis_table(self) -> Array:
        """(ANGLE_BINS, N1, N2) log-likelihood ratio of the axes at each rotation of the source."""
        half_turns = np.exp(
            2j * np.pi * np.arange(ANGLE_BINS) / ANGLE_BINS
        )  # doubled angles of rotations over pi
        return self.axis_ratio(self.source_axes[None] * half_turns[:, None, None])

    def axis_ratio(self, axes: NDArray[np.complex128]) -> Array:
        """(K, N1, 2) rotated source axes -> (K, N1, N2) log-likelihood ratio of same body against any
        body.
        """
        count, n_source = axes.shape[:2]
        ours, theirs = axes.reshape(-1), self.target_axes.reshape(-1)
        apart = ours.real[:, None] - theirs.real
        apart *= apart
        across = ours.imag[:, None] - theirs.imag
        apart += across * across
        apart = np.minimum(apart[:, 0::2], apart[:, 1::2])
        best = np.minimum(apart[0::2], apart[1::2]).reshape(count, n_source, len(self.target))
        peak = (1 - AXIS_OUTLIER) * 1.25 / AXIS_SIGMA
        ratio = np.log(peak * np.exp(-best / (2 * AXIS_SIGMA**2)) + AXIS_OUTLIER)
        return np.asarray(ratio * self.axis_weight)

    def size_ratio(self, log_sizes: Array) -> Array:
        """(K, N1) ln sizes of the mapped source -> (K, N1, N2) log-likelihood ratio."""
        return size_log_ratio(log_sizes[:, :, None] - self.log_size_target[None, None, :])

    def position_ratio(self, mapped: Array, sigma: Array) -> Array:
        """(K, N1, 2) mapped centres, (K,) sigma in body sizes -> (K, N1, N2) log-likelihood ratio."""
        scale2 = (sigma[:, None] * np.exp(self.log_size_target)[None, :]) ** 2
        east, down = self.target.centres.T
        chi2 = (mapped[:, :, :1] - east) ** 2 + (mapped[:, :, 1:] - down) ** 2
        chi2 /= scale2[:, None, :]
        shape = (1 - FAR_SHARE) * np.exp(-chi2 / 2) + FAR_SHARE / FAR_FACTOR**2 * np.exp(
            -chi2 / (2 * FAR_FACTOR**2)
        )
        return np.asarray(np.log(self.area / (2 * np.pi * scale2))[:, None, :] + np.log(shape + 1e-30))

    def transform_prior(self, homographies: Array) -> Array:
        """(K, 3, 3) -> (K,) log prior of the rotation, the scale, the position, the overlap."""
        total = np.zeros(len(homographies))
        alpha = similarity_part(homographies)
        if self.prior.rotation_rad is not None:
            mean, std = self.prior.rotation_rad
            apart = wrap_angle(np.angle(alpha) - mean)
            total += np.log(
                (1 - HEADING_OUTLIER) * np.exp(-((apart / std) ** 2) / 2) * np.sqrt(2 * np.pi) / std
                + HEADING_OUTLIER
            )
        if self.prior.log_scale is not None:
            mean, std = self.prior.log_scale
            total += np.log(np.exp(-(((np.log(np.abs(alpha)) - mean) / std) ** 2) / 2) + 1e-4)
        if self.prior.position is not None and self.prior.anchor is not None:
            centre, std = self.prior.position
            mapped, _ = apply_homographies(homographies, self.prior.anchor[None])
            chi2 = ((mapped[:, 0] - centre) ** 2).sum(axis=1) / std**2
            total += np.log(np.exp(-chi2 / 2) + 1e-6)
        if self.views_overlap:
            middle = self.source_window.mean(axis=0)[None]
            apart = apply_homographies(homographies, middle)[0][:, 0] - self.target_window.mean(axis=0)
            share2 = (apart**2).sum(axis=1) / _polygon_area(self.target_window)
            near = np.exp(-share2 / (2 * OVERLAP_STD**2)) / (2 * np.pi * OVERLAP_STD**2)
            total += np.log(OVERLAP_SHARE * near + 1 - OVERLAP_SHARE)
        return total

    def insideness(self, homographies: Array, mapped: Array) -> tuple[Array, Array]:
        """How surely each source mark lies in the target's window (K, N1), and each target in the source's
        (K, N2).
        """
        inverse = np.asarray(np.linalg.inv(homographies), dtype=np.float64)
        back, _ = apply_homographies(inverse, self.target.centres)
        return _inside(mapped, self.target_window), _inside(back, self.source_window)


def similarity_part(homographies: Array) -> NDArray[np.complex128]:
    """(K, 3, 3) -> (K,) complex scale and rotation at the origin."""
    h = homographies
    return np.asarray((h[:, 0, 0] + h[:, 1, 1]) / 2 + 1j * (h[:, 1, 0] - h[:, 0, 1]) / 2)


def _normaliser(unit: float, origin: Array) -> Array:
    return np.array([[1 / unit, 0, -origin[0] / unit], [0, 1 / unit, -origin[1] / unit], [0, 0, 1.0]])


def _window(marks: Marks) -> Array:
    """The marks' window, or the upright square about them where nobody gave one: few boxes may lie in a row,
    but no camera sees a strip."""
    if marks.window is not None:
        return marks.window
    low, high = marks.centres.min(axis=0), marks.centres.max(axis=0)
    half = float((high - low).max()) / 2 + 0.3
    return np.asarray(
        (low + high) / 2 + half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    )


def _polygon_area(corners: Array) -> float:
    x, y = corners.T
    return float(abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2)


def _inside(points: Array, polygon: Array) -> Array:
    """(K, N, 2) points -> (K, N) from 0 to 1, by the signed distance to a convex polygon's nearest edge."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    normals = np.column_stack([-edges[:, 1], edges[:, 0]])
    turn = np.sign((edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]) or 1.0)
    normals *= turn / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    depth = (points @ normals.T - (polygon * normals).sum(axis=1)).min(axis=2)
    return np.asarray(1 / (1 + np.exp(-np.clip(depth / BORDER, -30, 30))))
