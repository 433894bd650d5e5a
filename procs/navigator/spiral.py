"""The scout's path: a spiral that grows from the search point (paper, Scouting)."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["spacing_for", "spiral"]

Array = NDArray[np.float64]


def spacing_for(height_m: float, vfov_rad: float, overlap: float = 0.3) -> float:
    """Distance between turns so that the image's short side (its height) covers them with `overlap` (0 to
    below 1).
    """
    if not 0 <= overlap < 1:
        raise ValueError(f"overlap {overlap} must be at least 0 and below 1")
    return 2 * height_m * float(np.tan(vfov_rad / 2)) * (1 - overlap)


def spiral(centre_ne: Array, spacing_m: float, radius_m: float) -> Array:
    """(K, 2) waypoints north, east of an Archimedean spiral round `centre_ne`, turns `spacing_m` apart.

    The first is the centre and the last lies at `radius_m`; neighbours are at most `spacing_m` and a sixth
    of a turn apart. Raises ValueError for a spacing or a radius that is not above 0.
    """
    if not (spacing_m > 0 and radius_m > 0):
        raise ValueError(f"spacing {spacing_m} m and radius {radius_m} m must both be above 0")
    per_radian_m = spacing_m / (2 * np.pi)
    angles = [0.0]
    while per_radian_m * angles[-1] < radius_m:
        reach_m = max(per_radian_m * angles[-1], per_radian_m)
        # 0.95: the chord grows outwards too, and shall stay below the spacing.
        angles.append(angles[-1] + min(np.pi / 3, 0.95 * spacing_m / reach_m))
    theta = np.minimum(np.array(angles), radius_m / per_radian_m)
    offsets = per_radian_m * theta[:, None] * np.column_stack([np.cos(theta), np.sin(theta)])
    return np.asarray(np.asarray(centre_ne, dtype=np.float64) + offsets)
