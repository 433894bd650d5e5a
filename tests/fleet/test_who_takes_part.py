"""Fleets in which not everybody takes part from the beginning: some stay on the ground, some stand by."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lcmtypes import channels
from logs.reader import read
from procs.navigator.states import State
from procs.settings import DroneEntry
from tests.fleet.conftest import new_plan
from tools.judge import Verdict, judge, load_run
from tools.sim.lockstep import LockstepFleet
from tools.sim.run import prepare, write_truth_notes
from tools.sim.settings import SimMission
from tools.sim.watch import Watch

LIMIT_S = 90.0  # the fleets here watch after about 50 s
WATCH_S = 10.0

pytestmark = pytest.mark.timeout(300)


class Flight:
    """A fleet on the virtual clock, half a second at a time."""

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
    flights: list[Flight] = []

    def begin(n_drones: int, n_animals: int, watch_s: float) -> Flight:
        changes = {
            "drones": tuple(DroneEntry(id=k, home_e_m=10.0 * (k - 1)) for k in range(1, n_drones + 1)),
            "pod": near.pod.model_copy(update={"animals": n_animals}),
            "watch": near.watch.model_copy(update={"watch_s": watch_s}),
        }
        flights.append(Flight(near.model_copy(update=changes), tmp_path / "run"))
        return flights[-1]

    yield begin
    for each in flights:
        each.close()


def test_two_drones_on_the_ground_do_not_cut_the_ring_of_the_other_three(flight):
    """They have no charge to fly. Drone 3's neighbours on the ring are these two."""
    flown, grounded = flight(5, 5, 20.0), [2, 4]
    for drone_id in grounded:
        flown.fleet.world.vehicles[drone_id].battery = 0.2
    flown.fly(LIMIT_S, lambda: flown.in_state(State.MONITOR) == [1, 3, 5])
    assert flown.in_state(State.MONITOR) == [1, 3, 5]
    flown.fly(WATCH_S)
    assert flown.in_state(State.IDLE) == grounded
    verdict = flown.judged()
    assert verdict.consensus, verdict.reasons
    watched = [drone.animal for drone in verdict.drones if drone.id not in grounded]
    assert None not in watched
    assert len(set(watched)) == 3, watched
    said = [episode.members for _, _, episode in read(flown.plan.log_path(1), channels=channels.RING_EPISODE)]
    assert set(said) == {0b10101}


def test_a_surplus_drone_takes_the_animal_of_one_that_dies_while_it_watches(flight):
    flown = flight(3, 2, 90.0)
    flown.fly(LIMIT_S, lambda: len(flown.in_state(State.MONITOR)) == 2 == len(flown.watch.states) - 1)
    flown.fly(WATCH_S)
    (spare,) = flown.in_state(State.STANDBY)
    lost, left = flown.in_state(State.MONITOR)
    flown.kill(lost)
    took_s = flown.fly(40.0, lambda: flown.state(spare) == State.MONITOR)
    print(f"drone {spare} took over {took_s:.1f} s after drone {lost} died")
    assert flown.state(spare) == State.MONITOR
    assert flown.state(left) == State.MONITOR, "who watches goes on"
    flown.fly(3 * WATCH_S)
    verdict = {drone.id: drone for drone in flown.judged().drones}
    animals = [verdict[drone_id].animal for drone_id in (spare, left)]
    assert None not in animals
    assert animals[0] != animals[1]
    assert animals[0] == verdict[lost].watched[-1].what
