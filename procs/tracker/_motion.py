"""Where the animal goes in the picture: an alpha-beta filter that rides on the camera's own motion."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from procs.tracker._body import jacobian_at, project

__all__ = ["Motion"]

Array = NDArray[np.float64]

ALPHA = 0.7  # trust in a sight's place: masks are steadier than whales
BETA = 0.25  # of the innovation a frame, into the velocity
COAST_S = 0.8  # unseen, the velocity dies with this time constant: animals turn, and a wrong guess runs away
HISTORY_S = 1.0  # detections come at most this late


class Motion:
    """Centre (2,) px and velocity (2,) px/s of one animal in the image, and a second of its past."""

    def __init__(self, centre: Array) -> None:
        self.centre = centre.copy()
        self.velocity_px_s = np.zeros(2)
        # Oldest first: age s, the centre in its own frame, the homography from that frame to the newest one.
        self._past: deque[tuple[float, Array, Array]] = deque([(0.0, self.centre, np.eye(3))])

    def predict(self, dt_s: float, image_motion: Array | None, seen: bool) -> None:
        """Go on by `dt_s`; `image_motion` (3, 3) is the picture's own motion since the frame before."""
        if image_motion is not None:
            self.velocity_px_s = jacobian_at(image_motion, self.centre) @ self.velocity_px_s
            self.centre = project(image_motion, self.centre)
        if not seen:
            self.velocity_px_s = self.velocity_px_s * np.exp(-dt_s / COAST_S)
        self.centre = self.centre + self.velocity_px_s * dt_s
        step = np.eye(3) if image_motion is None else image_motion
        aged = ((age + dt_s, centre, step @ since) for age, centre, since in self._past)
        self._past = deque(row for row in aged if row[0] <= HISTORY_S)

    def correct(self, measured: Array, dt_s: float) -> None:
        """Take in where the animal was seen, `dt_s` after the last prediction began."""
        innovation = measured - self.centre
        self.centre = self.centre + ALPHA * innovation
        self.velocity_px_s = self.velocity_px_s + BETA / dt_s * innovation

    def jump(self, centre: Array) -> None:
        """The animal is elsewhere: the past and the velocity no longer hold."""
        self.centre, self.velocity_px_s = centre.copy(), np.zeros(2)
        self._past.clear()

    def remember(self) -> None:
        """Close this frame: boxes of it may come later."""
        self._past.append((0.0, self.centre.copy(), np.eye(3)))

    def carried(self, box: Array, age_s: float) -> Array:
        """(4,) box seen `age_s` ago, as it lies now: moved with the camera and with the animal since then."""
        if not self._past or age_s <= 0:
            return box
        _, centre, since = min(self._past, key=lambda row: abs(row[0] - age_s))
        corners = np.array([project(since, box[[i, j]]) for i, j in ((0, 1), (2, 1), (2, 3), (0, 3))])
        own_step = self.centre - project(since, centre)
        return np.concatenate([corners.min(axis=0) + own_step, corners.max(axis=0) + own_step])
