"""Large pictures in overlapping tiles, so that small animals are seen at the size that the network knows."""

from typing import Literal

import numpy as np

from procs.detector.decode import Candidates

__all__ = ["drop_cut", "tile_windows"]

OVERLAP = 0.25  # of a tile: animals up to this long lie whole in at least one
AUTO_SHRINK = 2.5  # the whole picture shrunk by more than this hides small animals
AUTO_TILE_SHRINK = 1.5  # by how much a tile is shrunk
MOST_TILES = 12  # a cap on the time one picture takes; larger pictures get larger tiles
SEAM_PX = 2.0


def _starts(length: int, tile: int) -> list[int]:
    """Where tiles begin along a side, evenly spread, at least OVERLAP of a tile shared."""
    if tile >= length:
        return [0]
    count = int(np.ceil((length - tile) / (tile * (1 - OVERLAP)))) + 1
    return [int(start) for start in np.round(np.linspace(0, length - tile, count))]


def tile_windows(
    size: tuple[int, int], tile: int | Literal["auto"] | None, input_size: tuple[int, int]
) -> list[tuple[int, int, int, int]]:
    """Windows (left, top, right, bottom) px to look at beside the whole picture of `size`; none for small
    pictures.
    """
    width, height = size
    if tile is None:
        return []
    if tile == "auto":
        if max(width / input_size[0], height / input_size[1]) <= AUTO_SHRINK:
            return []
        side = int(AUTO_TILE_SHRINK * max(input_size))
        while len(_starts(width, side)) * len(_starts(height, side)) > MOST_TILES:
            side = int(side * 1.1)
    else:
        side = tile
    columns, rows = _starts(width, side), _starts(height, side)
    if len(columns) * len(rows) == 1:
        return []
    return [(left, top, min(left + side, width), min(top + side, height)) for top in rows for left in columns]


def drop_cut(found: Candidates, window: tuple[int, int, int, int], size: tuple[int, int]) -> Candidates:
    """Without boxes that touch a seam inside the picture: a neighbouring tile or the whole view has them
    uncut.

    Boxes are in the window's own pixels.
    """
    left, top, right, bottom = window
    low = np.array([SEAM_PX if left > 0 else -np.inf, SEAM_PX if top > 0 else -np.inf])
    high = np.array(
        [
            right - left - SEAM_PX if right < size[0] else np.inf,
            bottom - top - SEAM_PX if bottom < size[1] else np.inf,
        ]
    )
    whole = np.all(found.boxes[:, :2] >= low, axis=1) & np.all(found.boxes[:, 2:] <= high, axis=1)
    return found.take(whole)
