"""Whose word the navigator takes: the ring's once it is settled, the boat's where it is meant."""

import numpy as np
import pytest

from lcmtypes import make, podwatch
from procs.navigator.mission import Inputs, Navigator
from procs.navigator.situation import Situation
from procs.navigator.states import State
from tests.unit.navigator_flights import Fleet, mission

POD = np.array([[92.0, -8.0], [104.0, 3.0], [96.0, 12.0]])


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
    navigator = Navigator(mission(2), 1)
    fleet = make(podwatch.fleet_state_t)
    fleet.order = make(podwatch.operator_t, utime=1, command=podwatch.operator_t.HOLD, target=target)
    now = Situation(navigator.mission, 1, Inputs(2, fleet=fleet), navigator.memory)
    assert (now.command == podwatch.operator_t.HOLD) is holds
