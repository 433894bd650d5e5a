"""The drone's own clock: CLOCK_MONOTONIC, alike in every process of one boot."""

import time


class MonotonicClock:
    """Microseconds since boot. Drone seconds are real seconds."""

    def utime(self) -> int:
        return time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000

    def real_seconds(self, seconds: float) -> float:
        """How long to wait on this machine for `seconds` of the drone's clock."""
        return seconds

    def late(self, seconds: float) -> None:
        """A timer ran this much too late; a real clock cannot wait for it."""
