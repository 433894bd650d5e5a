"""What the logger keeps, and when the disk lets it: the logger's core, without a file or a clock."""

from lcmtypes import channels

__all__ = ["DISK_LOW_GB", "DISK_STOP_GB", "Selection", "disk_is_full", "disk_trouble"]

DISK_LOW_GB = 1.0  # below it the heartbeat warns
DISK_STOP_GB = 0.2  # below it the log is closed: the drone's other processes need the rest of the disk


class Selection:
    """Which messages are kept, by `log_every` of the channel table; unknown channels are kept."""

    def __init__(self) -> None:
        self._every: dict[str, int] = {}
        self._heard: dict[str, int] = {}

    def keeps(self, channel: str) -> bool:
        """Count one message of `channel` and tell whether it is kept: the first and then each n-th."""
        every = self._every.get(channel)
        if every is None:
            every = self._every[channel] = _log_every(channel)
        heard = self._heard.get(channel, 0)
        self._heard[channel] = heard + 1
        return every > 0 and heard % every == 0


def disk_is_full(free_gb: float) -> bool:
    """The log must be closed now."""
    return free_gb < DISK_STOP_GB


def disk_trouble(free_gb: float) -> str:
    """What to tell people of the space left, "" where there is enough."""
    if disk_is_full(free_gb):
        return (
            f"disk full: {free_gb:.2f} GB left, {DISK_STOP_GB} GB are needed; free some, restart the logger"
        )
    if free_gb < DISK_LOW_GB:
        return f"disk nearly full: {free_gb:.2f} GB left, the log stops below {DISK_STOP_GB} GB; free some"
    return ""


def _log_every(channel: str) -> int:
    """`log_every` of a channel; a neighbour's copy is kept as its original."""
    copy = channels.split_received(channel)
    known = channels.BY_NAME.get(copy[1] if copy else channel)
    return known.log_every if known else 1
