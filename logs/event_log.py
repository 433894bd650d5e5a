"""LCM's own event logs: what lcm-logger writes and lcm-logplayer plays.

An event is (number, time in us, channel, bytes). lcm-logger's times are the wall clock's; ours are the
drone's. Both directions keep counts, order, times and bytes.
"""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import lcm

from lcmtypes import channels
from logs.copying import Copied
from logs.exceptions import LogError
from logs.scan import LCM_EVENT_MAGIC, Scan
from logs.sequence import DRONE_ID_OFFSET, read_head
from logs.writer import LogWriter

__all__ = ["from_lcm", "to_lcm"]

LONGEST_CHANNEL = 63  # bytes of a channel's name on an LCM bus


def to_lcm(path: Path, out: Path, report: Callable[[str], None]) -> Copied:
    """Write a log's messages as an LCM event log. Raises LogError: no log, `out` exists or cannot be made."""
    scan = Scan(path, report)
    _refuse_existing(out)
    try:
        events = lcm.EventLog(str(out), "w")
    except (OSError, ValueError) as error:
        raise LogError(f"{out}: cannot be made; give a path in a folder that may be written") from error
    n_messages, start_ns, end_ns = 0, 0, 0
    for raw in scan.messages():
        if len(raw.channel.encode()) > LONGEST_CHANNEL:
            report(f"{path}: {raw.channel} is left out; LCM's channel names end at {LONGEST_CHANNEL} bytes")
            continue
        events.write_event(raw.log_time_ns // 1000, raw.channel, raw.data)
        start_ns = min(start_ns, raw.log_time_ns) if n_messages else raw.log_time_ns
        end_ns = max(end_ns, raw.log_time_ns)
        n_messages += 1
    events.close()
    return Copied(out, n_messages, start_ns, end_ns)


def from_lcm(path: Path, out: Path, drone_id: int | None = None) -> Copied:
    """Write an LCM event log's events as a drone's log.

    drone_id: whose bus it was; None takes it from the first message of a known type. Raises LogError: `path`
    is no event log, nothing says whose bus it was, `out` exists.
    """
    _check_event_log(path)
    if drone_id is None:
        drone_id = next((who for event in _events(path) if (who := _speaker(event)) is not None), None)
    if drone_id is None:
        raise LogError(f"{path}: holds no message that names its drone; say whose bus it was with --drone")
    out.parent.mkdir(parents=True, exist_ok=True)
    writer = LogWriter(out, drone_id=drone_id, metadata={"source": path.name})
    times = [0, 0]
    n_messages = 0
    for event in _events(path):
        writer.write(event.channel, event.data, event.timestamp)
        times = [min(times[0], event.timestamp) if n_messages else event.timestamp, event.timestamp]
        n_messages += 1
    writer.close()
    return Copied(out, n_messages, times[0] * 1000, times[1] * 1000)


def _events(path: Path) -> Iterator[lcm.Event]:
    log = lcm.EventLog(os.fspath(path), "r")
    try:
        yield from log
    finally:
        log.close()


def _speaker(event: lcm.Event) -> int | None:
    """Whose bus an event was on, None where it does not tell: a neighbour's copy, an unknown type."""
    if channels.split_received(event.channel) or read_head(event.channel, event.data) is None:
        return None
    return event.data[DRONE_ID_OFFSET] if len(event.data) > DRONE_ID_OFFSET else None


def _check_event_log(path: Path) -> None:
    try:
        with path.open("rb") as file:
            magic = file.read(len(LCM_EVENT_MAGIC))
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); give an LCM event log") from error
    if magic != LCM_EVENT_MAGIC:
        raise LogError(f"{path}: is no LCM event log (begins with {magic!r}); lcm-logger writes such logs")


def _refuse_existing(out: Path) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.exists():
        raise LogError(f"{out}: exists already and is not overwritten; give a path that is free")
