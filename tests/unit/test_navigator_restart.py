"""A navigator that starts while the bridge has not heard the autopilot yet: both were killed in flight."""

import pytest

from lcmtypes import make, podwatch
from procs.navigator.mission import Inputs, Navigator
from procs.navigator.states import State
from procs.settings import Mission

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
