"""Who is kept clear of: drones that are heard, and drones that have fallen silent in the air."""

import numpy as np
import pytest

from lcmtypes import make, podwatch
from procs.navigator.flight import approach
from procs.navigator.mission import Inputs, Navigator
from procs.navigator.situation import Situation
from procs.navigator.states import State
from tests.unit.navigator_flights import Fleet, mission
from tests.unit.test_navigator_mission import POD


def pushed_off_m(age_s: float, alive: bool = False, table_s: float = 0.0, d_m: float = -30.0) -> float:
    """How far from its goal a drone ends that flies to where another was last heard, `age_s` ago.

    `table_s` of this age is that of the fleet table itself.
    """
    navigator = Navigator(mission(2), 1)
    row = make(podwatch.fleet_row_t, id=2, alive=alive, age_ms=round(1e3 * (age_s - table_s)), d_m=d_m)
    place, goal, utime = np.array([20.0, 0.0, -30.0]), np.array([0.0, 0.0, -30.0]), 100_000_000
    fleet = make(podwatch.fleet_state_t, utime=utime - round(1e6 * table_s), n_rows=1, rows=[row])
    for _ in range(300):
        vehicle = make(podwatch.vehicle_state_t, utime=utime, n_m=place[0], e_m=place[1], d_m=place[2])
        now = Situation(navigator.mission, 1, Inputs(utime, vehicle, fleet=fleet), navigator.memory)
        place = place + 0.1 * navigator._clear(now, approach(place, goal, 6.0))
    return float(np.linalg.norm(place - goal))


@pytest.mark.parametrize("alive", [True, False])
def test_a_drone_that_has_fallen_silent_is_kept_clear_of_as_its_place_grows_uncertain(alive: bool) -> None:
    assert pushed_off_m(4.0, alive) == pytest.approx(5.5, abs=0.1), "lost after 3 s, and still there"
    assert pushed_off_m(10.0, alive) == pytest.approx(6.5, abs=0.1)
    assert pushed_off_m(29.0, alive) == pytest.approx(9.5, abs=0.1)
    assert pushed_off_m(10.0, alive, d_m=0.0) < 0.1, "on the ground"


def test_after_half_a_minute_the_silent_are_gone_and_the_living_are_not() -> None:
    assert pushed_off_m(31.0) < 0.1
    assert pushed_off_m(31.0, alive=True) > 9.0
    assert pushed_off_m(31.0, alive=True, table_s=31.0) < 0.1, "the table is as old: nobody knows who lives"


def test_what_moved_when_it_fell_silent_is_not_carried_on_for_ever() -> None:
    """A velocity of half a minute ago would put it a hundred metres from where it may hang."""
    navigator = Navigator(mission(2), 1)
    row = make(podwatch.fleet_row_t, id=2, age_ms=20_000, n_m=0.0, d_m=-30.0, vn_m_s=4.0)
    vehicle = make(podwatch.vehicle_state_t, utime=100_000_000, n_m=20.0, e_m=-18.0, d_m=-30.0)
    fleet = make(podwatch.fleet_state_t, utime=100_000_000, n_rows=1, rows=[row])
    now = Situation(navigator.mission, 1, Inputs(100_000_000, vehicle, fleet=fleet), navigator.memory)
    bent = navigator._clear(now, np.array([0.0, 6.0, 0.0]))
    assert bent[1] == pytest.approx(0.7 * (18.0 - 5.5 - 4.0 - 3.0))


def test_the_others_fly_round_a_drone_whose_relay_died_over_its_animal() -> None:
    """Its row says no more than where it was; in the sky it is still there."""
    fleet = Fleet(mission(3), POD[:3])
    fleet.run(120.0, lambda: fleet.all_in(State.MONITOR))
    silent = fleet.drone(2)
    share, gone_us = fleet._row, fleet.utime
    last = share(silent)

    def row(drone):
        if drone is not silent:
            return share(drone)
        last.alive, last.age_ms = fleet.utime - gone_us < 3_000_000, (fleet.utime - gone_us) // 1000
        return last

    fleet._row, silent.fly = row, lambda: None  # it hangs there
    other = fleet.drone(1)
    # Its animal swims right under the silent one, which the certificate of an older episode does not say.
    fleet.animals[other.navigator.memory.animal] = silent.ned[:2] + [0.5, 0.0]
    other.navigator.mission = fleet.mission.model_copy(
        update={"watch": fleet.mission.watch.model_copy(update={"height_m": -silent.ned[2]})}
    )
    fleet.closest_m = np.inf
    fleet.run(20.0)
    assert fleet.closest_m > 4.0
