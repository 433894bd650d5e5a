"""Ground truth of a rendered view: the box of each animal in pixels, and how much of it can be seen."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from drivers.sim.render.scene import AnimalView
from drivers.sim.render.species import Species, species_named
from drivers.sim.render.sprites import PHASES, animal_ring

__all__ = ["INVISIBLE_DEPTH_M", "Labels", "body_to_ground", "label_animals", "opacity_at", "phase_index"]

Array = NDArray[np.float64]

INVISIBLE_DEPTH_M = 4.0


class Labels(NamedTuple):
    """What can be seen of the animals in one view, nearest row by row."""

    boxes: NDArray[np.float32]  # (N, 4) xyxy px, inside the image
    ids: NDArray[np.int64]  # (N,) ids of the animals
    visible: NDArray[
        np.float32
    ]  # (N,) 0 to 1: share of the outline inside the image times the opacity at its depth


def opacity_at(depth_m: float) -> float:
    """How much of an animal shows through the water: 1 at the surface, 0 from INVISIBLE_DEPTH_M."""
    below = max(depth_m, 0.0) / INVISIBLE_DEPTH_M
    return float(max(0.0, 1.0 - below) ** 1.5)


def phase_index(phase_rad: float) -> int:
    """The stroke picture that stands for a phase."""
    return round(phase_rad / (2 * np.pi) * PHASES) % PHASES


def body_to_ground(animal: AnimalView) -> Array:
    """(3, 3) from body coordinates (forward, right, 1) in body lengths to ground (n, e, 1) in metres."""
    cosine, sine = np.cos(animal.heading_rad), np.sin(animal.heading_rad)
    length = animal.length_m
    return np.array(
        [
            [length * cosine, -length * sine, animal.n_m],
            [length * sine, length * cosine, animal.e_m],
            [0, 0, 1.0],
        ]
    )


def _clip_polygon(points: Array, width: float, height: float) -> Array:
    """The part of a polygon (N, 2) inside the image, (M, 2) with M = 0 for none (Sutherland and Hodgman
    1974).
    """
    for axis, limit, side in ((0, 0.0, 1.0), (0, width, -1.0), (1, 0.0, 1.0), (1, height, -1.0)):
        inside = side * (points[:, axis] - limit)
        if np.all(inside >= 0):
            continue
        following, inside_next = np.roll(points, -1, axis=0), np.roll(inside, -1)
        crosses = (inside >= 0) != (inside_next >= 0)
        share = inside / np.where(crosses, inside - inside_next, 1.0)
        crossings = points + (following - points) * share[:, None]
        crossings[:, axis] = limit
        # Each corner that is inside, then the place where the edge after it crosses the limit.
        kept = np.stack([inside >= 0, crosses], axis=1)
        points = np.stack([points, crossings], axis=1)[kept]
        if len(points) == 0:
            break
    return points


def _area(points: Array) -> float:
    if len(points) < 3:
        return 0.0
    x, y = points[:, 0], points[:, 1]
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def label_animals(
    camera: Pinhole,
    pose: Pose,
    animals: Sequence[AnimalView],
    shapes: Mapping[str, Species] | None = None,
) -> Labels:
    """The animals of which anything shows in the view, in the order given.

    The box is the smallest upright rectangle round the part of the projected outline that lies inside the
    image. Raises ValueError when a species is not known.
    """
    to_image = camera.ground_to_image(pose)
    width, height = camera.image_size
    rows: list[tuple[Array, int, float]] = []
    for animal in animals:
        species = (shapes or {}).get(animal.species) or species_named(animal.species)
        opacity = 1.0 if animal.poster else opacity_at(animal.depth_m)
        placed = to_image @ body_to_ground(animal)
        # A poster shows the printed stroke 0, always.
        outlines = animal_ring(species, 0 if animal.poster else phase_index(animal.phase_rad))
        behind = any(np.any(ring @ placed[2, :2] + placed[2, 2] <= 1e-9) for ring in outlines)
        if opacity <= 0 or behind:
            continue
        projected = [apply_homography(placed, ring) for ring in outlines]
        clipped = [_clip_polygon(ring, width, height) for ring in projected]
        shown = sum(_area(ring) for ring in clipped) / max(sum(_area(ring) for ring in projected), 1e-9)
        if shown <= 0:
            continue
        points = np.concatenate(clipped)
        rows.append((np.concatenate([points.min(axis=0), points.max(axis=0)]), animal.id, shown * opacity))
    return Labels(
        np.array([row[0] for row in rows], np.float32).reshape(-1, 4),
        np.array([row[1] for row in rows], np.int64),
        np.array([row[2] for row in rows], np.float32),
    )
