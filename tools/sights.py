"""What a drone truly saw and when: states as spans of time, and pixels through the true pose to the animal
that really was there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pose, apply_homography
from tools.evidence import DroneLog, Truth

__all__ = [
    "NOBODY",
    "Interval",
    "Span",
    "common_monitor",
    "in_image_share",
    "inside",
    "majority",
    "monitor_spans",
    "state_spans",
    "true_animals",
    "watch_at",
    "watch_spans",
]

Array = NDArray[np.float64]
Ids = NDArray[np.int64]
Interval = tuple[float, float]

NOBODY = -1
REACH_LENGTHS = 0.6  # a point this near to an animal's middle, in its own lengths, is on that animal
STATE_LIFE_S = 3.0  # a state that is not said again for so long is over
TRACK_LIFE_S = 0.5  # the same for a sight, as in the channel table


@dataclass(frozen=True)
class Span:
    """Simulation time from..to in which `what` held: a state's name, or the id of a watched animal."""

    from_s: float
    to_s: float
    what: str | int


def true_animals(truth: Truth, drone_id: int, t_s: Array, points_px: Array) -> Ids:
    """(N,) animals that really were under (N, 2) pixels of a drone's camera at (N,) instants; NOBODY where
    there was none.

    The point goes through the drone's true pose to the surface; the nearest animal within REACH_LENGTHS of
    its length counts.
    """
    if not len(t_s) or not truth.animals or drone_id not in truth.drones:
        return np.full(len(t_s), NOBODY, dtype=np.int64)
    ground = np.full((len(t_s), 2), np.nan)
    for index, (row, point) in enumerate(zip(truth.drone_at(drone_id, t_s), points_px, strict=True)):
        pose = Pose(*row)
        if np.isfinite(point).all() and pose.height_m > 0:
            ground[index] = apply_homography(truth.camera.image_to_ground(pose), point)[0]
    animals = truth.animals_at(t_s)
    distance = np.linalg.norm(animals[:, :, :2] - ground[:, None], axis=2) / animals[:, :, 2]
    distance = np.where(np.isfinite(distance), distance, np.inf)
    nearest = distance.argmin(axis=1)
    is_there = distance[np.arange(len(t_s)), nearest] <= REACH_LENGTHS
    return np.where(is_there, np.array(truth.animal_ids)[nearest], NOBODY).astype(np.int64)


def watch_at(truth: Truth, drone: DroneLog, grid_s: Array) -> Ids:
    """(G,) the animal truly watched at each instant: that of the newest sight, NOBODY where it is older than
    TRACK_LIFE_S.
    """
    watched = np.full(len(grid_s), NOBODY, dtype=np.int64)
    if not len(drone.track_t_s):
        return watched
    newest = np.searchsorted(drone.track_t_s, grid_s, side="right") - 1
    is_fresh = (newest >= 0) & (grid_s - drone.track_t_s[np.maximum(newest, 0)] <= TRACK_LIFE_S)
    picked = newest[is_fresh]
    watched[is_fresh] = true_animals(truth, drone.id, drone.track_t_s[picked], drone.track_px[picked])
    return watched


def watch_spans(t_s: Array, animals: Ids, bin_s: float = 1.0) -> list[Span]:
    """Who was watched when, from (N,) sights: the majority of each bin, equal neighbours as one span."""
    spans: list[Span] = []
    if not len(t_s):
        return spans
    bins = np.floor((t_s - t_s[0]) / bin_s).astype(np.int64)
    for number in np.unique(bins).tolist():
        animal = majority(animals[bins == number])
        from_s = float(t_s[0] + number * bin_s)
        to_s = min(from_s + bin_s, float(t_s[-1]))
        if animal is None:
            continue
        if spans and spans[-1].what == animal and abs(spans[-1].to_s - from_s) < 1e-6:
            spans[-1] = Span(spans[-1].from_s, to_s, animal)
        else:
            spans.append(Span(from_s, to_s, animal))
    return spans


def majority(ids: Ids) -> int | None:
    """The most frequent animal (the lower id of equals); None where nobody was the most frequent, or for no
    sight at all.
    """
    counts = Counter(ids.tolist())
    best = min(counts, key=lambda i: (-counts[i], i), default=NOBODY)
    return None if best == NOBODY else int(best)


def in_image_share(
    truth: Truth, drone_id: int, spans: Sequence[Interval], t_s: Array, animals: Ids
) -> float | None:
    """Share of the truth's instants in `spans` at which the animal watched in that span lay inside the
    drone's image.

    t_s, animals: (N,) the drone's sights. None where there is no such instant, or no truth about the animals.
    """
    shares: list[NDArray[np.bool_]] = []
    for span in spans:
        instants = truth.t_s[inside(truth.t_s, [span])]
        animal = majority(animals[inside(t_s, [span])])
        if animal is None or drone_id not in truth.drones:
            shares.append(np.zeros(len(instants), dtype=bool))
        else:
            shares.append(_lies_in_image(truth, drone_id, animal, instants))
    every = np.concatenate(shares) if shares else np.empty(0, dtype=bool)
    return float(every.mean()) if len(every) and truth.is_labelled else None


def _lies_in_image(truth: Truth, drone_id: int, animal: int, t_s: Array) -> NDArray[np.bool_]:
    """(N,) whether the middle of an animal lay inside a drone's image."""
    places = truth.animals_at(t_s)[:, truth.animal_ids.index(animal), :2]
    points = np.full((len(t_s), 2), np.nan)
    for index, (row, place) in enumerate(zip(truth.drone_at(drone_id, t_s), places, strict=True)):
        pose = Pose(*row)
        if pose.height_m > 0:
            points[index] = apply_homography(truth.camera.ground_to_image(pose), place)[0]
    return np.asarray(((points >= 0) & (points <= truth.camera.image_size)).all(axis=1))


def state_spans(states: Sequence[tuple[float, str]]) -> list[Span]:
    """A drone's states as spans; one that was not said again for STATE_LIFE_S ends there, and the next begins
    when said.
    """
    spans: list[Span] = []
    for index, (t_s, name) in enumerate(states):
        following_s = states[index + 1][0] if index + 1 < len(states) else t_s
        to_s = min(following_s, t_s + STATE_LIFE_S)
        if spans and spans[-1].what == name and spans[-1].to_s >= t_s:
            spans[-1] = Span(spans[-1].from_s, to_s, name)
        else:
            spans.append(Span(t_s, to_s, name))
    return spans


def monitor_spans(drone: DroneLog) -> list[Interval]:
    """When a drone was in MONITOR by its own word."""
    return [(span.from_s, span.to_s) for span in state_spans(drone.states) if span.what == "MONITOR"]


def common_monitor(truth: Truth, assigned: Sequence[DroneLog]) -> list[Interval]:
    """Times in which every assigned drone that lived was in MONITOR; a death ends a drone's duty, not the
    others'.
    """
    last_s = max((span[1] for drone in assigned for span in monitor_spans(drone)), default=0.0)
    common: list[Interval] = [(0.0, last_s)]
    for drone in assigned:
        spans = monitor_spans(drone)
        if drone.id in truth.deaths and drone.states:
            spans = [*spans, (drone.states[-1][0], np.inf)]
        common = _overlaps(common, spans)
    return common if assigned else []


def _overlaps(first: Sequence[Interval], second: Sequence[Interval]) -> list[Interval]:
    """Times in both, those that touch joined."""
    joined: list[Interval] = []
    for span in sorted((max(a[0], b[0]), min(a[1], b[1])) for a in first for b in second):
        if span[0] >= span[1]:
            continue
        if joined and span[0] <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(joined[-1][1], span[1]))
        else:
            joined.append(span)
    return joined


def inside(t_s: Array, spans: Sequence[Interval]) -> NDArray[np.bool_]:
    """(N,) whether each instant lies in one of the spans."""
    within = np.zeros(len(t_s), dtype=bool)
    for from_s, to_s in spans:
        within |= (t_s >= from_s) & (t_s <= to_s)
    return within
