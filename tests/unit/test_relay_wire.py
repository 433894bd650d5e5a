"""Each wire format of the relay: what is packed comes back, what is cut or wrong is refused."""

import contextlib

import pytest
from hypothesis import assume, given
from hypothesis import settings as cases
from hypothesis import strategies as st

from lcmtypes.podwatch import operator_t
from procs.relay import datagram
from procs.relay.clock_sync import FleetOffer
from procs.relay.datagram import Body, ClockPart, DatagramError, MessagePart
from procs.relay.fleet import TABLE_LIMIT_BYTES, FleetTable, Order
from procs.relay.rows import Marker, Row, RowError, pack_row, position_unit_m, unpack_row, with_age

int64 = st.integers(-(2**63), 2**63 - 1)
offers = st.builds(FleetOffer, int64, st.integers(0, 255), st.integers(0, 255))
clocks = st.builds(ClockPart, int64, st.none() | st.integers(0, 2**32 - 2), offers)
messages = st.builds(MessagePart, st.integers(0, 255), st.binary(max_size=400))


@st.composite
def bodies(draw: st.DrawFn) -> Body:
    table, message = draw(st.sampled_from([(False, False), (True, False), (False, True)]))
    return Body(
        draw(int64),
        draw(st.binary(min_size=6, max_size=6)),
        draw(st.none() | clocks),
        draw(st.binary(max_size=300)) if table else None,
        draw(messages) if message else None,
    )


metres = st.floats(-3276, 3276)
speeds = st.floats(-25.4, 25.4)
markers = st.builds(Marker, metres, metres, st.floats(0, 127), st.integers(-32767, 32767))
rows = st.builds(
    Row,
    counter=st.integers(0, 2**15 - 1),
    state=st.integers(0, 31),
    animal=st.integers(-1, 254),
    battery=st.floats(0, 1),
    position_m=st.tuples(metres, metres, metres),
    velocity_m_s=st.tuples(speeds, speeds, speeds),
    found=st.booleans(),
    on_station=st.booleans(),
    wants_episode=st.booleans(),
    is_line=st.booleans(),
    marker=st.none() | markers,
)


@cases(deadline=None, max_examples=100)
@given(body=bodies())
def test_a_body_comes_back(body: Body) -> None:
    assert datagram.unpack(datagram.pack(body), 6) == body


@cases(deadline=None, max_examples=100)
@given(body=bodies(), kept=st.integers(0, 40))
def test_a_body_cut_short_is_refused_or_shorter(body: Body, kept: int) -> None:
    whole = datagram.pack(body)
    assume(kept < len(whole))
    with contextlib.suppress(DatagramError):
        assert datagram.unpack(whole[:kept], 6) != body


@cases(deadline=None, max_examples=100)
@given(noise=st.binary(max_size=60))
def test_noise_in_a_body_raises_nothing_else(noise: bytes) -> None:
    with contextlib.suppress(DatagramError):
        datagram.unpack(noise, 6)


def test_a_body_of_another_roster_is_refused() -> None:
    with pytest.raises(DatagramError, match="roster"):
        datagram.unpack(datagram.pack(Body(1, bytes(4))), 6)
    with pytest.raises(ValueError, match="not both"):
        datagram.pack(Body(1, bytes(4), None, b"table", MessagePart(0, b"message")))


@cases(deadline=None, max_examples=200)
@given(row=rows, age_us=st.integers(0, 20_000_000))
def test_a_row_comes_back_within_its_steps(row: Row, age_us: int) -> None:
    wire = pack_row(row, age_us)
    back, age, used = unpack_row(wire + b"more")
    assert used == len(wire) == (15 if row.marker is None else 22)
    assert (age == 255 and age_us > 12_700_000) or 0 <= age * 50_000 - age_us < 50_000
    assert (back.state, back.animal, back.counter) == (row.state, row.animal, row.counter)
    flags = (row.found, row.on_station, row.wants_episode, row.is_line)
    assert (back.found, back.on_station, back.wants_episode, back.is_line) == flags
    assert abs(back.battery - row.battery) <= 0.5 / 63 + 1e-9
    assert max(abs(a - b) for a, b in zip(back.position_m, row.position_m, strict=True)) <= 0.0501
    assert max(abs(a - b) for a, b in zip(back.velocity_m_s, row.velocity_m_s, strict=True)) <= 0.1001
    if row.marker is not None:
        assert back.marker is not None
        assert back.marker.waypoint == row.marker.waypoint
        assert abs(back.marker.found_n_m - row.marker.found_n_m) <= 0.0501
        assert abs(back.marker.pod_radius_m - row.marker.pod_radius_m) <= 0.2501
    assert unpack_row(with_age(wire, 0))[:2] == (back, 0)


def row_at(n_m: float = 1.0, **members: object) -> Row:
    values = {"counter": 0, "state": 3, "animal": -1, "battery": 0.5, "velocity_m_s": (0.0, 0.0, 0.0)}
    return Row(**(values | {"position_m": (n_m, 2.0, -30.0)} | members))  # type: ignore[arg-type]


def test_a_position_too_far_for_decimetres_travels_in_metres() -> None:
    far = row_at(15_123.4)
    assert position_unit_m(far) == 1.0
    back, _, _ = unpack_row(pack_row(far, 0))
    assert back.position_m == (15_123.0, 2.0, -30.0)
    assert unpack_row(pack_row(row_at(3_276.7), 0))[0].position_m[0] == pytest.approx(3_276.7)


def test_values_beyond_a_row_are_held_or_refused() -> None:
    fast = row_at(velocity_m_s=(99.0, -99.0, float("nan")))
    assert unpack_row(pack_row(fast, 0))[0].velocity_m_s == pytest.approx((25.4, -25.4, 0.0))
    for wrong in ({"state": 32}, {"state": -1}, {"animal": 255}, {"animal": -2}):
        with pytest.raises(RowError, match="does not fit"):
            pack_row(row_at(**wrong), 0)
    with pytest.raises(RowError, match="needs 15"):
        unpack_row(bytes(14))
    with pytest.raises(RowError, match="needs 22"):
        unpack_row(pack_row(row_at(marker=Marker()), 0)[:-1])


@cases(deadline=None, max_examples=50)
@given(said=st.lists(rows, min_size=1, max_size=29), n_orders=st.integers(0, 8))  # drone 30 hears
def test_a_table_is_within_its_limit_and_comes_back_whole_in_time(said: list[Row], n_orders: int) -> None:
    ids = tuple(range(31))
    tables = [FleetTable(member, ids) for member in ids[1:]]
    source, sink = tables[0], FleetTable(30, ids)
    for member, row in enumerate(said, start=1):
        tables[member - 1].say(row, 1_000_000, 1_000_000)
        if member > 1:
            source.merge(member, tables[member - 1].pack(1, 1_000_000), 1_000_000)
    for k in range(n_orders):
        source.order(Order(1000 + k, 2, k + 1, -1, 60))
    for _ in range(5):
        data = source.pack(30, 1_000_000)
        assert len(data) <= TABLE_LIMIT_BYTES
        sink.merge(1, data, 1_000_000)
    assert [row.id for row in sink.rows((), 1_000_000)] == list(range(1, len(said) + 1))
    assert sink.order_for(n_orders, 1_000).utime_us == (999 + n_orders if n_orders else 0)


def test_more_orders_than_one_table_holds_all_arrive_in_turn() -> None:
    source, sink = FleetTable(1, (0, 1, 2)), FleetTable(2, (0, 1, 2))
    for animal in range(12):
        source.order(Order(1000 + animal, operator_t.LEAVE, 0, animal, 60))
    for _ in range(7):
        sink.merge(1, source.pack(2, 1_000_000), 1_000_000)
    assert sink.left(1_000) == list(range(12))


def test_orders_to_fly_go_before_those_about_animals_and_each_peer_has_its_own_turn() -> None:
    source = FleetTable(1, (0, 1, 2, 3))
    sinks = {peer: FleetTable(peer, (0, 1, 2, 3)) for peer in (2, 3)}
    source.order(Order(1000, operator_t.HOLD, 3, -1, 60))
    for animal in range(7):
        source.order(Order(2000 + animal, operator_t.LEAVE, 0, animal, 60))
    for peer, sink in sinks.items():
        sink.merge(1, source.pack(peer, 1_000_000), 1_000_000)
        assert sink.order_for(3, 3_000).command == operator_t.HOLD
    for _ in range(3):  # two peers and an even number of the rest: one counter for both would starve each
        for peer, sink in sinks.items():
            sink.merge(1, source.pack(peer, 1_000_000), 1_000_000)
    assert [sink.left(3_000) for sink in sinks.values()] == [list(range(7))] * 2


def test_a_row_of_an_earlier_life_of_a_drones_clock_does_not_come_back() -> None:
    ids = (0, 1, 2, 3)
    old_life, new_life, sink = FleetTable(2, ids), FleetTable(2, ids), FleetTable(1, ids)
    now_us = 500_000_000
    old_life.say(row_at(animal=1), now_us, now_us)
    old = old_life.pack(1, now_us)
    sink.merge(2, old, now_us)
    clock_us = 20_000_000  # drone 2 booted again: its counter is behind
    new_life.say(row_at(animal=2), clock_us, clock_us)
    sink.merge(2, new_life.pack(1, clock_us), now_us + 5_000_000)
    assert sink.rows((), now_us)[0].animal == 2
    aged = with_age(old[1:16], 5_500_000)
    sink.merge(3, old[:1] + aged + old[16:], now_us + 5_500_000)  # by another path
    assert sink.rows((), now_us)[0].animal == 2


@cases(deadline=None, max_examples=100)
@given(noise=st.binary(max_size=60))
def test_noise_in_a_table_is_refused_and_changes_nothing(noise: bytes) -> None:
    table = FleetTable(1, (0, 1, 2))
    assume(noise != b"\x00\x00")  # the empty table
    try:
        table.merge(2, noise, 0)
    except ValueError:
        assert table.rows((), 0) == []
