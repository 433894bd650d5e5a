"""Where drones and animals were, on one regular grid of time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcmtypes import channels
from tools.report.flights import Flight

__all__ = ["Ways", "find_ways"]

Array = NDArray[np.float64]

MOST_INSTANTS = 1500
LONGEST_GAP_S = 3.0  # over longer silences no place is guessed
OLDEST_SIGHT_S = 10.0  # an animal that no drone saw for so long is nowhere


@dataclass(frozen=True)
class Ways:
    """(T,) instants `step_s` apart from 0; NaN where nobody knows a place.

    drones: id -> (T, 4) north, east, height in m, yaw in rad; animals: number -> (T, 2) north, east in m;
    lengths_m: number -> body length.
    """

    step_s: float
    t_s: Array
    drones: dict[int, Array]
    animals: dict[int, Array]
    lengths_m: dict[int, float]


def find_ways(flight: Flight) -> Ways:
    """From truth where it is known, else as the drones said it."""
    step_s = max(1.0, float(np.ceil(flight.end_s / MOST_INSTANTS)))
    t_s = np.arange(0.0, flight.end_s + step_s / 2, step_s)
    drones = _true_drones(flight, t_s) if flight.knows_drones else _believed_drones(flight, t_s)
    if flight.knows_animals:
        truth = flight.run.truth
        places = truth.animals_at(t_s)
        animals = {animal: places[:, k, :2] for k, animal in enumerate(truth.animal_ids)}
        lengths = {animal: float(np.nanmedian(rows[:, 2])) for animal, rows in truth.animals.items()}
    else:
        animals, lengths = _believed_animals(flight, t_s)
    return Ways(step_s, t_s, drones, animals, lengths)


def _true_drones(flight: Flight, t_s: Array) -> dict[int, Array]:
    truth = flight.run.truth
    ways = {}
    for drone_id in truth.drones:
        pose = truth.drone_at(drone_id, t_s)
        way = np.stack([pose[:, 0], pose[:, 1], -pose[:, 2], pose[:, 5]], axis=1)
        way[t_s > truth.deaths.get(drone_id, np.inf)] = np.nan
        ways[drone_id] = way
    return ways


def _believed_drones(flight: Flight, t_s: Array) -> dict[int, Array]:
    ways = {}
    for log in flight.run.drones:
        rows = [
            (at_s, state.n_m, state.e_m, -state.d_m, state.yaw_rad)
            for at_s, state in flight.run.messages[log.id][channels.VEHICLE_STATE]
            if state.position_ok and np.isfinite([state.n_m, state.e_m, state.d_m, state.yaw_rad]).all()
        ]
        if rows:
            known = np.array(rows)
            known[:, 4] = np.unwrap(known[:, 4])
            ways[log.id] = _resampled(t_s, known[:, 0], known[:, 1:])
    return ways


def _believed_animals(flight: Flight, t_s: Array) -> tuple[dict[int, Array], dict[int, float]]:
    """The fleet's map: of each animal in each second the freshest sight, of equals the nearest to the map."""
    best: dict[int, dict[int, tuple[tuple[float, float], tuple[float, ...]]]] = {}
    sizes: dict[int, list[float]] = {}
    for log in flight.run.drones:
        for at_s, named in flight.run.messages[log.id][channels.IDENTITIES]:
            for seen in named.map:
                if (
                    seen.age_ms > OLDEST_SIGHT_S * 1000
                    or not np.isfinite([seen.n_m, seen.e_m, seen.size_m]).all()
                ):
                    continue
                rank = (seen.age_ms, seen.residual_m)
                slot = best.setdefault(seen.id, {})
                if int(at_s) not in slot or rank < slot[int(at_s)][0]:
                    slot[int(at_s)] = (rank, (at_s, seen.n_m, seen.e_m))
                sizes.setdefault(seen.id, []).append(seen.size_m)
    ways = {}
    for animal, slots in sorted(best.items()):
        known = np.array([slots[second][1] for second in sorted(slots)])
        ways[animal] = _resampled(t_s, known[:, 0], known[:, 1:])
    return ways, {animal: float(np.median(sizes[animal])) for animal in ways}


def _resampled(t_s: Array, known_s: Array, values: Array) -> Array:
    """(T, K) values at t_s, NaN before the first, after the last, and in gaps."""
    places = np.stack([np.interp(t_s, known_s, column) for column in values.T], axis=1)
    after = np.searchsorted(known_s, t_s)
    before_s = np.where(after > 0, known_s[np.maximum(after - 1, 0)], np.inf)
    after_s = np.where(after < len(known_s), known_s[np.minimum(after, len(known_s) - 1)], np.inf)
    nearest = np.minimum(np.abs(t_s - before_s), np.abs(after_s - t_s))
    places[nearest > LONGEST_GAP_S] = np.nan
    return places
