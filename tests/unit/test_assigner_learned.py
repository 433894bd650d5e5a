"""The learned methods: what an agent says and hears, how far it sees, that one agent and the evaluator agree,
and how good the networks that ship are.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from procs.assigner.gnn import GnnAgent
from procs.assigner.learned import TRAINING_SEEDS, block_of, load, network
from procs.assigner.resolve import Lists, choose, left_over, split_rounds
from procs.assigner.solve import METHODS, Method, agents_of, assign, assign_many, talk
from procs.assigner.window import bid, features, observe

LEARNED: tuple[Method, ...] = ("gnn", "gnn+resolve")
quick = settings(deadline=None, max_examples=25)


def squares(seed: int, count: int, n_agents: int, n_goals: int) -> NDArray[np.float64]:
    points = np.random.default_rng([seed, 60_000, n_agents, n_goals]).random((count, n_agents + n_goals, 2))
    agents = points[:, :n_agents]
    order = np.argsort(np.arctan2(agents[..., 1] - 0.5, agents[..., 0] - 0.5), axis=1)
    agents = np.take_along_axis(agents, order[..., None], axis=1)
    return np.asarray(np.linalg.norm(agents[:, :, None] - points[:, None, n_agents:], axis=-1))


@pytest.mark.parametrize("method", METHODS)
def test_agents_and_evaluator_agree_goal_for_goal_and_byte_for_byte(method: Method) -> None:
    checked = 0
    for n_agents, n_goals, count in [
        (5, 5, 120),
        (5, 10, 80),
        (1, 4, 30),
        (2, 2, 80),
        (3, 2, 60),
        (4, 6, 80),
        (8, 9, 50),
    ]:
        costs = squares(1, count, n_agents, n_goals)
        if n_agents == 4:
            costs[np.random.default_rng(0).random(costs.shape) < 0.2] = np.inf
        many = assign_many(costs, method)
        for case in range(count):
            one = assign(costs[case], method)
            np.testing.assert_array_equal(one.goals, many.goals[case])
            np.testing.assert_array_equal(one.bytes_sent, many.bytes_sent[case])
            assert (one.is_distinct, one.rounds) == (many.is_distinct[case], many.rounds)
            checked += 1
    assert checked == 500


@pytest.mark.parametrize("method", LEARNED)
@pytest.mark.parametrize("rounds", [1, 2, 3, 4, 9])
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_any_number_of_rounds_and_any_loss_is_defined(method: Method, rounds: int, loss: float) -> None:
    for n_agents in (2, 5, 7):
        costs = squares(2, 2, n_agents, 7)
        for seed, case in enumerate(costs):
            one = assign(case, method, rounds=rounds, loss=loss, seed=seed)
            many = assign_many(case[None], method, rounds=rounds, loss=loss, seed=seed)
            assert one.rounds == rounds
            np.testing.assert_array_equal(one.goals, many.goals[0])
            np.testing.assert_array_equal(one.bytes_sent, many.bytes_sent[0])


@pytest.mark.parametrize("method", LEARNED)
@pytest.mark.parametrize("rounds", [2, 5])
def test_a_goal_depends_on_no_row_more_than_rounds_hops_away(method: Method, rounds: int) -> None:
    n = 24
    costs = squares(3, 1, n, 26)[0]
    before = assign(costs, method, rounds=rounds).goals
    changed = []
    for other in (0, 7, 15):
        moved = costs.copy()
        moved[other] = np.random.default_rng(other).random(26) * 40
        after = assign(moved, method, rounds=rounds).goals
        apart = np.abs(np.arange(n) - other)
        apart = np.minimum(apart, n - apart)
        np.testing.assert_array_equal(after[apart > rounds], before[apart > rounds])
        changed += apart[(after != before) & (apart > 0)].tolist()
    assert changed  # near rows do matter


@pytest.mark.parametrize("method", LEARNED)
def test_metres_and_unit_squares_agree(method: Method) -> None:
    costs = squares(4, 200, 5, 7)
    squared = assign_many(costs, method).goals
    np.testing.assert_array_equal(assign_many(costs * 64, method).goals, squared)
    # Codes round differently at another scale: a few near ties may turn.
    assert (assign_many(costs * 137.0, method).goals == squared).mean() >= 0.995


def test_drones_far_from_the_pod_decide_by_differences() -> None:
    costs = squares(5, 200, 5, 6)
    near, far = (assign_many(costs * 50 + extra, "gnn").goals for extra in (0.0, 200.0))
    assert (near == far).mean() >= 0.97


@quick
@given(
    st.integers(1, 7), st.integers(1, 8), st.integers(0, 10_000), st.sampled_from(LEARNED), st.floats(0, 1)
)
def test_what_is_forbidden_is_taken_by_nobody(n: int, g: int, seed: int, method: Method, loss: float) -> None:
    random = np.random.default_rng(seed)
    costs = random.random((n, g))
    costs[random.random((n, g)) < 0.3] = np.inf
    found = assign(costs, method, loss=loss, seed=seed)
    for agent, goal in enumerate(found.goals):
        assert -1 <= goal < g
        assert goal < 0 or np.isfinite(costs[agent, goal])
    taken = found.goals[found.goals >= 0].tolist()
    assert found.is_distinct == (len(set(taken)) == len(taken) == min(n, g))


@pytest.mark.parametrize("method", LEARNED)
def test_repeated_messages_in_any_order_change_nothing(method: Method) -> None:
    costs = squares(6, 1, 5, 6)[0]
    plain, odd = agents_of(costs, method), agents_of(costs, method)
    talk(plain, np.ones((5, 2, 2, 5), dtype=bool))
    inboxes: list[list[bytes]] = [[] for _ in odd]
    for _ in range(6):
        said = [agent.step(inbox) for agent, inbox in zip(odd, inboxes, strict=True)]
        inboxes = [[] for _ in odd]
        for k, messages in enumerate(said):
            for side, data in enumerate(messages):
                to = inboxes[(k + (1 if side else -1)) % 5]
                to[:0] = [data, b"", data[:-1], b"\x09\x01junk", data]
    assert [agent.goal for agent in odd] == [agent.goal for agent in plain]


@pytest.mark.parametrize("method", LEARNED)
def test_an_agent_that_hears_nothing_takes_the_goal_that_it_would_alone(method: Method) -> None:
    costs = np.array([[5.0, 1.0, 9.0], [6.0, 2.0, 9.0], [7.0, 3.0, 9.0]])
    found = assign(costs, method, loss=1.0)
    assert found.goals.tolist() == [1, 1, 1]
    assert not found.is_distinct


def test_a_message_keeps_to_the_papers_bound() -> None:
    agents = agents_of(squares(7, 1, 7, 20)[0], "gnn")
    inboxes: list[list[bytes]] = [[] for _ in agents]
    for number in range(1, 6):
        said = [agent.step(inbox) for agent, inbox in zip(agents, inboxes, strict=True)]
        inboxes = [[said[k - 1][1], said[(k + 1) % 7][0]] for k in range(7)]
        for k, messages in enumerate(said):
            assert [len(data) for data in messages] == [2 + 6 * 20] * 2
            assert [data[:2] for data in messages] == [bytes([k, number + (128 if number <= 3 else 0)])] * 2
    assert agents[0].step(inboxes[0]) == []
    assert agents[0].goal >= 0


def test_an_agent_says_its_own_row_first_and_hands_on_what_it_heard() -> None:
    agents = agents_of(squares(8, 1, 5, 6)[0], "gnn")
    first = [agent.step([]) for agent in agents]
    second = agents[2].step([first[1][1], first[3][0]])
    assert second[1][2:14] == first[1][1][2:14]  # to the right: the row from the left
    assert second[0][2:14] == first[3][0][2:14]
    third = agents[2].step([])  # nothing came: nothing to hand on, and from here on no rows travel
    assert third[0][1] == 3
    assert len(third[0]) == 2 + 6 * 6


def test_surplus_agents_get_none() -> None:
    costs = squares(9, 200, 5, 3)
    resolved = assign_many(costs, "gnn+resolve")
    assert resolved.is_distinct.all()
    assert ((resolved.goals >= 0).sum(axis=1) == 3).all()
    assert assign_many(costs, "gnn").is_distinct.mean() >= 0.6
    assert assign(np.zeros((2, 0)), "gnn").goals.tolist() == [-1, -1]
    assert assign(np.zeros((2, 0)), "gnn+resolve").goals.tolist() == [-1, -1]


@pytest.mark.parametrize("seed", TRAINING_SEEDS)
def test_the_networks_that_ship_are_as_good_as_the_floors(seed: int) -> None:
    for n_goals, floor, agreeing in ((5, 0.9, 0.955), (7, 0.925, 0.955), (10, 0.96, 0.97)):
        costs = squares(10, 600, 5, n_goals)
        best = np.array([linear_sum_assignment(table)[1] for table in costs])
        learned = assign_many(costs, "gnn", training_seed=seed)
        # Two standard deviations of 600 cases below the floor of 5000.
        assert learned.is_distinct.mean() >= floor - 2 * np.sqrt(floor * (1 - floor) / 600)
        assert (learned.goals == best).mean() >= agreeing - 0.005
        resolved = assign_many(costs, "gnn+resolve", training_seed=seed)
        assert resolved.is_distinct.all()
        assert (resolved.goals == best).all(axis=1).mean() >= 0.98


def test_lists_are_solved_together_and_who_is_left_over_takes_what_is_free() -> None:
    lists = Lists(3, 4, flooding=2)
    named = np.array([[0, 1, 2], [0, 1, 2], [1, 0, 2]])
    worth = np.array([[10, 20, 30], [10, 90, 95], [10, 20, 30]], dtype=np.uint16)
    chosen, free = choose(lists, named, worth)
    assert chosen.tolist() == [2, 0, 1]  # 30 + 10 + 10 beats 20 + 10 + 30, and worse
    assert free == [3]
    assert left_over(np.array([2, -1, 1]), 1, [0, 3], np.array([5.0, 1.0, 1.0, 9.0])) == 3
    assert left_over(np.array([-1, -1, 1]), 1, [0, 3], np.array([9.0, 1.0, 1.0, 5.0])) == 3
    assert left_over(np.array([-1, -1, 1]), 0, [0, 3], np.full(4, -np.inf)) == -1
    assert left_over(np.array([2, -1, 1]), 1, [], np.zeros(4)) == -1


def test_four_agents_with_the_same_three_goals_listed_leave_one_over() -> None:
    lists = Lists(4, 5, flooding=2)
    named = np.tile([0, 1, 2], (4, 1))
    chosen, free = choose(lists, named, np.tile(np.array([1, 2, 3], dtype=np.uint16), (4, 1)))
    assert sorted(chosen.tolist()) == [-1, 0, 1, 2]
    assert free == [3, 4]


@pytest.mark.parametrize(
    ("rounds", "split"), [(1, (0, 1)), (2, (0, 2)), (4, (2, 2)), (5, (3, 2)), (9, (3, 6))]
)
def test_rounds_are_split_between_learning_and_flooding(rounds: int, split: tuple[int, int]) -> None:
    assert split_rounds(rounds, 6) == split
    assert split_rounds(rounds, 1) == (0, 0)


@pytest.mark.parametrize(
    ("rounds", "blocks"),
    [(1, [0]), (3, [0, 1, 2]), (4, [0, 1, 2, 3]), (5, [0, 1, 2, 3, 4]), (7, [0, 1, 2, 3, 3, 3, 4])],
)
def test_the_fourth_rounds_weights_serve_rounds_beyond_five(rounds: int, blocks: list[int]) -> None:
    assert [block_of(number, rounds) for number in range(1, rounds + 1)] == blocks


def test_prices_rise_where_two_want_one_goal() -> None:
    rows = np.array([[1.0, 2.0, 8.0], [1.0, 6.0, 8.0]])
    window = observe(rows, np.array([True, True]), 2)
    prices, bids = bid(window, np.zeros(3), 0.1)
    assert prices[0] > 0.5
    assert prices[2] == 0
    assert bids[0].argmax() == 1  # the one who gains least by staying steps back
    assert bids[1].argmax() == 0
    np.testing.assert_allclose(bids.sum(axis=1), 1.0)
    found = features(window, prices, bids, 2)
    assert found.shape == (3, 12)
    np.testing.assert_allclose(
        features(observe(rows * 9, np.array([True, True]), 2), prices * 9, bids, 2), found
    )


def test_a_row_that_is_not_held_counts_for_nothing() -> None:
    rows = np.array([[1.0, 2.0], [7.0, 3.0]])
    alone, other = (observe(rows[:k], np.array([True, False][:k]), 2) for k in (1, 2))
    for one, two in zip(bid(alone, np.zeros(2), 0.2), bid(other, np.zeros(2), 0.2), strict=True):
        np.testing.assert_allclose(one.reshape(-1)[:2], two.reshape(-1)[:2])


def test_what_is_no_network_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(ValueError, match=r"start.weight has shape \(0,\)"):
        load(tmp_path / "other.npz")
    with pytest.raises(ValueError, match="training seed 7"):
        network(7)
    with pytest.raises(ValueError, match="rounds 128"):
        GnnAgent(np.ones(2), 0, 2, rounds=128)
    with pytest.raises(ValueError, match="cost nan"):
        GnnAgent(np.array([np.nan]), 0, 2)
    with pytest.raises(ValueError, match="costs of shape"):
        assign_many(np.ones((3, 3)))
