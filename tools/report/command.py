"""`podwatch report`: one page for a mission or a day of several, from runs or from drones' logs."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tools.errors import plain_errors

if TYPE_CHECKING:
    from tools.report.flights import Flight

__all__ = ["report"]


def report(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN-or-LOGS...",
            help="Runs' folders, a folder of them for a day, or drones' logs of one mission. Logs of several "
            "boots of a drone are as many missions.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="The page to write.",
            show_default="report.html in the mission's folder, or here for a day; logs_report.html beside "
            "logs that are given by name",
        ),
    ] = None,
) -> None:
    """Make report.html: what went wrong, where all flew, who watched whom, pictures and figures."""
    from tools.report.flights import find_flights
    from tools.report.page import write_report

    with plain_errors():
        found = find_flights(paths, lambda text: typer.echo(f"podwatch: {text}", err=True))
        flights = _readable(found)
        page = write_report(flights, out or _beside(found, has_folder=any(path.is_dir() for path in paths)))
        for flight in flights:
            if flight.knows_drones:
                text = json.dumps(flight.summary, indent=2, allow_nan=False) + "\n"
                (flight.run.folder / "summary.json").write_text(text)
    typer.echo(str(page))


def _readable(found: list[list[Path]]) -> list["Flight"]:
    """Every mission that can be read; of a day, those that cannot are told on stderr and left out.

    Raises LogError where none is left.
    """
    from logs.exceptions import LogError
    from tools.report.flights import read_flight

    flights = []
    for logs in found:
        try:
            flights.append(read_flight(logs))
        except LogError as error:
            if len(found) == 1 or (logs is found[-1] and not flights):
                raise
            typer.echo(f"podwatch: left out: {error}", err=True)
    return flights


def _beside(found: list[list[Path]], *, has_folder: bool) -> Path:
    """In the one mission's folder, that of its logs too; in the current folder where there are several."""
    folders = {path if path.is_dir() else path.parent for paths in found for path in paths}
    # A few logs by name tell less than their run's own page, which stays as it is.
    name = "report.html" if has_folder else "logs_report.html"
    return (folders.pop() if len(folders) == 1 else Path()) / name
