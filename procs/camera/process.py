"""The camera: takes an image from its driver at the mission's rate and says where its pixels are.

Hears nothing. Says FRAME (a handle; the pixels stay in the frame ring) at camera.rate_hz and PREVIEW (a small
JPEG) at camera.preview_hz. An image of the wrong size or type is dropped, counted and named in the heartbeat;
a camera that gives nothing for a second, or black images, is named too, and the rest of the drone goes on.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from lcmtypes import channels, make
from lcmtypes.podwatch import frame_t, preview_t
from procs.runtime import Runtime

PREVIEW_WIDTH_PX = 320
PREVIEW_QUALITY = 70  # JPEG, of 100
SILENT_AFTER_S = 1.0
BLACK_BELOW = 8  # of 255, the brightest value of an image with nothing to see
CHECK_STEP_PX = 16  # every 16th pixel is enough to tell black


class Camera:
    """Captures, checks and numbers frames."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._driver = runtime.open("camera")
        self._frames = runtime.open("frames")
        settings = runtime.settings.mission.camera
        self._shape = (settings.height_px, settings.width_px, 3)
        self._number = 0
        self._image: NDArray[np.uint8] | None = None
        self._given_utime = runtime.utime  # when the driver gave its last image, good or bad
        self._last_utime = runtime.utime
        self._n_refused = 0
        self._previewed = -1

    def capture(self) -> None:
        """Take one image and say its handle."""
        runtime = self._runtime
        try:
            image = self._driver.capture()
            runtime.ok("driver")
        except OSError as error:
            runtime.degraded(f"the camera fails: {error}; is it connected?", cause="driver")
            image = None
        if image is None:
            silent_s = (runtime.utime - self._given_utime) / 1e6
            if silent_s > SILENT_AFTER_S:
                runtime.degraded(f"no image for {silent_s:.1f} s; is the camera connected?", cause="silent")
            return
        self._given_utime = runtime.utime
        runtime.ok("silent")
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != self._shape:
            self._n_refused += 1
            runtime.degraded(
                f"the camera gave {_kind_of(image)}, the mission wants {_size_of(self._shape)} uint8; "
                f"{self._n_refused} dropped; set [camera] width_px and height_px to what it gives",
                cause="shape",
            )
            return
        runtime.ok("shape")
        if int(image[::CHECK_STEP_PX, ::CHECK_STEP_PX].max()) < BLACK_BELOW:
            runtime.degraded("black images; is the lens covered?", cause="black")
        else:
            runtime.ok("black")
        self._last_utime = runtime.utime
        self._image = image
        ring, token, slot = self._frames.write(image, self._number)
        height, width = self._shape[:2]
        runtime.publish(
            channels.FRAME, make(frame_t, ring=ring, token=token, slot=slot, width=width, height=height)
        )
        self._number += 1

    def preview(self) -> None:
        """Say a small JPEG of the newest frame."""
        if self._image is None or self._previewed == self._number:
            return
        self._previewed = self._number
        scale = PREVIEW_WIDTH_PX / self._shape[1]
        size = (PREVIEW_WIDTH_PX, round(self._shape[0] * scale))
        small = cv2.resize(self._image, size, interpolation=cv2.INTER_AREA)
        _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, PREVIEW_QUALITY])
        data = encoded.tobytes()
        self._runtime.publish(
            channels.PREVIEW,
            make(
                preview_t,
                utime=self._last_utime,
                frame_seq=self._number - 1,
                width=size[0],
                height=size[1],
                scale=scale,
                format="jpeg",
                n_bytes=len(data),
                data=data,
            ),
        )

    def close(self) -> None:
        """Give the frame ring back."""
        self._frames.close()


def _size_of(shape: tuple[int, ...]) -> str:
    """ "640x480" of (480, 640, 3), else the shape as it is."""
    return f"{shape[1]}x{shape[0]}" if len(shape) == 3 and shape[2] == 3 else f"an array of {shape}"


def _kind_of(image: object) -> str:
    """What a driver gave, for people."""
    if isinstance(image, np.ndarray):
        return f"{_size_of(image.shape)} {image.dtype}"
    return f"a {type(image).__name__}"


def setup(runtime: Runtime) -> None:
    cv2.setNumThreads(1)
    settings = runtime.settings.mission.camera
    camera = Camera(runtime)
    runtime.every(1 / settings.rate_hz, camera.capture)
    runtime.every(1 / settings.preview_hz, camera.preview)
    runtime.on_stop(camera.close)
