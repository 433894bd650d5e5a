"""Assignment as one call: the exact method's answers, rounds and bytes, and the 16-bit costs that it rests
on.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from procs.assigner.costs import FORBIDDEN, UNIT, code_values, cost_codes, solve_table
from procs.assigner.flood import RowAgent
from procs.assigner.solve import assign, assign_many

quick = settings(deadline=None, max_examples=80)


@quick
@given(st.floats(1e-4, 60_000))
def test_a_code_keeps_a_cost_to_one_part_in_4096(cost: float) -> None:
    value = float(code_values(cost_codes(np.array([cost])))[0]) * UNIT
    assert abs(value - cost) <= cost / 4095


@quick
@given(st.floats(0, 1e5), st.floats(0, 1e5))
def test_codes_keep_the_order_of_costs(one: float, other: float) -> None:
    codes = cost_codes(np.sort(np.array([one, other])))
    assert codes[0] <= codes[1] < FORBIDDEN


def test_every_code_comes_back_from_its_value() -> None:
    codes = np.arange(FORBIDDEN, dtype=np.uint16)
    values = code_values(codes)
    assert (np.diff(values) > 0).all()
    np.testing.assert_array_equal(cost_codes(values * UNIT), codes)
    assert cost_codes(np.array([np.inf]))[0] == FORBIDDEN


def test_a_table_worked_by_hand() -> None:
    # Each would like goal 0; the whole is cheapest when the one who gains least steps back.
    costs = np.array([[1.0, 2.0, 9.0], [1.0, 6.0, 9.0]])
    np.testing.assert_array_equal(solve_table(cost_codes(costs)), [1, 0])
    np.testing.assert_array_equal(assign(costs).goals, [1, 0])


def test_forbidden_goals_are_given_to_nobody() -> None:
    costs = np.array([[np.inf, 1.0], [np.inf, 2.0]])
    result = assign(costs)
    np.testing.assert_array_equal(result.goals, [1, -1])
    assert not result.is_distinct


@pytest.mark.parametrize("n", range(1, 13))
def test_the_exact_method_is_optimal_within_its_rounds_and_bytes(n: int) -> None:
    for n_goals in (n, 2 * n):
        random = np.random.default_rng([0, n, n_goals])
        quality = []
        for _ in range(20):
            points = random.random((n + n_goals, 2))
            costs = np.linalg.norm(points[:n, None] - points[None, n:], axis=2)
            result = assign(costs)
            best = costs[linear_sum_assignment(costs)].sum()
            quality.append(best / costs[np.arange(n), result.goals].sum())
            assert result.is_distinct
            assert len(set(result.goals.tolist())) == n
            assert result.rounds == n // 2
            assert result.bytes_sent.max() <= (n - 1) * (2 * n_goals + 1)
        assert np.mean(quality) >= 0.99999


@pytest.mark.parametrize(("loss", "share"), [(0.1, 0.9995), (0.2, 0.995)])
def test_whole_tables_outlast_loss(loss: float, share: float) -> None:
    costs = np.random.default_rng(0).random((5000, 5, 7))
    many = assign_many(costs, loss=loss, seed=1)
    assert many.rounds == 5
    assert many.is_distinct.mean() >= share
    for one in many.goals:
        taken = one[one >= 0]
        assert len(set(taken.tolist())) == len(taken)


@pytest.mark.parametrize("n", [2, 3, 6])
@pytest.mark.parametrize("loss", [0.3, 0.8])
def test_agents_under_loss_decide_as_the_evaluator_says(n: int, loss: float) -> None:
    for seed in range(20):
        costs = np.random.default_rng(seed).random((n, n + 1))
        one, many = assign(costs, loss=loss, seed=seed), assign_many(costs[None], loss=loss, seed=seed)
        np.testing.assert_array_equal(one.goals, many.goals[0])
        np.testing.assert_array_equal(one.bytes_sent, many.bytes_sent[0])
        assert one.is_distinct == many.is_distinct[0] == ((one.goals >= 0).all())


def test_a_table_that_is_cut_short_counts_as_not_come() -> None:
    agents = [RowAgent(np.array([1.0, 2.0]), k, 3, lossy=True) for k in range(3)]
    said = agents[1].step([])
    agents[0].step([])
    agents[0].step([said[0][:-1], b"", b"\x01\xff\xff", said[0][:1] + b"\x08" + said[0][2:]])
    assert sorted(agents[0].rows) == [0]
    agents[0].step([said[0], said[0]])
    assert sorted(agents[0].rows) == [0, 1]


def test_a_neighbour_is_not_told_again_what_it_said_that_it_holds() -> None:
    agents = [RowAgent(np.array([1.0, 2.0]), k, 2, lossy=True) for k in range(2)]
    first, second = (agent.step([]) for agent in agents)
    assert first == [bytes([0, 1, 1]) + agents[0].rows[0]] * 2
    assert agents[0].step(second) == [bytes([0, 3, 1]) + agents[0].rows[0]] * 2
    assert agents[1].step(first) == [bytes([1, 3, 2]) + agents[1].rows[1]] * 2
    assert agents[0].step([bytes([1, 3, 0])]) == [bytes([0, 3, 0])] * 2


def test_with_everything_lost_everybody_holds() -> None:
    result = assign(np.random.default_rng(0).random((4, 6)), loss=1.0)
    np.testing.assert_array_equal(result.goals, [-1] * 4)
    assert not result.is_distinct
    assert (result.bytes_sent > 0).all()


def test_one_agent_needs_no_messages_and_surplus_agents_get_none() -> None:
    alone = assign(np.array([[3.0, 1.0, 2.0]]))
    assert alone.goals.tolist() == [1]
    assert alone.rounds == 0
    assert alone.bytes_sent.tolist() == [0]
    crowd = assign(np.array([[1.0], [2.0], [3.0]]))
    assert crowd.goals.tolist() == [0, -1, -1]
    assert crowd.is_distinct
    empty = assign(np.zeros((2, 0)))
    assert empty.goals.tolist() == [-1, -1]


def test_the_same_seed_gives_the_same_answer() -> None:
    costs = np.random.default_rng(3).random((6, 9))
    one, other = assign(costs, loss=0.4, seed=7), assign(costs, loss=0.4, seed=7)
    np.testing.assert_array_equal(one.goals, other.goals)
    np.testing.assert_array_equal(one.bytes_sent, other.bytes_sent)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"method": "auction"}, "method 'auction' is not known; this release has: gnn, gnn"),
        ({"costs": np.zeros(3)}, r"costs of shape \(3,\)"),
        ({"costs": np.array([[np.nan]])}, "cost nan"),
        ({"costs": np.array([[-1.0]])}, "cost -1.0"),
        ({"loss": 1.5}, "loss 1.5"),
        ({"rounds": 0}, "rounds 0"),
    ],
)
def test_bad_arguments_are_refused_with_their_value(arguments: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        assign(**({"costs": np.ones((2, 2))} | arguments))
