"""The table that every benchmark prints: one row a promise, MISSING where there is no figure."""

import json
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

__all__ = ["Row", "bench_console", "measured", "print_table", "write_table"]

PRINTED_WIDTH = 150  # in a file or a pipe


@dataclass(frozen=True)
class Row:
    """One line of the table. floor: what must be met; aim: what is hoped for."""

    name: str
    n: int
    seed: str
    figure: str | None  # None: MISSING
    floor: str = ""
    aim: str = ""
    passed: bool | None = None  # of the floor; None where there is none
    why: str = ""  # said below the table


def bench_console() -> Console:
    """Where a benchmark prints: as wide as the terminal, and wide enough where there is none."""
    return Console(width=None if sys.stdout.isatty() else PRINTED_WIDTH)


def measured(rows: Iterable[Row], name: str) -> list[Row]:
    """All rows of one part of a benchmark; what it raises becomes a row that is MISSING, so that the other
    parts are measured still.
    """
    taken: list[Row] = []
    try:
        taken.extend(rows)
    except Exception as error:  # whatever fell, the table must say so
        taken.append(Row(name, 0, "-", None, why=f"{type(error).__name__}: {error}"))
    return taken


def print_table(title: str, rows: list[Row], console: Console) -> None:
    """The rows in their order; reasons below."""
    table = Table(title=title, title_justify="left")
    headings = ["what", "n", "seed", "floor", "aim", "figure", "pass"]
    if not any(row.aim for row in rows):
        headings.remove("aim")
    for heading in headings:
        table.add_column(heading, overflow="fold")
    words = {True: "yes", False: "[bold red]no[/]", None: ""}
    for row in rows:
        cells = {
            "what": row.name,
            "n": str(row.n),
            "seed": row.seed,
            "floor": row.floor,
            "aim": row.aim,
            "figure": row.figure if row.figure is not None else "[bold red]MISSING[/]",
            "pass": words[row.passed if row.figure is not None else None],
        }
        table.add_row(*(cells[heading] for heading in headings))
    console.print(table)
    for row in rows:
        if row.why:
            console.print(f"{row.name}: {row.why}", highlight=False, markup=False)


def write_table(path: Path, rows: list[Row]) -> None:
    """The same as JSON, for other tools."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")
