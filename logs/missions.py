"""Which logs flew together: those of drones that measured each other's clocks.

Each drone of a link says how far the other's clock is ahead of its own (LINK_STATE, 1 Hz). Where both logs
tell of one contact they say the same offset at the same moment, with opposite signs; two logs of different
boots do not, as every boot begins a clock of its own.
"""

from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import combinations
from pathlib import Path

from lcmtypes import channels
from lcmtypes.podwatch import link_state_t
from logs.boots import other_boots, pictures, segments, stray_pictures, whose
from logs.exceptions import LogError
from logs.scan import RawMessage, Scan
from logs.sequence import read_head

__all__ = ["Samples", "agreeing", "distinct", "link_offsets", "missions", "report_strays"]

Samples = list[tuple[int, int]]  # (own clock in us, peer's clock less one's own in us)

NEAR_US = 3_000_000  # LINK_STATE is said once a second, by each at its own time
SAME_US = 50_000  # between two measurements of one offset; a slow way there and a fast one back parts them


def distinct(logs: Sequence[Path]) -> list[Path]:
    """Without the files that belong to another of `logs`: what goes on behind it, its pictures."""
    parts = [file for log in logs for file in (*segments(log), *pictures(log)) if file != log]
    return [log for log in dict.fromkeys(logs) if log not in parts]


def missions(logs: Sequence[Path], report: Callable[[str], None]) -> list[list[Path]]:
    """`logs`, each of one boot of one drone, as missions, each with at most one log a drone, in their order.

    Where each drone has but one boot all is one mission, as ever. Drones that were in contact longest come
    together first; `report` gets a line where a drone began anew while another's log went on.
    """
    for log in logs:
        report_strays(log, report)
    drones = [_drone(log) for log in logs]
    known = [drone for drone in drones if drone]
    if len(set(known)) == len(known) and not any(other_boots(log) for log in logs):
        return [list(logs)]
    mission_of = list(range(len(logs)))
    for _, first, second in _contacts(logs, drones):
        if mission_of[first] == mission_of[second]:
            continue
        joined = [k for k, key in enumerate(mission_of) if key in (mission_of[first], mission_of[second])]
        if len({drones[k] for k in joined}) < len(joined):
            report(
                f"{logs[first]} and {logs[second]} were in contact, but are of two missions here: a drone "
                "began anew meanwhile"
            )
            continue
        for k in joined:
            mission_of[k] = joined[0]
    found = [
        [k for k, key in enumerate(mission_of) if key == mission] for mission in dict.fromkeys(mission_of)
    ]
    return [[logs[k] for k in members] for members in _in_order(found, drones)]


def report_strays(log: Path, report: Callable[[str], None]) -> None:
    """Tell of pictures beside a log of which nobody knows that they are its own."""
    strays = ", ".join(file.name for file in stray_pictures(log))
    if strays:
        report(f"{log}: {strays} beside it may be of another boot; these pictures are left out")


def link_offsets(messages: Iterable[RawMessage]) -> dict[int, Samples]:
    """Each peer's clock against this drone's, as its LINK_STATEs say."""
    found: dict[int, Samples] = defaultdict(list)
    for raw in messages:
        if raw.channel == channels.LINK_STATE and read_head(raw.channel, raw.data):
            state = link_state_t.decode(raw.data)
            for link in state.links:
                if link.up and link.offset_us:
                    found[link.peer_id].append((state.utime, link.offset_us))
    return found


def agreeing(own: Samples, others: Samples) -> Samples:
    """Those of `own` that the other drone measured too, at that moment and with the opposite sign."""
    others = sorted(others)
    times_us = [utime for utime, _ in others]
    kept = []
    for utime, offset_us in own:
        there_us = utime + offset_us
        near = others[bisect_left(times_us, there_us - NEAR_US) : bisect_right(times_us, there_us + NEAR_US)]
        if any(abs(offset_us + back_us) <= SAME_US for _, back_us in near):
            kept.append((utime, offset_us))
    return kept


def _contacts(logs: Sequence[Path], drones: Sequence[str]) -> Iterator[tuple[int, int, int]]:
    """(measurements that agree, index of one log, of the other) of each two in contact, the longest first."""
    offsets = [link_offsets(_messages(log)) for log in logs]
    found = []
    for first, second in combinations(range(len(logs)), 2):
        if drones[first] == drones[second]:
            continue
        seen = offsets[first].get(int(drones[second] or 0), [])
        n_agree = len(agreeing(seen, offsets[second].get(int(drones[first] or 0), [])))
        if n_agree:
            found.append((n_agree, first, second))
    yield from sorted(found, key=lambda contact: (-contact[0], contact[1:]))


def _in_order(found: list[list[int]], drones: Sequence[str]) -> Iterator[list[int]]:
    """Missions one after the other, by their drones' logs, which are in order."""
    left = list(found)
    while left:
        waiting = [k for members in left for k in members]
        firsts = {drones[k]: k for k in sorted(waiting, reverse=True)}
        ready = (members for members in left if all(firsts[drones[k]] == k for k in members))
        following = next(ready, left[0])
        left.remove(following)
        yield following


def _messages(log: Path) -> Iterator[RawMessage]:
    for path in segments(log):
        try:
            yield from Scan(path, lambda _text: None).messages()
        except LogError:  # told when the mission is read
            continue


def _drone(log: Path) -> str:
    """The drone's id, "" where the log cannot be read or does not say it."""
    try:
        said = whose(segments(log)[0])
    except LogError:
        return ""
    return said if said.isdigit() else ""
