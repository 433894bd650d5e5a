"""What a process said then against what it says now, message by message."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from lcmtypes import channels
from tools.replaying.run import Said

__all__ = ["Account", "Difference", "Tolerance", "compare"]

# Counters and names that a new start draws anew; what the machine was doing at that time.
NEVER_COMPARED = frozenset({"seq", "ring", "token", "pid", "cpu", "memory_mb", "late_ms", "compute_us"})
NOT_IN_REAL_TIME = frozenset({"loop_hz", "rates_hz"})  # one message more or less in a second is no fault
TIMES = ("_us", "utime")
MS = "_ms"


@dataclass(frozen=True)
class Tolerance:
    """How far two messages may lie apart: in time (us), and each number by its own size."""

    time_us: int = 0
    relative: float = 0.0

    def agrees(self, name: str, recorded: Any, replayed: Any) -> bool:
        """Whether two values of the member `name` are the same."""
        if self.time_us and name in NOT_IN_REAL_TIME:
            return True
        if isinstance(recorded, str | bytes | bool):
            return bool(recorded == replayed)
        first, second = np.asarray(recorded), np.asarray(replayed)
        if first.shape != second.shape:
            return False
        slack = self.relative * np.maximum(np.abs(first), np.abs(second)) if first.size else 0.0
        if name.endswith(TIMES):
            slack = slack + self.time_us
        elif name.endswith(MS) and self.time_us:
            slack = slack + self.time_us / 1000 + 1
        return bool(np.all((np.abs(first - second) <= slack) | (np.isnan(first) & np.isnan(second))))


class Difference(NamedTuple):
    """One member that differs, or a whole message that is missing or too many."""

    at_us: int
    channel: str
    member: str  # "" for a whole message
    recorded: Any
    replayed: Any


@dataclass
class Account:
    """What the comparison of one channel found."""

    channel: str
    n_recorded: int = 0
    n_replayed: int = 0
    n_same: int = 0
    n_different: int = 0
    n_missing: int = 0  # recorded, and not said now
    n_extra: int = 0  # said now, and not recorded
    differences: list[Difference] = field(default_factory=list)

    @property
    def agrees(self) -> bool:
        return self.n_same == self.n_recorded == self.n_replayed


def compare(recorded: list[Said], replayed: list[Said], tolerance: Tolerance) -> list[Account]:
    """An account for each channel, by name. Messages are paired by their utime, in order."""
    names = sorted({said.channel for said in (*recorded, *replayed)})
    return [
        _compare_channel(
            name,
            [said for said in recorded if said.channel == name],
            [said for said in replayed if said.channel == name],
            tolerance,
        )
        for name in names
    ]


def _compare_channel(name: str, then: list[Said], now: list[Said], tolerance: Tolerance) -> Account:
    account = Account(name, len(then), len(now))
    kind = channels.kind_of(name)
    assert kind is not None  # a process says only what the table has
    for old, new in _pairs([(s, kind.decode(s.data)) for s in then], [(s, kind.decode(s.data)) for s in now],
                           tolerance):  # fmt: skip
        if new is None:
            account.n_missing += 1
            account.differences.append(Difference(old[0].at_us, name, "", "said", "not said"))
        elif old is None:
            account.n_extra += 1
            account.differences.append(Difference(new[0].at_us, name, "", "not said", "said"))
        else:
            found = list(_differing(name, old[0].at_us, old[1], new[1], tolerance))
            account.differences += found
            account.n_different += bool(found)
            account.n_same += not found
    return account


def _pairs(then: list[Any], now: list[Any], tolerance: Tolerance) -> Iterator[tuple[Any, Any]]:
    """(recorded, replayed) by utime, the nearest within the tolerance; None where there is no counterpart."""
    i = j = 0
    while i < len(then) or j < len(now):
        ahead = _ahead(then, now, i, j, tolerance.time_us)
        yield (then[i] if ahead <= 0 else None), (now[j] if ahead >= 0 else None)
        i += ahead <= 0
        j += ahead >= 0


def _ahead(then: list[Any], now: list[Any], i: int, j: int, time_us: int) -> int:
    """0 where then[i] and now[j] are a pair, -1 where then[i] stands alone, 1 where now[j] does."""
    if j == len(now) or i == len(then):
        return -1 if j == len(now) else 1
    apart_us = abs(then[i][1].utime - now[j][1].utime)
    if apart_us > time_us:
        return 1 if then[i][1].utime > now[j][1].utime else -1
    if j + 1 < len(now) and abs(then[i][1].utime - now[j + 1][1].utime) < apart_us:
        return 1
    if i + 1 < len(then) and abs(then[i + 1][1].utime - now[j][1].utime) < apart_us:
        return -1
    return 0


def _differing(
    channel: str, at_us: int, old: Any, new: Any, tolerance: Tolerance, prefix: str = ""
) -> Iterator[Difference]:
    """The members in which two messages differ; of nested structs each by its own name."""
    for name in old.__slots__:
        first, second = getattr(old, name), getattr(new, name)
        if name in NEVER_COMPARED:
            continue
        if hasattr(first, "__slots__"):
            yield from _differing(channel, at_us, first, second, tolerance, f"{prefix}{name}.")
        elif isinstance(first, list) and first and not isinstance(first[0], int | float | list | tuple):
            yield from _differing_list(channel, at_us, f"{prefix}{name}", first, second, tolerance)
        elif not _same(tolerance, name, first, second):
            yield Difference(at_us, channel, f"{prefix}{name}", first, second)


def _differing_list(
    channel: str, at_us: int, name: str, old: list[Any], new: list[Any], tolerance: Tolerance
) -> Iterator[Difference]:
    if len(old) != len(new):
        yield Difference(at_us, channel, name, f"{len(old)} entries", f"{len(new)} entries")
        return
    for index, (first, second) in enumerate(zip(old, new, strict=True)):
        if hasattr(first, "__slots__"):
            yield from _differing(channel, at_us, first, second, tolerance, f"{name}[{index}].")
        elif first != second:
            yield Difference(at_us, channel, f"{name}[{index}]", first, second)


def _same(tolerance: Tolerance, name: str, first: Any, second: Any) -> bool:
    return bool(first == second) or tolerance.agrees(name, first, second)
