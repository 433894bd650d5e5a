"""Right whales with the proportions of real ones, from the table of outlines in ../shared/data."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.sim.render import SPECIES, Species
from drivers.sim.render.species import STATIONS, with_widths

__all__ = ["measured_right_whales"]

Array = NDArray[np.float64]
SIDE_POINTS = ("head1", "head2", "eye", "body1", "body2", "body3", "peduncle_width")


def measured_right_whales(outlines_csv: Path, count: int = 40) -> list[Species]:
    """About `count` right whales with the widths of real ones; empty if the table is missing.

    The table gives rostrum, peduncle and the two sides' points in pixels; the width at a station is the
    distance between the sides there, in shares of the distance from rostrum to fluke notch.
    """
    if not outlines_csv.is_file():
        return []
    with outlines_csv.open(newline="") as file:
        rows = list(csv.DictReader(file))
    shapes = [_shape(row) for row in rows[:: max(len(rows) // count, 1)]]
    return [shape for shape in shapes if shape is not None]


def _shape(row: dict[str, str]) -> Species | None:
    """None for a strongly bent animal, which has no straight axis to measure along."""

    def point(name: str) -> Array:
        return np.array([float(row[f"{name}_x"]), float(row[f"{name}_y"])])

    rostrum, notch = point("rostrum"), point("fluke")
    length = max(float(np.hypot(*(notch - rostrum))), 1e-9)
    axis = (notch - rostrum) / length
    left, right = (np.array([point(f"side{side}_{name}") for name in SIDE_POINTS]) for side in (1, 2))
    stations = ((left + right) / 2 - rostrum) @ axis / length
    widths = np.hypot(*(left - right).T) / length
    if np.any(np.diff(stations) <= 0) or widths.max() > 0.4:
        return None
    stations, widths = np.append(stations, 1.0), np.append(widths, 0.03)
    along = np.interp(STATIONS, np.concatenate([[0.0], stations]), np.concatenate([[0.03], widths]))
    return with_widths(SPECIES["right"], along)
