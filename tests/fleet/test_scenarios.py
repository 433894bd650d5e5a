"""Every scenario that ships, flown in lockstep with boxes in place of pixels, meets its own [expect]."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import fleets
from lcmtypes import channels
from logs.reader import read
from procs.registrar import registrar
from procs.registrar._marks import Marks
from procs.registrar.box_icp import BoxAlignment
from procs.registrar.ring import RingNode
from procs.settings import load_mission
from tests.fleet.conftest import new_plan
from tools.sim.expect import Safety, check, read_safety
from tools.sim.plan import RunPlan
from tools.sim.run import fly_lockstep
from tools.sim.settings import Expect, SimMission
from tools.summary import write_summary

SCENARIOS = (
    "default",
    "field_test",
    "one_drone",
    "more_drones",
    "dive",
    "death_in_monitor",
    "cut_link",
    "scout_dies",
    "five_drones",
)
CAMERA_HZ = 10.0  # of boxes; half the work of the 20 Hz that pixels are flown with
ABLATION_S = 75.0  # the same fleet watches after 50 s when it registers what it sees
PIXELS_S = 65.0  # two drones come to watch after 45 s


class Flown(NamedTuple):
    """A run's folder, its mission and what came of it."""

    folder: Path
    mission: SimMission
    summary: dict[str, Any]
    safety: Safety


def fly(mission: SimMission, folder: Path) -> Flown:
    """Fly a mission in lockstep with boxes at CAMERA_HZ, and judge it."""
    camera = mission.camera.model_copy(update={"rate_hz": CAMERA_HZ})
    plan = new_plan(mission.model_copy(update={"camera": camera}), folder)
    fly_lockstep(plan, None)
    return judged(plan)


def judged(plan: RunPlan) -> Flown:
    """What came of a plan that has flown."""
    safety = read_safety(plan.folder, plan.mission.limits)
    return Flown(plan.folder, plan.mission, write_summary(plan.folder), safety)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Flown]:
    """Flies a scenario by its name, once."""
    flights: dict[str, Flown] = {}

    def fly_once(name: str) -> Flown:
        if name not in flights:
            mission = load_mission(fleets.path(name), SimMission)
            flights[name] = fly(mission, tmp_path_factory.mktemp(name) / "run")
        return flights[name]

    return fly_once


def test_every_scenario_that_ships_is_flown_here():
    there = sorted(path.stem for path in fleets.path("default").parent.glob("*.toml"))
    assert there == sorted(SCENARIOS)


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_scenario_meets_what_it_expects(name, flown, record_property):
    flight = flown(name)
    record_property("nearest_m", flight.safety.nearest_m)
    print(f"{name}: {flight.safety}")
    assert check(flight.mission.expect, flight.summary, flight.safety) == []


def test_in_a_fleet_of_five_drone_1_hears_of_drones_3_and_4_only_by_the_fleet_table(flown):
    flight = flown("five_drones")
    names = Counter(channel for channel, _, _ in read(flight.folder / "drone_1.mcap"))
    copies = [split for name in names if (split := channels.split_received(name)) is not None]
    assert {drone_id for drone_id, _ in copies} == {2, 5}, "its neighbours on the ring"
    assert {channel for _, channel in copies} == {channel.name for channel in channels.CROSSING}
    tables = [t for _, _, t in read(flight.folder / "drone_1.mcap", channels=channels.FLEET_STATE)]
    assert {row.id for table in tables for row in table.rows if row.alive} == {1, 2, 3, 4, 5}


@pytest.mark.timeout(600)
def test_two_drones_find_agree_and_watch_by_pixels_alone(near, tmp_path):
    mission = near.model_copy(update={"drones": near.drones[:2], "duration_s": PIXELS_S})
    plan = replace(new_plan(mission, tmp_path / "run"), sensor="pixels")
    fly_lockstep(plan, None)
    flight = judged(plan)
    assert flight.summary["consensus"], flight.summary["reasons"]
    watched = [drone["animal"] for drone in flight.summary["drones"]]
    assert None not in watched
    assert len(set(watched)) == 2
    assert check(Expect(drones_in_monitor=2, min_in_image_share=0.9), flight.summary, flight.safety) == []


def as_it_stands(source: Marks, target: Marks, *, prior: Any = None) -> BoxAlignment:
    """Registration set to the identity: a view is laid on the map without being moved or turned."""
    distance = np.linalg.norm(source.centres[:, None] - target.centres[None], axis=2)
    mutual = [
        (row, column)
        for row, column in enumerate(distance.argmin(axis=1))
        if distance[:, column].argmin() == row and distance[row, column] < float(np.median(target.sizes))
    ]
    rows, columns = [row for row, _ in mutual], [int(column) for _, column in mutual]
    return BoxAlignment(
        transform=np.eye(3),
        matches=np.array(mutual, dtype=np.intp).reshape(-1, 2),
        unmatched_source=np.setdiff1d(np.arange(len(source)), rows),
        unmatched_target=np.setdiff1d(np.arange(len(target)), columns),
        residual_px=0.0,
        confidence=1.0,
        is_ambiguous=False,
        iterations=0,
    )


@pytest.mark.timeout(600)
@pytest.mark.parametrize("is_ablated", [False, True], ids=["as it is", "registration is the identity"])
def test_without_registration_there_is_no_consensus(is_ablated, near, tmp_path, monkeypatch):
    if is_ablated:
        monkeypatch.setattr(registrar, "RingNode", partial(RingNode, register=as_it_stands))
    mission = near.model_copy(update={"duration_s": ABLATION_S})
    summary = fly(mission, tmp_path / "run").summary
    assert summary["episodes"] > 0, "the fleet gathered and tried"
    assert summary["consensus"] is not is_ablated, summary["reasons"]
