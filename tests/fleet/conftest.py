"""What the tests of whole fleets share: a short mission, and the run's folder."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from procs.navigator.states import State
from procs.settings import DroneEntry, load_mission
from tools.judge import Verdict, judge, load_run
from tools.sim.lockstep import LockstepFleet
from tools.sim.plan import RunPlan
from tools.sim.run import prepare, write_truth_notes
from tools.sim.settings import SimMission
from tools.sim.watch import Watch


@pytest.fixture(scope="session")
def near() -> SimMission:
    """Three drones, a pod 25 m away, 20 s of watching."""
    return load_mission(Path(__file__).parent / "near.toml", SimMission)


def new_plan(mission: SimMission, folder: Path) -> RunPlan:
    """A plan with boxes in place of pixels in a fresh folder."""
    folder.mkdir()
    return RunPlan(mission, folder, sensor="boxes")


class Flight:
    """A fleet on the virtual clock, boxes in place of pixels, half a second at a time."""

    def __init__(self, mission: SimMission, folder: Path) -> None:
        camera = mission.camera.model_copy(update={"rate_hz": 10.0})
        self.plan = new_plan(mission.model_copy(update={"camera": camera}), folder)
        prepare(self.plan)
        self.watch = Watch(self.plan.mission, None)
        self.fleet = LockstepFleet(self.plan, self.watch.hear)
        self._is_open = True

    def state(self, drone_id: int) -> State:
        return self.watch.states.get(drone_id, State.IDLE)

    def in_state(self, state: State) -> list[int]:
        return [drone_id for drone_id in self.plan.mission.roster if self.state(drone_id) == state]

    def fly(self, seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """Fly for `seconds`, or until something is so -> how long it took."""
        began_s = self.fleet.now_s
        while not until() and self.fleet.now_s < began_s + seconds:
            self.fleet.run_until(self.fleet.now_s + 0.5)
            self.watch.step(self.fleet.now_s, self.fleet, 1.0)
        return self.fleet.now_s - began_s

    def kill(self, drone_id: int) -> None:
        self.fleet.kill(drone_id)
        self.watch.died(drone_id)

    def close(self) -> None:
        if self._is_open:
            self._is_open = False
            self.fleet.close()

    def judged(self) -> Verdict:
        """End it and judge it."""
        self.close()
        write_truth_notes(self.plan, self.watch, "lockstep", "", self.fleet.now_s, 1.0)
        run = load_run(self.plan.folder)
        return judge(run.truth, run.drones)


@pytest.fixture
def flight(near: SimMission, tmp_path: Path) -> Iterator[Callable[..., Flight]]:
    """Begins a flight of so many drones over so many animals near by."""
    flights: list[Flight] = []

    def begin(n_drones: int, n_animals: int, watch_s: float, **tables: Any) -> Flight:
        changes = tables | {
            "drones": tuple(DroneEntry(id=k, home_e_m=10.0 * (k - 1)) for k in range(1, n_drones + 1)),
            "pod": near.pod.model_copy(update={"animals": n_animals}),
            "watch": near.watch.model_copy(update={"watch_s": watch_s}),
        }
        flights.append(Flight(near.model_copy(update=changes), tmp_path / "run"))
        return flights[-1]

    yield begin
    for each in flights:
        each.close()
