"""The play head: when a recorded message is due on the wall clock, through pauses and steps.

No clock of its own: every call is given the time.
"""

__all__ = ["Playhead"]


class Playhead:
    """Maps the log's time (us) onto the wall clock (s). It starts at the first `due_s` that is asked."""

    def __init__(self, speed: float) -> None:
        """speed: seconds of the log a second. Raises ValueError where it is not above 0."""
        if not speed > 0:
            raise ValueError(f"--speed {speed:g}: it must be above 0")
        self.speed = speed
        self.is_paused = False
        self._anchor: tuple[int, float] | None = None  # log time, and the wall time at which it is due

    def due_s(self, at_us: int, now_s: float) -> float:
        """The wall time at which the log's time `at_us` is due."""
        if self._anchor is None:
            self._anchor = (at_us, now_s)
        return self._anchor[1] + (at_us - self._anchor[0]) / 1e6 / self.speed

    def toggle(self, at_us: int, now_s: float) -> None:
        """Pause, or go on from the log's time `at_us` as if no time had passed."""
        self.is_paused = not self.is_paused
        self._anchor = (at_us, now_s)

    def jump(self, at_us: int, now_s: float) -> None:
        """The log's time `at_us` is now: after a step, or at the log's beginning again."""
        self._anchor = (at_us, now_s)

    def position_us(self, now_s: float) -> int | None:
        """Where the head is in the log; None before it started. While paused, where it was paused."""
        if self._anchor is None:
            return None
        if self.is_paused:
            return self._anchor[0]
        return self._anchor[0] + round((now_s - self._anchor[1]) * self.speed * 1e6)
