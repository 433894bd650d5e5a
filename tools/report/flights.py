"""One mission as the report tells it: read from a simulated run with its truth, or from drones' logs alone.

Logs alone know what the drones believed: their own positions, the animals of the fleet's map under the
fleet's names. Such a flight says so (`knows_drones`, `knows_animals`), and all else treats both alike.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.cameras.pinhole import Pinhole
from logs.exceptions import LogError
from logs.fleet import DroneLog as LogFiles
from logs.fleet import Fleet, Line, find_logs, list_logs
from logs.missions import missions
from tools.evidence import Clock, EvidenceError, Run, Truth, drone_log, load_run, read_samples
from tools.judge import Verdict, judge
from tools.summary import summary_of

__all__ = ["Flight", "find_flights", "read_flight"]

CUT_SHORT_S = 5.0  # a log that ends so long before the others' ended without its fleet
DEFAULT_CAMERA = Pinhole((640, 480), float(np.radians(60)))
AT_REST = ("IDLE", "LANDED")
LONGEST_NAME = 80
Messages = dict[int, dict[str, list[tuple[float, Any]]]]


@dataclass(frozen=True)
class Flight:
    """A mission that is read and judged."""

    name: str  # of its folder, or of its logs
    run: Run
    verdict: Verdict
    summary: dict[str, Any]
    knows_drones: bool  # drones' places are the simulator's truth, not their own belief
    knows_animals: bool  # the same of the animals', and of who watched whom
    cut_short: tuple[int, ...] = ()  # drones whose log ends in the air, before the others'

    @property
    def end_s(self) -> float:
        return float(self.run.truth.t_s[-1])

    @property
    def title(self) -> str:
        return str(self.run.mission.get("name") or "mission")[:LONGEST_NAME]


def find_flights(paths: Sequence[Path], report: Callable[[str], None]) -> list[list[Path]]:
    """What people give, as one list of paths a mission, in the given order.

    A folder with drones' logs is a mission; one without is a day, and each of its folders with logs a
    mission. All logs that are given by name fly together. Where a drone's computer was started anew, so that
    it has logs of several clocks, the logs are as many missions, by who was in contact with whom; `report`
    gets a line where that leaves doubt. Raises LogError where nothing is found.
    """
    flights: list[list[Path]] = []
    loose: list[Path] = []
    for path in paths:
        if not path.is_dir():
            if not path.exists():
                raise LogError(f"{path}: no such file or folder; give a run's folder, or drones' logs")
            if not loose:
                flights.append(loose)
            loose.append(path)
        elif _has_logs(path):
            flights.append([path])
        else:
            inner = [[folder] for folder in sorted(path.iterdir()) if folder.is_dir() and _has_logs(folder)]
            if not inner:
                raise LogError(
                    f"{path}: no drone_<id>.mcap in this folder, nor in one of its folders; give a run's "
                    "folder, or drones' logs"
                )
            flights += inner
    return [mission for given in flights for mission in _missions(given, report)]


def _missions(given: list[Path], report: Callable[[str], None]) -> list[list[Path]]:
    """Logs that are given together as missions: as they are, but for logs of several clocks."""
    if _is_simulated(given[0]):
        return [given]
    found = missions(list_logs(given), report)
    return found if len(found) > 1 else [given]


def read_flight(paths: list[Path]) -> Flight:
    """One mission, of one of `find_flights`' lists. Raises LogError where no log of it can be read at all."""
    folder = paths[0]
    trouble: list[str] = []
    if _is_simulated(folder):
        try:
            run = load_run(folder)
        except EvidenceError as error:
            trouble = [f"{error}; the page tells what the drones' own logs say"]
        else:
            return _flight(_name(folder), run, knows_drones=True, knows_animals=run.truth.is_labelled)
    run, cut_short = _read_logs(find_logs(paths) if trouble else list_logs(paths), trouble)
    name = _name(folder) if len(paths) == 1 else ", ".join(path.stem for path in paths)
    return replace(_flight(name, run, knows_drones=False, knows_animals=False), cut_short=cut_short)


def _is_simulated(path: Path) -> bool:
    """A folder that the simulator wrote."""
    return path.is_dir() and ((path / "truth.json").exists() or (path / "truth.mcap").exists())


def _flight(name: str, run: Run, *, knows_drones: bool, knows_animals: bool) -> Flight:
    verdict = judge(run.truth, run.drones)
    return Flight(name, run, verdict, summary_of(run, verdict), knows_drones, knows_animals)


def _has_logs(folder: Path) -> bool:
    if (folder / "truth.json").exists():
        return True
    try:
        return bool(list_logs([folder]))
    except LogError:
        return False


def _name(path: Path) -> str:
    return path.resolve().name.removesuffix(".mcap")


def _read_logs(paths: Sequence[Path], problems: list[str]) -> tuple[Run, tuple[int, ...]]:
    """(the run that drones' logs tell, drones whose log was cut short)."""
    files, lines, begin_us = _common_clock(paths, problems)
    mission = _mission(files)
    camera = _camera(mission)
    messages: Messages = {}
    clocks = {}
    for log in files:
        # Seconds since the first message: (line(utime) - begin) as an offset and a drift.
        line = lines[log.drone_id]
        clocks[log.drone_id] = Clock(
            line.x_us - (line.y_us - begin_us) / line.rate, (1 / line.rate - 1) * 1e6
        )
        messages[log.drone_id], complaints = read_samples(log.paths, log.drone_id, clocks[log.drone_id])
        problems += complaints
    logs = tuple(drone_log(drone_id, samples, camera) for drone_id, samples in sorted(messages.items()))
    ends_s = {drone_id: _end_s(samples) for drone_id, samples in messages.items()}
    end_s = max(ends_s.values(), default=0.0)
    cut_short = {
        log.id: ends_s[log.id]
        for log in logs
        if ends_s[log.id] < end_s - CUT_SHORT_S and log.states and log.states[-1][1] not in AT_REST
    }
    truth = Truth(camera, np.array([0.0, max(end_s, 1.0)]), {}, {}, dict(cut_short), is_labelled=False)
    folder = files[0].path.parent
    run = Run(folder, {}, mission, truth, logs, messages, clocks, tuple(problems))
    return run, tuple(sorted(cut_short))


def _end_s(samples: dict[str, list[tuple[float, Any]]]) -> float:
    return max((rows[-1][0] for rows in samples.values() if rows), default=0.0)


def _common_clock(
    paths: Sequence[Path], problems: list[str]
) -> tuple[list[LogFiles], dict[int, Line], float]:
    """(logs that can be read, each one's line to the common clock, that clock at the first message).

    A drone whose clock nobody measured is laid so that its log begins with the others'.
    """
    fleet, apart = _largest_fleet(paths, problems)
    files, lines = list(fleet.logs), dict(fleet.lines)
    begin_us = min(lines[log.drone_id].at(_first_us(log)) for log in files)
    for log in apart:
        if log.drone_id in lines:
            raise LogError(
                f"{log.path}: drone {log.drone_id} has another log here; give each mission's logs alone, or "
                "its folder"
            )
        lines[log.drone_id] = Line(_first_us(log), begin_us)
        files.append(log)
        problems.append(
            f"drone {log.drone_id}: its clock was never compared with the others', so its times may be off; "
            "they are shown as if all logs began at one instant"
        )
    return sorted(files, key=lambda log: log.drone_id), lines, begin_us


def _largest_fleet(paths: Sequence[Path], problems: list[str]) -> tuple[Fleet, list[LogFiles]]:
    """(the logs that have one clock, those that have none in common with them)."""
    ignore: Callable[[str], None] = lambda _text: None  # noqa: E731  what is damaged is told when it is read
    readable: list[LogFiles] = []
    for path in paths:
        try:
            readable.append(LogFiles(path, ignore))
        except LogError as error:
            problems.append(str(error))
    if not readable:
        raise LogError(problems[-1])
    try:
        return Fleet([log.path for log in readable], ignore), []
    except LogError:
        if len({log.drone_id for log in readable}) < len(readable):
            raise  # two logs of one drone
    together, apart = [readable[0]], []
    for log in readable[1:]:
        try:
            Fleet([*(known.path for known in together), log.path], ignore)
            together.append(log)
        except LogError:
            apart.append(log)
    return Fleet([log.path for log in together], ignore), apart


def _first_us(log: LogFiles) -> float:
    return next((raw.log_time_ns / 1000 for raw in log.messages()), 0.0)


def _mission(files: Sequence[LogFiles]) -> dict[str, Any]:
    """The mission as a log's metadata tells it, empty where none does."""
    for log in files:
        try:
            mission = json.loads(log.metadata.get("mission", ""))
        except ValueError:
            continue
        if isinstance(mission, dict):
            return mission
    return {}


def _camera(mission: dict[str, Any]) -> Pinhole:
    try:
        camera = mission["camera"]
        size = int(camera["width_px"]), int(camera["height_px"])
        return Pinhole(size, float(np.radians(camera["vfov_deg"])))
    except (KeyError, TypeError, ValueError):
        return DEFAULT_CAMERA
