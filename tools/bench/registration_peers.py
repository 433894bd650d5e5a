"""Other methods on the same pairs: the paper's algorithm, from one heading and from 36, ICP on centres, and
coherent point drift.

All but the paper's own get centred and scaled input: boxes about the mean of their centres, in units of the
centres' root mean square distance from it. What ICP and point drift leave is matched by one assignment, in
which a pair further apart than half the usual distance between neighbours is no match; the paper's algorithm
has no such rule and gets none.
"""

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from procs.registrar._literal import corner_costs, corners_of
from tools.bench.registration_pairs import pair_counts
from tools.bench.registration_scenes import Cell, draw_views, trial_rng, true_matches

__all__ = ["METHODS", "peer_counts", "peer_key", "peer_matches", "peer_table"]

Array = NDArray[np.float64]
Matches = set[tuple[int, int]]

ROUNDS = 60  # of an ICP, or of the literal algorithm
HEADINGS = 36
SETTLED = 1e-4  # a round that lowers the cost by no more than this share is the last
ORDERS = np.array(list(permutations(range(4))))  # (24, 4): a corner of the partner for each corner


def _normalised(boxes: Array) -> tuple[Array, float]:
    """(N, 4) boxes -> themselves, centred and scaled by their centres; and the usual distance between
    neighbours.
    """
    centres = (boxes[:, :2] + boxes[:, 2:]) / 2
    middle = centres.mean(axis=0)
    scale = max(float(np.sqrt(((centres - middle) ** 2).sum(axis=1).mean())), 1e-9)
    apart = cdist(centres, centres) + np.diag(np.full(len(boxes), np.inf))
    nearest = float(np.median(apart.min(axis=1))) / scale if len(boxes) > 1 else 1.0
    return (boxes - np.tile(middle, 2)) / scale, nearest


def _centres(boxes: Array) -> Array:
    return np.asarray((boxes[:, :2] + boxes[:, 2:]) / 2)


def _assigned(moved: Array, target: Array, neighbours_apart: float) -> Matches:
    """Matches of source centres as a method moved them, within half the distance between neighbours."""
    distance = cdist(moved, target)
    rows, columns = linear_sum_assignment(distance)
    near = distance[rows, columns] <= neighbours_apart / 2
    return set(zip(rows[near].tolist(), columns[near].tolist(), strict=True))


def _similarity(source: Array, target: Array) -> tuple[Array, Array]:
    """Linear part (2, 2) and shift (2,) of the least-squares similarity of paired points (Umeyama 1991)."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(b.T @ a)
    flip = np.array([1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((singular * flip).sum() / max(float((a**2).sum()), 1e-12))
    linear = scale * (u * flip) @ vt
    return linear, target_mean - linear @ source_mean


def _icp(source: Array, target: Array, apart: float) -> Matches:
    """Iterative closest point on centres, with a similarity, from the identity."""
    goals, moved = _centres(target), _centres(source)
    previous: list[int] = []
    for _ in range(ROUNDS):
        nearest = cdist(moved, goals).argmin(axis=1)
        if nearest.tolist() == previous:
            break
        previous = nearest.tolist()
        linear, shift = _similarity(moved, goals[nearest])
        moved = moved @ linear.T + shift
    return _assigned(moved, goals, apart)


def _drift(source: Array, target: Array, apart: float, kind: str) -> Matches:
    """Coherent point drift (Myronenko and Song 2010) on centres, as pycpd has it."""
    import pycpd

    method = {"rigid": pycpd.RigidRegistration, "affine": pycpd.AffineRegistration}[kind]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # two points leave its matrices singular: then it just fails
        try:
            moved, _ = method(X=_centres(target), Y=_centres(source)).register()
        except (np.linalg.LinAlgError, ValueError):
            return set()
    return _assigned(moved, _centres(target), apart) if np.isfinite(moved).all() else set()


def _best_corners(corners: Array, goals: Array) -> Array:
    """(K, 4, 2) corners of K boxes and of their partners -> the partners' in the order that lies nearest."""
    distances = np.linalg.norm(corners[:, :, None] - goals[:, None], axis=3)  # (K, 4, 4)
    totals = distances[:, np.arange(4), ORDERS].sum(axis=2)  # (K, 24)
    return np.take_along_axis(goals, ORDERS[totals.argmin(axis=1)][:, :, None], axis=1)


def _literal_from(corners: Array, goals: Array) -> tuple[float, Matches]:
    """The paper's algorithm on (N, 4, 2) corners, from where they are -> its last cost and matches."""
    previous: list[int] = []
    total = np.inf
    for _ in range(ROUNDS):
        costs = corner_costs(corners, goals)[0]
        rows, columns = linear_sum_assignment(costs)
        is_settled = columns.tolist() == previous and costs[rows, columns].sum() > total * (1 - SETTLED)
        previous, total = columns.tolist(), float(costs[rows, columns].sum())
        if is_settled:
            break
        points = corners[rows].reshape(-1, 2)
        wanted = _best_corners(corners[rows], goals[columns]).reshape(-1, 2)
        design = np.column_stack([points, np.ones(len(points))])
        step = np.linalg.lstsq(design, wanted, rcond=None)[0]
        corners = corners @ step[:2] + step[2]
    return total, set(zip(rows.tolist(), columns.tolist(), strict=True))


def _literal_36(source: Array, target: Array, apart: float) -> Matches:
    """The paper's algorithm from 36 starting headings; the least cost wins."""
    corners, goals = corners_of(source), corners_of(target)
    runs = []
    for angle in np.arange(HEADINGS) * 2 * np.pi / HEADINGS:
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        runs.append(_literal_from(corners @ turn, goals))
    return min(runs, key=lambda run: run[0])[1]


PEERS: dict[str, Callable[[Array, Array, float], Matches]] = {
    "literal from 36 headings": _literal_36,
    "ICP on centres": _icp,
    "CPD rigid": lambda source, target, apart: _drift(source, target, apart, "rigid"),
    "CPD affine": lambda source, target, apart: _drift(source, target, apart, "affine"),
}
OURS, LITERAL = "ours", "literal (paper)"
METHODS = (OURS, LITERAL, *PEERS)


def peer_matches(peer: str, source: Array, target: Array) -> Matches:
    """What a peer, one of PEERS, makes of (N1, 4) and (N2, 4) boxes px."""
    if not len(source) or not len(target):
        return set()
    first, _ = _normalised(source)
    second, apart = _normalised(target)
    return PEERS[peer](first, second, apart)


def peer_counts(method: str, cell: Cell, seed: int, trials: Iterable[int]) -> Counter[str]:
    """Over these trials: pairs `n`, all matches `right`, and `microseconds` of the method alone."""
    if method not in PEERS:
        return pair_counts(replace(cell, literal=method == LITERAL), seed, trials)
    counts: Counter[str] = Counter()
    for trial in trials:
        source, target = draw_views(cell, trial_rng(seed, cell.name, trial))
        began = time.process_time()
        got = peer_matches(method, source.boxes, target.boxes)
        counts["microseconds"] += round(1e6 * (time.process_time() - began))
        counts.update(n=1, right=got == set(true_matches(source, target)))
    return counts


def peer_key(method: str, name: str) -> str:
    """Under which the counts of a method on a cell are kept."""
    return f"{method} | {name}"


def peer_table(counts: Mapping[str, Counter[str]], cells: Sequence[Cell], timed: Sequence[str]) -> Table:
    """Percent of pairs with all matches right, a line a cell and a column a method; below, the mean time of a
    pair in the cells named `timed`. What was not measured is MISSING.
    """
    table = Table(title="peers on the same pairs: all matches right, %", title_justify="left")
    table.add_column("what", overflow="fold")
    for heading in ("n", *METHODS):
        table.add_column(heading, justify="right")
    for cell in cells:
        found = [counts.get(peer_key(method, cell.name), Counter()) for method in METHODS]
        shares = [f"{100 * one['right'] / one['n']:.0f}" if one["n"] else "MISSING" for one in found]
        table.add_row(cell.name, str(max(one["n"] for one in found)), *shares)
    table.add_section()
    for name in timed:
        found = [counts.get(peer_key(method, name), Counter()) for method in METHODS]
        times = [f"{one['microseconds'] / one['n'] / 1e3:.1f}" if one["n"] else "MISSING" for one in found]
        table.add_row(f"ms a pair, {name}", str(max(one["n"] for one in found)), *times)
    return table
