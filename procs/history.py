"""What a process remembers of the vehicle: its pose at the instant when a frame was taken, not when it was
handled.
"""

from bisect import bisect_left
from collections import deque

import numpy as np

from drivers.cameras.pinhole import Pinhole, Pose
from lcmtypes.podwatch import vehicle_state_t
from procs.settings import CameraSettings

__all__ = ["PoseHistory", "camera_of"]

KEEP_US = 9_000_000
REACH_US = 500_000  # beyond this from the nearest state, the pose is unknown


def camera_of(settings: CameraSettings) -> Pinhole:
    """The mission's camera."""
    return Pinhole((settings.width_px, settings.height_px), float(np.radians(settings.vfov_deg)))


class PoseHistory:
    """The vehicle's states of the last seconds, interpolated between them."""

    def __init__(self) -> None:
        self._utimes: deque[int] = deque()
        self._poses: deque[Pose] = deque()

    def add(self, state: vehicle_state_t) -> None:
        """Remember one state; one without a position, or older than the last, is passed over."""
        if not state.position_ok or (self._utimes and state.utime <= self._utimes[-1]):
            return
        self._utimes.append(state.utime)
        self._poses.append(
            Pose(state.n_m, state.e_m, state.d_m, state.roll_rad, state.pitch_rad, state.yaw_rad)
        )
        while self._utimes[0] < state.utime - KEEP_US:
            self._utimes.popleft()
            self._poses.popleft()

    def at(self, utime: int) -> Pose | None:
        """The pose at `utime` (us, drone clock); None where no state lies within half a second."""
        if not self._utimes:
            return None
        after = bisect_left(self._utimes, utime)
        if after == 0 or after == len(self._utimes):
            nearest = min(after, len(self._utimes) - 1)
            return self._poses[nearest] if abs(self._utimes[nearest] - utime) <= REACH_US else None
        early, late = self._utimes[after - 1], self._utimes[after]
        if min(utime - early, late - utime) > REACH_US:
            return None
        return _between(self._poses[after - 1], self._poses[after], (utime - early) / (late - early))


def _between(first: Pose, second: Pose, share: float) -> Pose:
    """Linear in position and tilt, the short way round in heading."""
    turn_rad = float(np.angle(np.exp(1j * (second.yaw_rad - first.yaw_rad))))
    return Pose(
        first.n_m + share * (second.n_m - first.n_m),
        first.e_m + share * (second.e_m - first.e_m),
        first.d_m + share * (second.d_m - first.d_m),
        first.roll_rad + share * (second.roll_rad - first.roll_rad),
        first.pitch_rad + share * (second.pitch_rad - first.pitch_rad),
        first.yaw_rad + share * turn_rad,
    )
