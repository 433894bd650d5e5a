"""Renders labelled scenes: seas with whales, lawns with whale posters, and empty ones, in the standard YOLO
layout.

The trainer and the tests draw from the same scenes; a scene depends on (seed, index, split) alone.
"""

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose
from drivers.sim.render import SPECIES, AnimalView, Image, SeaRenderer, Species
from drivers.sim.render.clutter import add_clutter
from drivers.sim.render.species import STATIONS, with_widths

__all__ = ["SPLITS", "Scene", "command", "measured_right_whales", "render_dataset", "scenes"]

Array = NDArray[np.float64]

# Which species a split draws. Validation species never reach the trainer.
SPLITS: dict[str, tuple[str, ...]] = {
    "train": ("sperm", "right", "humpback", "minke"),
    "val": ("gray", "fin"),
    "val_sperm": ("sperm",),  # what the simulator shows, with seeds of its own
    "empty": (),
}
# Added to the seed so that no split ever shares a sea with another.
SPLIT_SEEDS = {"train": 0, "val": 500_000_000, "val_sperm": 600_000_000, "empty": 700_000_000}
SCENES_A_SEA = 20  # a sea's textures take half a second to make, a view of it some milliseconds
LEAST_VISIBLE = 0.35  # animals fainter or further outside than this get no box
LEAST_SIDE_PX = 4.0


@dataclass(frozen=True)
class Scene:
    """One rendered view and its truth."""

    image: Image  # (H, W, 3) BGR
    boxes: NDArray[np.float32]  # (N, 4) xyxy px of the animals that count
    ids: NDArray[np.int64]  # (N,)
    faint: NDArray[np.float32]  # (M, 4) boxes of animals too faint or too far outside to count either way
    image_to_ground: Array  # (3, 3) px to local NED metres
    kind: str


def _pod(rng: np.random.Generator, species: tuple[str, ...], extent_m: float, kind: str) -> list[AnimalView]:
    """Between no and ten animals round the origin; most pods are of one species, all swimming roughly one
    way.
    """
    if not species or rng.random() < 0.08:
        return []
    name = str(rng.choice(species))
    heading = rng.uniform(-np.pi, np.pi)
    scattered = rng.random() < 0.5
    animals: list[AnimalView] = []
    for identity in range(int(rng.integers(1, 11))):
        length_m = SPECIES[name].length_m * rng.uniform(0.75, 1.15) * (0.55 if rng.random() < 0.1 else 1.0)
        place = rng.uniform(-0.5, 0.5, 2) * extent_m
        # Animals may touch but rarely lie on each other: two boxes in one place teach nothing.
        spacing_m = length_m * (1.2 if kind == "grass" else 0.35)
        if any(np.hypot(place[0] - other.n_m, place[1] - other.e_m) < spacing_m for other in animals):
            continue
        depth_m = 0.0 if kind == "grass" or rng.random() < 0.5 else float(rng.uniform(0, 3.0) ** 1.3 * 0.8)
        turn = rng.uniform(-np.pi, np.pi) if scattered else rng.normal(0, 0.4)
        phase = np.pi / 2 * int(rng.integers(4))  # four of the strokes: each picture takes 20 ms to draw
        animals.append(
            AnimalView(
                id=identity,
                n_m=float(place[0]),
                e_m=float(place[1]),
                heading_rad=heading + turn,
                length_m=length_m,
                species=name,
                depth_m=depth_m,
                phase_rad=phase,
                poster=kind == "grass",
            )
        )
    return animals


def _view(rng: np.random.Generator, length_m: float, side: tuple[int, int]) -> tuple[Pinhole, Pose, float]:
    """A camera whose height shows an animal of `length_m` at 14 to 230 px, and that length in px."""
    length_px = float(np.exp(rng.uniform(np.log(14), np.log(230)))) * max(side) / 384
    camera = Pinhole(side, float(rng.uniform(0.7, 1.3)))
    height_m = length_m * camera.focal_px / length_px
    roll, pitch = np.clip(rng.normal(0, 0.12, 2), -0.4, 0.4).tolist()
    north_m, east_m = (rng.uniform(-0.1, 0.1, 2) * height_m).tolist()
    pose = Pose(north_m, east_m, -height_m, roll, pitch, float(rng.uniform(-np.pi, np.pi)))
    return camera, pose, length_px


def scenes(
    count: int,
    seed: int,
    split: str = "train",
    side: tuple[int, int] = (384, 384),
    shapes: list[Species] | None = None,
) -> Iterator[Scene]:
    """`count` scenes of `split`, `side` (width, height) px; `shapes` are measured right whales."""
    if split not in SPLITS:
        raise ValueError(f"split {split!r} is not known; there are: {', '.join(SPLITS)}")
    renderer, kind, species = SeaRenderer(0, species=(), sea_state=0), "sea", SPLITS[split]
    for index in range(count):
        rng = np.random.default_rng([SPLIT_SEEDS[split] + seed, index])
        if index % SCENES_A_SEA == 0:
            kind = "grass" if rng.random() < 0.14 else "sea"
            species = tuple(rng.permutation(SPLITS[split])[:2].tolist())
            measured = {"right": shapes[int(rng.integers(len(shapes)))]} if shapes else None
            renderer = SeaRenderer(
                SPLIT_SEEDS[split] + seed * 10_000 + index,
                kind="grass" if kind == "grass" else "sea",
                species=(),
                sea_state=float(5 * rng.random() ** 1.5),
                sun_elevation_rad=float(rng.uniform(0.3, 1.4)),
                sun_azimuth_rad=float(rng.uniform(-np.pi, np.pi)),
                glint=float(rng.uniform(0, 1) ** 1.5),
                shapes=measured,
            )
        yield _scene(rng, renderer, species, kind, side)


def _scene(
    rng: np.random.Generator,
    renderer: SeaRenderer,
    species: tuple[str, ...],
    kind: str,
    side: tuple[int, int],
) -> Scene:
    camera, pose, length_px = _view(rng, 5.0 if kind == "grass" else 11.0, side)
    extent_m = min(camera.metres_per_px(pose.height_m) * max(side) * 0.95, 140.0)
    animals = _pod(rng, species, extent_m, kind)
    image = renderer.render(camera, pose, float(rng.uniform(0, 60)), animals)
    add_clutter(image, rng, length_px, on_water=kind == "sea")
    labels = renderer.labels(camera, pose, animals)
    sides = labels.boxes[:, 2:] - labels.boxes[:, :2]
    counts = (labels.visible >= LEAST_VISIBLE) & (sides.max(axis=1, initial=0) >= LEAST_SIDE_PX)
    return Scene(
        image,
        labels.boxes[counts],
        labels.ids[counts],
        labels.boxes[~counts],
        camera.image_to_ground(pose),
        kind,
    )


def measured_right_whales(outlines_csv: Path, count: int = 40) -> list[Species]:
    """Right whales with the widths of real ones, from the table of outlines in ../shared/data; empty if it is
    missing.

    The table gives rostrum, peduncle and the two sides' points in pixels; the width at a station is the
    distance between the sides there, in shares of the distance from rostrum to fluke notch.
    """
    if not outlines_csv.is_file():
        return []
    with outlines_csv.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = ("head1", "head2", "eye", "body1", "body2", "body3", "peduncle_width")
    shapes = []
    for row in rows[:: max(len(rows) // count, 1)]:

        def point(name: str, row: dict[str, str] = row) -> Array:
            return np.array([float(row[f"{name}_x"]), float(row[f"{name}_y"])])

        rostrum, notch = point("rostrum"), point("fluke")
        length = float(np.hypot(*(notch - rostrum)))
        axis = (notch - rostrum) / max(length, 1e-9)
        left, right = (np.array([point(f"side{side}_{name}") for name in names]) for side in (1, 2))
        stations = ((left + right) / 2 - rostrum) @ axis / max(length, 1e-9)
        widths = np.hypot(*(left - right).T) / max(length, 1e-9)
        if np.any(np.diff(stations) <= 0) or widths.max() > 0.4:
            continue  # a strongly bent animal has no straight axis to measure along
        stations, widths = np.append(stations, 1.0), np.append(widths, 0.03)
        along = np.interp(STATIONS, np.concatenate([[0.0], stations]), np.concatenate([[0.03], widths]))
        shapes.append(with_widths(SPECIES["right"], along))
    return shapes


def render_dataset(
    out: Path, n: int, seed: int, split: str = "train", side: tuple[int, int] = (640, 480)
) -> Path:
    """Write `n` scenes to `out` as images/<split>/, labels/<split>/ (YOLO text), truth/<split>/ (JSON) and
    data.yaml.

    The JSON holds ids and boxes in px, boxes of animals too faint to count, and the 3x3 homography from
    pixels to ground metres. Returns the path of data.yaml. Raises ValueError for a bad split or count.
    """
    if n < 1:
        raise ValueError(f"n {n}: at least one scene must be asked for")
    folders = {name: out / name / split for name in ("images", "labels", "truth")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    width, height = side
    for index, scene in enumerate(scenes(n, seed, split, side)):
        stem = f"{seed:04d}_{index:06d}"
        cv2.imwrite(str(folders["images"] / f"{stem}.jpg"), scene.image, [cv2.IMWRITE_JPEG_QUALITY, 92])
        low, high = scene.boxes[:, :2], scene.boxes[:, 2:]
        rows = np.concatenate([(low + high) / 2, high - low], axis=1) / (width, height, width, height)
        lines = [f"0 {x:.6f} {y:.6f} {w:.6f} {h:.6f}\n" for x, y, w, h in rows.tolist()]
        (folders["labels"] / f"{stem}.txt").write_text("".join(lines))
        truth = {
            "kind": scene.kind,
            "ids": scene.ids.tolist(),
            "boxes_px": np.round(scene.boxes.astype(float), 2).tolist(),
            "faint_px": np.round(scene.faint.astype(float), 2).tolist(),
            "image_to_ground": scene.image_to_ground.tolist(),
        }
        (folders["truth"] / f"{stem}.json").write_text(json.dumps(truth))
    present = sorted(folder.name for folder in (out / "images").iterdir() if folder.is_dir())
    lines = ["path: .", *(f"{name}: images/{name}" for name in present), "names:", "  0: whale", ""]
    if "train" not in present:
        lines.insert(1, f"train: images/{present[0]}")
    if "val" not in present:
        lines.insert(2, f"val: images/{present[0]}")
    data_yaml = out / "data.yaml"
    data_yaml.write_text("\n".join(lines))
    return data_yaml


def command(
    out: Path, n: int = 100, seed: int = 0, split: str = "train", width: int = 640, height: int = 480
) -> None:
    """Render N labelled scenes into OUT in the YOLO layout; splits: train, val, val_sperm, empty."""
    print(f"wrote {n} scenes, {render_dataset(out, n, seed, split, (width, height))}")
