"""What one link may send: a cap on bytes in any second, and of each channel only the newest message, while
it is fresh.

The relay's own datagrams (ages, clocks, fleet table) go first: messages leave room for what those will
need within the second.
"""

from collections import deque
from dataclasses import dataclass

from lcmtypes.channels import Channel

__all__ = ["ByteWindow", "Message", "MessageQueue"]

SECOND_US = 1_000_000


class ByteWindow:
    """At most `bytes_per_s` in every window of one second, of which the relay's own datagrams may always
    take `reserved`."""

    def __init__(self, bytes_per_s: int, reserved: int) -> None:
        self.bytes_per_s = bytes_per_s
        self.reserved = reserved
        self._sent: deque[tuple[int, int, bool]] = deque()  # when, bytes, whether it was a message
        self._total = 0
        self._total_own = 0

    def fits(self, size: int, is_message: bool, now_us: int) -> bool:
        """Whether a datagram of `size` bytes may go now."""
        while self._sent and now_us - self._sent[0][0] >= SECOND_US:
            _, old, was_message = self._sent.popleft()
            self._total -= old
            self._total_own -= 0 if was_message else old
        kept_free = max(0, self.reserved - self._total_own) if is_message else 0
        return self._total + size <= self.bytes_per_s - kept_free

    def spend(self, size: int, is_message: bool, now_us: int) -> None:
        """A datagram of `size` bytes has gone."""
        self._sent.append((now_us, size, is_message))
        self._total += size
        self._total_own += 0 if is_message else size


@dataclass(frozen=True)
class Message:
    """One message of the own bus that shall cross."""

    channel: Channel
    data: bytes
    utime: int  # own clock, when it was said
    payload_bytes: int  # of its array

    def is_stale(self, now_us: int) -> bool:
        """Whether it is older than its channel allows."""
        return now_us - self.utime > self.channel.max_age_s * 1e6


class MessageQueue:
    """Messages that wait for room on one link: the newest of each channel."""

    def __init__(self) -> None:
        self._waiting: dict[str, Message] = {}
        self.n_dropped = 0  # replaced by a newer one, or stale, before there was room

    def offer(self, message: Message) -> None:
        """Put a message in the place of an older one of its channel."""
        self.n_dropped += message.channel.name in self._waiting
        self._waiting[message.channel.name] = message

    def first(self, now_us: int) -> Message | None:
        """The message that goes next, by its channel's priority, then by age; stale ones are dropped and
        counted."""
        for name in [name for name, message in self._waiting.items() if message.is_stale(now_us)]:
            del self._waiting[name]
            self.n_dropped += 1
        order = sorted(self._waiting.values(), key=lambda m: (m.channel.priority, m.utime, m.channel.name))
        return order[0] if order else None

    def remove(self, message: Message) -> None:
        """The message has gone."""
        del self._waiting[message.channel.name]

    def clear(self) -> None:
        """The peer is no neighbour any more: what waited for it is dropped and counted."""
        self.n_dropped += len(self._waiting)
        self._waiting.clear()
