"""The visual servo: from the tracked animal's pixels to a velocity that keeps it in the middle of the image.

The pixel is projected to the ground with the pose that the drone had when the frame was taken, so that tilt
does not look like motion of the animal; an alpha-beta filter carries place and velocity over gaps.
"""

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from procs.navigator.flight import approach

__all__ = ["AnimalFilter", "ground_points", "servo_velocity"]

Array = NDArray[np.float64]

MIN_HEIGHT_M = 2.0  # below it the ground is too near for a projection
MAX_RANGE_HEIGHTS = (
    3.0  # a pixel that falls further away than this many heights is near the horizon: not believed
)


def ground_points(camera: Pinhole, pose: Pose, pixels: Array) -> Array:
    """(M, 2) north, east of the pixels (N, 2) that show ground; M < N where some lie near or over the
    horizon.
    """
    pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    if pose.height_m < MIN_HEIGHT_M or len(pixels) == 0:
        return np.zeros((0, 2))
    homography = camera.image_to_ground(pose)
    # Over the horizon the homogeneous weight changes its sign from what it is at the nadir.
    weight = pixels @ homography[2, :2] + homography[2, 2]
    nadir = np.append(apply_homography(camera.ground_to_image(pose), np.array([[pose.n_m, pose.e_m]])), 1.0)
    pixels = pixels[weight * float(homography[2] @ nadir) > 0]
    points = apply_homography(homography, pixels)
    near = np.linalg.norm(points - [pose.n_m, pose.e_m], axis=1) <= MAX_RANGE_HEIGHTS * pose.height_m
    return np.asarray(points[near])


class AnimalFilter:
    """Alpha-beta filter of one animal's place and velocity on the ground, in the drone's own NED frame."""

    def __init__(self, max_speed_m_s: float, alpha: float = 0.25, beta: float = 0.02) -> None:
        self.max_speed_m_s = max_speed_m_s
        self.alpha = alpha
        self.beta = beta
        self.ne: Array | None = None
        self.velocity_ne: Array = np.zeros(2)
        self.seen_us = 0

    def update(self, utime: int, point_ne: Array) -> None:
        """Take one sight of the animal, (2,) on the ground, at `utime` us; an older one than the last is
        left out.
        """
        if self.ne is None or (utime - self.seen_us) * 1e-6 > 5.0:
            self.ne, self.velocity_ne, self.seen_us = np.array(point_ne, dtype=np.float64), np.zeros(2), utime
            return
        dt_s = (utime - self.seen_us) * 1e-6
        if dt_s <= 0:
            return
        predicted = self.ne + self.velocity_ne * dt_s
        residual = point_ne - predicted
        self.ne = predicted + self.alpha * residual
        self.velocity_ne = self.velocity_ne + self.beta / dt_s * residual
        speed = float(np.linalg.norm(self.velocity_ne))
        if speed > self.max_speed_m_s:
            self.velocity_ne = self.velocity_ne * (self.max_speed_m_s / speed)
        self.seen_us = utime

    def at(self, utime: int, fade_s: float = 4.0) -> Array | None:
        """(2,) where the animal should be at `utime`; carried on for `fade_s` at most, then it stays
        there.
        """
        if self.ne is None:
            return None
        return self.ne + self.velocity_ne * float(np.clip((utime - self.seen_us) * 1e-6, 0, fade_s))

    def reset(self) -> None:
        self.ne = None
        self.velocity_ne = np.zeros(2)
        self.seen_us = 0


def servo_velocity(
    own_ned: Array, animal_ne: Array, animal_velocity_ne: Array, height_m: float, speed_m_s: float
) -> Array:
    """Velocity (3,) that brings the drone over the animal and keeps it there: its own speed fed forward,
    height held.
    """
    goal = np.array([animal_ne[0], animal_ne[1], -height_m])
    velocity = approach(
        own_ned, goal, speed_m_s, np.array([animal_velocity_ne[0], animal_velocity_ne[1], 0.0])
    )
    speed = float(np.linalg.norm(velocity[:2]))
    if speed > speed_m_s:
        velocity[:2] *= speed_m_s / speed
    return velocity
