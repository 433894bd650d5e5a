"""Renders labelled scenes: seas with whales, lawns with whale posters, and empty ones.

The trainer, the benchmarks and the tests draw from the same scenes; a scene depends on (split, seed, index)
alone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose
from drivers.sim.render import MORE_WATERS, WATERS, AnimalView, Image, SeaRenderer, Species
from drivers.sim.render.clutter import add_clutter, add_spout
from drivers.sim.render.effects import (
    blurred,
    compressed,
    glittering,
    hazy,
    motion_blurred,
    noisy,
    vignetted,
)
from tools.errors import UnusableError
from tools.render.pods import POSTER_LENGTHS_M, SPLITS, Pod, Split, make_pod, make_view, pick_species
from tools.render.visible import LEAST_CONTRAST, LEAST_SHARE, Visible, draw_and_see

__all__ = ["Conditions", "Scene", "scenes"]

Array = NDArray[np.float64]

SCENES_A_SEA = 12  # a sea's textures take a third of a second to make, a view of it some milliseconds
EMPTY_SHARE = 0.1
INPUT_PX = 320  # of the network, for whose eyes animals are large or small
TRIES = 2000  # for a scene with exactly as many animals as were asked for


@dataclass(frozen=True)
class Conditions:
    """Sea, sun, air and camera of one view. Zero means none of it."""

    sea_state: float = 0.0  # Douglas scale
    glint: float = 0.0  # sheen of sun and sky, 0 to 1
    glitter: float = 0.0  # sparks, 0 to 1
    haze: float = 0.0  # share of air light
    exposure: float = 1.0
    blur_px: float = 0.0
    motion_px: int = 0
    noise: float = 0.0  # grey levels
    jpeg: int = 100

    @property
    def clear(self) -> float:
        """Share of a difference in brightness that reaches the picture."""
        return (1 - self.haze) * self.exposure

    @property
    def glare(self) -> float:
        """Sheen and sparks together, 0 to 1."""
        return min(self.glint * 0.6 + self.glitter, 1.0)


@dataclass(frozen=True)
class Scene:
    """One rendered view and its truth. Arrays go by the animals that count."""

    image: Image  # (H, W, 3) BGR
    boxes: NDArray[np.float32]  # (N, 4) xyxy px
    ids: NDArray[np.int64]  # (N,)
    faint: NDArray[np.float32]  # (M, 4) boxes of animals that show too little to count either way
    image_to_ground: Array  # (3, 3) px to local NED metres
    kind: str  # sea or grass
    oriented: NDArray[np.float32]  # (N, 4, 2) corners px
    depth_m: NDArray[np.float32]  # (N,)
    contrast: NDArray[np.float32]  # (N,) grey levels between animal and water
    mask: NDArray[np.uint8]  # (H, W) 0, else id + 1, of every animal that shows at all
    height_m: float = 0.0
    species: str = ""
    conditions: Conditions = field(default_factory=Conditions)


@dataclass(frozen=True)
class _Place:
    """What a dozen scenes share."""

    renderer: SeaRenderer
    kind: str
    species: Species | None
    conditions: Conditions
    sea: Image | None = None  # a photograph in place of the renderer's water


def scenes(
    count: int,
    seed: int,
    split: str = "train",
    side: tuple[int, int] = (384, 384),
    shapes: list[Species] | None = None,
    animals: int | None = None,
    camera_effects: bool = False,
    seas: Sequence[Image] = (),
    views: int = 1,
) -> Iterator[Scene]:
    """`count` scenes of `split`, `side` (width, height) px; `shapes` are measured right whales.

    animals: exactly so many that count, and none that does not, in every scene. camera_effects: haze, blur,
    noise and compression too (the trainer adds its own, different at every look). seas: photographs of empty
    water that take the place of the rendered one. views: of each scene, one after another: the same animals
    under the same ids, at the same instant, each from a place and with an air and a camera of its own. Raises
    UnusableError for an unknown split.
    """
    if split not in SPLITS:
        raise UnusableError(f"split {split!r} is not known; there are: {', '.join(SPLITS)}")
    drawn, place = SPLITS[split], None
    for index in range(count):
        rng = np.random.default_rng([drawn.seed + seed, index])
        if place is None or index % SCENES_A_SEA == 0:
            place = _place(rng, drawn, drawn.seed + seed * 10_000 + index, shapes, seas)
        for _ in range(TRIES):
            shot = _shot(rng, place, drawn, side, animals, camera_effects)
            if shot is None:
                continue
            scene = _drawn(rng, place, drawn, shot)
            if animals is None or (len(scene.ids) == animals and not len(scene.faint)):
                yield scene
                for _ in range(views - 1):
                    yield _drawn(rng, place, drawn, _from_elsewhere(rng, place, shot, camera_effects))
                break
        else:
            raise UnusableError(f"{animals} animals do not fit into a picture of {side}; ask for fewer")


def _place(
    rng: np.random.Generator, split: Split, seed: int, shapes: list[Species] | None, seas: Sequence[Image]
) -> _Place:
    sea = seas[int(rng.integers(len(seas)))] if seas else None
    grass = sea is None and rng.random() < split.posters
    species = pick_species(rng, split)
    if grass and species is not None:  # a print shows the whole animal
        species = replace(species, head_under=0.0, tail_under=0.0)
    if shapes and species is not None and species.name == "right" and rng.random() < 0.8:
        species = shapes[int(rng.integers(len(shapes)))]
    conditions = Conditions(sea_state=float(5 * rng.random() ** 1.5), glint=float(rng.uniform(0, 1) ** 1.5))
    renderer = SeaRenderer(
        seed,
        kind="grass" if grass else "sea",
        species=(),
        sea_state=conditions.sea_state,
        sun_elevation_rad=float(rng.uniform(0.3, 1.4)),
        sun_azimuth_rad=float(rng.uniform(-np.pi, np.pi)),
        glint=conditions.glint,
        water=str(rng.choice(split.waters)) if sea is None else _water_like(sea, split.waters),
        shapes={species.name: species} if species is not None else None,
    )
    return _Place(renderer, "grass" if grass else "sea", species, conditions, sea)


def _water_like(sea: Image, waters: Sequence[str]) -> str:
    """The water whose colour is nearest to a photograph's: submerged animals take it on."""
    colour, known = np.median(sea.reshape(-1, 3), axis=0), {**WATERS, **MORE_WATERS}
    return min(waters, key=lambda name: float(np.abs(colour - known[name]).sum()))


def _cut(sea: Image, rng: np.random.Generator, side: tuple[int, int]) -> Image:
    """A window of a photograph at a random scale, mirrored at random."""
    height, width = sea.shape[:2]
    scale = max(side[0] / width, side[1] / height) * float(rng.uniform(1.0, 1.6))
    cut = (round(side[0] / scale), round(side[1] / scale))
    left, top = (int(rng.integers(0, limit + 1)) for limit in (width - cut[0], height - cut[1]))
    window = sea[top : top + cut[1], left : left + cut[0]]
    mirrored = cv2.flip(window, int(rng.integers(-1, 2)))
    return np.asarray(cv2.resize(mirrored, side, interpolation=cv2.INTER_LINEAR), np.uint8)


def _conditions(rng: np.random.Generator, place: _Place, camera_effects: bool) -> Conditions:
    sea = place.kind == "sea"
    glitter = float(rng.uniform(0.1, 0.8)) if sea and rng.random() < 0.2 else 0.0
    base = replace(place.conditions, glitter=glitter) if sea else Conditions()
    if not camera_effects:
        return base
    return replace(
        base,
        haze=float(rng.uniform(0, 0.35)) if rng.random() < 0.2 else 0.0,
        exposure=float(rng.uniform(0.7, 1.25)),
        blur_px=float(rng.uniform(0.3, 1.1)) if rng.random() < 0.2 else 0.0,
        motion_px=int(rng.integers(2, 6)) if rng.random() < 0.12 else 0,
        noise=float(rng.uniform(0.5, 6.0)),
        jpeg=int(rng.integers(55, 96)),
    )


@dataclass(frozen=True)
class _Shot:
    """What is to be drawn: animals on the ground, and who looks at them, when and through what."""

    camera: Pinhole
    pose: Pose
    conditions: Conditions
    animals: list[AnimalView]
    length_m: float
    t_s: float


def _shot(
    rng: np.random.Generator,
    place: _Place,
    split: Split,
    side: tuple[int, int],
    wanted: int | None,
    camera_effects: bool,
) -> _Shot | None:
    """None where fewer animals fit in than were wanted."""
    poster, species = place.kind == "grass", place.species
    usual_m = species.length_m if species is not None else float(rng.uniform(5, 15))
    length_m = float(rng.uniform(*POSTER_LENGTHS_M)) if poster else usual_m
    camera, pose = make_view(rng, length_m, side, wanted or 1)
    conditions = _conditions(rng, place, camera_effects)
    count = 0 if species is None or rng.random() < EMPTY_SHARE else int(rng.integers(1, 11))
    animals: list[AnimalView] = []
    if species is not None:
        pod = Pod(place.kind, species, length_m, count if wanted is None else wanted, wanted is not None)
        animals = make_pod(rng, camera, pose, pod)
    if wanted is not None and len(animals) != wanted:
        return None
    t_s = float(rng.uniform(0, 60)) if place.sea is None else 0.0
    return _Shot(camera, pose, conditions, animals, length_m, t_s)


def _from_elsewhere(rng: np.random.Generator, place: _Place, shot: _Shot, camera_effects: bool) -> _Shot:
    """The same animals as another drone sees them: about as high, over their middle, turned at random."""
    height_m = shot.pose.height_m * float(np.exp(rng.normal(0, 0.15)))
    middle = [shot.pose.n_m, shot.pose.e_m]
    if shot.animals:
        middle = np.mean([(animal.n_m, animal.e_m) for animal in shot.animals], axis=0).tolist()
    north_m, east_m = (np.array(middle) + rng.normal(0, 0.12 * height_m, 2)).tolist()
    roll, pitch = np.clip(rng.normal(0, 0.1, 2), -0.35, 0.35).tolist()
    pose = Pose(north_m, east_m, -height_m, roll, pitch, float(rng.uniform(-np.pi, np.pi)))
    return replace(shot, pose=pose, conditions=_conditions(rng, place, camera_effects))


def _drawn(rng: np.random.Generator, place: _Place, split: Split, shot: _Shot) -> Scene:
    """The picture of a shot, with what it shows of each animal."""
    camera, pose, conditions, animals = shot.camera, shot.pose, shot.conditions, shot.animals
    length_px = shot.length_m / camera.metres_per_px(pose.height_m)
    if place.sea is None:
        image = place.renderer.render(camera, pose, shot.t_s)
    else:
        image = _cut(place.sea, rng, camera.image_size)
    add_clutter(image, rng, length_px, place.kind == "sea", split.clutter)
    seen = (
        _no_animals(camera.image_size)
        if place.species is None
        else draw_and_see(place.renderer, image, camera, pose, animals, place.species, conditions.clear)
    )
    if place.kind == "sea":
        _breaths(image, rng, camera, pose, animals)
    image = _photographed(image, rng, conditions)
    to_ground = camera.image_to_ground(pose)
    return _labelled(image, seen, animals, to_ground, pose.height_m, place, conditions, split.least_long_px)


def _no_animals(side: tuple[int, int]) -> Visible:
    none = np.zeros(0, np.float32)
    mask = np.zeros((side[1], side[0]), np.uint8)
    return Visible(none.reshape(0, 4), none.reshape(0, 4, 2), none, none, none, mask)


def _breaths(
    image: Image, rng: np.random.Generator, camera: Pinhole, pose: Pose, animals: list[AnimalView]
) -> None:
    """A spout over the head of one in eight of the animals at the surface."""
    to_image = camera.ground_to_image(pose)
    for animal in animals:
        if animal.depth_m > 0.1 or rng.random() > 0.12:
            continue
        ahead = 0.42 * animal.length_m * np.array([np.cos(animal.heading_rad), np.sin(animal.heading_rad)])
        point = to_image @ [animal.n_m + ahead[0], animal.e_m + ahead[1], 1.0]
        if point[2] > 1e-6 and np.all(np.abs(point[:2] / point[2]) < 4000):
            at = (point[:2] / point[2]).astype(int)
            size_px = animal.length_m / camera.metres_per_px(pose.height_m)
            add_spout(image, rng, (int(at[0]), int(at[1])), size_px)


def _photographed(image: Image, rng: np.random.Generator, c: Conditions) -> Image:
    """The view through the air and the camera."""
    picture = image.astype(np.float32)
    if c.glitter > 0:
        picture = glittering(picture, rng, c.glitter)
    if c == Conditions(c.sea_state, c.glint, c.glitter):
        return np.clip(picture, 0, 255).astype(np.uint8)
    if c.haze > 0:
        picture = hazy(picture, c.haze, 205.0)
    picture = vignetted(picture * np.float32(c.exposure), float(rng.uniform(0, 0.3)))
    if c.blur_px > 0:
        picture = blurred(picture, c.blur_px)
    if c.motion_px > 0:
        picture = motion_blurred(picture, c.motion_px, float(rng.uniform(0, np.pi)))
    picture = noisy(picture, rng, c.noise)
    return compressed(np.clip(picture, 0, 255).astype(np.uint8), c.jpeg)


def _labelled(
    image: Image,
    seen: Visible,
    animals: list[AnimalView],
    image_to_ground: Array,
    height_m: float,
    place: _Place,
    c: Conditions,
    least_long_px: float,
) -> Scene:
    """The scene with its animals told apart into those that count and those too faint to."""
    contrast, noise = seen.contrast * c.clear, np.hypot(seen.noise * c.clear, c.noise / 2)
    long_px = (seen.boxes[:, 2:] - seen.boxes[:, :2]).max(axis=1, initial=0)
    counts = (
        (seen.shares >= LEAST_SHARE)
        & (contrast >= np.maximum(LEAST_CONTRAST, noise))
        & (long_px >= least_long_px * max(image.shape[:2]) / INPUT_PX)
    )
    shows = long_px > 0
    return Scene(
        image=image,
        boxes=seen.boxes[counts],
        ids=np.array([animal.id for animal in animals], np.int64)[counts],
        faint=seen.boxes[shows & ~counts],
        image_to_ground=image_to_ground,
        kind=place.kind,
        oriented=seen.oriented[counts],
        depth_m=np.array([animal.depth_m for animal in animals], np.float32)[counts],
        contrast=contrast[counts].astype(np.float32),
        mask=seen.mask,
        height_m=height_m,
        species=place.species.name if place.species is not None else "",
        conditions=c,
    )
