"""The assigner's process over real relays in virtual time: loss, delay, drones that die or go home, animals
that come and go, more drones than animals, one drone and two.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.radios.memory import MemoryEther
from lcmtypes import channels, make
from lcmtypes.podwatch import (
    assignment_t,
    identities_t,
    map_animal_t,
    mission_state_t,
    ring_assign_t,
    vehicle_state_t,
)
from procs.assigner import process as assigner
from procs.assigner.solve import assign
from procs.navigator.states import State
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.relay import process as relay
from procs.relay.keys import make_key, read_key
from procs.relay.members import BOAT_ID
from procs.relay.relay import TICK_S
from procs.settings import AssignSettings, DroneEntry, DroneSettings, Mission
from tools.boat.core import Boat
from tools.boat.orders import parse

S = 1_000_000
Places = dict[int, tuple[float, float]]


class Fleet:
    """Drones with a relay and an assigner each; the test plays navigator, autopilot and registrar."""

    def __init__(
        self, run_dir: Path, places: Places, loss: float = 0.0, assign: AssignSettings | None = None
    ) -> None:
        self.queue = EventQueue()
        self.places = places
        self.ether = MemoryEther(
            np.random.default_rng(3), self._after, latency_s=0.02, jitter_s=0.1, loss=loss
        )
        self.mission = Mission(
            drones=tuple(DroneEntry(id=drone_id, home_e_m=10.0 * drone_id) for drone_id in places),
            assign=assign or AssignSettings(),
        )
        self.state = dict.fromkeys(places, State.ASSIGN)
        self.animal = dict.fromkeys(places, -1)
        self.told: dict[int, list[assignment_t]] = {drone_id: [] for drone_id in places}
        self.buses: dict[int, VirtualBus] = {}
        self.runtimes: dict[int, list[QueueRuntime]] = {}
        self.largest_packet = 0
        self.follows = True  # the navigators say that they watch what they are given
        for drone_id in places:
            self._start(drone_id, run_dir)
        self.run(3.0)

    def _after(self, delay_s: float, action: Any) -> None:
        self.queue.schedule(self.queue.now_us + round(delay_s * S), action)

    def _start(self, drone_id: int, run_dir: Path) -> None:
        settings = DroneSettings(drone_id=drone_id, mission=self.mission, run_dir=str(run_dir))
        bus = self.buses[drone_id] = VirtualBus(self.queue)
        drivers = {"radio": lambda _process: self.ether.radio(drone_id, (BOAT_ID, *self.mission.roster))}
        self.runtimes[drone_id] = []
        for name, module in (("relay", relay), ("assigner", assigner)):
            runtime = QueueRuntime(name, settings, bus, ClockError(10 * S), drivers)
            module.setup(runtime)
            runtime.start()
            self.runtimes[drone_id].append(runtime)
        bus.observers.append(lambda channel, data: self._heard(drone_id, channel, data))

    def _heard(self, drone_id: int, channel: str, data: bytes) -> None:
        if channel == channels.RING_ASSIGN:
            self.largest_packet = max(self.largest_packet, ring_assign_t.decode(data).n_bytes)
        if channel == channels.ASSIGNMENT:
            self.told[drone_id].append(assignment_t.decode(data))
            self._nobody_watches_twice()

    def _nobody_watches_twice(self) -> None:
        held = [told[-1].animal for drone, told in self.told.items() if told and drone in self.runtimes]
        held = [animal for animal in held if animal >= 0]
        assert len(held) == len(set(held)), f"two drones on one animal: {held}"

    def say(self, drone_id: int, channel: str, message: Any) -> None:
        message.drone_id, message.utime = drone_id, 10 * S + self.queue.now_us
        self.buses[drone_id].deliver(channel, message.encode())

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 10)):
            for drone_id in self.runtimes:
                n_m, e_m = self.places[drone_id]
                vehicle = make(vehicle_state_t, n_m=n_m, e_m=e_m, battery=0.75, position_ok=True)
                self.say(drone_id, channels.VEHICLE_STATE, vehicle)
                if self.follows and self.told[drone_id] and self.state[drone_id] == State.MONITOR:
                    self.animal[drone_id] = self.told[drone_id][-1].animal
                mission = make(mission_state_t, state=self.state[drone_id], animal=self.animal[drone_id])
                self.say(drone_id, channels.MISSION_STATE, mission)
            self.queue.run_until(self.queue.now_us + S // 10)

    def boat(self, run_dir: Path) -> Boat:
        """A boat that hears them all."""
        radio = self.ether.radio(BOAT_ID, self.mission.roster)
        boat = Boat(self.mission, read_key(run_dir / "fleet.key"), radio, self.queue.now_us)
        radio.on_arrival(lambda: boat.hear(self.queue.now_us))

        def tick() -> None:
            boat.tick(self.queue.now_us)
            self._after(TICK_S, tick)

        tick()
        self.run(3.0)
        return boat

    def episode(self, number: int, animals: Places, members: list[int] | None = None) -> None:
        """All registrars name these animals, ids with their places in metres north and east."""
        roster = self.mission.roster
        bitmap = sum(1 << roster.index(drone_id) for drone_id in members or self.runtimes)
        entries = [make(map_animal_t, id=k, n_m=n, e_m=e, hits=3) for k, (n, e) in animals.items()]
        for drone_id in self.runtimes:
            message = make(
                identities_t,
                episode=number,
                episode_proposer=roster[0],
                episode_members=bitmap,
                consensus=True,
                n_map=len(entries),
                map=entries,
            )
            self.say(drone_id, channels.IDENTITIES, message)

    def kill(self, drone_id: int) -> None:
        for runtime in self.runtimes.pop(drone_id):
            runtime.kill()

    def last(self) -> dict[int, assignment_t]:
        return {drone_id: self.told[drone_id][-1] for drone_id in self.runtimes}

    def animals(self) -> dict[int, int]:
        return {drone_id: message.animal for drone_id, message in self.last().items()}


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    make_key(tmp_path / "fleet.key")
    return tmp_path


def line(n: int, gap_m: float = 20.0) -> Places:
    return {k: (gap_m * k, 0.0) for k in range(1, n + 1)}


def beside(places: Places, first_id: int = 100) -> Places:
    """One animal 3 m east of each drone; drone k's is first_id + k."""
    return {first_id + k: (n, e + 3.0) for k, (n, e) in places.items()}


@pytest.mark.parametrize(("n", "loss"), [(1, 0.0), (2, 0.0), (2, 0.3), (5, 0.0), (5, 0.3)])
def test_the_fleet_takes_the_cheapest_distinct_animals(run_dir: Path, n: int, loss: float) -> None:
    random = np.random.default_rng(n)
    places = {k: (float(a), float(b)) for k, (a, b) in enumerate(random.uniform(0, 80, (n, 2)), 1)}
    animals = {k: (float(a), float(b)) for k, (a, b) in enumerate(random.uniform(0, 80, (n + 2, 2)))}
    fleet = Fleet(run_dir, places, loss)
    fleet.episode(1, animals)
    fleet.run(12.0)
    costs = np.linalg.norm(
        np.array(list(places.values()))[:, None] - np.array(list(animals.values()))[None], axis=2
    )
    assert [*fleet.animals().values()] == assign(costs, "exact").goals.tolist()
    assert all(told.certified and not told.running and not told.surplus for told in fleet.last().values())


@pytest.mark.parametrize("method", ["gnn", "gnn+resolve"])
def test_a_mission_may_ask_for_a_learned_method(run_dir: Path, method: Any) -> None:
    fleet = Fleet(run_dir, line(5), 0.2, AssignSettings(method=method))
    # All but one side by side with a drone: no method mistakes these.
    animals = beside(fleet.places) | {50: (300.0, 3.0)}
    fleet.episode(1, animals)
    fleet.run(15.0)
    assert fleet.animals() == {1: 101, 2: 102, 3: 103, 4: 104, 5: 105}
    assert all(told.certified for told in fleet.last().values())
    assert fleet.largest_packet <= 308


def test_who_gets_no_animal_is_told_so(run_dir: Path) -> None:
    fleet = Fleet(run_dir, line(3))
    fleet.episode(1, {7: (20.0, 1.0), 9: (60.0, 1.0)})
    fleet.run(4.0)
    assert fleet.animals() == {1: 7, 2: -1, 3: 9}
    assert {drone: told.surplus for drone, told in fleet.last().items()} == {1: False, 2: True, 3: False}
    assert all(told.certified for told in fleet.last().values())


def test_a_neighbour_that_dies_in_mid_round_is_waited_for_until_it_is_lost(run_dir: Path) -> None:
    fleet = Fleet(run_dir, line(4))
    fleet.episode(1, beside(fleet.places))
    fleet.run(0.1)
    fleet.kill(2)
    fleet.run(1.0)
    assert not any(told.certified for told in fleet.last().values())
    fleet.run(8.0)
    assert fleet.animals() == {1: 101, 3: 103, 4: 104}
    assert all(told.certified for told in fleet.last().values())


def test_animals_appear_and_vanish_between_episodes(run_dir: Path) -> None:
    fleet = Fleet(run_dir, line(3))
    fleet.episode(1, beside(fleet.places))
    fleet.run(4.0)
    fleet.state = dict.fromkeys(fleet.places, State.MONITOR)
    fleet.run(2.0)
    # 102 has dived; 50 came up near the second drone, and 51 far away.
    fleet.episode(2, {101: (20.0, 3.0), 103: (60.0, 3.0), 50: (44.0, 0.0), 51: (300.0, 0.0)})
    fleet.run(4.0)
    assert fleet.animals() == {1: 101, 2: 50, 3: 103}
    assert all(told.episode == 2 and told.certified for told in fleet.last().values())


def test_animals_change_hands_only_for_a_gain_and_never_twice_held(run_dir: Path) -> None:
    fleet = Fleet(run_dir, line(3))
    fleet.episode(1, beside(fleet.places))
    fleet.run(4.0)
    fleet.state = dict.fromkeys(fleet.places, State.MONITOR)
    # A ring of exchanges: every animal has swum to the next drone.
    fleet.episode(2, {101: (40.0, 3.0), 102: (60.0, 3.0), 103: (20.0, 3.0)})
    fleet.run(6.0)
    assert fleet.animals() == {1: 103, 2: 101, 3: 102}
    # Drones 2 and 3 would save 4 m together by another exchange: not worth it.
    fleet.episode(3, {101: (51.0, 0.0), 102: (49.0, 0.0), 103: (20.0, 3.0)})
    fleet.run(6.0)
    assert fleet.animals() == {1: 103, 2: 101, 3: 102}
    # 16 m for two that change is above 5 m each.
    fleet.episode(4, {101: (54.0, 0.0), 102: (46.0, 0.0), 103: (20.0, 3.0)})
    fleet.run(6.0)
    assert fleet.animals() == {1: 103, 2: 102, 3: 101}


def test_an_animal_that_the_boat_wants_left_is_taken_by_nobody_until_it_may_be_watched_again(
    run_dir: Path,
) -> None:
    fleet = Fleet(run_dir, line(2))
    animals = {101: (20.0, 3.0), 102: (40.0, 3.0), 103: (20.0, 12.0)}
    boat = fleet.boat(run_dir)
    fleet.episode(1, animals)
    fleet.run(3.0)
    assert fleet.animals() == {1: 101, 2: 102}
    for number, order, expected in ((2, "leave 101", 103), (3, "watch 101", 101)):
        boat.say(parse(order, fleet.mission.roster), fleet.queue.now_us)
        fleet.run(3.0)
        fleet.episode(number, animals)
        fleet.run(4.0)
        assert fleet.animals() == {1: expected, 2: 102}
        assert all(told.certified for told in fleet.last().values())


def test_minutes_already_watched_make_an_animal_dearer_for_all(run_dir: Path) -> None:
    animals = {7: (20.0, 2.0), 8: (20.0, 12.0)}  # 10 m apart, the gain that it takes to change is 5 m
    for price_m, expected in ((1.0, 7), (20.0, 8)):
        fleet = Fleet(run_dir, {1: (20.0, 0.0)}, assign=AssignSettings(minute_watched_m=price_m))
        fleet.episode(1, animals)
        fleet.run(1.0)
        assert fleet.animals() == {1: 7}
        fleet.state[1] = State.MONITOR
        fleet.run(60.0)
        fleet.episode(2, animals)
        fleet.run(1.0)
        assert fleet.animals() == {1: expected}


def test_a_drone_that_goes_home_gives_its_animal_up_and_the_next_episode_hands_it_on(run_dir: Path) -> None:
    fleet = Fleet(run_dir, line(3))
    fleet.episode(1, {101: (20.0, 3.0), 102: (40.0, 3.0)})
    fleet.run(4.0)
    assert fleet.animals() == {1: 101, 2: 102, 3: -1}
    fleet.state = {1: State.MONITOR, 2: State.MONITOR, 3: State.STANDBY}
    fleet.run(1.0)
    fleet.state[2], fleet.animal[2] = State.RETURN, -1
    fleet.run(1.0)
    assert fleet.animals() == {1: 101, 2: -1, 3: -1}
    fleet.episode(2, {101: (20.0, 3.0), 102: (40.0, 3.0)}, members=[1, 3])
    fleet.run(4.0)
    assert fleet.animals() == {1: 101, 2: -1, 3: 102}


def test_who_goes_home_in_the_middle_of_an_exchange_is_waited_for_no_more(run_dir: Path) -> None:
    fleet = Fleet(run_dir, line(4))
    fleet.ether.blocked = lambda _one, _other: True
    fleet.episode(1, beside(fleet.places))
    fleet.run(0.3)
    fleet.state[3] = State.RETURN
    fleet.ether.blocked = lambda _one, _other: False
    fleet.run(6.0)
    assert fleet.animals()[3] == -1
    others = [told for drone, told in fleet.last().items() if drone != 3]
    assert all(told.certified and told.animal >= 0 for told in others)


def test_a_drone_far_from_its_radio_keeps_what_it_has(run_dir: Path) -> None:
    fleet = Fleet(run_dir, line(3))
    fleet.episode(1, beside(fleet.places))
    fleet.run(4.0)
    fleet.state = dict.fromkeys(fleet.places, State.MONITOR)
    fleet.ether.blocked = lambda _one, _other: True
    fleet.episode(2, {101: (40.0, 3.0), 102: (60.0, 3.0), 103: (20.0, 3.0)})
    fleet.run(1.5)
    assert fleet.animals() == {1: 101, 2: 102, 3: 103}
    assert not any(told.certified for told in fleet.last().values())
