"""Ways in which a camera, a frame ring or a network can go wrong: the table behind detection_corruptions.

A picture's corruption takes (good picture (H, W, 3) uint8, the same picture each time a little shifted; the
generator) and gives what the camera gives in its place: any object, or an OSError to raise. An output's takes
what the network says and gives what it says in its place. A frame's takes the handle of a frame and gives the
handles that the detector hears in its place.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lcmtypes.podwatch import frame_t

__all__ = ["FRAMES", "OUTPUTS", "PICTURES"]

Image = NDArray[np.uint8]
Random = np.random.Generator
OfPicture = Callable[[Image, Random], Any]
OfOutput = Callable[[NDArray[np.float32]], Any]
OfFrame = Callable[[frame_t], list[frame_t]]

BLOCK_PX = 16


def _filled(picture: Image, *bgr: int) -> Image:
    return np.full_like(picture, bgr)


def _part(picture: Image, rows: slice, columns: slice, *bgr: int) -> Image:
    """With a part of it filled."""
    changed = picture.copy()
    changed[rows, columns] = bgr
    return changed


def _noisy(picture: Image, noise: NDArray[Any] | float) -> Image:
    return np.asarray(np.clip(picture.astype(np.float64) + noise, 0, 255), np.uint8)


def _salted(picture: Image, random: Random) -> Image:
    draw = random.random(picture.shape[:2])
    changed = picture.copy()
    changed[draw < 0.2], changed[draw > 0.8] = 0, 255
    return changed


def _striped(picture: Image, axis: int) -> Image:
    changed = picture.copy()
    changed[(slice(None),) * axis + (slice(None, None, 3),)] = 255
    return changed


def _torn(picture: Image, bands: int) -> Image:
    """Bands of other instants."""
    edges = np.linspace(0, len(picture), bands + 1).astype(int)
    pieces = [
        np.roll(picture[first:last], 40 * k, axis=1)
        for k, (first, last) in enumerate(pairwise(edges.tolist()))
    ]
    return np.ascontiguousarray(np.concatenate(pieces))


def _sheared(picture: Image) -> Image:
    """Each row begins further on: the driver has the wrong row length."""
    return np.stack([np.roll(row, 3 * number, axis=0) for number, row in enumerate(picture)])


def _blocks(picture: Image, random: Random, lost: bool) -> Image:
    """Blocks shuffled, or every third one lost, as where packets of a video are."""
    height, width = (side - side % BLOCK_PX for side in picture.shape[:2])
    grid = picture[:height, :width].reshape(height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX, 3)
    blocks = grid.swapaxes(1, 2).reshape(-1, BLOCK_PX, BLOCK_PX, 3).copy()
    if lost:
        blocks[random.random(len(blocks)) < 1 / 3] = 128
    else:
        random.shuffle(blocks)
    changed = picture.copy()
    shuffled = blocks.reshape(height // BLOCK_PX, width // BLOCK_PX, BLOCK_PX, BLOCK_PX, 3).swapaxes(1, 2)
    changed[:height, :width] = shuffled.reshape(height, width, 3)
    return changed


def _interlaced(picture: Image) -> Image:
    changed = picture.copy()
    changed[1::2] = np.roll(picture[1::2], 12, axis=1)
    return changed


def _jpeg(picture: Image) -> Image:
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 1])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def _coarse(picture: Image) -> Image:
    small = cv2.resize(picture, None, fx=1 / 16, fy=1 / 16, interpolation=cv2.INTER_LINEAR)
    size = (picture.shape[1], picture.shape[0])
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def _read_only(picture: Image) -> Image:
    kept = picture.copy()
    kept.flags.writeable = False
    return kept


ALL = slice(None)

# (name, a word that a heartbeat must say meanwhile, what the camera gives); an empty word where one picture
# does not show that it is wrong.
PICTURES: tuple[tuple[str, str, OfPicture], ...] = (
    ("black", "black", lambda p, _r: _filled(p, 0, 0, 0)),
    ("white", "empty", lambda p, _r: _filled(p, 255, 255, 255)),
    ("grey", "empty", lambda p, _r: _filled(p, 128, 128, 128)),
    ("green", "empty", lambda p, _r: _filled(p, 0, 135, 0)),
    ("almost black", "black", lambda p, r: r.integers(0, 3, p.shape, dtype=np.uint8)),
    ("frozen", "same picture", lambda p, _r: np.full_like(p, np.arange(p.shape[1])[None, :, None] % 200)),
    ("lower half black", "rows are empty", lambda p, _r: _part(p, slice(len(p) // 2, None), ALL, 0, 0, 0)),
    ("upper half grey", "rows are empty", lambda p, _r: _part(p, slice(0, len(p) // 2), ALL, 90, 90, 90)),
    (
        "last third green",
        "rows are empty",
        lambda p, _r: _part(p, slice(len(p) * 2 // 3, None), ALL, 0, 135, 0),
    ),
    ("left half black", "", lambda p, _r: _part(p, ALL, slice(0, p.shape[1] // 2), 0, 0, 0)),
    ("torn once", "", lambda p, _r: _torn(p, 2)),
    ("torn often", "", lambda p, _r: _torn(p, 9)),
    ("sheared", "", lambda p, _r: _sheared(p)),
    ("noise alone", "", lambda p, r: r.integers(0, 256, p.shape, dtype=np.uint8)),
    ("noise over it", "", lambda p, r: _noisy(p, r.normal(0, 60, p.shape))),
    ("salt and pepper", "", _salted),
    ("rows of white", "", lambda p, _r: _striped(p, 0)),
    ("columns of white", "", lambda p, _r: _striped(p, 1)),
    (
        "checkered",
        "",
        lambda p, _r: p * (np.indices(p.shape[:2]).sum(axis=0) % 2)[..., None].astype(np.uint8),
    ),
    ("rows rolled", "", lambda p, _r: np.roll(p, len(p) // 3, axis=0)),
    ("columns rolled", "", lambda p, _r: np.roll(p, p.shape[1] // 3, axis=1)),
    ("rows shuffled", "", lambda p, r: p[r.permutation(len(p))]),
    ("blocks shuffled", "", lambda p, r: _blocks(p, r, lost=False)),
    ("blocks lost", "", lambda p, r: _blocks(p, r, lost=True)),
    ("interlaced", "", lambda p, _r: _interlaced(p)),
    ("channels swapped", "", lambda p, _r: p[..., ::-1]),
    ("one channel lost", "", lambda p, _r: p * np.array([1, 1, 0], np.uint8)),
    ("inverted", "", lambda p, _r: 255 - p),
    ("bits shifted", "", lambda p, _r: p << 3),
    ("two levels", "", lambda p, _r: (p > 80).astype(np.uint8) * 255),
    ("overexposed", "", lambda p, _r: _noisy(p, 150.0)),
    ("blurred", "", lambda p, _r: cv2.GaussianBlur(p, (0, 0), 25)),
    ("JPEG of quality 1", "", lambda p, _r: _jpeg(p)),
    ("sixteen times coarser", "", lambda p, _r: _coarse(p)),
    ("upside down, a view", "", lambda p, _r: p[::-1]),
    ("mirrored, a view", "", lambda p, _r: p[:, ::-1]),
    ("column after column in memory", "", lambda p, _r: np.asfortranarray(p)),
    ("read only", "", lambda p, _r: _read_only(p)),
    ("on its side", "wants", lambda p, _r: np.rot90(p)),
    ("half as large", "wants", lambda p, _r: p[::2, ::2]),
    ("twice as large", "wants", lambda p, _r: np.tile(p, (2, 2, 1))),
    ("12 megapixels", "wants", lambda p, _r: np.zeros((3000, 4000, 3), np.uint8)),
    ("8 x 6 px", "wants", lambda p, _r: p[:6, :8]),
    ("one pixel", "wants", lambda p, _r: p[:1, :1]),
    ("one row", "wants", lambda p, _r: p[:1]),
    ("no rows", "wants", lambda p, _r: p[:0]),
    ("without colour", "wants", lambda p, _r: p[..., 0]),
    ("four channels", "wants", lambda p, _r: np.dstack([p, p[..., :1]])),
    ("a batch", "wants", lambda p, _r: p[None]),
    ("float from 0 to 1", "wants", lambda p, _r: (p / 255).astype(np.float32)),
    ("float with NaN", "wants", lambda p, _r: np.full(p.shape, np.nan)),
    ("16 bits", "wants", lambda p, _r: p.astype(np.uint16) << 8),
    ("booleans", "wants", lambda p, _r: p > 80),
    ("text", "wants", lambda _p, _r: "no picture"),
    ("nothing", "no image", lambda _p, _r: None),
    ("a driver that fails", "the camera fails", lambda _p, _r: OSError("no such device")),
)

OUTPUTS: tuple[tuple[str, str, OfOutput], ...] = (
    ("NaN from the network", "NaN", lambda output: np.full_like(output, np.nan)),
    ("infinity from the network", "infinite", lambda output: np.full_like(output, np.inf)),
    ("scores of 9 from the network", "scores above 1", lambda output: np.full_like(output, 9.0)),
    ("NaN in a few rows", "", lambda output: np.where(np.arange(output.shape[-1]) % 5 == 0, np.nan, output)),
    ("nothing but zeros from the network", "", np.zeros_like),
)


def _changed(frame: frame_t, **members: Any) -> list[frame_t]:
    changed = frame_t.decode(frame.encode())
    for name, value in members.items():
        setattr(changed, name, value)
    return [changed]


FRAMES: tuple[tuple[str, str, OfFrame], ...] = (
    ("frames that the ring has no more", "", lambda frame: _changed(frame, seq=frame.seq - 1000)),
    ("handles said twice", "", lambda frame: [frame, frame]),
    ("times that go backwards", "", lambda frame: _changed(frame, utime=max(1, 10**9 - frame.utime))),
)
