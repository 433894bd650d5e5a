"""The same animal's box from frame to frame: ids stay on their animals through what happens in the air."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from procs.registrar.carry import KEEP_US, BoxCarrier, Sighting

Array = NDArray[np.float64]
LENGTH_M = 10.0
FRAME_US = 200_000  # 5 Hz
# Five animals as in the default mission: about a body length apart.
POD = np.array([[0.0, 0.0], [12.0, 3.0], [-4.0, 11.0], [-11.0, -6.0], [6.0, -13.0]])
IDS = [10, 11, 12, 13, 14]


class Film:
    """Frames of a pod; `see` gives the carrier one and returns animal row -> the id that its box carries."""

    def __init__(self, animals: Array = POD, ids: list[int] | None = None) -> None:
        self.carrier = BoxCarrier(LENGTH_M)
        self.utime = 50_000_000
        self.animals = animals.copy()
        named = self.see_all()
        self.carrier.name(named, ids or IDS[: len(animals)])

    def see_all(self) -> Sighting:
        return self._frame(np.arange(len(self.animals)), np.zeros(2))

    def see(
        self, rows: list[int] | None = None, shift: tuple[float, float] = (0, 0), after_us: int = FRAME_US
    ) -> dict[int, int]:
        self.utime += after_us
        shown = np.arange(len(self.animals)) if rows is None else np.array(rows, dtype=int)
        sighting = self._frame(shown, np.array(shift))
        return {int(row): number for row, number in zip(shown, sighting.ids, strict=True)}

    def _frame(self, rows: NDArray[np.int64], shift: Array) -> Sighting:
        ground = self.animals[rows] + shift
        boxes = np.hstack([ground - 2, ground + 2])
        return self.carrier.update(self.utime, boxes, ground)


def named(rows: list[int] | None = None) -> dict[int, int]:
    return {row: IDS[row] for row in (range(len(POD)) if rows is None else rows)}


def test_ids_stay_on_animals_that_swim_and_in_whatever_order_they_are_detected():
    film = Film()
    random = np.random.default_rng(3)
    for _ in range(50):
        film.animals += np.array([0.7, 0.4]) * FRAME_US / 1e6 + random.normal(0, 0.15, POD.shape)
        order = [int(row) for row in random.permutation(len(POD))]
        assert film.see(order) == named()


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    shifts=st.lists(st.tuples(st.floats(-2.5, 2.5), st.floats(-2.5, 2.5)), min_size=3, max_size=10),
)
def test_a_tilt_that_shifts_all_boxes_alike_moves_no_id(seed, shifts):
    film = Film()
    random = np.random.default_rng(seed)
    for shift in shifts:
        film.animals += random.normal(0, 0.2, POD.shape)
        assert film.see(shift=shift) == named()


def test_a_box_that_vanishes_for_2_s_comes_back_with_its_id_and_lends_it_to_nobody():
    film = Film()
    speed = np.array([0.8, -0.5])
    for _ in range(10):
        film.animals += speed * FRAME_US / 1e6
        assert film.see() == named()
    seen = [0, 2, 3, 4]
    for _ in range(10):
        film.animals += speed * FRAME_US / 1e6
        assert film.see(seen) == named(seen)
    film.animals += speed * FRAME_US / 1e6
    assert film.see() == named()


def test_two_animals_that_cross_keep_their_ids():
    """They pass within two metres, each on its own course at 1.5 m/s."""
    film = Film(np.array([[-9.0, 0.0], [0.0, -9.5]]))
    courses = np.array([[1.5, 0.0], [0.0, 1.5]]) * FRAME_US / 1e6
    for _ in range(60):
        film.animals += courses
        assert film.see() == {0: 10, 1: 11}
    assert film.animals[0, 0] > 8


def test_an_animal_unseen_for_too_long_is_nobody_and_a_stranger_has_no_name():
    film = Film()
    assert film.see([0, 1], after_us=KEEP_US) == named([0, 1])
    assert film.see([0, 1, 2], after_us=FRAME_US) == {0: 10, 1: 11, 2: -1}
    film.animals = np.vstack([film.animals, [40.0, 40.0]])
    assert film.see([0, 5]) == {0: 10, 5: -1}


def test_an_episode_names_the_boxes_of_an_earlier_frame_and_the_newest_carries_the_names():
    film = Film()
    film.see()
    asked_us = film.utime
    for _ in range(5):
        film.animals += 0.2
        film.see()
    at = film.carrier.nearest(asked_us + 60_000, 100_000)
    assert at is not None
    assert at.utime == asked_us
    film.carrier.name(at, [20, 21, -1, 23, 24])
    assert film.see() == {0: 20, 1: 21, 2: -1, 3: 23, 4: 24}


def test_no_frame_within_reach_of_the_instant_is_no_view():
    film = Film()
    assert film.carrier.nearest(film.utime + 100_001, 100_000) is None
    assert BoxCarrier(LENGTH_M).nearest(0, 10**9) is None


def test_a_name_that_is_given_to_one_is_taken_from_the_other():
    film = Film()
    film.utime += FRAME_US
    sighting = film.see_all()
    film.carrier.name_one(sighting.followed[2], 11)
    assert sighting.ids == [10, -1, 11, 13, 14]
    assert film.carrier.held_ids(film.utime, 0) == [10, 11, 13, 14]
    assert film.carrier.held_ids(film.utime + FRAME_US, 0) == []


def test_a_box_that_the_pictures_edge_cuts_moves_nobody_and_begins_nobody():
    film = Film()
    film.utime += FRAME_US
    ground = np.vstack([POD[:2], POD[2:3] + 4.0])  # the third's centre is that of half an animal
    boxes = np.hstack([ground - 2, ground + 2])
    film.carrier.update(film.utime, boxes, ground, np.array([True, True, False]))
    assert film.see() == named()


def test_a_box_round_two_animals_that_touch_is_neither_and_both_keep_their_ids_through_it():
    film = Film(np.array([[0.0, 0.0], [10.5, 0.0], [5.0, 30.0]]))
    sizes = np.full(3, 9.0)

    def see(ground: Array, sizes: Array) -> list[int]:
        film.utime += FRAME_US
        boxes = np.hstack([ground - 2, ground + 2])
        return film.carrier.update(film.utime, boxes, ground, None, sizes).ids

    for _ in range(5):
        assert see(film.animals, sizes) == IDS[:3]
    for _ in range(8):
        # Shifted too, so that one shift of all would lay the box of two on either.
        merged = np.array([[5.2, 1.0], [5.0, 31.0]])
        assert see(merged, np.array([19.0, 9.0])) == [-1, IDS[2]]
    assert see(film.animals, sizes) == IDS[:3]


def test_the_first_box_after_two_came_together_is_given_neithers_id():
    """It lies between where they were: the map's offers say later whose it is (docs/registration.md)."""
    film = Film(np.array([[0.0, 0.0], [6.5, 0.0], [5.0, 30.0]]))
    assert film.see([0, 1, 2]) == named([0, 1, 2])
    for _ in range(5):
        film.see([2])
    film.animals[0] = [3.0, 0.0]
    assert film.see([0, 2]) == {0: -1, 2: IDS[2]}
    film.animals[:2] = [[0.3, 0.0], [6.3, 0.0]]
    after = film.see([0, 1, 2])
    assert (after[0], after[1]) in ((-1, IDS[1]), (IDS[0], IDS[1]))


def test_an_animal_half_under_water_for_a_while_keeps_its_id_when_it_is_whole_again():
    film = Film(np.array([[0.0, 0.0]]))
    ids = []
    for size_m in [9.0] * 20 + [5.0] * 15 + [9.0] * 5:
        film.utime += FRAME_US
        seen = film.carrier.update(film.utime, np.zeros((1, 4)), np.zeros((1, 2)), None, np.array([size_m]))
        ids += seen.ids
    assert ids == [IDS[0]] * 40


@pytest.mark.parametrize("apart_m", [2.8, 4.0])
def test_a_calf_beside_its_mother_that_dives_takes_no_name_away(apart_m):
    film = Film(np.array([[0.0, 0.0], [apart_m, 0.0]]))
    random = np.random.default_rng(1)
    for _ in range(10):
        film.see([0, 1])
    for _ in range(30):
        film.animals[0] = random.normal(0, 0.15, 2)
        assert film.see([0]) == {0: IDS[0]}
    assert film.see([0, 1]) == named([0, 1])


def test_a_box_that_is_given_no_name_is_one_and_the_same_from_then_on():
    """What the map offers must come for the same one several times running."""
    film = Film(np.array([[0.0, 0.0], [6.5, 0.0]]))
    for _ in range(5):
        film.see([])
    film.animals[0] = [3.0, 0.0]
    first = film._frame(np.array([0]), np.zeros(2))
    for _ in range(4):
        film.utime += FRAME_US
        again = film._frame(np.array([0]), np.zeros(2))
        assert again.followed[0] is first.followed[0]


def test_a_size_first_seen_too_large_comes_down():
    film = Film(np.array([[0.0, 0.0]]))
    for size_m in (18.0, 18.0, *[9.0] * 12):
        film.utime += FRAME_US
        film.carrier.update(film.utime, np.zeros((1, 4)), np.zeros((1, 2)), None, np.array([size_m]))
    film.utime += FRAME_US
    merged = film.carrier.update(film.utime, np.zeros((1, 4)), np.array([[1.0, 0.0]]), None, np.array([18.0]))
    assert merged.ids == [-1]


def test_a_frame_without_boxes_is_a_frame():
    film = Film()
    assert film.see([]) == {}
    assert film.see() == named()


@pytest.mark.parametrize("count", [1, 20])
def test_old_frames_are_forgotten(count):
    film = Film()
    for _ in range(count):
        film.see(after_us=KEEP_US // 10)
    assert len(film.carrier.sightings) == min(count + 1, 11)
