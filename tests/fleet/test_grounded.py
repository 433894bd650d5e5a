"""A ring whose members have drones between them that take no part: on the ground, for want of charge."""

import pytest

from lcmtypes import channels
from logs.reader import read
from procs.navigator.states import State
from procs.settings import DroneEntry
from tests.fleet.conftest import new_plan
from tools.judge import judge, load_run
from tools.sim.lockstep import LockstepFleet
from tools.sim.run import prepare, write_truth_notes
from tools.sim.watch import Watch

GROUNDED = (2, 4)
LIMIT_S = 90.0  # three drones watch after about 50 s
WATCH_S = 10.0


@pytest.mark.timeout(300)
def test_two_drones_on_the_ground_do_not_cut_the_ring_of_the_other_three(near, tmp_path):
    """Drone 3's neighbours on the ring are the two: without them it would agree with nobody."""
    drones = tuple(DroneEntry(id=k, home_e_m=10.0 * (k - 1)) for k in range(1, 6))
    camera = near.camera.model_copy(update={"rate_hz": 10.0})
    plan = new_plan(near.model_copy(update={"drones": drones, "camera": camera}), tmp_path / "run")
    prepare(plan)
    watch = Watch(plan.mission, None)
    fleet = LockstepFleet(plan, watch.hear)
    for drone_id in GROUNDED:
        fleet.world.vehicles[drone_id].battery = 0.2
    able = [drone_id for drone_id in plan.mission.roster if drone_id not in GROUNDED]

    def step() -> list[State]:
        fleet.run_until(fleet.now_s + 0.5)
        watch.step(fleet.now_s, fleet, 1.0)
        return [watch.states.get(drone_id, State.IDLE) for drone_id in able]

    while set(step()) != {State.MONITOR}:
        assert fleet.now_s < LIMIT_S, watch.states
    until_s = fleet.now_s + WATCH_S
    while fleet.now_s < until_s:
        step()
    fleet.close()
    write_truth_notes(plan, watch, "lockstep", "", fleet.now_s, 1.0)

    assert {watch.states[drone_id] for drone_id in GROUNDED} == {State.IDLE}
    run = load_run(plan.folder)
    verdict = judge(run.truth, run.drones)
    assert verdict.consensus, verdict.reasons
    watched = [drone.animal for drone in verdict.drones if drone.id in able]
    assert None not in watched
    assert len(set(watched)) == 3, watched
    said = [episode.members for _, _, episode in read(plan.log_path(1), channels=channels.RING_EPISODE)]
    assert set(said) == {0b10101}
