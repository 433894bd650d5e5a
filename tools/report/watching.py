"""Who watched which animal and when, who lost it, and how long each animal was in any camera's picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pose, apply_homography
from tools.judge import DEEP_M
from tools.report.flights import Flight
from tools.sights import Interval, Span, inside, monitor_spans, watch_spans

__all__ = ["AnimalStory", "animal_stories", "lost_spans", "shared_spans", "true_number", "watched_spans"]

Array = NDArray[np.float64]

STEP_S = 0.5
LOST_S = 3.0  # a shorter gap in a watch is a blink
LEAST_HEIGHT_M = 3.0  # a drone on the ground sees nothing


@dataclass(frozen=True)
class AnimalStory:
    """What the fleet saw of one animal. in_view: when it was in any camera's picture."""

    number: int
    length_m: float | None
    watched_by: dict[int, float]  # drone -> seconds
    watched_s: float  # by any drone
    in_view: tuple[Interval, ...]

    @property
    def in_view_s(self) -> float:
        return sum(to_s - from_s for from_s, to_s in self.in_view)


def watched_spans(flight: Flight) -> dict[int, list[Span]]:
    """Drone -> whom it watched when: true animals under its mark, else those that it says it tracked."""
    if flight.knows_animals:
        return {about.id: list(about.watched) for about in flight.verdict.drones}
    spans = {}
    for log in flight.run.drones:
        seen = inside(log.track_t_s, monitor_spans(log)) & np.isfinite(log.track_px).all(axis=1)
        spans[log.id] = watch_spans(log.track_t_s[seen], log.track_ids[seen])
    return spans


def lost_spans(flight: Flight, watched: dict[int, list[Span]]) -> dict[int, list[Interval]]:
    """Drone -> stretches of its watch, LOST_S or longer, in which it had no animal under its mark."""
    lost: dict[int, list[Interval]] = {}
    for log in flight.run.drones:
        gaps: list[Interval] = []
        for from_s, to_s in monitor_spans(log):
            at_s = from_s
            for span in [s for s in watched[log.id] if s.to_s > from_s and s.from_s < to_s]:
                gaps.append((at_s, span.from_s))
                at_s = max(at_s, span.to_s)
            gaps.append((at_s, to_s))
        lost[log.id] = [gap for gap in gaps if gap[1] - gap[0] >= LOST_S]
    return lost


def shared_spans(watched: dict[int, list[Span]]) -> list[tuple[int, int, Span]]:
    """(one drone, another, when and which animal): both watched it, LOST_S or longer."""
    ids = sorted(watched)
    return [
        (one, other, Span(max(a.from_s, b.from_s), min(a.to_s, b.to_s), a.what))
        for k, one in enumerate(ids)
        for other in ids[k + 1 :]
        for a in watched[one]
        for b in watched[other]
        if a.what == b.what and min(a.to_s, b.to_s) - max(a.from_s, b.from_s) >= LOST_S
    ]


def true_number(flight: Flight, drone_id: int, identity: int) -> int | None:
    """The animal's number on the page for the fleet's name: the true one where truth is known (None where
    this drone's name stands for none), else the name itself.
    """
    if identity < 0:
        return None
    if not flight.knows_animals:
        return identity
    names = next((about.names for about in flight.verdict.drones if about.id == drone_id), {})
    return names.get(identity)


def animal_stories(
    flight: Flight, watched: dict[int, list[Span]], lengths_m: dict[int, float]
) -> list[AnimalStory]:
    """Every animal that is known, by number."""
    in_view = _truly_in_view(flight) if flight.knows_animals else _named_in_view(flight)
    numbers = {*lengths_m, *in_view, *(int(s.what) for spans in watched.values() for s in spans)}
    stories = []
    for number in sorted(number for number in numbers if number >= 0):
        mine = {drone: [s for s in spans if s.what == number] for drone, spans in sorted(watched.items())}
        stories.append(
            AnimalStory(
                number,
                lengths_m.get(number),
                {drone: _total_s(spans) for drone, spans in mine.items() if spans},
                _union_s([s for spans in mine.values() for s in spans]),
                tuple(in_view.get(number, ())),
            )
        )
    return stories


def _total_s(spans: Sequence[Span]) -> float:
    return sum(span.to_s - span.from_s for span in spans)


def _union_s(spans: Sequence[Span]) -> float:
    total, end_s = 0.0, -np.inf
    for span in sorted(spans, key=lambda span: span.from_s):
        total += max(span.to_s - max(span.from_s, end_s), 0.0)
        end_s = max(end_s, span.to_s)
    return float(total)


def _truly_in_view(flight: Flight) -> dict[int, list[Interval]]:
    """By the truth: its middle lay in the picture of a drone in the air, and near the surface."""
    truth = flight.run.truth
    t_s = np.arange(0.0, flight.end_s, STEP_S)
    animals = truth.animals_at(t_s)
    seen = np.zeros((len(t_s), len(truth.animals)), dtype=bool)
    for drone_id in truth.drones:
        alive = t_s <= truth.deaths.get(drone_id, np.inf)
        for k, row in enumerate(truth.drone_at(drone_id, t_s)):
            pose = Pose(*row)
            if alive[k] and pose.height_m > LEAST_HEIGHT_M and len(truth.animals):
                points = apply_homography(truth.camera.ground_to_image(pose), animals[k, :, :2])
                seen[k] |= ((points >= 0) & (points <= truth.camera.image_size)).all(axis=1)
    seen &= animals[:, :, 3] <= DEEP_M
    return {animal: _stretches(t_s, seen[:, k]) for k, animal in enumerate(truth.animal_ids)}


def _named_in_view(flight: Flight) -> dict[int, list[Interval]]:
    """By the drones' word: a box in a picture carried the animal's name."""
    slots: dict[int, set[int]] = {}
    for log in flight.run.drones:
        for label in log.labels:
            for identity in label.ids.tolist():
                slots.setdefault(identity, set()).add(int(label.t_s / STEP_S))
    t_s = np.arange(0.0, flight.end_s + STEP_S, STEP_S)
    return {
        identity: _stretches(t_s, np.isin(np.arange(len(t_s)), sorted(taken)))
        for identity, taken in sorted(slots.items())
    }


def _stretches(t_s: Array, is_seen: NDArray[np.bool_]) -> list[Interval]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_seen, [False]]).astype(np.int8)))
    return [(float(t_s[a]), float(t_s[b - 1] + STEP_S)) for a, b in edges.reshape(-1, 2)]
