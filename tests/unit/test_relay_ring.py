"""Relays of a whole fleet in memory: losses, deaths, cuts, partitions, wrong clocks, bad datagrams."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.radios.memory import MemoryEther, MemoryRadio
from lcmtypes import channels, make
from lcmtypes.podwatch import (
    episode_t,
    fleet_state_t,
    link_t,
    mission_state_t,
    operator_t,
    ring_map_t,
    vehicle_state_t,
)
from procs.queue_executor import ClockError, EventQueue
from procs.relay import datagram
from procs.relay.datagram import Body, MessagePart
from procs.relay.fleet import Order
from procs.relay.relay import TICK_S, Copy, Relay
from procs.relay.seal import Refusal, Sessions

KEY = bytes(range(32))
S = 1_000_000
MAP = channels.BY_NAME[channels.RING_MAP]
EPISODE = channels.BY_NAME[channels.RING_EPISODE]


class Drone:
    """One relay, its clock, its radio and what its navigator and autopilot say."""

    def __init__(self, fleet: "Fleet", drone_id: int, clock: ClockError) -> None:
        self.fleet, self.id, self.clock = fleet, drone_id, clock
        self.mission = make(mission_state_t, state=2, animal=-1)
        self.vehicle = make(vehicle_state_t, n_m=10.0 * drone_id, battery=0.5, position_ok=True)
        self.copies: list[Copy] = []
        self.alive = False
        self.start()

    @property
    def now_us(self) -> int:
        return self.clock.utime(self.fleet.queue.now_us)

    def start(self) -> None:
        """A relay that has just started, with nothing remembered."""
        self.radio: MemoryRadio = self.fleet.ether.radio(self.id, self.fleet.ids)
        self.core = Relay(
            own_id=self.id,
            roster=self.fleet.roster,
            fleet_key=KEY,
            session=self.radio.session_id(),
            send=self.radio.send,
            reachable=self.fleet.ids,
            bytes_per_s=self.fleet.bytes_per_s,
            lost_after_s=3.0,
            now_us=self.now_us,
        )
        self.radio.on_arrival(self._arrived)
        self.alive = True
        self.fleet.after(TICK_S * self.fleet.random.random(), lambda core=self.core: self._tick(core))

    def die(self) -> None:
        self.alive = False
        self.radio.close()

    def say(self, channel: channels.Channel, message: Any) -> None:
        message.utime, message.drone_id = self.now_us, self.id
        payload = len(getattr(message, "packet", b""))
        self.core.say(channel, message.encode(), message.utime, payload, self.now_us)

    @property
    def state(self) -> fleet_state_t:
        return self.core.fleet_state(self.now_us)

    @property
    def fleet_us(self) -> int:
        return self.now_us + int(self.state.fleet_offset_us)

    def row(self, drone_id: int) -> Any:
        return next(row for row in self.state.rows if row.id == drone_id)

    def _arrived(self) -> None:
        for data in self.radio.receive():
            copy = self.core.receive(data, self.now_us)
            if copy is not None:
                self.copies.append(copy)

    def _tick(self, core: Relay) -> None:
        if self.alive and core is self.core:
            if self.id:
                self.vehicle.utime = self.now_us
                self.core.describe(self.mission, self.vehicle, self.now_us)
            self.core.tick(self.now_us)
            self.core.pump(self.now_us)
            self.fleet.after(TICK_S, lambda: self._tick(core))


class Fleet:
    """Drones with clocks that are off by up to 2 s and drift by up to 50 ppm, on one ether."""

    def __init__(
        self,
        n: int,
        loss: float = 0.0,
        seed: int = 1,
        boat: bool = False,
        bytes_per_s: int = 6000,
        jitter_s: float = 0.005,
    ) -> None:
        self.queue, self.random, self.bytes_per_s = EventQueue(), np.random.default_rng(seed), bytes_per_s
        self.roster = tuple(range(1, n + 1))
        self.ids = (0, *self.roster) if boat else self.roster
        self.ether = MemoryEther(self.random, self.after, latency_s=0.005, jitter_s=jitter_s, loss=loss)
        self.drones: dict[int, Drone] = {}
        for drone_id in self.ids:
            offset_us = 500 * S + int(self.random.uniform(-2, 2) * S)
            clock = ClockError(offset_us, self.random.uniform(-50, 50))
            self.drones[drone_id] = Drone(self, drone_id, clock)

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        self.queue.schedule(self.queue.now_us + round(delay_s * S), action)

    def run(self, seconds: float, each_s: Callable[[], None] | None = None) -> None:
        """Let time pass; `each_s` is called once a second."""
        end_us = self.queue.now_us + round(seconds * S)
        while self.queue.now_us < end_us:
            self.queue.run_until(min(end_us, self.queue.now_us + S))
            if each_s is not None:
                each_s()

    def cut(self, *pairs: tuple[int, int]) -> None:
        """Block these links both ways, and no others."""
        self.ether.blocked = lambda a, b: (a, b) in pairs or (b, a) in pairs

    def __getitem__(self, drone_id: int) -> Drone:
        return self.drones[drone_id]

    @property
    def living(self) -> list[Drone]:
        return [drone for drone in self.drones.values() if drone.alive and drone.id]

    def members(self) -> list[int]:
        return [drone.state.members for drone in self.living]

    def clock_spread_us(self) -> int:
        times = [drone.fleet_us for drone in self.living]
        return max(times) - min(times)


def link(drone: Drone, peer_id: int) -> link_t:
    return next(entry for entry in drone.core.link_state(drone.now_us).links if entry.peer_id == peer_id)


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
    fleet.run(9)
    assert [drone.state.order.command for drone in fleet.living] == [operator_t.NONE] * 4
    assert fleet.members() == [0b1111] * 4


def test_a_flood_stays_under_the_cap_and_episodes_go_first() -> None:
    fleet = Fleet(3, bytes_per_s=3000)
    fleet.run(5)
    sent: list[tuple[int, int, int]] = []
    send = fleet[1].radio.send

    def counted(peer_id: int, data: bytes) -> bool:
        sent.append((fleet.queue.now_us, peer_id, len(data)))
        return send(peer_id, data)

    fleet[1].core._send_to_radio = counted
    link_before = link(fleet[1], 2)
    for _ in range(100):
        fleet[1].say(MAP, make(ring_map_t, n_bytes=308, packet=bytes(308)))
        fleet[1].say(EPISODE, make(episode_t))
        fleet.run(0.05)
    for end_us in range(sent[0][0], sent[-1][0], 100_000):
        for peer_id in (2, 3):
            size = sum(n for at_us, to, n in sent if to == peer_id and end_us - S < at_us <= end_us)
            assert size <= 3000
    n_maps = sum(copy.channel is MAP for copy in fleet[2].copies)
    n_episodes = sum(copy.channel is EPISODE for copy in fleet[2].copies)
    assert n_maps < n_episodes
    assert fleet.members() == [0b111] * 3
    assert all(drone.state.fleet_time_ok for drone in fleet.living)
    link_after = link(fleet[1], 2)
    assert link_after.n_dropped - link_before.n_dropped >= 200 - n_maps - n_episodes - 2


@pytest.mark.parametrize("n", [3, 20, 50])
def test_twenty_animals_and_a_state_fit_the_paper_and_the_datagram(n: int) -> None:
    fleet = Fleet(n)
    fleet.run(1.5)
    fleet[1].say(MAP, make(ring_map_t, n_bytes=308, packet=bytes(308)))
    report = link(fleet[1], 2)
    place = list(report.kinds).index(channels.RING_MAP)
    assert report.max_payload[place] == 308
    assert report.max_encoded[place] <= 400
    assert report.max_datagram[place] <= 500
    assert max(report.max_datagram) <= 500


def forged(fleet: Fleet, sender: int, body: Body) -> None:
    """Let `sender`'s own relay say something that its core never would."""
    peer = fleet[1]
    sealed = fleet[sender].core.sessions.seal(1, datagram.pack(body))
    peer.radio.arrive(sealed)


def part(message: Any, channel: int = 1, cut: int = 0) -> MessagePart:
    data = message.encode()
    return MessagePart(channel, data[: len(data) - cut])


def test_messages_that_may_not_cross_or_do_not_decode_or_are_old_are_refused() -> None:
    fleet = Fleet(5)
    fleet.run(4)
    peer, now_us = fleet[1], fleet[2].now_us
    ages = fleet[2].core.members.ages(now_us)
    good = make(ring_map_t, utime=now_us, drone_id=2, n_bytes=2, packet=b"ab")
    cases = [
        (2, part(good, channel=77), Refusal.BAD_MESSAGE),
        (2, part(good, channel=0), Refusal.BAD_MESSAGE),
        (2, part(good, cut=1), Refusal.BAD_MESSAGE),
        (2, MessagePart(1, good.encode() + b"more"), Refusal.BAD_MESSAGE),
        (2, MessagePart(1, b""), Refusal.BAD_MESSAGE),
        (2, part(make(ring_map_t, utime=now_us, drone_id=3)), Refusal.BAD_MESSAGE),
        (2, part(make(ring_map_t, utime=now_us - 1_100_000, drone_id=2)), Refusal.STALE),
        (2, part(make(ring_map_t, utime=now_us + 1_100_000, drone_id=2)), Refusal.STALE),
    ]
    for sender, message, reason in cases:
        before = peer.core.refused.get(reason, 0)
        forged(fleet, sender, Body(fleet[sender].now_us, ages, message=message))
        assert peer.core.refused.get(reason, 0) == before + 1, message
    assert peer.copies == []
    forged(fleet, 2, Body(now_us, ages, message=part(good)))
    assert [copy.data for copy in peer.copies] == [good.encode()]
    assert link(peer, 2).n_rejected >= len(cases)


def test_a_message_from_a_drone_that_is_no_neighbour_is_refused() -> None:
    fleet = Fleet(5)
    fleet.run(4)
    for _ in range(3):  # drones 1 and 3 greet each other, as after a partition
        fleet[3].core._send_own(fleet[3].core.links[1], False, fleet[3].now_us)
        fleet[1].core._send_own(fleet[1].core.links[3], False, fleet[1].now_us)
        fleet.run(0.1)
    message = part(make(ring_map_t, utime=fleet[3].now_us, drone_id=3))
    forged(fleet, 3, Body(fleet[3].now_us, fleet[3].core.members.ages(fleet[3].now_us), message=message))
    assert fleet[1].core.refused[Refusal.NOT_NEIGHBOUR] == 1
    assert fleet[1].copies == []


def test_a_datagram_that_was_held_back_is_refused() -> None:
    fleet = Fleet(3)
    fleet.run(4)
    body = Body(fleet[2].now_us, fleet[2].core.members.ages(fleet[2].now_us))
    sealed = fleet[2].core.sessions.seal(1, datagram.pack(body))
    fleet.run(2.5)
    fleet[1].core.receive(sealed, fleet[1].now_us)
    assert fleet[1].core.refused[Refusal.LATE] == 1


def test_recorded_datagrams_change_nothing_after_both_ends_restarted() -> None:
    fleet = Fleet(2)
    recorded: list[bytes] = []
    carry = fleet.ether.carry

    def tapped(sender: int, receiver: int, data: bytes) -> None:
        if sender == 2:
            recorded.append(data)
        carry(sender, receiver, data)

    fleet.ether.carry = tapped  # type: ignore[method-assign]
    fleet.run(20)
    fleet.ether.carry = carry  # type: ignore[method-assign]
    fleet[2].die()
    fleet[1].start()
    for data in recorded:
        fleet[1].radio.arrive(data)
        fleet.run(0.1)
    assert fleet[1].core.refused == {Refusal.UNPROVEN: len(recorded)}
    assert fleet[1].state.members == 0b01
    assert len(fleet[1].state.rows) == 1
    fleet[2].start()
    fleet.run(4)
    assert fleet.members() == [0b11, 0b11]
    unproven = fleet[1].core.refused[Refusal.UNPROVEN]
    for data in recorded:
        fleet[1].radio.arrive(data)
    assert fleet[1].core.refused[Refusal.UNPROVEN] == unproven + len(recorded)
    assert link(fleet[1], 2).n_rejected == unproven + len(recorded)


def test_strangers_and_altered_datagrams_are_counted() -> None:
    fleet = Fleet(2)
    fleet.run(3)
    stranger = Sessions(bytes(32), 2, 5, fleet.roster)
    fleet[1].radio.arrive(stranger.seal(1, b"I am drone 2"))
    fleet[1].radio.arrive(b"noise")
    good = fleet[2].core.sessions.seal(1, datagram.pack(Body(fleet[2].now_us, bytes(3))))
    fleet[1].radio.arrive(good[:-1] + bytes([good[-1] ^ 1]))
    fleet[1].radio.arrive(good)
    fleet[1].radio.arrive(good)
    refused = fleet[1].core.refused
    assert (refused[Refusal.STRANGER], refused[Refusal.ALTERED], refused[Refusal.REPLAYED]) == (2, 1, 1)
    malformed = fleet[2].core.sessions.seal(1, b"no body")
    fleet[1].radio.arrive(malformed)
    assert refused[Refusal.MALFORMED] == 1


def test_what_may_not_be_said_is_refused_at_the_sender() -> None:
    fleet = Fleet(2)
    with pytest.raises(ValueError, match="TRACK may not cross"):
        fleet[1].core.say(channels.BY_NAME[channels.TRACK], b"", 0, 0, fleet[1].now_us)
    with pytest.raises(ValueError, match="at most 400"):
        fleet[1].core.say(MAP, bytes(401), 0, 0, fleet[1].now_us)
    with pytest.raises(ValueError, match=r"no address for drones \[3\]"):
        Relay(1, (1, 2, 3), KEY, 0, lambda *_: True, (1, 2), 6000, 3.0, 0)


def test_the_same_seed_gives_the_same_datagrams() -> None:
    def traffic(seed: int) -> list[bytes]:
        fleet, sent = Fleet(3, loss=0.2, seed=seed), []
        carry = fleet.ether.carry
        fleet.ether.carry = lambda a, b, data: (sent.append(data), carry(a, b, data))  # type: ignore
        fleet.run(5)
        return sent

    assert traffic(4) == traffic(4)
    assert traffic(4) != traffic(5)
