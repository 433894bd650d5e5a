"""Who truly watched whom: one pure function of the simulator's truth and the drones' logs (docs/judge.md).

What a drone believes is never taken for true: the centre that it tracked, and the boxes that it named, go
through its *true* pose down to the surface, and the animal that really was there decides. No file is read
here; `load_run` makes the inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from procs.navigator.states import State
from tools.evidence import DroneLog, Truth, load_run
from tools.sights import (
    NOBODY,
    Interval,
    Span,
    common_monitor,
    in_image_share,
    inside,
    majority,
    monitor_spans,
    true_animals,
    watch_at,
    watch_spans,
)

__all__ = ["DroneVerdict", "Verdict", "drone_list", "judge", "load_run"]

Ids = NDArray[np.int64]

DEEP_M = 2.0  # under this an animal cannot be seen well enough to be watched
END_S = 5.0  # "at the end" is the majority over the last so many seconds
GRID_S = 0.2  # how often the fleet as a whole is looked at
DISTINCT_SHARE = 0.9  # of the window
STRAY_SHARE = 0.05  # of a drone's names may sit on the wrong animal, or on none
# Who is in one of these has given its animal up.
GOING_HOME = tuple(state.name for state in (State.RETURN, State.LAND, State.LANDED))
MIN_NAMINGS = 3  # fewer sights of one identity by one drone decide nothing


@dataclass(frozen=True)
class DroneVerdict:
    """What one drone truly did. `animal` is a number of truth.csv, `identity` the fleet's name for what it
    says it watches.
    """

    id: int
    is_assigned: bool
    animal: int | None
    identity: int | None
    monitor_s: float
    in_image_share: float | None
    watch_share: float | None  # of its sights within the window, on `animal`
    watched: tuple[Span, ...]
    names: dict[int, int]  # identity -> true animal, by majority of its labels within the window
    stray_share: float  # of its labels within the window, not on the majority's animal


@dataclass(frozen=True)
class Verdict:
    """The judgement of a run; `distinct` and `consensus` are None where the animals' places are not known."""

    distinct: bool | None
    consensus: bool | None
    episodes: int
    seconds_to_monitor: float | None
    monitor_window_s: tuple[float, float] | None
    distinct_share: float | None
    drones: tuple[DroneVerdict, ...]
    reasons: tuple[str, ...]


def judge(truth: Truth, drones: Sequence[DroneLog]) -> Verdict:
    """Judge one run from truth and logs.

    The window is the longest time in which every assigned drone that lived was in MONITOR. `distinct`: at its
    end all of them truly watch different animals, as they did for 90 % of it. `consensus`: within it each
    identity names one animal, the same on every drone, each drone's own animal is named by it, and each
    assigned drone's newest episode claims consensus. Every "no" has its reason in words.
    """
    assigned = [drone for drone in drones if _is_assigned(drone)]
    windows = common_monitor(truth, assigned)
    window = max(windows, key=lambda span: span[1] - span[0], default=None)
    verdicts = tuple(_judge_drone(truth, drone, window, drone in assigned) for drone in drones)
    distinct: bool | None = None
    consensus: bool | None = None
    share: float | None = None
    if not truth.is_labelled:
        reasons = [
            "nobody knows where the animals of this scene were: distinct and consensus cannot be judged"
        ]
    elif window is None:
        distinct = consensus = False
        reasons = [_why_no_window(truth, drones, assigned)]
    else:
        share, apart = _judge_distinct(truth, assigned, verdicts, window)
        disputes = _judge_consensus(truth, drones, verdicts, window)
        distinct, consensus = not apart, not disputes
        reasons = [*apart, *disputes] or [_praise(truth, verdicts, window)]
    return Verdict(
        distinct=distinct,
        consensus=consensus,
        episodes=len(
            {labels.episode for drone in drones for labels in drone.labels if labels.episode[0] > 0}
        ),
        seconds_to_monitor=windows[0][0] if windows else None,
        monitor_window_s=window,
        distinct_share=share,
        drones=verdicts,
        reasons=tuple(reasons),
    )


def _is_assigned(drone: DroneLog) -> bool:
    """It watched at some time, or its last word before it went home was that it has an animal."""
    if monitor_spans(drone):
        return True
    out = [t_s for t_s, state in drone.states if state not in GOING_HOME]
    words = [identity for t_s, identity in drone.assignments if not out or t_s <= out[-1]]
    return bool(words and words[-1] >= 0)


def _is_alive(truth: Truth, drone_id: int, t_s: float) -> bool:
    return truth.deaths.get(drone_id, np.inf) > t_s


def _judge_drone(truth: Truth, drone: DroneLog, window: Interval | None, is_assigned: bool) -> DroneVerdict:
    spans = monitor_spans(drone)
    seen = inside(drone.track_t_s, spans)
    t_s, identities = drone.track_t_s[seen], drone.track_ids[seen]
    animals = true_animals(truth, drone.id, t_s, drone.track_px[seen])
    in_window = inside(t_s, [window] if window else [])
    at_end = in_window & (t_s >= (t_s[in_window][-1] - END_S if in_window.any() else 0))
    animal = majority(animals[at_end])
    names, stray_share = _names(truth, drone, window)
    return DroneVerdict(
        id=drone.id,
        is_assigned=is_assigned,
        animal=animal,
        identity=majority(identities[at_end]),
        monitor_s=float(sum(to_s - from_s for from_s, to_s in spans)),
        in_image_share=in_image_share(truth, drone.id, spans, t_s, animals),
        watch_share=None if animal is None else float(np.mean(animals[in_window] == animal)),
        watched=tuple(watch_spans(t_s, animals)),
        names=names,
        stray_share=stray_share,
    )


def _names(truth: Truth, drone: DroneLog, window: Interval | None) -> tuple[dict[int, int], float]:
    """(identity -> the true animal under most of the boxes that a drone gave it, share of its labels that sit
    elsewhere).
    """
    labels = [
        label for label in drone.labels if window and window[0] <= label.t_s <= window[1] and len(label.ids)
    ]
    if not labels:
        return {}, 0.0
    t_s = np.concatenate([np.full(len(label.ids), label.t_s) for label in labels])
    identities = np.concatenate([label.ids for label in labels])
    animals = true_animals(truth, drone.id, t_s, np.concatenate([label.centres_px for label in labels]))
    names, n_right = {}, 0
    for identity in np.unique(identities).tolist():
        named = animals[identities == identity]
        animal = majority(named)
        if animal is not None:
            n_right += int((named == animal).sum())
            if len(named) >= MIN_NAMINGS:
                names[identity] = animal
    return names, 1 - n_right / len(identities)


def _why_no_window(truth: Truth, drones: Sequence[DroneLog], assigned: Sequence[DroneLog]) -> str:
    if not any(monitor_spans(drone) for drone in drones):
        ends = [
            f"drone {drone.id} died at {truth.deaths[drone.id]:.1f} s"
            if drone.id in truth.deaths
            else f"drone {drone.id} ended in {drone.states[-1][1] if drone.states else 'silence'}"
            for drone in drones
        ]
        return "no drone ever came to MONITOR: " + ", ".join(ends)
    late = [drone.id for drone in assigned if not monitor_spans(drone)]
    if late:
        return f"{drone_list(late)} had an animal to watch but never came to MONITOR"
    return "the drones were never all in MONITOR at the same time"


def _judge_distinct(
    truth: Truth, assigned: Sequence[DroneLog], verdicts: Sequence[DroneVerdict], window: Interval
) -> tuple[float, list[str]]:
    """(share of the window in which all watched different animals, why they are not distinct: empty where
    they are).
    """
    reasons = []
    living = [v for v in verdicts if v.is_assigned and _is_alive(truth, v.id, window[1])]
    n_alive = sum(_is_alive(truth, v.id, window[1]) for v in verdicts)
    if len(living) < min(n_alive, len(truth.animals)):
        reasons.append(
            f"only {len(living)} of {n_alive} living drones took an animal, "
            f"though there were {len(truth.animals)}"
        )
    reasons += [
        f"drone {v.id} watches no animal at the end of the window ({window[1]:.1f} s)"
        for v in living
        if v.animal is None
    ]
    grid_s = np.arange(window[0], window[1] + 1e-9, GRID_S)
    watch = {drone.id: watch_at(truth, drone, grid_s) for drone in assigned}
    for animal in sorted({v.animal for v in living if v.animal is not None}):
        together = [v.id for v in living if v.animal == animal]
        if len(together) > 1:
            shared = np.logical_and.reduce([watch[drone_id] == animal for drone_id in together])
            since_s = _since(shared, grid_s)
            reasons.append(
                f"{drone_list(together)} {_all(together)} watch animal {animal} from {since_s:.1f} s"
            )
    share = _distinct_share(truth, watch, [v.animal for v in living if v.animal is not None], grid_s)
    if share < DISTINCT_SHARE:
        worst = min(
            (v for v in living if v.watch_share is not None), key=lambda v: v.watch_share or 0, default=None
        )
        reasons.append(
            f"all watched different animals for only {share:.0%} of the window, {DISTINCT_SHARE:.0%} is asked"
            + (f"; worst is drone {worst.id}, over its animal for {worst.watch_share:.0%}" if worst else "")
        )
    return share, reasons


def _distinct_share(
    truth: Truth, watch: dict[int, Ids], animals: Sequence[int], grid_s: NDArray[np.float64]
) -> float:
    """Share of the instants at which every living assigned drone watches an animal, and no two the same.

    Instants at which one of `animals` lies deep are left out: nobody can see it then.
    """
    all_apart = np.ones(len(grid_s), dtype=bool)
    rows = [(watched, grid_s < truth.deaths.get(drone_id, np.inf)) for drone_id, watched in watch.items()]
    for i, (watched, on_duty) in enumerate(rows):
        all_apart &= ~on_duty | (watched != NOBODY)
        for other, other_on_duty in rows[:i]:
            all_apart &= ~on_duty | ~other_on_duty | (watched != other)
    places = [truth.animal_ids.index(animal) for animal in animals]
    is_up = ~(truth.animals_at(grid_s)[:, places, 3] > DEEP_M).any(axis=1)
    return float(all_apart[is_up].mean()) if is_up.any() else 0.0


def _since(shared: NDArray[np.bool_], grid_s: NDArray[np.float64], gap_s: float = 1.0) -> float:
    """When the last stretch of `shared` began, over gaps of up to `gap_s`; the end where there is none."""
    start, gap = len(shared) - 1, 0
    for index in range(len(shared) - 1, -1, -1):
        gap = 0 if shared[index] else gap + 1
        if gap * GRID_S > gap_s:
            break
        if shared[index]:
            start = index
    return float(grid_s[start])


def _judge_consensus(
    truth: Truth, drones: Sequence[DroneLog], verdicts: Sequence[DroneVerdict], window: Interval
) -> list[str]:
    """Why the identities are not agreed; empty where they are."""
    reasons = _disputed_names(verdicts)
    is_alone = sum(_is_alive(truth, drone.id, window[0]) for drone in drones) == 1
    for drone, verdict in zip(drones, verdicts, strict=True):
        if verdict.stray_share >= STRAY_SHARE:
            reasons.append(
                f"drone {drone.id} put {verdict.stray_share:.0%} of its names on another animal or on none, "
                f"under {STRAY_SHARE:.0%} is allowed"
            )
        if not verdict.is_assigned:
            continue
        newest = [label for label in drone.labels if window[0] <= label.t_s <= window[1]]
        if not newest:
            reasons.append(f"drone {drone.id} said no identities within the window")
        elif not newest[-1].consensus and not is_alone:
            number, proposer = newest[-1].episode
            reasons.append(
                f"drone {drone.id} holds no consensus: its newest episode is {number} by drone {proposer}"
                if number
                else f"drone {drone.id} holds no consensus: it never finished an episode"
            )
        reasons += _own_animal(verdict) if newest else []
    return reasons


def _own_animal(verdict: DroneVerdict) -> list[str]:
    """What is wrong with a drone's name for the animal that it truly watches."""
    if verdict.animal is None:
        return []
    if verdict.animal not in verdict.names.values():
        return [f"drone {verdict.id} watches animal {verdict.animal} but never named it"]
    named = verdict.names.get(verdict.identity) if verdict.identity is not None else None
    if named is not None and named != verdict.animal:
        return [
            f"drone {verdict.id} says that it watches identity {verdict.identity}, which is animal {named}, "
            f"but it watches animal {verdict.animal}"
        ]
    return []


def _disputed_names(verdicts: Sequence[DroneVerdict]) -> list[str]:
    """Identities that stand for two animals, and animals with two identities, over all drones."""
    by_identity: dict[int, dict[int, list[int]]] = {}
    by_animal: dict[int, dict[int, list[int]]] = {}
    for verdict in verdicts:
        for identity, animal in verdict.names.items():
            by_identity.setdefault(identity, {}).setdefault(animal, []).append(verdict.id)
            by_animal.setdefault(animal, {}).setdefault(identity, []).append(verdict.id)
    reasons = []
    for identity, animals in sorted(by_identity.items()):
        if len(animals) > 1:
            who = ", ".join(
                f"animal {animal} for {drone_list(ids)}" for animal, ids in sorted(animals.items())
            )
            reasons.append(f"identity {identity} is not one animal: {who}")
    for animal, identities in sorted(by_animal.items()):
        if len(identities) > 1:
            who = ", ".join(
                f"{identity} by {drone_list(ids)}" for identity, ids in sorted(identities.items())
            )
            reasons.append(f"animal {animal} has {len(identities)} identities: {who}")
    return reasons


def _praise(truth: Truth, verdicts: Sequence[DroneVerdict], window: Interval) -> str:
    pairs = [
        f"drone {v.id} over animal {v.animal}"
        for v in verdicts
        if v.is_assigned and v.animal is not None and _is_alive(truth, v.id, window[1])
    ]
    return f"identities agreed and held from {window[0]:.1f} to {window[1]:.1f} s: " + ", ".join(pairs)


def drone_list(ids: Sequence[int]) -> str:
    """In words: drone 1; drones 1 and 3; drones 1, 2 and 3."""
    words = [str(i) for i in ids]
    if len(words) == 1:
        return f"drone {words[0]}"
    return f"drones {', '.join(words[:-1])} and {words[-1]}"


def _all(ids: Sequence[int]) -> str:
    return "both" if len(ids) == 2 else "all"
