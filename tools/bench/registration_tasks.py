"""Trials spread over processes: counts add up, and whatever falls is told in place of a figure.

Light to import, since every process imports it: what a task calls brings its own libraries.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from tools.bench.table import Row, measured

__all__ = ["Found", "Task", "count_all", "in_chunks", "rows_of_part", "together"]

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Task:
    """A few trials: `count(*arguments, trials)`; `key` is whose counts they add to."""

    key: str
    count: Callable[..., Counter[str]]
    arguments: tuple[object, ...]
    trials: range


@dataclass
class Found:
    """What all tasks of one key came to."""

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)


def in_chunks(
    key: str, count: Callable[..., Counter[str]], arguments: tuple[object, ...], n: int, size: int
) -> Iterator[Task]:
    """The tasks of n trials, `size` at a time."""
    for start in range(0, n, size):
        yield Task(key, count, arguments, range(start, min(start + size, n)))


def _pool(processes: int | None) -> ProcessPoolExecutor:
    """Fresh processes of one thread each: a fork would take over threads, and not these settings."""
    for name in ONE_THREAD:
        os.environ[name] = "1"
    return ProcessPoolExecutor(processes, mp_context=get_context("spawn"))


def count_all(tasks: list[Task], console: Console) -> dict[str, Found]:
    """All tasks in as many processes as there are processors, with a line of progress."""
    found: dict[str, Found] = {}
    if not tasks:
        return found
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        Progress(*columns, console=console, transient=True) as progress,
        _pool(os.cpu_count()) as pool,
    ):
        line = progress.add_task("registration", total=len(tasks))
        running: dict[Future[Counter[str]], Task] = {
            pool.submit(task.count, *task.arguments, task.trials): task for task in tasks
        }
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


def together(found: Mapping[str, Found], keys: Iterable[str]) -> tuple[Counter[str], list[str]]:
    """The counts of several keys as one, and what fell of any."""
    counts: Counter[str] = Counter()
    failures: list[str] = []
    for key in keys:
        one = found.get(key, Found(failures=[f"{key} was not measured"]))
        counts.update(one.counts)
        failures += one.failures
    return counts, failures


def rows_of_part(name: str, measure: Callable[..., Iterable[Row]], *arguments: Any) -> list[Row]:
    """The rows of a part that needs a processor for itself, from a process of its own."""
    with _pool(1) as alone:
        return alone.submit(_rows_of_part, name, measure, arguments).result()


def _rows_of_part(name: str, measure: Callable[..., Iterable[Row]], arguments: tuple[Any, ...]) -> list[Row]:
    return measured(measure(*arguments), name)
