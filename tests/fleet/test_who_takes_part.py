"""Fleets in which not everybody takes part from the beginning: some stay on the ground, some stand by."""

import pytest

from lcmtypes import channels
from logs.reader import read
from procs.navigator.states import State

LIMIT_S = 90.0  # the fleets here watch after about 50 s
WATCH_S = 10.0

pytestmark = pytest.mark.timeout(300)


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
