"""Pixels between processes: a ring of frames in shared memory, and its counterpart in one process's memory.

A frame_t handle names ring, token and slot; a reader copies the slot and checks the frame's number before and
after, so a frame that was overwritten, or a ring that was made anew, reads as "gone" (None), never as other
pixels.
"""

import mmap
import os
import secrets
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcmtypes.podwatch import frame_t

__all__ = ["MemoryFrames", "SharedFrames"]

Image = NDArray[np.uint8]
SHARED_FOLDER = Path("/dev/shm")
HEADER = struct.Struct("<qqii")  # token, frame number, width, height; one before each slot's pixels
WRITING = -1


class SharedFrames:
    """A drone's frame ring in /dev/shm: the camera writes, detector and tracker read.

    `run` and `drone_id` name it; what an earlier camera of the same run and drone left behind is removed at
    the first write.
    """

    def __init__(self, run: str, drone_id: int, slots: int = 16) -> None:
        self._prefix = f"podwatch_{run}_{drone_id}_"
        self._slots = slots
        self._name = ""
        self._token = 0
        self._map: mmap.mmap | None = None
        self._slot_bytes = 0
        self.n_gone = 0

    def write(self, image: Image, number: int) -> tuple[str, int, int]:
        """Put one (H, W, 3) uint8 image into the ring -> (ring name, token, slot)."""
        height, width = image.shape[:2]
        if self._map is None or self._slot_bytes != HEADER.size + image.size:
            self._create(image.size)
        assert self._map is not None
        slot = number % self._slots
        start = slot * self._slot_bytes
        HEADER.pack_into(self._map, start, self._token, WRITING, width, height)
        pixels = np.frombuffer(self._map, np.uint8, image.size, start + HEADER.size)
        pixels.reshape(image.shape)[...] = image
        HEADER.pack_into(self._map, start, self._token, number, width, height)
        return self._name, self._token, slot

    def read(self, frame: frame_t) -> Image | None:
        """A copy of the pixels of `frame`, or None where they are gone (counted in `n_gone`)."""
        image = self._copy(frame)
        if image is None:
            self.n_gone += 1
        return image

    def close(self) -> None:
        """Remove the ring that this process made."""
        if self._map is not None and self._name.startswith(self._prefix) and self._slot_bytes:
            (SHARED_FOLDER / self._name).unlink(missing_ok=True)

    def _create(self, image_bytes: int) -> None:
        for leftover in SHARED_FOLDER.glob(f"{self._prefix}*"):
            leftover.unlink(missing_ok=True)
        self._token = secrets.randbits(62)
        self._name = f"{self._prefix}{self._token:x}"
        self._slot_bytes = HEADER.size + image_bytes
        descriptor = os.open(SHARED_FOLDER / self._name, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        os.ftruncate(descriptor, self._slot_bytes * self._slots)
        self._map = mmap.mmap(descriptor, self._slot_bytes * self._slots)
        os.close(descriptor)

    def _copy(self, frame: frame_t) -> Image | None:
        size = frame.width * frame.height * 3
        if self._map is None or frame.ring != self._name:
            if not self._attach(frame.ring):
                return None
        assert self._map is not None
        start = frame.slot * (HEADER.size + size)
        if start < 0 or start + HEADER.size + size > len(self._map):
            return None
        wanted = (frame.token, frame.seq, frame.width, frame.height)
        if HEADER.unpack_from(self._map, start) != wanted:
            return None
        image = np.frombuffer(self._map, np.uint8, size, start + HEADER.size).copy()
        if HEADER.unpack_from(self._map, start) != wanted:
            return None
        return image.reshape(frame.height, frame.width, 3)

    def _attach(self, name: str) -> bool:
        """Map the ring of another process; its name must be one of this run and drone."""
        if not name.startswith(self._prefix) or "/" in name:
            return False
        try:
            descriptor = os.open(SHARED_FOLDER / name, os.O_RDONLY)
        except OSError:
            return False
        try:
            self._map = mmap.mmap(descriptor, 0, prot=mmap.PROT_READ)
        except (OSError, ValueError):  # empty: made, not yet sized
            return False
        finally:
            os.close(descriptor)
        self._name = name
        return True


class MemoryFrames:
    """The same ring within one process: writer and readers share one object."""

    def __init__(self, slots: int = 16) -> None:
        self._slots: list[tuple[int, Image] | None] = [None] * slots
        self.n_gone = 0

    def write(self, image: Image, number: int) -> tuple[str, int, int]:
        """Keep one image -> (ring name, token, slot)."""
        slot = number % len(self._slots)
        self._slots[slot] = (number, image)
        return "memory", 0, slot

    def read(self, frame: frame_t) -> Image | None:
        """The pixels of `frame`, or None where they are gone (counted in `n_gone`)."""
        held = self._slots[frame.slot % len(self._slots)]
        if held is None or held[0] != frame.seq:
            self.n_gone += 1
            return None
        return held[1]

    def close(self) -> None:
        """Nothing to remove."""
