"""The replay camera: logged images as a camera's frames again.

A drone's settings name it, `drivers.cameras.replay:ReplayCamera`; podwatch play uses `decode_picture` too.
"""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from numpy.typing import NDArray

from drivers.cameras.capture import CameraError
from lcmtypes import channels
from lcmtypes.podwatch import preview_t

__all__ = ["RAW_FORMAT", "ReplayCamera", "decode_picture"]

Image = NDArray[np.uint8]
RAW_FORMAT = "bgr8"  # preview_t.format of pixels as they are, three bytes each: B G R


def decode_picture(picture: preview_t, image_size: tuple[int, int] | None = None) -> Image | None:
    """A logged picture's pixels, (H, W, 3) uint8 BGR, scaled to `image_size` (width, height) px where that is
    given; None for bytes that are no picture.
    """
    pixels = np.frombuffer(picture.data, np.uint8)
    image: Image | None
    if picture.format == RAW_FORMAT:
        shape = (picture.height, picture.width, 3)
        image = pixels.reshape(shape) if pixels.size == np.prod(shape) else None
    else:
        decoded = cv2.imdecode(pixels, cv2.IMREAD_COLOR) if pixels.size else None
        image = None if decoded is None else np.asarray(decoded, np.uint8)
    if image is None or image_size is None or image.shape[1::-1] == tuple(image_size):
        return image
    return np.asarray(cv2.resize(image, image_size, interpolation=cv2.INTER_LINEAR), np.uint8)


class ReplayCamera:
    """The pictures of one drone's log, each at its own time.

    Each call of `capture` stands for 1 / rate_hz of the log: where no picture is due it gives None, where
    several are it gives the newest. Whole frames (`podwatch sim --log-frames`) are taken where the log has
    them, else the previews, scaled to image_size (width, height) px. loop: begin anew at the end.
    """

    def __init__(
        self, log: str, image_size: tuple[int, int], rate_hz: float = 20.0, loop: bool = False
    ) -> None:
        self._path = Path(log)
        self._image_size = (int(image_size[0]), int(image_size[1]))
        self._period_us = 1e6 / rate_hz
        self._loop = loop
        self._channel = self._best_channel()
        self._pictures: Iterator[preview_t] = iter(())
        self._next: preview_t | None = None
        self._start_us = 0.0
        self._n_calls = 0
        self._restart()

    def capture(self) -> Image | None:
        """The newest picture that is due, (H, W, 3) uint8 BGR; None where there is none."""
        now_us = self._start_us + self._n_calls * self._period_us
        self._n_calls += 1
        due = None
        while self._next is not None and self._next.utime <= now_us:
            due, self._next = self._next, next(self._pictures, None)
        if due is None and self._next is None and self._loop:
            self._restart()
            return self.capture()
        return None if due is None else decode_picture(due, self._image_size)

    def _restart(self) -> None:
        self._pictures = self._read(self._channel)
        self._next = next(self._pictures, None)
        self._start_us = float(self._next.utime) if self._next else 0.0
        self._n_calls = 0

    def _best_channel(self) -> str:
        for channel in (channels.IMAGE, channels.PREVIEW):
            if next(self._read(channel), None) is not None:
                return channel
        raise CameraError(
            f"{self._path}: holds no picture; give a log with previews, or one of podwatch sim --log-frames"
        )

    def _read(self, channel: str) -> Iterator[preview_t]:
        try:
            with self._path.open("rb") as file:
                for _, _, message in make_reader(file).iter_messages(topics=[channel]):
                    yield preview_t.decode(message.data)
        except (McapError, ValueError, EOFError) as error:
            raise CameraError(
                f"{self._path}: does not read as a whole log ({error}); mend it with podwatch log recover"
            ) from error
        except OSError as error:
            raise CameraError(f"{self._path}: cannot be read ({error.strerror})") from error
