"""Logs made from logs: a damaged one mended, a long one cut into parts, the parts of one drone joined.

What is copied keeps its bytes, its log time and its type, also a type of another version.
"""

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from logs.exceptions import LogError
from logs.reader import info
from logs.scan import RawMessage, Scan
from logs.writer import BOOT, METADATA, LogWriter

__all__ = ["Copied", "copy_message", "merge", "open_like", "recover", "split"]

Report = Callable[[str], None]


@dataclass(frozen=True)
class Copied:
    """What went into one new log."""

    path: Path
    n_messages: int
    start_ns: int  # log time of its earliest message, 0 where it holds none
    end_ns: int  # log time of its latest message

    @property
    def span_s(self) -> float:
        return (self.end_ns - self.start_ns) / 1e9


def recover(path: Path, out: Path, report: Report) -> Copied:
    """Write every whole message of a damaged or unfinished log into a closed one at `out`.

    `report` gets a line for each damaged or missing part. Raises LogError: `path` is no log, holds no whole
    message or `out` exists.
    """
    scan = Scan(path, report)
    messages = scan.messages()
    first = next(messages, None)  # the metadata stands before the first message
    if first is None:
        raise LogError(f"{path}: no whole message is left in its {scan.n_bytes} bytes; nothing to recover")
    return _write(open_like(scan, out), [first], messages)


def split(path: Path, folder: Path, every_s: float, report: Report) -> list[Copied]:
    """Cut a log into parts of `every_s` seconds of log time, named as a restarted logger's: name.mcap,
    name.1.mcap, ...; a part without a message is not made.

    Raises LogError: no log, a period that is not above 0, a part that exists.
    """
    if every_s <= 0:
        raise LogError(f"--every {every_s:g}: a part must be longer than 0 s")
    start_ns = info(path).start_ns
    scan = Scan(path, report)
    parts: dict[int, tuple[LogWriter, list[int]]] = {}
    numbers: dict[int, int] = {}
    for raw in scan.messages():
        number = int((raw.log_time_ns - start_ns) / 1e9 // every_s)
        if number not in parts:
            numbers[number] = len(numbers)
            name = path.name if not numbers[number] else f"{path.stem}.{numbers[number]}{path.suffix}"
            parts[number] = (open_like(scan, folder / name), [])
        writer, times = parts[number]
        copy_message(writer, raw)
        times.append(raw.log_time_ns)
    done = []
    for writer, times in parts.values():
        writer.close()
        done.append(Copied(writer.path, len(times), min(times), max(times)))
    return done


def merge(paths: Sequence[Path], out: Path, report: Report) -> Copied:
    """Join logs of one drone into one, in the order of their log times.

    Raises LogError: no log, logs of several drones or boots (each has a clock of its own), `out` exists.
    """
    scans = [Scan(path, report) for path in paths]
    streams = [_started(scan) for scan in scans]
    drones: dict[str, Path] = {}
    for scan in scans:
        drones.setdefault(scan.metadata.get(METADATA, {}).get("drone_id", ""), scan.path)
    if len(drones) > 1:
        told = ", ".join(f"drone {drone or 'unknown'} in {path}" for drone, path in drones.items())
        raise LogError(
            f"these are logs of several drones, each on a clock of its own: {told}; merge the logs of "
            "one, or play several as a fleet with podwatch play"
        )
    _refuse_boots(scans)
    return _write(open_like(scans[0], out), [], heapq.merge(*streams, key=_log_time))


def _refuse_boots(scans: Sequence[Scan]) -> None:
    boots = {boot: scan.path for scan in scans if (boot := scan.metadata.get(METADATA, {}).get(BOOT, ""))}
    if len(boots) > 1:
        told = ", ".join(f"{path} of boot {boot}" for boot, path in boots.items())
        raise LogError(
            f"these are logs of several boots of a drone, each on a clock of its own: {told}; merge those of "
            "one"
        )


def open_like(scan: Scan, out: Path) -> LogWriter:
    """A new log at `out` that says of itself what the scanned one does."""
    metadata = dict(scan.metadata.get(METADATA, {}))
    drone_id = metadata.pop("drone_id", "0")
    out.parent.mkdir(parents=True, exist_ok=True)
    return LogWriter(out, drone_id=int(drone_id) if drone_id.isdigit() else 0, metadata=metadata)


def copy_message(writer: LogWriter, raw: RawMessage) -> None:
    """Add one message as another log held it."""
    foreign = (raw.type_name, raw.schema_text) if raw.type_name else None
    writer.write(raw.channel, raw.data, raw.log_time_ns // 1000, foreign)


def _write(writer: LogWriter, first: Iterable[RawMessage], rest: Iterable[RawMessage]) -> Copied:
    n_messages, start_ns, end_ns = 0, 0, 0
    for messages in (first, rest):
        for raw in messages:
            copy_message(writer, raw)
            start_ns = min(start_ns, raw.log_time_ns) if n_messages else raw.log_time_ns
            end_ns = max(end_ns, raw.log_time_ns)
            n_messages += 1
    writer.close()
    return Copied(writer.path, n_messages, start_ns, end_ns)


def _started(scan: Scan) -> Iterator[RawMessage]:
    """The scan's messages, its metadata read already."""
    messages = scan.messages()
    first = next(messages, None)
    return iter(()) if first is None else _chained(first, messages)


def _chained(first: RawMessage, rest: Iterator[RawMessage]) -> Iterator[RawMessage]:
    yield first
    yield from rest


def _log_time(raw: RawMessage) -> int:
    return raw.log_time_ns
