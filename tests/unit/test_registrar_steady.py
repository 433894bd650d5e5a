"""What a view was at an instant: the detector's blinks are mended by the frames around it."""

import numpy as np
import pytest

from procs.registrar.carry import BoxCarrier, Sighting
from procs.registrar.steady import steady

FRAME_US = 200_000
LENGTH_M = 10.0
PX_PER_M = 10.0
ANIMALS = np.array([[0.0, 0.0], [15.0, 5.0], [5.0, 20.0]])
DRIFT = np.array([0.5, 0.0])  # m a frame


def seen(frames: dict[int, np.ndarray]) -> tuple[BoxCarrier, list[Sighting]]:
    """A carrier that took places (N, 2) m at frame numbers, as boxes 40 px wide round ten px a metre."""
    carrier = BoxCarrier(LENGTH_M)
    sightings = []
    for number, places in frames.items():
        centres = places * PX_PER_M + 100
        sightings.append(carrier.update(number * FRAME_US, np.hstack([centres - 20, centres + 20]), places))
    return carrier, sightings


def at(number: int) -> np.ndarray:
    return ANIMALS + number * DRIFT


def steadied(frames: dict[int, np.ndarray], number: int, whole: list[bool] | None = None) -> Sighting:
    carrier, sightings = seen(frames)
    chosen = sightings[number]
    flags = np.ones(len(chosen.boxes), bool) if whole is None else np.array(whole)
    return steady(carrier.sightings, chosen, flags)


def test_a_frame_that_missed_nothing_stays_as_it_is():
    carrier, sightings = seen({k: at(k) for k in range(5)})
    result = steady(carrier.sightings, sightings[2], np.ones(3, bool))
    np.testing.assert_allclose(result.boxes, sightings[2].boxes)
    assert [id(a) for a in result.followed] == [id(a) for a in sightings[2].followed]


def test_an_animal_missed_for_one_frame_is_put_between_its_sights_before_and_after():
    result = steadied({0: at(0), 1: at(1), 2: at(2)[1:], 3: at(3), 4: at(4)}, 2)
    assert len(result.boxes) == 3
    np.testing.assert_allclose(result.ground_m[-1], at(2)[0])
    np.testing.assert_allclose((result.boxes[-1, :2] + result.boxes[-1, 2:]) / 2, at(2)[0] * PX_PER_M + 100)


def test_the_mended_animal_takes_the_name_that_the_episode_gives_it():
    carrier, sightings = seen({0: at(0), 1: at(1), 2: at(2)[1:], 3: at(3)})
    result = steady(carrier.sightings, sightings[2], np.ones(2, bool))
    carrier.name(result, [4, 5, 6])
    assert sightings[3].ids == [6, 4, 5], "the first animal was the one that frame 2 missed"


def test_a_false_alarm_of_one_frame_is_left_out():
    alarm = np.vstack([at(2), [40.0, 40.0]])
    result = steadied({0: at(0), 1: at(1), 2: alarm, 3: at(3), 4: at(4)}, 2)
    np.testing.assert_allclose(result.ground_m, at(2))


def test_a_box_that_the_edge_cuts_stays_for_nobody_follows_it():
    alarm = np.vstack([at(2), [40.0, 40.0]])
    frames = {0: at(0), 1: at(1), 2: alarm, 3: at(3), 4: at(4)}
    assert len(steadied(frames, 2, [True, True, True, False]).boxes) == 4


@pytest.mark.parametrize("frames", [{2: at(2)}, {1: at(1)[:1], 2: at(2)}], ids=["alone", "one witness"])
def test_with_too_few_witnesses_every_box_is_believed(frames):
    assert len(steadied(frames, len(frames) - 1).boxes) == 3


def test_an_animal_seen_only_before_the_instant_has_left():
    result = steadied({0: at(0), 1: at(1), 2: at(2)[1:], 3: at(3)[1:], 4: at(4)[1:]}, 2)
    assert len(result.boxes) == 2


def test_frames_half_a_second_away_are_no_witnesses():
    alarm = np.vstack([at(2), [40.0, 40.0]])
    result = steadied({0: at(0), 2: alarm, 5: at(5), 6: at(6)}, 1)
    assert len(result.boxes) == 4
