"""LCM's messages in UDP datagrams ("LCM UDP Multicast Protocol Description", lcm 1.5.3).

short        "LC02", number 4, channel, 0, message
fragment     "LC03", number 4, message bytes 4, offset 4, fragment 2, of 2; the first begins with channel, 0
"""

import struct
from collections import OrderedDict
from dataclasses import dataclass, field

__all__ = ["CHANNEL_START", "HEAD_BYTES", "SHORT", "Fragments"]

SHORT, FRAGMENT = b"LC02", b"LC03"
FRAGMENT_HEAD = struct.Struct(">4sIIIHH")
LONGEST_CHANNEL = 63
CHANNEL_START = 8  # of a short message's datagram
HEAD_BYTES = CHANNEL_START + LONGEST_CHANNEL + 1
LARGEST_MESSAGE = 1 << 28  # as lcm
MOST_HALF = 16  # messages under way at once; the oldest is given up, its fragments were lost


@dataclass
class _Half:
    """A message of which fragments are still missing."""

    n_missing: int
    data: bytearray
    channel: bytes = b""
    seen: set[int] = field(default_factory=set)


class Fragments:
    """Puts long messages together again."""

    def __init__(self) -> None:
        self._halves: OrderedDict[tuple[bytes, int], _Half] = OrderedDict()

    def add(self, sender: bytes, datagram: bytes) -> tuple[bytes, bytes] | None:
        """(channel, message) once its last fragment has come, else None; what is malformed is dropped."""
        if len(datagram) < FRAGMENT_HEAD.size or not datagram.startswith(FRAGMENT):
            return None
        _, number, n_bytes, offset, index, n_fragments = FRAGMENT_HEAD.unpack_from(datagram)
        body = datagram[FRAGMENT_HEAD.size :]
        channel = b""
        if index == 0:
            channel, _, body = body.partition(b"\0")
        if n_bytes > LARGEST_MESSAGE or offset + len(body) > n_bytes or index >= n_fragments:
            return None
        half = self._half((sender, number), n_bytes, n_fragments)
        if half is None or index in half.seen:
            return None
        half.seen.add(index)
        half.data[offset : offset + len(body)] = body
        half.channel = channel or half.channel
        half.n_missing -= 1
        if half.n_missing:
            return None
        del self._halves[sender, number]
        return half.channel, bytes(half.data)

    def _half(self, key: tuple[bytes, int], n_bytes: int, n_fragments: int) -> _Half | None:
        half = self._halves.get(key)
        if half is None:
            half = self._halves[key] = _Half(n_fragments, bytearray(n_bytes))
            if len(self._halves) > MOST_HALF:
                self._halves.popitem(last=False)
        return half if len(half.data) == n_bytes else None
