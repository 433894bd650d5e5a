"""Words for people: what a state, a trouble, a kind of radio traffic means to who never saw the code."""

from __future__ import annotations

import re
from collections.abc import Sequence

from lcmtypes import channels

__all__ = [
    "KIND_WORDS",
    "PROCESS_WORDS",
    "STATE_WORDS",
    "clock",
    "count",
    "drones",
    "lasting",
    "plain",
    "state_words",
]

# State -> what a drone in it does, and its colour in the timeline (dark words are readable on each).
STATE_WORDS = {
    "IDLE": ("on the ground", "#f2f2f0"),
    "TAKEOFF": ("takes off", "#dcdcd8"),
    "STANDBY": ("waits", "#e9e9e4"),
    "SCOUT": ("searches", "#b7d4ea"),
    "FOUND": ("has found a pod", "#7fb2d9"),
    "RENDEZVOUS": ("gathers", "#f5d9a8"),
    "REGISTER": ("agrees which animal is which", "#f2b661"),
    "ASSIGN": ("agrees who takes which", "#e0943a"),
    "MONITOR": ("watches its animal", "#5fb58a"),
    "RETURN": ("flies home", "#d5cbe6"),
    "LAND": ("lands", "#b9a9d6"),
    "LANDED": ("landed", "#f2f2f0"),
    "HOLD": ("stopped in the air", "#e58b88"),
}
UNKNOWN_STATE = ("in a state of another version", "#ffffff")
PROCESS_WORDS = {
    "camera": "camera",
    "detector": "finding of animals",
    "registrar": "naming of animals",
    "assigner": "sharing out of animals",
    "tracker": "following of its animal",
    "navigator": "steering",
    "autopilot": "autopilot link",
    "relay": "radio",
    "logger": "recording",
}
KIND_WORDS = {
    channels.RING_EPISODE: "calls to compare views",
    channels.RING_MAP: "where the animals are",
    channels.RING_ASSIGN: "who takes which animal",
    "link": "being there: places, states, clocks",
}
# The judge's own words -> words for people; in this order.
PLAIN = (
    (r"no drone ever came to MONITOR: .*", "no drone ever came to watch an animal"),
    (r"had an animal to watch but never came to MONITOR", "had an animal to watch but never watched it"),
    (
        r"the drones were never all in MONITOR at the same time",
        "the drones never all watched at the same time",
    ),
    (r"watches no animal at the end of the window \((\S+) s\)", r"had lost its animal at the end (\1 s)"),
    (
        r"all watched different animals for only (\S+) of the window, \S+ is asked(; worst.*)?",
        r"each drone had an animal of its own for only \1 of the time in which all were watching",
    ),
    (
        r"put (\S+) of its names on another animal or on none.*",
        r"gave the wrong name to an animal in \1 of its sights",
    ),
    (
        r"holds no consensus: its newest episode is .*",
        "had not agreed with the others which animal is which",
    ),
    (r"holds no consensus: it never finished an episode", "never compared what it saw with the others"),
    (r"said no identities within the window", "named no animal while all were watching"),
    (r"says that it watches identity (\d+), which is animal (\d+)", r"believed to watch animal \2"),
    (r"\bidentity (\d+) is not one animal", r"one name (\1) stands for several animals"),
    (r"has (\d+) identities", r"has \1 names"),
)
SECONDS = re.compile(r"(\bfrom |\bat |\()(\d+(?:\.\d+)?) s\b")


def state_words(state: str) -> str:
    return STATE_WORDS.get(state, UNKNOWN_STATE)[0]


def state_colour(state: str) -> str:
    return STATE_WORDS.get(state, UNKNOWN_STATE)[1]


def plain(reason: str) -> str:
    """One of the judge's reasons without its terms, times as minutes and seconds."""
    for pattern, words in PLAIN:
        reason = re.sub(pattern, words, reason)
    return SECONDS.sub(lambda found: f"{found[1]}{clock(float(found[2]))}", reason)


def clock(t_s: float) -> str:
    """A time since the start: 1:34, 1:02:05."""
    whole = max(round(t_s), 0)
    hours, minutes, seconds = whole // 3600, whole // 60 % 60, whole % 60
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def lasting(span_s: float) -> str:
    """A length of time in words: 8 s, 1 min 3 s, 2 h 5 min."""
    whole = max(round(span_s), 0)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min" + (f" {whole % 60} s" if whole % 60 else "")
    return f"{whole // 3600} h" + (f" {whole // 60 % 60} min" if whole // 60 % 60 else "")


def drones(ids: Sequence[int]) -> str:
    """Drone 1; Drones 1 and 3: as a sentence begins."""
    words = [str(i) for i in ids]
    return f"Drone {words[0]}" if len(words) == 1 else f"Drones {', '.join(words[:-1])} and {words[-1]}"


def count(number: int, noun: str) -> str:
    small = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
    return f"{small[number] if number < len(small) else number} {noun}" + ("" if number == 1 else "s")
