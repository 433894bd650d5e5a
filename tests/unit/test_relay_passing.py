"""Packets of an episode cross the drones that have no part in it."""

from collections import Counter

import pytest

from lcmtypes import channels, make
from lcmtypes.podwatch import episode_t, ring_assign_t, ring_map_t
from procs.relay.passing import KEPT, EpisodeRoll
from procs.relay.seal import Refusal
from tests.unit.relay_fleet import EPISODE, MAP, Fleet

ASSIGN = channels.BY_NAME[channels.RING_ASSIGN]


def bitmap(*members: int) -> int:
    return sum(1 << member - 1 for member in members)


def flown(
    n: int, members: tuple[int, ...], seconds: int = 3, speakers: tuple[int, ...] | None = None
) -> Fleet:
    """A ring of n that all know episode 7 of `members`; each of `speakers` says two packets a second."""
    fleet = Fleet(n)
    fleet.run(3)
    for drone in fleet.living:
        drone.say(EPISODE, make(episode_t, number=7, proposer=1, members=bitmap(*members)))

    def speak() -> None:
        for drone_id in members if speakers is None else speakers:
            packet = bytes([drone_id])
            fleet[drone_id].say(MAP, make(ring_map_t, episode=7, proposer=1, n_bytes=1, packet=packet))
            fleet[drone_id].say(ASSIGN, make(ring_assign_t, episode=7, proposer=1, n_bytes=1, packet=packet))

    fleet.run(seconds, speak)
    fleet.run(1)
    return fleet


def heard(fleet: Fleet, drone_id: int) -> dict[str, set[int]]:
    """Channel -> whose packets a drone heard."""
    copies = [copy for copy in fleet[drone_id].copies if copy.channel in (MAP, ASSIGN)]
    found: dict[str, set[int]] = {MAP.name: set(), ASSIGN.name: set()}
    for copy in copies:
        found[copy.channel.name].add(copy.channel.kind.decode(copy.data).packet[0])
    return found


@pytest.mark.parametrize(
    ("n", "members", "neighbours"),
    [
        (5, (1, 3, 5), {1: {3, 5}, 3: {1, 5}, 5: {1, 3}}),  # 2 and 4 on the ground cut 3 off on both sides
        (4, (1, 3), {1: {3}, 3: {1}}),
        (7, (1, 5), {1: {5}, 5: {1}}),  # three bystanders in a row
    ],
)
def test_members_hear_the_next_member_across_those_that_have_no_part(n, members, neighbours):
    fleet = flown(n, members)
    for drone_id, wanted in neighbours.items():
        assert heard(fleet, drone_id) == {MAP.name: wanted, ASSIGN.name: wanted}
    assert not any(drone.core.refused.get(Refusal.BAD_MESSAGE) for drone in fleet.living)


def test_what_is_handed_on_is_each_time_the_carriers_word_by_its_clock():
    fleet = flown(5, (1, 3, 5))
    for copy in fleet[1].copies:
        message = copy.channel.kind.decode(copy.data)
        assert message.drone_id == copy.sender
        if copy.channel == MAP and copy.sender == 2:
            assert message.packet == bytes([3])
            assert abs(message.utime - (fleet[2].now_us - 4_000_000)) < 4_000_000


def test_a_packet_crosses_each_link_once_and_ends_at_the_next_member():
    fleet = flown(5, (1, 3, 5), speakers=(3,))
    count = Counter(
        (drone.id, copy.sender) for drone in fleet.living for copy in drone.copies if copy.channel == MAP
    )
    assert count == {(2, 3): 3, (4, 3): 3, (1, 2): 3, (5, 4): 3}


def test_one_member_alone_among_bystanders_floods_nobody():
    fleet = flown(4, (1,), speakers=(1,))
    count = Counter(
        (drone.id, copy.sender) for drone in fleet.living for copy in drone.copies if copy.channel == MAP
    )
    assert max(count.values()) == 3


def test_who_knows_nothing_of_an_episode_passes_nothing_on():
    roll = EpisodeRoll(1)
    about = make(ring_map_t, episode=7, proposer=1)
    assert not roll.is_bystander(about)
    roll.hear(make(episode_t, number=7, proposer=1, members=bitmap(1, 2)))
    assert not roll.is_bystander(about), "a member answers for itself"
    roll.hear(make(episode_t, number=7, proposer=3, members=bitmap(1, 3)))
    assert roll.is_bystander(make(ring_map_t, episode=7, proposer=3))


def test_old_episodes_are_forgotten():
    roll = EpisodeRoll(1)
    for number in range(1, KEPT + 2):
        roll.hear(make(episode_t, number=number, proposer=1, members=bitmap(1)))
    assert not roll.is_bystander(make(ring_map_t, episode=1, proposer=1))
    assert roll.is_bystander(make(ring_map_t, episode=KEPT + 1, proposer=1))
