"""Relays of a whole fleet in memory: losses, deaths, cuts, partitions, wrong clocks."""

import numpy as np
import pytest

from lcmtypes import make
from lcmtypes.podwatch import mission_state_t, operator_t, ring_map_t
from procs.queue_executor import ClockError
from procs.relay.fleet import Order
from procs.relay.seal import Refusal
from tests.unit.relay_fleet import MAP, Fleet, S, link


def test_a_ring_that_loses_a_third_of_its_datagrams_stays_whole() -> None:
    fleet = Fleet(5, loss=0.3)
    fleet.run(8)

    def check() -> None:
        assert fleet.members() == [0b11111] * 5
        assert fleet.clock_spread_us() < 10_000
        for drone in fleet.living:
            assert drone.state.fleet_time_ok
            assert [row.id for row in drone.state.rows] == [
                drone.id,
                *(other for other in fleet.roster if other != drone.id),
            ]
            assert max(row.age_ms for row in drone.state.rows) < 5_000

    fleet.run(40, check)
    assert 0.15 < link(fleet[1], 2).loss < 0.45
    assert abs(link(fleet[1], 2).offset_us - (fleet[2].now_us - fleet[1].now_us)) < 5_000


def test_fleet_time_is_the_lowest_drones_and_offsets_converge() -> None:
    for seed in range(5):
        fleet = Fleet(5, seed=seed, jitter_s=0.02)
        fleet.run(5)
        assert all(drone.state.fleet_time_ok for drone in fleet.living)
        fleet.run(20)
        assert max(abs(drone.fleet_us - fleet[1].now_us) for drone in fleet.living) < 10_000


def test_copies_come_from_the_two_neighbours_only() -> None:
    fleet = Fleet(5)
    fleet.run(3)

    def everybody_speaks() -> None:
        for drone in fleet.living:
            drone.say(MAP, make(ring_map_t, n_bytes=3, packet=b"abc"))

    fleet.run(10, everybody_speaks)
    for drone in fleet.living:
        neighbours = {(drone.id - 2) % 5 + 1, drone.id % 5 + 1}
        assert {copy.sender for copy in drone.copies} == neighbours
        assert len(drone.copies) == 18  # ten times, the last still under way
    assert not any(drone.core.refused.get(Refusal.NOT_NEIGHBOUR) for drone in fleet.living)
    copy = fleet[1].copies[0]
    assert ring_map_t.decode(copy.data).packet == b"abc"
    assert ring_map_t.decode(copy.data).drone_id == copy.sender


def test_a_dead_member_is_lost_after_3_s_and_the_ring_closes_over_it() -> None:
    fleet = Fleet(5)
    fleet.run(6)
    fleet[3].die()
    fleet.run(2.5)
    assert fleet.members() == [0b11111] * 4
    fleet.run(2.5)
    assert fleet.members() == [0b11011] * 4
    assert (fleet[2].state.right_id, fleet[4].state.left_id) == (4, 2)
    fleet.run(2)
    assert not any(drone.state.is_line for drone in fleet.living)
    assert [fleet[1].row(3).alive, fleet[1].row(2).alive] == [False, True]
    assert fleet[1].row(3).age_ms > 6_000
    fleet[2].say(MAP, make(ring_map_t))
    fleet.run(0.1)
    assert [copy.sender for copy in fleet[4].copies] == [2]

    fleet[3].start()
    fleet.run(4)
    assert fleet.members() == [0b11111] * 5
    assert not any(drone.state.is_line for drone in fleet.living)


def test_fleet_time_outlives_its_reference() -> None:
    fleet = Fleet(4)
    fleet.run(8)
    before_us = fleet[2].fleet_us - fleet.queue.now_us
    fleet[1].die()
    fleet.run(10)
    assert fleet.clock_spread_us() < 10_000
    assert abs(fleet[2].fleet_us - fleet.queue.now_us - before_us) < 10_000
    fleet[1].start()
    fleet.run(10)
    assert fleet.clock_spread_us() < 10_000
    assert abs(fleet[1].fleet_us - fleet.queue.now_us - before_us) < 10_000


def test_a_cut_link_beside_a_living_neighbour_makes_a_line_and_word_still_goes_round() -> None:
    fleet = Fleet(5)
    fleet.run(6)
    fleet.cut((1, 2))
    fleet.run(5)

    def still_one_fleet() -> None:
        assert fleet.members() == [0b11111] * 5

    fleet.run(10, still_one_fleet)
    assert all(drone.state.is_line for drone in fleet.living)
    assert (fleet[1].core.silent_sides(fleet[1].now_us), fleet[2].core.silent_sides(fleet[2].now_us)) == (
        ("right",),
        ("left",),
    )
    assert fleet[1].state.right_id == 2  # it lives: nobody takes its place
    assert not link(fleet[1], 2).up
    assert link(fleet[1], 5).up
    fleet[2].mission.animal = 17
    fleet.run(4)
    assert fleet[1].row(2).animal == 17
    assert fleet.clock_spread_us() < 10_000

    fleet.cut()
    fleet.run(3)
    assert not any(drone.state.is_line for drone in fleet.living)


def test_a_link_that_is_silent_one_way_is_down_at_both_ends() -> None:
    fleet = Fleet(3)
    fleet.run(5)
    fleet.ether.blocked = lambda sender, receiver: (sender, receiver) == (1, 2)
    fleet.run(7)
    assert fleet.members() == [0b111] * 3
    assert fleet[1].core.silent_sides(fleet[1].now_us) == ("right",)
    assert fleet[2].core.silent_sides(fleet[2].now_us) == ("left",)


def test_a_partition_is_two_fleets_that_meet_again() -> None:
    fleet = Fleet(5)
    fleet.run(6)
    fleet.cut(*((a, b) for a in (1, 2, 3) for b in (4, 5)))
    fleet.run(8)
    assert fleet.members() == [0b00111] * 3 + [0b11000] * 2
    assert (fleet[1].state.left_id, fleet[1].state.right_id) == (3, 2)
    assert (fleet[4].state.left_id, fleet[4].state.right_id) == (5, 5)
    assert not any(drone.state.is_line for drone in fleet.living)
    fleet[5].mission.animal = 9
    fleet.run(3)
    assert fleet[1].row(5).animal == -1
    fleet.cut()
    fleet.run(5)
    assert fleet.members() == [0b11111] * 5
    assert fleet[2].row(5).animal == 9
    fleet.run(3)
    assert fleet.clock_spread_us() < 10_000
    assert not any(drone.state.is_line for drone in fleet.living)


def test_a_pair_and_one_alone_are_fleets() -> None:
    fleet = Fleet(2)
    fleet.run(5)
    assert (fleet[1].state.left_id, fleet[1].state.right_id, fleet[1].state.is_line) == (2, 2, False)
    fleet[2].die()
    fleet.run(6)
    state = fleet[1].state
    assert (state.left_id, state.right_id, state.members, state.fleet_time_ok) == (0, 0, 1, True)


def test_a_relay_that_restarts_is_linked_again_within_2_s_and_learns_its_own_last_row() -> None:
    fleet = Fleet(3)
    fleet.run(5)
    fleet[2].mission.waypoint = 7
    fleet[2].mission.animal = 12
    fleet.run(3)
    fleet[2].start()
    fleet[2].mission = make(mission_state_t)
    core, fleet[2].core.describe = fleet[2].core, lambda *_: None  # type: ignore[method-assign]
    fleet.run(2)
    assert (fleet[2].row(2).animal, fleet[2].row(2).waypoint) == (12, 7)
    del core.describe
    fleet.run(2)
    assert fleet.members() == [0b111] * 3
    assert all(link(fleet[2], peer_id).up for peer_id in (1, 3))
    assert fleet[1].row(2).animal == 0


@pytest.mark.parametrize("drone_id", [1, 2])
@pytest.mark.parametrize("jump_s", [-400, 400, 2000])
def test_a_drone_that_boots_again_with_another_clock_is_taken_up_again(drone_id: int, jump_s: int) -> None:
    fleet = Fleet(3)
    fleet.run(8)
    before_us = fleet[3].fleet_us - fleet.queue.now_us
    drone = fleet[drone_id]
    drone.die()
    fleet.run(1)
    drone.clock = ClockError(drone.clock.offset_us + jump_s * S)
    drone.mission.animal = 5
    drone.start()
    fleet.run(5)
    assert fleet.members() == [0b111] * 3
    assert fleet.clock_spread_us() < 10_000
    assert abs(fleet[3].fleet_us - fleet.queue.now_us - before_us) < 10_000  # also where the reference did it
    assert all(other.row(drone_id).animal == 5 for other in fleet.living)
    assert all(other.row(drone_id).age_ms < 2_000 for other in fleet.living)
    assert not any(other.core.refused.get(Refusal.LATE) for other in fleet.living)


def test_a_find_reaches_all_and_costs_one_marker() -> None:
    fleet = Fleet(5)
    fleet.run(5)
    fleet[2].mission = make(
        mission_state_t, state=4, found=True, found_n_m=101.26, found_e_m=-40.0, pod_radius_m=12.5, waypoint=3
    )
    fleet.run(4)
    row = fleet[5].row(2)
    assert (row.found, row.waypoint, row.pod_radius_m) == (True, 3, 12.5)
    assert (row.found_n_m, row.found_e_m) == pytest.approx((101.3, -40.0), abs=0.05)
    assert not fleet[5].row(1).found
    for drone_id in (3, 4, 5, 1):  # the others adopt it as they hear it
        heard = fleet[drone_id].row(2)
        fleet[drone_id].mission = make(
            mission_state_t,
            found=True,
            found_n_m=heard.found_n_m,
            found_e_m=heard.found_e_m,
            pod_radius_m=heard.pod_radius_m,
        )
    fleet.run(6)
    for drone in fleet.living:
        assert all(row.found and abs(row.found_n_m - 101.26) < 0.1 for row in drone.state.rows)
    with_marker = [member for member, entry in fleet[5].core.fleet._entries.items() if entry.row.marker]
    assert len(with_marker) <= 2  # the lowest that says it, and the scout for its waypoint

    fleet[2].mission.found_n_m = 150.0  # the pod swims
    fleet.run(4)
    assert fleet[4].row(2).found_n_m == pytest.approx(150.0, abs=0.05)
    assert fleet[4].row(3).found_n_m == pytest.approx(101.26, abs=0.1)


def test_the_boats_order_reaches_everybody_and_expires() -> None:
    fleet = Fleet(4, boat=True)
    fleet.run(8)
    assert fleet[0].state.fleet_time_ok
    fleet[0].core.fleet.order(Order(fleet[0].fleet_us, operator_t.START, 0, -1, 20))
    fleet.run(3)
    assert [drone.state.order.command for drone in fleet.living] == [operator_t.START] * 4
    assert all(0 not in (drone.state.left_id, drone.state.right_id) for drone in fleet.living)
    assert all(drone.state.boat_age_ms < 1_500 for drone in fleet.living)
    fleet[0].core.fleet.order(Order(fleet[0].fleet_us, operator_t.HOLD, 3, -1, 10))
    fleet.run(3)
    assert [drone.state.order.command for drone in fleet.living] == [
        operator_t.START,
        operator_t.START,
        operator_t.HOLD,
        operator_t.START,
    ]
    fleet[0].die()
    fleet.run(9)
    assert [drone.state.order.command for drone in fleet.living] == [operator_t.START] * 4
    assert all(8_000 < drone.state.boat_age_ms < 11_000 for drone in fleet.living)
    fleet.run(9)
    assert [drone.state.order.command for drone in fleet.living] == [operator_t.NONE] * 4
    assert fleet.members() == [0b1111] * 4


def test_what_the_boat_says_of_an_animal_stands_beside_what_each_drone_is_to_fly() -> None:
    """A drone on hold hears that its animal is to be left; the newest word on an animal holds."""
    fleet = Fleet(4, boat=True)
    fleet.run(8)

    def say(*order: int) -> None:
        fleet[0].core.fleet.order(Order(fleet[0].fleet_us, *order))
        fleet.run(3)

    def left() -> list[list[int]]:
        return [list(drone.state.left) for drone in fleet.living]

    say(operator_t.LEAVE, 0, 7, 60)
    say(operator_t.HOLD, 3, -1, 60)
    say(operator_t.LEAVE, 0, 2, 60)
    assert left() == [[2, 7]] * 4
    orders = [drone.state.order.command for drone in fleet.living]
    assert orders == [operator_t.NONE, operator_t.NONE, operator_t.HOLD, operator_t.NONE]
    say(operator_t.WATCH, 0, 7, 60)
    assert left() == [[2]] * 4
    fleet[0].die()
    fleet.run(70)
    assert left() == [[]] * 4


def test_the_same_seed_gives_the_same_datagrams() -> None:
    def traffic(seed: int) -> list[bytes]:
        fleet, sent = Fleet(3, loss=0.2, seed=seed), []
        carry = fleet.ether.carry
        fleet.ether.carry = lambda a, b, data: (sent.append(data), carry(a, b, data))  # type: ignore
        fleet.run(5)
        return sent

    assert traffic(4) == traffic(4)
    assert traffic(4) != traffic(5)


@pytest.mark.parametrize("seed", [1, 4, 9])
def test_after_any_troubles_the_fleet_is_whole_again(seed: int) -> None:
    random = np.random.default_rng(seed)
    n = int(random.integers(3, 8))
    fleet = Fleet(n, loss=float(random.uniform(0, 0.3)), seed=seed)
    fleet.run(6)
    for _ in range(10):
        drone = fleet[int(random.integers(1, n + 1))]
        trouble = random.choice(["death", "restart", "another clock", "cuts", "peace"])
        if trouble == "cuts":
            fleet.cut(*((int(a), int(b)) for a, b in random.integers(1, n + 1, (4, 2))))
        elif trouble == "peace":
            fleet.cut()
        else:
            drone.die()
            if trouble == "another clock":
                drone.clock = ClockError(500 * S + int(random.uniform(-600, 600) * S))
            if trouble != "death":
                drone.start()
        fleet.run(random.uniform(0.2, 6))
    fleet.cut()
    for drone in fleet.drones.values():
        if not drone.alive:
            drone.start()
    fleet.run(14)
    assert fleet.members() == [2**n - 1] * n
    assert fleet.clock_spread_us() < 10_000
    for drone in fleet.living:
        assert drone.state.fleet_time_ok
        assert not drone.state.is_line
        assert drone.state.n_rows == n
        assert max(row.age_ms for row in drone.state.rows) < 5_000


@pytest.mark.parametrize("command", [operator_t.HOLD, operator_t.LEAVE])
def test_an_order_of_a_fleet_time_that_has_ended_does_not_keep_newer_ones_out(command: int) -> None:
    """All drones are switched off for longer than any clock is kept, and the boat's program runs on."""
    fleet = Fleet(3, boat=True)
    fleet.run(8)
    boat, drones = fleet[0], list(fleet.living)
    fleet.run(200)  # the fleet's time is older than any that begins anew
    animal = 5 if command == operator_t.LEAVE else -1
    assert boat.core.order(Order(boat.fleet_us, command, 0, animal, 6 * 3600), boat.now_us)
    fleet.run(3)
    for drone in drones:
        drone.die()
    fleet.run(240)
    for drone in drones:
        drone.clock = ClockError(20 * S - fleet.queue.now_us, 0)
        drone.start()
    fleet.run(20)
    assert all(drone.state.fleet_time_ok for drone in drones)
    assert all(drone.state.order.command == operator_t.NONE and not drone.state.left for drone in drones)
    assert boat.core.order(Order(boat.fleet_us, operator_t.LAND, 0, -1, 60), boat.now_us)
    assert boat.core.order(Order(boat.fleet_us, operator_t.LEAVE, 0, 5, 60), boat.now_us)
    fleet.run(3)
    assert all(drone.state.order.command == operator_t.LAND for drone in drones)
    assert all(list(drone.state.left) == [5] for drone in drones)
