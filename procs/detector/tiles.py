"""Large pictures in overlapping tiles, so that small animals are seen at the size that the network knows.

Every tile owns the part of the picture that is nearer to its middle than to its neighbours'. An animal counts
in the tile that owns its centre, where it lies whole; one that is large for a tile counts as the whole
picture shows it: so none is counted twice, and none in halves.
"""

from collections import deque
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from procs.detector.decode import Candidates

__all__ = ["LEAST_ANIMAL_PX", "SeenLength", "Tile", "merge", "owned", "pieces", "plan", "shortfall"]

OVERLAP = 0.25  # of a tile that its neighbour shows too; an animal nearly so long is whole where it counts
LEAST_ANIMAL_PX = 16.0  # long side at the network's size; smaller animals are missed (docs/detector.md)
HOPELESS_ANIMAL_PX = 8.0  # where tiles show it smaller than this, they are not worth their time
WANTED_ANIMAL_PX = 24.0  # long side that tiles give it, where there is time
MOST_ENLARGED = 0.5  # px of the picture for each px of the input: more enlarging shows nothing new
UNKNOWN_SHRINK = 2.5  # a picture shrunk by more may hide small animals, where nobody knows how large they are
UNKNOWN_TILE_SHRINK = 1.5  # by how much a tile is shrunk then
LEAST_GAIN = 1.25  # tiles that show animals less than so much larger are not worth their time
MOST_TILES = 64
SLACK_PX = 4.0  # of the input: by how much two looks may differ about where an animal is
SAME_IOU = 0.3  # two looks' boxes that overlap by so much are one animal
SAME_AREA = 3.0  # or that hold each other's centres and are not more different than that
LARGE = 0.5  # of a tile; a longer animal may be whole in none, and boxes of its parts end short of the cut
MOST_INSIDE = 0.5  # of a tile's box; with more inside a large animal's box it is a piece of that animal


class Tile(NamedTuple):
    """left, top, right, bottom px of the picture: what the network is shown, and what of it counts."""

    window: tuple[int, int, int, int]
    core: tuple[float, float, float, float]


def plan(
    size: tuple[int, int],
    tile: int | Literal["auto"] | None,
    input_size: tuple[int, int],
    animal_px: float | None = None,
    most: int = MOST_TILES,
) -> list[Tile]:
    """The tiles to look at beside the whole picture of `size`; none where they would show nothing more.

    tile: their side in px, longer where there would be more than 64 of them; "auto" cuts where an animal's
    long side, `animal_px` in px of the picture, would be under 16 px at `input_size` and tiles show it with
    at least 8, into at most `most` tiles; None never cuts. animal_px: None where nobody knows; pictures that
    shrink by more than 2.5 are cut then.
    """
    if tile is None:
        return []
    if tile == "auto":
        shrink = max(size[0] / input_size[0], size[1] / input_size[1])
        if animal_px is None:
            wanted = UNKNOWN_TILE_SHRINK if shrink > UNKNOWN_SHRINK else shrink
        elif animal_px / shrink >= LEAST_ANIMAL_PX:
            wanted = shrink
        else:
            wanted = max(animal_px / WANTED_ANIMAL_PX, MOST_ENLARGED)
        hopeless = shrink if animal_px is None else animal_px / HOPELESS_ANIMAL_PX
        while wanted * LEAST_GAIN <= shrink and wanted <= hopeless:
            sides = (int(wanted * input_size[0]), int(wanted * input_size[1]))
            tiles = _grid(size, sides)
            if len(tiles) <= min(most, MOST_TILES):
                return tiles
            wanted *= 1.05  # fewer tiles, each of more of the picture
        return []
    side = max(tile, int(np.sqrt(size[0] * size[1] / MOST_TILES)))  # too short even without overlap
    while len(tiles := _grid(size, (side, side))) > MOST_TILES:
        side += side // 20 + 1
    return tiles if len(tiles) > 1 else []


def shortfall(
    tiles: list[Tile],
    size: tuple[int, int],
    tile: int | Literal["auto"] | None,
    input_size: tuple[int, int],
    animal_px: float | None,
) -> str:
    """What people should know of the `tiles` that `plan` gave: that they are not as asked for, or that
    animals of `animal_px` are missed all the same. "" where all is well.
    """
    left, top, right, bottom = tiles[0].window if tiles else (0, 0, *size)
    side = max(right - left, bottom - top)
    if isinstance(tile, int) and tiles and side > tile:
        return (
            f"tile = {tile}: more than {MOST_TILES} tiles in a picture of {size[0]} x {size[1]} px; they are "
            f"{side} px instead; set that or more, or auto"
        )
    shown_px = (animal_px or np.inf) / max((right - left) / input_size[0], (bottom - top) / input_size[1])
    if tile != "auto" or shown_px >= LEAST_ANIMAL_PX:
        return ""
    return (
        f"with {len(tiles)} tiles animals are {shown_px:.0f} px long to the network, which misses them below "
        f"{LEAST_ANIMAL_PX:.0f}; fly lower, or raise tile_limit_ms"
    )


def _grid(size: tuple[int, int], sides: tuple[int, int]) -> list[Tile]:
    """Tiles of `sides` all over a picture of `size`, row after row."""
    columns, rows = _spans(size[0], sides[0]), _spans(size[1], sides[1])
    return [
        Tile((left, top, right, bottom), (core_left, core_top, core_right, core_bottom))
        for top, bottom, core_top, core_bottom in rows
        for left, right, core_left, core_right in columns
    ]


def _spans(length: int, side: int) -> list[tuple[int, int, float, float]]:
    """(begin, end, core's begin, core's end) of each tile along a side, evenly spread."""
    if side >= length:
        return [(0, length, -np.inf, np.inf)]
    count = int(np.ceil((length - side) / (side * (1 - OVERLAP)))) + 1
    starts = [round(start) for start in np.linspace(0, length - side, count).tolist()]
    borders = [(second + first + side) / 2 for first, second in pairwise(starts)]
    cores = zip([-np.inf, *borders], [*borders, np.inf], strict=True)
    return [(start, start + side, *core) for start, core in zip(starts, cores, strict=True)]


def owned(found: Candidates, tile: Tile, size: tuple[int, int], shrink: float) -> Candidates:
    """Those of a tile's boxes, in px of the picture, that count: whole, and with their centre in its core.

    shrink: px of the picture for each px of the input.
    """
    slack = SLACK_PX * shrink
    window = np.array(tile.window, np.float64)
    at_border = np.array([window[0] <= 0, window[1] <= 0, window[2] >= size[0], window[3] >= size[1]])
    inner = np.where(at_border, [-np.inf, -np.inf, np.inf, np.inf], window + slack * np.array([1, 1, -1, -1]))
    core = np.array(tile.core) + slack * np.array([-1, -1, 1, 1])
    centre = (found.boxes[:, :2] + found.boxes[:, 2:]) / 2
    whole = np.all(found.boxes[:, :2] >= inner[:2], axis=1) & np.all(found.boxes[:, 2:] <= inner[2:], axis=1)
    return found.take(whole & np.all((centre >= core[:2]) & (centre <= core[2:]), axis=1))


def pieces(found: Candidates, whole: Candidates, side_px: float) -> NDArray[np.bool_]:
    """(N,) which boxes of a tile are a head or a tail of an animal that is large for tiles of `side_px` and
    that the `whole` picture's look has; one that it has by itself too is an animal beside that one.
    """
    is_large = (whole.boxes[:, 2:] - whole.boxes[:, :2]).max(axis=1, initial=0) > LARGE * side_px
    large = whole.take(is_large)
    inside = _shared(found, large) > MOST_INSIDE * _areas(found.boxes)[:, None]
    inside &= found.classes[:, None] == large.classes[None]
    return np.asarray(inside.any(axis=1) & ~_doubles(found, whole.take(~is_large)))


def merge(looks: list[Candidates]) -> Candidates:
    """All looks' boxes in px of the picture, each animal once; of two looks at one the earlier counts."""
    merged = looks[0]
    for look in looks[1:]:
        new = look.take(~_doubles(look, merged))
        merged = Candidates(
            np.concatenate([merged.boxes, new.boxes]),
            np.concatenate([merged.scores, new.scores]),
            np.concatenate([merged.classes, new.classes]),
        )
    return merged


def _doubles(new: Candidates, known: Candidates) -> NDArray[np.bool_]:
    """(N,) which boxes of one look are animals that earlier looks have; each of those is met only once, so
    that two animals side by side stay two.
    """
    double = np.zeros(len(new.scores), np.bool_)
    if not (len(new.scores) and len(known.scores)):
        return double
    shared = _shared(new, known)
    areas, known_areas = _areas(new.boxes), _areas(known.boxes)
    both = areas[:, None] + known_areas[None] - shared
    iou = shared / np.maximum(both, 1e-6)
    larger = np.maximum(areas[:, None], known_areas[None]) / np.maximum(
        np.minimum(areas[:, None], known_areas[None]), 1e-6
    )
    mutual = _holds(new.boxes, known.boxes) & _holds(known.boxes, new.boxes).T
    same = (iou >= SAME_IOU) | (mutual & (larger <= SAME_AREA))
    same &= new.classes[:, None] == known.classes[None]
    likeness = np.where(same, iou + 1, 0)
    while likeness.max() > 0:
        row, column = np.unravel_index(int(likeness.argmax()), likeness.shape)
        double[row] = True
        likeness[row], likeness[:, column] = 0, 0
    return double


def _shared(found: Candidates, others: Candidates) -> NDArray[np.float32]:
    """(N, M) px^2 that two looks' boxes have in common."""
    low = np.maximum(found.boxes[:, None, :2], others.boxes[None, :, :2])
    high = np.minimum(found.boxes[:, None, 2:], others.boxes[None, :, 2:])
    return np.asarray(np.clip(high - low, 0, None).prod(axis=2))


def _areas(boxes: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))


def _holds(boxes: NDArray[np.float32], others: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(N, M): whether box n holds the centre of the other m."""
    centre = (others[:, :2] + others[:, 2:]) / 2
    above = np.all(centre[None] >= boxes[:, None, :2], axis=2)
    return np.asarray(above & np.all(centre[None] <= boxes[:, None, 2:], axis=2))


class SeenLength:
    """How long animals were in the last pictures, px, for as long as some were seen.

    Now and then it says that it does not know: the large ones that it saw may not be all there are.
    """

    REMEMBERED = 10  # pictures with animals
    FORGOTTEN_AFTER = 25  # pictures without any
    DOUBTED_EVERY = 10  # pictures
    SHARE = 0.25  # of the animals that may be shorter than what it says

    def __init__(self) -> None:
        self._lengths: deque[NDArray[np.float32]] = deque(maxlen=self.REMEMBERED)
        self._n_empty = 0
        self._n_asked = 0

    def see(self, boxes: NDArray[np.float32]) -> None:
        """The (N, 4) boxes of one picture."""
        if len(boxes):
            self._lengths.append((boxes[:, 2:] - boxes[:, :2]).max(axis=1))
            self._n_empty = 0
            return
        self._n_empty += 1
        if self._n_empty > self.FORGOTTEN_AFTER:
            self._lengths.clear()

    def ask(self) -> float | None:
        """The length for the next picture, None where it is not known."""
        self._n_asked += 1
        if not self._lengths or self._n_asked % self.DOUBTED_EVERY == 0:
            return None
        return float(np.quantile(np.concatenate(list(self._lengths)), self.SHARE))
