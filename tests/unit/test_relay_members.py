"""Who lives, and who is next to whom."""

import pytest
from hypothesis import given
from hypothesis import settings as cases
from hypothesis import strategies as st

from procs.relay.members import Members, Neighbours, age_byte

S = 1_000_000
START_GRACE_S = 3.5  # five drones: word of the farthest needs two hops


def members_of(own_id: int, n: int = 5) -> Members:
    return Members(own_id, tuple(range(1, n + 1)), lost_after_s=3.0, now_us=0)


def only_alive(own_id: int, alive: tuple[int, ...], n: int = 5) -> tuple[Members, int]:
    """A drone that has heard `alive` of late and nobody else for long."""
    members, now_us = members_of(own_id, n), 60 * S
    for member in alive:
        members.hear(member, now_us, now_us)
    return members, now_us


@pytest.mark.parametrize(
    ("own_id", "alive", "neighbours"),
    [
        (1, (2, 3, 4, 5), Neighbours(5, 2)),
        (3, (1, 2, 4, 5), Neighbours(2, 4)),
        (5, (1, 2, 3, 4), Neighbours(4, 1)),
        (1, (3, 4, 5), Neighbours(5, 3)),  # the ring closes over the lost 2
        (1, (4,), Neighbours(4, 4)),  # a pair: the one neighbour fills both sides
        (1, (), Neighbours(0, 0)),  # alone
    ],
)
def test_the_ring_closes_over_the_lost(own_id: int, alive: tuple[int, ...], neighbours: Neighbours) -> None:
    members, now_us = only_alive(own_id, alive)
    assert members.neighbours(now_us) == neighbours
    assert members.living(now_us) == tuple(sorted((own_id, *alive)))
    assert members.bitmap(now_us) == sum(1 << (member - 1) for member in (own_id, *alive))
    assert neighbours.ids == tuple(dict.fromkeys(x for x in (neighbours.left, neighbours.right) if x))


def test_all_are_taken_to_live_at_first_but_not_for_long() -> None:
    members = members_of(2)
    assert members.living(0) == (1, 2, 3, 4, 5)
    assert members.living(round(START_GRACE_S * S)) == (1, 2, 3, 4, 5)
    assert members.living(round(START_GRACE_S * S) + 1) == (2,)
    assert members.ages(10) == bytes([255, 255, 0, 255, 255, 255])


def test_a_member_lives_while_any_path_brings_newer_word_of_it() -> None:
    members, now_us = only_alive(1, (2, 3))
    for _ in range(20):  # drone 3 is heard no more, but drone 2 hears it
        now_us += S // 2
        members.hear(2, now_us, now_us)
        members.merge(bytes([255, 8, 0, 4, 255, 255]), now_us, now_us)
    assert members.lives(3, now_us)
    for k in range(1, 9):  # now drone 2's word of it only grows older
        now_us += S // 2
        members.hear(2, now_us, now_us)
        members.merge(bytes([255, 8, 0, 4 + 10 * k, 255, 255]), now_us, now_us)
        assert members.lives(3, now_us) is (k <= 6)
    assert members.lives(2, now_us)


def test_old_word_of_a_far_member_that_keeps_coming_is_life() -> None:
    """In a ring of 50 the word of the member opposite is always 5 s old."""
    members, now_us = only_alive(1, (2,), n=50)
    ages = [255] * 51
    ages[25] = 100
    for _ in range(10):
        now_us += S
        members.merge(bytes(ages), now_us, now_us)
        assert members.lives(25, now_us)


@cases(deadline=None, max_examples=50)
@given(
    latency_us=st.integers(0, 400_000),
    clock_error_us=st.integers(-3_000, 3_000),
    period_us=st.integers(30_000, 400_000),
)
def test_two_drones_never_keep_a_dead_one_alive_between_them(
    latency_us: int, clock_error_us: int, period_us: int
) -> None:
    one, two = members_of(1, 3), members_of(2, 3)
    one.hear(3, 0, 0)
    for k in range(12 * S // period_us):
        now_us = k * period_us
        # Either knows when the other sent, but for an error of its clock that is opposite at the two ends.
        two.merge(one.ages(now_us), now_us + clock_error_us, now_us + latency_us)
        one.merge(two.ages(now_us), now_us - clock_error_us, now_us + latency_us)
    assert not one.lives(3, 12 * S)
    assert not two.lives(3, 12 * S)


@cases(deadline=None, max_examples=50)
@given(age_us=st.integers(0, 60 * S))
def test_an_age_never_travels_as_younger_than_it_is(age_us: int) -> None:
    assert age_byte(age_us) == 255 or 0 <= age_byte(age_us) * 50_000 - age_us < 50_000


def test_a_roster_without_oneself_is_refused() -> None:
    with pytest.raises(ValueError, match="must hold drone 7"):
        members_of(7)
