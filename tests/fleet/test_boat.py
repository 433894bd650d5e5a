"""The boat over a whole flight: it hears the find, gives orders, is lost and comes back.

One flight of five drones over six animals; each test goes on where the one before it ended.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from lcmtypes import channels
from lcmtypes.podwatch import episode_t, mission_state_t
from procs.navigator.states import State
from procs.relay.keys import read_key
from procs.relay.members import BOAT_ID
from procs.relay.relay import TICK_S
from procs.settings import DroneEntry
from tests.fleet.conftest import Flight
from tools.boat.core import Boat, Given
from tools.boat.orders import parse
from tools.sim.settings import SimMission

S = 1_000_000
CLOCK_US = 77 * S  # the boat's clock is its own
STEP_S = 0.05
ALL = [1, 2, 3, 4, 5]
LIMIT_S = 110.0

pytestmark = pytest.mark.timeout(600)


class Sailed:
    """A boat beside a flight on the virtual clock."""

    def __init__(self, flight: Flight) -> None:
        self.flight, self._queue = flight, flight.fleet.queue
        self._radio = flight.fleet.ether.radio(BOAT_ID, flight.plan.mission.roster)
        key = read_key(flight.plan.folder / flight.plan.mission.radio.key_file)
        self.core = Boat(flight.plan.mission, key, self._radio, self.now_us)
        self._radio.on_arrival(lambda: self.core.hear(self.now_us))
        self._is_afloat = True
        self._tick()

    @property
    def now_us(self) -> int:
        return self._queue.now_us + CLOCK_US

    def say(self, line: str) -> Given:
        return self.core.say(parse(line, self.flight.plan.mission.roster), self.now_us)

    def sink(self) -> None:
        self._is_afloat = False
        self._radio.close()

    def _tick(self) -> None:
        if self._is_afloat:
            self.core.tick(self.now_us)
            self._queue.schedule(self._queue.now_us + round(TICK_S * S), self._tick)


class Voyage:
    """The flight, its present boat, and each drone's newest word."""

    def __init__(self, flight: Flight) -> None:
        self.flight = flight
        self.words: dict[int, mission_state_t] = {}
        self.episode = 0  # the newest
        for drone_id, runtimes in flight.fleet.runtimes.items():
            runtimes[0]._bus.observers.append(
                lambda channel, data, own=drone_id: self._hear(own, channel, data)
            )
        self.boat = Sailed(flight)

    def _hear(self, drone_id: int, channel: str, data: bytes) -> None:
        if channel == channels.MISSION_STATE:
            self.words[drone_id] = mission_state_t.decode(data)
        elif channel == channels.RING_EPISODE:
            self.episode = max(self.episode, episode_t.decode(data).number)

    def until(self, is_so: Callable[[], Any], limit_s: float) -> float:
        """Fly on until something is so -> s that it took; fails after `limit_s`."""
        fleet, began_s = self.flight.fleet, self.flight.fleet.now_s
        while not is_so():
            assert fleet.now_s - began_s < limit_s, {d: State(w.state).name for d, w in self.words.items()}
            fleet.run_until(fleet.now_s + STEP_S)
        return fleet.now_s - began_s

    def fly(self, seconds: float) -> None:
        end_s = self.flight.fleet.now_s + seconds
        self.until(lambda: self.flight.fleet.now_s >= end_s, seconds + 1)

    def all_in(self, *states: State) -> bool:
        return [d for d in ALL if self.words[d].state in states] == ALL

    def nearest(self, drone_id: int) -> tuple[int, float]:
        """(the animal that a drone is really over, m from it)."""
        world = self.flight.fleet.world.state()
        (drone,) = [one for one in world.drones if one.id == drone_id]
        return min(
            ((one.id, math.hypot(one.n_m - drone.n_m, one.e_m - drone.e_m)) for one in world.animals),
            key=lambda pair: pair[1],
        )

    @property
    def animals(self) -> list[int]:
        return [self.words[drone_id].animal for drone_id in ALL]


@pytest.fixture(scope="module")
def voyage(near: SimMission, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Voyage]:
    changes = {
        "drones": tuple(DroneEntry(id=k, home_e_m=10.0 * (k - 1)) for k in ALL),
        "pod": near.pod.model_copy(update={"animals": 6}),
        "watch": near.watch.model_copy(update={"watch_s": 600.0}),
        "search": near.search.model_copy(update={"start": "operator"}),
    }
    flight = Flight(near.model_copy(update=changes), tmp_path_factory.mktemp("boat") / "run")
    yield Voyage(flight)
    flight.close()


def test_a_start_from_the_boat_and_the_find_on_the_boat_within_two_seconds_at_30_percent_loss(voyage):
    boat = voyage.boat.core
    voyage.until(lambda: len(voyage.words) == 5 and boat.is_linked(voyage.boat.now_us), 15.0)
    voyage.fly(3.0)
    assert voyage.all_in(State.IDLE), "nobody flies before the boat says so"
    given = voyage.boat.say("start")
    voyage.until(lambda: not boat.left_to_obey(given, voyage.boat.now_us), 10.0)
    voyage.flight.fleet.ether.loss = 0.3
    voyage.until(lambda: any(word.found for word in voyage.words.values()), LIMIT_S)
    took_s = voyage.until(lambda: any(row.found for row in boat.rows(voyage.boat.now_us).values()), 5.0)
    print(f"the boat heard the find after {took_s:.2f} s")
    assert took_s <= 2.0
    voyage.flight.fleet.ether.loss = 0.02
    (row,) = [row for row in boat.rows(voyage.boat.now_us).values() if row.found][:1]
    word = next(word for word in voyage.words.values() if word.found)
    assert abs(row.found_n_m - word.found_n_m) < 1.0


def test_every_drone_and_its_animal_are_seen_from_the_boat(voyage):
    voyage.until(lambda: voyage.all_in(State.MONITOR), LIMIT_S)
    voyage.fly(5.0)
    rows = voyage.boat.core.rows(voyage.boat.now_us)
    assert [rows[d].animal for d in ALL] == voyage.animals
    assert len(set(voyage.animals)) == 5


def test_leave_frees_that_animal_within_one_episode_and_no_drone_takes_it_again(voyage):
    left, before = voyage.animals[2], voyage.episode
    truly_left, _ = voyage.nearest(3)
    voyage.boat.say(f"leave {left}")
    took_s = voyage.until(lambda: left not in voyage.animals, 20.0)
    print(f"animal {left} was free after {took_s:.2f} s and {voyage.episode - before} episodes")
    assert voyage.episode - before <= 1
    taken: set[int] = set()
    end_s = voyage.flight.fleet.now_s + 35.0  # the order itself dies before
    voyage.until(lambda: taken.update(voyage.animals) or voyage.flight.fleet.now_s >= end_s, 40.0)
    assert left not in taken
    voyage.until(lambda: voyage.all_in(State.MONITOR), 60.0)
    voyage.fly(5.0)
    assert sorted(voyage.nearest(d)[0] for d in ALL) == sorted({*range(1, 7)} - {truly_left}), "by truth"


def test_a_boat_that_is_lost_changes_nothing(voyage):
    before = {d: (w.state, w.animal) for d, w in voyage.words.items()}
    voyage.boat.sink()
    seen = []
    end_s = voyage.flight.fleet.now_s + 12.0

    def look() -> bool:
        seen.append({d: (w.state, w.animal) for d, w in voyage.words.items()})
        return voyage.flight.fleet.now_s >= end_s

    voyage.until(look, 15.0)
    assert all(now == before for now in seen)


@pytest.mark.parametrize(
    ("line", "states"), [("hold", (State.HOLD,)), ("return", (State.RETURN, State.LAND, State.LANDED))]
)
def test_the_last_of_five_obeys_within_a_second_with_one_link_cut(voyage, line, states):
    if line == "hold":  # a new boat, after the one that was lost
        voyage.flight.fleet.cut(2, 3, True)
        voyage.boat = Sailed(voyage.flight)
        voyage.until(lambda: voyage.boat.core.is_linked(voyage.boat.now_us), 15.0)
        voyage.fly(4.0)
    given = voyage.boat.say(line)
    took_s = voyage.until(lambda: voyage.all_in(*states), 5.0)
    print(f"{line}: the last of five obeyed after {took_s:.2f} s")
    assert took_s <= 1.0
    voyage.until(lambda: not voyage.boat.core.left_to_obey(given, voyage.boat.now_us), 2.0)


def test_one_drone_alone_is_told(voyage):
    """Order by order, each ends what was said before to that drone and to no other."""
    given = voyage.boat.say("land 4")
    voyage.until(lambda: voyage.words[4].state in (State.LAND, State.LANDED), 1.0)
    assert voyage.words[5].state == State.RETURN
    voyage.until(lambda: not voyage.boat.core.left_to_obey(given, voyage.boat.now_us), 2.0)
