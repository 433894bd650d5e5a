"""Writes rendered scenes to a folder in the standard YOLO layout, with all that is known about them."""

import json
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.render.scenes import Scene, scenes

__all__ = ["command", "render_dataset"]

FOLDERS = ("images", "labels", "oriented", "masks", "truth")


def render_dataset(
    out: Path,
    n: int,
    seed: int,
    split: str = "train",
    side: tuple[int, int] = (640, 480),
    views: int = 1,
) -> Path:
    """Write `n` scenes of `split`, `views` pictures of each, to `out` and return the path of its data.yaml.

    images/SPLIT/*.jpg; labels/SPLIT/*.txt, boxes as YOLO text; oriented/SPLIT/*.txt, turned boxes as four
    corners (class x1 y1 ... x4 y4, shares of the picture from 0 to 1); masks/SPLIT/*.png, 0 or an animal's
    id + 1; truth/SPLIT/*.json, everything in px and metres with the 3x3 homography from pixels to ground
    metres, and turned boxes as they lie, also where a corner is outside the picture.
    The views of a scene show the same animals under the same ids. Raises ValueError for a bad split or count.
    """
    if n < 1 or views < 1:
        raise ValueError(f"n {n}, views {views}: at least one scene and one view must be asked for")
    folders = {name: out / name / split for name in FOLDERS}
    for number, scene in enumerate(scenes(n, seed, split, side, camera_effects=True, views=views)):
        index, view = divmod(number, views)
        if number == 0:
            for folder in folders.values():
                folder.mkdir(parents=True, exist_ok=True)
        stem = f"{seed:04d}_{index:06d}" + (f"_{view}" if views > 1 else "")
        cv2.imwrite(str(folders["images"] / f"{stem}.jpg"), scene.image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        cv2.imwrite(str(folders["masks"] / f"{stem}.png"), scene.mask)
        (folders["labels"] / f"{stem}.txt").write_text(_box_lines(scene, side))
        (folders["oriented"] / f"{stem}.txt").write_text(_corner_lines(scene, side))
        (folders["truth"] / f"{stem}.json").write_text(json.dumps(_truth(scene)))
    return _data_yaml(out)


def _box_lines(scene: Scene, side: tuple[int, int]) -> str:
    low, high = scene.boxes[:, :2], scene.boxes[:, 2:]
    rows = np.concatenate([(low + high) / 2, high - low], axis=1) / (*side, *side)
    return "".join(f"0 {x:.6f} {y:.6f} {w:.6f} {h:.6f}\n" for x, y, w, h in rows.tolist())


def _corner_lines(scene: Scene, side: tuple[int, int]) -> str:
    rows = [(corners_inside(corners, side) / side).reshape(8).tolist() for corners in scene.oriented]
    return "".join("0 " + " ".join(f"{value:.6f}" for value in row) + "\n" for row in rows)


def corners_inside(corners: NDArray[np.float32], side: tuple[int, int]) -> NDArray[np.float32]:
    """A turned box (4, 2) px as four corners inside a picture of `side` (width, height).

    Ultralytics refuses a picture with a corner outside it, and takes the smallest turned box round the four.
    So of the part inside, which has up to eight corners, those four stay that span most of it: the box round
    them is the one given, or close to it. Moved to the rim one by one, the corners would leave out more.
    """
    if np.all((corners >= 0) & (corners <= side)):
        return corners
    width, height = side
    picture = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    _, part = cv2.intersectConvexConvex(corners, picture)
    spans = combinations(part.reshape(-1, 2), 4)  # in their order round it
    largest = max((np.stack(four) for four in spans), key=lambda four: float(cv2.contourArea(four)))
    return np.asarray(np.clip(largest, 0, side), np.float32)


def _truth(scene: Scene) -> dict[str, object]:
    return {
        "kind": scene.kind,
        "species": scene.species,
        "height_m": round(scene.height_m, 2),
        "ids": scene.ids.tolist(),
        "boxes_px": np.round(scene.boxes.astype(float), 2).tolist(),
        "oriented_px": np.round(scene.oriented.astype(float), 2).tolist(),
        "depth_m": np.round(scene.depth_m.astype(float), 2).tolist(),
        "contrast": np.round(scene.contrast.astype(float), 1).tolist(),
        "faint_px": np.round(scene.faint.astype(float), 2).tolist(),
        "image_to_ground": scene.image_to_ground.tolist(),
        "conditions": {name: round(float(value), 3) for name, value in vars(scene.conditions).items()},
    }


def _data_yaml(out: Path) -> Path:
    """data.yaml naming the splits that lie in `out`; train and val are always named, as readers need them."""
    present = sorted(folder.name for folder in (out / "images").iterdir() if folder.is_dir())
    lines = ["path: .", *(f"{name}: images/{name}" for name in present), "names:", "  0: whale", ""]
    if "train" not in present:
        lines.insert(1, f"train: images/{present[0]}")
    if "val" not in present:
        lines.insert(2, f"val: images/{present[0]}")
    path = out / "data.yaml"
    path.write_text("\n".join(lines))
    return path


def command(
    out: Path,
    n: int = 100,
    seed: int = 0,
    split: str = "train",
    width: int = 640,
    height: int = 480,
    views: int = 1,
) -> None:
    """Render N labelled scenes into OUT in the YOLO layout; splits: train, tune, val, val_sperm, empty."""
    written = render_dataset(out, n, seed, split, (width, height), views)
    print(f"wrote {n} scenes{f' in {views} views each' if views > 1 else ''}, {written}")
