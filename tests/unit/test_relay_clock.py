"""Clock offsets of links, and one fleet time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as cases
from hypothesis import strategies as st

from procs.relay.clock_sync import NO_REFERENCE, FleetClock, FleetOffer, LinkClock

S = 1_000_000


def exchange(link: LinkClock, offset_us: int, there_us: int, back_us: int, sent_us: int) -> int:
    """One exchange with a peer whose clock is `offset_us` ahead; when the answer came."""
    held_us = 1_000
    peer_received_us = sent_us + there_us + offset_us
    received_us = sent_us + there_us + held_us + back_us
    link.add(sent_us, peer_received_us, peer_received_us + held_us, received_us)
    return received_us


@cases(deadline=None, max_examples=100)
@given(
    offset_us=st.integers(-(10**15), 10**15),
    there_us=st.integers(0, 50_000),
    back_us=st.integers(0, 50_000),
)
def test_an_offset_is_wrong_by_half_the_asymmetry(offset_us: int, there_us: int, back_us: int) -> None:
    link = LinkClock()
    now_us = exchange(link, offset_us, there_us, back_us, 0)
    assert link.round_trip_us(now_us) == there_us + back_us
    assert abs(link.offset_us(now_us) - offset_us - (there_us - back_us) / 2) <= 1


def test_the_exchange_with_the_least_round_trip_counts() -> None:
    link, now_us = LinkClock(), 0
    for there_us, back_us in ((90_000, 5_000), (5_000, 5_000), (5_000, 200_000)):
        now_us = exchange(link, 1_234_567, there_us, back_us, now_us + S // 4)
    assert link.offset_us(now_us) == 1_234_567
    assert link.offset_us(now_us + 9 * S) is None
    assert not link.is_settled


def test_an_exchange_across_a_clock_that_was_set_back_is_left_out() -> None:
    link = LinkClock()
    link.add(sent_us=5 * S, peer_received_us=0, peer_sent_us=1, received_us=4 * S)
    assert link.offset_us(4 * S) is None


class Fleet:
    """Fleet clocks on a ring whose links are measured exactly; drone k's clock is k seconds ahead."""

    def __init__(self, ids: tuple[int, ...]) -> None:
        self.ids, self.true_us = ids, 100 * S
        self.clocks = {drone_id: FleetClock(drone_id, 5, self.now_us(drone_id)) for drone_id in ids}

    def now_us(self, drone_id: int) -> int:
        return self.true_us + drone_id * S

    def run(self, seconds: int, living: tuple[int, ...]) -> None:
        for _ in range(seconds * 4):
            self.true_us += S // 4
            offers = {drone_id: self.clocks[drone_id].offer(self.now_us(drone_id)) for drone_id in living}
            for place, drone_id in enumerate(living):
                now_us, links = self.now_us(drone_id), {}
                for peer_id in (living[place - 1], living[(place + 1) % len(living)]):
                    links[peer_id] = LinkClock()
                    for k in range(4):
                        exchange(links[peer_id], (peer_id - drone_id) * S, 0, 0, now_us - 1_000 - k)
                    self.clocks[drone_id].hear(peer_id, offers[peer_id], now_us)
                # Peers heard once have links still; what they said grows old.
                for peer_id in self.ids:
                    links.setdefault(peer_id, LinkClock())
                self.clocks[drone_id].update(living, links, now_us)

    def fleet_us(self, drone_id: int) -> int:
        clock = self.clocks[drone_id]
        assert clock.is_ok(self.now_us(drone_id))
        return self.now_us(drone_id) + round(clock.offset_us)


def test_all_share_the_clock_of_the_lowest() -> None:
    fleet = Fleet((1, 2, 3, 4, 5))
    fleet.run(1, fleet.ids)
    assert not any(clock.is_ok(fleet.now_us(drone_id)) for drone_id, clock in fleet.clocks.items())
    fleet.run(4, fleet.ids)
    assert [fleet.fleet_us(drone_id) for drone_id in fleet.ids] == [fleet.now_us(1)] * 5
    assert [fleet.clocks[drone_id].hops for drone_id in fleet.ids] == [0, 1, 2, 2, 1]


def test_fleet_time_goes_on_when_its_reference_dies_and_when_it_comes_back() -> None:
    fleet = Fleet((1, 2, 3, 4, 5))
    fleet.run(5, fleet.ids)
    definition_us = fleet.fleet_us(3) - fleet.true_us
    fleet.run(5, (2, 3, 4, 5))
    assert {clock.reference for drone_id, clock in fleet.clocks.items() if drone_id > 1} == {2}
    assert [fleet.fleet_us(drone_id) - fleet.true_us for drone_id in (2, 3, 4, 5)] == [definition_us] * 4

    fleet.clocks[1] = FleetClock(1, 5, fleet.now_us(1))  # restarted: it knows nothing
    fleet.run(1, fleet.ids)
    assert fleet.fleet_us(1) - fleet.true_us == definition_us  # it asks instead of saying
    fleet.run(5, fleet.ids)
    assert {clock.reference for clock in fleet.clocks.values()} == {1}
    assert [fleet.fleet_us(drone_id) - fleet.true_us for drone_id in fleet.ids] == [definition_us] * 5


def test_a_reference_that_restarts_unnoticed_keeps_its_own_word() -> None:
    fleet = Fleet((1, 2, 3))
    fleet.run(5, fleet.ids)
    fleet.clocks[2].offset_us += 7_000_000  # whatever fleet time is, it is the fleet's
    fleet.clocks[3].offset_us += 7_000_000
    fleet.clocks[1] = FleetClock(1, 5, fleet.now_us(1))
    fleet.run(5, fleet.ids)
    assert [fleet.fleet_us(drone_id) - fleet.now_us(1) for drone_id in fleet.ids] == [7_000_000] * 3


def test_alone_the_own_clock_is_fleet_time_after_listening() -> None:
    clock = FleetClock(4, 5, 0)
    clock.update((4,), {}, S)
    assert not clock.is_ok(S)
    assert clock.offer(S).reference == NO_REFERENCE
    clock.update((4,), {}, 3 * S)
    assert clock.is_ok(3 * S)
    assert (clock.offset_us, clock.reference) == (0, 4)


def test_without_word_fleet_time_ends() -> None:
    fleet = Fleet((1, 2))
    fleet.run(5, fleet.ids)
    clock, now_us = fleet.clocks[2], fleet.now_us(2)
    clock.update((1, 2), {1: LinkClock()}, now_us + 50 * S)
    assert clock.is_ok(now_us + 50 * S)
    clock.update((1, 2), {1: LinkClock()}, now_us + 61 * S)
    assert not clock.is_ok(now_us + 61 * S)


def test_noise_is_smoothed_and_a_step_is_taken() -> None:
    random, clock, link = np.random.default_rng(1), FleetClock(2, 5, 0), LinkClock()
    said = []
    for k in range(1, 41):
        now_us = exchange(link, 500_000, 0, 0, k * S // 4)
        clock.hear(1, FleetOffer(int(random.normal(0, 2_000)), 1, 0), now_us)
        clock.update((1, 2), {1: link}, now_us)
        if link.is_settled and k > 10:
            said.append(clock.offset_us)
    assert np.std(said) < 1_200
    clock.hear(1, FleetOffer(3 * S, 1, 0), now_us)
    clock.update((1, 2), {1: link}, now_us)
    assert clock.offset_us == pytest.approx(3_500_000, abs=10)
