"""`podwatch doctor`: a table of what is wrong and the command that mends it."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape

from tools.errors import MISSING, plain_errors

if TYPE_CHECKING:
    from procs.settings import Mission
    from tools.findings import Finding

__all__ = ["doctor"]

OWN = ("multicast", "rmem_max", "/dev/shm")  # of the machine: looked at in any case
CHECKS = ("multicast", "rmem_max", "slots", "shm", "model", "java")


def doctor(
    fleet: Annotated[
        Path | None, typer.Argument(help="A fleet file: its key and addresses too.", show_default=False)
    ] = None,
    drone: Annotated[
        int | None, typer.Option(help="With a fleet file: this machine is that drone's; its edges too.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help=f"Only this of the machine's: {', '.join(CHECKS)}.")
    ] = None,
    without: Annotated[list[str] | None, typer.Option(help="Not this of the machine's.")] = None,
) -> None:
    """Say what this machine lacks, and the command that mends it.

    With a fleet file also the fleet's key and addresses; with --drone the camera, model, autopilot and radio
    of that drone. Exit code 0 where nothing lacks, 3 where something does.
    """
    console = Console(highlight=False)
    chosen = _chosen(only or (), without or (), on_drone=drone is not None)
    with plain_errors():
        if drone is not None and fleet is None:
            raise typer.BadParameter("it needs the fleet file too", param_hint="--drone")
        mission = _read(fleet, drone) if fleet else None
        findings = []
        for finding in _look(chosen, mission, fleet, drone):
            findings.append(finding)
            _print(finding, console)
    if fleet is None and not only:
        note = "camera, autopilot, key: podwatch doctor fleet.toml --drone K looks at them"
        console.print(f"      {note}", style="dim", soft_wrap=True)
    n_lacking = sum(1 for finding in findings if finding.lacks)
    if n_lacking:
        typer.echo(f"podwatch: {n_lacking} of {len(findings)} to mend; the commands are above", err=True)
        raise typer.Exit(MISSING)


def _chosen(only: list[str] | tuple[()], without: list[str] | tuple[()], *, on_drone: bool) -> list[str]:
    """Names of the machine's checks to make. Nobody sits before a drone: Java is left out there."""
    for name in (*only, *without):
        if name not in CHECKS:
            raise typer.BadParameter(f"{name!r}; there are: {', '.join(CHECKS)}")
    usual = [name for name in CHECKS if name != "java" or not on_drone]
    return [name for name in only or usual if name not in without]


def _read(path: Path, drone_id: int | None) -> "Mission":
    """The fleet file; a drone that it does not have is told before anything is looked at."""
    from tools.fleet.machine import machine_of, read_fleet

    mission = read_fleet(path)
    if drone_id is not None:
        machine_of(mission, drone_id)
    return mission


def _look(
    chosen: list[str], mission: "Mission | None", path: Path | None, drone_id: int | None
) -> Iterator["Finding"]:
    """Each finding as soon as it is made."""
    from procs.settings import Mission
    from tools.doctor import machine
    from tools.fleet.check import check_drone, check_fleet

    on_drone = drone_id is not None
    asked = mission or Mission()
    n_cameras = 1 if on_drone else len(asked.drones)
    checks: dict[str, Callable[[], Finding]] = {
        "multicast": lambda: machine.check_route(on_drone=on_drone),
        "rmem_max": machine.check_receive_buffer,
        "slots": machine.check_slots,
        "shm": lambda: machine.check_shared_memory(machine.frames_bytes(asked.camera, n_cameras)),
        "model": machine.check_model,
        "java": machine.check_java,
    }
    for name in chosen:
        if name != "model" or not on_drone:  # a drone's own machine may name another
            yield checks[name]()
    if mission is not None and path is not None:
        found = check_fleet(mission, path) if drone_id is None else check_drone(mission, path, drone_id)
        yield from (one for one in found if one.what not in OWN)


def _print(finding: "Finding", console: Console) -> None:
    mark, style = ("wrong", "red") if finding.lacks else ("ok   ", "green")
    console.print(
        f"[{style}]{mark}[/] {finding.what:<10}", escape(finding.lacks or finding.found), soft_wrap=True
    )
    if finding.mend:  # whole, in a line of its own: to be copied
        console.print(" " * 16, escape(finding.mend), style="bold", soft_wrap=True)
