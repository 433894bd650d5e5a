"""The navigator flown through whole missions in virtual time: point masses, a fleet table that is a moment
old, no clock.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lcmtypes import make, podwatch
from procs.navigator.mission import Navigator
from procs.navigator.states import Event, State
from tests.unit.navigator_flights import Array, Drone, Fleet, mission

POD = np.array([[92.0, -8.0], [104.0, 3.0], [96.0, 12.0], [110.0, -6.0], [101.0, -15.0]])
DRIFT = np.array([0.5, 0.2])


def flown_to(
    state: State, n: int = 3, animals: np.ndarray = POD, seed: int = 0, limit_s: float = 120.0
) -> Fleet:
    fleet = Fleet(mission(n), animals, DRIFT, seed)
    fleet.run(limit_s, lambda: fleet.all_in(state))
    assert fleet.all_in(state), [drone.navigator.state.name for drone in fleet.drones]
    return fleet


def animals_of(fleet: Fleet) -> list[int]:
    return [drone.navigator.memory.animal for drone in fleet.drones if drone.alive]


def off_centre(fleet: Fleet, drone: Drone) -> float:
    """How far from the image's centre the own animal stands, as a share of the image's height."""
    points, _ = fleet.pixels(drone)
    middle = np.array(fleet.camera.image_size) / 2
    return float(np.linalg.norm(points[drone.navigator.memory.animal] - middle) / fleet.camera.image_size[1])


@pytest.mark.parametrize("n", [1, 3])
def test_a_fleet_searches_gathers_watches_and_lands(n: int) -> None:
    fleet = flown_to(State.MONITOR, n)
    assert len(set(animals_of(fleet))) == n
    fleet.run(12.0)
    assert all(off_centre(fleet, drone) < 0.1 for drone in fleet.drones)
    watched_s = 12.0 + fleet.run(30.0, lambda: fleet.all_in(State.RETURN))
    assert 20.0 <= watched_s <= 24.0
    fleet.run(90.0, lambda: fleet.all_in(State.LANDED))
    assert fleet.all_in(State.LANDED)
    for drone in fleet.drones:
        home = fleet.mission.home(drone.id)
        assert np.hypot(drone.ned[0] - home.home_n_m, drone.ned[1] - home.home_e_m) < 3.0
        middle = [State.RENDEZVOUS, State.REGISTER, State.ASSIGN, State.MONITOR, State.RETURN]
        assert [s for s in drone.states if s in middle] == middle
    assert State.SCOUT in fleet.drone(1).states
    assert all(State.SCOUT not in drone.states for drone in fleet.drones[1:])
    assert fleet.closest_m > 0.6 * fleet.mission.watch.separation_m


def test_more_drones_than_animals_stand_by_near_the_pod_and_return() -> None:
    fleet = Fleet(mission(4), POD[:2], DRIFT)
    fleet.run(120.0, lambda: fleet.all_in(State.MONITOR, State.STANDBY) and fleet.episode > 0)
    fleet.run(10.0)
    assert sorted(animals_of(fleet)) == [-1, -1, 0, 1]
    waiting = [drone for drone in fleet.drones if drone.navigator.state == State.STANDBY]
    assert all(np.linalg.norm(drone.ned[:2] - fleet.animals.mean(axis=0)) < 40 for drone in waiting)
    fleet.run(120.0, lambda: fleet.all_in(State.LANDED))
    assert fleet.all_in(State.LANDED)


def test_the_next_drone_scouts_on_from_the_last_waypoint() -> None:
    far = np.array([[100.0, 70.0], [104.0, 74.0]])
    fleet = Fleet(mission(3), far)
    fleet.run(120.0, lambda: fleet.drone(1).navigator.memory.waypoint >= 3)
    fleet.drone(1).alive = False
    fleet.run(10.0, lambda: fleet.drone(2).navigator.state == State.SCOUT)
    assert fleet.drone(2).navigator.memory.target_waypoint is None or (
        fleet.drone(2).navigator.memory.target_waypoint >= 3
    )
    assert fleet.drone(3).navigator.state == State.STANDBY
    fleet.run(150.0, lambda: fleet.all_in(State.MONITOR))
    assert fleet.all_in(State.MONITOR)
    assert len(set(animals_of(fleet))) == 2


def test_a_navigator_that_restarts_in_flight_takes_up_state_and_animal() -> None:
    fleet = flown_to(State.MONITOR)
    fleet.run(3.0)
    animal = fleet.drone(2).navigator.memory.animal
    place = fleet.drone(2).ned.copy()
    fleet.restart(2)
    took_s = fleet.run(6.0, lambda: fleet.drone(2).navigator.state == State.MONITOR)
    assert took_s < 5.0
    assert fleet.drone(2).navigator.memory.animal == animal
    assert np.linalg.norm(fleet.drone(2).ned - place) < 6.0
    assert State.TAKEOFF not in fleet.drone(2).states[-2:]
    fleet.run(60.0, lambda: fleet.all_in(State.RETURN, State.LAND))
    assert fleet.all_in(State.RETURN, State.LAND)


def test_a_scout_that_restarts_goes_on_scouting_and_never_takes_off_in_flight() -> None:
    fleet = Fleet(mission(2), np.array([[100.0, 90.0]]))
    fleet.run(120.0, lambda: fleet.drone(1).navigator.memory.waypoint >= 2)
    fleet.restart(1)
    fleet.run(6.0)
    assert fleet.drone(1).navigator.state == State.SCOUT
    assert fleet.drone(1).navigator.memory.waypoint >= 2
    assert fleet.drone(1).states.count(State.TAKEOFF) == 1


def test_an_animal_that_comes_up_beside_the_find_is_gathered_over_too(monkeypatch: Any) -> None:
    """Seed 25 of the default flight: the find was one animal, the other four came up 22 to 26 m from it, and
    the fleet went down over the one.
    """
    away_m = 26.0
    fleet = Fleet(mission(3), POD[0] + np.array([[0.0, 0.0], [away_m, 0.0]]))
    pixels = fleet.pixels

    def only_the_first_until_it_is_found(drone: Drone) -> tuple[Array, NDArray[np.bool_]]:
        points, inside = pixels(drone)
        inside[1] &= any(State.RENDEZVOUS in one.states for one in fleet.drones)
        return points, inside

    monkeypatch.setattr(fleet, "pixels", only_the_first_until_it_is_found)
    fleet.run(120.0, lambda: fleet.episode > 0)
    finds = [drone.navigator.memory.find for drone in fleet.drones]
    assert all(find is not None and find.radius_m > away_m / 2 for find in finds), finds


def test_a_pod_that_dives_for_20_s_is_waited_for() -> None:
    fleet = flown_to(State.MONITOR)
    fleet.run(3.0)
    before = animals_of(fleet)
    fleet.visible = False
    fleet.run(14.0)
    heights = [-drone.ned[2] for drone in fleet.drones]
    assert fleet.all_in(State.MONITOR)
    fleet.visible = True
    fleet.run(2.0)
    assert fleet.all_in(State.MONITOR)
    assert animals_of(fleet) == before
    # While it is not seen each drone climbs, so that more of the sea is in view.
    assert min(heights) > fleet.mission.watch.height_m + 3


def test_an_animal_that_stays_away_sends_the_drone_back_to_gather() -> None:
    settings = mission(1, watch={"watch_s": 200.0})
    fleet = Fleet(settings, POD[:1])
    fleet.run(120.0, lambda: fleet.all_in(State.MONITOR))
    fleet.visible = False
    gone_s = fleet.run(60.0, lambda: not fleet.all_in(State.MONITOR))
    assert 39.0 < gone_s < 42.0
    assert fleet.drone(1).navigator.state == State.RENDEZVOUS
    fleet.run(5.0)
    fleet.visible = True
    fleet.run(1.0)
    assert fleet.drone(1).navigator.state == State.MONITOR
    assert fleet.drone(1).navigator.memory.animal == 0


def test_a_pod_that_comes_up_as_strangers_is_agreed_on_anew_without_waiting() -> None:
    fleet = flown_to(State.MONITOR)
    fleet.run(3.0)
    fleet.visible = False
    fleet.run(12.0)
    assert fleet.all_in(State.MONITOR), "nothing to be seen: it waits for its animal"
    box = make(podwatch.box_t, left_px=1, right_px=2, top_px=1, bottom_px=2)
    strangers = make(podwatch.identities_t, episode=1, consensus=True, n_boxes=1, boxes=[box], ids=[-1])
    fleet._identities = lambda: strangers
    waited_s = fleet.run(20.0, lambda: fleet.all_in(State.RENDEZVOUS))
    assert 2.9 < waited_s < 4.0


def test_a_drone_lost_in_monitor_leaves_the_others_at_work() -> None:
    fleet = flown_to(State.MONITOR)
    fleet.drone(2).alive = False
    fleet.run(10.0)
    assert fleet.all_in(State.MONITOR)


@pytest.mark.parametrize(("towards_m_s", "ends_in"), [(0.0, State.RENDEZVOUS), (1.5, State.MONITOR)])
def test_a_drone_over_anothers_animal_is_a_conflict_unless_it_passes_on_to_its_own(
    towards_m_s: float, ends_in: State
) -> None:
    fleet = flown_to(State.MONITOR)
    fleet.run(10.0)
    first, second = fleet.drone(1), fleet.drone(2)
    mine, theirs = (fleet.animals[drone.navigator.memory.animal] for drone in (first, second))
    way = (theirs - mine) / np.linalg.norm(theirs - mine)
    share = fleet._share

    def say_it_is_over_the_first_ones_animal() -> None:
        share()
        for row in fleet.rows:
            if row.id == 2:
                row.n_m, row.e_m = mine
                row.vn_m_s, row.ve_m_s = towards_m_s * way

    fleet._share = say_it_is_over_the_first_ones_animal
    fleet.run(5.0)
    assert first.navigator.state == ends_in


def test_of_two_drones_with_one_animal_the_higher_gathers_again() -> None:
    fleet = flown_to(State.MONITOR, n=2)
    fleet.run(2.0)
    fleet.drone(2).navigator.memory.animal = fleet.drone(1).navigator.memory.animal
    fleet.run(6.0, lambda: fleet.drone(2).navigator.state != State.MONITOR)
    assert fleet.drone(2).navigator.state == State.RENDEZVOUS
    assert fleet.drone(1).navigator.state == State.MONITOR
    fleet.run(60.0, lambda: fleet.all_in(State.MONITOR))
    assert len(set(animals_of(fleet))) == 2


def test_without_consensus_the_fleet_tries_again_from_other_places() -> None:
    fleet = Fleet(mission(3), POD)
    fleet.agrees = False
    fleet.run(150.0, lambda: fleet.episode >= 2)
    assert fleet.episode >= 2
    assert not any(State.ASSIGN in drone.states for drone in fleet.drones)
    fleet.agrees = True
    fleet.run(60.0, lambda: fleet.all_in(State.MONITOR))
    assert fleet.all_in(State.MONITOR)


@pytest.mark.parametrize(
    ("command", "state"),
    [
        (podwatch.operator_t.HOLD, State.HOLD),
        (podwatch.operator_t.RETURN, State.RETURN),
        (podwatch.operator_t.LAND, State.LAND),
    ],
)
def test_an_order_is_obeyed_at_once(command: int, state: State) -> None:
    fleet = Fleet(mission(1), POD)
    fleet.run(60.0, lambda: fleet.drone(1).ned[0] > 20)
    fleet.command = command
    fleet.run(1.0)
    assert fleet.drone(1).navigator.state == state
    if state == State.HOLD:
        fleet.run(20.0)
        assert fleet.drone(1).navigator.state == State.HOLD
        fleet.command = podwatch.operator_t.NONE
        fleet.run(1.0)
        assert fleet.drone(1).navigator.state == State.SCOUT


def test_an_order_to_leave_an_animal_lets_go_of_it() -> None:
    fleet = flown_to(State.MONITOR, n=1)
    left = fleet.drone(1).navigator.memory.animal
    fleet.left = (left,)
    fleet.run(1.0)
    assert fleet.drone(1).navigator.state == State.STANDBY, "it makes way, and nobody gathers for that"
    assert fleet.drone(1).navigator.memory.animal == -1
    fleet.run(20.0)
    assert fleet.drone(1).navigator.memory.animal != left, "its old certificate gives it back to nobody"


@pytest.mark.parametrize(
    ("lost_return_s", "age_ms", "state"),
    [
        (30.0, 31_000, State.RETURN),
        (30.0, 29_000, State.SCOUT),
        (30.0, -1, State.SCOUT),  # there never was one
        (0.0, 600_000, State.SCOUT),  # nobody asked for it
    ],
)
def test_a_lost_boat_brings_the_fleet_home_where_the_mission_says_so(
    lost_return_s: float, age_ms: int, state: State
) -> None:
    fleet = Fleet(mission(1, boat={"lost_return_s": lost_return_s}), POD)
    fleet.visible = False
    fleet.run(40.0)
    fleet.boat_age_ms = age_ms
    fleet.run(0.5)
    assert fleet.drone(1).navigator.state == state
    if state == State.RETURN:
        assert fleet.drone(1).navigator.memory.reason == "the boat is silent"


def test_a_lost_boat_ends_its_order_to_hold_and_a_relay_that_forgot_it_does_not_make_it_found() -> None:
    fleet = Fleet(mission(1, boat={"lost_return_s": 30.0}), POD)
    fleet.run(60.0, lambda: fleet.drone(1).ned[0] > 20)
    fleet.command, fleet.boat_age_ms = podwatch.operator_t.HOLD, 0
    fleet.run(1.0)
    assert fleet.drone(1).navigator.state == State.HOLD
    fleet.boat_age_ms = -1
    fleet.run(28.0)
    assert fleet.drone(1).navigator.state == State.HOLD
    fleet.run(4.0)
    assert fleet.drone(1).navigator.state in (State.RETURN, State.LAND)


def test_the_pilot_always_wins_and_hands_back() -> None:
    fleet = Fleet(mission(1), POD)
    fleet.run(60.0, lambda: fleet.all_in(State.SCOUT))
    drone = fleet.drone(1)
    drone.guided, drone.battery = False, 0.2
    fleet.run(30.0)
    assert drone.navigator.state == State.HOLD
    assert drone.setpoint is not None
    assert drone.setpoint.kind == podwatch.setpoint_t.IDLE
    drone.guided, drone.battery = True, 0.9
    fleet.run(3.0)
    assert drone.navigator.state == State.SCOUT


@pytest.mark.parametrize(("doubt_s", "state"), [(5.0, State.SCOUT), (30.0, State.RETURN)])
def test_doubt_holds_and_a_short_one_is_forgotten(doubt_s: float, state: State) -> None:
    fleet = Fleet(mission(1), POD)
    fleet.run(60.0, lambda: fleet.drone(1).ned[0] > 30)
    drone = fleet.drone(1)
    drone.position_ok = False
    fleet.run(1.0)
    assert drone.navigator.state == State.HOLD
    assert drone.setpoint is not None
    assert drone.setpoint.kind == podwatch.setpoint_t.HOLD
    fleet.run(doubt_s - 1.0)
    assert drone.navigator.state == State.HOLD
    drone.position_ok = True
    fleet.run(2.5)
    assert drone.navigator.state == state


def test_a_low_battery_returns_and_an_empty_one_lands() -> None:
    fleet = Fleet(mission(1), POD)
    fleet.run(60.0, lambda: fleet.drone(1).ned[0] > 20)
    fleet.drone(1).battery = 0.2
    fleet.run(0.5)
    assert fleet.drone(1).navigator.state == State.RETURN
    fleet.drone(1).battery = 0.05
    fleet.run(0.5)
    assert fleet.drone(1).navigator.state == State.LAND
    fleet.run(60.0, lambda: fleet.all_in(State.LANDED))
    fleet.drone(1).battery = 0.9
    fleet.run(10.0)
    assert fleet.drone(1).navigator.state == State.LANDED


def test_a_search_without_a_find_ends_at_home() -> None:
    settings = mission(2, search={"radius_m": 30.0, "north_m": 40.0})
    fleet = Fleet(settings, np.array([[-300.0, 0.0]]))
    fleet.run(200.0, lambda: fleet.all_in(State.LANDED))
    assert fleet.all_in(State.LANDED)


def test_an_operator_start_waits_for_the_order() -> None:
    settings = mission(1, search={"start": "operator"})
    fleet = Fleet(settings, POD)
    fleet.run(10.0)
    assert fleet.drone(1).navigator.state == State.IDLE
    fleet.command = podwatch.operator_t.START
    fleet.run(1.0)
    assert fleet.drone(1).navigator.state == State.TAKEOFF


def test_every_setpoint_keeps_the_limits_and_expires() -> None:
    settings = mission(
        2,
        limits={"fence_radius_m": 95.0, "speed_m_s": 5.0, "climb_m_s": 1.5},
        search={"north_m": 70.0, "radius_m": 20.0},
    )
    fleet = Fleet(settings, POD - np.array([15.0, 0.0]), DRIFT)
    limits = settings.limits
    for _ in range(900):
        fleet.run(0.1)
        for drone in fleet.drones:
            setpoint = drone.setpoint
            assert setpoint is not None
            assert np.hypot(setpoint.vn_m_s, setpoint.ve_m_s) <= limits.speed_m_s + 1e-6
            assert -limits.climb_m_s - 1e-6 <= setpoint.vd_m_s <= limits.descent_m_s + 1e-6
            assert setpoint.expiry_utime == setpoint.utime + round(limits.setpoint_life_s * 1e6)
            assert np.linalg.norm(drone.ned[:2]) < limits.fence_radius_m
    assert any(State.RENDEZVOUS in drone.states for drone in fleet.drones), "over a pod beyond the fence"


def test_a_drone_outside_the_roster_is_refused() -> None:
    with pytest.raises(KeyError, match="drone 9 is not in the roster"):
        Navigator(mission(2), 9)


def test_a_drone_that_gathers_without_a_find_does_not_wait_for_ever() -> None:
    fleet = Fleet(mission(1), POD)
    fleet.run(120.0, lambda: fleet.all_in(State.RENDEZVOUS))
    memory = fleet.drone(1).navigator.memory
    fleet.visible = False
    memory.find = None
    memory.barycentre.reset()
    fleet.run(5.0)
    assert memory.state == State.RENDEZVOUS
    assert memory.find is None
    memory.gather_since_us = fleet.utime - 301_000_000
    fleet.run(0.3)
    assert (memory.state, memory.reason) == (State.RETURN, Event.STUCK.value)


@pytest.mark.parametrize("state", [State.RENDEZVOUS, State.MONITOR])
def test_a_drone_whose_detector_is_silent_goes_home_from_the_circle_and_the_other_goes_on(
    state: State,
) -> None:
    fleet = Fleet(mission(2, watch={"watch_s": 200.0}), POD, DRIFT)
    fleet.run(120.0, lambda: fleet.all_in(state))
    fleet.agrees = state == State.MONITOR
    detections = fleet._detections
    fleet._detections = lambda drone: detections(drone) if drone.id == 1 else None
    blind = fleet.drone(2).navigator.memory
    fleet.run(9.5)
    assert blind.state in ((State.MONITOR,) if state == State.MONITOR else (State.RENDEZVOUS, State.REGISTER))
    fleet.run(2.0)
    if state == State.MONITOR:
        assert blind.state == State.MONITOR, "the tracker goes on"
        return
    assert (blind.state, blind.reason) == (State.RETURN, Event.BLIND.value)
    fleet.agrees = True
    fleet.run(30.0, lambda: fleet.drone(1).navigator.state == State.MONITOR)
    assert fleet.drone(1).navigator.state == State.MONITOR, "that one went home does not end the watch"


def test_a_silent_camera_loses_the_animal_and_then_brings_the_drone_home() -> None:
    fleet = Fleet(mission(1, watch={"watch_s": 200.0}), POD[:1])
    fleet.run(120.0, lambda: fleet.all_in(State.MONITOR))
    said = fleet._identities()  # the last: without detections the registrar says nothing new
    fleet._detections = fleet._track = lambda drone: None
    fleet._identities = lambda: said
    gone_s = fleet.run(80.0, lambda: fleet.all_in(State.RETURN))
    assert 48.0 < gone_s < 54.0
    assert fleet.drone(1).navigator.memory.reason == Event.BLIND.value


@pytest.mark.parametrize("battery", [-1.0, float("nan")])
def test_an_unknown_battery_is_not_an_empty_one(battery: float) -> None:
    fleet = Fleet(mission(2), POD)
    first = fleet.drone(1)
    first.battery = battery
    row_of = fleet._row

    def row(drone: Drone) -> object:
        said = row_of(drone)
        said.battery = max(0.0, said.battery) if said.battery >= 0 else 0.0  # as the relay packs it
        return said

    fleet._row = row
    fleet.run(2.5)
    assert first.said is not None
    assert (first.navigator.state, first.said.reason) == (State.IDLE, "battery unknown")
    fleet.run(120.0, lambda: fleet.all_in(State.RENDEZVOUS))
    assert fleet.all_in(State.RENDEZVOUS)
    assert State.SCOUT in first.states
    assert State.SCOUT not in fleet.drone(2).states
    assert State.RETURN not in first.states
    assert State.LAND not in first.states
