"""From a place where the drone wants to be to a velocity that stays inside every limit."""

import numpy as np
from numpy.typing import NDArray

from procs.settings import FENCE_KEPT_M, LimitSettings

__all__ = ["approach", "inside_fence", "limited"]

Array = NDArray[np.float64]

# Velocity per metre of distance: a first-order approach in 1.7 s, slower than the autopilot's own loop
GAIN_PER_S = 0.6
BRAKING_M_S2 = 1.2
ACCELERATION_M_S2 = 2.5


def approach(own_ned: Array, goal_ned: Array, speed_m_s: float, feed_ned: Array | None = None) -> Array:
    """Velocity (3,) towards `goal_ned` that slows down in time to stop there, plus the goal's own velocity
    `feed_ned`.

    The horizontal part keeps to `speed_m_s`; the vertical part is limited later, by `limited`.
    """
    gap = goal_ned - own_ned
    velocity = GAIN_PER_S * gap
    distance_m = float(np.linalg.norm(gap[:2]))
    if distance_m > 0:
        fastest = min(GAIN_PER_S * distance_m, float(np.sqrt(2 * BRAKING_M_S2 * distance_m)), speed_m_s)
        velocity[:2] = gap[:2] / distance_m * fastest
    return velocity if feed_ned is None else velocity + feed_ned


def inside_fence(goal_ned: Array, limits: LimitSettings) -> Array:
    """`goal_ned` (3,) moved to the nearest place inside the fence and between the lowest and the highest
    height.
    """
    goal = np.array(goal_ned, dtype=np.float64)
    reach_m = float(np.linalg.norm(goal[:2]))
    radius_m = max(limits.fence_radius_m - FENCE_KEPT_M, 1.0)
    if reach_m > radius_m:
        goal[:2] *= radius_m / reach_m
    goal[2] = -float(np.clip(-goal[2], limits.min_height_m, limits.max_height_m))
    return goal


def limited(velocity: Array, previous: Array, own_ned: Array, dt_s: float, limits: LimitSettings) -> Array:
    """`velocity` (3,) inside the limits of speed, climb, descent, acceleration, fence and height; (3,).

    `previous` is the velocity that was last asked for, `dt_s` ago. The limits that keep the drone in its
    volume come last: they may brake harder than the acceleration limit.
    """
    change = np.asarray(velocity, dtype=np.float64) - previous
    size = float(np.linalg.norm(change))
    most = ACCELERATION_M_S2 * dt_s
    result = previous + change * (most / size if size > most else 1.0)
    speed = float(np.linalg.norm(result[:2]))
    if speed > limits.speed_m_s:
        result[:2] *= limits.speed_m_s / speed
    height_m = -own_ned[2]
    # Never faster towards the ceiling or the floor than it can still be stopped.
    highest = np.clip(limits.max_height_m - height_m, -limits.descent_m_s, limits.climb_m_s)
    lowest = np.clip(limits.min_height_m - height_m, -limits.descent_m_s, limits.climb_m_s)
    result[2] = -float(np.clip(-result[2], lowest, highest))
    reach_m = float(np.linalg.norm(own_ned[:2]))
    if reach_m > 0:
        outward = own_ned[:2] / reach_m
        left_m = limits.fence_radius_m - 2.0 - reach_m
        excess = float(result[:2] @ outward) - max(
            np.sqrt(2 * BRAKING_M_S2 * left_m) if left_m > 0 else 0.0, 0.0
        )
        if excess > 0:
            result[:2] -= excess * outward
    return result
