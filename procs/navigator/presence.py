"""Is a pod in view, and where is its middle: the presence gate and the filtered barycentre (paper,
Scouting).
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

__all__ = ["Barycentre", "PresenceGate"]

Array = NDArray[np.float64]


class PresenceGate:
    """Present when at least `share` of the last `frames` frames had detections; hysteresis on both edges.

    It opens only on a full buffer at `share` and closes only when the share falls below `share` -
    `hysteresis`.
    """

    def __init__(self, frames: int, share: float, hysteresis: float = 0.3) -> None:
        if frames < 1 or not 0 < share <= 1:
            raise ValueError(f"frames {frames} must be at least 1 and share {share} in (0, 1]")
        self.threshold = share
        self.lower = max(share - hysteresis, 0.0)
        self.present = False
        self._seen: deque[bool] = deque(maxlen=frames)

    @property
    def share(self) -> float:
        """Share of the whole buffer that had detections; frames not yet taken count as empty."""
        return sum(self._seen) / (self._seen.maxlen or 1)

    def update(self, seen: bool) -> bool:
        """Take one frame (`seen`: it had boxes) and say whether animals are present."""
        self._seen.append(seen)
        # A billionth guards 0.8 x 15 = 12 frames against rounding.
        threshold = self.lower if self.present else self.threshold
        self.present = self.share >= threshold - 1e-9 and self.share > 0
        return self.present

    def reset(self) -> None:
        self._seen.clear()
        self.present = False


class Barycentre:
    """Low-pass filter of a pod's middle on the ground and of its radius."""

    def __init__(self, gain: float = 0.3, radius_decay: float = 0.98) -> None:
        self.gain = gain
        self.radius_decay = radius_decay
        self.centre_ne: Array | None = None
        self.radius_m = 0.0

    def update(self, points_ne: Array, margin_m: float = 0.0) -> None:
        """Take one frame's animals, (N, 2) on the ground; `margin_m` (half a body) is added to the radius. N
        = 0 changes nothing.
        """
        if len(points_ne) == 0:
            return
        middle = points_ne.mean(axis=0)
        if self.centre_ne is None:
            self.centre_ne = middle
        else:
            self.centre_ne = self.centre_ne + self.gain * (middle - self.centre_ne)
        reach_m = float(np.linalg.norm(points_ne - self.centre_ne, axis=1).max()) + margin_m
        # The radius follows a growth at once and a shrinking slowly: an animal that dives is still of the
        # pod.
        self.radius_m = max(reach_m, self.radius_decay * self.radius_m)

    def start_at(self, centre_ne: Array, radius_m: float) -> None:
        """Begin from a pod that another drone found."""
        self.centre_ne = np.asarray(centre_ne, dtype=np.float64)
        self.radius_m = radius_m

    def reset(self) -> None:
        self.centre_ne = None
        self.radius_m = 0.0
