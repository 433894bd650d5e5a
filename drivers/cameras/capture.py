"""Real cameras and recordings: what OpenCV opens (V4L2, GStreamer, RTSP, video), and folders of pictures.

A drone's settings name them: `drivers.cameras.capture:OpenCvCamera`, `drivers.cameras.capture:PictureCamera`.
"""

from itertools import cycle
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["CameraError", "OpenCvCamera", "PictureCamera"]

Image = NDArray[np.uint8]

BACKENDS = {
    "any": cv2.CAP_ANY,
    "v4l2": cv2.CAP_V4L2,
    "gstreamer": cv2.CAP_GSTREAMER,
    "ffmpeg": cv2.CAP_FFMPEG,
}
PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


class CameraError(OSError):
    """A camera or recording cannot be opened; the message names it and the remedy."""


class OpenCvCamera:
    """A camera device ("/dev/video0" or 0), a GStreamer pipeline, an RTSP address or a video file.

    image_size (width, height) px and rate_hz are asked of a device, which may give another size: the camera
    process refuses that by name. loop: a file begins anew at its end.
    """

    def __init__(
        self,
        source: str | int,
        backend: Literal["any", "v4l2", "gstreamer", "ffmpeg"] = "any",
        image_size: tuple[int, int] | None = None,
        rate_hz: float | None = None,
        loop: bool = False,
    ) -> None:
        self._source, self._loop = source, loop
        self._capture = cv2.VideoCapture(source, BACKENDS[backend])
        if not self._capture.isOpened():
            raise CameraError(f"camera {source!r} does not open; is it connected, and may this user read it?")
        # One frame of buffer: a longer queue would show the past.
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if image_size is not None:
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, image_size[0])
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, image_size[1])
        if rate_hz is not None:
            self._capture.set(cv2.CAP_PROP_FPS, rate_hz)

    def capture(self) -> Image | None:
        """The next image, (H, W, 3) uint8 BGR; None where the camera gives none."""
        is_read, image = self._capture.read()
        if not is_read and self._loop:
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
            is_read, image = self._capture.read()
        return np.asarray(image, np.uint8) if is_read else None


class PictureCamera:
    """One picture, or all pictures of a folder by name, again and again."""

    def __init__(self, path: str) -> None:
        folder = Path(path)
        files = sorted(folder.iterdir()) if folder.is_dir() else [folder]
        self._files = [file for file in files if file.suffix.lower() in PICTURES and file.exists()]
        if not self._files:
            raise CameraError(
                f"{path}: no picture there ({', '.join(PICTURES)}); give a picture or a folder of them"
            )
        self._turn = cycle(self._files)

    def capture(self) -> Image | None:
        """The next picture, (H, W, 3) uint8 BGR; None for a file that OpenCV cannot read."""
        image = cv2.imread(str(next(self._turn)), cv2.IMREAD_COLOR)
        return None if image is None else np.asarray(image, np.uint8)
