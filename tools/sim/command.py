"""`podwatch sim`: fly a simulated fleet, judge it, and leave a folder with logs, summary and report."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

import fleets
from procs.settings import DroneEntry, MissionError, load_mission, validate
from tools.errors import FAILED, plain_errors
from tools.live import LiveView
from tools.sim.buses import has_multicast_route
from tools.sim.plan import RunPlan
from tools.sim.run import finish, fly_lockstep, fly_processes, new_folder
from tools.sim.settings import SimMission
from tools.sim.supervision import SupervisorError

__all__ = ["read_mission", "sim", "with_overrides"]

HOME_SPACING_M = 6.0
SENSORS = ("pixels", "boxes")
SIMULATED = "sim"
NO_ROUTE = "no multicast route; for real buses: ip route add 224.0.0.0/4 dev lo"


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
        str, typer.Option(help="'sim', or a comma between addresses of real ones.")
    ] = SIMULATED,
    sensor: Annotated[
        str, typer.Option(help="pixels, or boxes in place of pixels for large batches.")
    ] = "pixels",
    out: Annotated[Path, typer.Option(help="Where the run's folder is made.")] = Path("runs"),
    headless: Annotated[bool, typer.Option("--headless", help="No live display.")] = False,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="One process on a virtual clock.")] = False,
) -> None:
    """Fly a simulated fleet from one command."""
    console = Console()
    with plain_errors():
        chosen = with_overrides(read_mission(mission), drones, animals, seed, duration)
        plan = _plan(chosen, out, sensor, scene, autopilot, lockstep)
    fallback = "" if lockstep or has_multicast_route() else NO_ROUTE
    if fallback:
        console.print(f"Flying in lockstep: {fallback}", highlight=False)
    console.print(
        f"[bold]{chosen.name}[/]: {len(chosen.drones)} drones, {chosen.pod.animals} animals, seed {chosen.seed}"
        f" -> {plan.folder}",
        highlight=False,
    )
    with plain_errors():
        try:
            _fly(plan, console, headless=headless, lockstep=lockstep or bool(fallback), fallback=fallback)
        except KeyboardInterrupt:
            console.print("Stopped before its end; what was logged is judged.")
        except SupervisorError as error:
            typer.echo(f"podwatch: {error}", err=True)
            raise typer.Exit(FAILED) from None
        summary = finish(plan.folder)
    from tools.summary import print_summary  # noqa: PLC0415 - needs the summary's types only here

    print_summary(summary, console)
    console.print(f"Report: {plan.folder / 'report.html'}", highlight=False, soft_wrap=True)


def read_mission(name: str) -> SimMission:
    """A mission by path, or by the name of one that ships. Raises MissionError."""
    path = Path(name)
    if not path.exists() and not name.endswith(".toml"):
        try:
            path = fleets.path(name)
        except FileNotFoundError as error:
            raise MissionError(f"{error}; or give the path of a mission file") from error
    return load_mission(path, SimMission)


def with_overrides(
    mission: SimMission,
    drones: int | None = None,
    animals: int | None = None,
    seed: int | None = None,
    duration_s: float | None = None,
) -> SimMission:
    """The mission with the command line's values in place of the file's; validated again."""
    changed: dict[str, Any] = mission.model_dump()
    if drones is not None:
        entries = [DroneEntry(id=k + 1, home_e_m=HOME_SPACING_M * k) for k in range(drones)]
        changed["drones"] = [entry.model_dump() for entry in entries]
    if animals is not None:
        changed["pod"]["animals"] = animals
    if seed is not None:
        changed["seed"] = seed
    if duration_s is not None:
        changed["duration_s"] = duration_s
    return validate(changed, SimMission, "command line")


def _plan(
    mission: SimMission, out: Path, sensor: str, scene: Path | None, autopilot: str, lockstep: bool
) -> RunPlan:
    if sensor not in SENSORS:
        raise MissionError(f"--sensor {sensor}: there are {' and '.join(SENSORS)}")
    addresses: tuple[str, ...] = ()
    if autopilot != SIMULATED:
        addresses = tuple(autopilot.split(","))
        if len(addresses) != len(mission.drones):
            raise MissionError(
                f"--autopilot names {len(addresses)} addresses for {len(mission.drones)} drones; give one each"
            )
        if lockstep:
            raise MissionError(
                "--lockstep runs on a virtual clock, which a real autopilot cannot follow; drop one"
            )
    if scene is not None:
        if not scene.exists():
            raise MissionError(f"--scene {scene}: no such file; give a photograph or a video")
        scene = scene.resolve()
    return RunPlan(mission, new_folder(out.resolve()), sensor, scene, addresses)


def _fly(plan: RunPlan, console: Console, *, headless: bool, lockstep: bool, fallback: str) -> None:
    def fly(screen: LiveView | None) -> None:
        if lockstep:
            fly_lockstep(plan, screen, fallback)
        else:
            fly_processes(plan, screen)

    if headless:
        fly(None)
        return
    mission = plan.mission
    with LiveView(
        mission.roster, title=mission.name, watch_s=mission.watch.watch_s, console=console
    ) as screen:
        fly(screen)
