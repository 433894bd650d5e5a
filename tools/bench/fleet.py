"""`podwatch bench fleet`: fly many missions and print every figure of the fleet, judged from truth and logs.

Each row has n, seed, figure, bar and pass; a row whose figure could not be had prints MISSING and the reason
below the table.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lcmtypes import channels
from logs.reader import read
from procs import processes
from tools.bench.table import Row, bench_console, measured, print_table, write_table
from tools.folders import new_folder
from tools.sim.flight import read_mission, with_overrides
from tools.sim.lockstep import LockstepFleet
from tools.sim.plan import RunPlan
from tools.sim.run import finish, fly_lockstep, fly_processes, prepare
from tools.sim.settings import SimMission

__all__ = ["command"]

PIXEL_FLEETS = (1, 3, 5, 10)
BOX_FLEETS = (1, 5, 10, 20, 50)
SPEED_FROM_S, SPEED_FOR_S = 12.0, 8.0  # in flight, after the take-off
MOST_ANIMALS = 20


def command(seeds: range, out: Path, *, quick: bool) -> None:
    """Measure all: the default mission with each of `seeds`, the rest with the first of them.

    Prints the table and writes it as bench_fleet.json into `out`.
    """
    console = bench_console()
    sensor = "boxes" if quick else "pixels"
    groups: list[tuple[str, Callable[[], Iterator[Row]]]] = [
        ("default mission", lambda: default_missions(seeds, out, sensor)),
        ("largest messages", lambda: largest_messages(out, seeds[0])),
        ("lockstep speed", lambda: lockstep_speed(out, seeds[0], quick=quick)),
    ]
    if not quick:
        groups.insert(1, ("processes mode", lambda: processes_mode(out, seeds[0])))
    rows: list[Row] = []
    for name, measure in groups:
        with console.status(name):
            rows += measured(measure(), name)
    print_table("podwatch bench fleet", rows, console)
    write_table(out / "bench_fleet.json", rows)


def default_missions(seeds: range, out: Path, sensor: str) -> Iterator[Row]:
    """The default mission flown with each of `seeds` in lockstep, each judged."""
    default = read_mission("default")
    summaries = [_fly(with_overrides(default, seed=seed), out, sensor) for seed in seeds]
    label = f"{seeds[0]}-{seeds[-1]}"
    right = [summary["distinct"] is True and summary["consensus"] is True for summary in summaries]
    share = sum(right) / len(seeds)
    wrong = [str(seed) for seed, ok in zip(seeds, right, strict=True) if not ok]
    why = f"not in seed {', '.join(wrong)}" if wrong else ""
    name = f"every drone over a different animal, identities agreed ({sensor})"
    yield Row(name, len(seeds), label, f"{100 * share:.0f} %", ">= 90 %", "", share >= 0.9, why)
    to_monitor = [s["seconds_to_monitor"] for s in summaries if s["seconds_to_monitor"] is not None]
    figure = f"{statistics.median(to_monitor):.0f} s (most {max(to_monitor):.0f})" if to_monitor else None
    yield Row("seconds to MONITOR, median", len(to_monitor), label, figure)
    inside = [d["in_image_share"] for s in summaries for d in s["drones"] if d["in_image_share"] is not None]
    mean = statistics.mean(inside) if inside else 0.0
    shares = f"{100 * mean:.1f} % (least {100 * min(inside):.1f})" if inside else None
    yield Row(
        "MONITOR time with the animal inside the image",
        len(inside),
        label,
        shares,
        ">= 95 %",
        passed=mean >= 0.95,
    )


def processes_mode(out: Path, seed: int) -> Iterator[Row]:
    """The default mission as operating-system processes on this machine."""
    plan = RunPlan(with_overrides(read_mission("default"), seed=seed), new_folder(out))
    fly_processes(plan, None)
    summary: Any = finish(plan.folder)
    label = str(seed)
    latency = summary["camera_to_setpoint_ms"]
    figure: str | None
    if latency["p50"] is not None:
        figure = f"{latency['p50']:.0f} ms, {latency['p99']:.0f} ms"
        yield Row(
            "camera to setpoint, p50 and p99", 1, label, figure, "p99 <= 250 ms", passed=latency["p99"] <= 250
        )
    else:
        yield Row("camera to setpoint, p50 and p99", 1, label, None, why="no setpoint rested on a frame")
    rates = [drone["tracker_hz"] for drone in summary["drones"] if drone["tracker_hz"]]
    slowest = min(rates, default=0.0)
    figure = f"{slowest:.1f} Hz in the slowest drone" if rates else None
    yield Row("tracker rate, simulated time", len(rates), label, figure, ">= 19 Hz", passed=slowest >= 19)
    factor = summary["realtime_factor"]
    yield Row("realtime factor, whole mission", 1, label, f"{factor:.2f}", ">= 0.8", passed=factor >= 0.8)
    for link in summary["links"]:
        kinds = ", ".join(f"{kind} {rate:.0f}" for kind, rate in sorted(link["bytes_per_s"].items()))
        yield Row(f"bytes/s on link {link['from']} to {link['to']}", 1, label, kinds)
    yield from _costs(plan, label)


def _costs(plan: RunPlan, seed: str) -> Iterator[Row]:
    """CPU and memory of each process, from its own heartbeats, over all drones."""
    beats: dict[str, list[tuple[float, float]]] = {process.name: [] for process in processes.PROCESSES}
    for drone_id in plan.mission.roster:
        for _, _, beat in read(plan.log_path(drone_id), channels=[channels.HEARTBEAT]):
            beats[beat.process].append((beat.cpu, beat.memory_mb))
    for name, values in beats.items():
        cpu = np.median([value[0] for value in values]) if values else 0.0
        memory = max((value[1] for value in values), default=0.0)
        figure = f"{cpu:.3f} cores, {memory:.0f} MB" if values else None
        yield Row(f"CPU (median) and memory (most) of {name}", len(values), seed, figure)


def largest_messages(out: Path, seed: int) -> Iterator[Row]:
    """The largest of what crosses a link, with 20 animals in the pod, counted where it is sent."""
    mission = with_overrides(read_mission("five_drones"), animals=MOST_ANIMALS, seed=seed)
    pod = mission.pod.model_copy(update={"radius_m": 40.0, "spacing_m": 11.0})
    summary = _fly(mission.model_copy(update={"pod": pod}), out, "boxes")
    for name, key, bar in (
        ("payload", "largest_payload_bytes", 308),
        ("encoded", "largest_encoded_bytes", 400),
        ("datagram", "largest_datagram_bytes", 500),
    ):
        most = max((link[key] for link in summary["links"]), default=None)
        figure = f"{most} B" if most is not None else None
        passed = most is not None and most <= bar
        yield Row(
            f"largest {name} with {MOST_ANIMALS} animals", 1, str(seed), figure, f"<= {bar} B", passed=passed
        )


def lockstep_speed(out: Path, seed: int, *, quick: bool) -> Iterator[Row]:
    """Wall seconds a simulated second in flight, for growing fleets."""
    for sensor, sizes in (("pixels", PIXEL_FLEETS), ("boxes", BOX_FLEETS)):
        for size in sizes if not quick else sizes[:2]:
            mission = with_overrides(read_mission("default"), drones=size, seed=seed)
            wall_s = _wall_per_second(RunPlan(mission, new_folder(out), sensor))
            name = f"lockstep wall time a simulated second, {size} drones on {sensor}"
            yield Row(name, 1, str(seed), f"{wall_s:.2f} s ({wall_s / size:.3f} a drone)")


def _wall_per_second(plan: RunPlan) -> float:
    prepare(plan)
    fleet = LockstepFleet(plan, lambda _drone, _channel, _data: None)
    try:
        fleet.run_until(SPEED_FROM_S)
        began = time.monotonic()
        fleet.run_until(SPEED_FROM_S + SPEED_FOR_S)
        return (time.monotonic() - began) / SPEED_FOR_S
    finally:
        fleet.close()


def _fly(mission: SimMission, out: Path, sensor: str) -> dict[str, Any]:
    plan = RunPlan(mission, new_folder(out), sensor)
    fly_lockstep(plan, None)
    return finish(plan.folder)
