"""`podwatch bench registration`: how often registration is right, cell by cell, beside what is promised.

Every trial has a generator of its own, made from the seed, the cell's name and the trial's number: so a cell
gives the same figure alone and among all, on one processor and on many.
"""

import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from tools.bench.registration_cells import EPISODES, MONITOR, PAIRS, PROMISES, RINGS, row_of
from tools.bench.registration_monitor import monitor_counts
from tools.bench.registration_pairs import pair_counts, pair_success
from tools.bench.registration_peers import METHODS, peer_counts, peer_key, peer_table
from tools.bench.registration_rings import episode_counts, is_ring_right, ring_counts, ring_success
from tools.bench.registration_scenes import CAMERA, IMAGE_SIZE, Cell, View, draw_views, true_matches
from tools.bench.registration_speed import speed_rows
from tools.bench.registration_tasks import Task, count_all, in_chunks, rows_of_part, together
from tools.bench.table import Row, bench_console, print_table, write_table

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
    "true_matches",
]

MOST_PEER_PAIRS = 100
RINGS_A_SEQUENCE = 4  # a sequence of episodes costs about as much as this many rings
TIMED = ("full view N=5", "full view N=9", "full view N=20")
SPEED, PEERS, FIGURE, PIXELS = "speed", "peers", "figure", "real pixels"


def command(pairs: int, rings: int, seed: int, only: str, out: Path) -> None:
    """Measure, print the tables, write the rows as JSON and the figures as PNG into `out`."""
    console = bench_console()
    began = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    promises = [promise for promise in PROMISES if only.lower() in promise.name.lower()]
    parts = [part for part in (SPEED, PEERS, FIGURE, PIXELS) if only.lower() in part]
    wanted = dict.fromkeys(cell for promise in promises for cell in promise.cells)
    peer_pairs = min(pairs, MOST_PEER_PAIRS)
    tasks = [*_promised_tasks(wanted, pairs, rings, seed)]
    if PEERS in parts:
        tasks += _peer_tasks(PAIRS, peer_pairs, seed)
    if FIGURE in parts:
        tasks += _peer_tasks(_figure_cells(), peer_pairs, seed)
    found = count_all(tasks, console)
    rows = [row_of(promise, seed, *together(found, promise.cells)) for promise in promises]
    if SPEED in parts:
        rows += rows_of_part(SPEED, speed_rows, seed)
    if PIXELS in parts:
        with console.status(PIXELS):
            rows += _pixel_rows(seed, out)
    if rows:
        print_table("podwatch bench registration", rows, console)
    write_table(out / "bench_registration.json", rows)
    counts = {key: one.counts for key, one in found.items()}
    if PEERS in parts:
        console.print(peer_table(counts, PAIRS, TIMED))
    if FIGURE in parts:
        from tools.bench.registration_figure import draw

        draw(counts, peer_pairs, seed).savefig(out / "registration_axes.png")
    console.print(f"{time.monotonic() - began:.0f} s; tables and figures in {out}", highlight=False)


def _figure_cells() -> list[Cell]:
    from tools.bench.registration_figure import POINTS

    return [point.cell for point in POINTS]


def _pixel_rows(seed: int, out: Path) -> list[Row]:
    from tools.bench.registration_pixels import pixel_rows

    return rows_of_part(PIXELS, pixel_rows, seed, out)


def _promised_tasks(wanted: Iterable[str], pairs: int, rings: int, seed: int) -> Iterator[Task]:
    """The longest first, so that no processor waits for one at the end."""
    chosen = set(wanted)
    if EPISODES.name in chosen:
        sequences = -(-rings // RINGS_A_SEQUENCE)
        yield from in_chunks(EPISODES.name, episode_counts, (EPISODES, seed), sequences, 5)
    for cell in RINGS:
        if cell.name in chosen:
            yield from in_chunks(cell.name, ring_counts, (cell, seed), rings, 10)
    for cell in PAIRS:
        if cell.name in chosen:
            yield from in_chunks(cell.name, pair_counts, (cell, seed), pairs, 50)
    if MONITOR.name in chosen:
        yield from in_chunks(MONITOR.name, monitor_counts, (MONITOR, seed), rings, 25)


def _peer_tasks(cells: Iterable[Cell], pairs: int, seed: int) -> Iterator[Task]:
    """Every method on every cell, on the cell's first pairs."""
    for cell in cells:
        for method in METHODS:
            yield from in_chunks(peer_key(method, cell.name), peer_counts, (method, cell, seed), pairs, 50)
