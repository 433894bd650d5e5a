"""One simulated flight from its mission to its verdict: what `podwatch sim` does."""

import difflib
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape

import fleets
from drivers.sim.render import open_surface
from procs.bus_executor import ROUTE_COMMAND
from procs.runtime import RuntimeFailure
from procs.settings import DroneEntry, MissionError, beside, load_mission, validate
from tools.buses import has_multicast_route
from tools.called import call_words
from tools.errors import INTERRUPTED, plain_errors
from tools.folders import new_folder
from tools.live import LiveView
from tools.sim.expect import check, read_safety
from tools.sim.plan import RunPlan
from tools.sim.run import finish, fly_lockstep, fly_processes
from tools.sim.settings import Expect, SimMission
from tools.summary import print_summary

__all__ = ["SIMULATED", "command", "read_mission", "with_overrides"]

HOME_SPACING_M = 10.0  # two drones that land beside each other are each 1.5 m off by GPS
SENSORS = ("pixels", "boxes")
SIMULATED = "sim"
LINKS = ("udp", "udpout", "tcp", "serial")
NO_ROUTE = f"no multicast route; for real buses, as root: {ROUTE_COMMAND}"


def command(
    mission: str,
    drones: int | None,
    animals: int | None,
    seed: int | None,
    duration: float | None,
    scene: Path | None,
    autopilot: str,
    sensor: str,
    out: Path,
    *,
    log_frames: bool,
    headless: bool,
    lockstep: bool,
) -> None:
    """Plan the flight, fly it, judge it and say how it went; arguments as `podwatch sim` has them."""
    console = Console()
    fallback = "" if lockstep or has_multicast_route() else NO_ROUTE
    with plain_errors():
        if log_frames and sensor == "boxes":
            raise MissionError("--log-frames: --sensor boxes looks at no pixels; drop one of them")
        chosen = with_overrides(read_mission(mission), drones, animals, seed, duration, log_frames=log_frames)
        _see_who_starts(chosen, lockstep, fallback)
        addresses = _addresses(autopilot, chosen, lockstep, fallback)
        plan = _plan(chosen, out, sensor, scene, addresses)
    if fallback:
        console.print(f"Flying in lockstep: {fallback}", highlight=False, soft_wrap=True)
    console.print(
        f"[bold]{escape(chosen.name)}[/]: {_counted(len(chosen.drones), 'drone')}, "
        f"{_counted(chosen.pod.animals, 'animal')}, seed {chosen.seed} -> {plan.folder}",
        highlight=False,
        soft_wrap=True,
    )
    with plain_errors():
        try:
            _fly(plan, console, headless=headless, lockstep=lockstep or bool(fallback), fallback=fallback)
            stopped = False
        except KeyboardInterrupt:
            stopped = True
        if stopped and not (plan.folder / "truth.json").exists():
            typer.echo(f"Stopped before anything flew; nothing to judge in {plan.folder}", err=True)
            raise typer.Exit(INTERRUPTED)
        if stopped:
            console.print("Stopped before its end; what was logged is judged.")
        summary = finish(plan.folder)
    print_summary(summary, console)
    # Where the run was changed or stopped, the file's figures do not fit.
    if not stopped and (drones, animals, duration, scene) == (None, None, None, None):
        _print_expected(chosen, plan.folder, summary, console)
    console.print(f"Report: {plan.folder / 'report.html'}", highlight=False, soft_wrap=True)
    if stopped:
        raise typer.Exit(INTERRUPTED)


def _print_expected(mission: SimMission, folder: Path, summary: dict[str, Any], console: Console) -> None:
    """Say whether the run did what its scenario's [expect] asks; nothing for a mission without one.

    A flight that a person ended is not blamed for what it had no time to reach, but for its safety.
    """
    if mission.expect == Expect():
        return
    safety = read_safety(folder, mission.limits)
    short = check(mission.expect, summary, safety)
    call = call_words(summary)
    if not short:
        told, style = "The flight did all that its file expects", "green"
    elif call and not check(Expect(min_distance_m=mission.expect.min_distance_m), summary, safety):
        told, style = f"{call}, before the flight had done all that its file expects", "yellow"
    else:
        told, style = "The flight fell short of what its file expects", "red"
    console.print(f"  {told}; {safety}.", style=style, highlight=False)
    for line in short:
        console.print(f" - {line}", highlight=False, markup=False)


def read_mission(name: str) -> SimMission:
    """A mission by path, or by the name of one that ships. Raises MissionError."""
    path = Path(name)
    if not path.is_file() and not name.endswith(".toml"):
        try:
            path = fleets.path(name)
        except FileNotFoundError as error:
            there = sorted(file.stem for file in fleets.path("default").parent.glob("*.toml"))
            near = difflib.get_close_matches(name, there, n=1)
            guess = f"did you mean {near[0]!r}? " if near else ""
            raise MissionError(f"{guess}{error}; or give the path of a mission file") from error
    return beside(path, load_mission(path, SimMission))


def with_overrides(
    mission: SimMission,
    drones: int | None = None,
    animals: int | None = None,
    seed: int | None = None,
    duration_s: float | None = None,
    *,
    log_frames: bool = False,
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
    if log_frames:
        changed["log"]["frames"] = True
    return validate(changed, SimMission, "command line")


def _plan(
    mission: SimMission, out: Path, sensor: str, scene: Path | None, addresses: tuple[str, ...]
) -> RunPlan:
    """Look at everything that was given, and only then make the run's folder."""
    if sensor not in SENSORS:
        raise MissionError(f"--sensor {sensor}: there are {' and '.join(SENSORS)}")
    if scene is not None:
        if sensor == "boxes":
            raise MissionError(f"--scene {scene}: --sensor boxes looks at no pixels; drop one of them")
        scene = scene.resolve()
        open_surface(scene, mission.world.scene_width_m)
        try:
            RunPlan(mission, out, sensor, scene).scene_truth()
        except ValueError as error:
            raise MissionError(
                f"--scene {scene}: the labels beside it are no YOLO text ({error}); each line is: class u v "
                "width height, as shares of the picture"
            ) from error
    try:
        folder = new_folder(out.resolve())
    except OSError as error:
        raise MissionError(
            f"--out {out}: no folder can be made there ({error.strerror}); give one that you may write to"
        ) from error
    return RunPlan(mission, folder, sensor, scene, addresses)


def _addresses(autopilot: str, mission: SimMission, lockstep: bool, fallback: str) -> tuple[str, ...]:
    """The real autopilots' addresses, by rank of their drones; none for simulated ones.

    lockstep: whether it was asked for. fallback: why nothing else can fly here, empty where it can. host:port
    alone means udp. Raises MissionError, and RuntimeFailure where the machine cannot.
    """
    if autopilot == SIMULATED:
        return ()
    addresses = [address.strip() for address in autopilot.split(",")]
    if len(addresses) != len(mission.drones):
        raise MissionError(
            f"--autopilot names {_counted(len(addresses), 'address', 'addresses')} for "
            f"{_counted(len(mission.drones), 'drone')}; give one each, with commas between"
        )
    named = tuple(a if a.split(":")[0] in LINKS else f"udp:{a}" for a in addresses)
    for address in named:
        if not address.rpartition(":")[2].isdigit() or address.count(":") < 2:
            raise MissionError(
                f"--autopilot {address.removeprefix('udp:')!r}: write 'sim', HOST:PORT, udp:HOST:PORT "
                "(listen), udpout:HOST:PORT (send first), tcp:HOST:PORT or serial:DEVICE:BAUD"
            )
    told = "--autopilot: a real autopilot cannot follow the virtual clock of lockstep"
    if lockstep:
        raise MissionError(f"{told}; drop it, or --lockstep")
    if fallback:
        raise RuntimeFailure(f"{told}, and nothing else can fly here: {fallback}")
    return named


def _see_who_starts(mission: SimMission, lockstep: bool, fallback: str) -> None:
    """A fleet that waits for an order would wait for ever where no boat can give one. lockstep, fallback and
    errors as for `_addresses`.
    """
    if mission.search.start != "operator" or not (lockstep or fallback):
        return
    told = 'search.start = "operator" waits for a boat\'s order, and no boat can join a flight in lockstep'
    if lockstep:
        raise MissionError(f'{told}; fly without --lockstep, or write "auto" in the file')
    raise RuntimeFailure(f"{told}, and nothing else can fly here: {fallback}")


def _counted(count: int, one: str, many: str = "") -> str:
    """ "1 drone", "3 drones"."""
    return f"{count} {one if count == 1 else many or one + 's'}"


def _fly(plan: RunPlan, console: Console, *, headless: bool, lockstep: bool, fallback: str) -> None:
    def tell(line: str) -> None:
        console.print(line, highlight=False, markup=False, soft_wrap=True)

    def fly(screen: LiveView | None) -> None:
        if lockstep:
            fly_lockstep(plan, screen, fallback)
        else:
            fly_processes(plan, screen, tell)

    if headless:
        fly(None)
        return
    mission = plan.mission
    with LiveView(
        mission.roster, title=mission.name, watch_s=mission.watch.watch_s, console=console
    ) as screen:
        fly(screen)
