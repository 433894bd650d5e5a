"""A surplus drone takes over from one that was lost; the watch's clock counts what was watched."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest

from lcmtypes import make, podwatch
from procs.navigator import surplus
from procs.navigator.behaviours import PATIENCE_S
from procs.navigator.mission import Inputs, Navigator
from procs.navigator.situation import Situation
from procs.navigator.states import State
from tests.unit.navigator_flights import Drone, Fleet, mission
from tests.unit.test_navigator_mission import DRIFT, POD, flown_to

S = 1_000_000


def three_over_two() -> Fleet:
    """Three drones, two animals: two watch, one stands by."""
    settings = mission(3, watch={"watch_s": 60.0})
    fleet = Fleet(settings, POD[:2], DRIFT)
    fleet.run(120.0, lambda: fleet.episode > 0 and fleet.all_in(State.MONITOR, State.STANDBY))
    assert fleet.episode == 1
    return fleet


def test_a_surplus_drone_takes_the_animal_of_one_that_was_lost() -> None:
    fleet = three_over_two()
    (spare,) = (drone for drone in fleet.drones if drone.navigator.state == State.STANDBY)
    lost, left = (drone for drone in fleet.drones if drone is not spare)
    kept = left.navigator.memory.animal
    fleet.run(10.0)
    assert fleet.episode == 1, "while all are watched nobody asks"
    lost.alive = False
    wanted = lost.navigator.memory.animal
    fleet.run(surplus.FREE_FOR_S + 6.0, lambda: spare.navigator.state == State.MONITOR)
    assert spare.navigator.state == State.MONITOR
    assert (spare.navigator.memory.animal, left.navigator.memory.animal) == (wanted, kept)
    assert left.states[-1] == State.MONITOR, "who watches goes on"
    fleet.run(40.0)
    assert fleet.pixels(spare)[1][wanted]


def test_nobody_who_gathers_again_waits_for_a_surplus_drone_to_come_into_the_circle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fleet = three_over_two()
    watcher = next(drone for drone in fleet.drones if drone.navigator.state == State.MONITOR)
    animal, track, identities = watcher.navigator.memory.animal, fleet._track, fleet._identities

    def unseen(drone: Drone) -> podwatch.track_t | None:
        said = track(drone)
        if drone is watcher and said is not None:
            said.state = podwatch.track_t.LOST
        return said

    def seen_before() -> podwatch.identities_t:
        said = identities()
        for entry in said.map:
            entry.age_ms = 15_000 if entry.id == animal else 0
        return said

    monkeypatch.setattr(fleet, "_track", unseen)
    monkeypatch.setattr(fleet, "_identities", seen_before)
    fleet.run(60.0, lambda: watcher.navigator.state == State.RENDEZVOUS)
    assert (watcher.navigator.state, fleet.episode) == (State.RENDEZVOUS, 1)
    assert fleet.run(60.0, lambda: fleet.episode > 1) < PATIENCE_S


def test_it_asks_only_so_often_for_what_the_ring_does_not_agree_on() -> None:
    fleet = three_over_two()
    fleet.drone(1).alive = False
    fleet.agrees = False
    fleet.run(55.0)
    assert fleet.episode == 1 + surplus.MOST_ASKED


def asked_s(entries: list, rows: list, seconds: float = 20.0, running: bool = False) -> float | None:
    """After how long a surplus drone asks for an episode; None where it does not."""
    navigator = Navigator(mission(3), 1)
    for k in range(round(seconds * 10)):
        utime = 100 * S + k * S // 10
        fleet = make(podwatch.fleet_state_t, utime=utime, n_rows=len(rows), rows=rows)
        identities = make(
            podwatch.identities_t,
            utime=utime,
            episode=1,
            episode_running=running,
            n_map=len(entries),
            map=entries,
        )
        inputs = Inputs(utime, identities=identities, fleet=fleet)
        if surplus.asks(Situation(navigator.mission, 1, inputs, navigator.memory), navigator.memory):
            return k / 10
    return None


def stranger_asked_s(
    ids: list[int], left_px: float, episodes: int = 1, rows: Sequence[Any] = (), asks: Any = surplus.asks
) -> list[float]:
    """When a surplus drone (or another that decides by `asks`) asks, over a minute in which every ask is
    answered by an episode that changes nothing, at most `episodes` of them.
    """
    navigator = Navigator(mission(3), 1)
    box = make(podwatch.box_t, left_px=left_px, top_px=100.0, right_px=left_px + 80, bottom_px=140.0)
    asked: list[float] = []
    number = 1
    for k in range(600):
        utime = 100 * S + k * S // 10
        fleet = make(podwatch.fleet_state_t, utime=utime, n_rows=len(rows), rows=rows)
        identities = make(
            podwatch.identities_t, utime=utime, episode=number, width=640, height=480, n_boxes=len(ids),
            boxes=[box] * len(ids), ids=ids,
        )  # fmt: skip
        inputs = Inputs(utime, identities=identities, fleet=fleet)
        if asks(Situation(navigator.mission, 1, inputs, navigator.memory), navigator.memory):
            asked.append(k / 10)
            number += number < episodes
    return asked


def test_an_animal_that_the_map_does_not_know_brings_an_episode_too() -> None:
    (first, *_) = stranger_asked_s([3, -1], 200.0)
    assert first == pytest.approx(surplus.STRANGER_FOR_S, abs=0.2)
    assert stranger_asked_s([3, 4], 200.0) == []
    assert stranger_asked_s([3, -1], 1.0) == [], "cut by the picture's edge"
    assert stranger_asked_s([3, -1], 558.0) == []
    assert len(stranger_asked_s([-1], 200.0, episodes=99)) == surplus.MOST_ASKED


@pytest.mark.parametrize(
    ("others", "is_unsure", "asks"),
    [
        ([(2, 0, State.MONITOR), (3, -1, State.STANDBY)], False, True),
        ([(2, 0, State.MONITOR), (3, -1, State.STANDBY, False)], False, False),  # it is lost
        ([(2, 0, State.MONITOR)], False, False),  # everybody has one
        ([(2, 0, State.MONITOR)], True, True),
        ([(2, -1, State.RENDEZVOUS), (3, -1, State.STANDBY)], True, False),  # an episode comes anyway
    ],
)
def test_who_watches_asks_when_it_sees_an_animal_for_one_that_has_none(others, is_unsure, asks) -> None:
    rows = [row(*other) for other in others]
    decides = partial(surplus.asks_for_another, is_unsure=is_unsure)
    asked = stranger_asked_s([3, -1], 200.0, rows=rows, asks=decides)
    assert bool(asked) is asks
    assert asked[:1] == pytest.approx([surplus.STRANGER_FOR_S] * asks, abs=0.2)
    assert stranger_asked_s([3, 4], 200.0, rows=rows, asks=decides) == []


def animal(number: int, age_ms: int = 200) -> podwatch.map_animal_t:
    return make(podwatch.map_animal_t, id=number, age_ms=age_ms)


def row(
    drone_id: int, watches: int, state: State = State.MONITOR, alive: bool = True
) -> podwatch.fleet_row_t:
    return make(podwatch.fleet_row_t, id=drone_id, alive=alive, state=state, animal=watches)


@pytest.mark.parametrize(
    ("entries", "rows", "asks"),
    [
        ([animal(0), animal(1)], [row(2, 0), row(3, 1)], False),
        ([animal(0), animal(1)], [row(2, 0), row(3, 1, alive=False)], True),
        ([animal(0), animal(1, age_ms=60_000)], [row(2, 0), row(3, 1, alive=False)], False),  # dived, or none
        ([animal(0), animal(1)], [row(2, 0), row(3, -1, State.RENDEZVOUS)], False),  # an episode comes anyway
        ([animal(0), animal(1)], [row(2, 0), row(3, 1, State.HOLD)], False),  # it keeps its animal
        ([], [row(2, 0)], False),
    ],
)
def test_an_animal_is_free_when_it_is_seen_and_no_living_drone_watches_it(entries, rows, asks) -> None:
    waited_s = asked_s(entries, rows)
    assert (waited_s is not None) is asks
    if waited_s is not None:
        assert waited_s > surplus.FREE_FOR_S, "who was only silent may be heard again"
    assert asked_s(entries, rows, running=True) is None


@pytest.mark.parametrize("before_s", [5.0, 12.0])
def test_what_was_watched_before_an_animal_was_lost_counts_and_what_nobody_saw_does_not(before_s) -> None:
    fleet = flown_to(State.MONITOR, 1)
    fleet.run(before_s)
    fleet.visible = False
    fleet.run(60.0, lambda: fleet.all_in(State.RENDEZVOUS))
    fleet.visible = True
    fleet.run(60.0, lambda: fleet.all_in(State.MONITOR))
    assert fleet.all_in(State.MONITOR)
    after_s = fleet.run(40.0, lambda: fleet.all_in(State.RETURN))
    watched_s = before_s + after_s
    assert fleet.mission.watch.watch_s <= watched_s <= fleet.mission.watch.watch_s + 6.0


def test_the_watchs_clock_stands_while_all_gather_anew() -> None:
    fleet = flown_to(State.MONITOR, 3)
    fleet.run(10.0)
    watched = [drone.navigator.memory.watched_us for drone in fleet.drones]
    fleet.visible = False
    fleet.run(60.0, lambda: fleet.all_in(State.RENDEZVOUS, State.REGISTER))
    lost = [drone.navigator.memory.watched_us for drone in fleet.drones]
    assert np.subtract(lost, watched).max() < 5 * S
    assert min(lost) > 8 * S
