"""The map on the wire, 9 bytes an animal, and the memory between episodes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from procs.registrar.map import (
    ANIMAL_BYTES,
    HEADER_BYTES,
    NO_ID,
    REUSE_AFTER_S,
    AxisState,
    MapAnimal,
    MapHeader,
    Memory,
    PacketError,
    decode_map,
    encode_map,
)

QUIET = settings(deadline=None, max_examples=60)

HEADERS = st.builds(
    MapHeader,
    episode=st.integers(0, 65535),
    proposer=st.integers(0, 99),
    lap=st.integers(0, 15),
    rank=st.integers(0, 98),
    flags=st.integers(0, 255),
    confidence=st.floats(0, 1),
    origin_n_m=st.integers(-32767, 32767),
    origin_e_m=st.integers(-32767, 32767),
    yaw_rad=st.floats(0, 6.28),
)
ANIMALS = st.builds(
    MapAnimal,
    n_m=st.floats(-300, 300),
    e_m=st.floats(-300, 300),
    size_m=st.floats(0.1, 160),
    axis_rad=st.floats(0, 3.14),
    hits=st.integers(0, 15),
    misses=st.integers(0, 15),
    id=st.integers(0, NO_ID),
    axis_state=st.sampled_from([AxisState.KNOWN, AxisState.MIRRORED, AxisState.UNKNOWN]),
)
HEADER = MapHeader(7, 2, 1, 0, 0, 1.0, 100, -50, 1.0)


def whale(number, **changes):
    values = {"n_m": 101.0, "e_m": -49.0, "size_m": 10.0, "axis_rad": 0.5, "hits": 2, "misses": 0, **changes}
    return MapAnimal(id=number, **values)


@QUIET
@given(HEADERS, st.lists(ANIMALS, max_size=20))
def test_what_is_said_is_heard_within_a_unit_of_the_wire(header, animals):
    placed = [
        MapAnimal(
            one.n_m + header.origin_n_m,
            one.e_m + header.origin_e_m,
            *(one.size_m, one.axis_rad, one.hits, one.misses, one.id, one.axis_state),
        )
        for one in animals
    ]
    packet = encode_map(header, placed)
    heard, decoded = decode_map(packet)
    assert len(packet) == HEADER_BYTES + ANIMAL_BYTES * len(animals)
    exact = ("episode", "proposer", "lap", "rank", "flags", "origin_n_m", "origin_e_m")
    assert [getattr(heard, name) for name in exact] == [getattr(header, name) for name in exact]
    assert heard.confidence == pytest.approx(header.confidence, abs=1 / 255)
    for said, got in zip(placed, decoded, strict=True):
        assert (got.n_m, got.e_m, got.size_m) == pytest.approx((said.n_m, said.e_m, said.size_m), abs=0.006)
        assert abs((got.axis_rad - said.axis_rad + np.pi / 2) % np.pi - np.pi / 2) < 0.007
        assert (got.hits, got.misses, got.id, got.axis_state) == (
            *(said.hits, said.misses, said.id, said.axis_state),
        )
    assert encode_map(*decode_map(packet)) == packet


def test_twenty_animals_stay_inside_the_papers_bound():
    packet = encode_map(HEADER, [whale(k) for k in range(20)])
    assert ANIMAL_BYTES == 9
    assert HEADER_BYTES <= 24
    assert len(packet) - HEADER_BYTES <= 308 - 128


@QUIET
@given(st.integers(0, 51), st.integers(1, 255))
def test_an_altered_byte_is_noticed(place, flip):
    packet = bytearray(encode_map(HEADER, [whale(k) for k in range(4)]))
    packet[place] ^= flip
    with pytest.raises(PacketError):
        decode_map(bytes(packet))


@pytest.mark.parametrize("length", range(HEADER_BYTES + 2 * ANIMAL_BYTES))
def test_a_truncated_packet_is_noticed(length):
    with pytest.raises(PacketError):
        decode_map(encode_map(HEADER, [whale(1), whale(2)])[:length])


@QUIET
@given(st.binary(max_size=200))
def test_random_bytes_are_no_map(data):
    with pytest.raises(PacketError):
        decode_map(data)


@pytest.mark.parametrize(
    ("animal", "message"),
    [
        (whale(1, n_m=500.0), "leave it out"),
        (whale(1, size_m=200.0), "no longer than 163.83"),
        (whale(256), "animal id 256"),
        (whale(1, hits=16), "hits 16"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_value(animal, message):
    with pytest.raises(ValueError, match=message):
        encode_map(HEADER, [animal])


def test_a_map_too_large_or_too_far_is_refused():
    with pytest.raises(ValueError, match="33 animals"):
        encode_map(HEADER, [whale(k) for k in range(33)])
    with pytest.raises(ValueError, match="32767 m"):
        encode_map(MapHeader(7, 2, 1, 0, 0, 1.0, 40000, 0, 0.0), [])


def test_memory_keeps_unseen_animals_ten_minutes_and_no_longer():
    memory = Memory().after([whale(1), whale(2)], now_s=100.0)
    memory = memory.after([whale(1), whale(2, hits=0)], now_s=400.0)
    assert dict(zip([one.id for one in memory.animals], memory.last_seen_s, strict=True)) == {
        1: 400.0,
        2: 100.0,
    }
    assert [one.id for one in memory.known_at(100.0 + REUSE_AFTER_S - 1).animals] == [1, 2]
    assert [one.id for one in memory.known_at(100.0 + REUSE_AFTER_S + 1).animals] == [1]


def test_an_animal_that_only_a_map_carries_is_not_remembered_as_seen():
    assert Memory().after([whale(3, hits=0)], now_s=0.0).animals == ()


def test_a_newer_sight_moves_a_remembered_animal_and_an_older_or_unknown_one_does_nothing():
    memory = Memory().after([whale(1), whale(2)], now_s=100.0)
    moved = replace(whale(1), n_m=50.0)
    seen = memory.refreshed([(moved, 700.0), (replace(whale(2), n_m=9.0), 99.0), (whale(3), 700.0)])
    assert seen.animals == (moved, whale(2))
    assert seen.last_seen_s == (700.0, 100.0)
    assert [one.id for one in seen.known_at(100.0 + REUSE_AFTER_S + 1).animals] == [1]


def test_the_latest_seen_stand_first_where_a_map_has_not_room_for_all():
    memory = (
        Memory().after([whale(1)], now_s=100.0).after([whale(2)], now_s=200.0).after([whale(3)], now_s=150.0)
    )
    assert [one.id for one in memory.newest_first().animals] == [2, 3, 1]


def test_a_new_episode_counts_anew():
    memory = Memory().after([whale(1, misses=1, axis_state=AxisState.MIRRORED)], now_s=0.0)
    (one,) = memory.forgotten_counts()
    assert (one.hits, one.misses, one.axis_state) == (0, 0, AxisState.UNKNOWN)
