"""Several drones' logs as one fleet on one clock.

Each drone's log has its own clock. What the drones measured of each other in flight (LINK_STATE: "the peer's
clock is mine plus this"; FLEET_STATE: "fleet time is mine plus this") gives straight lines from clock to
clock, offset and drift, that lead from every drone to the one with the lowest id.
"""

import heapq
import re
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from statistics import median
from typing import NamedTuple

from lcmtypes import channels
from lcmtypes.podwatch import fleet_state_t
from logs.boots import boots, pictures, segments
from logs.exceptions import LogError
from logs.missions import Samples, agreeing, distinct, link_offsets, missions, report_strays
from logs.scan import RawMessage, Scan
from logs.sequence import read_head
from logs.writer import METADATA

__all__ = [
    "DroneLog",
    "Fleet",
    "FleetMessage",
    "Line",
    "find_logs",
    "fit_line",
    "list_logs",
    "measure_clocks",
]

Report = Callable[[str], None]

LEAST_SPAN_US = 20_000_000  # over less, a drift of some ppm drowns in the noise of the offsets
OUTLIER = 4.0  # times the median residual; beyond it an offset is a slow datagram's
MOST_SAMPLES = 2000  # of one link; more say nothing more
FLEET_LOG = re.compile(r"(drone_\d+)(\.\d+)?\.mcap")  # the first file may have been dropped for room


class FleetMessage(NamedTuple):
    """One message of one drone, on the clock of the fleet."""

    at_us: int  # the common clock: that of the drone with the lowest id
    drone_id: int
    raw: RawMessage


@dataclass(frozen=True)
class Line:
    """One clock by another: `y_us + rate * (clock - x_us)`."""

    x_us: float
    y_us: float
    rate: float = 1.0

    def at(self, utime: float) -> float:
        return self.y_us + self.rate * (utime - self.x_us)

    def inverse(self) -> "Line":
        return Line(self.y_us, self.x_us, 1 / self.rate)

    def then(self, other: "Line") -> "Line":
        """First this, then `other`."""
        return Line(self.x_us, other.at(self.y_us), self.rate * other.rate)


class DroneLog:
    """Everything that one drone logged in one boot: its log, the files that go on behind it, its pictures.

    `report` is told of files beside it that are of other boots. Raises LogError: no log, or one that does not
    say whose it is.
    """

    def __init__(self, path: Path, report: Report) -> None:
        self.path = path
        self._report = report
        self._logged, self._shown = segments(path), pictures(path)
        self.paths = [*self._logged, *self._shown]
        first = Scan(self.paths[0], report)
        for _ in first.messages():  # the metadata stands before the first message
            break
        self.metadata = first.metadata.get(METADATA, {})
        drone_id = self.metadata.get("drone_id", "")
        if not drone_id.isdigit():
            raise LogError(f"{path}: does not say whose log it is; make it anew with podwatch log from-lcm")
        self.drone_id = int(drone_id)
        for files in boots(path)[1:]:
            report(
                f"{path}: {', '.join(file.name for file in files)} beside it is of another boot of drone "
                f"{drone_id}, on a clock of its own, and not part of this log"
            )
        report_strays(path, report)

    def messages(self) -> Iterator[RawMessage]:
        """Every whole message by log time."""
        logged = chain.from_iterable(Scan(path, self._report).messages() for path in self._logged)
        shown = chain.from_iterable(Scan(path, self._report).messages() for path in self._shown)
        return heapq.merge(logged, shown, key=lambda raw: raw.log_time_ns)


class Fleet:
    """The logs of one or more drones on one clock, that of the lowest id.

    Raises LogError: no log, two logs of one drone, a drone whose clock nobody measured.
    """

    def __init__(self, paths: Sequence[Path], report: Report) -> None:
        self.logs = [DroneLog(path, report) for path in paths]
        owners: dict[int, Path] = {}
        for log in self.logs:
            if log.drone_id in owners:
                raise LogError(
                    f"{owners[log.drone_id]} and {log.path} are both of drone {log.drone_id}; give one, or "
                    "join them with podwatch log merge"
                )
            owners[log.drone_id] = log.path
        self.drone_ids = sorted(owners)
        self.lines = _clock_lines(self.logs) if len(self.logs) > 1 else {self.drone_ids[0]: Line(0, 0)}

    def messages(self) -> Iterator[FleetMessage]:
        """Every message of every drone by the common clock; of one instant, the lower drone's first."""
        return heapq.merge(*(self._timed(log) for log in self.logs), key=lambda entry: entry[:2])

    def _timed(self, log: DroneLog) -> Iterator[FleetMessage]:
        line = self.lines[log.drone_id]
        for raw in log.messages():
            yield FleetMessage(round(line.at(raw.log_time_ns / 1000)), log.drone_id, raw)


def list_logs(paths: Iterable[Path]) -> list[Path]:
    """The logs that people mean: files as they are, of a run's folder each drone's log; one a boot.

    Raises LogError for a folder without one.
    """
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        names = [FLEET_LOG.fullmatch(file.name) for file in path.glob("drone_*.mcap")]
        drones = sorted(path / f"{stem}.mcap" for stem in {name[1] for name in names if name})
        if not drones:
            raise LogError(f"{path}: no drone_<id>.mcap in this folder; give a run's folder, or logs")
        for log in drones:
            found += [log, *(files[0] for files in boots(log)[1:])]
    return distinct(found)


def find_logs(paths: Iterable[Path]) -> list[Path]:
    """The logs of the one mission that people mean, as `list_logs` finds them.

    Raises LogError for a folder without one, and for the logs of several missions.
    """
    found = missions(list_logs(paths), lambda _text: None)
    if len(found) > 1:
        told = "; or: ".join(" ".join(str(log) for log in logs) for logs in found)
        raise LogError(
            f"these are {len(found)} missions, as a drone's clock begins anew at each boot of its computer; "
            f"give the logs of one: {told}"
        )
    return found[0]


def measure_clocks(log: DroneLog) -> dict[int, Line]:
    """Each other drone's clock by this one's, as measured in flight: LINK_STATE's, else FLEET_STATE's."""
    return {peer: fit_line(samples) for peer, samples in _offsets(log).items()}


def _offsets(log: DroneLog) -> dict[int, Samples]:
    by_fleet: dict[int, Samples] = defaultdict(list)
    for raw in log.messages():
        if raw.channel == channels.FLEET_STATE and read_head(raw.channel, raw.data):
            state = fleet_state_t.decode(raw.data)
            living = [row.id for row in state.rows if row.alive and row.id > 0]
            if state.fleet_time_ok and living and min(living) != state.drone_id:
                by_fleet[min(living)].append((state.utime, state.fleet_offset_us))
    return {**by_fleet, **link_offsets(log.messages())}


def fit_line(samples: Sequence[tuple[int, int]]) -> Line:
    """The straight line through (clock in us, offset in us): least squares without the outliers; over a short
    span the median offset.
    """
    samples = samples[:: 1 + len(samples) // MOST_SAMPLES]
    middle = median(float(offset) for _, offset in samples)
    if samples[-1][0] - samples[0][0] < LEAST_SPAN_US:
        return Line(samples[0][0], samples[0][0] + middle)
    slope, x_us, y_us = _least_squares(samples)
    misses = [abs(y_us + slope * (utime - x_us) - offset) for utime, offset in samples]
    limit = OUTLIER * max(median(misses), 1.0)
    kept = [sample for sample, miss in zip(samples, misses, strict=True) if miss <= limit]
    slope, x_us, y_us = _least_squares(kept)
    return Line(x_us, x_us + y_us, 1 + slope)


def _least_squares(samples: Sequence[tuple[int, int]]) -> tuple[float, float, float]:
    """(slope, mean clock, mean offset)."""
    x_us = sum(utime for utime, _ in samples) / len(samples)
    y_us = sum(offset for _, offset in samples) / len(samples)
    spread = sum((utime - x_us) ** 2 for utime, _ in samples)
    return sum((utime - x_us) * (offset - y_us) for utime, offset in samples) / spread, x_us, y_us


def _clock_lines(logs: Sequence[DroneLog]) -> dict[int, Line]:
    """The line from each drone's clock to the lowest one's, by as few links as possible."""
    to_peer: dict[int, dict[int, Line]] = {log.drone_id: {} for log in logs}
    offsets = {log.drone_id: _offsets(log) for log in logs}
    for log in logs:
        for peer, samples in offsets[log.drone_id].items():
            # A peer that began anew had another clock then: what its log tells of too is of this one.
            agreed = agreeing(samples, offsets.get(peer, {}).get(log.drone_id, []))
            line = fit_line(agreed or samples)
            to_peer[log.drone_id][peer] = line
            to_peer.setdefault(peer, {}).setdefault(log.drone_id, line.inverse())
    reference = min(log.drone_id for log in logs)
    lines = {reference: Line(0, 0)}
    waiting = deque([reference])
    while waiting:
        known = waiting.popleft()
        for other in sorted(to_peer[known]):
            if other not in lines:
                lines[other] = to_peer[other][known].then(lines[known])
                waiting.append(other)
    for log in logs:
        if log.drone_id not in lines:
            raise LogError(
                f"{log.path}: drone {log.drone_id} and drone {reference} never measured each other's clocks, "
                "so their logs have no common time; give each alone"
            )
    return lines
