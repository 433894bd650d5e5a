"""What a relay refuses to believe or to send, and what it counts."""

from typing import Any

import pytest

from lcmtypes import channels, make
from lcmtypes.podwatch import episode_t, ring_map_t
from procs.relay import datagram
from procs.relay.datagram import Body, MessagePart
from procs.relay.relay import Relay
from procs.relay.seal import Refusal, Sessions
from tests.unit.relay_fleet import EPISODE, KEY, MAP, Fleet, S, link


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
