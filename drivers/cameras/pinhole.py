"""The pinhole camera under a drone: pixels to ground metres and back.

The camera looks straight down the body's z axis; the top of the image is the drone's nose. Pixels are
(u right, v down) from the top-left corner; the ground is the plane d = 0 of a local NED frame; angles are
aerospace roll, pitch, yaw.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Pinhole", "Pose", "apply_homography", "body_to_ned", "inverse"]

Array = NDArray[np.float64]

# Camera axes (right, down in the image, forward along the optical axis) in body axes (front, right, down).
CAMERA_TO_BODY = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Pose:
    """Where a drone is: NED metres in a local frame (d is minus the height above the surface), radians."""

    n_m: float
    e_m: float
    d_m: float
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0

    @property
    def height_m(self) -> float:
        return -self.d_m

    @property
    def tilt_rad(self) -> float:
        """Angle between the optical axis and the vertical."""
        return float(np.arccos(np.cos(self.roll_rad) * np.cos(self.pitch_rad)))


def body_to_ned(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """(3, 3) rotation from body FRD to local NED, in the aerospace order yaw, pitch, roll."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


@dataclass(frozen=True)
class Pinhole:
    """An ideal camera: `image_size` (width, height) px and the vertical field of view in radians."""

    image_size: tuple[int, int]
    vfov_rad: float

    @property
    def focal_px(self) -> float:
        return float(self.image_size[1] / 2 / np.tan(self.vfov_rad / 2))

    @property
    def intrinsics(self) -> Array:
        """(3, 3) matrix K from camera axes to homogeneous pixels."""
        width, height = self.image_size
        return np.array([[self.focal_px, 0, width / 2], [0, self.focal_px, height / 2], [0, 0, 1.0]])

    def ground_to_image(self, pose: Pose) -> Array:
        """(3, 3) homography from ground (n, e, 1) in metres to pixels (u, v, 1)."""
        to_camera = (body_to_ned(pose.roll_rad, pose.pitch_rad, pose.yaw_rad) @ CAMERA_TO_BODY).T
        # A ground point (n, e, 0) minus the camera's position, as a linear function of (n, e, 1).
        from_camera = np.array([[1.0, 0, -pose.n_m], [0, 1.0, -pose.e_m], [0, 0, -pose.d_m]])
        return np.asarray(self.intrinsics @ to_camera @ from_camera, dtype=np.float64)

    def image_to_ground(self, pose: Pose) -> Array:
        """(3, 3) homography from pixels (u, v, 1) to ground (n, e, 1) in metres.

        Raises ValueError when the camera is not above the surface: no ground is in view then.
        """
        if pose.height_m <= 0:
            raise ValueError(f"height {pose.height_m:.2f} m: a camera sees the ground only from above it")
        return inverse(self.ground_to_image(pose))

    def metres_per_px(self, height_m: float) -> float:
        """Ground sample distance at the nadir."""
        return height_m / self.focal_px


def inverse(homography: Array) -> Array:
    """(3, 3) the way back. Raises numpy.linalg.LinAlgError for a homography that has none."""
    return np.asarray(np.linalg.inv(homography), dtype=np.float64)


def apply_homography(homography: Array, points: Array) -> Array:
    """(N, 2) points through a (3, 3) homography -> (N, 2)."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:3])
