"""The bars of the assignment: five agents as in the paper's Table 2, the exact method, whole tables under
loss.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from procs.assigner.solve import Method, assign, assign_many
from tools.bench.assignment_cases import Cases, Scores, cases, distinct, score
from tools.bench.table import Row

__all__ = ["Measures", "Outcome", "exact_rows", "five_agents", "honest_rows", "lossy_tables", "percent"]

GOALS = (5, 6, 7, 8, 9, 10)
PAPER_OPTIMALITY = (64.1, 67.0, 73.2, 84.9, 91.3, 92.2)  # %, Table 2: n_a = 5, 5 rounds
PAPER_DIVERSITY = (34.3, 78.8, 91.2, 93.3, 93.6, 94.6)
GNN_FLOOR = ((90, 95.5), (92, 95.5), (92.5, 95.5), (94, 96), (95, 96.5), (96, 97))  # %, D and O1
GNN_AIM = ((95, 98), (96, 98), (96, 98), (97, 98.5), (97.5, 98.5), (98, 99))
RESOLVE_FLOOR = (
    (99.9, 98),
    (99.9, 98),
    (99.9, 98),
    (99.9, 98.5),
    (99.9, 98.5),
    (99.9, 99),
)  # Q0 and exact, D = 100
TRAINING_SEEDS = (0, 1, 2)  # of the networks that ship
CHECKED = 10  # cases of a size that are also run agent by agent
CHECKED_AGENTS = 20  # of larger rings none: their agents take minutes


@dataclass(frozen=True)
class Outcome:
    """One method on the cases of one size."""

    scores: Scores
    bytes_sent: float  # by one agent, mean
    most_bytes: int  # by any agent
    rounds: int
    goals: NDArray[np.int64]


@dataclass
class Measures:
    """Runs methods on cases, and notes every answer that says wrongly whether it is distinct."""

    seed: int
    count: int
    n_answers: int = 0
    n_wrong: int = 0
    differing: list[str] = field(
        default_factory=list
    )  # sizes at which the agents themselves decided otherwise

    def given(self, n_agents: int, n_goals: int, count: int | None = None) -> Cases:
        return _cases(self.seed, n_agents, n_goals, self.count if count is None else count)

    def run(
        self, given: Cases, method: Method, rounds: int = 5, loss: float = 0.0, training_seed: int = 0
    ) -> Outcome:
        """All cases at once; a few of them also by the agents themselves, which must say the same."""
        answer = assign_many(
            given.costs, method, rounds=rounds, loss=loss, seed=self.seed, training_seed=training_seed
        )
        truly = distinct(answer.goals, given.costs.shape[2])
        self.n_answers += len(truly)
        self.n_wrong += int((answer.is_distinct != truly).sum())
        if loss == 0:
            self._check(given, method, rounds, training_seed, answer.goals, answer.bytes_sent)
        sent = answer.bytes_sent
        return Outcome(
            score(given, answer.goals),
            float(sent.mean()),
            int(sent.max(initial=0)),
            answer.rounds,
            answer.goals,
        )

    def worst(self, given: Cases, method: Method, rounds: int = 5, loss: float = 0.0) -> Outcome:
        """The training seed with the lowest score; methods that were not trained have one."""
        outcomes = [self.run(given, method, rounds, loss, training) for training in seeds_of(method)]
        scores = [
            Scores(*(min(getattr(one.scores, name) for one in outcomes) for name in Scores.__annotations__))
        ]
        first = outcomes[0]
        return Outcome(scores[0], first.bytes_sent, first.most_bytes, first.rounds, first.goals)

    def _check(
        self,
        given: Cases,
        method: Method,
        rounds: int,
        training_seed: int,
        goals: NDArray[np.int64],
        sent: NDArray[np.int64],
    ) -> None:
        n_agents, n_goals = given.costs.shape[1:]
        most = CHECKED if n_agents <= 10 else 1 if n_agents <= CHECKED_AGENTS else 0
        for case in range(min(most, len(goals))):
            one = assign(given.costs[case], method, rounds=rounds, training_seed=training_seed)
            if (one.goals != goals[case]).any() or (one.bytes_sent != sent[case]).any():
                self.differing.append(f"{method} {n_agents}x{n_goals}")


@lru_cache(maxsize=4)
def _cases(seed: int, n_agents: int, n_goals: int, count: int) -> Cases:
    return cases(seed, n_agents, n_goals, count)


def seeds_of(method: Method) -> Sequence[int]:
    return TRAINING_SEEDS if method.startswith("gnn") else (0,)


def percent(*shares: float) -> str:
    """Shares as per cents side by side, never rounded up to 100."""
    return " / ".join(f"{np.floor(share * 1e4) / 100:.2f}" for share in shares)


def five_agents(measures: Measures) -> Iterator[Row]:
    """Table 2's sizes: learned, the paper's own figures, and learned with two rounds of flooding."""
    seed = str(measures.seed)
    for k, n_goals in enumerate(GOALS):
        given = measures.given(5, n_goals)
        got = measures.worst(given, "gnn").scores
        floor, aim = GNN_FLOOR[k], GNN_AIM[k]
        passed = 100 * got.distinct >= floor[0] and 100 * got.agreeing >= floor[1]
        name = f"gnn, n_g = {n_goals}: D / O1, %"
        yield Row(
            name, len(given.costs), seed, percent(got.distinct, got.agreeing), _bar(floor), _bar(aim), passed
        )
        paper = f"{PAPER_DIVERSITY[k]} / {PAPER_OPTIMALITY[k]}"
        yield Row(f"  the paper's Table 2, n_g = {n_goals}", 5000, "-", paper)
    for k, n_goals in enumerate(GOALS):
        given = measures.given(5, n_goals)
        got = measures.worst(given, "gnn+resolve").scores
        floor = RESOLVE_FLOOR[k]
        passed = got.distinct == 1.0 and 100 * got.quality >= floor[0] and 100 * got.exact >= floor[1]
        figure = percent(got.distinct, got.quality, got.exact)
        name = f"gnn+resolve, n_g = {n_goals}: D / Q0 / exact, %"
        yield Row(name, len(given.costs), seed, figure, "100 / " + _bar(floor), "", passed)


def _bar(values: tuple[float, ...]) -> str:
    return " / ".join(f"{value:g}" for value in values)


def exact_rows(measures: Measures, *, quick: bool = False) -> Iterator[Row]:
    """The exact method at n = 3 to 12, each with all numbers of goals from n to 2n; the worst of them
    counts.
    """
    for n in (3, 5, 12) if quick else range(3, 13):
        conflicts, quality, over, rounds, total = 0, 1.0, 0, 0, 0
        for n_goals in range(n, 2 * n + 1):
            given = cases(measures.seed, n, n_goals, measures.count)
            got = measures.run(given, "exact")
            conflicts += int((~distinct(got.goals, n_goals)).sum())
            quality = min(quality, got.scores.quality)
            over = max(over, got.most_bytes - (n - 1) * (2 * n_goals + 1))
            rounds = max(rounds, got.rounds)
            total += len(given.costs)
        passed = conflicts == 0 and quality >= 0.99999 and over <= 0 and rounds == n // 2
        figure = f"{conflicts} / {100 * quality:.5f} % / {over:+d} B / {rounds}"
        yield Row(
            f"exact, n = {n}, n_g = {n} to {2 * n}: conflicts / Q0 / bytes above (n-1)(2 n_g + 1) / rounds",
            total,
            str(measures.seed),
            figure,
            f"0 / >= 99.999 % / <= 0 / {n // 2}",
            "",
            passed,
        )


def lossy_tables(measures: Measures) -> Iterator[Row]:
    """Whole tables at n = 5 while messages are lost."""
    for loss, floor in ((0.1, 99.95), (0.2, 99.5)):
        for n_goals in (5, 10):
            given = measures.given(5, n_goals)
            got = measures.run(given, "exact", loss=loss)
            name = f"exact, n = 5, n_g = {n_goals}, {100 * loss:.0f} % lost: D, % ({got.rounds} rounds)"
            figure = f"{percent(got.scores.distinct)} ({got.bytes_sent:.0f} B)"
            passed = 100 * got.scores.distinct >= floor
            yield Row(name, len(given.costs), str(measures.seed), figure, f">= {floor}", "", passed)


def honest_rows(all_measures: Sequence[Measures]) -> Iterator[Row]:
    """What all runs of this benchmark said of themselves."""
    answers = sum(one.n_answers for one in all_measures)
    wrong = sum(one.n_wrong for one in all_measures)
    seed = str(all_measures[0].seed)
    yield Row("is_distinct said wrongly, all runs", answers, seed, str(wrong), "0", "", wrong == 0)
    differing = [name for one in all_measures for name in one.differing]
    why = ", ".join(differing[:8])
    name = "cases in which the agents themselves decide or send otherwise than the evaluator of many"
    yield Row(name, answers, seed, str(len(differing)), "0", "", not differing, why)
