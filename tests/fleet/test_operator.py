"""The boat's orders through the whole path: its relay, the drones' relays, FLEET_STATE, the navigators."""

import pytest

from lcmtypes.podwatch import operator_t
from procs.navigator.states import State
from procs.relay.fleet import Order
from procs.relay.keys import read_key
from procs.relay.members import BOAT_ID
from procs.relay.relay import TICK_S, Relay
from tests.fleet.conftest import Flight

S = 1_000_000
CLOCK_US = 77 * S  # the boat's clock is its own
LINKED_S = 6.0  # until the boat is heard and knows the fleet's time
LISTENED_S = 8.0  # a drone listens for 3 s before it takes off; the rest is the order's way

pytestmark = pytest.mark.timeout(300)


class Boat:
    """Roster member 0: a relay like any other, and nothing else."""

    def __init__(self, flight: Flight) -> None:
        self._queue = flight.fleet.queue
        self._radio = flight.fleet.ether.radio(BOAT_ID, flight.plan.mission.roster)
        self.core = Relay(
            own_id=BOAT_ID,
            roster=flight.plan.mission.roster,
            fleet_key=read_key(flight.plan.folder / flight.plan.mission.radio.key_file),
            session=self._radio.session_id(),
            send=self._radio.send,
            reachable=self._radio.peers,
            bytes_per_s=flight.plan.mission.radio.bytes_per_s,
            lost_after_s=3.0,
            now_us=self.now_us,
        )
        self._radio.on_arrival(self._hear)
        self._tick()

    @property
    def now_us(self) -> int:
        return self._queue.now_us + CLOCK_US

    def order(self, command: int, target: int = 0, expiry_s: int = 30) -> None:
        """Give an order now, in fleet time."""
        state = self.core.fleet_state(self.now_us)
        assert state.fleet_time_ok, "an order in no time would hold for nobody"
        self.core.fleet.order(Order(self.now_us + state.fleet_offset_us, command, target, -1, expiry_s))

    def _hear(self) -> None:
        for data in self._radio.receive():
            self.core.receive(data, self.now_us)

    def _tick(self) -> None:
        self.core.tick(self.now_us)
        self._queue.schedule(self._queue.now_us + round(TICK_S * S), self._tick)


@pytest.fixture
def waiting(flight, near) -> tuple[Flight, Boat]:
    """Three drones on the ground whose mission begins on the boat's order, and the boat."""
    search = near.search.model_copy(update={"start": "operator"})
    flown = flight(3, 3, 20.0, search=search)
    boat = Boat(flown)
    flown.fly(LINKED_S + LISTENED_S)
    assert flown.in_state(State.IDLE) == [1, 2, 3], "without an order nobody flies"
    return flown, boat


def test_a_start_order_from_the_boat_begins_the_mission_on_every_drone(waiting):
    flown, boat = waiting
    boat.order(operator_t.START)
    flown.fly(LISTENED_S, lambda: not flown.in_state(State.IDLE))
    assert not flown.in_state(State.IDLE)
    flown.fly(40.0, lambda: State.SCOUT in flown.watch.states.values())
    assert flown.in_state(State.SCOUT) == [1]
    boat.order(operator_t.RETURN)
    flown.fly(60.0, lambda: len(flown.in_state(State.LANDED)) == 3)
    assert flown.in_state(State.LANDED) == [1, 2, 3]
    flown.fly(LISTENED_S)
    assert flown.in_state(State.LANDED) == [1, 2, 3], "the START of before begins nothing anew"


def test_an_order_for_one_drone_starts_that_one_alone(waiting):
    flown, boat = waiting
    boat.order(operator_t.START, target=2)
    flown.fly(LISTENED_S)
    assert flown.in_state(State.IDLE) == [1, 3]


def test_an_order_that_has_died_of_age_starts_nobody(waiting):
    flown, boat = waiting
    flown.fleet.ether.blocked = lambda sender, _receiver: sender == BOAT_ID
    boat.order(operator_t.START, expiry_s=2)
    flown.fly(3.0)
    flown.fleet.ether.blocked = lambda _sender, _receiver: False
    flown.fly(LISTENED_S)
    assert flown.in_state(State.IDLE) == [1, 2, 3]
