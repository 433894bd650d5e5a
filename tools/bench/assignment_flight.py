"""What flies: the exchange with its certificate, agents stepping as their process steps them; times; and
the method that the rule picks, held against what was measured.
"""

import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from procs.assigner.costs import cost_codes, solve_table
from procs.assigner.gossip import Agent
from procs.assigner.process import STEP_S
from procs.assigner.rule import DISTINCT, RATIOS, plan, rows_listed
from procs.assigner.solve import METHODS, Method, agent_for, assign_many, talk
from procs.navigator.behaviours import ASSIGN_LIMIT_S
from tools.bench.assignment_cases import Scores, points
from tools.bench.assignment_large import AT_FIVE, LargeRings
from tools.bench.table import Row

__all__ = ["exchange_rows", "rule_rows", "time_rows"]

FLEETS = ((3, 5), (5, 10), (10, 15), (20, 30), (30, 45), (50, 50), (50, 75), (63, 65))
LOSSES = (0.0, 0.1, 0.2)
POD_M = 120.0  # side of the square in which drones and animals lie
MOST_STEPS = 400
RULE_SIZES = (2, 3, 5, 10, 14, 19, 20, 30, 50, 63)
SHARE_TOLERANCE = 0.05


def exchange_rows(seed: int, *, quick: bool = False) -> Iterator[Row]:
    """Seconds and bytes until every drone holds its certificate, at the process's pace."""
    for n, n_goals in FLEETS[:3] if quick else FLEETS:
        for loss in LOSSES:
            runs = 2 if quick else max(2, 200 // n)
            results = [_exchange(seed + k, n, n_goals, loss) for k in range(runs)]
            slowest = max(result[0] for result in results)
            middle = float(np.median([result[0] for result in results]))
            rows_sent, sent, quality = np.mean([result[1:4] for result in results], axis=0)
            clashes = sum(result[4] for result in results)
            name = (
                f"certificate, {n} drones, {n_goals} animals, {100 * loss:.0f} % lost: "
                "median / slowest, bytes to decide + to certify, Q0, clashes"
            )
            spent = f"{rows_sent:.0f} + {sent - rows_sent:.0f} B"
            figure = f"{middle:.1f} / {slowest:.1f} s, {spent}, {100 * quality:.2f} %, {clashes}"
            passed = slowest <= ASSIGN_LIMIT_S and clashes == 0
            yield Row(
                name,
                runs,
                f"{seed}-{seed + runs - 1}",
                figure,
                f"<= {ASSIGN_LIMIT_S:.0f} s, 0 clashes",
                "",
                passed,
            )


def _exchange(seed: int, n: int, n_goals: int, loss: float) -> tuple[float, float, float, float, int]:
    """One exchange on a ring -> (seconds to the last certificate, bytes an agent sent to both neighbours
    until all had decided, and in all, optimum / cost, steps at which two drones had one animal).
    """
    agents_at, goals_at = points(seed, n, n_goals, 1)
    costs = POD_M * np.linalg.norm(agents_at[0][:, None] - goals_at[0], axis=-1)
    random = np.random.default_rng([seed, n, n_goals, 3])
    listed = rows_listed(n, n_goals, loss)
    agents = [Agent(k, n, row, range(n_goals), listed=listed) for k, row in enumerate(costs)]
    inboxes: list[list[bytes]] = [[] for _ in agents]
    sent, sent_to_decide, clashes = 0, 0, 0
    for step in range(MOST_STEPS):
        arriving: list[list[bytes]] = [[] for _ in agents]
        for k, agent in enumerate(agents):
            for data in agent.step(inboxes[k], step * STEP_S):
                for to in sorted({(k - 1) % n, (k + 1) % n} - {k}):
                    sent += len(data)
                    if random.random() >= loss:
                        arriving[to].append(data)
        inboxes = arriving
        if any(agent.choice is None for agent in agents):
            sent_to_decide = sent
        held = [agent.animal for agent in agents if agent.animal >= 0]
        clashes += len(held) != len(set(held))
        if all(agent.certified for agent in agents):
            break
    rows, columns = linear_sum_assignment(costs)
    chosen = [agent.animal for agent in agents]
    cost = sum(costs[k, animal] for k, animal in enumerate(chosen) if animal >= 0)
    complete = all(agent.certified for agent in agents) and min(chosen) >= 0
    quality = float(costs[rows, columns].sum() / cost) if complete else 0.0
    seconds = step * STEP_S if complete else float("inf")
    return seconds, sent_to_decide / n, sent / n, quality, clashes


def time_rows(seed: int, *, quick: bool = False) -> Iterator[Row]:
    """Times of this machine, and as ratios to solving one table of 60 x 60, which every machine can time."""
    random = np.random.default_rng([seed, 4])
    unit_table = random.random((60, 60))
    unit_ms = _least_ms(lambda: linear_sum_assignment(unit_table), 50)
    yield Row("unit of the ratios below: one 60 x 60 table solved", 50, str(seed), f"{unit_ms:.3f} ms")
    costs = random.random((5, 10))
    for method in METHODS:
        each_ms, calls = _round_ms(method, costs, 10 if quick else 50)
        floor = "<= 0.2 ms" if method.startswith("gnn") else ""
        passed = each_ms <= 0.2 if floor else None
        yield Row(
            f"one agent's round, {method}, n_g = 10",
            calls,
            str(seed),
            _time(each_ms, unit_ms),
            floor,
            "",
            passed,
        )
    count = 200 if quick else 5000
    many = random.random((count, 5, 10))
    for method in METHODS:
        took_ms = _least_ms(lambda method=method: assign_many(many, method), 1)  # type: ignore[misc]
        name = f"{count} cases at once, {method}, 5 agents, 10 goals"
        yield Row(name, count, str(seed), _time(took_ms, unit_ms), "<= 10 s", "", took_ms <= 10_000)
    codes = cost_codes(random.random((100, 200)))
    solve_ms = _least_ms(lambda: solve_table(codes), 10)
    name = "one agent solves the table of 100 agents, 200 goals"
    yield Row(name, 10, str(seed), _time(solve_ms, unit_ms), "<= 5 ms", "", solve_ms <= 5.0)


def _round_ms(method: Method, costs: NDArray[np.float64], times: int) -> tuple[float, int]:
    """The least time of one agent's step, messages handed over, over some runs of a ring -> (ms, steps a
    run).
    """
    n = len(costs)
    taken, steps = [], 0
    for _ in range(times):
        agents = [agent_for(method, row, k, n) for k, row in enumerate(costs)]
        rounds = agents[0].rounds
        steps = n * (rounds + 1)
        arrives = np.ones((rounds, 2, 2, n), dtype=bool)
        began = time.perf_counter()
        talk(agents, arrives)
        taken.append(time.perf_counter() - began)
    return 1e3 * min(taken) / steps, steps


def _least_ms(work: Callable[[], object], times: int) -> float:
    """The least of some runs: what else the machine does only adds."""
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        work()
        taken.append(time.perf_counter() - began)
    return 1e3 * min(taken)


def _time(took_ms: float, unit_ms: float) -> str:
    return f"{took_ms:.3f} ms (x {took_ms / unit_ms:.2f})"


def rule_rows(rings: LargeRings) -> Iterator[Row]:
    """What the rule picks, and whether the learned methods' measured figures bear it out."""
    for n in RULE_SIZES:
        n_animals = round(RATIOS[1] * n)
        for loss in (0.0, 0.2):
            chosen = plan(n, n_animals, loss)
            sent = ", ".join(f"{name} {value:.0f}" for name, value in chosen.bytes_needed.items())
            name = f"the rule, {n} drones, {n_animals} animals, {100 * loss:.0f} % lost: bytes / D"
            yield Row(name, 1, "-", f"{chosen.method}, {chosen.listed} listed ({sent})")
    at_five = {
        (point.method, point.n_agents, point.n_goals): point.scores
        for point in rings.points
        if point.budget == AT_FIVE
    }
    for method, sizes in DISTINCT.items():
        for n, shares in sizes.items():
            for ratio, share in zip(RATIOS, shares, strict=True):
                scores = at_five.get((method, n, round(ratio * n)))
                if scores is None:
                    continue
                name = f"the rule's share of distinct answers, {method}, n = {n}, n_g = {round(ratio * n)}"
                figure = f"{100 * share:.1f} % (measured {100 * scores.distinct:.1f} %)"
                near = abs(share - scores.distinct) <= SHARE_TOLERANCE
                yield Row(name, 1, str(rings.measures.seed), figure, "within 5 points", "", near)
    yield from _verdicts(at_five, rings)


def _verdicts(at_five: dict[tuple[str, int, int], Scores], rings: LargeRings) -> Iterator[Row]:
    """A learned mode that loses to both flooding and the nearest-top-3 line must not be the default."""
    for method in ("gnn", "gnn+resolve"):
        for (name, n, n_goals), scores in at_five.items():
            if name != method:
                continue
            flooded, nearest = at_five[("flooding", n, n_goals)], at_five[("nearest top 3", n, n_goals)]
            words = [
                f"{word} {other}"
                for other, theirs in (("flooding", flooded), ("nearest top 3", nearest))
                for word in ["beats" if scores.quality > theirs.quality else "does not beat"]
            ]
            loses = all(word.startswith("does") for word in words)
            flies = plan(n, n_goals).method == method
            yield Row(
                f"{method} at 5 rounds by Q0, n = {n}, n_g = {n_goals}",
                1,
                str(rings.measures.seed),
                ", ".join(words),
                "not the default where it loses to both",
                "",
                not (loses and flies),
            )
