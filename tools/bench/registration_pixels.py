"""The paper's experiment on registration with real pixels: 39 views of nine whales, our own detector, 200 of
the 741 pairs of views; and its figure.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from procs.detector.yolo import Detector
from procs.registrar.box_icp import box_icp
from tools.bench.registration_composite import VIEW_SIZE, CompositeView, composite_views
from tools.bench.table import Row
from tools.train.detector.samples import held_out, read_yolo, real_data

__all__ = ["draw", "pixel_rows"]

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
Pair = tuple[int, int]

N_PAIRS = 200
NEAR_RAD = float(np.deg2rad(20.0))  # where the paper's algorithm is at home
SHOWN = 4  # views beside the leftmost
PICTURE = "registration_pixels.png"
# After Okabe and Ito (2008), lighter so as to be seen on water; red is for what is wrong.
COLOURS = (
    *("#56B4E9", "#E69F00", "#00D09C", "#F0E442", "#FF9AD5", "#9DB4FF", "#FFFFFF", "#C8A2FF", "#A6E22E"),
)
RED = "#FF2020"


@dataclass(frozen=True)
class Detected:
    """One view, its boxes (N, 4) px and which animal each is (N,), -1 a false alarm."""

    view: CompositeView
    boxes: Array
    animals: Ints

    @property
    def is_complete(self) -> bool:
        """Every animal found once and nothing else."""
        return sorted(self.animals.tolist()) == list(range(len(self.view.quads)))


def pixel_rows(seed: int, out: Path) -> Iterator[Row]:
    """The experiment's rows, its figure written into `out`. One MISSING row where the photographs are not."""
    folder = real_data() / "right_whales"
    if not folder.is_dir():
        why = f"there is no {folder}; PODWATCH_REAL_DATA may name the folder of real data"
        yield Row("real pixels", 0, str(seed), None, why=why)
        return
    _, kept = held_out(sorted((folder / "images").glob("*.jpg")))
    rng = np.random.default_rng(seed)
    views = _detected(composite_views(read_yolo(kept, folder / "labels"), rng))
    complete = [view.is_complete for view in views]
    shown = f"{sum(complete)} of {len(views)}"
    yield Row("real pixels: views in which just the nine are found", len(views), str(seed), shown, aim="39")
    everything = list(combinations(range(len(views)), 2))
    pairs = [everything[row] for row in rng.choice(len(everything), N_PAIRS, replace=False).tolist()]
    yield _row("pairs right, any heading", views, pairs, "robust", seed)
    whole = [pair for pair in everything if complete[pair[0]] and complete[pair[1]]]
    near = [pair for pair in whole if abs(_turn(views, pair)) < NEAR_RAD][:N_PAIRS]
    whole = [whole[row] for row in rng.choice(len(whole), min(N_PAIRS, len(whole)), replace=False).tolist()]
    yield _row("pairs of complete views right", views, whole, "robust", seed)
    yield _row("pairs right, literal mode", views, pairs, "literal", seed)
    yield _row("pairs of complete views within 20 degrees, literal mode", views, near, "literal", seed)
    draw(views).savefig(out / PICTURE)


def _detected(views: Sequence[CompositeView]) -> list[Detected]:
    detector = Detector()
    found = []
    for view in views:
        boxes = np.asarray(detector.detect(view.image).boxes, dtype=np.float64)
        found.append(Detected(view, boxes, _animals_of(boxes, view.quads)))
    return found


def _animals_of(boxes: Array, quads: Array) -> Ints:
    """Which animal each box is: at most one box an animal, its centre nearer to the label's than half the
    label's size.
    """
    animals = np.full(len(boxes), -1, dtype=np.intp)
    centres, middles = (boxes[:, :2] + boxes[:, 2:]) / 2, quads.mean(axis=1)
    distance = np.linalg.norm(centres[:, None] - middles[None], axis=2)
    reach = np.linalg.norm(quads[:, 2] - quads[:, 0], axis=1) / 2
    rows, columns = linear_sum_assignment(distance)
    for row, column in zip(rows, columns, strict=True):
        if distance[row, column] < reach[column]:
            animals[row] = column
    return animals


def _turn(views: Sequence[Detected], pair: Pair) -> float:
    """Radians from one view's heading to the other's, -pi to pi."""
    apart = views[pair[1]].view.turn_rad - views[pair[0]].view.turn_rad
    return float(np.angle(np.exp(1j * apart)))


def _matches(source: Detected, target: Detected, mode: Literal["robust", "literal"]) -> set[Pair]:
    answer = box_icp(source.boxes, target.boxes, image_size=VIEW_SIZE, mode=mode)
    return {(int(row), int(column)) for row, column in answer.matches}


def _true_matches(source: Detected, target: Detected) -> set[Pair]:
    return {
        (row, column)
        for row, animal in enumerate(source.animals.tolist())
        for column, other in enumerate(target.animals.tolist())
        if animal == other >= 0
    }


def _row(
    name: str,
    views: Sequence[Detected],
    pairs: Sequence[Pair],
    mode: Literal["robust", "literal"],
    seed: int,
) -> Row:
    """How many pairs have exactly the true matches of what was detected."""
    right = sum(
        _matches(views[one], views[other], mode) == _true_matches(views[one], views[other])
        for one, other in pairs
    )
    figure = f"{100 * right / len(pairs):.1f} % ({right} of {len(pairs)})" if pairs else None
    return Row(f"real pixels: {name}", len(pairs), str(seed), figure, aim="paper: 100 % (200 of 200)")


def draw(views: Sequence[Detected]) -> Figure:
    """The paper's figure: what was detected in the leftmost view, numbered, and the same individuals in other
    views by registration with it. A wrong match is red.
    """
    reference = next((view for view in views if view.is_complete), views[0])
    others = [view for view in views if view is not reference]
    by_turn = sorted(others, key=lambda view: (view.view.turn_rad - reference.view.turn_rad) % (2 * np.pi))
    places = np.linspace(0, len(by_turn) - 1, SHOWN + 2).round().astype(int)[1:-1]
    shown = [reference, *(by_turn[place] for place in places)]
    figure = Figure(figsize=(3.6 * len(shown), 3.0), dpi=110, layout="constrained")
    for column, (panel, view) in enumerate(zip(figure.subplots(1, len(shown)), shown, strict=True)):
        named = {row: row for row in range(len(reference.boxes))}
        if column:
            named = {target: source for source, target in _matches(reference, view, "robust")}
        right = sum(reference.animals[source] == view.animals[row] for row, source in named.items())
        turn = np.degrees(_turn([reference, view], (0, 1)))
        title = "the leftmost view" if not column else f"turned {turn:.0f}°: {right} of {len(named)} right"
        _draw_view(panel, view, named, reference)
        panel.set_title(title, fontsize=10)
    return figure


def _draw_view(panel: Axes, view: Detected, named: dict[int, int], reference: Detected) -> None:
    panel.imshow(view.view.image[..., ::-1])
    panel.set_axis_off()
    for row, (left, top, right, bottom) in enumerate(view.boxes.tolist()):
        source = named.get(row, -1)
        is_right = source >= 0 and reference.animals[source] == view.animals[row]
        colour = COLOURS[source % len(COLOURS)] if is_right else RED
        panel.add_patch(
            Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=colour, linewidth=1.6)
        )
        panel.text(
            *(left - 6, top, str(source + 1) if source >= 0 else "?"),
            ha="right",
            va="top",
            fontsize=9,
            fontweight="bold",
            bbox={"boxstyle": "square,pad=0.1", "facecolor": colour, "edgecolor": "none"},
        )
