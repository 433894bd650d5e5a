"""Bad input of the tracker, refused with the value, the limit and the remedy."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "check_boxes",
    "check_companions",
    "check_dt",
    "check_image",
    "check_model",
    "check_motion",
    "check_point",
]

Array = NDArray[np.float64]
MAX_DT_S = 5.0


def check_model(model_path: str | Path | None) -> None:
    """Refuse every model: this tracker has only its classical core."""
    if model_path is None:
        return
    if not Path(model_path).is_file():
        raise ValueError(
            f"model_path {str(model_path)!r}: no such file; leave it None for the built-in colour tracker"
        )
    raise ValueError(
        f"model_path {str(model_path)!r}: segmentation models are not supported; "
        "leave it None for the built-in colour tracker"
    )


def check_image(image: object, shape: tuple[int, int] | None) -> NDArray[np.uint8]:
    """The image, if it is (height, width, 3) uint8 and of the `shape` (height, width) that the track began
    with.
    """
    if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        found = f"{image.shape} {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"image is {found}: give a (height, width, 3) uint8 array in B G R order")
    if min(image.shape[:2]) < 32:
        raise ValueError(f"image is {image.shape[1]} x {image.shape[0]} px: at least 32 x 32 px are needed")
    if shape is not None and image.shape[:2] != shape:
        raise ValueError(
            f"image is {image.shape[1]} x {image.shape[0]} px but the track began on {shape[1]} x {shape[0]} "
            "px: keep the camera's size, or start again"
        )
    return image


def check_point(point: ArrayLike, shape: tuple[int, int]) -> Array:
    """(2,) float64 point inside an image of `shape` (height, width)."""
    checked = np.asarray(point, dtype=np.float64)
    if checked.shape != (2,) or not np.isfinite(checked).all():
        raise ValueError(f"point {point!r}: give two finite numbers, (u, v) in px")
    if not (0 <= checked[0] < shape[1] and 0 <= checked[1] < shape[0]):
        raise ValueError(
            f"point ({checked[0]:.1f}, {checked[1]:.1f}) lies outside the image of {shape[1]} x {shape[0]} "
            "px: give a point on the animal"
        )
    return checked


def check_boxes(boxes: ArrayLike | None, name: str = "boxes") -> Array:
    """(K, 4) float64 boxes left, top, right, bottom px, finite and not empty; None is (0, 4)."""
    if boxes is None:
        return np.zeros((0, 4))
    checked = np.asarray(boxes, dtype=np.float64)
    if checked.size == 0:
        return np.zeros((0, 4))
    if checked.ndim != 2 or checked.shape[1] != 4:
        raise ValueError(
            f"{name} has shape {checked.shape}: give (K, 4), rows of left, top, right, bottom px"
        )
    if not np.isfinite(checked).all():
        raise ValueError(
            f"{name} holds {checked[~np.isfinite(checked).all(axis=1)][0]}: every side must be finite"
        )
    bad = ((checked[:, 2:] - checked[:, :2]) < 1).any(axis=1)
    if bad.any():
        raise ValueError(
            f"{name} holds {checked[bad][0]}: right must exceed left and bottom exceed top by at least 1 px"
        )
    return checked


def check_companions(companions: ArrayLike | Sequence[ArrayLike]) -> Array:
    """(K, 2) points or (K, 4) boxes of the other animals as float64; nothing is (0, 4)."""
    checked = np.asarray(companions, dtype=np.float64)
    if checked.ndim == 2 and checked.shape[1] == 2 and len(checked):
        if not np.isfinite(checked).all():
            raise ValueError(f"companions holds {checked.tolist()}: every coordinate must be finite")
        return checked
    return check_boxes(checked, "companions")


def check_dt(dt_s: float) -> float:
    """Seconds since the frame before, above 0 and at most 5."""
    if not (np.isfinite(dt_s) and 0 < dt_s <= MAX_DT_S):
        raise ValueError(
            f"dt_s {dt_s!r}: must be above 0 and at most {MAX_DT_S} s; after a longer gap start again"
        )
    return float(dt_s)


def check_motion(image_motion: ArrayLike | None, shape: tuple[int, int]) -> Array | None:
    """(3, 3) homography that keeps the whole image in front of the camera, or None."""
    if image_motion is None:
        return None
    checked = np.asarray(image_motion, dtype=np.float64)
    if checked.shape != (3, 3) or not np.isfinite(checked).all():
        raise ValueError(
            f"image_motion is {image_motion!r}: give a finite (3, 3) homography, last frame to this one"
        )
    height, width = shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], dtype=np.float64)
    depth = corners @ checked[2]
    if (depth * np.sign(depth[0]) <= 1e-6 * np.abs(checked).max()).any() or np.linalg.det(checked) == 0:
        raise ValueError(
            f"image_motion {checked.tolist()} folds the image: give the homography "
            "from the last frame to this one"
        )
    return np.asarray(checked / depth[0])
