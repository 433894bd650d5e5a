"""The exchange round the ring: the wire format, agreement under loss, and never two drones on one animal."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from procs.assigner.gossip import Agent
from procs.assigner.packets import MAX_PACKET_BYTES, Packet, Row, decode, encode
from tests.unit.assigner_talk import ring_of, talk

IDS = st.integers(0, 254)
quick = settings(deadline=None, max_examples=60)


@st.composite
def rows(draw: st.DrawFn) -> Row:
    ids = draw(st.lists(IDS, max_size=12, unique=True))
    codes = draw(st.lists(st.integers(0, 0xFFFF), min_size=len(ids), max_size=len(ids)))
    return Row(tuple(ids), tuple(codes), draw(st.sampled_from([-1, 0, 254])), draw(st.booleans()))


@st.composite
def packets(draw: st.DrawFn) -> Packet:
    n = draw(st.integers(1, 99))
    members = st.integers(0, n - 1)
    return Packet(
        draw(members),
        n,
        draw(st.frozensets(members)),
        draw(st.dictionaries(members, st.integers(-1, 254))),
        draw(st.frozensets(members)),
        draw(st.frozensets(members)),
        draw(st.dictionaries(members, rows(), max_size=3)),
        tuple(draw(st.lists(st.tuples(members, IDS, st.binary(max_size=20)), max_size=3))),
    )


@quick
@given(packets())
def test_a_packet_comes_back_from_its_bytes(packet: Packet) -> None:
    assert decode(encode(packet)) == packet


@settings(deadline=None, max_examples=200)
@given(st.binary(max_size=120), st.integers(1, 5))
def test_any_bytes_are_a_packet_or_refused(data: bytes, n: int) -> None:
    for guess in (data, bytes([2, 0, n]) + data):
        try:
            packet = decode(guess)
        except ValueError:
            continue
        assert packet.sender < packet.n_members


def test_bad_packets_say_what_is_wrong() -> None:
    good = encode(Packet(0, 2, frozenset({0}), {0: 7}, frozenset(), frozenset(), {0: Row((7,), (99,))}))
    for bad, words in (
        (good[:-1], "ends inside a row's costs"),
        (good[:2], "ends inside the header"),
        (bytes([9]) + good[1:], "version 9"),
        (bytes([2, 5]) + good[2:], "sender 5"),
        (good[:3] + bytes([255]) + good[4:], "beyond the 2"),
    ):
        with pytest.raises(ValueError, match=words):
            decode(bad)
    agent = Agent(1, 2, [1.0], [7])
    agent.step([good[:-1], b"", encode(Packet(0, 3, frozenset(), {}, frozenset(), frozenset(), {}))], 0.0)
    assert agent.n_bad == 3
    assert agent.choice is None


def fleet_of(
    costs: np.ndarray, ids: list[int], previous: list[int] | None = None, listed: int | None = None
) -> list[Agent]:
    before = previous or [-1] * len(costs)
    return [Agent(k, len(costs), row, ids, previous=before[k], listed=listed) for k, row in enumerate(costs)]


@pytest.mark.parametrize("n", [1, 2, 3, 5, 10])
def test_a_ring_agrees_on_the_cheapest_distinct_choice(n: int) -> None:
    random = np.random.default_rng(n)
    costs = random.uniform(0, 60, (n, n + 2))
    ids = [int(animal) for animal in random.permutation(200)[: n + 2]]
    agents = fleet_of(costs, ids)
    sizes = talk(agents, ring_of(n), random)
    _, best = linear_sum_assignment(costs)
    assert all(agent.certified for agent in agents)
    assert [agent.animal for agent in agents] == [ids[k] for k in best]
    assert all((agent.choices == [ids[k] for k in best]).all() for agent in agents)
    assert max(sizes, default=0) <= MAX_PACKET_BYTES


@pytest.mark.parametrize("n", [2, 3, 5])
def test_where_any_choice_is_as_cheap_all_find_the_same_one(n: int) -> None:
    agents = fleet_of(np.full((n, n + 1), 20.0), list(range(n + 1)))
    talk(agents, ring_of(n), np.random.default_rng(n))
    assert not any(agent.clash for agent in agents)
    assert all(agent.certified for agent in agents)
    assert len({tuple(agent.choices) for agent in agents}) == 1


@pytest.mark.parametrize("n", [2, 6])
def test_a_line_agrees_too(n: int) -> None:
    random = np.random.default_rng(0)
    line = [link for link in ring_of(n) if set(link) != {0, n - 1}] if n > 2 else [(0, 1), (1, 0)]
    agents = fleet_of(random.uniform(0, 60, (n, n)), list(range(n)))
    talk(agents, line, random)
    assert all(agent.certified for agent in agents)


@quick
@given(
    st.integers(1, 7),
    st.integers(0, 9),
    st.floats(0, 0.95),
    st.integers(0, 10_000),
    st.sampled_from([None, 1, 3]),
)
def test_never_two_on_one_animal_whatever_is_lost(
    n: int, n_goals: int, loss: float, seed: int, listed: int | None
) -> None:
    random = np.random.default_rng(seed)
    previous = [int(k) if random.random() < 0.6 else -1 for k in random.permutation(max(n, n_goals))[:n]]
    previous = [k if k < n_goals else -1 for k in previous]
    agents = fleet_of(random.uniform(0, 60, (n, n_goals)), list(range(n_goals)), previous, listed)
    talk(agents, ring_of(n), random, loss, steps=25)
    for agent in agents:
        # A certificate is never given on less than everybody's choice.
        assert not agent.certified or (agent.choices >= -1).all()


@pytest.mark.parametrize("loss", [0.3, 0.6])
def test_loss_costs_time_and_nothing_else(loss: float) -> None:
    random = np.random.default_rng(1)
    agents = fleet_of(random.uniform(0, 60, (5, 7)), list(range(7)))
    talk(agents, ring_of(5), random, loss, steps=150)
    assert all(agent.certified for agent in agents)


def test_nobody_moves_while_one_member_is_silent_and_all_do_once_it_is_dropped() -> None:
    random = np.random.default_rng(2)
    agents = fleet_of(random.uniform(0, 60, (4, 6)), list(range(6)))
    talk(agents, ring_of(4), random, dead=(2,))
    assert not any(agent.certified for agent in agents)
    for k in (0, 1, 3):
        agents[k].drop_member(2)
    talk(agents, ring_of(4), random, dead=(2,))
    assert all(agents[k].certified for k in (0, 1, 3))
    with pytest.raises(ValueError, match="cannot drop itself"):
        agents[0].drop_member(0)


def test_a_member_that_dies_in_the_middle_never_leads_to_a_clash() -> None:
    for seed in range(30):
        random = np.random.default_rng(seed)
        agents = fleet_of(random.uniform(0, 60, (5, 5)), list(range(5)))
        talk(agents, ring_of(5), random, 0.3, steps=int(random.integers(1, 6)))
        for k in (0, 2, 3, 4):
            agents[k].drop_member(1)
        talk(agents, [(a, b) for a, b in ring_of(5) if 1 not in (a, b)], random, 0.3, steps=80, dead=(1,))
        animals = [agents[k].animal for k in (0, 2, 3, 4) if agents[k].certified]
        assert len(animals) == len(set(animals))


def test_more_drones_than_animals_are_told_so() -> None:
    agents = fleet_of(np.array([[5.0, 9.0], [1.0, 9.0], [9.0, 2.0]]), [40, 41])
    talk(agents, ring_of(3), np.random.default_rng(0))
    assert [agent.animal for agent in agents] == [-1, 40, 41]
    assert [agent.surplus for agent in agents] == [True, False, False]
    assert all(agent.certified for agent in agents)


def test_an_animal_is_kept_unless_the_gain_is_above_the_threshold() -> None:
    costs = np.array([[10.0, 8.0], [8.0, 10.0]])  # swapping would save 4 m in all
    kept = [Agent(k, 2, costs[k], [0, 1], previous=k, threshold_m=5.0) for k in range(2)]
    talk(kept, ring_of(2), np.random.default_rng(0))
    assert [agent.animal for agent in kept] == [0, 1]
    swapped = [Agent(k, 2, costs[k], [0, 1], previous=k, threshold_m=1.0) for k in range(2)]
    talk(swapped, ring_of(2), np.random.default_rng(0))
    assert [agent.animal for agent in swapped] == [1, 0]


def test_nobody_takes_an_animal_before_its_holder_has_confirmed() -> None:
    costs = np.array([[90.0, 1.0], [1.0, 90.0]])
    first, second = (Agent(k, 2, costs[k], [0, 1], previous=k) for k in range(2))
    said = first.step([], 0.0)
    said = second.step(said, 0.2)
    assert second.choice == 0
    said = first.step(said, 0.4)  # knows both choices and confirms; does not know that the other does
    assert (first.choice, first.animal, first.certified) == (1, 0, False)
    said = second.step(said, 0.6)  # knows that both confirm: lets go of its own animal
    assert (second.animal, second.certified) == (-1, False)
    said = first.step(said, 0.8)  # the other let go: lets go of its own and takes its choice
    assert (first.animal, first.certified) == (1, True)
    second.step(said, 1.0)
    assert (second.animal, second.certified) == (0, True)


def test_forbidden_animals_are_left_alone() -> None:
    agents = [
        Agent(k, 2, [1.0, 5.0, 9.0], [3, 4, 5], previous=3 if k == 0 else -1, forbidden=[3]) for k in range(2)
    ]
    assert agents[0].animal == -1
    talk(agents, ring_of(2), np.random.default_rng(0))
    assert sorted(agent.animal for agent in agents) == [4, 5]


def test_drones_with_different_maps_still_agree() -> None:
    agents = [Agent(0, 3, [1.0, 2.0], [7, 8]), Agent(1, 3, [1.0, 3.0], [8, 9]), Agent(2, 3, [1.0], [7])]
    talk(agents, ring_of(3), np.random.default_rng(0))
    assert all(agent.certified for agent in agents)
    assert sorted(agent.animal for agent in agents) == [7, 8, 9]


def test_a_restarted_drone_takes_up_its_old_choice() -> None:
    random = np.random.default_rng(5)
    costs = random.uniform(0, 60, (4, 5))
    agents = fleet_of(costs, list(range(5)))
    talk(agents, ring_of(4), random)
    before = [agent.animal for agent in agents]
    agents[1] = Agent(1, 4, costs[1][::-1].copy(), list(range(5)))  # elsewhere by now: other costs
    talk(agents, ring_of(4), random)
    assert [agent.animal for agent in agents] == before
    assert all(agent.certified for agent in agents)


def test_a_drone_that_restarts_before_it_chose_takes_up_its_old_row() -> None:
    other = Agent(1, 2, [1.0, 2.0], [0, 1])
    other.step(
        Agent(0, 2, [3.0, 9.0], [0, 1]).step([], 0.0), 0.0
    )  # decides on the old row: leaves 0 to the first
    again = Agent(0, 2, [9.0, 3.0], [0, 1])
    agents = [again, other]
    talk(agents, ring_of(2), np.random.default_rng(0))
    assert [agent.animal for agent in agents] == [0, 1]


def test_two_accounts_of_one_choice_end_the_episode_without_a_certificate() -> None:
    agent = Agent(0, 3, [1.0, 2.0, 3.0], [0, 1, 2])
    held = frozenset(range(3))
    rows = {k: Row((0, 1, 2), (100, 200, 300)) for k in (1, 2)}
    for sender, told in ((1, {1: 1}), (2, {1: 2, 2: 1})):
        agent.step([encode(Packet(sender, 3, held, told, frozenset(), frozenset(), rows))], 0.0)
    assert agent.clash
    assert not agent.certified


def test_who_has_told_everybody_speaks_once_a_second() -> None:
    agents = fleet_of(np.eye(3), [0, 1, 2])
    random = np.random.default_rng(0)
    talk(agents, ring_of(3), random, steps=40)
    assert len(talk(agents, ring_of(3), random, steps=50)) <= 3 * 11
    assert Agent(0, 1, [2.0], [9]).step([], 0.0) == []


def test_rows_that_list_the_nearest_animals_only_lead_to_almost_the_same_choice() -> None:
    random = np.random.default_rng(4)
    places, animals = random.uniform(0, 100, (20, 2)), random.uniform(0, 100, (30, 2))
    costs = np.linalg.norm(places[:, None] - animals, axis=2)
    short, whole = (fleet_of(costs, list(range(30)), listed=listed) for listed in (8, None))
    for agents in (short, whole):
        talk(agents, ring_of(20), random, steps=80)
        assert all(agent.certified for agent in agents)
    paid = [sum(costs[k, agent.animal] for k, agent in enumerate(agents)) for agents in (short, whole)]
    assert paid[1] <= paid[0] <= 1.03 * paid[1]
    assert all(len(agent.rows[0].ids) == 8 and agent.rows[0].is_cut for agent in short)


def test_nobody_is_surplus_while_an_animal_that_no_row_lists_is_free() -> None:
    costs = np.array([[1.0, 2.0, 30.0, 40.0], [2.0, 3.0, 40.0, 30.0], [3.0, 4.0, 50.0, 60.0]])
    agents = [Agent(k, 3, row, [4, 5, 6, 7], listed=1) for k, row in enumerate(costs)]
    talk(agents, ring_of(3), np.random.default_rng(0))
    # All list 4 alone. The first gets it; the two left over take what is free in order.
    assert [agent.animal for agent in agents] == [4, 5, 6]
    assert all(agent.certified and not agent.surplus for agent in agents)


def test_a_row_keeps_its_own_and_the_forbidden_animals_however_short_it_is() -> None:
    agent = Agent(0, 2, [9.0, 1.0, 2.0, 8.0], [4, 5, 6, 7], previous=4, forbidden=[7], listed=3)
    assert agent.rows[0].ids == (4, 5, 7)
    assert agent.rows[0].codes[2] == 0xFFFF
    other = Agent(1, 2, [1.0, 2.0, 3.0, 4.0], [4, 5, 6, 7], listed=1)
    talk([agent, other], ring_of(2), np.random.default_rng(0))
    assert (agent.animal, other.animal) == (5, 4)


@pytest.mark.parametrize("n", [5, 10, 30])
def test_twenty_animals_fit_the_papers_bound(n: int) -> None:
    random = np.random.default_rng(0)
    agents = fleet_of(random.uniform(0, 60, (n, 20)), list(range(100, 120)))
    sizes = talk(agents, ring_of(n), random, steps=20 + 8 * n)
    assert max(sizes) <= 308
    assert all(agent.choice is not None for agent in agents)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((3, 3, [1.0], [0]), "index 3 of 3"),
        ((0, 100, [1.0], [0]), "of 100 members"),
        ((0, 2, [1.0], [0, 1]), "need 1 different ids"),
        ((0, 2, [1.0, 2.0], [4, 4]), "need 2 different ids"),
        ((0, 2, [1.0], [255]), "from 0 to 254"),
        ((0, 2, [-1.0], [0]), "cost -1.0"),
        ((0, 2, [float("nan")], [0]), "cost nan"),
        ((0, 99, [1.0] * 70, list(range(70))), "has room for"),
    ],
)
def test_bad_arguments_are_refused_with_their_value(arguments: tuple, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Agent(*arguments)
