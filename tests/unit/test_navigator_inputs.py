"""What the navigator takes of what it hears: whose word, for how long, and of which instant."""

import numpy as np
import pytest

from lcmtypes import make, podwatch
from procs.history import camera_of
from procs.navigator.mission import Inputs, Navigator
from procs.navigator.monitor import look
from procs.navigator.situation import VEHICLE_LIMIT_S, Situation
from procs.navigator.states import State
from tests.unit.navigator_flights import Fleet, mission

S = 1_000_000
POD = np.array([[92.0, -8.0], [104.0, 3.0], [96.0, 12.0]])


def vehicle(utime: int, **members: float | bool) -> podwatch.vehicle_state_t:
    """In flight, 30 m up."""
    flying = {"d_m": -30.0, "armed": True, "guided": True, "position_ok": True, "battery": 0.9}
    return make(podwatch.vehicle_state_t, utime=utime, **{**flying, **members})


def situation(inputs: Inputs, n: int = 1, drone_id: int = 1) -> Situation:
    navigator = Navigator(mission(n), drone_id)
    return Situation(navigator.mission, drone_id, inputs, navigator.memory)


def test_another_animal_is_taken_up_when_the_ring_has_settled_it() -> None:
    fleet = Fleet(mission(1), POD)
    drone = fleet.drone(1)
    fleet.run(120.0, lambda: fleet.all_in(State.MONITOR))
    before = drone.navigator.memory.animal
    other = (before + 1) % len(POD)
    newest = {"episode": fleet.episode + 1, "proposer": 1}
    drone.assigned = make(podwatch.assignment_t, **newest, animal=before, running=True)
    fleet.run(1.0)
    assert drone.navigator.memory.animal == before
    drone.assigned = make(podwatch.assignment_t, **newest, animal=other, certified=True)
    fleet.run(1.0)
    assert drone.navigator.memory.animal == other


@pytest.mark.parametrize(("target", "holds"), [(0, True), (1, True), (2, False)])
def test_an_order_for_another_drone_is_none(target: int, holds: bool) -> None:
    fleet = make(podwatch.fleet_state_t)
    fleet.order = make(podwatch.operator_t, utime=1, command=podwatch.operator_t.HOLD, target=target)
    assert (situation(Inputs(2, fleet=fleet), n=2).command == podwatch.operator_t.HOLD) is holds


def test_a_position_that_has_not_come_for_a_second_is_doubt_though_the_rest_is_new() -> None:
    last_good_us = S + round(VEHICLE_LIMIT_S * S)
    for utime, is_ok in ((last_good_us, True), (last_good_us + 1, False)):
        assert situation(Inputs(utime, vehicle(S), vehicle_heard_us=utime)).vehicle_ok is is_ok


@pytest.mark.parametrize("member", ["n_m", "e_m", "d_m"])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_position_that_is_no_number_is_doubt(member: str, number: float) -> None:
    assert situation(Inputs(S, vehicle(S))).vehicle_ok
    assert not situation(Inputs(S, vehicle(S, **{member: number}))).vehicle_ok


def test_drones_fly_in_layers_of_their_own_at_least_2_m_apart() -> None:
    for lowest_m in (12.0, 30.0):
        heights = [situation(Inputs(S), n=4, drone_id=k).layer(lowest_m) for k in (1, 2, 3, 4)]
        assert heights == sorted(heights)
        assert min(np.diff(heights)) >= 2.0
        assert heights[0] == lowest_m


@pytest.mark.parametrize(("share", "state"), [(0.99, State.IDLE), (1.01, State.TAKEOFF)])
def test_nobody_takes_off_with_less_charge_than_sends_it_home(share: float, state: State) -> None:
    fleet = Fleet(mission(1), POD)
    fleet.drone(1).battery = share * fleet.mission.limits.battery_return
    fleet.run(10.0, lambda: fleet.drone(1).navigator.state != State.IDLE)
    assert fleet.drone(1).navigator.state == state


@pytest.mark.parametrize(("animal", "is_seen"), [(2, True), (3, False)])
def test_a_track_counts_for_its_own_animal_and_from_where_the_drone_was_then(
    animal: int, is_seen: bool
) -> None:
    navigator = Navigator(mission(1), 1)
    camera = camera_of(navigator.mission.camera)
    navigator.memory.animal = 2
    for tenth in range(11):  # 10 m/s to the north, and the handling is a second late
        navigator.hear_vehicle(vehicle(S + tenth * S // 10, n_m=float(tenth), e_m=5.0))
    middle = {"u_px": camera.image_size[0] / 2, "v_px": camera.image_size[1] / 2}
    track = make(podwatch.track_t, utime=S, animal=animal, state=podwatch.track_t.TRACKING, **middle)
    now = Situation(navigator.mission, 1, Inputs(2 * S, track=track), navigator.memory)
    look(now, navigator.memory, camera)
    seen_ne = navigator.memory.animal_filter.ne
    assert (seen_ne is not None) is is_seen
    if seen_ne is not None:
        assert seen_ne == pytest.approx([0.0, 5.0], abs=1e-6)
