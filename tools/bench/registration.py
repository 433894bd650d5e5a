"""Success of registration on pods seen through a pinhole camera, cell by cell; seeded, so that anyone gets
these figures.

Animals are 20-point outlines of whales of 7 to 13 m, 2.5 lengths apart; each view has its own heading,
height and tilt, and each edge of a box is off by a share of its side. A pair is right only where the whole
set of matches is.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from procs.registrar.box_icp import BoxAlignment, box_icp
from procs.registrar.ring import RingRegistration, register_ring

__all__ = ["Cell", "View", "draw_pod", "draw_views", "is_ring_right", "main", "pair_success", "ring_success"]

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

IMAGE_SIZE = (1280, 960)
CAMERA = Pinhole(IMAGE_SIZE, float(np.deg2rad(70.0)))
SPACING = 2.5  # lengths between neighbouring animals, at least 0.6 of it after the jitter of the layout
MEAN_LENGTH_M = 10.0


@dataclass(frozen=True)
class View:
    """What one camera's detector said: boxes (N, 4) px, and which animal each is (N,), -1 a false alarm;
    its pose.
    """

    boxes: Array
    animals: Ints
    pose: Pose


@dataclass(frozen=True)
class Cell:
    """One row of the table: the pod, the cameras and the detector's errors."""

    name: str
    n_animals: int
    n_views: int = 2
    heading_rad: float = np.pi
    height_ratio: tuple[float, float] = (0.7, 1.4)
    tilt_rad: float = float(np.deg2rad(10.0))
    jitter: float = 0.05
    missed: float = 0.0
    false: float = 0.0
    moved: float = 0.0
    shift: float = 0.0
    heading_prior: bool = False
    literal: bool = False


def draw_outlines(n: int, rng: np.random.Generator) -> Array:
    """(n, 20, 2) outlines in metres round each animal's centre, random length and heading."""
    lengths = rng.uniform(7.0, 13.0, n)
    widths = lengths * rng.uniform(0.18, 0.26, n)
    along = np.linspace(0.0, np.pi, 10)
    profile = np.sin(along) ** 0.8 * (1 + 0.35 * np.cos(along))  # the head is blunter than the tail
    half = np.column_stack([np.cos(along) / 2, profile / profile.max() / 2])
    outline = np.concatenate([half, half[::-1] * [1, -1]])
    headings = rng.uniform(0, 2 * np.pi, n)
    scaled = outline[None] * np.stack([lengths, widths], axis=1)[:, None, :]
    turn = np.stack([[np.cos(headings), -np.sin(headings)], [np.sin(headings), np.cos(headings)]]).transpose(
        2, 0, 1
    )
    return np.asarray(np.einsum("nab,npb->npa", turn, scaled))


def draw_centres(n: int, rng: np.random.Generator) -> Array:
    """(n, 2) centres in metres: a loose crowd in which no two are nearer than the spacing."""
    spacing = SPACING * MEAN_LENGTH_M
    radius = spacing * 0.75 * np.sqrt(n)
    centres = np.zeros((0, 2))
    while len(centres) < n:
        point = rng.uniform(-radius, radius, 2)
        if not len(centres) or np.linalg.norm(centres - point, axis=1).min() > spacing:
            centres = np.vstack([centres, point])
        else:
            radius *= 1.01
    return np.asarray(centres - centres.mean(axis=0))


def draw_pod(n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Centres (n, 2) and outlines (n, 20, 2) in metres."""
    return draw_centres(n, rng), draw_outlines(n, rng)


def _pose(reach_m: float, cell: Cell, heading_rad: float, ratio: float, rng: np.random.Generator) -> Pose:
    """A camera over the pod's middle, high enough that the highest ratio sees all of it."""
    half_view = CAMERA.vfov_rad / 2 - cell.tilt_rad
    height = reach_m / np.tan(half_view) * 1.02 * ratio / cell.height_ratio[0]
    direction, size = rng.uniform(0, 2 * np.pi), cell.tilt_rad * np.sqrt(rng.uniform())
    offset = rng.normal(0.0, 0.02 * height, 2)
    return Pose(
        offset[0], offset[1], -height, size * np.cos(direction), size * np.sin(direction), heading_rad
    )


def look(centres: Array, outlines: Array, pose: Pose, cell: Cell, rng: np.random.Generator) -> View:
    """The boxes of the animals whose centre is in the image, with the detector's errors, in random order."""
    homography = CAMERA.ground_to_image(pose)
    points = apply_homography(homography, (centres[:, None] + outlines).reshape(-1, 2)).reshape(
        *outlines.shape
    )
    boxes = np.concatenate([points.min(axis=1), points.max(axis=1)], axis=1)
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    seen = ((middle > 0) & (middle < IMAGE_SIZE)).all(axis=1) & (rng.uniform(size=len(boxes)) >= cell.missed)
    animals = np.flatnonzero(seen)
    boxes = boxes[animals]
    n_false = rng.binomial(len(centres), cell.false)
    if n_false and len(boxes):
        sides = (boxes[:, 2:] - boxes[:, :2])[rng.integers(len(boxes), size=n_false)]
        places = rng.uniform(0, 1, (n_false, 2)) * IMAGE_SIZE
        boxes = np.concatenate([boxes, np.concatenate([places - sides / 2, places + sides / 2], axis=1)])
        animals = np.concatenate([animals, np.full(n_false, -1)])
    sides = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    boxes = boxes + rng.normal(0.0, cell.jitter, boxes.shape) * sides
    boxes = np.concatenate(
        [np.minimum(boxes[:, :2], boxes[:, 2:]), np.maximum(boxes[:, :2], boxes[:, 2:])], axis=1
    )
    order = rng.permutation(len(boxes))
    return View(boxes[order], animals[order], pose)


def draw_views(cell: Cell, rng: np.random.Generator) -> list[View]:
    """One pod seen by `cell.n_views` cameras; animals move anew before each further view."""
    centres, outlines = draw_pod(cell.n_animals, rng)
    reach = float(np.linalg.norm(centres, axis=1).max()) + MEAN_LENGTH_M * (0.7 + 1.5 * cell.moved)
    views = []
    for index in range(cell.n_views):
        ratio = 1.0 if index == 0 else float(np.exp(rng.uniform(*np.log(cell.height_ratio))))
        heading = float(rng.uniform(-cell.heading_rad, cell.heading_rad)) if index else 0.0
        pose = _pose(reach, cell, heading, ratio, rng)
        if index and cell.shift:
            width = 2 * pose.height_m * np.tan(CAMERA.vfov_rad / 2) * IMAGE_SIZE[0] / IMAGE_SIZE[1]
            toward = rng.uniform(0, 2 * np.pi)
            pose = Pose(
                pose.n_m + cell.shift * width * np.cos(toward),
                pose.e_m + cell.shift * width * np.sin(toward),
                *(pose.d_m, pose.roll_rad, pose.pitch_rad, pose.yaw_rad),
            )
        ways = rng.uniform(0, 2 * np.pi, cell.n_animals)
        step = np.column_stack([np.cos(ways), np.sin(ways)]) * MEAN_LENGTH_M * cell.moved * (index > 0)
        views.append(look(centres + step, outlines, pose, cell, rng))
    return views


def true_matches(source: View, target: View) -> list[tuple[int, int]]:
    """Rows of (source, target) that are the same animal."""
    where = {int(animal): row for row, animal in enumerate(target.animals) if animal >= 0}
    return [(row, where[int(animal)]) for row, animal in enumerate(source.animals) if int(animal) in where]


def pair_success(
    cell: Cell, trials: int, seed: int, register: Callable[..., BoxAlignment] = box_icp
) -> dict[str, float]:
    """Shares over `trials` pairs: strictly right, precision, recall, wrong at confidence >= 0.9; and ms a
    call.
    """
    rng = np.random.default_rng(seed)
    right = sure_wrong = sure = 0
    true_found = found = true_total = 0
    elapsed = 0.0
    for _ in range(trials):
        source, target = draw_views(cell, rng)
        prior = None
        if cell.heading_prior:
            prior = (
                target.pose.yaw_rad - source.pose.yaw_rad + rng.normal(0.0, np.deg2rad(8.0)),
                np.deg2rad(8.0),
            )
        begin = time.process_time()
        answer = register(
            source.boxes,
            target.boxes,
            image_size=IMAGE_SIZE,
            heading_prior_rad=prior,
            mode="literal" if cell.literal else "robust",
        )
        elapsed += time.process_time() - begin
        wanted = set(true_matches(source, target))
        got = {(int(a), int(b)) for a, b in answer.matches}
        right += got == wanted
        sure += answer.confidence >= 0.9
        sure_wrong += answer.confidence >= 0.9 and got != wanted
        true_found, found, true_total = (
            true_found + len(got & wanted),
            found + len(got),
            true_total + len(wanted),
        )
    return {
        "right": right / trials,
        "precision": true_found / max(found, 1),
        "recall": true_found / max(true_total, 1),
        "sure": sure / trials,
        "sure_wrong": sure_wrong / trials,
        "ms": elapsed / trials * 1e3,
    }


def _is_in_another_view(row: int, view: View, others: list[View]) -> bool:
    """Whether the ground under a box lies a body inside another camera's image."""
    box = view.boxes[row]
    ground = apply_homography(CAMERA.image_to_ground(view.pose), ((box[:2] + box[2:]) / 2)[None])
    for other in others:
        place = apply_homography(CAMERA.ground_to_image(other.pose), ground)[0]
        depth = min(*place, *(IMAGE_SIZE - place))
        if depth > float(np.linalg.norm(box[2:] - box[:2])) * view.pose.height_m / other.pose.height_m:
            return True
    return False


def is_ring_right(views: list[View], registration: RingRegistration) -> bool:
    """Every animal that two views hold has one id in all of them, no two share one, and no false alarm has
    an id but one of its own, where no other view could deny it.
    """
    holders: dict[int, int] = {}
    for view in views:
        for animal in view.animals.tolist():
            holders[animal] = holders.get(animal, 0) + 1
    id_of: dict[int, int] = {}
    false_ids: list[int] = []
    for index, (view, identities) in enumerate(zip(views, registration.identities, strict=True)):
        others = views[:index] + views[index + 1 :]
        for row, (animal, identity) in enumerate(
            zip(view.animals.tolist(), identities.tolist(), strict=True)
        ):
            if animal < 0 and identity >= 0:
                if _is_in_another_view(row, view, others):
                    return False
                false_ids.append(identity)
            elif animal >= 0 and holders[animal] >= 2:
                is_same_id = identity >= 0 and id_of.setdefault(animal, identity) == identity
                if not is_same_id:
                    return False
    owners = [*id_of.values(), *false_ids]
    return len(dict.fromkeys(owners)) == len(owners)


def ring_success(cell: Cell, trials: int, seed: int) -> dict[str, float]:
    """Shares over `trials` rings: every box right, consensus among the right ones, consensus on wrong
    ones; ms a ring."""
    rng = np.random.default_rng(seed)
    right = proved = wrong_proved = repaired = 0
    elapsed = 0.0
    for _ in range(trials):
        views = draw_views(cell, rng)
        begin = time.process_time()
        answer = register_ring([view.boxes for view in views], image_size=IMAGE_SIZE)
        elapsed += time.process_time() - begin
        is_right = is_ring_right(views, answer)
        right += is_right
        proved += is_right and answer.consensus
        wrong_proved += answer.consensus and not is_right
        repaired += answer.repaired
    return {
        "right": right / trials,
        "proved": proved / max(right, 1),
        "wrong_proved": wrong_proved / trials,
        "repaired": repaired / trials,
        "ms": elapsed / trials * 1e3,
    }


PAIRS = (
    Cell(
        "literal, heading 15, jitter 2 %, N=9",
        9,
        heading_rad=float(np.deg2rad(15)),
        jitter=0.02,
        literal=True,
    ),
    Cell("full view N=5", 5),
    Cell("full view N=9", 9),
    Cell("full view N=20", 20),
    Cell("full view N=3", 3),
    Cell("full view N=2", 2),
    Cell("full view N=2, heading prior", 2, heading_prior=True),
    Cell("tilt 20, jitter 10 %, N=5", 5, tilt_rad=float(np.deg2rad(20)), jitter=0.1),
    Cell("tilt 20, jitter 10 %, N=9", 9, tilt_rad=float(np.deg2rad(20)), jitter=0.1),
    Cell("moved 0.5, N=9", 9, moved=0.5),
    Cell("moved 1, N=9", 9, moved=1.0),
    Cell("moved 2, N=9", 9, moved=2.0),
    Cell("10 % missed, 5 % false, N=9", 9, missed=0.1, false=0.05),
    Cell("20 % missed, 10 % false, N=5", 5, missed=0.2, false=0.1),
    Cell("20 % missed, 10 % false, N=9", 9, missed=0.2, false=0.1),
    Cell("20 % missed, 10 % false, N=20", 20, missed=0.2, false=0.1),
    Cell("shifted 10 %, N=12", 12, shift=0.1),
    Cell("shifted 25 %, N=12", 12, shift=0.25),
    Cell("shifted 50 %, N=12", 12, shift=0.5),
    Cell(
        "missed, false, moved 0.25, tilt 15, N=9",
        9,
        missed=0.1,
        false=0.05,
        moved=0.25,
        tilt_rad=float(np.deg2rad(15)),
    ),
)
RINGS = (
    Cell("ring N=5 n=3", 5, n_views=3),
    Cell("ring N=9 n=3", 9, n_views=3),
    Cell("ring N=9 n=6", 9, n_views=6),
    Cell("ring N=9 n=12", 9, n_views=12),
    Cell("ring N=9 n=20, 5 % missed 2 % false", 9, n_views=20, missed=0.05, false=0.02),
    Cell("ring N=9 n=12, 10 % missed 5 % false", 9, n_views=12, missed=0.1, false=0.05),
    Cell("ring N=3 n=6, jitter 10 %", 3, n_views=6, jitter=0.1),
)


def main() -> None:
    """Print one line a cell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=1000, help="pairs a cell")
    parser.add_argument("--rings", type=int, default=200, help="rings a cell")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="only the cells whose name contains this")
    chosen = parser.parse_args()
    for cells, trials, measure in ((PAIRS, chosen.pairs, pair_success), (RINGS, chosen.rings, ring_success)):
        for cell in cells:
            if trials and chosen.only in cell.name:
                figures = measure(cell, trials, chosen.seed)
                shown = "  ".join(
                    f"{name} {value * (1 if name == 'ms' else 100):6.2f}" for name, value in figures.items()
                )
                print(f"{cell.name:42s} n={trials:<5d} {shown}", flush=True)


if __name__ == "__main__":
    main()
