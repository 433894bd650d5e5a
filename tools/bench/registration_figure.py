"""Success of registration against each axis, ours and the peers': the figure of `podwatch bench
registration`."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from tools.bench.registration_peers import METHODS, peer_key
from tools.bench.registration_scenes import Cell

__all__ = ["POINTS", "Point", "draw"]

DEG = float(np.pi / 180)
N_ANIMALS = 9
# Okabe and Ito (2008), black for ours.
STYLES = {
    "ours": ("#000000", "o", "-"),
    "literal (paper)": ("#D55E00", "s", "-"),
    "literal from 36 headings": ("#E69F00", "D", "--"),
    "ICP on centres": ("#0072B2", "v", "--"),
    "CPD rigid": ("#009E73", "^", "--"),
    "CPD affine": ("#CC79A7", "<", "--"),
}
AXES = {
    "heading": "relative heading, degrees",
    "jitter": "error of a box's edge, % of its side",
    "missed": "animals missed in each view, % (half as many false)",
    "shift": "shift between the views, % of the image's width",
    "moved": "moved between the views, body lengths",
    "animals": "animals in the pod",
}


@dataclass(frozen=True)
class Point:
    """One place on one axis, and the cell that is measured there."""

    axis: str
    value: float
    cell: Cell

    @property
    def key(self) -> str:
        return self.cell.name


def _points() -> tuple[Point, ...]:
    """Elsewhere than on its axis a cell is nine animals at any heading, an error of 5 % and full views."""
    points = []
    for value in (0.0, 15.0, 30.0, 45.0, 60.0, 90.0, 135.0, 180.0):
        cell = Cell("", N_ANIMALS, heading_rad=value * DEG, exact_heading=True, full_view=True)
        points.append(("heading", value, cell))
    for value in (0.0, 2.0, 5.0, 10.0, 15.0, 20.0):
        points.append(("jitter", value, Cell("", N_ANIMALS, jitter=value / 100, full_view=True)))
    for value in (0.0, 5.0, 10.0, 20.0, 30.0):
        points.append(("missed", value, Cell("", N_ANIMALS, missed=value / 100, false=value / 200)))
    for value in (5.0, 10.0, 25.0, 50.0, 65.0):
        points.append(("shift", value, Cell("", N_ANIMALS, shift=value / 100)))
    for value in (0.0, 0.5, 1.0, 2.0, 3.0):
        points.append(("moved", value, Cell("", N_ANIMALS, moved=value)))
    for value in (2, 3, 5, 9, 14, 20):
        points.append(("animals", float(value), Cell("", value, full_view=True)))
    return tuple(Point(axis, value, _named(cell, f"axis {axis} {value:g}")) for axis, value, cell in points)


def _named(cell: Cell, name: str) -> Cell:
    return Cell(**{**vars(cell), "name": name})


POINTS = _points()


def draw(counts: Mapping[str, Counter[str]], pairs: int, seed: int) -> Figure:
    """One panel an axis, one line a method: percent of `pairs` pairs with all matches right."""
    figure = Figure(figsize=(11.5, 7.0), dpi=110, layout="constrained")
    panels = figure.subplots(2, 3, sharey=True)
    for panel, (axis, label) in zip(panels.flat, AXES.items(), strict=True):
        for method in METHODS:  # ours below the others, and wide, so that none hides another
            colour, marker, line = STYLES[method]
            places, shares = [], []
            for point in POINTS:
                one = counts.get(peer_key(method, point.key), Counter())
                if point.axis == axis and one["n"]:
                    places.append(point.value)
                    shares.append(100 * one["right"] / one["n"])
            is_ours = method == METHODS[0]
            panel.plot(
                *(places, shares, line),
                color=colour,
                marker=marker,
                markersize=7 if is_ours else 4,
                linewidth=4.0 if is_ours else 1.3,
                label=method,
            )
        panel.set_xlabel(label)
        panel.set_ylim(-3, 103)
        panel.grid(color="#dddddd", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        if axis == "heading":
            panel.set_xticks(range(0, 181, 45))
        if axis == "animals":
            panel.set_xticks([point.value for point in POINTS if point.axis == axis])
    for panel in panels[:, 0]:
        panel.set_ylabel("pairs with all matches right, %")
    handles, labels = panels.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(METHODS), frameon=False)
    figure.supxlabel(
        f"{pairs} pairs a point, seed {seed}; nine animals at any heading where the axis says nothing else",
        fontsize=8,
        color="#666666",
    )
    return figure
