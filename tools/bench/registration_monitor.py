"""MONITOR: each drone over its own animal, its boxes named by the map and by its own pose."""

import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pose
from procs.registrar.map import MapAnimal
from procs.registrar.monitor import name_by_map
from procs.registrar.ring import ViewGeometry
from tools.bench.registration_scenes import (
    CAMERA,
    IMAGE_SIZE,
    Cell,
    View,
    detected,
    draw_pod,
    trial_rng,
    true_boxes,
)

__all__ = ["MonitorScene", "draw_monitor", "monitor_counts"]

Array = NDArray[np.float64]

MOST_SHARED = 3  # boxes that two neighbours on the ring have in common
HEIGHTS_M = (20.0, 75.0)  # so that neighbours share none, one, two or three
OFF_CENTRE_M = 1.5  # standard deviation of how well the servo holds its animal in the middle
# How far off a drone believes itself to be, standard deviations; the position's holds north and east each.
POSITION_ERROR_M, HEADING_ERROR_RAD, HEIGHT_ERROR = 1.5, float(np.deg2rad(5.0)), 0.02
# How far off the map is: it was made from views like these.
MAP_ERROR_M, MAP_SIZE_ERROR, MAP_AXIS_ERROR_RAD = 0.5, 0.03, float(np.deg2rad(5.0))


@dataclass(frozen=True)
class MonitorScene:
    """The fleet's map, its ids the animals' numbers; the drones' views in ring order, and what each believes
    of its camera.
    """

    animals: list[MapAnimal]
    views: list[View]
    believed: list[ViewGeometry]


def draw_monitor(cell: Cell, rng: np.random.Generator) -> MonitorScene:
    """`cell.n_views` drones, each over its own of `cell.n_animals`; drawn again until each sees its own
    animal and no two neighbours share more than MOST_SHARED boxes.
    """
    centres, outlines = draw_pod(cell.n_animals, rng)
    while True:
        own = rng.permutation(cell.n_animals)[: cell.n_views]
        views = [_view_over(int(animal), centres, outlines, cell, rng) for animal in own]
        seen = [set(view.animals.tolist()) for view in views]
        shared = [len(one & other) for one, other in pairwise([*seen, seen[0]])]
        if max(shared) <= MOST_SHARED and all(
            int(animal) in one for animal, one in zip(own, seen, strict=True)
        ):
            break
    animals = [
        _mapped(number, centre, outline, rng)
        for number, (centre, outline) in enumerate(zip(centres, outlines, strict=True))
    ]
    return MonitorScene(animals, views, [_believed(view.pose, rng) for view in views])


def _view_over(animal: int, centres: Array, outlines: Array, cell: Cell, rng: np.random.Generator) -> View:
    n_m, e_m = (centres[animal] + rng.normal(0.0, OFF_CENTRE_M, 2)).tolist()
    direction, tilt = rng.uniform(0, 2 * np.pi), cell.tilt_rad * np.sqrt(rng.uniform())
    pose = Pose(
        *(n_m, e_m, -rng.uniform(*HEIGHTS_M), tilt * np.cos(direction), tilt * np.sin(direction)),
        rng.uniform(0, 2 * np.pi),
    )
    return detected(true_boxes(centres, outlines, CAMERA.ground_to_image(pose)), pose, cell, rng)


def _mapped(number: int, centre: Array, outline: Array, rng: np.random.Generator) -> MapAnimal:
    n_m, e_m = (centre + rng.normal(0.0, MAP_ERROR_M, 2)).tolist()
    sides = outline.max(axis=0) - outline.min(axis=0)
    head = outline[0] - outline.mean(axis=0)
    axis_rad = float(np.arctan2(head[1], head[0]) + rng.normal(0.0, MAP_AXIS_ERROR_RAD)) % np.pi
    size_m = float(np.hypot(*sides) * np.exp(rng.normal(0.0, MAP_SIZE_ERROR)))
    return MapAnimal(n_m, e_m, size_m, axis_rad, hits=3, misses=0, id=number)


def _believed(pose: Pose, rng: np.random.Generator) -> ViewGeometry:
    return ViewGeometry(
        height_m=pose.height_m * float(np.exp(rng.normal(0.0, HEIGHT_ERROR))),
        yaw_rad=pose.yaw_rad + rng.normal(0.0, HEADING_ERROR_RAD),
        n_m=pose.n_m + rng.normal(0.0, POSITION_ERROR_M),
        e_m=pose.e_m + rng.normal(0.0, POSITION_ERROR_M),
        focal_px=CAMERA.focal_px,
        roll_rad=pose.roll_rad,
        pitch_rad=pose.pitch_rad,
    )


def monitor_counts(cell: Cell, seed: int, trials: Iterable[int]) -> Counter[str]:
    """Over these trials: fleets `n`, `boxes`, those named `right`, those `unnamed`, and `microseconds`."""
    counts: Counter[str] = Counter()
    for trial in trials:
        scene = draw_monitor(cell, trial_rng(seed, cell.name, trial))
        counts["n"] += 1
        for view, believed in zip(scene.views, scene.believed, strict=True):
            began = time.process_time()
            named = name_by_map(view.boxes, scene.animals, believed, image_size=IMAGE_SIZE)
            counts["microseconds"] += round(1e6 * (time.process_time() - began))
            counts.update(
                boxes=len(view.boxes),
                right=int((named.identities == view.animals).sum()),
                unnamed=int((named.identities < 0).sum()),
            )
    return counts
