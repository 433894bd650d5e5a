"""One drone's word on the map: what it saw, what it missed, and where that puts it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import inverse
from procs.registrar._chart import ViewGeometry, fits_map, local_view, map_marks, merge_sight, shifted
from procs.registrar._marks import Marks
from procs.registrar.box_icp import HEADING_PRIOR_STD_RAD, BoxAlignment, Prior
from procs.registrar.map import COUNTER_LIMIT, MAX_ANIMALS, MapAnimal, MapHeader, Memory

__all__ = ["Observer", "Register", "Sight", "with_sight", "without_sight"]

Array = NDArray[np.float64]
Register = Callable[..., BoxAlignment]

MAX_RESIDUAL_SIZES = 0.6  # root mean square, in body sizes: more is no match, whatever registration says
LEAST_COVERAGE = 0.5  # of the boxes that lie among the map's animals
SCALE_STD = 0.12  # of ln(own height over the first drone's): barometers drift by metres
MEMORY_STD_M = 15.0  # how far a pod may have moved, as a whole, since the last episode
MISS_DEPTH_SIZES = 0.5  # an animal nearer to the image's border than this is not missed


@dataclass
class Sight:
    """One drone's latest word on the map: what it saw (box row -> id), what it missed, and how sure it is."""

    ids: dict[int, int] = field(default_factory=dict)
    missed: list[int] = field(default_factory=list)
    to_chart: Array = field(default_factory=lambda: np.eye(3))
    confidence: float = 0.0
    has_pose: bool = False


class Observer:
    """One drone's boxes at the instant of an episode, and the ways to match them to a map or a memory."""

    def __init__(
        self,
        boxes: Array,
        image_size: tuple[int, int] | None,
        view: ViewGeometry | None,
        memory: Memory,
        register: Register,
    ) -> None:
        self.view, self.memory, self.register = view, memory, register
        self.marks, self.pixel_to_local = local_view(boxes, image_size, view)

    def look(self, header: MapHeader, animals: list[MapAnimal]) -> tuple[Sight, bool]:
        """Register own boxes against the map; False where there is nothing that registration could tell."""
        believed = self.believed(header)
        if not len(self.marks) or not animals:
            return Sight(to_chart=believed, confidence=1.0), not len(self.marks)
        target = map_marks(animals, header.origin, header.yaw_rad)
        prior = Prior()
        if self.view is not None:
            prior = Prior((0.0, HEADING_PRIOR_STD_RAD), (0.0, SCALE_STD))
        found = self.register(self.marks, target, prior=prior)
        if not len(found.matches):
            return Sight(to_chart=believed), False
        confidence = found.confidence if self._is_plausible(found, target) else 0.0
        ids = {int(row): animals[column].id for row, column in found.matches}
        sight = Sight(ids, [], found.transform, confidence, has_pose=True)
        sight.missed = self._missed(sight, animals, target)
        return sight, True

    def believed(self, header: MapHeader) -> Array:
        if self.view is None:
            return np.eye(3)
        return shifted(self.view.n_m - header.origin_n_m, self.view.e_m - header.origin_e_m)

    def _is_plausible(self, found: BoxAlignment, target: Marks) -> bool:
        """Residual and coverage, checked here so that no registration, however sure, is taken at its word."""
        sizes = float(np.median(target.sizes[found.matches[:, 1]]))
        mapped = self.marks.through(found.transform).centres
        low, high = target.centres.min(axis=0) - sizes, target.centres.max(axis=0) + sizes
        expected = int(((mapped > low) & (mapped < high)).all(axis=1).sum())
        apart = mapped[found.matches[:, 0]] - target.centres[found.matches[:, 1]]
        residual = float(np.sqrt((apart**2).sum(axis=1).mean()))
        return residual <= MAX_RESIDUAL_SIZES * sizes and len(found.matches) >= LEAST_COVERAGE * expected

    def _missed(self, sight: Sight, animals: list[MapAnimal], target: Marks) -> list[int]:
        """Ids of the animals that lie well inside this view and that no box of it matched."""
        if self.marks.window is None:
            return [one.id for one in animals if one.id not in sight.ids.values()]
        back = target.through(inverse(sight.to_chart))
        depth = _depth_inside(back.centres, self.marks.window) / np.maximum(back.sizes, 1e-9)
        inside = depth > MISS_DEPTH_SIZES
        return [
            one.id
            for one, is_inside in zip(animals, inside, strict=True)
            if is_inside and one.id not in sight.ids.values()
        ]

    def remembered(self, header: MapHeader, to_chart: Array, now_s: float) -> list[MapAnimal]:
        """The remembered animals in this episode's map frame, no view counted yet."""
        known = list(self.memory.known_at(now_s).newest_first().forgotten_counts())[:MAX_ANIMALS]
        if known and self.view is None and len(self.marks):
            # Pictures without geometry have no common ground: the remembered frame is found by the boxes
            # alone.
            old = map_marks(known, np.zeros(2), 0.0)
            found = self.register(self.marks.through(to_chart), old, prior=Prior())
            if len(found.matches) >= 2:
                back = old.through(inverse(found.transform))
                known = [
                    replace(
                        one,
                        n_m=float(place[0]),
                        e_m=float(place[1]),
                        size_m=float(size),
                        axis_rad=float(axis % np.pi),
                    )
                    for one, place, size, axis in zip(
                        known, back.centres, back.sizes, _axes(back), strict=True
                    )
                ]
        origin = header.origin
        return [one for one in known if fits_map(np.array([one.n_m, one.e_m]) - origin, one.size_m)]

    def match_memory(self, header: MapHeader, animals: list[MapAnimal], to_chart: Array) -> dict[int, int]:
        """Own box row -> remembered id."""
        if not animals or not len(self.marks):
            return {}
        target = map_marks(animals, header.origin, header.yaw_rad)
        prior = Prior()
        if self.view is not None:
            prior = Prior(
                (0.0, HEADING_PRIOR_STD_RAD), (0.0, SCALE_STD), (np.zeros(2), MEMORY_STD_M), np.zeros(2)
            )
        found = self.register(self.marks.through(to_chart), target, prior=prior)
        return {int(row): animals[column].id for row, column in found.matches}


def without_sight(animals: Sequence[MapAnimal], sight: Sight, n_members: int) -> list[MapAnimal]:
    """The map without one drone's earlier counts."""
    saturates = n_members > COUNTER_LIMIT  # a full counter has lost count of its views and stays
    result = []
    for one in animals:
        hit, miss = one.id in sight.ids.values(), one.id in sight.missed
        hits = one.hits - (hit and not (saturates and one.hits == COUNTER_LIMIT))
        misses = one.misses - (miss and not (saturates and one.misses == COUNTER_LIMIT))
        result.append(replace(one, hits=max(hits, 0), misses=max(misses, 0)))
    return result


def with_sight(
    header: MapHeader, animals: Sequence[MapAnimal], marks: Marks, sight: Sight, before: Sight
) -> dict[int, MapAnimal]:
    """The map by id with one drone's hits and misses; an animal that it saw in `before` is not averaged in
    again."""
    chart_marks = marks.through(sight.to_chart)
    by_id = {one.id: one for one in animals}
    for row, number in sight.ids.items():
        one = by_id[number]
        if before.ids.get(row) == number:
            by_id[number] = replace(one, hits=min(one.hits + 1, COUNTER_LIMIT))
        else:
            by_id[number] = merge_sight(one, chart_marks, row, header.origin, header.yaw_rad)
    for number in sight.missed:
        one = by_id[number]
        by_id[number] = replace(one, misses=min(one.misses + 1, COUNTER_LIMIT))
    return by_id


def _axes(marks: Marks) -> Array:
    shapes = marks.shapes[:, 0]
    return np.asarray(np.arctan2(2 * shapes[:, 0, 1], shapes[:, 0, 0] - shapes[:, 1, 1]) / 2)


def _depth_inside(points: Array, polygon: Array) -> Array:
    """(N, 2) points -> (N,) signed distance to a convex polygon's nearest edge, positive inside."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    normals = np.column_stack([-edges[:, 1], edges[:, 0]]) / np.linalg.norm(edges, axis=1, keepdims=True)
    depth = points @ normals.T - (polygon * normals).sum(axis=1)
    middle = polygon.mean(axis=0) @ normals.T - (polygon * normals).sum(axis=1)
    return np.asarray((depth * np.sign(middle)).min(axis=1))
