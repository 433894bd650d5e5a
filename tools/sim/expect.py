"""What a scenario's [expect] asks of a run, and what of it falls short."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from lcmtypes import channels
from lcmtypes.podwatch import world_state_t
from logs.reader import read
from procs.settings import LimitSettings
from tools.sim.settings import Expect

__all__ = ["Safety", "check", "flown_safely", "read_safety"]

AIRBORNE_M = 1.0  # lower than this a drone stands on the ground
# A drone keeps its limits by its own position, which is this much off at times.
POSITION_ERROR_M = 3.0


@dataclass(frozen=True)
class Safety:
    """How near the drones truly came to each other and to their limits.

    nearest_m: least 3-D distance between two living airborne drones, between `nearest` (two ids) at
    `nearest_s`; None where no two were ever in the air. breaches: each limit that a drone truly passed, in
    words.
    """

    nearest_m: float | None
    nearest: tuple[int, int] | None
    nearest_s: float | None
    breaches: tuple[str, ...]

    def __str__(self) -> str:
        if self.nearest is None:
            return "no two drones were in the air at once"
        first, second = self.nearest
        return f"nearest were drones {first} and {second}: {self.nearest_m:.1f} m at {self.nearest_s:.1f} s"


def read_safety(folder: Path, limits: LimitSettings) -> Safety:
    """`flown_safely` of a run's truth.mcap. Raises logs.exceptions.LogError where it cannot be read."""
    return flown_safely(
        (message for _, _, message in read(folder / "truth.mcap", channels=channels.WORLD_STATE)), limits
    )


def flown_safely(states: Iterable[world_state_t], limits: LimitSettings) -> Safety:
    """The safety of a flight from every state of the world, in order of time."""
    nearest: tuple[float, tuple[int, int], float] | None = None
    places: dict[int, list[tuple[float, float, float, float]]] = {}
    for state in states:
        t_s = state.utime / 1e6
        flying = [drone for drone in state.drones if drone.alive and -drone.d_m > AIRBORNE_M]
        for drone in flying:
            reach_m = float(np.hypot(drone.n_m, drone.e_m))
            places.setdefault(drone.id, []).append((t_s, reach_m, -drone.d_m, drone.vd_m_s))
        for one, other in combinations(flying, 2):
            apart_m = float(np.linalg.norm([one.n_m - other.n_m, one.e_m - other.e_m, one.d_m - other.d_m]))
            if nearest is None or apart_m < nearest[0]:
                nearest = (apart_m, (one.id, other.id), t_s)
    breaches = [breach for drone, rows in sorted(places.items()) for breach in _breaches(drone, rows, limits)]
    if nearest is None:
        return Safety(None, None, None, tuple(breaches))
    return Safety(nearest[0], nearest[1], nearest[2], tuple(breaches))


def _breaches(
    drone: int, rows: Sequence[tuple[float, float, float, float]], limits: LimitSettings
) -> list[str]:
    """The limits that one drone passed, from rows of (time, distance from the origin, height, fall)."""
    t_s, reach_m, height_m, _ = np.array(rows).T
    # Between its climb and its last descent: on its way up and down every drone is below the lowest height.
    up = np.flatnonzero(height_m >= limits.min_height_m)
    cruise = slice(int(up[0]), int(up[-1]) + 1) if len(up) else slice(0, 0)
    worst = [
        ("from the origin", reach_m, 1.0, limits.fence_radius_m, "limits.fence_radius_m"),
        ("high", height_m, 1.0, limits.max_height_m, "limits.max_height_m"),
        ("high", height_m[cruise], -1.0, limits.min_height_m, "limits.min_height_m"),
    ]
    told = []
    for what, values, sign, limit_m, name in worst:
        if len(values) and (sign * (values - limit_m)).max() > POSITION_ERROR_M:
            at = int((sign * values).argmax())
            offset = cruise.start if sign < 0 else 0
            when = f"at {t_s[at + offset]:.1f} s"
            told.append(f"drone {drone} was {values[at]:.1f} m {what} {when}; {name} is {limit_m:g}")
    return told


def check(expect: Expect, summary: Mapping[str, Any], safety: Safety | None = None) -> list[str]:
    """What of `expect` a run's summary (summary.json) and its safety fall short of, in words; empty where it
    is met.
    """
    short = [
        f"{name} is {summary[name]}, expected {wanted}: " + "; ".join(summary["reasons"])
        for name, wanted in (("distinct", expect.distinct), ("consensus", expect.consensus))
        if wanted is not None and summary[name] != wanted
    ]
    short += _check_drones(expect, [drone for drone in summary["drones"] if drone["died_s"] is None])
    to_monitor_s, episodes = summary["seconds_to_monitor"], summary["episodes"]
    if expect.max_seconds_to_monitor is not None and not (
        to_monitor_s is not None and to_monitor_s <= expect.max_seconds_to_monitor
    ):
        short.append(
            f"all watched after {to_monitor_s} s, expected within {expect.max_seconds_to_monitor:g} s"
        )
    if expect.min_episodes is not None and episodes < expect.min_episodes:
        short.append(f"{episodes} episodes, expected at least {expect.min_episodes}")
    if safety is not None:
        short += safety.breaches
        if safety.nearest_m is not None and safety.nearest_m < expect.min_distance_m:
            short.append(f"{safety}, expected at least {expect.min_distance_m:g} m")
    return short


def _check_drones(expect: Expect, living: Sequence[Mapping[str, Any]]) -> list[str]:
    """The same for what each drone that lived to the end did."""
    watching = [drone for drone in living if drone["monitor_s"] > 0]
    spare = [drone["id"] for drone in living if not drone["assigned"]]
    short = []
    if expect.drones_in_monitor is not None and len(watching) != expect.drones_in_monitor:
        ids = [drone["id"] for drone in watching]
        short.append(f"drones {ids} came to MONITOR, expected {expect.drones_in_monitor} of them")
    if expect.drones_standing_by is not None and len(spare) != expect.drones_standing_by:
        short.append(f"drones {spare} stood by to the end, expected {expect.drones_standing_by} of them")
    if expect.all_landed:
        short += [
            f"drone {drone['id']} ended in {drone['final_state']}, expected LANDED"
            for drone in living
            if drone["final_state"] != "LANDED"
        ]
    for name, least, unit in (
        ("monitor_s", expect.min_monitor_s, " s"),
        ("in_image_share", expect.min_in_image_share, ""),
    ):
        short += [
            f"{name} of drone {drone['id']} is {drone[name]}, expected at least {least:g}{unit}"
            for drone in watching
            if least is not None and not (drone[name] is not None and drone[name] >= least)
        ]
    return short
