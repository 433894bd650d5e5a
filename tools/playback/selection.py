"""What of the logs is played: a span of time, some channels, under which names."""

import fnmatch
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from lcmtypes import channels
from logs.exceptions import LogError
from logs.fleet import FleetMessage

__all__ = ["Selection", "parse_renames"]

LONGEST_NAME = 63  # bytes of a channel's name on an LCM bus
# A frame's handle means nothing without the pixels that it named; an image is on no bus.
NEVER_PLAYED = (channels.FRAME, channels.IMAGE)


@dataclass(frozen=True)
class Selection:
    """start_s and end_s count from the first message of all logs; patterns as in a shell (RX_*)."""

    start_s: float = 0.0
    end_s: float | None = None
    only: tuple[str, ...] = ()  # patterns of channels; none: all
    without: tuple[str, ...] = ()  # patterns of channels that are left out
    renames: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.start_s < 0:
            raise LogError(f"--start {self.start_s:g}: it counts from the logs' beginning, at least 0")
        if self.end_s is not None and self.end_s < self.start_s:
            raise LogError(f"--end {self.end_s:g} lies before --start {self.start_s:g}")

    def takes(self, channel: str) -> bool:
        """Whether messages of `channel` are played."""
        wanted = not self.only or any(fnmatch.fnmatchcase(channel, pattern) for pattern in self.only)
        return wanted and not any(fnmatch.fnmatchcase(channel, pattern) for pattern in self.without)

    def name(self, channel: str) -> str:
        """The name under which a channel is played."""
        return self.renames.get(channel, channel)

    def cut(self, messages: Iterable[FleetMessage]) -> Iterator[FleetMessage]:
        """The messages of the span, of every channel; the first of all gives the beginning.

        Raises LogError where the logs end before the span begins.
        """
        begin_us: int | None = None
        at_s = self.start_s
        for entry in messages:
            begin_us = entry.at_us if begin_us is None else begin_us
            at_s = (entry.at_us - begin_us) / 1e6
            if at_s < self.start_s:
                continue
            if self.end_s is not None and at_s > self.end_s:
                return
            yield entry
        if at_s < self.start_s:
            raise LogError(
                f"--start {self.start_s:g}: nothing to play there; the logs end {at_s:.1f} s after their "
                "first message"
            )


def parse_renames(pairs: Sequence[str]) -> dict[str, str]:
    """{"TRACK": "OLD_TRACK"} of ["TRACK=OLD_TRACK"]. Raises LogError for what is no such pair."""
    renames = {}
    for pair in pairs:
        old, _, new = pair.partition("=")
        if not old or not new or len(new.encode()) > LONGEST_NAME:
            raise LogError(
                f"--rename {pair}: write OLD=NEW, with a new name of at most {LONGEST_NAME} bytes, as in "
                f"{channels.TRACK}=OLD_{channels.TRACK}"
            )
        renames[old] = new
    return renames
