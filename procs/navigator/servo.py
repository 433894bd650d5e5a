"""The visual servo: from the tracked animal's pixels to a velocity that keeps it in the middle of the image.

The pixel is projected to the ground with the pose that the drone had when the frame was taken, so that tilt
does not look like motion of the animal; an alpha-beta filter carries place and velocity over gaps.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from procs.navigator.flight import approach

__all__ = ["AnimalFilter", "PoseHistory", "ground_points", "servo_velocity"]

Array = NDArray[np.float64]

MIN_HEIGHT_M = 2.0  # below it the ground is too near for a projection
MAX_RANGE_HEIGHTS = (
    3.0  # a pixel that falls further away than this many heights is near the horizon: not believed
)


class PoseHistory:
    """The drone's poses of the last seconds, so that a frame is projected with the pose of its own
    instant.
    """

    def __init__(self, keep: int = 60) -> None:
        self._times_us: deque[int] = deque(maxlen=keep)
        self._poses: deque[Array] = deque(maxlen=keep)

    def add(self, utime: int, ned: Array, roll_pitch_yaw: Array) -> None:
        """Take a pose; one that is not newer than the newest is left out."""
        if self._times_us and utime <= self._times_us[-1]:
            return
        self._times_us.append(utime)
        self._poses.append(np.concatenate([ned, roll_pitch_yaw]))

    def at(self, utime: int, max_gap_s: float = 0.5) -> Pose | None:
        """The pose at `utime`, interpolated; None when no pose lies within `max_gap_s`."""
        if not self._times_us:
            return None
        times = np.array(self._times_us, dtype=np.float64)
        if np.abs(times - utime).min() > max_gap_s * 1e6:
            return None
        after = int(np.clip(np.searchsorted(times, utime), 1, len(times) - 1)) if len(times) > 1 else 0
        if after == 0:
            return Pose(*(float(value) for value in self._poses[0]))
        share = float(np.clip((utime - times[after - 1]) / (times[after] - times[after - 1]), 0, 1))
        before, later = self._poses[after - 1], self._poses[after]
        step = later - before
        step[3:] = (step[3:] + np.pi) % (2 * np.pi) - np.pi
        return Pose(*(float(value) for value in before + share * step))


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
