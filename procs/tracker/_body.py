"""The animal's shape prior: an ellipse with a long axis, in pixels.

Whales from above are long ovals: 19-point outlines of 638 right whales fill about the ellipse of their own
second moments. Two numbers for size and one for direction hold a mask together where a free contour would
flood.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

__all__ = ["Body", "body_of_box", "body_of_weights"]

Array = NDArray[np.float64]
MIN_WIDTH_PX = 2.0


@dataclass(frozen=True)
class Body:
    """An ellipse: centre (2,) px, full length and width px, angle of the long axis from +u towards +v,
    radians.
    """

    centre: Array
    length_px: float
    width_px: float
    angle_rad: float

    @property
    def area_px(self) -> float:
        return float(np.pi / 4 * self.length_px * self.width_px)

    @property
    def box(self) -> Array:
        """(4,) left, top, right, bottom of the ellipse."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        half = 0.5 * np.hypot(
            [self.length_px * c, self.length_px * s], [self.width_px * s, self.width_px * c]
        )
        return np.concatenate([self.centre - half, self.centre + half])

    def radius(self, size: tuple[int, int], stride: int = 1) -> NDArray[np.float32]:
        """(height, width) normalised radius at the pixels of a picture of `size` (width, height): 1 on the
        outline.
        """
        u = (np.arange(0, size[0], stride) + 0.5 * stride - self.centre[0]).astype(np.float32)
        v = (np.arange(0, size[1], stride) + 0.5 * stride - self.centre[1]).astype(np.float32)[:, None]
        c, s = np.float32(np.cos(self.angle_rad)), np.float32(np.sin(self.angle_rad))
        along = (u * c + v * s) * np.float32(2 / self.length_px)
        across = (v * c - u * s) * np.float32(2 / self.width_px)
        return np.asarray(np.sqrt(along * along + across * across), dtype=np.float32)

    def scaled(self, factor: float) -> "Body":
        """The same place and direction, other size."""
        return replace(self, length_px=self.length_px * factor, width_px=self.width_px * factor)

    def through(self, homography: Array) -> "Body":
        """The body after the picture moved by a (3, 3) homography, to first order round its centre."""
        jacobian = jacobian_at(homography, self.centre)
        axis = jacobian @ np.array([np.cos(self.angle_rad), np.sin(self.angle_rad)])
        growth = float(np.sqrt(abs(np.linalg.det(jacobian))))
        return Body(
            project(homography, self.centre),
            self.length_px * growth,
            self.width_px * growth,
            float(np.arctan2(axis[1], axis[0])),
        )


def project(homography: Array, point: Array) -> Array:
    """(2,) point through a (3, 3) homography."""
    mapped = homography[:, :2] @ point + homography[:, 2]
    return np.asarray(mapped[:2] / mapped[2])


def jacobian_at(homography: Array, point: Array) -> Array:
    """(2, 2) derivative of the homography at a point: how a small arrow there is turned and stretched."""
    depth = homography[2, :2] @ point + homography[2, 2]
    return np.asarray((homography[:2, :2] - np.outer(project(homography, point), homography[2, :2])) / depth)


def body_of_box(box: Array) -> Body:
    """The ellipse inscribed in a (4,) box: what a box alone says."""
    size = box[2:] - box[:2]
    long_side, short_side = float(max(size)), float(max(min(size), MIN_WIDTH_PX))
    return Body((box[:2] + box[2:]) / 2, long_side, short_side, 0.0 if size[0] >= size[1] else np.pi / 2)


def body_of_weights(weights: NDArray[np.float32], near_angle_rad: float = 0.0) -> Body | None:
    """The ellipse with the second moments of a (height, width) weight map; None where the weights vanish.

    A direction is known modulo pi only: the one nearer `near_angle_rad` is given.
    """
    columns = weights.sum(axis=0, dtype=np.float64)
    rows = weights.sum(axis=1, dtype=np.float64)
    total = float(columns.sum())
    if total < 1.0:
        return None
    u = np.arange(weights.shape[1]) + 0.5
    v = np.arange(weights.shape[0]) + 0.5
    mean_u, mean_v = float(columns @ u) / total, float(rows @ v) / total
    var_u = float(columns @ (u - mean_u) ** 2) / total
    var_v = float(rows @ (v - mean_v) ** 2) / total
    cov = float((v - mean_v) @ (weights @ (u - mean_u).astype(np.float32))) / total
    spread = np.hypot(var_u - var_v, 2 * cov)
    major, minor = (var_u + var_v + spread) / 2, max((var_u + var_v - spread) / 2, 0.0)
    angle = 0.5 * np.arctan2(2 * cov, var_u - var_v)
    angle += np.pi * np.round((near_angle_rad - angle) / np.pi)
    # A full ellipse of length a has variance a^2 / 16 along it.
    length, width = 4 * np.sqrt(major), max(4 * np.sqrt(minor), MIN_WIDTH_PX)
    return Body(np.array([mean_u, mean_v]), float(max(length, width)), float(width), float(angle))
