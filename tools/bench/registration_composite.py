"""Composites of real photographs: nine whales on one sea, seen through synthetic views (paper, Detection and
Registration).

The paper takes 39 views of one scene of nine whales at three instants, moved, turned and sheared, with a
picture of the ocean where the warped frame ends. Here the nine are cut from photographs that the detector
never saw and laid on water of one of them, with soft rims and the water's colour.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.train.detector.samples import Sample

__all__ = ["VIEW_SIZE", "CompositeView", "composite_views"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

N_ANIMALS, N_INSTANTS, N_VIEWS = 9, 3, 39
VIEW_SIZE = (1280, 960)
FRAME_SIZE = (1500, 1200)  # the aerial frame that the views are warped from
LENGTHS_PX = (105.0, 175.0)  # of the animals in the frame
POD_RADIUS_PX = 385.0  # so that a turned, sheared and moved view still holds all nine
LEAST_APART_PX = 185.0
MOVES_PX, TURNS_RAD = 15.0, 0.15  # standard deviations, from one instant to the next
SHEAR = 0.2
SHIFT_PX = 30.0
MARGIN = 0.16  # of the animal, that is cut out round it


@dataclass(frozen=True)
class CompositeView:
    """One picture (H, W, 3) BGR; `quads` (9, 4, 2) px, where the corners of each animal's loose label lie;
    its turn from the frame; which instant it shows.
    """

    image: Image
    quads: Array
    turn_rad: float
    instant: int


@dataclass(frozen=True)
class _Cutout:
    """An animal with some water round it; its label (4,) xyxy px in the cutout."""

    image: Image
    label: Array


def composite_views(photos: Sequence[Sample], rng: np.random.Generator) -> list[CompositeView]:
    """The 39 views. Raises ValueError for fewer than nine photographs with an animal."""
    labelled = [photo for photo in photos if len(photo.boxes)]
    if len(labelled) < N_ANIMALS:
        raise ValueError(f"{len(labelled)} photographs with an animal: {N_ANIMALS} are needed")
    chosen = [labelled[index] for index in rng.choice(len(labelled), N_ANIMALS, replace=False).tolist()]
    cutouts = [_cut(photo) for photo in chosen]
    water = _open_water(labelled)
    places, turns = _places(rng), rng.uniform(0, 2 * np.pi, N_ANIMALS)
    lengths = rng.uniform(*LENGTHS_PX, N_ANIMALS)
    views = []
    for instant in range(N_INSTANTS):
        if instant:
            places = places + rng.normal(0.0, MOVES_PX, places.shape)
            turns = turns + rng.normal(0.0, TURNS_RAD, N_ANIMALS)
        frame, quads = _frame(cutouts, places, turns, lengths, water)
        for _ in range(N_VIEWS // N_INSTANTS):
            views.append(_view(frame, quads, water, instant, rng))
    return views


def _cut(photo: Sample) -> _Cutout:
    height, width = photo.image.shape[:2]
    left, top, right, bottom = photo.boxes[0, :4].astype(float).tolist()
    margin = MARGIN * max(right - left, bottom - top)
    x0, y0 = int(max(left - margin, 0)), int(max(top - margin, 0))
    x1, y1 = int(min(right + margin, width)), int(min(bottom + margin, height))
    return _Cutout(photo.image[y0:y1, x0:x1], np.array([left - x0, top - y0, right - x0, bottom - y0]))


def _open_water(photos: Sequence[Sample]) -> Image:
    """The largest window without an animal of any photograph, calmest first, mirrored to the frame's size."""
    best: tuple[float, Image] | None = None
    for photo in photos:
        height, width = photo.image.shape[:2]
        left, top, right, bottom = photo.boxes[0, :4].astype(int).tolist()
        windows = [
            photo.image[:, : max(left - 20, 0)],
            photo.image[:, min(right + 20, width) :],
            photo.image[: max(top - 20, 0)],
            photo.image[min(bottom + 20, height) :],
        ]
        for window in windows:
            if min(window.shape[:2]) < min(height, width) // 2:
                continue
            restless = float(cv2.cvtColor(window, cv2.COLOR_BGR2GRAY).std())
            if best is None or restless < best[0]:
                best = (restless, window)
    if best is None:
        raise ValueError("no photograph has open water beside its animal: give some that do")
    window = best[1]
    rows, columns = -(-FRAME_SIZE[1] // window.shape[0]), -(-FRAME_SIZE[0] // window.shape[1])
    strips = []
    for row in range(rows):
        tiles = [cv2.flip(window, 1) if column % 2 else window for column in range(columns)]
        strip = np.hstack(tiles)
        strips.append(cv2.flip(strip, 0) if row % 2 else strip)
    return np.ascontiguousarray(np.vstack(strips)[: FRAME_SIZE[1], : FRAME_SIZE[0]], dtype=np.uint8)


def _places(rng: np.random.Generator) -> Array:
    """(9, 2) px in the frame, in a circle and apart."""
    apart, places = LEAST_APART_PX, np.zeros((0, 2))
    while len(places) < N_ANIMALS:
        point = POD_RADIUS_PX * np.sqrt(rng.uniform()) * _direction(rng.uniform(0, 2 * np.pi))
        if not len(places) or np.linalg.norm(places - point, axis=1).min() > apart:
            places = np.vstack([places, point])
        else:
            apart *= 0.999  # a full circle takes no ninth
    return np.asarray(places + np.array(FRAME_SIZE) / 2)


def _direction(angle: float) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


def _frame(
    cutouts: Sequence[_Cutout], places: Array, turns: Array, lengths: Array, water: Image
) -> tuple[Image, Array]:
    """The aerial frame of one instant, and the corners (9, 4, 2) px of every animal's label in it."""
    canvas = water.astype(np.float32)
    quads = []
    for cutout, place, turn, length in zip(cutouts, places, turns, lengths, strict=True):
        left, top, right, bottom = cutout.label
        scale = length / max(right - left, bottom - top)
        small = cv2.resize(
            cutout.image, None, fx=min(scale * 2, 1.0), fy=min(scale * 2, 1.0), interpolation=cv2.INTER_AREA
        )
        shrunk = small.shape[1] / cutout.image.shape[1]
        move = _about(shrunk * np.array([left + right, top + bottom]) / 2, scale / shrunk, turn, place)
        piece, cover = _levelled(np.asarray(small, dtype=np.uint8), water, place)
        _lay(canvas, piece, cover, move)
        corners = shrunk * np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        quads.append(corners @ move[:, :2].T + move[:, 2])
    return np.asarray(np.clip(canvas, 0, 255), dtype=np.uint8), np.array(quads)


def _lay(
    canvas: NDArray[np.float32], piece: NDArray[np.float32], cover: NDArray[np.float32], move: Array
) -> None:
    """Draw the piece onto the canvas by a (2, 3) affine map, in the window that it covers."""
    height, width = cover.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) @ move[:, :2].T + move[:, 2]
    limit = np.array(FRAME_SIZE)
    low = np.clip(np.floor(corners.min(axis=0)), 0, limit - 1).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)), low + 1, limit).astype(int)
    local = move - np.column_stack([np.zeros((2, 2)), low])
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    drawn = cv2.warpAffine(piece, local, size, flags=cv2.INTER_LINEAR)
    share = cv2.warpAffine(cover, local, size, flags=cv2.INTER_LINEAR)[..., None]
    window = canvas[low[1] : high[1], low[0] : high[0]]
    window += share * (drawn - window)


def _about(middle: Array, scale: float, turn: float, place: Array) -> Array:
    """(2, 3) affine map that turns and scales about `middle` and carries it to `place`."""
    cos, sin = scale * np.cos(turn), scale * np.sin(turn)
    linear = np.array([[cos, -sin], [sin, cos]])
    return np.column_stack([linear, place - linear @ middle])


def _levelled(cutout: Image, water: Image, place: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The cutout with its water's colour shifted to the frame's, and how much of it counts, 0 at its rim."""
    height, width = cutout.shape[:2]
    v, u = np.mgrid[0:height, 0:width]
    rim = max(min(height, width) / 7, 1.0)
    edge = np.minimum(np.minimum(u, width - 1 - u), np.minimum(v, height - 1 - v)) / rim
    cover = np.clip(edge, 0, 1).astype(np.float32)
    column, row = (int(value) for value in place)
    around = water[max(row - 60, 0) : row + 60, max(column - 60, 0) : column + 60].reshape(-1, 3)
    shift = np.median(around, axis=0) - np.median(cutout[edge < 1], axis=0)
    return np.asarray(cutout + shift, dtype=np.float32), cover


def _view(frame: Image, quads: Array, water: Image, instant: int, rng: np.random.Generator) -> CompositeView:
    """The frame moved, turned and sheared; the water where it ends."""
    turn = float(rng.uniform(-np.pi, np.pi))
    shear = np.eye(2)
    axis = int(rng.integers(2))
    shear[axis, 1 - axis] = rng.uniform(-SHEAR, SHEAR)
    linear = shear @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    middle = np.array(VIEW_SIZE) / 2 + rng.uniform(-SHIFT_PX, SHIFT_PX, 2)
    move = np.column_stack([linear, middle - linear @ (np.array(FRAME_SIZE) / 2)])
    image = np.ascontiguousarray(water[: VIEW_SIZE[1], : VIEW_SIZE[0]])
    cv2.warpAffine(frame, move, VIEW_SIZE, dst=image, borderMode=cv2.BORDER_TRANSPARENT)
    return CompositeView(image, quads @ move[:, :2].T + move[:, 2], turn, instant)
