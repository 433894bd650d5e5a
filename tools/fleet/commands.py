"""`podwatch fleet new|keys|check|units`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from tools.errors import MISSING, plain_errors

__all__ = ["app"]

app = typer.Typer(help="The fleet file: made, keyed, checked, and turned into units.", no_args_is_help=True)

FleetFile = Annotated[Path, typer.Argument(help="The fleet file.", show_default=False)]


@app.command("new")
def new(
    path: FleetFile = Path("fleet.toml"),
    drones: Annotated[int, typer.Option(min=1, help="How many drones.")] = 3,
    name: Annotated[str, typer.Option(help="What the fleet is called.", show_default="the file's name")] = "",
) -> None:
    """Write a fleet file with a comment on every value that people change."""
    from procs.settings import MAX_DRONES, MissionError
    from tools.fleet.template import fleet_text

    with plain_errors():
        if drones > MAX_DRONES:
            raise MissionError(f"--drones {drones}: a fleet holds at most {MAX_DRONES}")
        if path.exists():
            raise MissionError(f"{path} exists already; name another file, or edit this one")
        if '"' in name or "\\" in name:
            raise MissionError(f"--name {name}: no quotation marks and no backslashes")
        path.write_text(fleet_text(name or path.stem, path.name, drones))
    typer.echo(f"{path}: {drones} {'drone' if drones == 1 else 'drones'}. Next: podwatch fleet keys {path}")


@app.command("keys")
def keys(
    path: FleetFile = Path("fleet.toml"),
    force: Annotated[bool, typer.Option("--force", help="Replace a key that is there.")] = False,
) -> None:
    """Make the fleet key, readable by its owner alone; copy it to every drone and the boat."""
    from procs.relay.keys import make_key, read_key
    from procs.settings import MissionError
    from tools.fleet.check import fingerprint
    from tools.fleet.machine import read_fleet

    with plain_errors():
        mission = read_fleet(path)
        key = Path(mission.radio.key_file)
        if key.exists() and not force:
            raise MissionError(
                f"{key} exists: a new key shuts out every drone that holds the old; --force replaces it"
            )
        make_key(key, force)
        made = fingerprint(read_key(key))
    typer.echo(
        f"{key}: made, mode 0600, fingerprint {made}. Copy it to every machine of the fleet (scp -p), and to "
        "nobody else."
    )


@app.command("check")
def check(
    path: FleetFile = Path("fleet.toml"),
    drone: Annotated[int | None, typer.Option(help="What this drone lacks, on its own machine.")] = None,
    boat: Annotated[bool, typer.Option("--boat", help="What the boat lacks, on its own machine.")] = False,
) -> None:
    """Say what the fleet file, one drone or the boat on its own machine still lacks, and what mends it.

    Exit code 0 where nothing lacks, 2 for a fleet file that cannot be flown, 3 where something lacks.
    """
    from tools.fleet.check import check_boat, check_drone, check_fleet
    from tools.fleet.machine import read_fleet

    console = Console(highlight=False)
    with plain_errors():
        if boat and drone is not None:
            raise typer.BadParameter("a machine is a drone's or the boat's", param_hint="--boat")
        mission = read_fleet(path)
        if drone is not None:
            findings = check_drone(mission, path, drone)
        else:
            findings = (check_boat if boat else check_fleet)(mission, path)
    for one in findings:
        mark, style = ("lacks", "red") if one.lacks else ("ok   ", "green")
        console.print(f"[{style}]{mark}[/] {one.what:<10}", escape(one.lacks or one.found), soft_wrap=True)
        if one.mend:  # whole, in a line of its own: to be copied
            console.print(" " * 16, escape(one.mend), style="bold", soft_wrap=True)
    n_lacking = sum(1 for one in findings if one.lacks)
    if n_lacking:
        typer.echo(
            f"podwatch: {n_lacking} of {len(findings)} lack something; what mends each is above", err=True
        )
        raise typer.Exit(MISSING)


@app.command("units")
def units(
    path: FleetFile,
    drone: Annotated[int, typer.Option(help="Which drone the machine is.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder to write into.")] = Path("units"),
) -> None:
    """Write the systemd units of one drone, and the settings that they name."""
    from tools.fleet.machine import read_fleet
    from tools.fleet.units import USER, closed_folders, write_units

    with plain_errors():
        files = write_units(read_fleet(path), drone, out)
    for folder in closed_folders(out):
        typer.echo(
            f"podwatch: the user {USER} may not enter {folder}, where the units look for their files: clone "
            "podwatch to /opt/podwatch, with the system's python3, and write the units to /etc/podwatch",
            err=True,
        )
    target = f"podwatch-{drone}.target"
    typer.echo(
        f"{len(files)} files in {out}. On the drone, once: sudo useradd -r {USER}; then: sudo systemctl "
        f"link {out.resolve()}/podwatch-{drone}*; sudo systemctl enable --now {target}. After every change "
        f"of the fleet file this again, then: sudo systemctl daemon-reload; sudo systemctl restart {target}"
    )
