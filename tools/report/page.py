"""The page: findings and figures as HTML, what moves as compact JSON for the page's own script.

Nothing that comes from a log reaches the page unescaped: HTML through the template's escaping, JSON with its
angle brackets as escapes, and a content policy lets run only the script whose hash it names.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from lcmtypes import channels
from procs.autopilot.telemetry import EARLIEST_UTC_US, LATEST_UTC_US
from tools.report import words
from tools.report.events import Event, list_events
from tools.report.findings import GRAVE, NOTE, Finding, find_findings, sentence
from tools.report.flights import Flight, read_flight
from tools.report.payload import payload_of
from tools.report.series import Chart, make_charts
from tools.report.stills import Still, best_stills, camera_stills
from tools.report.watching import AnimalStory, animal_stories, watched_spans
from tools.report.ways import find_ways
from tools.sights import Span, state_spans

__all__ = ["Section", "make_report", "make_section", "render", "write_report"]

PICTURE_BYTES = 1_500_000  # of all cameras' pictures on one page, as text
PICTURE_MEAN_BYTES = 14_000  # of one, as text
SCRIPTS = ("map.js", "charts.js", "page.js")
FOLDER_TIME = re.compile(r"(\d{4}-\d\d-\d\d)_(\d\d)-(\d\d)-(\d\d)")
DRONE_COLOURS = 7
ANIMAL_COLOURS = 8


@dataclass(frozen=True)
class Section:
    """One mission as the template shows it."""

    key: str
    flight: Flight
    is_good: bool | None
    sentence: str
    findings: tuple[Finding, ...]
    watched: dict[int, list[Span]]
    states: dict[int, list[Span]]
    stories: tuple[AnimalStory, ...]
    best: dict[int, Still]
    charts: tuple[Chart, ...]
    events: tuple[Event, ...]
    payload: dict[str, Any]

    @property
    def end_s(self) -> float:
        return self.flight.end_s

    @property
    def began(self) -> str:
        """Date and time by a drone's GPS, else as the run's folder is named by, empty where it is not."""
        for samples in self.flight.run.messages.values():
            for t_s, state in samples.get(channels.VEHICLE_STATE, ()):
                if EARLIEST_UTC_US <= state.utc_us < LATEST_UTC_US:
                    began = datetime.fromtimestamp(state.utc_us / 1e6 - t_s, tz=UTC)
                    return began.strftime("%-d %B %Y, %H:%M UTC")
        found = FOLDER_TIME.match(self.flight.name)
        if not found:
            return ""
        return datetime.fromisoformat(f"{found[1]}T{found[2]}:{found[3]}").strftime("%-d %B %Y, %H:%M")

    @property
    def wrong(self) -> list[Finding]:
        return [finding for finding in self.findings if finding.rank < NOTE]

    @property
    def notes(self) -> list[Finding]:
        return [finding for finding in self.findings if finding.rank >= NOTE]

    @property
    def watched_s(self) -> float:
        return sum(story.watched_s for story in self.stories)

    @property
    def n_watched(self) -> int:
        return sum(1 for story in self.stories if story.watched_s)

    @property
    def ticks(self) -> list[float]:
        """Instants of the time axis, in s."""
        steps = (10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200)
        step_s = next((step for step in steps if self.end_s / step <= 8), 14400)
        return [k * float(step_s) for k in range(math.ceil(self.end_s / step_s))]


def make_report(folder: Path) -> Path:
    """Write report.html into a run's folder -> its path. Raises LogError where it holds no drone's log."""
    return write_report([read_flight([folder])], folder / "report.html")


def write_report(flights: Sequence[Flight], out: Path) -> Path:
    """Write one page for one or several missions -> its path. Raises OSError where it cannot be written."""
    sections = [make_section(f"m{k}", flight, len(flights)) for k, flight in enumerate(flights)]
    out.write_text(render(sections), encoding="utf-8")
    return out


def make_section(key: str, flight: Flight, n_flights: int = 1) -> Section:
    """All that the page says of one mission; pictures as many as leave room for the others'."""
    watched = watched_spans(flight)
    is_good, words_of_it = sentence(flight, watched)
    ways = find_ways(flight)
    states = {log.id: state_spans(log.states) for log in flight.run.drones}
    stills = camera_stills(flight, PICTURE_BYTES // PICTURE_MEAN_BYTES // n_flights)
    events = tuple(list_events(flight, watched))
    return Section(
        key,
        flight,
        is_good,
        words_of_it,
        tuple(find_findings(flight, watched, is_good)),
        watched,
        states,
        tuple(animal_stories(flight, watched, ways.lengths_m)),
        best_stills(flight),
        (charts := tuple(make_charts(flight))),
        events,
        payload_of(flight, ways, states, watched, stills, charts),
    )


def render(sections: Sequence[Section]) -> str:
    """The page of one mission, or of a day of several."""
    here = files("tools.report")
    script = "\n".join(here.joinpath(name).read_text(encoding="utf-8") for name in SCRIPTS)
    digest = base64.b64encode(hashlib.sha256(f"\n{script}\n".encode()).digest()).decode("ascii")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(
        clock=words.clock,
        lasting=lambda span_s: words.lasting(span_s).replace(" ", "\xa0"),
        state_words=words.state_words,
        state_colour=words.state_colour,
        kind_words=lambda kind: words.KIND_WORDS.get(kind, kind),
        drone_colour=lambda drone_id: f"var(--d{(drone_id - 1) % DRONE_COLOURS + 1})",
        animal_colour=lambda number: f"var(--a{number % ANIMAL_COLOURS + 1})",
    )
    template = environment.from_string(here.joinpath("page.html.j2").read_text(encoding="utf-8"))
    return template.render(
        sections=sections,
        is_day=len(sections) > 1,
        day_sentence=_day_sentence(sections),
        style=here.joinpath("page.css").read_text(encoding="utf-8"),
        script=script,
        script_hash=f"sha256-{digest}",
        data=_json([section.payload for section in sections]),
        states=words.STATE_WORDS,
        grave=GRAVE,
    )


def _day_sentence(sections: Sequence[Section]) -> str:
    parts = [
        (sum(section.is_good is True for section in sections), "went well"),
        (sum(section.is_good is False for section in sections), "did not"),
        (sum(section.is_good is None for section in sections), "cannot be judged"),
    ]
    told = [f"{words.count(n, 'x').removesuffix('s').removesuffix(' x')} {what}" for n, what in parts if n]
    return f"{words.count(len(sections), 'mission').capitalize()}: {', '.join(told)}."


def _json(data: Any) -> str:
    """Compact JSON that closes no script element and starts no comment, whatever names it holds."""
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
