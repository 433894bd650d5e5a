"""The map between episodes: the newest sight wins everywhere, and nothing grows younger on its way round."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.cameras.pinhole import Pose
from procs.registrar.upkeep import (
    AGE_UNIT_US,
    MAX_ANIMALS,
    OWN_FRESH_US,
    Correction,
    MapBook,
    MapEntry,
    UpkeepError,
)

S = 1_000_000


def book(*animals: int, seen_utime: int = 100 * S) -> MapBook:
    """A map on which each animal stands at (10 * id, -id) m, seen by nobody in particular."""
    made = MapBook()
    made.replace([MapEntry(k, np.array([10.0 * k, -k]), seen_utime, mine=False) for k in animals])
    return made


def test_a_neighbours_newer_sight_moves_the_animal_and_an_older_one_does_not():
    mine, theirs = book(1, 2), book(1, 2)
    theirs.saw(1, np.array([20.0, 3.0]), 110 * S)
    mine.saw(2, np.array([25.0, 1.0]), 111 * S)
    mine.merge(theirs.encode(112 * S), 112 * S)
    np.testing.assert_allclose(mine.entries[1].position_m, [20.0, 3.0])
    np.testing.assert_allclose(mine.entries[2].position_m, [25.0, 1.0])
    assert mine.entries[1].seen_fleet_utime == pytest.approx(110 * S, abs=AGE_UNIT_US)
    assert (mine.entries[1].mine, mine.entries[2].mine) == (False, True)


def test_our_own_sight_that_comes_back_is_still_our_own():
    mine, theirs = book(1), book(1)
    mine.saw(1, np.array([12.0, 1.0]), 110 * S)
    theirs.merge(mine.encode(110 * S + 150_000), 110 * S + 160_000)
    np.testing.assert_allclose(theirs.entries[1].position_m, [12.0, 1.0])
    mine.merge(theirs.encode(110 * S + 400_000), 110 * S + 410_000)
    entry = mine.entries[1]
    assert entry.mine
    assert entry.seen_fleet_utime == 110 * S
    assert entry.theirs_m is None, "what we said ourselves is no second witness"


def test_two_who_see_one_animal_learn_how_far_their_frames_are_apart():
    mine, theirs = book(1), book(1)
    theirs.saw(1, np.array([10.0, 0.0]), 110 * S)
    mine.merge(theirs.encode(110 * S), 110 * S)
    assert mine.saw(1, np.array([13.0, 4.0]), 110 * S + 100_000) == pytest.approx(5.0)
    assert mine.saw(1, np.array([13.0, 4.0]), 110 * S + OWN_FRESH_US + 1) == 0.0, "too old to compare"
    assert book(1).saw(1, np.array([13.0, 4.0]), 110 * S) == 0.0


def test_of_two_other_witnesses_the_newer_is_compared_with():
    mine, near, far = book(1), book(1), book(1)
    near.saw(1, np.array([10.0, 0.0]), 110 * S)
    far.saw(1, np.array([30.0, 0.0]), 109 * S)
    for witness in (near, far):  # the older one arrives last
        mine.merge(witness.encode(110 * S), 110 * S)
    assert mine.saw(1, np.array([10.0, 0.0]), 110 * S) == pytest.approx(0.0)


def test_only_agreed_animals_are_held_and_an_episode_replaces_them():
    mine, theirs = book(1), book(2)
    theirs.saw(2, np.zeros(2), 110 * S)
    mine.merge(theirs.encode(110 * S), 110 * S)
    assert list(mine.entries) == [1]
    assert mine.saw(9, np.zeros(2), 110 * S) == 0.0
    mine.replace([MapEntry(3, np.zeros(2), 0, mine=True), MapEntry(2, np.zeros(2), 0, mine=True)])
    assert list(mine.entries) == [2, 3]


@pytest.mark.parametrize(
    "damage", [b"", b"\x55", b"\x00\x00", b"\x55\x02" + bytes(6), b"\x55\x01" + bytes(7)]
)
def test_a_packet_of_another_form_is_refused(damage):
    with pytest.raises(UpkeepError, match=f"a packet of {len(damage)} bytes"):
        book(1).merge(damage, 0)


def test_twenty_animals_fit_beside_a_state_and_the_rest_is_left_out():
    packet = book(*range(25), seen_utime=100 * S).encode(100 * S)
    assert len(packet) == 2 + MAX_ANIMALS * 6 <= 180


def test_an_animal_that_nobody_sees_drops_out_of_what_is_said():
    old = book(1, seen_utime=100 * S)
    assert len(old.encode(100 * S + 126 * AGE_UNIT_US)) == 8
    assert len(old.encode(100 * S + 127 * AGE_UNIT_US)) == 2


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32), n_drones=st.integers(2, 6), latency_ms=st.integers(0, 25))
def test_round_the_ring_an_animal_that_nobody_sees_never_grows_younger(seed, n_drones, latency_ms):
    """One drone saw it at 100 s; 20 s of telling both neighbours later nobody holds it for newer."""
    random = np.random.default_rng(seed)
    books = [book(1, seen_utime=90 * S) for _ in range(n_drones)]
    books[0].saw(1, np.array([5.0, 5.0]), 100 * S)
    for second in range(100, 120):
        for k in random.permutation(n_drones):
            said_us = second * S + int(random.integers(0, S))
            packet = books[k].encode(said_us)
            for neighbour in ((k - 1) % n_drones, (k + 1) % n_drones):
                books[neighbour].merge(packet, said_us + latency_ms * 1000)
    for held in books:
        seen = held.entries[1].seen_fleet_utime
        assert seen <= 100 * S + n_drones * latency_ms * 1000
        np.testing.assert_allclose(held.entries[1].position_m, [5.0, 5.0])


@settings(max_examples=40, deadline=None)
@given(
    shift=st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-np.pi, np.pi)),
    point=st.tuples(st.floats(-200, 200), st.floats(-200, 200)),
    place=st.tuples(st.floats(-200, 200), st.floats(-200, 200)),
)
def test_a_correction_there_and_back_is_nothing_and_keeps_distances(shift, point, place):
    correction = Correction(*shift)
    own = Pose(place[0], place[1], -30.0, 0.0, 0.0, 0.4)
    at = np.array(point)
    on_map = correction.to_map(at, own)
    np.testing.assert_allclose(correction.to_own(on_map, own), at, atol=1e-9)
    moved = correction.pose(own)
    nadir = np.array([moved.n_m, moved.e_m])
    np.testing.assert_allclose(correction.to_map(np.array(place), own), nadir, atol=1e-9)
    assert np.linalg.norm(on_map - nadir) == pytest.approx(np.linalg.norm(at - np.array(place)), abs=1e-9)
    assert moved.yaw_rad == pytest.approx(own.yaw_rad + shift[2])
