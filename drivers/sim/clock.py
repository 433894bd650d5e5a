"""One simulation clock for every process of a run: a page of shared memory that says how simulation time
follows real time.

The world owns the page. When processes fall behind it slows the clock instead of letting setpoints die;
nobody else notices.
"""

import mmap
import os
import struct
import time
from pathlib import Path

__all__ = ["ClockPage", "SimClock"]

PAGE_BYTES = 64
MAPPING = struct.Struct(
    "<qdqd"
)  # version (odd while written), simulation us at ..., ... this real time in ns, rate
LATE_OFFSET = 48
LATE = struct.Struct(
    "<d"
)  # the worst lateness in seconds that any process has told since the world last looked


class ClockPage:
    """The shared page: simulation time = sim_us + (real time - real_ns) * rate."""

    def __init__(self, path: Path, *, create: bool = False) -> None:
        flags = os.O_RDWR | (os.O_CREAT | os.O_EXCL if create else 0)
        descriptor = os.open(path, flags, 0o600)
        if create:
            os.ftruncate(descriptor, PAGE_BYTES)
        self._map = mmap.mmap(descriptor, PAGE_BYTES)
        os.close(descriptor)
        if create:
            self.set(0.0, 0.0)

    def set(self, sim_us: float, rate: float) -> None:
        """From now on simulation time runs from `sim_us` at `rate` (0 stands still)."""
        version = MAPPING.unpack_from(self._map, 0)[0] + 2
        now_ns = time.monotonic_ns()
        MAPPING.pack_into(self._map, 0, version - 1, sim_us, now_ns, rate)
        MAPPING.pack_into(self._map, 0, version, sim_us, now_ns, rate)

    def read(self) -> tuple[float, float]:
        """(simulation time now in us, rate)."""
        while True:
            version, sim_us, real_ns, rate = MAPPING.unpack_from(self._map, 0)
            if version % 2 == 0 and MAPPING.unpack_from(self._map, 0)[0] == version:
                return sim_us + (time.monotonic_ns() - real_ns) / 1000 * rate, rate

    def tell_late(self, seconds: float) -> None:
        """A process was this late; the worst is kept until the world looks."""
        if seconds > LATE.unpack_from(self._map, LATE_OFFSET)[0]:
            LATE.pack_into(self._map, LATE_OFFSET, seconds)

    def take_late(self) -> float:
        """The worst lateness since the last call, s."""
        (late_s,) = LATE.unpack_from(self._map, LATE_OFFSET)
        LATE.pack_into(self._map, LATE_OFFSET, 0.0)
        return float(late_s)


class SimClock:
    """One drone's clock on the simulation's time, with its own offset and drift."""

    STANDING_S = 0.5  # how long to wait before looking again while the clock stands still

    def __init__(self, page: str, offset_us: int = 0, drift_ppm: float = 0.0) -> None:
        self._page = ClockPage(Path(page))
        self._offset_us = offset_us
        self._scale = 1 + drift_ppm * 1e-6

    def utime(self) -> int:
        return round(self._offset_us + self._page.read()[0] * self._scale)

    def real_seconds(self, seconds: float) -> float:
        """How long to wait on this machine for `seconds` of the drone's clock."""
        rate = self._page.read()[1]
        return seconds / self._scale / rate if rate > 0 else self.STANDING_S

    def late(self, seconds: float) -> None:
        """Tell the world that a timer ran too late."""
        self._page.tell_late(seconds)
