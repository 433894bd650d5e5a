"""What the report draws: maps, timelines and camera strips as plain numbers and words that the template turns
into SVG.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcmtypes import channels
from lcmtypes.podwatch import track_t
from tools.evidence import DroneLog, Run, Truth
from tools.judge import Verdict
from tools.sights import Interval, Span, inside, monitor_spans, state_spans, watch_spans

__all__ = [
    "Map",
    "Shot",
    "Timeline",
    "animal_colour",
    "draw_map",
    "draw_timeline",
    "drone_colour",
    "pick_shots",
]

Array = NDArray[np.float64]

# Okabe and Ito (2008) for drones, Tol's light scheme for animals: both are told apart by colour-blind eyes.
DRONE_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#444444")
ANIMAL_COLOURS = ("#77AADD", "#EE8866", "#EEDD88", "#FFAABB", "#99DDFF", "#44BB99", "#BBCC33", "#AAAA00")

MAP_WIDTH = 640.0  # units of the drawing
MAP_MARGIN = 34.0
MIN_EXTENT_M = 20.0
STEP_UNITS = 1.0  # points of a track nearer than this to the last one are left out
SIGHT_S = 0.5  # boxes and tracks this near in time to a picture are drawn on it
SHOTS_BEFORE, SHOTS_WATCHING, SHOTS_AFTER = 4, 6, 2


@dataclass(frozen=True)
class Line:
    """One thing's way over the map, in drawing units."""

    id: int
    colour: str
    points: str  # of an SVG polyline
    start: tuple[float, float]
    end: tuple[float, float]
    radius: float  # half a body length for an animal, 0 for a drone


@dataclass(frozen=True)
class Map:
    """North is up, east is right; `bar` units stand for `bar_m` metres."""

    width: float
    height: float
    drones: tuple[Line, ...]
    animals: tuple[Line, ...]
    bar: float
    bar_m: float


@dataclass(frozen=True)
class Bar:
    """A stretch of time in percent of the timeline's width."""

    left: float
    width: float
    what: str | int
    from_s: float
    to_s: float


@dataclass(frozen=True)
class Timeline:
    """What each drone did, and whom it watched, over one common axis of time."""

    end_s: float
    ticks: tuple[tuple[float, str], ...]  # percent, label
    states: dict[int, tuple[Bar, ...]]
    watched: dict[int, tuple[Bar, ...]]
    window: tuple[float, float] | None  # percent from, percent wide
    is_true: bool  # watched: by the truth; else by the drones' own word


@dataclass(frozen=True)
class BoxMark:
    """A box on a picture, in px of the picture."""

    x: float
    y: float
    width: float
    height: float
    label: str
    is_own: bool  # the animal that the drone says it tracks


@dataclass(frozen=True)
class Shot:
    """What a camera saw at one instant."""

    t_s: float
    state: str
    width: int
    height: int
    uri: str
    marks: tuple[BoxMark, ...]


def drone_colour(drone_id: int) -> str:
    return DRONE_COLOURS[(drone_id - 1) % len(DRONE_COLOURS)]


def animal_colour(animal: int) -> str:
    return ANIMAL_COLOURS[(animal - 1) % len(ANIMAL_COLOURS)]


def draw_map(truth: Truth, span: Interval | None = None) -> Map:
    """True ways of drones and animals, over the whole run or over `span` of it."""
    within = inside(truth.t_s, [span]) if span else np.ones(len(truth.t_s), dtype=bool)
    within = within if within.any() else np.ones(len(truth.t_s), dtype=bool)
    drones = {
        i: rows[within & (truth.t_s <= truth.deaths.get(i, np.inf))][:, :2]
        for i, rows in truth.drones.items()
    }
    animals = {i: rows[within] for i, rows in truth.animals.items()}
    places = [
        rows[np.isfinite(rows).all(axis=1)]
        for rows in (*drones.values(), *(r[:, :2] for r in animals.values()))
    ]
    known = np.concatenate([rows for rows in places if len(rows)] or [np.zeros((1, 2))])
    middle = (known.min(axis=0) + known.max(axis=0)) / 2
    extent = np.maximum(known.max(axis=0) - known.min(axis=0) + 4.0, MIN_EXTENT_M)
    extent[1] = max(extent[1], 0.8 * extent[0])  # a tall narrow map wastes the page
    extent[0] = max(extent[0], 0.45 * extent[1])
    scale = (MAP_WIDTH - 2 * MAP_MARGIN) / extent[1]
    height = extent[0] * scale + 2 * MAP_MARGIN

    def to_units(places: Array) -> Array:
        return np.stack(
            [
                MAP_WIDTH / 2 + (places[:, 1] - middle[1]) * scale,
                height / 2 - (places[:, 0] - middle[0]) * scale,
            ],
            axis=1,
        )

    bar_m = _nice(extent[1] / 4)
    return Map(
        MAP_WIDTH,
        height,
        tuple(_line(i, drone_colour(i), to_units(rows), 0.0) for i, rows in drones.items() if len(rows)),
        tuple(
            _line(i, animal_colour(i), to_units(rows[:, :2]), float(np.nanmedian(rows[:, 2])) / 2 * scale)
            for i, rows in animals.items()
            if np.isfinite(rows).all(axis=1).any()
        ),
        bar_m * scale,
        bar_m,
    )


def _line(thing_id: int, colour: str, places: Array, radius: float) -> Line:
    places = places[np.isfinite(places).all(axis=1)]
    kept = [places[0]]
    for place in places[1:]:
        if np.abs(place - kept[-1]).max() >= STEP_UNITS:
            kept.append(place)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in kept)
    first, last = places[0], places[-1]
    return Line(
        thing_id, colour, points, (float(first[0]), float(first[1])), (float(last[0]), float(last[1])), radius
    )


def _nice(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `length`."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length)


def draw_timeline(run: Run, verdict: Verdict) -> Timeline:
    """States and watched animals of every drone; without labels, whom the drones say they watched."""
    end_s = float(run.truth.t_s[-1])
    is_true = run.truth.is_labelled
    watched = {
        about.id: about.watched if is_true else _said(log)
        for log, about in zip(run.drones, verdict.drones, strict=True)
    }
    step_s = _nice(end_s / 6)
    ticks = tuple((100 * t_s / end_s, f"{t_s:g}") for t_s in np.arange(0, end_s, step_s).tolist())
    window = verdict.monitor_window_s
    return Timeline(
        end_s,
        ticks,
        {log.id: _bars(state_spans(log.states), end_s) for log in run.drones},
        {drone_id: _bars(spans, end_s) for drone_id, spans in watched.items()},
        (100 * window[0] / end_s, 100 * (window[1] - window[0]) / end_s) if window else None,
        is_true,
    )


def _said(log: DroneLog) -> list[Span]:
    """Identities that a drone said it tracked while in MONITOR."""
    seen = inside(log.track_t_s, monitor_spans(log))
    return watch_spans(log.track_t_s[seen], log.track_ids[seen])


def _bars(spans: Sequence[Span], end_s: float) -> tuple[Bar, ...]:
    return tuple(
        Bar(100 * s.from_s / end_s, 100 * (s.to_s - s.from_s) / end_s, s.what, s.from_s, s.to_s)
        for s in spans
    )


def pick_shots(run: Run, log: DroneLog) -> list[Shot]:
    """About a dozen pictures of one drone's camera: on the way, while it watched (half of all), and after."""
    previews = [entry for entry in run.messages[log.id][channels.PREVIEW] if entry[1].format == "jpeg"]
    flown = [span for span in state_spans(log.states) if span.what not in ("IDLE", "LANDED")]
    if not previews or not flown:
        return []
    t_s = np.array([entry[0] for entry in previews])
    watched = monitor_spans(log)
    from_s, to_s = flown[0].from_s, flown[-1].to_s
    if watched:
        wanted = [
            *_spread(from_s, watched[0][0], SHOTS_BEFORE),
            *_spread(watched[0][0], watched[-1][1], SHOTS_WATCHING),
            *_spread(watched[-1][1], to_s, SHOTS_AFTER),
        ]
    else:
        wanted = _spread(from_s, to_s, SHOTS_BEFORE + SHOTS_WATCHING + SHOTS_AFTER)
    picked = sorted({int(np.abs(t_s - instant).argmin()) for instant in wanted})
    return [_shot(run, log, *previews[index]) for index in picked]


def _spread(from_s: float, to_s: float, count: int) -> list[float]:
    """`count` instants inside from..to, none at its ends; none where there is no such time."""
    if to_s - from_s < 1e-6:
        return []
    return [from_s + (to_s - from_s) * (k + 0.5) / count for k in range(count)]


def _shot(run: Run, log: DroneLog, t_s: float, preview: Any) -> Shot:
    named = _nearest(run.messages[log.id][channels.IDENTITIES], t_s)
    track = _nearest(run.messages[log.id][channels.TRACK], t_s)
    own = track.animal if track is not None and track.state in (track_t.TRACKING, track_t.PREDICTED) else -1
    marks = []
    if named is not None and named.width > 0:
        across = preview.width / named.width
        for mark, identity in zip(named.boxes, named.ids, strict=True):
            is_own = identity >= 0 and identity == own
            marks.append(_mark(mark, across, "" if identity < 0 else str(identity), is_own))
    if own >= 0 and track.width > 0 and not any(mark.is_own for mark in marks):
        marks.append(_mark(track, preview.width / track.width, str(own), True))
    uri = "data:image/jpeg;base64," + base64.b64encode(preview.data).decode("ascii")
    state = next((span.what for span in state_spans(log.states) if span.from_s <= t_s <= span.to_s), "")
    return Shot(t_s, str(state), preview.width, preview.height, uri, tuple(marks))


def _mark(edges: Any, scale: float, label: str, is_own: bool) -> BoxMark:
    return BoxMark(
        edges.left_px * scale,
        edges.top_px * scale,
        max(edges.right_px - edges.left_px, 0) * scale,
        max(edges.bottom_px - edges.top_px, 0) * scale,
        label,
        is_own,
    )


def _nearest(samples: Sequence[tuple[float, Any]], t_s: float) -> Any:
    """The message nearest in time, None where none lies within SIGHT_S."""
    best = min(samples, key=lambda sample: abs(sample[0] - t_s), default=None)
    return best[1] if best is not None and abs(best[0] - t_s) <= SIGHT_S else None
