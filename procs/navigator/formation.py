"""Places of a fleet in the air: the gathering circle, the layers of heights, and keeping clear of each
other.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["circle_radius", "gather_height", "layer_heights", "separate", "slot"]

Array = NDArray[np.float64]

N_LAYERS = 3
# Share of the height within which the layers lie (docs/navigator.md): boxes of all drones stay alike.
LAYER_SPAN = 0.15
TILT_MARGIN_RAD = np.radians(5.0)
BARRIER_PER_S = 0.7  # how fast a drone may use up the distance that it has left
# A report is carried forward by its velocity for so long at most; then its drone may have turned, or stand.
CARRY_S = 5.0
DRIFT_M_S, DRIFT_MOST_M = 0.2, 4.0  # how the place of a drone grows that is not heard for longer than that
REACH_M = 15.0  # drones further off than the clearance and this are not looked at


def circle_radius(separation_m: float, n: int) -> float:
    """Radius on which n drones stand `separation_m` from their neighbours; 0 for one drone."""
    return 0.0 if n <= 1 else separation_m / (2 * float(np.sin(np.pi / n)))


def gather_height(
    pod_radius_m: float,
    circle_radius_m: float,
    vfov_rad: float,
    lowest_m: float,
    highest_m: float,
    tilt_margin_rad: float = float(TILT_MARGIN_RAD),
) -> float:
    """Height from which every drone of the circle sees the whole pod, clamped to [lowest_m, highest_m]
    (docs/navigator.md).

    The lowest of the circle's layers stands here; the others stand at most 15 % above it, and none above
    highest_m.
    """
    half_rad = vfov_rad / 2 - tilt_margin_rad
    if half_rad <= 0:
        raise ValueError(
            f"field of view {vfov_rad:.3f} rad is too narrow beside {tilt_margin_rad:.3f} rad of tilt"
        )
    wanted_m = (pod_radius_m + circle_radius_m) / float(np.tan(half_rad))
    return float(np.clip(wanted_m, lowest_m, max(highest_m / (1 + LAYER_SPAN), lowest_m)))


def slot(
    rank: int, n: int, centre_ne: Array, separation_m: float, height_m: float, rotation_rad: float = 0.0
) -> Array:
    """(3,) NED place number `rank` of `n` on the circle: at 360 rank/n degrees from north, in its layer."""
    angle = 2 * np.pi * rank / n + rotation_rad
    radius_m = circle_radius(separation_m, n)
    # The last of four, seven, ... stands beside the first: never in its layer.
    number = 1 if rank == n - 1 and n % N_LAYERS == 1 else rank % N_LAYERS
    layer = 1 + LAYER_SPAN * number / (N_LAYERS - 1) if n > 1 else 1.0
    return np.array(
        [centre_ne[0] + radius_m * np.cos(angle), centre_ne[1] + radius_m * np.sin(angle), -height_m * layer]
    )


def layer_heights(n: int, lowest_m: float, highest_m: float, step_m: float = 6.0, most: int = 4) -> Array:
    """(n,) heights by rank: up to `most` layers `step_m` apart from lowest_m, closer together where
    highest_m is near.
    """
    layers = max(1, min(n, most))
    top_m = min(highest_m, lowest_m + step_m * (layers - 1))
    heights = np.linspace(min(lowest_m, top_m), top_m, layers)
    return np.asarray(heights[np.arange(n) % layers])


def separate(
    velocity_ned: Array,
    own_ned: Array,
    others_ned: Array,
    others_velocity_ned: Array,
    ages_s: Array,
    clearance_m: float,
    max_growth_m: float = 4.0,
) -> Array:
    """The velocity nearest to `velocity_ned` (3,) that keeps `clearance_m` from each other drone, in three
    dimensions.

    others_ned, others_velocity_ned: (K, 3) as last heard, `ages_s` (K,) ago. Each place is carried forward
    and its clearance grown by speed x age (at most max_growth_m); after CARRY_S it stays where it is, and
    its clearance grows on, slowly. The closing speed may not exceed 0.7/s of the distance left; what that
    takes away is given back to the right-hand side, so that two drones that meet head on pass each other.
    """
    result = np.array(velocity_ned, dtype=np.float64)
    carried_s = np.minimum(ages_s, CARRY_S)
    predicted_ned = others_ned + others_velocity_ned * carried_s[:, None]
    growth_m = np.minimum(np.linalg.norm(others_velocity_ned, axis=1) * carried_s, max_growth_m)
    growth_m = growth_m + np.minimum(DRIFT_M_S * (ages_s - carried_s), DRIFT_MOST_M)
    others_velocity_ned = np.where((ages_s > CARRY_S)[:, None], 0.0, others_velocity_ned)
    away = own_ned - predicted_ned
    distance_m = np.linalg.norm(away, axis=1)
    # The nearest is looked at last: its word counts most.
    for k in np.argsort(-distance_m, kind="stable"):
        left_m = distance_m[k] - clearance_m - growth_m[k]
        if left_m > REACH_M:
            continue
        # Two drones at one point: the one that would climb, climbs.
        out = away[k] / distance_m[k] if distance_m[k] > 1e-6 else np.array([0.0, 0.0, -1.0])
        short_m_s = float(others_velocity_ned[k] @ out - BARRIER_PER_S * left_m - result @ out)
        if short_m_s <= 0:
            continue
        aside = np.array([out[1], -out[0], 0.0])
        result = result + short_m_s * out + 0.5 * min(short_m_s, 3.0) * aside
    return result
