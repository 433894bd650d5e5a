"""`podwatch log`: look into a drone's MCAP log. `info` says what it holds, `cat` prints its messages."""

import fnmatch
import sys
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from logs.boots import other_boots, pictures, segments
from logs.exceptions import LogError
from logs.reader import LogInfo, info, read
from logs.schemas import PACKAGE
from logs.writer import BOOT
from tools.log.names import value_name
from tools.log.shared import LogPath, app, clear_errors, size_text, warn

__all__ = ["describe", "describe_value"]

LONGEST_LIST = 8  # items of a list that `cat` prints; the rest is counted
TABLE_COLUMNS = 100
LONGEST_RAW = 16  # bytes of undecoded data that `cat` prints


@app.command("info")
def show_info(path: LogPath) -> None:
    """Say what a log holds: its span, its channels, their rates and sizes, and whether it is whole."""
    with clear_errors():
        log = info(path)
    sys.stdout.write(f"{_summary(log)}\n\n")
    # Wide enough that no name is cut, in a pipe and in a narrow terminal too.
    Console(file=sys.stdout, width=max(Console().width, TABLE_COLUMNS)).print(_table(log))
    for problem in log.problems:
        warn(problem)


@app.command("cat")
def show_messages(
    path: LogPath,
    channel: Annotated[
        list[str] | None, typer.Option("--channel", "-c", help="Only this channel; RX_* is a pattern.")
    ] = None,
    start: Annotated[float, typer.Option(help="First second, counted from the log's first message.")] = 0.0,
    end: Annotated[
        float | None, typer.Option(help="Last second, counted alike.", show_default="the log's end")
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="At most this many messages.")] = None,
) -> None:
    """Print a log's messages, one a line: seconds from the log's start, channel, members."""
    with clear_errors():
        if end is not None and end < start:
            raise LogError(f"--end {end:g} lies before --start {start:g}; give an end of at least the start")
        log = info(path)
        start_ns = log.start_ns
        printed = 0
        for name, log_time_ns, message in read(path, channels=_fitting(log, channel)):
            at_s = (log_time_ns - start_ns) / 1e9
            if at_s < start:
                continue
            if end is not None and at_s > end:
                break
            sys.stdout.write(f"{at_s:12.6f} {name} {describe(message)}\n")
            printed += 1
            if printed == limit:
                break


def _fitting(log: LogInfo, patterns: list[str] | None) -> list[str] | None:
    """The log's channels that fit the patterns, None for all. Raises LogError where one fits none."""
    if not patterns:
        return None
    present = [channel.name for channel in log.channels]
    for pattern in patterns:
        if not any(fnmatch.fnmatchcase(name, pattern) for name in present):
            raise LogError(
                f"{log.path}: has no channel {pattern}; it has {', '.join(present) or 'none'}; a pattern is "
                "'RX_*', in quotes"
            )
    return [name for name in present if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)]


def describe(message: Any) -> str:
    """A message's members on one line, each with its value's name where it has one; bytes that did not decode
    are shown by number and beginning.
    """
    if isinstance(message, bytes):
        return f"{len(message)} bytes {message[:LONGEST_RAW].hex(' ')}"
    return " ".join(_member(message, name) for name in message.__slots__)


def _member(message: Any, name: str) -> str:
    value = getattr(message, name)
    meaning = value_name(message, name)
    return f"{name}={describe_value(value)}" + (f" ({meaning})" if meaning else "")


def describe_value(value: Any) -> str:
    """One member's value; long lists are cut and counted."""
    if isinstance(value, bytes):
        return f"<{len(value)} bytes>"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        shown = [describe_value(item) for item in value[:LONGEST_LIST]]
        more = len(value) - len(shown)
        return "[" + ", ".join(shown) + (f", +{more} more" if more else "") + "]"
    if hasattr(value, "__slots__"):
        return "(" + describe(value) + ")"
    return repr(value) if isinstance(value, str) else str(value)


def _summary(log: LogInfo) -> str:
    drone = log.metadata.get("drone_id", "not said")
    lines = [
        f"{log.path}",
        f"drone {drone}, {log.n_messages} messages in {log.span_s:.3f} s, {size_text(log.n_bytes)}, "
        f"{'closed' if log.closed else 'NOT closed'}",
        f"drone clock {log.start_ns / 1e9:.6f} s to {log.end_ns / 1e9:.6f} s",
    ]
    if log.metadata.get(BOOT):
        lines.append(f"boot {log.metadata[BOOT]}")
    others = [str(segment) for segment in segments(log.path) if segment != log.path]
    if others:
        lines.append(f"the log goes on in {', '.join(others)}")
    for files in other_boots(log.path):
        told = ", ".join(map(str, files))
        lines.append(f"of another boot, on a clock of its own, and no part of this log: {told}")
    apart = [str(path) for path in pictures(log.path)]
    if apart:
        lines.append(f"its pictures are in {', '.join(apart)}")
    return "\n".join(lines)


def _table(log: LogInfo) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0))
    for heading in ("channel", "type"):
        table.add_column(heading, no_wrap=True)
    for heading in ("messages", "Hz", "size", "mean size", "lost"):
        table.add_column(heading, justify="right", no_wrap=True)
    for channel in log.channels:
        table.add_row(
            escape(channel.name),
            channel.type_name.removeprefix(f"{PACKAGE}.") or "not known",
            str(channel.n_messages),
            f"{channel.rate_hz:.2f}",
            size_text(channel.n_bytes),
            size_text(round(channel.n_bytes / channel.n_messages)),
            "-" if channel.n_lost is None else str(channel.n_lost),
        )
    return table
