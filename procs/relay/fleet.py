"""The fleet table: one row a drone and the operator's orders, merged from every path and sent again at 2
Hz.

Rows and orders are whole state. A row beats another of the same drone by its counter, an order by its
time, whichever path brought it, in any order and however often; so any loss costs time and nothing else,
on a ring as on a line.

The row counter counts tenths of a second of its drone's clock modulo 2^15 (54 minutes), so that it goes on
when a relay restarts; when a drone's clock has begun anew, a row that is newer by its age beats the
counter.

A find and the scout's waypoint travel in the row's marker. A drone that says the same as the lowest row
with a marker leaves its own away: one marker serves the fleet.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace

from lcmtypes import make
from lcmtypes.podwatch import fleet_row_t, operator_t
from procs.relay.members import AGE_STEP_US, BOAT_ID
from procs.relay.rows import COUNTER_RANGE, NO_MARKER, Marker, Row, pack_row, unpack_row, with_age

__all__ = ["TABLE_LIMIT_BYTES", "FleetTable", "Order"]

TABLE_LIMIT_BYTES = 300
MAX_ORDERS = 6  # those to fly first, and one of the rest in turn; 13 bytes each
# An order from further ahead was given in an earlier fleet time, which ended when all were switched off.
AHEAD_US = 5_000_000
ORDER = struct.Struct(">qBBBH")
NO_ANIMAL = 255
COUNTER_STEP_US = 100_000
# Rows whose ages differ by this much against their counters are of two lives of their drone's clock.
RESTART_US = 1_000_000
SAME_FIND_M = 1.0


@dataclass(frozen=True)
class Order:
    """An operator_t as the table keeps it. utime_us in fleet time; target 0 is everybody."""

    utime_us: int
    command: int
    target: int
    animal: int
    expiry_s: int

    def is_valid(self, fleet_us: int) -> bool:
        """Whether it is in force at a moment of fleet time."""
        return self.utime_us - AHEAD_US <= fleet_us <= self.utime_us + self.expiry_s * 1_000_000

    def message(self) -> operator_t:
        return make(
            operator_t,
            utime=self.utime_us,
            command=self.command,
            target=self.target,
            animal=self.animal,
            expiry_s=self.expiry_s,
        )


NO_ORDER = Order(0, operator_t.NONE, 0, -1, 0)
ABOUT_ANIMALS = (operator_t.LEAVE, operator_t.WATCH)


@dataclass(frozen=True)
class _Entry:
    row: Row
    wire: bytes
    born_us: int  # own clock, when the row's position was true
    source: int  # the peer that brought it


class FleetTable:
    """What one drone knows of all. Times in us of its own clock but where fleet time is said."""

    def __init__(self, own_id: int, ids: tuple[int, ...]) -> None:
        """`ids`: the boat and the roster, in the order of the age table."""
        self.own_id = own_id
        self.ids = ids
        self._entries: dict[int, _Entry] = {}
        self._orders: dict[int, Order] = {}  # to fly, the newest by target
        self._animal_orders: dict[int, Order] = {}  # to leave it or to watch it again, the newest by animal
        self._is_own_said = False
        self._sent: dict[
            int, dict[int, tuple[int, int]]
        ] = {}  # to each peer, of each row: counter, how recently
        self._n_sent = 0
        self._n_packed: dict[int, int] = {}  # tables for each peer

    def say(self, row: Row, born_us: int, now_us: int) -> None:
        """Set this drone's own row. `row.marker` says its find and waypoint in full. Raises RowError."""
        row = replace(row, counter=now_us // COUNTER_STEP_US % COUNTER_RANGE, marker=self._needed_marker(row))
        self._entries[self.own_id] = self._entry(row, born_us, now_us)
        self._is_own_said = True

    def order(self, order: Order, fleet_us: int | None = None) -> bool:
        """Take in an order -> whether it is news: the newest for its target wins, and a newer one for
        everybody ends those for one. What is said of an animal stands beside them: a drone on hold hears
        that its animal is to be left. Where fleet time is known, what is not in force neither comes in nor
        keeps anything out.
        """
        if fleet_us is not None:
            self._forget_ended(fleet_us)
            if not order.is_valid(fleet_us):
                return False
        if order.command in ABOUT_ANIMALS:
            known = self._animal_orders.get(order.animal)
            if known is not None and known.utime_us >= order.utime_us:
                return False
            self._animal_orders[order.animal] = order
            return True
        for target in (order.target, BOAT_ID):
            if target in self._orders and self._orders[target].utime_us >= order.utime_us:
                return False
        if order.target == BOAT_ID:
            self._orders = {
                target: kept for target, kept in self._orders.items() if kept.utime_us > order.utime_us
            }
        self._orders[order.target] = order
        return True

    def order_for(self, drone_id: int, fleet_us: int | None) -> Order:
        """The newest order in force for one drone; NONE where there is none, or where fleet time is not
        known."""
        if fleet_us is None:
            return NO_ORDER
        self._forget_ended(fleet_us)
        mine = [order for target, order in self._orders.items() if target in (BOAT_ID, drone_id)]
        return max(mine, key=lambda order: order.utime_us, default=NO_ORDER)

    def left(self, fleet_us: int | None) -> list[int]:
        """Ids of the animals that are to be left. Where fleet time is not known, orders outlive their expiry:
        rather an animal too few is watched.
        """
        if fleet_us is not None:
            self._forget_ended(fleet_us)
        orders = self._animal_orders.items()
        return sorted(animal for animal, order in orders if order.command == operator_t.LEAVE)

    @property
    def is_windowed(self) -> bool:
        """Whether the table is too large for one datagram."""
        rows_bytes = sum(len(entry.wire) for entry in self._entries.values())
        return self._bitmap_bytes + rows_bytes + 1 + MAX_ORDERS * ORDER.size > TABLE_LIMIT_BYTES

    def pack(self, peer_id: int, now_us: int) -> bytes:
        """The table for one peer, at most 300 bytes: bitmap of the rows within, rows, orders.

        A larger table goes as a window that moves on at each call: this drone's own row, then rows that are
        news to the peer, then the rest, each by how long ago it was sent to that peer.
        """
        orders = self._orders_to_send(peer_id)
        tail = bytes([len(orders)]) + b"".join(_pack_order(order) for order in orders)
        room = TABLE_LIMIT_BYTES - self._bitmap_bytes - len(tail)
        sent = self._sent.setdefault(peer_id, {})
        chosen: list[int] = []
        for member in sorted(self._entries, key=lambda member: self._sending_rank(member, peer_id)):
            entry = self._entries[member]
            if len(entry.wire) > room:
                break
            room -= len(entry.wire)
            self._n_sent += 1
            sent[member] = entry.row.counter, self._n_sent
            chosen.append(self.ids.index(member))
        bitmap = sum(1 << place for place in chosen).to_bytes(self._bitmap_bytes, "big")
        entries = [self._entries[self.ids[place]] for place in sorted(chosen)]
        return bitmap + b"".join(with_age(entry.wire, now_us - entry.born_us) for entry in entries) + tail

    def merge(self, peer_id: int, data: bytes, sent_us: int, fleet_us: int | None = None) -> bool:
        """Take in a peer's table, sent at `sent_us` -> whether it brings what all should hear at once: an
        order, a find. fleet_us: fleet time, where it is known. Raises ValueError where it is not laid out
        as `pack` does it."""
        bitmap, rest = int.from_bytes(data[: self._bitmap_bytes], "big"), data[self._bitmap_bytes :]
        if len(data) < self._bitmap_bytes or bitmap >> len(self.ids):
            raise ValueError(
                f"a fleet table whose bitmap {bitmap:#x} does not fit a roster of {len(self.ids)}"
            )
        heard: list[tuple[int, Row, bytes, int]] = []
        for place, member in enumerate(self.ids):
            if bitmap >> place & 1:
                row, age, used = unpack_row(rest)
                heard.append((member, row, rest[:used], sent_us - age * AGE_STEP_US))
                rest = rest[used:]
        if not rest or len(rest) != 1 + rest[0] * ORDER.size:
            raise ValueError(f"a fleet table with {len(rest)} bytes where its orders should be")
        n_finds = self.n_finds
        for member, row, wire, born_us in heard:
            self._hear_row(member, _Entry(row, wire, born_us, peer_id))
        orders = [
            self.order(
                Order(utime_us, command, target, -1 if animal == NO_ANIMAL else animal, expiry_s), fleet_us
            )
            for utime_us, command, target, animal, expiry_s in ORDER.iter_unpack(rest[1:])
        ]
        return any(orders) or self.n_finds > n_finds

    @property
    def n_finds(self) -> int:
        """How many drones say that a pod was found."""
        return sum(entry.row.found for entry in self._entries.values())

    def has_line(self, living: Sequence[int]) -> bool:
        """Whether a living drone says that a link to its living neighbour is silent."""
        return any(self._entries[member].row.is_line for member in living if member in self._entries)

    def rows(self, living: Sequence[int], now_us: int) -> list[fleet_row_t]:
        """All known rows as messages: this drone first, the rest by id."""
        members = sorted(self._entries, key=lambda member: (member != self.own_id, member))
        return [self._message(member, member in living, now_us) for member in members]

    def newest_order_us(self) -> int:
        """When the newest order that is kept was given, fleet time; 0 where there is none."""
        kept = (*self._orders.values(), *self._animal_orders.values())
        return max((order.utime_us for order in kept), default=0)

    def _forget_ended(self, fleet_us: int) -> None:
        """Drop the orders that are not in force."""
        for orders in (self._orders, self._animal_orders):
            for key in [key for key, order in orders.items() if not order.is_valid(fleet_us)]:
                del orders[key]

    def _orders_to_send(self, peer_id: int) -> list[Order]:
        """Those to fly first, the newest of each kind first; where there are too many, the last place goes to
        each of the rest in turn.
        """
        kinds = (self._orders.values(), self._animal_orders.values())
        orders = [order for kind in kinds for order in sorted(kind, key=lambda order: -order.utime_us)]
        if len(orders) <= MAX_ORDERS:
            return orders
        first, rest = orders[: MAX_ORDERS - 1], orders[MAX_ORDERS - 1 :]
        turn = self._n_packed[peer_id] = self._n_packed.get(peer_id, 0) + 1
        return [*first, rest[turn % len(rest)]]

    @property
    def _bitmap_bytes(self) -> int:
        return (len(self.ids) + 7) // 8

    def _entry(self, row: Row, born_us: int, now_us: int) -> _Entry:
        wire = pack_row(row, now_us - born_us)
        rounded, _, _ = unpack_row(wire)  # every drone, this one too, knows the row as it travels
        return _Entry(rounded, wire, born_us, self.own_id)

    def _sending_rank(self, member: int, peer_id: int) -> tuple[bool, bool, int, int]:
        """Lowest goes first to `peer_id`. What came from the peer, or went to it already, is no news to
        it."""
        entry = self._entries[member]
        counter, when = self._sent.get(peer_id, {}).get(member, (-1, 0))
        is_news = entry.source != peer_id and entry.row.counter != counter
        return member != self.own_id, not is_news, when, member

    def _hear_row(self, member: int, heard: _Entry) -> None:
        if member == self.own_id and self._is_own_said:
            return  # before that, what the fleet remembers of this drone's last life is the best there is
        known = self._entries.get(member)
        if known is not None:
            ahead = (heard.row.counter - known.row.counter) % COUNTER_RANGE
            is_ahead = 0 < ahead < COUNTER_RANGE // 2
            younger_us = heard.born_us - known.born_us
            # Of two lives of a drone's clock the younger row counts; within one life the counter does.
            if ahead == 0 or younger_us < -RESTART_US or (not is_ahead and younger_us <= RESTART_US):
                return
        self._entries[member] = heard

    def _marker_of(self, member: int) -> Marker:
        """The find and waypoint that hold for a row: its own marker, or that of the lowest row that has
        one."""
        own = self._entries[member].row.marker if member in self._entries else None
        return own or self._lower_marker(member) or NO_MARKER

    def _lower_marker(self, member: int) -> Marker | None:
        for other in sorted(self._entries):
            marker = self._entries[other].row.marker
            if other < member and other != BOAT_ID and marker is not None:
                return marker
        return None

    def _needed_marker(self, row: Row) -> Marker | None:
        """The row's marker, left away where a lower row says the same or where there is nothing to say."""
        own = row.marker or NO_MARKER
        lower = self._lower_marker(self.own_id)
        if not row.found and own.waypoint <= 0:
            return None
        if lower is None:
            return own
        is_near = (
            abs(lower.found_n_m - own.found_n_m) <= SAME_FIND_M
            and abs(lower.found_e_m - own.found_e_m) <= SAME_FIND_M
            and abs(lower.pod_radius_m - own.pod_radius_m) <= SAME_FIND_M
        )
        is_same = (own.waypoint <= 0 or own.waypoint == lower.waypoint) and (is_near or not row.found)
        return None if is_same else own

    def _message(self, member: int, alive: bool, now_us: int) -> fleet_row_t:
        entry = self._entries[member]
        row, marker = entry.row, self._marker_of(member)
        n_m, e_m, d_m = row.position_m
        vn_m_s, ve_m_s, vd_m_s = row.velocity_m_s
        return make(
            fleet_row_t,
            id=member,
            alive=alive,
            age_ms=min(max(0, (now_us - entry.born_us) // 1000), 2**31 - 1),
            state=row.state,
            animal=row.animal,
            battery=row.battery,
            n_m=n_m,
            e_m=e_m,
            d_m=d_m,
            vn_m_s=vn_m_s,
            ve_m_s=ve_m_s,
            vd_m_s=vd_m_s,
            found=row.found,
            found_n_m=marker.found_n_m if row.found else 0.0,
            found_e_m=marker.found_e_m if row.found else 0.0,
            pod_radius_m=marker.pod_radius_m if row.found else 0.0,
            waypoint=marker.waypoint,
            on_station=row.on_station,
            wants_episode=row.wants_episode,
        )


def _pack_order(order: Order) -> bytes:
    animal = order.animal if 0 <= order.animal < NO_ANIMAL else NO_ANIMAL
    return ORDER.pack(
        order.utime_us, order.command, order.target, animal, min(max(order.expiry_s, 0), 0xFFFF)
    )
