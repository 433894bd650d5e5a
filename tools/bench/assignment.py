"""`podwatch bench assignment`: who takes which animal, measured against what was promised and against other
ways.

Cases are uniform points on the unit square, agents in ring order by angle round the middle
(assignment_cases.py). In every figure D is the share of cases in which all goals are distinct, O1 the share
of agents that agree with the optimum, Q0 the mean of optimum / cost with 0 where not distinct, and "exact"
the share of whole answers that are optimal. Learned methods are judged by the worst of their training
seeds.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from tools.bench import assignment_bars as bars
from tools.bench import assignment_flight as flight
from tools.bench import assignment_large as large
from tools.bench.assignment_figures import draw
from tools.bench.table import Row, bench_console, measured, print_table, write_table

__all__ = ["command"]

Part = tuple[str, Callable[[], Iterator[Row]]]

FIVE, EXACT, LOSSY, HONEST = "five agents, five rounds", "exact", "whole tables under loss", "is_distinct"
LARGER, LOSS, FLIGHT, TIME, RULE = "larger rings", "loss", "the exchange in flight", "time", "what flies"
QUICK_CASES = 200  # a size
PRINTED = (FIVE, EXACT, LOSSY, HONEST, LARGER, LOSS, FLIGHT, TIME, RULE)


def command(seed: int, cases: int, out: Path, *, quick: bool) -> None:
    """Measure all, then print one table a part, write bench_assignment.json and the figures.

    cases: of each size up to 12 agents. quick: few cases a size, for a look and for tests.
    """
    console = bench_console()
    count = min(cases, QUICK_CASES) if quick else cases
    measures = bars.Measures(seed, count)
    rings = large.LargeRings(seed, quick=quick)
    # What all runs said of themselves is known only after them.
    parts: list[Part] = [
        (FIVE, lambda: bars.five_agents(measures)),
        (EXACT, lambda: bars.exact_rows(measures, quick=quick)),
        (LOSSY, lambda: bars.lossy_tables(measures)),
        (LARGER, rings.rows),
        (LOSS, rings.loss_rows),
        (HONEST, lambda: bars.honest_rows([measures, rings.measures])),
        (FLIGHT, lambda: flight.exchange_rows(seed, quick=quick)),
        (TIME, lambda: flight.time_rows(seed, quick=quick)),
        (RULE, lambda: flight.rule_rows(rings)),
    ]
    taken: dict[str, list[Row]] = {}
    for name, measure in parts:
        with console.status(name):
            taken[name] = measured(measure(), name)
    rows: list[Row] = []
    for name in PRINTED:
        print_table(f"podwatch bench assignment: {name}", taken[name], console)
        rows += taken[name]
    write_table(out / "bench_assignment.json", rows)
    for path in draw(rings.points, out):
        console.print(f"Figure: {path}", highlight=False)
