"""One drone's bus, heard without lcm: datagrams to statistics, and each channel's newest message as bytes."""

import time
from collections.abc import Callable
from typing import Any, Self

from tools.spy.datagrams import STRIDE, Batch, Datagrams
from tools.spy.packets import CHANNEL_START, HEAD_BYTES, SHORT, Fragments
from tools.spy.statistics import WINDOW_US, BusStatistics, ChannelStatistics

__all__ = ["Listener", "decode", "now_us"]

SELF_TEST = "LCM_SELF_TEST"  # what each new LCM says to itself
HEAD = HEAD_BYTES + 48  # of a datagram: its channel, and of the message as much as `seq` needs


def now_us() -> int:
    """The kernel's real-time clock, which stamps arrivals, in us."""
    return time.time_ns() // 1000


def decode(kind: type[Any] | None, data: bytes) -> Any:
    """The message that `data` holds, or the bytes where they are none of `kind`."""
    if kind is None:
        return data
    try:
        return kind.decode(data)
    except Exception:  # bytes from anywhere; a generated decoder raises many kinds
        return data


class Listener:
    """One bus. `wanted`: whether a channel of that name is counted. Raises ValueError and BusError."""

    def __init__(
        self,
        url: str,
        wanted: Callable[[str], bool] = lambda _: True,
        clock: Callable[[], int] = now_us,
        window_us: int = WINDOW_US,
    ) -> None:
        self.url = url
        self._datagrams = Datagrams(url)
        self.statistics = BusStatistics(clock(), window_us)
        self._wanted = wanted
        self._fragments = Fragments()
        self._by_bytes: dict[bytes, ChannelStatistics | None] = {}  # None: not wanted

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    @property
    def n_dropped(self) -> int:
        """Datagrams that came while this process was too slow to take them: they look like gaps."""
        return self._datagrams.n_dropped

    def fileno(self) -> int:
        return self._datagrams.fileno()

    def close(self) -> None:
        self._datagrams.close()

    def drain(self) -> None:
        """Take in all that waits."""
        for batch in self._datagrams.take():
            self._take(batch)

    def newest(self, name: str) -> Any:
        """The newest message of a channel, decoded now; None where nothing was heard."""
        channel = self.statistics.channels.get(name)
        return decode(channel.kind, channel.data) if channel else None

    def _take(self, batch: Batch) -> None:
        """The loop that every message passes: it reads heads, and copies only a batch's newest messages."""
        by_bytes, flat = self._by_bytes, batch.data
        newest: dict[ChannelStatistics, tuple[int, int]] = {}
        start = 0
        for size, time_us in zip(batch.sizes, batch.times_us, strict=True):
            head = bytes(flat[start : start + (size if size < HEAD else HEAD)])
            end = head.find(0, CHANNEL_START)
            if head[:4] == SHORT and end > 0:
                name = head[CHANNEL_START:end]
                channel = by_bytes[name] if name in by_bytes else self._meet(name)
                if channel is not None:
                    channel.hear(time_us, size - end - 1, head[end + 1 :])
                    newest[channel] = (start + end + 1, start + size)
            else:
                self._take_fragment(batch, start, size, time_us)
            start += STRIDE
        for channel, (first, last) in newest.items():
            channel.data = bytes(flat[first:last])
            channel.expire(batch.times_us[-1])

    def _take_fragment(self, batch: Batch, start: int, size: int, time_us: int) -> None:
        rank = start // STRIDE
        sender = bytes(batch.senders[16 * rank : 16 * rank + 8])
        whole = self._fragments.add(sender, bytes(batch.data[start : start + size]))
        if whole is None:
            return
        name, data = whole
        channel = self._by_bytes[name] if name in self._by_bytes else self._meet(name)
        if channel is not None:
            channel.hear(time_us, len(data), data[:HEAD])
            channel.data = data

    def _meet(self, name: bytes) -> ChannelStatistics | None:
        """A channel's first message."""
        text = name.decode("utf-8", "replace")
        is_wanted = text != SELF_TEST and self._wanted(text)
        self._by_bytes[name] = self.statistics.channel(text) if is_wanted else None
        return self._by_bytes[name]
