"""The drone's own clock: CLOCK_MONOTONIC, alike in every process of one boot."""

import time
from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # random(4): drawn anew at each boot


class MonotonicClock:
    """Microseconds since boot. Drone seconds are real seconds.

    boot: the kernel's name for this boot, "" where it gives none.
    """

    def __init__(self) -> None:
        self.boot = BOOT_ID.read_text().strip() if BOOT_ID.exists() else ""

    def utime(self) -> int:
        return time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000

    def real_seconds(self, seconds: float) -> float:
        """How long to wait on this machine for `seconds` of the drone's clock."""
        return seconds

    def late(self, seconds: float) -> None:
        """A timer ran this much too late; a real clock cannot wait for it."""
