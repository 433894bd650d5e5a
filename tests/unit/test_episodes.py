"""Proposals of episodes: whoever hears them, in whatever order, ends with the same one."""

from itertools import permutations

from hypothesis import given, settings
from hypothesis import strategies as st

from lcmtypes import make
from lcmtypes.podwatch import episode_t
from procs.registrar.episodes import (
    LEAD_US,
    LISTEN_FIRST_US,
    REPEAT_AFTER_T_US,
    EpisodeBook,
    from_bitmap,
    to_bitmap,
)

ROSTER = (2, 5, 9)
S = 1_000_000


def proposal(
    number: int, proposer: int, members: tuple[int, ...] = ROSTER, t_utime: int = 50 * S
) -> episode_t:
    bitmap = to_bitmap(members, ROSTER)
    return make(episode_t, number=number, proposer=proposer, members=bitmap, t_utime=t_utime)


def book(drone_id: int = 2, began_utime: int = 0) -> EpisodeBook:
    return EpisodeBook(drone_id, ROSTER, began_utime)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 4), st.sampled_from(ROSTER)), min_size=1, max_size=4, unique=True))
def test_the_larger_number_and_then_the_larger_proposer_wins_in_any_order_of_arrival(keys):
    for order in permutations(keys):
        one = book()
        took = [one.heard(proposal(*key)) for key in order]
        assert one.newest is not None
        assert one.newest.key == max(keys)
        # It took over exactly those that were larger than all before.
        assert took == [key == max(order[: index + 1]) for index, key in enumerate(order)]


def test_a_proposal_is_repeated_until_long_after_its_instant_and_says_it_all_each_time():
    one = book()
    proposed = one.propose(ROSTER, 10 * S, 110 * S)
    assert proposed is not None
    assert (proposed.number, proposed.proposer, proposed.t_utime) == (1, 2, 110 * S + LEAD_US)
    other = book(9)
    for fleet_utime in (110 * S, proposed.t_utime + REPEAT_AFTER_T_US):
        said = one.saying(fleet_utime)
        assert said is not None
        other.heard(said)
        assert other.newest == proposed
    assert one.saying(proposed.t_utime + REPEAT_AFTER_T_US + 1) is None


def test_the_next_number_is_the_highest_heard_plus_one():
    one = book()
    one.heard(proposal(7, 9))
    proposed = one.propose((2, 5), 10 * S, 110 * S)
    assert proposed is not None
    assert (proposed.number, proposed.proposer, proposed.members) == (8, 2, (2, 5))


def test_a_restarted_drone_listens_for_two_seconds_before_it_proposes():
    one = book(began_utime=100 * S)
    assert one.propose(ROSTER, 100 * S + LISTEN_FIRST_US - 1, 0) is None
    assert one.propose(ROSTER, 100 * S + LISTEN_FIRST_US, 0) is not None


def test_a_drone_proposes_no_episode_without_itself():
    assert book(2).propose((5, 9), 10 * S, 0) is None


def test_members_never_change_within_a_number():
    one = book()
    one.heard(proposal(3, 9, (2, 9)))
    assert not one.heard(proposal(3, 9, (2, 5, 9)))
    assert one.newest is not None
    assert one.newest.members == (2, 9)


def test_a_proposal_of_strangers_or_of_a_proposer_who_takes_no_part_is_refused():
    one = book()
    assert not one.heard(make(episode_t, number=3, proposer=9, members=0))
    assert not one.heard(make(episode_t, number=3, proposer=9, members=0b1111))
    assert not one.heard(proposal(3, 9, (2, 5)))
    assert one.newest is None


def test_who_says_an_old_number_is_told_the_newest_even_long_after():
    """A restarted drone that counts from 1 again while the fleet, at 6, has stopped repeating it."""
    others, restarted = book(9), book(2)
    others.heard(proposal(6, 9, t_utime=50 * S))
    later = 50 * S + 10 * REPEAT_AFTER_T_US
    assert others.saying(later) is None
    mine = restarted.propose(ROSTER, 10 * S, later)
    assert mine is not None
    said = restarted.saying(later)
    assert said is not None
    assert not others.heard(said)
    answer = others.saying(later)
    assert answer is not None
    assert others.saying(later) is None, "told once for each time that it was contradicted"
    assert restarted.heard(answer)
    again = restarted.propose(ROSTER, 20 * S, later)
    assert again is not None
    assert others.heard(restarted.saying(later))
    assert others.newest == again


@given(st.sets(st.sampled_from(ROSTER)))
def test_members_travel_as_a_bitmap_by_roster_index(members):
    ordered = tuple(sorted(members))
    assert from_bitmap(to_bitmap(ordered, ROSTER), ROSTER) == ordered
