"""`podwatch replay`: one process over a recorded log, its words compared with those that it said then."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tools.errors import FAILED, plain_errors

if TYPE_CHECKING:
    from rich.console import Console

    from logs.fleet import DroneLog
    from procs.queue_executor import ClockError
    from tools.replaying.compare import Account

__all__ = ["replay_command"]

REAL_TIME_MS = 100.0  # two machines, or two hours, never run a handler at the same microsecond
REAL_RELATIVE = 0.01
SHOWN = 12  # differences that are listed; all are counted


def replay_command(
    process: Annotated[str, typer.Argument(help="The process, as navigator or tracker.", show_default=False)],
    log: Annotated[Path, typer.Argument(help="A drone's .mcap log.", show_default=False)],
    time_ms: Annotated[
        float | None,
        typer.Option(
            "--time-tolerance",
            min=0,
            help="ms between two times.",
            show_default=f"0; {REAL_TIME_MS:g} for a log of real time",
        ),
    ] = None,
    relative: Annotated[
        float | None,
        typer.Option(
            "--tolerance",
            min=0,
            help="Share of a number.",
            show_default=f"0; {REAL_RELATIVE:g} for a log of real time",
        ),
    ] = None,
    show: Annotated[int, typer.Option(min=0, help="Differences to list.")] = SHOWN,
) -> None:
    """Run one process over a recorded log, in virtual time, and compare what it says with what it said.

    Exit code 1 where they differ.
    """
    from rich.console import Console

    from tools.log.shared import clear_errors, warn

    console = Console(highlight=False)
    with clear_errors(), plain_errors():
        from logs.fleet import DroneLog
        from tools.replaying.compare import Tolerance, compare
        from tools.replaying.run import replay

        drone = DroneLog(log, warn)
        done = replay(process, drone, _models(drone), _clock(drone))
        real = not done.is_virtual
        tolerance = Tolerance(
            round(1000 * (time_ms if time_ms is not None else REAL_TIME_MS * real)),
            relative if relative is not None else REAL_RELATIVE * real,
        )
        accounts = compare(done.recorded, done.replayed, tolerance)
    begin_us = min((said.at_us for said in done.recorded), default=0)
    _print_accounts(console, f"{process} of drone {drone.drone_id}", accounts)
    _print_differences(console, accounts, begin_us, show)
    if not all(account.agrees for account in accounts):
        raise typer.Exit(FAILED)


def _clock(drone: "DroneLog") -> "ClockError | None":
    """How a simulated drone's clock ran, by its run's notes beside the log; None where there are none."""
    from procs.queue_executor import ClockError

    try:
        notes = json.loads((drone.path.parent / "truth.json").read_text())["clocks"][str(drone.drone_id)]
        return ClockError(int(notes["offset_us"]), float(notes["drift_ppm"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _models(drone: "DroneLog") -> dict[str, Any]:
    """The models that look at pixels, made only where they are opened."""

    def detector() -> Any:
        from procs import processes
        from procs.detector.yolo import Detector
        from tools.replaying.run import settings_of

        # A look takes its nominal time, as in a flight in virtual time.
        nominal_ms = 1e3 * processes.BY_NAME["detector"].compute_s
        return Detector(**settings_of(drone).mission.detector.options(), look_ms=nominal_ms)

    def tracker() -> Any:
        from procs.tracker.mask_tracker import MaskTracker

        return MaskTracker()

    return {"detector": detector, "tracker": tracker}


def _print_accounts(console: "Console", title: str, accounts: "list[Account]") -> None:
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, padding=(0, 2, 0, 0))
    table.add_column("channel", no_wrap=True)
    for heading in ("recorded", "replayed", "same", "differ", "missing", "too many"):
        table.add_column(heading, justify="right", no_wrap=True)
    for a in accounts:
        counts = (a.n_recorded, a.n_replayed, a.n_same, a.n_different, a.n_missing, a.n_extra)
        table.add_row(a.channel, *map(str, counts), style="" if a.agrees else "red")
    console.print(table)


def _print_differences(console: "Console", accounts: "list[Account]", begin_us: int, show: int) -> None:
    from rich.markup import escape
    from rich.table import Table

    found = sorted((d for account in accounts for d in account.differences), key=lambda d: d.at_us)
    if not found:
        console.print("Every message is the same.")
        return
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("s", justify="right", no_wrap=True)
    for heading in ("channel", "member", "recorded", "replayed"):
        table.add_column(heading, overflow="fold")
    for one in found[:show]:
        cells = (one.channel, one.member or "(the message)", _value(one.recorded), _value(one.replayed))
        table.add_row(f"{(one.at_us - begin_us) / 1e6:.6f}", *map(escape, cells))
    console.print(table)
    if len(found) > show:
        console.print(f"{len(found) - show} more differences; --show {len(found)} lists all")


def _value(value: Any) -> str:
    text = f"<{len(value)} bytes>" if isinstance(value, bytes) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
