"""The spy's cores: exact figures at given times, messages from fragments, the ring as it is told."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.text import Text

from lcmtypes import channels, make
from lcmtypes.podwatch import (
    fleet_row_t,
    fleet_state_t,
    heartbeat_t,
    link_state_t,
    link_t,
    track_t,
    vehicle_state_t,
)
from logs.sequence import GapCounter
from procs.relay.link import NEVER_MS
from tools.spy.datagrams import parse_url
from tools.spy.listener import decode
from tools.spy.packets import FRAGMENT_HEAD, Fragments
from tools.spy.pages import ring_page
from tools.spy.ring import NEVER_S, Ring
from tools.spy.statistics import BusStatistics, ChannelStatistics
from tools.spy.values import brief, head_line, member_lines

S = 1_000_000


def track(seq: int, utime: int = 0) -> bytes:
    return make(track_t, utime=utime, seq=seq, drone_id=1).encode()


def hear(channel: ChannelStatistics, *times_us: int, n_bytes: int = 100) -> None:
    for time_us in times_us:
        channel.hear(time_us, n_bytes)


# Figures of one channel.


def test_rate_and_bytes_are_those_of_the_window_that_ends_now():
    channel = ChannelStatistics(channels.TRACK)
    hear(channel, *range(S, 11 * S, S // 20), n_bytes=300)  # 20 Hz for ten seconds
    assert channel.rate_hz(11 * S - 1, since_us=0) == 20
    assert channel.bytes_s(11 * S - 1, since_us=0) == 6000
    assert channel.rate_hz(11 * S, since_us=0) == pytest.approx(20 - 0.2)  # the message at 6.00 s is just out
    assert channel.rate_hz(13 * S, since_us=0) == pytest.approx((3 * 20 - 1) / 5)
    assert channel.rate_hz(16 * S, since_us=0) == 0
    assert channel.n_messages == 200


def test_before_a_whole_window_the_rate_is_that_since_listening_began():
    channel = ChannelStatistics(channels.TRACK)
    hear(channel, *range(10 * S, 12 * S, S // 10))
    assert channel.rate_hz(12 * S, since_us=10 * S) == 10


def test_jitter_is_the_deviation_of_the_periods():
    channel = ChannelStatistics(channels.TRACK)
    hear(channel, 0, 40_000, 100_000, 140_000, 200_000)  # periods of 40, 60, 40, 60 ms
    assert channel.jitter_ms(200_000) == 10
    even = ChannelStatistics(channels.TRACK)
    hear(even, *range(0, S, 50_000))
    assert even.jitter_ms(S) == 0
    assert ChannelStatistics(channels.TRACK).jitter_ms(S) is None


def test_heartbeats_of_many_processes_have_no_jitter():
    channel = ChannelStatistics(channels.HEARTBEAT)
    hear(channel, 0, 10_000, 20_000, 35_000)
    assert channel.jitter_ms(40_000) is None


def test_a_channel_far_below_its_nominal_rate_is_slow():
    channel = ChannelStatistics(channels.VEHICLE_STATE)  # 20 Hz
    hear(channel, *range(0, 5 * S, S // 9))
    assert channel.is_slow(5 * S, since_us=0)
    hear(channel, *range(5 * S, 10 * S, S // 19))
    assert not channel.is_slow(10 * S, since_us=0)
    assert not ChannelStatistics("OF_NO_TABLE").is_slow(S, since_us=0)


def test_gaps_are_counted_by_seq_and_a_restart_or_a_repetition_is_none():
    channel = ChannelStatistics(channels.TRACK)
    for seq, utime in ((5, 10), (6, 20), (9, 30), (8, 25), (9, 30), (0, 40), (1, 50)):
        channel.hear(utime, 50, track(seq, utime))
    assert channel.n_lost == 2


def test_each_process_counts_its_own_heartbeats():
    channel = ChannelStatistics(channels.HEARTBEAT)
    for seq in (1, 2, 4):
        for process in ("camera", "relay"):
            beat = make(heartbeat_t, utime=seq * S, seq=seq, drone_id=1, process=process).encode()
            channel.hear(seq * S, len(beat), beat)
    assert channel.n_lost == 2


steps = st.tuples(st.integers(-3, 4), st.integers(-2, 5), st.booleans())


@settings(deadline=None, max_examples=200)
@given(st.lists(steps, max_size=30))
def test_the_quick_count_of_gaps_is_that_of_the_logs(changes: list[tuple[int, int, bool]]):
    channel, counter = ChannelStatistics(channels.TRACK), GapCounter()
    seq = utime = 100
    for by_seq, by_utime, is_other in changes:
        seq, utime = seq + by_seq, utime + by_utime
        data = b"another type, never a track" if is_other else track(seq, utime)
        counter.see(channels.TRACK, data)
        channel.hear(utime, len(data), data)
    assert channel.n_lost == counter.n_lost


def test_channels_come_as_the_table_has_them_then_copies_then_strangers():
    statistics = BusStatistics(0)
    for name in ("ZEBRA", "RX_2_RING_MAP", channels.HEARTBEAT, "RX_1_RING_ASSIGN", channels.FRAME):
        statistics.channel(name)
    assert [channel.name for channel in statistics.in_order()] == [
        channels.FRAME, channels.HEARTBEAT, "RX_1_RING_ASSIGN", "RX_2_RING_MAP", "ZEBRA",
    ]  # fmt: skip


# Messages of several datagrams.


def fragments(number: int, channel: bytes, data: bytes, size: int) -> list[bytes]:
    starts = range(0, len(data), size)
    return [
        FRAGMENT_HEAD.pack(b"LC03", number, len(data), start, index, len(starts))
        + (channel + b"\0" if index == 0 else b"")
        + data[start : start + size]
        for index, start in enumerate(starts)
    ]


@settings(deadline=None, max_examples=50)
@given(st.binary(min_size=1, max_size=500), st.integers(20, 200), st.randoms(use_true_random=False))
def test_fragments_in_any_order_and_twice_make_the_message_once(data: bytes, size: int, random: Any):
    parts = fragments(7, b"PREVIEW", data, size)
    order = parts + parts[: len(parts) - 1]
    random.shuffle(order)
    whole = Fragments()
    made = [found for part in order if (found := whole.add(b"sender", part))]
    assert made[:1] == [(b"PREVIEW", data)]


def test_two_senders_messages_of_one_number_do_not_mix_and_damage_is_dropped():
    one, two = fragments(1, b"A", b"x" * 90, 30), fragments(1, b"B", b"y" * 90, 30)
    whole = Fragments()
    made = []
    for first, second in zip(one, two, strict=True):
        made += [whole.add(b"one", first), whole.add(b"two", second)]
    assert made == [None] * 4 + [(b"A", b"x" * 90), (b"B", b"y" * 90)]
    for damaged in (b"", b"LC03", b"LC02" + one[0][4:], one[0] + b"more" * 30):
        assert whole.add(b"three", damaged) is None


def test_fragments_that_never_come_are_given_up():
    whole = Fragments()
    for number in range(100):
        whole.add(b"one", fragments(number, b"A", b"x" * 90, 30)[0])
    assert len(whole._halves) == 16


@pytest.mark.parametrize(
    "url", ["", "udpm://", "memq://", "udpm://10.0.0.1:7667", "udpm://239.255.76.101", "tcpq://239.1.1.1:80"]
)
def test_an_address_that_is_no_bus_is_refused(url: str):
    with pytest.raises(ValueError, match="udpm://GROUP:PORT"):
        parse_url(url)
    assert parse_url("udpm://239.255.76.101:7667?ttl=0") == ("239.255.76.101", 7667)


# Newest messages.


def test_a_message_is_told_with_the_units_of_its_lcm_file():
    message = make(vehicle_state_t, utime=1, seq=2, drone_id=3, n_m=1.5)
    lines = {name: (value, meaning) for name, value, meaning in member_lines(message)}
    assert lines["n_m"][0] == "1.5"
    assert lines["n_m"][1].startswith("m")
    assert brief(message).startswith("n_m=1.5 ")
    assert head_line(message) == "utime 1, seq 2, drone_id 3"


def test_a_constant_is_told_by_its_name():
    lines = {name: meaning for name, _, meaning in member_lines(make(track_t, state=track_t.TRACKING))}
    assert lines["state"] == "TRACKING"


def test_each_struct_of_a_list_has_a_line():
    lines = member_lines(link_state(1, make(link_t, peer_id=2), make(link_t, peer_id=3)))
    told = {name: value for name, value, _ in lines}
    assert told["links[0]"].startswith("peer_id=2 ")
    assert told["links[1]"].startswith("peer_id=3 ")


def test_bytes_that_are_no_message_are_shown_as_bytes():
    assert decode(track_t, b"\x01\x02nothing") == b"\x01\x02nothing"
    assert decode(None, b"abc") == b"abc"
    assert "3 bytes" in brief(b"abc")
    assert member_lines(b"abc")[0][0] == "bytes"


# The ring.


def fleet_state(drone_id: int, members: int, rows: dict[int, float], **more: Any) -> fleet_state_t:
    made = [
        make(fleet_row_t, id=member, alive=age_s >= 0, age_ms=round(abs(age_s) * 1000))
        for member, age_s in rows.items()
    ]
    return make(
        fleet_state_t, drone_id=drone_id, members=members, n_rows=len(made), rows=made,
        fleet_time_ok=True, **more,
    )  # fmt: skip


def link_state(drone_id: int, *links: link_t) -> link_state_t:
    return make(link_state_t, drone_id=drone_id, n_links=len(links), links=list(links))


def text_of(lines: list[Text]) -> str:
    return "\n".join(line.plain for line in lines)


def test_the_ring_shows_whom_each_drone_believes_and_what_each_link_carries():
    ring = Ring()
    ring.hear_fleet(fleet_state(1, 0b11, {1: 0, 2: 0.4}, left_id=2, right_id=2), 10 * S)
    ring.hear_fleet(fleet_state(2, 0b111, {2: 0, 1: 0.2}, left_id=1, right_id=3, is_line=True), 10 * S)
    link = make(
        link_t, peer_id=2, up=True, age_ms=120, loss=0.05, round_trip_us=8000, n_dropped=4, n_rejected=2,
        cap_bytes_s=2000, n_kinds=2, kinds=["link", "RING_MAP"], bytes_out=[440, 560],
    )  # fmt: skip
    ring.hear_links(link_state(1, link, make(link_t, peer_id=0, age_ms=NEVER_MS)), 10 * S)
    text = text_of(ring_page(ring, 11 * S, 100))
    lines = [line.split() for line in text.splitlines()]
    assert ["1", "·", "0.4", "2", "‹", "1", "›", "2,", "ring", "of", "2"] in lines
    assert [
        "2",
        "0.2",
        "·",
        "1",
        "‹",
        "2",
        "›",
        "3,",
        "line",
        "of",
        "3,",
        "1",
        "without",
        "a",
        "position",
    ] in lines
    assert ["1", "→", "2", "up", "0.1", "5%", "8.0", "1000", "2000", "50%", "4", "2"] in lines
    assert ["RING_MAP", "560,", "link", "440"] in lines
    assert ["1", "→", "boat", "down", "never", "0%", "0.0", "0", "0", "0%", "0", "0"] in lines


def test_what_is_old_is_not_told_as_if_it_were_so():
    ring = Ring()
    ring.hear_fleet(fleet_state(1, 0b1, {1: 0}), 10 * S)
    ring.hear_links(link_state(1, make(link_t, peer_id=2)), 10 * S)
    ring.hear_fleet(fleet_state(2, 0b1, {2: 0, 3: -1}), 14 * S)
    assert [belief.drone_id for belief in ring.beliefs(14 * S)] == [2]
    assert ring.beliefs(14 * S)[0].ages_s == {2: 0}
    assert ring.links(14 * S) == []
    assert ring.silent(14 * S) == {1: 4.0}
    assert ring.known_ids() == [1, 2, 3]
    assert "silent for 4 s" in text_of(ring_page(ring, 14 * S, 100))


def test_a_peer_that_was_never_heard_has_no_age():
    ring = Ring()
    ring.hear_links(link_state(1, make(link_t, peer_id=2, age_ms=NEVER_MS)), 0)
    assert ring.links(0)[0].age_s >= NEVER_S
