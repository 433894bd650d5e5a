"""A navigator that starts while the bridge has not heard the autopilot yet: both were killed in flight."""

from dataclasses import replace

import pytest

from drivers.autopilots.ardupilot import mavlink
from lcmtypes import make, podwatch
from procs.autopilot.telemetry import Telemetry
from procs.navigator.mission import Inputs, Navigator
from procs.navigator.states import State
from procs.settings import Mission, OriginSettings

S = 1_000_000
NEVER_MS = 2**31 - 1


def vehicle(utime: int, *, heard: bool) -> podwatch.vehicle_state_t:
    """What the bridge says in flight; before it has heard the autopilot, its defaults."""
    if not heard:
        return make(podwatch.vehicle_state_t, utime=utime, landed=True, link_age_ms=NEVER_MS)
    return make(
        podwatch.vehicle_state_t,
        utime=utime,
        d_m=-30.0,
        armed=True,
        guided=True,
        position_ok=True,
        battery=0.9,
    )


def test_it_waits_for_the_autopilot_and_then_goes_on_instead_of_thinking_that_it_stands_on_the_ground():
    row = make(podwatch.fleet_row_t, id=2, alive=True, state=State.RENDEZVOUS, animal=-1, found=True)
    fleet = make(podwatch.fleet_state_t, n_rows=1, rows=[row], members=2)
    navigator = Navigator(Mission(), 2)
    states: list[int] = []
    for tick in range(60):
        utime = 100 * S + tick * S // 10
        fleet.utime = utime
        outputs = navigator.update(Inputs(utime=utime, vehicle=vehicle(utime, heard=tick >= 25), fleet=fleet))
        if outputs.mission is None:
            assert tick < 25, "it says nothing of itself before it knows whether it flies"
            assert outputs.setpoint.kind == podwatch.setpoint_t.IDLE
        else:
            states.append(outputs.mission.state)
    assert states[0] == State.HOLD
    assert states[-1] == State.RENDEZVOUS
    assert State.IDLE not in states


@pytest.mark.parametrize("heard", [True, False])
def test_on_the_ground_it_begins_only_with_an_autopilot(heard):
    navigator = Navigator(Mission(), 2)
    outputs = None
    for tick in range(40):
        utime = 100 * S + tick * S // 10
        on_ground = make(
            podwatch.vehicle_state_t, utime=utime, landed=True, link_age_ms=0 if heard else NEVER_MS
        )
        outputs = navigator.update(Inputs(utime=utime, vehicle=on_ground))
    assert outputs is not None
    assert (outputs.mission is not None) == heard


def test_a_bridge_that_starts_anew_in_flight_says_nothing_of_the_vehicle_before_it_was_told():
    """Its defaults are "landed, disarmed, battery empty": a drone that believed them would come down."""
    telemetry = Telemetry(OriginSettings())
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 3, mavlink.MAV_MODE_FLAG_SAFETY_ARMED, 4, 4, 3)
    telemetry.hear(heartbeat, 1 * S)
    assert not telemetry.is_known
    telemetry.hear(mavlink.MAVLink_sys_status_message(*[0] * 6, 80, *[0] * 6), 2 * S)
    assert telemetry.is_known
    assert (telemetry.armed, telemetry.landed, telemetry.battery) == (True, False, 0.8)
    telemetry.hear(heartbeat, 60 * S)  # after a silence, as of a restart
    assert telemetry.battery == 0.8, "it has not run empty meanwhile"


def test_in_doubt_whether_the_autopilot_is_heard_no_drone_has_touched_down():
    navigator = Navigator(Mission(), 2)
    states: list[int] = []
    for tick in range(80):
        utime = 100 * S + tick * S // 10
        outputs = navigator.update(Inputs(utime=utime, vehicle=vehicle(utime, heard=not 40 <= tick < 60)))
        if outputs.mission is not None:
            states.append(outputs.mission.state)
    assert State.LANDED not in states
    assert State.LAND not in states


def position_lost(utime: int, **members: float | bool) -> Inputs:
    """The position stopped 10 s ago; the autopilot still tells of itself."""
    state = {"d_m": -30.0, "armed": True, "guided": True, "battery": 0.9} | members
    message = make(podwatch.vehicle_state_t, utime=utime - 10 * S, position_ok=False, **state)
    return Inputs(utime=utime, vehicle=message, vehicle_heard_us=utime)


def held_in_flight(last: State = State.SCOUT) -> Navigator:
    """A navigator that was restarted in flight a moment ago, without a position."""
    row = make(podwatch.fleet_row_t, id=2, alive=True, state=last, animal=-1)
    fleet = make(podwatch.fleet_state_t, utime=100 * S, n_rows=1, rows=[row], members=2)
    navigator = Navigator(Mission(), 2)
    navigator.update(replace(position_lost(100 * S), fleet=fleet))
    assert navigator.state == State.HOLD
    return navigator


def test_without_a_position_an_empty_battery_still_brings_it_down_and_the_ground_ends_the_flight():
    navigator = held_in_flight()
    navigator.update(position_lost(101 * S))
    assert navigator.state == State.HOLD
    outputs = navigator.update(position_lost(102 * S, battery=0.05))
    assert navigator.state == State.LAND
    outputs = navigator.update(position_lost(103 * S, battery=0.05))
    assert outputs.setpoint.kind == podwatch.setpoint_t.LAND
    navigator.update(position_lost(104 * S, armed=False, landed=True))
    assert navigator.state == State.LANDED


def test_without_a_position_the_pilot_still_wins():
    navigator = held_in_flight()
    outputs = navigator.update(position_lost(101 * S, guided=False, battery=0.05))
    assert (navigator.state, outputs.setpoint.kind) == (State.HOLD, podwatch.setpoint_t.IDLE)


def test_what_the_bridge_said_before_it_fell_silent_counts_no_more():
    navigator = held_in_flight()
    old = position_lost(101 * S, armed=False, landed=True, battery=0.05)
    navigator.update(replace(old, utime=103 * S))
    assert navigator.state == State.HOLD


def flying_low(utime: int, **members: float | bool) -> Inputs:
    """Low over the sea, on its way down; `members` say otherwise."""
    state = {"d_m": -4.0, "armed": True, "guided": True, "position_ok": True, "battery": 0.9} | members
    row = make(podwatch.fleet_row_t, id=2, alive=True, state=State.LAND, animal=-1)
    fleet = make(podwatch.fleet_state_t, utime=utime, n_rows=1, rows=[row], members=2)
    return Inputs(utime=utime, vehicle=make(podwatch.vehicle_state_t, utime=utime, **state), fleet=fleet)


def test_a_drone_that_was_coming_down_lands_on_at_once():
    navigator = Navigator(Mission(), 2)
    for tick in range(10):
        outputs = navigator.update(flying_low(100 * S + tick * S // 10))
        assert outputs.mission is not None
        assert (outputs.mission.state, outputs.setpoint.kind) == (State.LAND, podwatch.setpoint_t.LAND)


def test_a_drone_that_was_coming_down_and_that_the_pilot_has_meanwhile_is_the_pilots():
    navigator = Navigator(Mission(), 2)
    outputs = navigator.update(flying_low(100 * S, guided=False))
    assert (navigator.state, outputs.setpoint.kind) == (State.HOLD, podwatch.setpoint_t.IDLE)


def landed() -> Navigator:
    navigator = Navigator(Mission(), 2)
    navigator.update(flying_low(100 * S, armed=False, landed=True))
    assert navigator.state == State.LANDED
    return navigator


def test_a_landed_drone_that_is_in_the_air_after_all_holds_and_lands_on():
    navigator = landed()
    for tick in range(30):
        navigator.update(flying_low(101 * S + tick * S // 10))
        assert navigator.state == (State.HOLD if tick <= 20 else State.LAND)


def test_a_landed_drone_in_the_air_is_the_pilots_while_he_flies_and_lands_on_an_empty_battery():
    navigator = landed()
    for tick in range(60):
        outputs = navigator.update(flying_low(101 * S + tick * S // 10, guided=False, battery=0.05))
    assert (navigator.state, outputs.setpoint.kind) == (State.HOLD, podwatch.setpoint_t.IDLE)
    navigator.update(flying_low(108 * S, battery=0.05))
    assert navigator.state == State.LAND


@pytest.mark.parametrize(
    "members", [{"armed": False, "landed": True}, {"landed": True}, {"link_age_ms": NEVER_MS}]
)
def test_a_landed_drone_stays_so_on_the_ground_and_without_a_word_of_the_autopilot(members):
    navigator = landed()
    navigator.update(flying_low(101 * S, **members))
    assert navigator.state == State.LANDED


@pytest.mark.parametrize(("given_s", "offset_s", "state"), [(99, 0, State.LANDED), (99, -5, State.TAKEOFF)])
def test_a_start_order_of_before_it_was_found_landed_does_not_take_it_off_again(given_s, offset_s, state):
    """The order is still in force, and the restarted navigator does not know that it was obeyed already."""
    navigator = landed()
    for tick in range(40):
        inputs = flying_low(100 * S + tick * S // 10, d_m=0.0, armed=False, landed=True)
        inputs.fleet.fleet_offset_us = offset_s * S
        inputs.fleet.order = make(
            podwatch.operator_t, utime=given_s * S, command=podwatch.operator_t.START, expiry_s=600
        )
        navigator.update(inputs)
    assert navigator.state == state
