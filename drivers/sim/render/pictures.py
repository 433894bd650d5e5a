"""A photograph or a video as the world's surface, over which the virtual cameras fly."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose
from drivers.sim.render.scene import AnimalView, Image, SurfaceError

__all__ = ["VIDEO_SUFFIXES", "PictureSurface", "VideoSurface", "open_surface"]

Array = NDArray[np.float64]

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm")
MOST_LEVELS = 5
MATCHES_NEEDED = 20  # fewer matched points than this say nothing about how the camera moved


class PictureSurface:
    """A photograph that covers `width_m` metres from left to right, its middle at `centre_ne`, its top to the
    north.

    Outside the picture lies flat sea of its median colour; nothing is mirrored or repeated, so no animal
    shows twice.
    """

    def __init__(self, image_bgr: Image, width_m: float, centre_ne: tuple[float, float] = (0.0, 0.0)) -> None:
        if (
            image_bgr.ndim != 3
            or image_bgr.shape[2] != 3
            or image_bgr.dtype != np.uint8
            or image_bgr.size == 0
        ):
            raise ValueError(f"the picture is {image_bgr.dtype} {image_bgr.shape}; (H, W, 3) uint8 is needed")
        if not width_m > 0:
            raise ValueError(
                f"width_m {width_m}: must be above 0; it is the width on the ground of the whole picture"
            )
        self.width_m = float(width_m)
        self.centre_ne = centre_ne
        self._set_picture(image_bgr)

    @property
    def metres_per_px(self) -> float:
        """Ground sample distance of the picture."""
        return float(self.width_m / self._levels[0].shape[1])

    def picture_to_ground(self) -> Array:
        """(3, 3) from the picture's pixels (u, v, 1) to ground (n, e, 1) in metres."""
        height, width = self._levels[0].shape[:2]
        scale = self.metres_per_px
        north, east = self.centre_ne
        return np.array(
            [[0, -scale, north + scale * height / 2], [scale, 0, east - scale * width / 2], [0, 0, 1.0]]
        )

    def render(
        self,
        camera: Pinhole,
        pose: Pose,
        t_s: float,
        animals: Sequence[AnimalView] = (),
        out: Image | None = None,
    ) -> Image:
        """The camera's view, (H, W, 3) uint8 BGR. `t_s` and `animals` change nothing: the animals are in the
        picture.
        """
        to_picture = np.linalg.inv(self.picture_to_ground()) @ camera.image_to_ground(pose)
        # Pixel centres lie half a pixel inside, on both sides.
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
        to_picture = np.linalg.inv(half) @ to_picture @ half
        step_px = camera.metres_per_px(pose.height_m) / self.metres_per_px
        level = int(np.clip(np.floor(np.log2(max(step_px, 1.0)) + 0.3), 0, len(self._levels) - 1))
        shrink = np.diag([0.5**level, 0.5**level, 1.0])
        shrink[:2, 2] = 0.5 * 0.5**level - 0.5
        image = cv2.warpPerspective(
            self._levels[level],
            shrink @ to_picture,
            camera.image_size,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=self._median_bgr,
        )
        if out is None:
            return np.asarray(image, np.uint8)
        out[:] = image
        return out

    def _set_picture(self, image_bgr: Image) -> None:
        self._median_bgr = tuple(
            float(value) for value in np.median(image_bgr[::4, ::4].reshape(-1, 3), axis=0)
        )
        self._levels = [image_bgr]
        while len(self._levels) < MOST_LEVELS and min(self._levels[-1].shape[:2]) >= 64:
            smaller = cv2.resize(self._levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            self._levels.append(np.asarray(smaller, np.uint8))


class VideoSurface(PictureSurface):
    """A video, each frame brought into the first one's place, played once from t_s = 0 and then frozen.

    The camera that took it may drift: ORB points matched to the first frame give a homography. Where too few
    match (open water without marks) the previous frame's place is kept.
    """

    def __init__(self, path: Path, width_m: float, centre_ne: tuple[float, float] = (0.0, 0.0)) -> None:
        self._capture = cv2.VideoCapture(str(_existing(path)))
        found, first = self._capture.read()
        if not found:
            raise SurfaceError(f"{path}: no frame could be read; convert it to H.264 MP4 or give a picture")
        super().__init__(np.asarray(first, np.uint8), width_m, centre_ne)
        rate_hz = float(self._capture.get(cv2.CAP_PROP_FPS))
        self._rate_hz = rate_hz if 1.0 <= rate_hz <= 240.0 else 25.0
        self._index = 0
        self._orb = cv2.ORB.create(1500)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self._first_points = self._orb.detectAndCompute(cv2.cvtColor(first, cv2.COLOR_BGR2GRAY), None)
        self._to_first: Array = np.eye(3)

    def render(
        self,
        camera: Pinhole,
        pose: Pose,
        t_s: float,
        animals: Sequence[AnimalView] = (),
        out: Image | None = None,
    ) -> Image:
        """The camera's view of the frame shown at `t_s`; time only runs forward, an earlier `t_s` shows the
        newest.
        """
        self._advance(int(max(t_s, 0.0) * self._rate_hz))
        return super().render(camera, pose, t_s, animals, out)

    def _advance(self, index: int) -> None:
        newest = None
        while self._index < index:
            found, frame = self._capture.read()
            if not found:
                self._index = np.iinfo(np.int64).max  # played out: frozen from here
                break
            newest = frame
            self._index += 1
        if newest is None:
            return
        self._to_first = self._place(np.asarray(newest, np.uint8))
        height, width = newest.shape[:2]
        steady = cv2.warpPerspective(
            newest,
            self._to_first,
            (width, height),
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=self._median_bgr,
        )
        self._set_picture(np.asarray(steady, np.uint8))

    def _place(self, frame: Image) -> Array:
        """(3, 3) from this frame's pixels to the first one's."""
        points, marks = self._orb.detectAndCompute(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), None)
        first_points, first_marks = self._first_points
        if marks is None or first_marks is None:
            return self._to_first
        matches = self._matcher.match(marks, first_marks)
        if len(matches) < MATCHES_NEEDED:
            return self._to_first
        here = np.array([points[match.queryIdx].pt for match in matches])
        there = np.array([first_points[match.trainIdx].pt for match in matches])
        homography, inliers = cv2.findHomography(here, there, cv2.RANSAC, 3.0)
        if homography is None or int(inliers.sum()) < MATCHES_NEEDED:
            return self._to_first
        return np.asarray(homography, float)


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise SurfaceError(f"{path}: no such file; --scene takes a picture or a video")
    return path


def open_surface(
    path: str | Path, width_m: float, centre_ne: tuple[float, float] = (0.0, 0.0)
) -> PictureSurface | VideoSurface:
    """The picture or video at `path` as a surface; SurfaceError names a missing or unreadable file."""
    path = _existing(Path(path))
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return VideoSurface(path, width_m, centre_ne)
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise SurfaceError(f"{path}: not a picture that OpenCV reads; give JPEG, PNG or TIFF, or a video")
    return PictureSurface(np.asarray(image, np.uint8), width_m, centre_ne)
