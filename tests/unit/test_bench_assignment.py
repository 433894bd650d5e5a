"""The assignment benchmark: its cases and scores, the other methods worked by hand, and the whole of it on
few cases.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from procs.assigner import rule
from procs.settings import MAX_DRONES
from tools.bench import assignment_flight as flight
from tools.bench import assignment_large as large
from tools.bench import assignment_peers as peers
from tools.bench.assignment import command
from tools.bench.assignment_cases import cases, distinct, points, score

# Everybody wants goal 0; on a line the whole is cheapest when the others step aside in turn.
CROWD = np.array([[[0.1, 0.5, 0.9], [0.2, 0.8, 0.9], [0.3, 0.35, 0.4]]])


def test_the_cases_are_those_of_the_benchmark() -> None:
    agents, goals = points(3, 4, 6, 7)
    drawn = np.random.default_rng([3, 4, 6]).random((5000, 10, 2))[:7]
    np.testing.assert_array_equal(goals, drawn[:, 4:])
    angle = np.arctan2(agents[..., 1] - 0.5, agents[..., 0] - 0.5)
    assert (np.diff(angle, axis=1) > 0).all()
    np.testing.assert_array_equal(np.sort(agents[..., 0], axis=1), np.sort(drawn[:, :4, 0], axis=1))


def test_scores_worked_by_hand() -> None:
    given = cases(0, 3, 4, 2)
    right = given.best.copy()
    assert score(given, right).exact == score(given, right).quality == 1.0
    right[0, 0] = right[0, 1]  # the first case: two agents on one goal
    got = score(given, right)
    assert (got.distinct, got.exact) == (0.5, 0.5)
    assert got.agreeing == pytest.approx(5 / 6)
    assert got.quality == pytest.approx(0.5)
    chosen = np.array([[0, 1, -1], [0, -1, -1], [1, 1, -1], [0, 1, 2]])
    assert distinct(chosen, 2).tolist() == [True, False, False, False]
    assert distinct(chosen, 3).tolist() == [False, False, False, True]


def test_cbaa_worked_by_hand() -> None:
    # Round 1: all bid for goal 0 and agent 0 wins. Round 2: agents 1 and 2 bid for goal 1, 0.8 against
    # 0.35: agent 2 wins. Then agent 1 is left with goal 2.
    assert peers.cbaa(CROWD, 1).goals.tolist() == [[0, 1, 1]]
    assert peers.cbaa(CROWD, 2).goals.tolist() == [[0, 2, 1]]
    settled = peers.cbaa(CROWD, 4)
    assert settled.goals.tolist() == [[0, 2, 1]]
    assert settled.bytes_sent == 4 * 2 * 3 * 3  # rounds, sides, goals, bytes


def test_the_auction_comes_within_its_epsilon_of_the_optimum() -> None:
    given = cases(1, 5, 5, 50)
    settled = peers.distributed_auction(given.costs, 200)
    got = score(given, settled.goals)
    assert got.distinct == 1.0
    paid = np.take_along_axis(given.costs, settled.goals[..., None], axis=2).sum(axis=(1, 2))
    assert (paid <= given.best_cost + 5 * 0.02 + 1e-3).all()


@pytest.mark.parametrize("method", [peers.cbaa, peers.distributed_auction])
def test_with_everything_lost_each_takes_what_is_best_for_itself(method) -> None:  # type: ignore[no-untyped-def]
    assert method(CROWD, 3, loss=1.0).goals.tolist() == [[0, 0, 0]]


def test_a_flood_reaches_as_far_as_it_has_rounds() -> None:
    random = np.random.default_rng(0)
    held, sent = peers.held_rows(1, 7, 2, 10, 0.0, random)
    assert held[0, 0].tolist() == [True, True, True, False, False, True, True]
    assert sent == 4 * 11
    lossy, more = peers.held_rows(3, 7, 3, 10, 1e-12, random)
    assert lossy.all()
    assert more > sent
    alone, _ = peers.held_rows(1, 7, 5, 10, 1.0, random)
    np.testing.assert_array_equal(alone[0], np.eye(7, dtype=bool))


def test_flooding_the_whole_ring_is_optimal_and_less_is_not() -> None:
    given = cases(2, 12, 14, 20)
    whole = peers.flood(given.costs, 6)
    np.testing.assert_array_equal(whole.goals, given.best)
    assert whole.bytes_sent == 11 * (1 + 28)
    assert score(given, peers.flood(given.costs, 2).goals).distinct < 0.5


def test_nearest_lists_leave_nobody_without_a_goal_of_its_own() -> None:
    given = cases(2, 8, 8, 40)
    got = score(given, peers.flood_nearest(given.costs, 4, 2).goals)
    assert got.distinct == 1.0
    assert 0.3 < got.agreeing < 0.9
    np.testing.assert_array_equal(peers.flood_nearest(given.costs, 4, 8).goals, given.best)


def test_the_best_of_a_window_is_the_optimum_where_it_is_the_whole_ring_and_beats_a_flood_where_not() -> None:
    given = cases(2, 11, 11, 3)
    random = np.random.default_rng(0)
    whole = peers.best_of_window(given.agents, given.goals, 5, random)
    np.testing.assert_array_equal(whole, given.best)
    given = cases(2, 14, 14, 12)
    guessed = score(given, peers.best_of_window(given.agents, given.goals, 3, random, completions=15))
    assert guessed.agreeing > score(given, peers.flood(given.costs, 3).goals).agreeing


def test_the_exchange_in_flight_comes_to_the_optimum_or_says_that_it_did_not() -> None:
    seconds, to_decide, sent, quality, clashes = flight._exchange(0, 4, 6, 0.0)
    assert (seconds, clashes) == (pytest.approx(0.8), 0)
    assert 0 < to_decide < sent
    assert quality == pytest.approx(1.0, abs=1e-3)
    assert flight._exchange(0, 4, 6, 1.0)[0] == np.inf


def test_the_rule_says_exact_at_every_size_that_a_mission_may_have() -> None:
    """What flies is the exact method: were a network to win somewhere, its rounds would have to be flown
    too.
    """
    for n in range(1, MAX_DRONES + 1):
        for n_animals in (1, n, 2 * n, 99):
            for loss in (0.0, 0.1, 0.3, 1.0):
                assert rule.plan(n, n_animals, loss).method == "exact"


def test_the_rule_cuts_rows_only_where_they_would_take_longer_than_their_hops() -> None:
    assert rule.plan(3, 20, 0.0).listed == 20
    assert rule.plan(10, 15, 0.2).listed == 15
    large_ring = rule.plan(50, 75, 0.0).listed
    assert rule.LEAST_LISTED <= rule.plan(50, 75, 0.3).listed < large_ring < 75
    # No row is longer than a packet, whatever the fleet.
    for n in range(1, MAX_DRONES + 1):
        assert 3 + 3 * rule.plan(n, 200, 0.0).listed <= 308


def test_the_whole_benchmark_on_few_cases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tools.bench.assignment.QUICK_CASES", 4)
    monkeypatch.setattr(large, "QUICK_COUNTS", {12: 2})
    monkeypatch.setattr("tools.bench.assignment_bars.CHECKED", 1)
    monkeypatch.setattr("tools.bench.assignment_bars.TRAINING_SEEDS", (0,))
    command(0, 5000, tmp_path, quick=True)
    rows = json.loads((tmp_path / "bench_assignment.json").read_text())
    missing = [row["name"] + ": " + row["why"] for row in rows if row["figure"] is None]
    assert missing == []
    by_name = {row["name"]: row for row in rows}
    assert by_name["is_distinct said wrongly, all runs"]["passed"]
    assert by_name["gnn, n_g = 5: D / O1, %"]["floor"] == "90 / 95.5"
    assert by_name["  the paper's Table 2, n_g = 10"]["figure"] == "94.6 / 92.2"
    names = [row["name"] for row in rows]
    assert (
        names.index("exact, n = 3, n_g = 3 to 6: conflicts / Q0 / bytes above (n-1)(2 n_g + 1) / rounds") > 12
    )
    assert (tmp_path / "assignment_rings.png").stat().st_size > 10_000
    assert (tmp_path / "assignment_loss.png").stat().st_size > 10_000
    assert "MISSING" not in capsys.readouterr().out
