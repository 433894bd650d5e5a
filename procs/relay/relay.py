"""The relay's core: everything that crosses between drones, with time and datagrams as arguments
(docs/relay.md).

It speaks to its living ring neighbours, to the boat while it hears it, and once a second to a few of the
lost, so that partitions meet again. `tick` sends each neighbour the link's part (ages, clocks) and every
second time the fleet table; messages of the own bus go as they are said, as far as the byte cap lets them.
"""

import struct
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from lcmtypes import channels, make
from lcmtypes.channels import Channel
from lcmtypes.podwatch import episode_t, fleet_state_t, link_state_t, mission_state_t, vehicle_state_t
from procs.relay import datagram
from procs.relay.budget import ByteWindow, Message
from procs.relay.clock_sync import FleetClock
from procs.relay.fleet import TABLE_LIMIT_BYTES, FleetTable, Order
from procs.relay.link import LINK_KIND, Link
from procs.relay.members import BOAT_ID, Members, Neighbours
from procs.relay.passing import PASSED_ON, EpisodeRoll
from procs.relay.rows import Marker, Row
from procs.relay.seal import MAX_OVERHEAD_BYTES, Refusal, RefusedError, Sessions
from procs.settings import Mission

__all__ = ["DATAGRAM_LIMIT_BYTES", "ENCODED_LIMIT_BYTES", "MAX_MEMBERS", "TICK_S", "Copy", "Relay"]

TICK_S = 0.25
TICKS_PER_TABLE = 2
NEWS_TICKS = 4
TICKS_PER_HELLO = 4
HELLOS = 4  # lost members called at each such tick, in turn
ENCODED_LIMIT_BYTES = 400  # of one message as LCM encodes it
DATAGRAM_LIMIT_BYTES = 500
MAX_MEMBERS = 63  # drones in the roster: the bitmap of fleet_state_t is an int64
ROW_BYTES = 22

Send = Callable[[int, bytes], bool]


@dataclass(frozen=True)
class Copy:
    """A neighbour's message that may be said on the own bus, as it is."""

    sender: int
    channel: Channel
    data: bytes


class Relay:
    """One drone's end of all its links. All times in us of its own clock."""

    @classmethod
    def on_radio(cls, radio: Any, mission: Mission, own_id: int, fleet_key: bytes, now_us: int) -> "Relay":
        """The relay of one member of a fleet, on a radio with the interface of `drivers.radios.udp.UdpRadio`.

        Raises ValueError where the radio has no address for a drone of the roster.
        """
        return cls(
            own_id=own_id,
            roster=mission.roster,
            fleet_key=fleet_key,
            session=radio.session_id(),
            send=radio.send,
            reachable=radio.peers,
            bytes_per_s=mission.radio.bytes_per_s,
            lost_after_s=mission.radio.lost_after_s,
            now_us=now_us,
        )

    def __init__(
        self,
        own_id: int,
        roster: tuple[int, ...],
        fleet_key: bytes,
        session: int,
        send: Send,
        reachable: Collection[int],
        bytes_per_s: int,
        lost_after_s: float,
        now_us: int,
    ) -> None:
        """`send(peer_id, datagram)` hands a datagram to the radio and says whether the radio took it;
        `reachable`: the peers that it has an address for. Raises ValueError where a drone of the roster is
        not among them."""
        missing = [member for member in roster if member != own_id and member not in reachable]
        if missing:
            raise ValueError(
                f"the radio has no address for drones {missing} of the roster {roster}; add them to its peers"
            )
        if len(roster) > MAX_MEMBERS:
            raise ValueError(f"a roster of {len(roster)} drones: a fleet has at most {MAX_MEMBERS}; fly two")
        self.own_id = own_id
        self.members = Members(own_id, roster, lost_after_s, now_us)
        self.sessions = Sessions(fleet_key, own_id, session, self.members.ids)
        self.fleet = FleetTable(own_id, self.members.ids)
        self.fleet_clock = FleetClock(own_id, len(roster), now_us)
        self._roll = EpisodeRoll(roster.index(own_id) if own_id in roster else None)
        self.refused: dict[Refusal, int] = {}  # arrivals that were not believed, by reason, since start
        self._send_to_radio = send
        reserved = self._own_bytes_per_s(bytes_per_s)
        self.links = {
            peer_id: Link(peer_id, ByteWindow(bytes_per_s, reserved), round(lost_after_s * 1e6))
            for peer_id in self.members.ids
            if peer_id != own_id and peer_id in reachable
        }
        head = MAX_OVERHEAD_BYTES + datagram.HEAD.size + len(self.members.ids) + 1
        self.encoded_limit_bytes = min(ENCODED_LIMIT_BYTES, DATAGRAM_LIMIT_BYTES - head)
        self._n_ticks = 0
        self._hello_turn = 0
        self._n_news_ticks = 0  # for which the table still goes at every tick

    def describe(self, mission: mission_state_t, vehicle: vehicle_state_t, now_us: int) -> None:
        """Set this drone's row of the fleet table from its navigator's and autopilot's last words."""
        marker = Marker(mission.found_n_m, mission.found_e_m, mission.pod_radius_m, mission.waypoint)
        row = Row(
            counter=0,
            state=mission.state,
            animal=mission.animal,
            battery=vehicle.battery,
            position_m=(vehicle.n_m, vehicle.e_m, vehicle.d_m),
            velocity_m_s=(vehicle.vn_m_s, vehicle.ve_m_s, vehicle.vd_m_s),
            found=mission.found,
            on_station=mission.on_station,
            wants_episode=mission.wants_episode,
            is_line=bool(self.silent_sides(now_us)),
            marker=marker,
        )
        n_finds = self.fleet.n_finds
        self.fleet.say(row, vehicle.utime, now_us)
        if self.fleet.n_finds > n_finds:
            self._spread(now_us)

    def order(self, order: Order, now_us: int) -> bool:
        """Give an order to the fleet, as the boat does -> whether it counts: a newer one may be known."""
        is_news = self.fleet.order(order, self._fleet_us(now_us))
        if is_news:
            self._spread(now_us)
        return is_news

    def say(self, channel: Channel, data: bytes, utime: int, payload_bytes: int, now_us: int) -> None:
        """Send a message of the own bus to both neighbours, now or as soon as the cap allows.

        Raises ValueError where its channel may not cross or it is too large to cross.
        """
        if not channel.crosses:
            raise ValueError(f"{channel.name} may not cross the ring (lcmtypes/channels.py)")
        if len(data) > self.encoded_limit_bytes:
            raise ValueError(
                f"{channel.name} of {len(data)} bytes: at most {self.encoded_limit_bytes} may cross"
            )
        if channel.name == channels.RING_EPISODE:
            self._roll.hear(episode_t.decode(data))
        message = Message(channel, data, utime, payload_bytes)
        for peer_id in self.members.neighbours(now_us).ids:
            self.links[peer_id].queue.offer(message)
        self.pump(now_us)

    def pump(self, now_us: int) -> None:
        """Send what waits for the neighbours, as far as the cap allows."""
        neighbours = self.members.neighbours(now_us).ids
        for peer_id, link in self.links.items():
            if peer_id not in neighbours:
                link.queue.clear()
                continue
            while (message := link.queue.first(now_us)) is not None and self._send_message(
                link, message, now_us
            ):
                link.queue.remove(message)

    def tick(self, now_us: int) -> None:
        """Every TICK_S: the relay's own datagrams."""
        living = self.members.living(now_us)
        self.fleet_clock.update(living, {peer_id: link.clock for peer_id, link in self.links.items()}, now_us)
        has_news = self._n_news_ticks > 0
        has_table = has_news or self.fleet.is_windowed or self._n_ticks % TICKS_PER_TABLE == 0
        self._n_news_ticks -= has_news
        spoken_to = self._spoken_to(now_us)
        for peer_id, link in self.links.items():
            if peer_id in spoken_to:
                self._send_own(link, has_table, now_us)
            elif link.is_knocking:
                self._send_own(link, False, now_us)
            link.is_knocking = False
        if self._n_ticks % TICKS_PER_HELLO == 0:
            called = self._called(now_us)
            for k in range(min(HELLOS, len(called))):
                self._send_own(self.links[called[(self._hello_turn + k) % len(called)]], False, now_us)
            self._hello_turn += HELLOS
        self._n_ticks += 1

    def receive(self, data: bytes, now_us: int) -> Copy | None:
        """Take in one datagram; the neighbour's message in it, where it carries one that may be said on
        the own bus."""
        try:
            opened = self.sessions.open(data)
        except RefusedError as refused:
            self._refuse(refused.reason, refused.sender)
            return None
        link = self.links.get(opened.sender)
        if link is None:
            self._refuse(Refusal.STRANGER, None)
            return None
        if opened.is_new_session:
            link.restart()
        try:
            body = datagram.unpack(opened.body, len(self.members.ids))
            if link.is_late(body.stamp_us, now_us):
                self._refuse(Refusal.LATE, link.peer_id)
                return None
            self._hear(link, body, now_us)
        except ValueError:
            self._refuse(Refusal.MALFORMED, link.peer_id)
            return None
        if body.message is None:
            return None
        return self._accept(link, body.message, now_us)

    def silent_sides(self, now_us: int) -> tuple[str, ...]:
        """ "left", "right" or both: sides whose living neighbour is not heard or does not hear us."""
        neighbours = self.members.neighbours(now_us)
        sides = (("left", neighbours.left), ("right", neighbours.right))
        return tuple(side for side, peer_id in sides if peer_id and not self.links[peer_id].is_up(now_us))

    def fleet_state(self, now_us: int) -> fleet_state_t:
        """FLEET_STATE as of now."""
        living = self.members.living(now_us)
        neighbours: Neighbours = self.members.neighbours(now_us)
        is_ok = self.fleet_clock.is_ok(now_us)
        offset_us = round(self.fleet_clock.offset_us)
        fleet_us = self._fleet_us(now_us)
        heard = [*living, *(member for member in (BOAT_ID,) if self.members.lives(member, now_us))]
        rows = self.fleet.rows(heard, now_us)
        left = self.fleet.left(fleet_us)
        boat_us = self.members.age_us(BOAT_ID, now_us)
        return make(
            fleet_state_t,
            fleet_offset_us=offset_us,
            fleet_time_ok=is_ok,
            left_id=neighbours.left,
            right_id=neighbours.right,
            is_line=bool(self.silent_sides(now_us)) or self.fleet.has_line(living),
            members=self.members.bitmap(now_us),
            n_rows=len(rows),
            rows=rows,
            order=self.fleet.order_for(self.own_id, fleet_us).message(),
            boat_age_ms=-1 if boat_us is None else min(boat_us // 1000, 2**31 - 1),
            n_left=len(left),
            left=left,
        )

    def _fleet_us(self, now_us: int) -> int | None:
        """Fleet time, None where it is not known."""
        is_ok = self.fleet_clock.is_ok(now_us)
        return now_us + round(self.fleet_clock.offset_us) if is_ok else None

    def link_state(self, now_us: int) -> link_state_t:
        """LINK_STATE: the neighbours' links, and any other that was used since the last report."""
        neighbours = self.members.neighbours(now_us).ids
        links = [
            link.report(self.sessions.loss(peer_id), now_us)
            for peer_id, link in self.links.items()
            if peer_id in neighbours or link.bytes_since_report or link.is_up(now_us) or link.n_rejected
        ]
        return make(link_state_t, session=self.sessions.session, n_links=len(links), links=links)

    def _own_bytes_per_s(self, bytes_per_s: int) -> int:
        """What the relay's own datagrams need on one link, at most half of the cap."""
        n_members = len(self.members.ids)
        link_bytes = MAX_OVERHEAD_BYTES + datagram.HEAD.size + n_members + datagram.CLOCK_PART.size
        table_bytes = min(TABLE_LIMIT_BYTES, n_members * ROW_BYTES)
        ticks_per_s = round(1 / TICK_S)
        tables_per_s = ticks_per_s if table_bytes == TABLE_LIMIT_BYTES else ticks_per_s // TICKS_PER_TABLE
        return min(bytes_per_s // 2, ticks_per_s * link_bytes + tables_per_s * table_bytes)

    def _spoken_to(self, now_us: int) -> tuple[int, ...]:
        """The living neighbours, and the boat while it is heard; from the boat, the one drone that it
        hears."""
        boat = self.links.get(BOAT_ID)
        if self.own_id == BOAT_ID:
            heard = [link for link in self.links.values() if link.is_up(now_us)]
            return tuple(link.peer_id for link in heard[:1])
        hears_boat = boat is not None and boat.is_heard(now_us)
        return (*self.members.neighbours(now_us).ids, *((BOAT_ID,) if hears_boat else ()))

    def _called(self, now_us: int) -> list[int]:
        """Whom to call until they answer: the lost; from a boat that hears nobody, everybody."""
        if self.own_id == BOAT_ID:
            return [] if self._spoken_to(now_us) else list(self.links)
        return [peer_id for peer_id in self.members.lost(now_us) if peer_id in self.links]

    def _send_own(self, link: Link, has_table: bool, now_us: int) -> None:
        clock = link.clock_part(self.fleet_clock.offer(now_us), now_us)
        table = self.fleet.pack(link.peer_id, now_us) if has_table else None
        body = datagram.Body(now_us, self.members.ages(now_us), clock, table=table)
        self._send(link, body, LINK_KIND, 0, 0, now_us)

    def _send_message(self, link: Link, message: Message, now_us: int) -> bool:
        part = datagram.MessagePart(channels.CROSSING.index(message.channel), message.data)
        body = datagram.Body(now_us, self.members.ages(now_us), message=part)
        return self._send(link, body, message.channel.name, message.payload_bytes, len(message.data), now_us)

    def _send(
        self, link: Link, body: datagram.Body, kind: str, payload: int, encoded: int, now_us: int
    ) -> bool:
        """Seal and send within the cap; whether there was room. A cap too tight for a table lets the
        link's part through."""
        plain = datagram.pack(body)
        is_message = body.message is not None
        if not link.window.fits(len(plain) + MAX_OVERHEAD_BYTES, is_message, now_us):
            if body.table is None:
                return False
            return self._send(link, datagram.Body(body.stamp_us, body.ages, body.clock), kind, 0, 0, now_us)
        sealed = self.sessions.seal(link.peer_id, plain)
        link.sent_stamps_us.append(body.stamp_us)
        if self._send_to_radio(link.peer_id, sealed):
            link.window.spend(len(sealed), is_message, now_us)
            link.count_sent(kind, payload, encoded, len(sealed))
        else:
            link.n_unsent += 1
        return True

    def _hear(self, link: Link, body: datagram.Body, now_us: int) -> None:
        sent_us = link.sent_here_us(body.stamp_us, now_us)
        fleet_us = self._fleet_us(now_us)
        is_news = body.table is not None and self.fleet.merge(link.peer_id, body.table, sent_us, fleet_us)
        self.members.hear(link.peer_id, sent_us, now_us)
        self.members.merge(body.ages, sent_us, now_us)
        link.hear(body, now_us)
        if body.clock is not None:
            self.fleet_clock.hear(link.peer_id, body.clock.offer, now_us)
        if is_news:
            self._spread(now_us, link.peer_id)

    def _spread(self, now_us: int, source: int | None = None) -> None:
        """Pass on an order or a find at once, but not to the peer that brought it, and at every tick of the
        next second: waiting for a tick at each hop, the far side of a ring would hear it seconds late.
        """
        self._n_news_ticks = NEWS_TICKS
        for peer_id in self._spoken_to(now_us):
            if peer_id != source and peer_id in self.links:
                self._send_own(self.links[peer_id], True, now_us)

    def _accept(self, link: Link, part: datagram.MessagePart, now_us: int) -> Copy | None:
        """A neighbour's message, if its channel may cross, it decodes as that channel's type and it is
        fresh."""
        if link.peer_id not in self.members.neighbours(now_us).ids:
            self._refuse(Refusal.NOT_NEIGHBOUR, link.peer_id)
            return None
        channel = channels.CROSSING[part.channel] if part.channel < len(channels.CROSSING) else None
        message = _decode(channel, part.data) if channel else None
        if channel is None or message is None or message.drone_id != link.peer_id:
            self._refuse(Refusal.BAD_MESSAGE, link.peer_id)
            return None
        offset_us = link.clock.offset_us(now_us)
        age_us = 0 if offset_us is None else now_us - (message.utime - offset_us)
        if abs(age_us) > channel.max_age_s * 1e6:
            self._refuse(Refusal.STALE, link.peer_id)
            return None
        if channel.name == channels.RING_EPISODE:
            self._roll.hear(message)
        elif channel.name in PASSED_ON and self._roll.is_bystander(message):
            self._pass_on(link, channel, message, now_us - age_us, now_us)
        return Copy(link.peer_id, channel, part.data)

    def _pass_on(self, link: Link, channel: Channel, message: Any, said_us: int, now_us: int) -> None:
        """Hand a neighbour's message on to the neighbour on the other side, as this drone's word, by its
        clock."""
        message.drone_id, message.utime = self.own_id, said_us
        handed_on = Message(channel, message.encode(), said_us, len(message.packet))
        for peer_id in self.members.neighbours(now_us).ids:
            if peer_id != link.peer_id:
                self.links[peer_id].queue.offer(handed_on)
        self.pump(now_us)

    def _refuse(self, reason: Refusal, sender: int | None) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1
        if sender in self.links:
            self.links[sender].n_rejected += 1
            self.links[sender].is_knocking |= reason is Refusal.UNPROVEN


def _decode(channel: Channel, data: bytes) -> Any:
    """The message, None where the bytes are not exactly one message of the channel's type."""
    try:
        message = channel.kind.decode(data)
        packet = getattr(message, "packet", b"")
        is_whole = len(packet) == getattr(message, "n_bytes", 0) and message.encode() == data
    except (ValueError, IndexError, struct.error):
        return None
    return message if is_whole else None
