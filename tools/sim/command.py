"""`podwatch sim`: fly a simulated fleet, judge it, and leave a folder with logs, summary and report."""

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["sim"]


def sim(
    mission: Annotated[
        str, typer.Argument(help="A mission file, or the name of one that ships.")
    ] = "default",
    drones: Annotated[int | None, typer.Option(min=1, max=20, help="How many drones.")] = None,
    animals: Annotated[int | None, typer.Option(min=0, max=20, help="How many animals.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="The same seed gives the same run.")] = None,
    duration: Annotated[
        float | None, typer.Option(min=1, help="End after this many simulated seconds.")
    ] = None,
    scene: Annotated[Path | None, typer.Option(help="A photograph or video as the world's surface.")] = None,
    autopilot: Annotated[
        str,
        typer.Option(
            help="'sim', or the address of a real one for each drone, with commas between: HOST:PORT or "
            "udp:HOST:PORT to listen, udpout:HOST:PORT to send first, tcp:HOST:PORT, serial:DEVICE:BAUD."
        ),
    ] = "sim",
    sensor: Annotated[
        str, typer.Option(help="pixels, or boxes in place of pixels for large batches.")
    ] = "pixels",
    out: Annotated[Path, typer.Option(help="Where the run's folder is made.")] = Path("runs"),
    log_frames: Annotated[
        bool,
        typer.Option("--log-frames", help="Log whole frames too, for `podwatch replay`: 4 MB/s a drone."),
    ] = False,
    headless: Annotated[bool, typer.Option("--headless", help="No live display.")] = False,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="One process on a virtual clock.")] = False,
) -> None:
    """Fly a simulated fleet from one command."""
    from tools.sim.flight import command

    command(
        mission,
        drones,
        animals,
        seed,
        duration,
        scene,
        autopilot,
        sensor,
        out,
        log_frames=log_frames,
        headless=headless,
        lockstep=lockstep,
    )
