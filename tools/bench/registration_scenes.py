"""Pods seen by several cameras, with the detector's errors: what the registration benchmark measures on.

Animals are 20-point outlines of whales of 7 to 13 m with random headings, the nearest neighbour 2.5 lengths
away in the mean; each view has its own heading, height and tilt, and each edge of a box is off by a share of
its side. All draws come from the generator that is given.
"""

import zlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography

__all__ = [
    "CAMERA",
    "IMAGE_SIZE",
    "LAYOUTS",
    "MEAN_LENGTH_M",
    "Cell",
    "View",
    "detected",
    "draw_centres",
    "draw_outlines",
    "draw_pod",
    "draw_views",
    "inside_image",
    "trial_rng",
    "true_boxes",
    "true_matches",
    "views_of_pod",
]

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

IMAGE_SIZE = (1280, 960)
CAMERA = Pinhole(IMAGE_SIZE, float(np.deg2rad(70.0)))
SPACING = 2.5  # lengths from an animal to its nearest neighbour, in the mean
NEAREST = 0.6  # of the spacing, and nobody is nearer
CROWD_SIDE = 1.38  # of the spacing, a pod's square for one animal: found by trial, so that the mean holds
MEAN_LENGTH_M = 10.0
LAYOUTS = ("grid", "ring", "line", "mirror")
LAYOUT_NOISE = 0.05  # of the spacing: how far an animal is from its place in a symmetric layout
HIT_IOU = 0.45  # with which the detector takes two boxes for one
MARGIN = 1.02  # the pod's circle does not quite touch the picture's edge
# Views overlap in part only where animals lie outside both. From this share of the height at which the pod's
# circle just fits, the literal algorithm does no better at a shift of 10, 25 and 50 % than 9, 1 and 1 %.
OVERFILL = 0.85
POSITION_NOISE = 0.02  # of the height: how far a camera is from where it wants to be


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
    """One kind of scene: the pod, the cameras and the detector's errors."""

    name: str
    n_animals: int
    n_views: int = 2
    heading_rad: float = np.pi  # relative headings lie within plus or minus this
    exact_heading: bool = False  # they are just this, to either side
    height_ratio: tuple[float, float] = (0.7, 1.4)
    tilt_rad: float = float(np.deg2rad(10.0))  # each camera's, up to
    shear: float = 0.0  # of every view but the first, along one axis of the image
    jitter: float = 0.05  # standard deviation of an edge, of its side
    missed: float = 0.0
    false: float = 0.0  # false alarms per animal and view
    moved: float = 0.0  # lengths, before every view but the first
    shift: float = 0.0  # of the image's width, between the two cameras
    layout: str = "crowd"
    full_view: bool = False  # every box centre inside every image: drawn again until it is so
    heading_prior: bool = False  # the compasses are asked
    literal: bool = False


def trial_rng(seed: int, name: str, trial: int) -> np.random.Generator:
    """The generator of one trial of one cell: the same whatever else is measured, and in whatever order."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), trial])


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


def draw_centres(n: int, rng: np.random.Generator, layout: str = "crowd") -> Array:
    """(n, 2) centres in metres about their mean: a crowd, or one of LAYOUTS, each animal a little off its
    place.
    """
    spacing = SPACING * MEAN_LENGTH_M
    if layout == "crowd":
        centres = _crowd(n, spacing, rng)
    else:
        centres = _symmetric(n, spacing, layout, rng)
        centres = centres + rng.normal(0.0, LAYOUT_NOISE * spacing, centres.shape)
    return np.asarray(centres - centres.mean(axis=0))


def _crowd(n: int, spacing: float, rng: np.random.Generator) -> Array:
    side = CROWD_SIDE * spacing * np.sqrt(n)
    centres = np.zeros((0, 2))
    while len(centres) < n:
        point = rng.uniform(-side / 2, side / 2, 2)
        if not len(centres) or np.linalg.norm(centres - point, axis=1).min() > NEAREST * spacing:
            centres = np.vstack([centres, point])
        else:
            side *= 1.001  # where there is hardly room for another, some
    return centres


def _symmetric(n: int, spacing: float, layout: str, rng: np.random.Generator) -> Array:
    """(n, 2) places that a rotation or a reflection carries into themselves. Raises ValueError for another
    layout.
    """
    places = np.arange(n)
    if layout == "grid":
        columns = int(np.ceil(np.sqrt(n)))
        return np.asarray(spacing * np.column_stack([places % columns, places // columns]), dtype=np.float64)
    if layout == "ring":
        angles = 2 * np.pi * places / n
        radius = spacing / (2 * np.sin(np.pi / n))
        return np.asarray(radius * np.column_stack([np.cos(angles), np.sin(angles)]))
    if layout == "line":
        return np.asarray(spacing * np.column_stack([places, np.zeros(n)]), dtype=np.float64)
    if layout == "mirror":
        half = _crowd(n // 2, spacing, rng)
        half[:, 0] += spacing / 2 - half[:, 0].min()
        return np.vstack([half, half * [-1, 1]])
    raise ValueError(f"layout {layout!r}: choose 'crowd' or one of {', '.join(LAYOUTS)}")


def draw_pod(n: int, rng: np.random.Generator, layout: str = "crowd") -> tuple[Array, Array]:
    """Centres (n, 2) and outlines (n, 20, 2) in metres."""
    return draw_centres(n, rng, layout), draw_outlines(n, rng)


def _pose(reach_m: float, cell: Cell, heading_rad: float, ratio: float, rng: np.random.Generator) -> Pose:
    """A camera over the pod's middle, so high that the lowest ratio sees all of the pod at any tilt; or,
    where views are shifted, too low to see all of it.
    """
    if cell.shift:
        height = OVERFILL * reach_m / np.tan(CAMERA.vfov_rad / 2) * ratio
    else:
        half_view = CAMERA.vfov_rad / 2 - cell.tilt_rad
        height = (reach_m + MEAN_LENGTH_M * (0.7 + 1.5 * cell.moved)) / np.tan(half_view) * MARGIN
        height *= ratio / cell.height_ratio[0]
    direction, size = rng.uniform(0, 2 * np.pi), cell.tilt_rad * np.sqrt(rng.uniform())
    offset = rng.normal(0.0, POSITION_NOISE * height, 2)
    return Pose(
        offset[0], offset[1], -height, size * np.cos(direction), size * np.sin(direction), heading_rad
    )


def _heading(cell: Cell, rng: np.random.Generator) -> float:
    if cell.exact_heading:
        return float(cell.heading_rad * rng.choice([-1.0, 1.0]))
    return float(rng.uniform(-cell.heading_rad, cell.heading_rad))


def _sheared(shear: float, rng: np.random.Generator) -> Array:
    """(3, 3) shear of the image about its middle, along u or along v, to either side."""
    matrix = np.eye(3)
    axis = int(rng.integers(2))
    matrix[axis, 1 - axis] = shear * rng.choice([-1.0, 1.0])
    middle = np.array(IMAGE_SIZE) / 2
    matrix[:2, 2] = middle - matrix[:2, :2] @ middle
    return matrix


def true_boxes(centres: Array, outlines: Array, homography: Array) -> Array:
    """(n, 4) boxes px of all animals, in the image or not."""
    points = apply_homography(homography, (centres[:, None] + outlines).reshape(-1, 2))
    points = points.reshape(*outlines.shape)
    return np.concatenate([points.min(axis=1), points.max(axis=1)], axis=1)


def inside_image(boxes: Array) -> NDArray[np.bool_]:
    """(N,) whether the centre of each box (N, 4) px is in the picture."""
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    return np.asarray(((middle > 0) & (middle < IMAGE_SIZE)).all(axis=1))


def detected(boxes: Array, pose: Pose, cell: Cell, rng: np.random.Generator) -> View:
    """What a detector says of (n, 4) true boxes: misses, false alarms as large as animals, edges that
    jitter.
    """
    count = len(boxes)
    animals = np.flatnonzero(inside_image(boxes) & (rng.uniform(size=count) >= cell.missed))
    n_false = rng.binomial(count, cell.false) if len(animals) else 0
    false = [_false_alarm(boxes[animals], boxes, rng) for _ in range(n_false)]
    boxes = np.concatenate([boxes[animals], np.array(false).reshape(-1, 4)])
    animals = np.concatenate([animals, np.full(n_false, -1)])
    sides = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    boxes = boxes + rng.normal(0.0, cell.jitter, boxes.shape) * sides
    boxes = np.concatenate(
        [np.minimum(boxes[:, :2], boxes[:, 2:]), np.maximum(boxes[:, :2], boxes[:, 2:])], axis=1
    )
    order = rng.permutation(len(boxes))
    return View(boxes[order], animals[order], pose)


def _false_alarm(found: Array, everything: Array, rng: np.random.Generator) -> Array:
    """(4,) px, as large as one of the boxes found, anywhere in the image but on an animal, missed or not: a
    box that covers one as well as a detector does is no false alarm.
    """
    while True:
        side = (found[:, 2:] - found[:, :2])[rng.integers(len(found))]
        place = rng.uniform(0, 1, 2) * IMAGE_SIZE
        box = np.concatenate([place - side / 2, place + side / 2])
        shared = np.minimum(box[2:], everything[:, 2:]) - np.maximum(box[:2], everything[:, :2])
        common = np.clip(shared, 0, None).prod(axis=1)
        areas = (everything[:, 2:] - everything[:, :2]).prod(axis=1)
        if (common < HIT_IOU * (areas + side.prod() - common)).all():
            return np.asarray(box)


def draw_views(cell: Cell, rng: np.random.Generator) -> list[View]:
    """One new pod seen by `cell.n_views` cameras."""
    centres, outlines = draw_pod(cell.n_animals, rng, cell.layout)
    return views_of_pod(cell, centres, outlines, rng)


def views_of_pod(cell: Cell, centres: Array, outlines: Array, rng: np.random.Generator) -> list[View]:
    """A pod, (n, 2) centres and (n, 20, 2) outlines in metres, seen by `cell.n_views` cameras; animals move
    anew before each further view. In a full view cell cameras and moves are drawn again until every true box
    centre is inside every image.
    """
    while True:
        scene = _draw_scene(cell, centres, outlines, rng)
        if not cell.full_view or all(inside_image(boxes).all() for boxes, _ in scene):
            return [detected(boxes, pose, cell, rng) for boxes, pose in scene]


def _draw_scene(
    cell: Cell, centres: Array, outlines: Array, rng: np.random.Generator
) -> list[tuple[Array, Pose]]:
    """True boxes (n, 4) px of all animals, in the image or not, and the pose, of each view."""
    reach = float(np.linalg.norm(centres, axis=1).max())
    toward = rng.uniform(0, 2 * np.pi)
    scene = []
    for index in range(cell.n_views):
        ratio = 1.0 if index == 0 else float(np.exp(rng.uniform(*np.log(cell.height_ratio))))
        heading = _heading(cell, rng) if index else 0.0
        pose = _pose(reach, cell, heading, ratio, rng)
        if cell.shift:
            pose = _shifted(pose, cell.shift * (index - 0.5), toward)
        ways = rng.uniform(0, 2 * np.pi, len(centres))
        step = np.column_stack([np.cos(ways), np.sin(ways)]) * MEAN_LENGTH_M * cell.moved * (index > 0)
        homography = CAMERA.ground_to_image(pose)
        if index and cell.shear:
            homography = _sheared(cell.shear, rng) @ homography
        scene.append((true_boxes(centres + step, outlines, homography), pose))
    return scene


def _shifted(pose: Pose, widths: float, toward_rad: float) -> Pose:
    """The pose moved by a share of the ground that its image is wide."""
    wide_m = 2 * pose.height_m * np.tan(CAMERA.vfov_rad / 2) * IMAGE_SIZE[0] / IMAGE_SIZE[1]
    n_m, e_m = widths * wide_m * np.array([np.cos(toward_rad), np.sin(toward_rad)])
    return replace(pose, n_m=pose.n_m + float(n_m), e_m=pose.e_m + float(e_m))


def true_matches(source: View, target: View) -> list[tuple[int, int]]:
    """Rows of (source, target) that are the same animal."""
    where = {int(animal): row for row, animal in enumerate(target.animals) if animal >= 0}
    return [(row, where[int(animal)]) for row, animal in enumerate(source.animals) if int(animal) in where]
