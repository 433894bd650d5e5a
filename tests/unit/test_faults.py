"""When a scenario's faults begin and end, and to whom they are done."""

from typing import Any

import pytest

from procs.navigator.states import State
from tools.sim.faults import FaultPlan
from tools.sim.settings import Fault


class Notes:
    """A victim that writes down what it suffers."""

    def __init__(self) -> None:
        self.suffered: list[tuple[Any, ...]] = []

    def dive(self, on: bool) -> None:
        self.suffered.append(("dive", on))

    def kill(self, drone_id: int) -> None:
        self.suffered.append(("kill", drone_id))

    def cut(self, first: int, second: int, on: bool) -> None:
        self.suffered.append(("cut", first, second, on))


def run(plan: FaultPlan, until_s: float, from_s: float = 0.0) -> list[tuple[float, Any]]:
    """Step twice a second -> (when, what was suffered)."""
    notes, told = Notes(), []
    for half in range(round(from_s * 2), round(until_s * 2) + 1):
        plan.step(half / 2, notes)
        told += [(half / 2, one) for one in notes.suffered]
        notes.suffered.clear()
    return told


def states(plan: FaultPlan, **by_drone: State) -> None:
    for name, state in by_drone.items():
        plan.hear(int(name[1:]), state)


def test_a_dive_begins_after_its_delay_and_ends_after_its_time():
    plan = FaultPlan([Fault(kind="dive", when="start", after_s=5, for_s=20)])
    assert run(plan, 60.0) == [(5.0, ("dive", True)), (25.0, ("dive", False))]


def test_a_cut_is_mended_and_a_death_is_not():
    cut = Fault(kind="cut", when="start", after_s=0, for_s=15, between=(2, 3))
    plan = FaultPlan([cut, Fault(kind="kill", when="start", after_s=1, for_s=5, drone=2)])
    assert run(plan, 60.0) == [
        (0.0, ("cut", 2, 3, True)),
        (1.0, ("kill", 2)),
        (15.0, ("cut", 2, 3, False)),
    ]


@pytest.mark.parametrize(
    ("when", "before", "after"),
    [
        ("scout", State.STANDBY, State.SCOUT),
        ("found", State.SCOUT, State.FOUND),
        ("register", State.RENDEZVOUS, State.REGISTER),
    ],
)
def test_one_drone_in_a_stage_is_enough_to_reach_it(when, before, after):
    plan = FaultPlan([Fault(kind="dive", when=when, after_s=2)])
    states(plan, d1=before, d2=State.STANDBY)
    assert run(plan, 10.0) == []
    states(plan, d1=after)
    assert run(plan, 20.0, from_s=10.0) == [(12.0, ("dive", True))]


def test_monitor_is_reached_when_all_but_those_that_stand_by_watch():
    plan = FaultPlan([Fault(kind="dive", when="monitor", after_s=0)])
    states(plan, d1=State.MONITOR, d2=State.ASSIGN, d3=State.STANDBY)
    assert run(plan, 1.0) == []
    states(plan, d2=State.MONITOR)
    assert run(plan, 2.0, from_s=2.0) == [(2.0, ("dive", True))]


def test_a_stage_that_was_reached_once_counts_though_it_is_over():
    plan = FaultPlan([Fault(kind="dive", when="scout", after_s=3)])
    states(plan, d1=State.SCOUT)
    assert run(plan, 0.0) == []
    states(plan, d1=State.MONITOR)
    assert run(plan, 5.0, from_s=0.5) == [(3.0, ("dive", True))]


def test_nobody_named_is_the_drone_that_scouts():
    plan = FaultPlan([Fault(kind="kill", when="scout", after_s=0)])
    states(plan, d1=State.RETURN, d2=State.SCOUT, d3=State.STANDBY)
    assert run(plan, 1.0) == [(0.0, ("kill", 2))]
