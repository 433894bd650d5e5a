"""Learned rounds over links that lose, repeat and delay: the answers of `assign`, inside the certificate."""

import numpy as np
import pytest

from procs.assigner.gossip import Agent
from procs.assigner.rounds import PATIENCE_S, RoundTalk
from procs.assigner.solve import Method, assign
from tests.unit.assigner_talk import ring_of, talk

IDS = [3, 7, 8, 20, 21, 90, 91, 92]


def costs_of(n: int, n_goals: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    agents, goals = random.uniform(0, 80, (n, 2)), random.uniform(0, 80, (n_goals, 2))
    order = np.argsort(np.arctan2(agents[:, 1] - 40, agents[:, 0] - 40))
    return np.asarray(np.linalg.norm(agents[order][:, None] - goals, axis=2))


def fleet_of(costs: np.ndarray, method: Method, previous: list[int] | None = None) -> list[Agent]:
    before = previous or [-1] * len(costs)
    ids = IDS[: costs.shape[1]]
    return [
        Agent(k, len(costs), row, ids, previous=before[k], threshold_m=0.0, method=method)
        for k, row in enumerate(costs)
    ]


@pytest.mark.parametrize("method", ["gnn", "gnn+resolve"])
@pytest.mark.parametrize(
    ("n", "n_goals", "loss"), [(1, 3, 0.0), (2, 4, 0.3), (5, 8, 0.0), (5, 8, 0.3), (5, 4, 0.2)]
)
def test_what_flies_decides_as_assign_does(method: Method, n: int, n_goals: int, loss: float) -> None:
    for seed in range(3):
        costs = costs_of(n, n_goals, seed)
        agents = fleet_of(costs, method)
        sizes = talk(agents, ring_of(n), np.random.default_rng(seed), loss, steps=150)
        expected = assign(costs, method)
        chosen = [IDS[goal] if goal >= 0 else -1 for goal in expected.goals]
        assert [agent.choice for agent in agents] == chosen
        taken = [goal for goal in chosen if goal >= 0]
        # Who moves, moves with everybody: the certificate is given for distinct choices only.
        assert all(agent.certified == (len(set(taken)) == len(taken)) for agent in agents)
        assert max(sizes, default=0) <= 308


def test_two_on_one_goal_are_given_no_certificate() -> None:
    clashing = next(
        costs
        for costs in (costs_of(5, 5, seed) for seed in range(200))
        if not assign(costs, "gnn").is_distinct and (assign(costs, "gnn").goals >= 0).all()
    )
    agents = fleet_of(clashing, "gnn", previous=IDS[:5])
    talk(agents, ring_of(5), np.random.default_rng(0), 0.2, steps=80)
    assert not any(agent.certified for agent in agents)
    assert [agent.animal for agent in agents] == IDS[:5]


def test_a_member_that_dies_in_mid_round_is_waited_for_until_it_is_dropped() -> None:
    agents = fleet_of(costs_of(5, 8, 1), "gnn+resolve")
    random = np.random.default_rng(0)
    talk(agents, ring_of(5), random, steps=2)
    talk(agents, ring_of(5), random, steps=4, dead=(2,))
    assert agents[1].choice is None
    for k in (0, 1, 3, 4):
        agents[k].drop_member(2)
    talk(agents, ring_of(5), random, steps=80, dead=(2,))
    animals = [agents[k].animal for k in (0, 1, 3, 4) if agents[k].certified]
    assert all(agents[k].choice is not None for k in (0, 1, 3, 4))
    assert len(animals) == len(set(animals))


class Counting:
    """A learner that notes what it is given."""

    rounds = 2
    goal = 0

    def __init__(self) -> None:
        self.given: list[list[bytes]] = []

    def step(self, inbox: list[bytes]) -> list[bytes]:
        self.given.append(inbox)
        return [b"to left", b"to right"] if len(self.given) <= self.rounds else []


def test_a_silent_neighbour_is_passed_over_and_a_stranger_is_not_heard() -> None:
    learner = Counting()
    rounds = RoundTalk(learner, 0, 4, [5, 6])
    rounds.step(0.0)
    digest = rounds.to_say([])[0][2][:1]
    assert [(to, number) for to, number, _ in rounds.to_say([])] == [(3, 1), (1, 1)]
    for sender, data in (
        (2, digest + b"stranger"),
        (1, b"?of another map"),
        (3, digest + b"left"),
        (3, digest),
    ):
        rounds.hear(sender, 1, data)
    rounds.step(PATIENCE_S - 0.1)
    assert learner.given == [[]]
    rounds.step(PATIENCE_S + 0.1)
    assert learner.given == [[], [b"left"]]
    # The right neighbour has not shown that it heard the first; the left may lack both.
    assert [(to, number) for to, number, _ in rounds.to_say([])] == [(3, 1), (1, 1), (3, 2), (1, 2)]
    rounds.hear(3, 2, digest + b"left again")
    rounds.hear(1, 2, digest + b"right again")
    rounds.step(PATIENCE_S + 0.2)
    assert rounds.is_over
    assert [(to, number) for to, number, _ in rounds.to_say([3])] == [(1, 2)]


def test_a_pod_that_no_learned_message_can_hold_is_refused() -> None:
    with pytest.raises(ValueError, match="60 goals: a message of gnn takes 373 bytes"):
        Agent(0, 5, [1.0] * 60, list(range(60)), method="gnn")
