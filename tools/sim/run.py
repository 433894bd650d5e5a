"""One simulated run from plan to report: choose the mode, fly, judge, write what is left behind."""

import contextlib
import json
import shlex
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from procs import processes
from procs.relay.keys import make_key, read_key
from tools.sim.lockstep import LockstepFleet
from tools.sim.plan import RunPlan
from tools.sim.processes import ProcessFleet
from tools.sim.watch import Screen, Watch

__all__ = ["finish", "fly_lockstep", "fly_processes", "prepare", "write_truth_notes"]

STEP_S = 0.25


def prepare(plan: RunPlan) -> None:
    """What a run needs before it flies: the fleet's key, a new one unless the mission names one that is
    there. Raises FleetKeyError.
    """
    key = plan.folder / plan.mission.radio.key_file
    if key.exists():
        read_key(key)
    else:
        make_key(key)


@contextlib.contextmanager
def _interrupt_between_steps() -> Iterator[Callable[[], None]]:
    """A Ctrl-C waits for the next call of what this yields, which raises KeyboardInterrupt.

    Python would raise it wherever it happens to be: in a library that swallows it, or while the processes are
    being stopped.
    """
    asked: list[int] = []
    kept = signal.signal(signal.SIGINT, lambda number, _frame: asked.append(number))

    def check() -> None:
        if asked:
            raise KeyboardInterrupt

    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, kept)


def fly_lockstep(plan: RunPlan, screen: Screen | None, fallback_reason: str = "") -> None:
    """Fly a plan on the virtual clock and write its notes."""
    prepare(plan)
    watch = Watch(plan.mission, screen)
    began = time.monotonic()
    with _interrupt_between_steps() as check_interrupt:
        fleet = LockstepFleet(plan, watch.hear)
        try:
            over = False
            while not over:
                check_interrupt()
                fleet.run_until(fleet.now_s + STEP_S)
                wall_s = time.monotonic() - began
                over = watch.step(fleet.now_s, fleet, fleet.now_s / max(wall_s, 1e-6))
        finally:  # a run that was stopped is judged by what it logged
            fleet.close()
            write_truth_notes(plan, watch, "lockstep", fallback_reason, fleet.now_s, time.monotonic() - began)


def fly_processes(plan: RunPlan, screen: Screen | None, tell: Callable[[str], None] = lambda _: None) -> None:
    """Fly a plan as operating-system processes and write its notes; `tell` is given lines for people while
    they start. Raises SupervisorError.
    """
    prepare(plan)
    n_drones, n_each = len(plan.mission.roster), len(processes.PROCESSES)
    tell(f"Starting {n_drones * n_each} processes, {n_each} for each drone; that can take a minute.")
    watch = Watch(plan.mission, screen)
    with _interrupt_between_steps() as check_interrupt, ProcessFleet(plan, watch) as fleet:
        fleet.wait_until_ready(check_interrupt, tell)
        if plan.mission.search.start == "operator":
            tell(
                'The fleet waits on the ground for an order (search.start = "operator"). '
                "In another terminal:\n"
                f"  podwatch boat {shlex.quote(str(plan.folder / 'boat.toml'))}\n"
                f"and type there: start. Without it the run ends after {plan.mission.duration_s:.0f} s."
            )
        began = time.monotonic()
        try:
            over = False
            while not over:
                check_interrupt()
                fleet.look()
                wall_s = time.monotonic() - began
                over = watch.step(fleet.now_s, fleet, fleet.now_s / max(wall_s, 1e-6))
        finally:  # a run that was stopped is judged by what it logged
            write_truth_notes(plan, watch, "processes", "", fleet.now_s, time.monotonic() - began)


def write_truth_notes(
    plan: RunPlan, watch: Watch, mode: str, fallback_reason: str, flown_s: float, wall_s: float
) -> None:
    """truth.json and mission.json: what the judge must know beside the logs."""
    mission = plan.mission
    clocks = {drone_id: plan.clock(drone_id) for drone_id in mission.roster}
    notes = {
        "seed": mission.seed,
        "mode": mode,
        "fallback_reason": fallback_reason or None,
        "sensor": plan.sensor,
        "scene": str(plan.scene.name) if plan.scene else None,
        "autopilots": list(plan.autopilots),  # real ones: then truth is what they say of themselves
        "scene_truth": plan.scene is None or plan.scene_truth() is not None,
        "clocks": {
            str(drone_id): {"offset_us": clock.offset_us, "drift_ppm": clock.drift_ppm}
            for drone_id, clock in clocks.items()
        },
        "camera": {
            "width_px": mission.camera.width_px,
            "height_px": mission.camera.height_px,
            "vfov_deg": mission.camera.vfov_deg,
        },
        "deaths": {str(drone_id): t_s for drone_id, t_s in watch.deaths.items()},
        "flown_s": flown_s,
        "wall_s": wall_s,
        "realtime_factor": flown_s / max(wall_s, 1e-6),
    }
    (plan.folder / "truth.json").write_text(json.dumps(notes, indent=2) + "\n")
    (plan.folder / "mission.json").write_text(mission.model_dump_json(indent=2) + "\n")


def finish(folder: Path) -> dict[str, object]:
    """summary.json and report.html of a run -> the summary."""
    from tools.report import make_report
    from tools.summary import write_summary

    summary = write_summary(folder)
    make_report(folder)
    return summary
