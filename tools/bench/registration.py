"""`podwatch bench registration`: how often registration is right, cell by cell, beside what is promised.

Every trial has a generator of its own, made from the seed, the cell's name and the trial's number: so a cell
gives the same figure alone and among all, on one processor and on many.
"""

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from tools.bench import registration_figure as figure
from tools.bench.registration_cells import EPISODES, PAIRS, PROMISES, RINGS, row_of
from tools.bench.registration_pairs import pair_counts, pair_success
from tools.bench.registration_peers import METHODS, peer_counts, peer_key, peer_table
from tools.bench.registration_pixels import pixel_rows
from tools.bench.registration_rings import episode_counts, is_ring_right, ring_counts, ring_success
from tools.bench.registration_scenes import CAMERA, IMAGE_SIZE, Cell, View, draw_views
from tools.bench.registration_speed import speed_rows
from tools.bench.table import Row, measured, print_table, write_table

__all__ = [
    "CAMERA",
    "IMAGE_SIZE",
    "PAIRS",
    "RINGS",
    "Cell",
    "View",
    "command",
    "draw_views",
    "is_ring_right",
    "pair_success",
    "ring_success",
]

MOST_PEER_PAIRS = 100
RINGS_A_SEQUENCE = 4  # a sequence of episodes costs about as much as this many rings
TIMED = ("full view N=5", "full view N=9", "full view N=20")
SPEED, PEERS, FIGURE, PIXELS = "speed", "peers", "figure", "real pixels"
PRINTED_WIDTH = 150  # in a file or a pipe
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

Counting = Callable[..., Counter[str]]


@dataclass(frozen=True)
class Task:
    """A few trials of one cell; `key` is whose counts they add to."""

    key: str
    count: Counting
    arguments: tuple[object, ...]
    trials: range


@dataclass
class Found:
    """What all tasks of one key came to."""

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)


def run_task(task: Task) -> Counter[str]:
    """In a process of its own."""
    return task.count(*task.arguments, task.trials)


def command(pairs: int, rings: int, seed: int, only: str, out: Path) -> None:
    """Measure, print the tables, write them as JSON and the figures as PNG into `out`."""
    console = Console(width=None if sys.stdout.isatty() else PRINTED_WIDTH)
    began = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    promises = [promise for promise in PROMISES if only.lower() in promise.name.lower()]
    parts = [part for part in (SPEED, PEERS, FIGURE, PIXELS) if only.lower() in part]
    wanted = dict.fromkeys(cell for promise in promises for cell in promise.cells)
    tasks = [*_promised_tasks(wanted, pairs, rings, seed)]
    peer_pairs = min(pairs, MOST_PEER_PAIRS)
    if PEERS in parts:
        tasks += _peer_tasks([(cell.name, cell) for cell in PAIRS], METHODS, peer_pairs, seed)
    if FIGURE in parts:
        points = [(point.key, point.cell) for point in figure.POINTS]
        tasks += _peer_tasks(points, METHODS, peer_pairs, seed)
    for name in ONE_THREAD:
        os.environ[name] = "1"  # before the processes start: each is one of as many as there are processors
    found = _count_all(tasks, console)
    rows = [row_of(promise, seed, *_together(found, promise.cells)) for promise in promises]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
        if SPEED in parts:
            rows += alone.submit(_all_speed_rows, seed).result()
        if PIXELS in parts:
            with console.status(PIXELS):
                rows += alone.submit(_all_pixel_rows, seed, out).result()
    print_table("podwatch bench registration", rows, console)
    write_table(out / "bench_registration.json", rows)
    counts = {key: one.counts for key, one in found.items()}
    if PEERS in parts:
        console.print(peer_table(counts, PAIRS, TIMED))
    if FIGURE in parts:
        figure.draw(counts, peer_pairs, seed).savefig(out / "registration_axes.png")
    console.print(f"{time.monotonic() - began:.0f} s; tables and figures in {out}", highlight=False)


def _all_speed_rows(seed: int) -> list[Row]:
    return measured(speed_rows(seed), SPEED)


def _all_pixel_rows(seed: int, out: Path) -> list[Row]:
    return measured(pixel_rows(seed, out), PIXELS)


def _in_chunks(key: str, count: Counting, arguments: tuple[object, ...], n: int, size: int) -> Iterator[Task]:
    for start in range(0, n, size):
        yield Task(key, count, arguments, range(start, min(start + size, n)))


def _promised_tasks(wanted: Iterable[str], pairs: int, rings: int, seed: int) -> Iterator[Task]:
    """The longest first, so that no processor waits for one at the end."""
    chosen = set(wanted)
    if EPISODES.name in chosen:
        sequences = -(-rings // RINGS_A_SEQUENCE)
        yield from _in_chunks(EPISODES.name, episode_counts, (EPISODES, seed), sequences, 5)
    for cell in RINGS:
        if cell.name in chosen:
            yield from _in_chunks(cell.name, ring_counts, (cell, seed), rings, 10)
    for cell in PAIRS:
        if cell.name in chosen:
            yield from _in_chunks(cell.name, pair_counts, (cell, seed), pairs, 50)


def _peer_tasks(
    cells: Iterable[tuple[str, Cell]], methods: Iterable[str], pairs: int, seed: int
) -> Iterator[Task]:
    for name, cell in cells:
        for method in methods:
            key = peer_key(method, name)
            yield from _in_chunks(key, peer_counts, (method, cell, seed), pairs, 50)


def _count_all(tasks: list[Task], console: Console) -> dict[str, Found]:
    """All tasks in as many processes as there are processors, with a line of progress."""
    found: dict[str, Found] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        Progress(*columns, console=console, transient=True) as progress,
        ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool,
    ):
        line = progress.add_task("registration", total=len(tasks))
        running: dict[Future[Counter[str]], Task] = {pool.submit(run_task, task): task for task in tasks}
        for future in as_completed(running):
            task = running[future]
            one = found.setdefault(task.key, Found())
            error = future.exception()
            if error is None:
                one.counts.update(future.result())
            else:
                one.failures.append(f"{type(error).__name__}: {error}")
            progress.update(line, advance=1, description=task.key[:40])
    return found


def _together(found: dict[str, Found], cells: Iterable[str]) -> tuple[Counter[str], list[str]]:
    counts: Counter[str] = Counter()
    failures: list[str] = []
    for cell in cells:
        one = found.get(cell, Found(failures=[f"{cell} was not measured"]))
        counts.update(one.counts)
        failures += one.failures
    return counts, failures
