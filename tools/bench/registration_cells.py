"""What registration is measured by: the cells, and what is promised of each, in the order of the table.

Where a promise can be read in two ways the harder one is taken; docs/registration.md says which.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tools.bench.registration_scenes import LAYOUTS, Cell
from tools.bench.table import Row

__all__ = ["EPISODES", "MONITOR", "PAIRS", "PROMISES", "RINGS", "Promise", "row_of"]

DEG = float(np.pi / 180)

LITERAL = Cell(
    "literal mode, heading 15, shear 0.2, jitter 2 %, N=9",
    9,
    heading_rad=15 * DEG,
    shear=0.2,
    jitter=0.02,
    full_view=True,
    literal=True,
)
FULL = tuple(Cell(f"full view N={n}", n, full_view=True) for n in (5, 9, 20))
FEW = (
    Cell("full view N=3", 3, full_view=True),
    Cell("full view N=2", 2, full_view=True),
    Cell("full view N=2, heading prior", 2, full_view=True, heading_prior=True),
)
TILTED = tuple(
    Cell(f"tilt 20, jitter 10 %, N={n}", n, tilt_rad=20 * DEG, jitter=0.1, full_view=True) for n in (5, 9)
)
SYMMETRIC = tuple(
    Cell(f"near-symmetric layout: {layout}, N=6", 6, layout=layout, full_view=True) for layout in LAYOUTS
)
MOVED = tuple(Cell(f"moved {moved:g} lengths, N=9", 9, moved=moved) for moved in (0.5, 1.0, 2.0))
MISSED_10 = Cell("10 % missed, 5 % false, N=9", 9, missed=0.1, false=0.05)
MISSED_20 = tuple(Cell(f"20 % missed, 10 % false, N={n}", n, missed=0.2, false=0.1) for n in (5, 9, 20))
SHIFTED = tuple(
    Cell(f"shifted {100 * shift:.0f} %, N=12", 12, shift=shift, false=0.0) for shift in (0.1, 0.25, 0.5)
)
COMBINED = Cell(
    "10 % missed, 5 % false, moved 0.25, tilt 15, N=9",
    9,
    missed=0.1,
    false=0.05,
    moved=0.25,
    tilt_rad=15 * DEG,
)
PAIRS = (LITERAL, *FULL, *FEW, *TILTED, *SYMMETRIC, *MOVED, MISSED_10, *MISSED_20, *SHIFTED, COMBINED)

FULL_RINGS = tuple(Cell(f"ring, full view N=9 n={n}", 9, n_views=n, full_view=True) for n in (3, 6, 12))
HARD_RINGS = (
    Cell("ring, 5 % missed, 2 % false, N=9 n=20", 9, n_views=20, missed=0.05, false=0.02),
    Cell("ring, 10 % missed, 5 % false, N=9 n=12", 9, n_views=12, missed=0.1, false=0.05),
    Cell("ring, jitter 10 %, N=3 n=6", 3, n_views=6, jitter=0.1, full_view=True),
)
RINGS = (*FULL_RINGS, *HARD_RINGS)
EPISODES = Cell("10 episodes, moved 0.5 each, one away for 3, N=9 n=5", 9, n_views=5, full_view=True)
MONITOR = Cell("MONITOR, pose error 1.5 m and 5 degrees", 7, n_views=5)


@dataclass(frozen=True)
class Promise:
    """One row of the table: the share `what` of `of` in percent, over the counts of all its cells."""

    name: str
    cells: tuple[str, ...]
    floor: float
    aim: float
    what: str = "right"
    of: str = "n"
    at_most: bool = False


def _each(cells: Sequence[Cell], floors: Sequence[float], aims: Sequence[float]) -> list[Promise]:
    return [
        Promise(cell.name, (cell.name,), floor, aim)
        for cell, floor, aim in zip(cells, floors, aims, strict=True)
    ]


def _named(cells: Sequence[Cell]) -> tuple[str, ...]:
    return tuple(cell.name for cell in cells)


ROBUST_PAIRS = tuple(cell for cell in PAIRS if not cell.literal)
PROMISES = (
    *_each([LITERAL], [99], [100]),
    *_each(FULL, [99.5] * 3, [99.9] * 3),
    *_each(FEW, [99, 93, 99], [99.7, 95, 99.5]),
    *_each(TILTED, [97, 99], [99, 99.8]),
    *_each(SYMMETRIC, [98.5] * 4, [99.5] * 4),
    *_each(MOVED, [98, 92, 55], [99.5, 97, 70]),
    *_each([MISSED_10], [96], [98.5]),
    Promise(f"{MISSED_10.name}: precision", (MISSED_10.name,), 98.5, 98.5, "true_found", "found"),
    Promise(f"{MISSED_10.name}: recall", (MISSED_10.name,), 98.5, 98.5, "true_found", "true_total"),
    *_each(MISSED_20, [72, 84, 90], [82, 92, 97]),
    *_each(SHIFTED, [89, 86, 62], [97, 95, 88]),
    *_each([COMBINED], [90], [95]),
    *_each(RINGS, [99, 99, 99, 88, 80, 85], [99.9, 99.9, 99.9, 97, 93, 95]),
    Promise(
        "right full-view rings that consensus proves", _named(FULL_RINGS), 95, 99, what="proved", of="right"
    ),
    Promise(
        f"{EPISODES.name}: identity switches per 100 animals and episodes",
        (EPISODES.name,),
        *(2, 0.2, "switches", "sightings"),
        at_most=True,
    ),
    Promise(f"{MONITOR.name}: right matches", (MONITOR.name,), 98, 99.5, of="boxes"),
    Promise(
        "a wrong full-view ring called consensus, of those called",
        _named(FULL_RINGS),
        *(1, 0.1, "wrongly_called", "called"),
        at_most=True,
    ),
    Promise(
        "a pair wrong at confidence >= 0.9, of all pairs at it",
        _named(ROBUST_PAIRS),
        *(1.5, 0.5, "sure_wrong", "sure"),
        at_most=True,
    ),
)


def row_of(promise: Promise, seed: int, counts: Counter[str], failures: Sequence[str]) -> Row:
    """The promise's row from the counts of its cells; MISSING where nothing could be counted."""
    sign = "<=" if promise.at_most else ">="
    row = Row(
        promise.name,
        counts[promise.of],
        str(seed),
        None,
        f"{sign} {promise.floor:g} %",
        f"{sign} {promise.aim:g} %",
        why="; ".join(dict.fromkeys(failures)),
    )
    if failures or not counts[promise.of]:
        return replace(row, why=row.why or "nothing was counted")
    share = 100 * counts[promise.what] / counts[promise.of]
    passed = share <= promise.floor if promise.at_most else share >= promise.floor
    return replace(row, figure=f"{share:.{1 if counts[promise.of] <= 1000 else 2}f} %", passed=passed)
