"""An order and a find cross the whole fleet at once, not a tick later at every hop."""

import pytest

from lcmtypes.podwatch import operator_t
from procs.relay.fleet import Order
from tests.unit.relay_fleet import Fleet, S

LINKED_S = 8.0
STEP_S = 0.02
N_SEEDS = 12


def seconds_until(fleet: Fleet, is_so) -> float:
    began_us = fleet.queue.now_us
    while not is_so():
        fleet.run(STEP_S)
        assert fleet.queue.now_us - began_us < 10 * S
    return (fleet.queue.now_us - began_us) / S


@pytest.mark.parametrize("finder", [1, 3])
def test_the_boat_hears_of_a_find_within_two_seconds_though_30_percent_are_lost(finder):
    """The boat talks to one drone; the finder may be that one or two hops away."""
    took_s = []
    for seed in range(N_SEEDS):
        fleet = Fleet(5, loss=0.3, seed=seed, boat=True)
        fleet.run(LINKED_S + 0.1 * seed)
        fleet[finder].mission.found = True
        took_s.append(
            seconds_until(
                fleet, lambda f=fleet: any(row.found for row in f[0].state.rows if row.id == finder)
            )
        )
    assert max(took_s) < 2.0


def test_the_last_of_five_hears_an_order_in_half_a_second_with_one_link_cut():
    """Whichever link it is. The rest of the second is the drone's own: FLEET_STATE at 4 Hz, its navigator."""
    for seed in range(N_SEEDS):
        fleet = Fleet(5, loss=0.02, seed=seed, boat=True)
        fleet.run(LINKED_S)
        fleet.cut((1 + seed % 5, 1 + (seed + 1) % 5))
        fleet.run(5.0 + 0.1 * seed)
        boat = fleet[0]
        boat.core.order(Order(boat.fleet_us, operator_t.HOLD, 0, -1, 60), boat.now_us)
        took_s = seconds_until(
            fleet, lambda f=fleet: all(d.state.order.command == operator_t.HOLD for d in f.living)
        )
        assert took_s < 0.5


def test_what_is_known_is_spread_no_more():
    """An order is news once; heard again by another path it makes no noise."""
    fleet = Fleet(5, seed=1, boat=True)
    fleet.run(LINKED_S)

    def bytes_per_s() -> int:
        for drone in fleet.drones.values():
            drone.core.link_state(drone.now_us)
        fleet.run(4.0)
        return sum(
            sum(link.bytes_out)
            for drone in fleet.drones.values()
            for link in drone.core.link_state(drone.now_us).links
        )

    quiet = bytes_per_s()
    boat = fleet[0]
    boat.core.order(Order(boat.fleet_us, operator_t.HOLD, 0, -1, 60), boat.now_us)
    boat.core.order(Order(boat.fleet_us - S, operator_t.RETURN, 0, -1, 60), boat.now_us)
    fleet.run(2.0)
    assert bytes_per_s() < 1.15 * quiet, "but for the order's own 13 bytes in each table"
    assert all(drone.state.order.command == operator_t.HOLD for drone in fleet.living), (
        "the older order is none"
    )
