"""The cap on bytes per second and the queue of messages that wait for room."""

from dataclasses import replace

from hypothesis import given
from hypothesis import settings as cases
from hypothesis import strategies as st

from lcmtypes import channels
from procs.relay.budget import ByteWindow, Message, MessageQueue

S = 1_000_000
EPISODE, MAP, ASSIGN = (
    channels.BY_NAME[name] for name in (channels.RING_EPISODE, channels.RING_MAP, channels.RING_ASSIGN)
)


@cases(deadline=None, max_examples=100)
@given(
    attempts=st.lists(
        st.tuples(st.integers(0, 300_000), st.integers(40, 500), st.booleans()), min_size=1, max_size=80
    )
)
def test_no_second_carries_more_than_the_cap(attempts: list[tuple[int, int, bool]]) -> None:
    window, now_us = ByteWindow(2000, 600), 0
    sent: list[tuple[int, int, bool]] = []
    for pause_us, size, is_message in attempts:
        now_us += pause_us
        if window.fits(size, is_message, now_us):
            window.spend(size, is_message, now_us)
            sent.append((now_us, size, is_message))
        last_second = [entry for entry in sent if entry[0] > now_us - S]
        assert sum(size for _, size, _ in last_second) <= 2000
        # Whatever the messages took, the relay's own datagrams can still have their share.
        own = sum(size for _, size, is_message in last_second if not is_message)
        assert own >= 600 or window.fits(600 - own, False, now_us)


def message(channel: channels.Channel, utime: int = 0, data: bytes = b"-") -> Message:
    return Message(channel, data, utime, 0)


def test_the_newest_of_a_channel_waits_and_the_order_is_by_priority() -> None:
    queue = MessageQueue()
    queue.offer(message(MAP, 1))
    queue.offer(message(ASSIGN, 2))
    queue.offer(message(MAP, 3))
    queue.offer(message(EPISODE, 4))
    assert queue.n_dropped == 1
    gone = []
    while (first := queue.first(10)) is not None:
        gone.append((first.channel.name, first.utime))
        queue.remove(first)
    assert gone == [("RING_EPISODE", 4), ("RING_ASSIGN", 2), ("RING_MAP", 3)]


def test_what_is_stale_is_dropped_and_counted() -> None:
    queue = MessageQueue()
    queue.offer(message(MAP, 0))
    assert queue.first(S) is not None
    assert queue.first(S + 1) is None
    assert queue.n_dropped == 1
    queue.offer(replace(message(MAP), utime=2 * S))
    queue.clear()
    assert queue.n_dropped == 2
