"""What a spy knows of each channel: how often, how evenly, how much, what is missing. Times are arguments.

All times are in us of one clock, that of the arrivals; rates are those of a sliding window.
"""

import math
import struct
from collections import deque

from lcmtypes import channels
from lcmtypes.podwatch import heartbeat_t
from logs.schemas import fingerprint
from logs.sequence import GapCounter, read_head

__all__ = ["WINDOW_US", "BusStatistics", "ChannelStatistics"]

WINDOW_US = 5_000_000
SEQ = struct.Struct(">i")
SLOW_SHARE = 0.5  # a channel below this share of its nominal rate is slow


class ChannelStatistics:
    """One channel. `data`: its newest message as it was said; decode it where it is shown."""

    def __init__(self, name: str, window_us: int = WINDOW_US) -> None:
        self.name = name
        self.kind = channels.kind_of(name)
        self.data = b""
        self.n_messages = 0
        self.last_us = 0
        self.n_lost = 0
        self._window_us = window_us
        # (arrival us, bytes and squared periods up to here): sums over a window are then differences.
        self._recent: deque[tuple[int, int, int]] = deque()
        self._before: tuple[int, int, int] | None = None  # the newest that has left the window
        self._n_bytes = self._squares = 0
        self._fingerprint = fingerprint(self.kind) if self.kind else b""
        self._beats = GapCounter() if self.kind is heartbeat_t else None  # each process counts for itself
        self._last_head = b""  # of the newest message by `seq`
        self._next_seq = -1

    @property
    def nominal_hz(self) -> float:
        """What the channel table expects while a mission runs; 0 where it expects nothing."""
        row = channels.BY_NAME.get(self.name)
        return row.rate_hz if row else 0.0

    def hear(self, arrived_us: int, n_bytes: int, head: bytes = b"") -> None:
        """One message of so many bytes. `head`: the first of them, as many as name a heartbeat's process."""
        period_us = arrived_us - self.last_us if self.n_messages else 0
        self._n_bytes += n_bytes
        self._squares += period_us * period_us
        self._recent.append((arrived_us, self._n_bytes, self._squares))
        self.n_messages += 1
        self.last_us = arrived_us
        # Almost every message is the next one, and costs no more than this look.
        if (
            len(head) >= 20
            and SEQ.unpack_from(head, 16)[0] == self._next_seq
            and head[:8] == self._fingerprint
        ):
            self._last_head = head
            self._next_seq += 1
        else:
            self._see_jump(head)

    def expire(self, now_us: int) -> int:
        """Forget what lies before the window that ends now; the number of messages in it."""
        first_us = now_us - self._window_us
        while self._recent and self._recent[0][0] <= first_us:
            self._before = self._recent.popleft()
        return len(self._recent)

    def rate_hz(self, now_us: int, since_us: int) -> float:
        """Messages a second in the window that ends now; `since_us` is when listening began."""
        return self.expire(now_us) / self._span_s(now_us, since_us)

    def bytes_s(self, now_us: int, since_us: int) -> float:
        """Bytes of messages a second in the window."""
        self.expire(now_us)
        left = self._before[1] if self._before else 0
        return (self._n_bytes - left) / self._span_s(now_us, since_us)

    def jitter_ms(self, now_us: int) -> float | None:
        """Standard deviation of the times from one message to the next in the window.

        None below two such times, and for heartbeats: many processes say them, each at its own instant.
        """
        n_periods = self.expire(now_us) - (self._before is None)
        if n_periods < 2 or self.kind is heartbeat_t:
            return None
        first_us, _, left = self._before or self._recent[0]
        total, squares = self.last_us - first_us, self._squares - left
        return math.sqrt(n_periods * squares - total * total) / n_periods / 1000

    def is_slow(self, now_us: int, since_us: int) -> bool:
        """Whether it says much less than the channel table expects."""
        return self.rate_hz(now_us, since_us) < SLOW_SHARE * self.nominal_hz

    def _see_jump(self, head: bytes) -> None:
        """Count what is missing by the rule of `logs.sequence.GapCounter`, which judges heartbeats itself."""
        if self._beats is not None:
            self.n_lost += self._beats.see(self.name, head)
            return
        now = read_head(self.name, head)
        if now is None:
            return
        last = read_head(self.name, self._last_head)
        if last is not None and now.seq <= last.seq and now.utime <= last.utime:
            return  # repeated, or overtaken
        if last is not None and now.seq > last.seq:
            self.n_lost += now.seq - last.seq - 1
        self._last_head, self._next_seq = head, now.seq + 1

    def _span_s(self, now_us: int, since_us: int) -> float:
        return max(min(now_us - since_us, self._window_us), 1) / 1e6


class BusStatistics:
    """All channels of one bus. `since_us`: when listening began."""

    def __init__(self, since_us: int, window_us: int = WINDOW_US) -> None:
        self.since_us = since_us
        self.channels: dict[str, ChannelStatistics] = {}
        self._window_us = window_us

    def channel(self, name: str) -> ChannelStatistics:
        """The channel of that name, made at its first message."""
        found = self.channels.get(name)
        if found is None:
            found = self.channels[name] = ChannelStatistics(name, self._window_us)
        return found

    def in_order(self) -> list[ChannelStatistics]:
        """Channels as the table has them, then neighbours' copies, then what the table does not know."""
        places = {name: place for place, name in enumerate(channels.BY_NAME)}

        def place(channel: ChannelStatistics) -> tuple[int, int, int, str]:
            copy = channels.split_received(channel.name)
            if copy:
                return 1, copy[0], places[copy[1]], channel.name
            return (0 if channel.name in places else 2), 0, places.get(channel.name, 0), channel.name

        return sorted(self.channels.values(), key=place)
