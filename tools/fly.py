"""`podwatch fly`: one drone's processes on its own machine, from the fleet file that all drones share."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from tools.errors import INTERRUPTED, plain_errors

__all__ = ["fly"]


def fly(
    fleet: Annotated[Path, typer.Argument(help="The fleet file.", show_default=False)],
    drone: Annotated[int, typer.Option(help="Which drone this machine is.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Where the flight's folder is made.")] = Path("runs"),
) -> None:
    """Start one drone's processes on its own machine and show what they do, until Ctrl-C.

    On Ctrl-C in the air the autopilot's own failsafe flies the drone home, as after any loss of its computer.
    """
    from rich.console import Console

    from procs.relay.keys import read_key
    from tools.fleet.flight import DroneFlight
    from tools.fleet.machine import machine_of, read_fleet
    from tools.folders import new_folder
    from tools.live import LiveView

    console = Console(highlight=False)
    with plain_errors():
        mission = read_fleet(fleet)
        machine_of(mission, drone)
        read_key(Path(mission.radio.key_file))
        folder = new_folder(out.resolve())
        screen = LiveView(
            (drone,), title=f"{mission.name}, drone {drone}", watch_s=mission.watch.watch_s, console=console
        )
        with _stop_between_looks() as check_stop, DroneFlight(mission, drone, folder, screen) as flight:
            console.print(f"drone {drone} -> {folder}, bus {flight.bus_url}", soft_wrap=True)
            try:
                flight.wait_until_ready(check_stop)
                console.print(f"drone {drone}: all {len(flight.beaten)} processes run", soft_wrap=True)
                with screen:
                    while True:
                        check_stop()
                        flight.look()
            except KeyboardInterrupt:
                console.print("Stopping in order; the log is in the folder above.")
    raise typer.Exit(INTERRUPTED)


@contextmanager
def _stop_between_looks() -> Iterator[Callable[[], None]]:
    """Ctrl-C and SIGTERM wait for the next call of what this yields, which raises KeyboardInterrupt."""
    asked: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    kept = [signal.signal(number, lambda got, _frame: asked.append(got)) for number in numbers]

    def check() -> None:
        if asked:
            raise KeyboardInterrupt

    try:
        yield check
    finally:
        for number, handler in zip(numbers, kept, strict=True):
            signal.signal(number, handler)
