"""Reads a drone's log: decoded messages, and an account of what the log holds.

Any damage is survived: what is whole is read, what is not gets one LogWarning that says what is missing.
"""

import os
import struct
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lcmtypes import channels as table
from lcmtypes import podwatch
from logs.boots import pictures, segments
from logs.exceptions import LogError, LogWarning
from logs.scan import RawMessage, Scan
from logs.schemas import PACKAGE, fingerprint
from logs.sequence import GapCounter
from logs.writer import METADATA

__all__ = ["ChannelInfo", "LogInfo", "info", "pictures", "read", "segments"]

PathLike = str | os.PathLike[str]


@dataclass(frozen=True)
class ChannelInfo:
    """What a log holds of one channel."""

    name: str
    type_name: str  # "podwatch.track_t", "" where the log does not say
    n_messages: int
    n_bytes: int  # of messages, uncompressed
    rate_hz: float  # over the channel's own span, 0 with fewer than two messages
    n_lost: int | None  # missing by `seq`; None where the channel is not logged whole


@dataclass(frozen=True)
class LogInfo:
    """What a log holds."""

    path: Path
    n_bytes: int  # of the file
    n_messages: int
    start_ns: int  # log time of the earliest message, 0 in a log without one
    end_ns: int  # log time of the latest message, 0 in a log without one
    channels: tuple[ChannelInfo, ...]  # by name
    metadata: dict[str, str]  # drone_id, and what the writer was given
    closed: bool  # its logger wrote the summary; False after a kill
    problems: tuple[str, ...]  # a line for each damaged or missing part

    @property
    def span_s(self) -> float:
        return (self.end_ns - self.start_ns) / 1e9


def read(
    path: PathLike, channels: Iterable[str] | str | None = None, strict: bool = False
) -> Iterator[tuple[str, int, Any]]:
    """(channel, log time in ns of the drone's clock, message) in the order in which they were logged.

    `channels` keeps only those names (a neighbour's copies have names of their own: RX_2_RING_MAP). A message
    of an unknown fingerprint, or that does not decode, comes as its raw bytes with one LogWarning a channel;
    damage and a log that was never closed get a LogWarning each. `strict` raises LogError in place of any.

    Raises LogError, at the call: the file is missing, unreadable, empty or no MCAP file. (docs/logs.md.)
    """
    report = _raise if strict else _warn
    wanted = None if channels is None else {channels} if isinstance(channels, str) else set(channels)
    return _decoded(Scan(Path(path), report), wanted, report)


def info(path: PathLike) -> LogInfo:
    """Count what a log holds, in one pass. Raises LogError as `read` does; damage goes to `.problems`."""
    problems: list[str] = []
    scan = Scan(Path(path), problems.append)
    tallies: dict[str, _Tally] = {}
    gaps = GapCounter()
    for raw in scan.messages():
        tallies.setdefault(raw.channel, _Tally(raw.log_time_ns)).add(raw)
        gaps.see(raw.channel, raw.data)
    return LogInfo(
        path=scan.path,
        n_bytes=scan.n_bytes,
        n_messages=sum(tally.n_messages for tally in tallies.values()),
        start_ns=min((tally.start_ns for tally in tallies.values()), default=0),
        end_ns=max((tally.end_ns for tally in tallies.values()), default=0),
        channels=tuple(
            tallies[name].info(name, scan.channel_types[name], gaps.lost.get(name, 0))
            for name in sorted(tallies)
        ),
        metadata=scan.metadata.get(METADATA, {}),
        closed=scan.closed,
        problems=tuple(problems),
    )


class _Tally:
    """Running counts of one channel."""

    def __init__(self, log_time_ns: int) -> None:
        self.n_messages = self.n_bytes = 0
        self.start_ns = self.end_ns = log_time_ns

    def add(self, raw: RawMessage) -> None:
        self.n_messages += 1
        self.n_bytes += len(raw.data)
        self.start_ns = min(self.start_ns, raw.log_time_ns)
        self.end_ns = max(self.end_ns, raw.log_time_ns)

    def info(self, name: str, type_name: str, n_lost: int) -> ChannelInfo:
        span_s = (self.end_ns - self.start_ns) / 1e9
        copy = table.split_received(name)
        channel = table.BY_NAME.get(copy[1] if copy else name)
        return ChannelInfo(
            name=name,
            type_name=type_name,
            n_messages=self.n_messages,
            n_bytes=self.n_bytes,
            rate_hz=(self.n_messages - 1) / span_s if span_s > 0 else 0.0,
            n_lost=n_lost if channel and channel.log_every == 1 else None,
        )


def _decoded(
    scan: Scan, wanted: set[str] | None, report: Callable[[str], None]
) -> Iterator[tuple[str, int, Any]]:
    decoder = _Decoder(scan.path, report)
    for raw in scan.messages():
        if wanted is None or raw.channel in wanted:
            yield raw.channel, raw.log_time_ns, decoder.decode(raw)
    for name in sorted(wanted or ()):
        if table.kind_of(name) is None and name not in scan.channel_types:
            present = ", ".join(sorted(scan.channel_types)) or "none"
            report(f"{scan.path}: has no channel {name}; it has {present}")


class _Decoder:
    """Turns raw messages into objects, and reports each channel's first bytes that it cannot turn."""

    def __init__(self, path: Path, report: Callable[[str], None]) -> None:
        self._path = path
        self._report = report
        self._kinds: dict[tuple[str, str, bytes], type[Any] | None] = {}
        self._broken: dict[str, str] = {}  # channel -> first error

    def decode(self, raw: RawMessage) -> Any:
        """The message, or its bytes where no type of ours has its fingerprint or they do not decode."""
        key = (raw.channel, raw.type_name, raw.data[:8])
        if key not in self._kinds:
            self._kinds[key] = _kind(raw)
            if self._kinds[key] is None:
                self._report(self._explain(raw))
        kind = self._kinds[key]
        if kind is None:
            return raw.data
        try:
            return kind.decode(raw.data)
        except (struct.error, ValueError, IndexError, MemoryError, OverflowError) as error:
            if raw.channel not in self._broken:
                self._broken[raw.channel] = str(error)
                self._report(
                    f"{self._path}: {raw.channel} at log time {raw.log_time_ns / 1e9:.6f} s does not decode "
                    f"as {kind.__name__} ({error}, {len(raw.data)} bytes); such messages come as raw bytes"
                )
            return raw.data

    def _explain(self, raw: RawMessage) -> str:
        text = f"{self._path}: {raw.channel} carries fingerprint {raw.data[:8].hex() or '(none)'}"
        if raw.type_name:
            text += f", {raw.type_name} of another version; lcm-gen on the log's schema makes its decoder"
        else:
            text += ", of no known type"
        expected = table.kind_of(raw.channel)
        if expected is not None:
            text += f" (this version's {expected.__name__} has {fingerprint(expected).hex()})"
        return text + "; its messages come as raw bytes"


def _kind(raw: RawMessage) -> type[Any] | None:
    """The type with the message's fingerprint: the one that the log names, else the channel table's.

    Not any type with that fingerprint: two structs with the same members share one (docs/logs.md, 5).
    """
    named = getattr(podwatch, raw.type_name.removeprefix(f"{PACKAGE}."), None)
    for kind in (named, table.kind_of(raw.channel)):
        if isinstance(kind, type) and fingerprint(kind) == raw.data[:8]:
            return kind
    return None


def _warn(text: str) -> None:
    warnings.warn(text, LogWarning, stacklevel=3)


def _raise(text: str) -> None:
    raise LogError(text)
