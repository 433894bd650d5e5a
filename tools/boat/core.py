"""The boat's end of the radio: a relay like any other, and the orders that it gives."""

from dataclasses import dataclass
from typing import Any

from lcmtypes.podwatch import fleet_row_t, fleet_state_t, link_t, operator_t
from procs.navigator.states import State
from procs.relay.fleet import Order
from procs.relay.members import BOAT_ID
from procs.relay.relay import Relay
from procs.settings import Mission
from tools.boat.orders import BoatError, Spoken

__all__ = ["Boat", "Given"]

S = 1_000_000
# How long an order holds, s. One to hold outlasts a lost boat, not the day; one to leave an animal does both.
EXPIRY_S = {
    operator_t.START: 30,
    operator_t.HOLD: 1800,
    operator_t.RETURN: 60,
    operator_t.LAND: 60,
    operator_t.LEAVE: 6 * 3600,
    operator_t.WATCH: 6 * 3600,
}
ON_GROUND = (State.IDLE, State.LANDED)


@dataclass(frozen=True)
class Given:
    """An order that was given, and when by the boat's clock."""

    spoken: Spoken
    order: Order
    at_us: int


class Boat:
    """Roster member 0. All times in us of the boat's own clock."""

    def __init__(self, mission: Mission, fleet_key: bytes, radio: Any, now_us: int) -> None:
        """radio: with the interface of `drivers.radios.udp.UdpRadio`. Raises ValueError where it has no
        address of a drone.
        """
        self.mission = mission
        self.given: list[Given] = []
        self._find: fleet_row_t | None = None
        self._radio = radio
        self._relay = Relay.on_radio(radio, mission, BOAT_ID, fleet_key, now_us)

    def hear(self, now_us: int) -> None:
        """Take in all that waits on the radio."""
        for datagram in self._radio.receive():
            self._relay.receive(datagram, now_us)

    def tick(self, now_us: int) -> None:
        """Every `procs.relay.relay.TICK_S`."""
        self._relay.tick(now_us)

    def state(self, now_us: int) -> fleet_state_t:
        """The fleet as the boat knows it."""
        return self._relay.fleet_state(now_us)

    def rows(self, now_us: int) -> dict[int, fleet_row_t]:
        """The drones that were ever heard of, by id."""
        return {row.id: row for row in self.state(now_us).rows if row.id != BOAT_ID}

    def find(self, now_us: int) -> fleet_row_t | None:
        """The row that says where the pod was found; kept when the fleet has gone home."""
        saying = [row for row in self.rows(now_us).values() if row.found]
        self._find = saying[0] if saying else self._find
        return self._find

    def links(self, now_us: int) -> list[link_t]:
        """The boat's own links to drones; begins a new second of counting their bytes."""
        return list(self._relay.link_state(now_us).links)

    def is_linked(self, now_us: int) -> bool:
        """Whether some drone hears the boat and the fleet's time is known: orders can be given."""
        is_heard = any(link.is_up(now_us) for link in self._relay.links.values())
        return is_heard and bool(self.state(now_us).fleet_time_ok)

    def say(self, spoken: Spoken, now_us: int) -> Given:
        """Give an order to the fleet. Raises BoatError where it can reach nobody."""
        state = self.state(now_us)
        if not self.is_linked(now_us):
            raise BoatError("no drone hears the boat yet: an order would reach nobody; wait for the link")
        # The newest word counts, also where another boat's clock runs a little ahead.
        fleet_us = max(now_us + int(state.fleet_offset_us), self._relay.fleet.newest_order_us() + 1)
        order = Order(fleet_us, spoken.command, spoken.target, spoken.animal, EXPIRY_S[spoken.command])
        if not self._relay.order(order, now_us):
            raise BoatError(f"{spoken}: the fleet keeps a newer order than this one; say it again")
        self.given.append(Given(spoken, order, now_us))
        return self.given[-1]

    def left_to_obey(self, given: Given, now_us: int) -> list[int]:
        """Living drones that do not yet do what they were told."""
        rows = self.rows(now_us)
        told = [given.spoken.target] if given.spoken.target else list(rows)
        living = [rows[drone_id] for drone_id in told if drone_id in rows and rows[drone_id].alive]
        return [row.id for row in living if not _obeys(given.spoken, row)]


def _obeys(spoken: Spoken, row: fleet_row_t) -> bool:
    state = State(row.state)
    if spoken.command == operator_t.START:
        return state not in (*ON_GROUND, State.HOLD)
    if spoken.command == operator_t.HOLD:
        return state in (State.HOLD, *ON_GROUND)
    if spoken.command == operator_t.LEAVE:
        return int(row.animal) != spoken.animal
    if spoken.command == operator_t.WATCH:
        return True  # it may be watched; who does is for the fleet to agree
    if spoken.command == operator_t.LAND:
        return state in (State.LAND, *ON_GROUND)
    return state in (State.RETURN, State.LAND, *ON_GROUND)
