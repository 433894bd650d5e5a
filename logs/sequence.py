"""Gaps in `seq`: how many messages never arrived, told from the head that every message begins with."""

import struct
from functools import lru_cache
from typing import NamedTuple

from lcmtypes import channels, podwatch
from logs.schemas import fingerprint

__all__ = ["DRONE_ID_OFFSET", "GapCounter", "Head", "read_head"]

HEAD = struct.Struct(">8sqi")  # fingerprint, int64 utime, int32 seq
DRONE_ID_OFFSET = HEAD.size  # int8
PROCESS_OFFSET = DRONE_ID_OFFSET + 1  # of the process's name in a heartbeat, behind int8 drone_id
STRING_LENGTH = struct.Struct(">i")
HEARTBEAT = fingerprint(podwatch.heartbeat_t)


class Head(NamedTuple):
    """The members that every message of the channel table begins with."""

    fingerprint: bytes
    utime: int
    seq: int


def read_head(channel: str, data: bytes) -> Head | None:
    """The head of a message, None where the table has no such channel or the bytes are of another type."""
    if len(data) < HEAD.size or data[:8] != _fingerprint_of(channel):
        return None
    return Head._make(HEAD.unpack_from(data))


@lru_cache(maxsize=4096)  # asked for every message; names on a bus are few, or garbage
def _fingerprint_of(channel: str) -> bytes | None:
    kind = channels.kind_of(channel)
    return fingerprint(kind) if kind else None


class GapCounter:
    """Counts messages missing between one message of a source and the next, by channel.

    A source is a channel, but on HEARTBEAT each process has a counter of its own. `seq` back with `utime`
    forward is a publisher that started anew; with `utime` not forward it is a repeated or overtaken message:
    neither is a gap.
    """

    def __init__(self) -> None:
        self.lost: dict[str, int] = {}  # channel -> messages missing
        self._last: dict[tuple[str, bytes], tuple[int, int]] = {}  # source -> (utime, seq)

    @property
    def n_lost(self) -> int:
        """Messages missing on all channels."""
        return sum(self.lost.values())

    def see(self, channel: str, data: bytes) -> int:
        """Take one message in; returns how many went missing just before it."""
        head = read_head(channel, data)
        if head is None:
            return 0
        source = (channel, _process_name(data) if head.fingerprint == HEARTBEAT else b"")
        last = self._last.get(source)
        if last is not None and head.seq <= last[1] and head.utime <= last[0]:
            return 0
        self._last[source] = (head.utime, head.seq)
        if last is None or head.seq <= last[1]:
            return 0
        missing = head.seq - last[1] - 1
        self.lost[channel] = self.lost.get(channel, 0) + missing
        return missing


def _process_name(heartbeat: bytes) -> bytes:
    """The `process` member of an encoded heartbeat: an LCM string."""
    start = PROCESS_OFFSET + STRING_LENGTH.size
    if len(heartbeat) < start:
        return b""
    (length,) = STRING_LENGTH.unpack_from(heartbeat, PROCESS_OFFSET)
    return heartbeat[start : start + max(length, 0)]
