"""What the scenes of a split show: species and waters, how the animals lie, from where they are seen."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from drivers.sim.render import MORE_WATERS, WATERS, AnimalView, Species
from drivers.sim.render.species import species_named
from procs.detector.tiles import LEAST_ANIMAL_PX

__all__ = ["POSTER_LENGTHS_M", "SPLITS", "Pod", "Split", "make_pod", "make_view", "pick_species", "varied"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Split:
    """What one set of scenes draws from. No two splits share a seed."""

    species: tuple[str, ...]
    waters: tuple[str, ...]
    seed: int  # added to the caller's
    posters: float = 0.14  # share of lawns with posters, the paper's field test
    varied: float = 1.0  # how far bodies and colours stray from the tables
    clutter: float = 1.0
    # An animal counts from this long side of its box on, in a network's input of 320 px: what is measured is
    # what the detector is asked for (smaller ones are cut into tiles); it learns somewhat smaller ones too.
    least_long_px: float = LEAST_ANIMAL_PX


HELD_OUT_WATERS = ("lagoon", "pewter", "bottle", "ink")
_WATERS = tuple(name for name in [*WATERS, *MORE_WATERS] if name not in HELD_OUT_WATERS)
_SPECIES = ("sperm", "sperm", "right", "humpback", "minke", "blue", "bowhead", "beluga", "orca", "pilot")
# Validation species, waters and seeds never reach the trainer.
SPLITS: dict[str, Split] = {
    "train": Split(_SPECIES, _WATERS, 0, least_long_px=12.0),
    "tune": Split(_SPECIES, _WATERS, 400_000_000),  # for choosing thresholds, never for training
    "val": Split(("gray", "fin", "sei"), HELD_OUT_WATERS, 500_000_000, varied=0.3),
    "val_sperm": Split(("sperm",), HELD_OUT_WATERS, 600_000_000, varied=0.3),
    "empty": Split((), HELD_OUT_WATERS, 700_000_000, posters=0.0),
}
SHARE_AWASH = 0.55
HEIGHTS_M = (20.0, 200.0)
POSTER_LENGTHS_M = (2.0, 5.0)


@dataclass(frozen=True)
class Pod:
    """Animals of one species to be placed in a view."""

    kind: str  # sea or grass
    species: Species
    length_m: float
    count: int
    plain: bool = False  # all of them in view, awash or hardly under


def varied(species: Species, rng: np.random.Generator, strength: float) -> Species:
    """`species` with another build, other colours and perhaps head or tail under water."""
    build = rng.normal(0, 0.06 * strength, 3)
    stations = np.linspace(-1, 1, len(species.widths))
    widths = np.array(species.widths) * np.exp(build[0] + build[1] * stations + build[2] * stations**2)
    light = float(np.exp(rng.normal(0, 0.25 * strength)))
    tint = np.exp(rng.normal(0, 0.08 * strength, 3))
    back = np.clip(np.array(species.back_bgr) * light * tint, 12, 235).astype(int).tolist()
    patch = np.clip(np.array(species.patch_bgr) * np.exp(rng.normal(0, 0.15 * strength)), 30, 245)
    patch = patch.astype(int).tolist()
    stretch = np.exp(rng.normal(0, 0.08 * strength, 3))
    half_under = rng.random() < 0.35
    return replace(
        species,
        widths=tuple(widths.tolist()),
        fluke_span=species.fluke_span * stretch[0],
        fluke_chord=species.fluke_chord * stretch[1],
        fin_length=species.fin_length * stretch[2],
        back_bgr=(back[0], back[1], back[2]),
        patch_bgr=(patch[0], patch[1], patch[2]),
        mottling=float(np.clip(species.mottling + rng.normal(0, 0.2 * strength), 0, 1)),
        head_under=float(rng.uniform(0, 0.9)) if half_under and rng.random() < 0.3 else 0.0,
        tail_under=float(rng.uniform(0.2, 1.0)) if half_under else 0.0,
    )


def make_view(
    rng: np.random.Generator, length_m: float, side: tuple[int, int], must_hold: int = 1
) -> tuple[Pinhole, Pose]:
    """A camera 20 to 200 m over animals of 12 m, lower over smaller ones, mostly looking down.

    One view in five is tilted by up to 50 degrees. It is high enough to hold `must_hold` animals.
    """
    camera = Pinhole(side, float(rng.uniform(0.6, 1.1)))
    low, high = (height_m * length_m / 12.0 for height_m in HEIGHTS_M)
    low = max(low, 2.2 * length_m * np.sqrt(must_hold - 1))
    height_m = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    roll, pitch = np.clip(rng.normal(0, 0.1, 2), -0.35, 0.35).tolist()
    if rng.random() < 0.2:
        pitch = float(rng.uniform(0.2, 0.85))
    yaw = float(rng.uniform(-np.pi, np.pi))
    north_m, east_m = rng.uniform(-20, 20, 2).tolist()
    return camera, Pose(north_m, east_m, -height_m, roll, pitch, yaw)


def _places(rng: np.random.Generator, camera: Pinhole, pose: Pose, pod: Pod) -> Array:
    """Ground positions (count, 2), in the picture or just outside it: scattered, bunched, or side by side."""
    (width, height), count, length_m = camera.image_size, pod.count, pod.length_m
    to_ground = camera.image_to_ground(pose)
    layout = rng.random()
    if layout < 0.5:
        rim = 0.1 if pod.plain else -0.03
        pixels = rng.uniform(rim, 1 - rim, (count, 2)) * (width, height)
        return apply_homography(to_ground, pixels)
    middle = apply_homography(to_ground, rng.uniform(0.3, 0.7, (1, 2)) * (width, height))
    if layout < 0.8:
        return np.asarray(middle + rng.normal(0, length_m * rng.uniform(0.6, 1.6), (count, 2)))
    abreast = rng.uniform(0, np.pi)
    step_m = length_m * rng.uniform(0.3, 0.9)
    row = (np.arange(count) - count / 2)[:, None] * step_m * np.array([np.cos(abreast), np.sin(abreast)])
    return np.asarray(middle + row + rng.normal(0, 0.15 * length_m, (count, 2)))


def make_pod(rng: np.random.Generator, camera: Pinhole, pose: Pose, pod: Pod) -> list[AnimalView]:
    """Up to `pod.count` animals; those that would lie on another are left out."""
    heading, scattered = rng.uniform(-np.pi, np.pi), rng.random() < 0.45
    # Side by side animals touch; across each other they lie only where one has dived.
    poster = pod.kind == "grass"
    spacing = 1.25 if poster else (0.7 if scattered else float(rng.choice([0.26, 0.45])))
    animals: list[AnimalView] = []
    places = np.concatenate([_places(rng, camera, pose, pod) for _ in range(3 if pod.plain else 1)])
    for identity, place in enumerate(places):
        calf = rng.random() < 0.08
        length_m = pod.length_m * float(rng.uniform(0.8, 1.15)) * (0.55 if calf else 1.0)
        awash = poster or rng.random() < SHARE_AWASH
        apart_m = spacing * length_m * (1.0 if awash or pod.plain else 0.5)
        if len(animals) == pod.count:
            break
        if any(np.hypot(place[0] - o.n_m, place[1] - o.e_m) < apart_m for o in animals):
            continue
        turn = rng.uniform(-np.pi, np.pi) if scattered else rng.normal(0, 0.2)
        animals.append(
            AnimalView(
                id=identity,
                n_m=float(place[0]),
                e_m=float(place[1]),
                heading_rad=heading + turn,
                length_m=length_m,
                species=pod.species.name,
                depth_m=0.0 if awash else (0.6 if pod.plain else 3.2) * float(rng.random() ** 1.4),
                phase_rad=np.pi / 2 * int(rng.integers(4)),  # each picture of a stroke takes 20 ms to draw
                poster=poster,
            )
        )
    return animals


def pick_species(rng: np.random.Generator, split: Split) -> Species | None:
    """One of the split's, varied; None where it has none."""
    if not split.species:
        return None
    return varied(species_named(str(rng.choice(split.species))), rng, split.varied)
