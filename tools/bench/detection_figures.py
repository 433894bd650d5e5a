"""Figures of the detection benchmark: exact counts at three confidences, and recall where seeing is hard."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tools.bench.detection_measure import CONFIDENCE, CONFIDENCES, Animal, Tally

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["by_hardness", "cells", "draw"]

# What makes an animal hard to see: title, value, edges of the cells.
HARDNESS: tuple[tuple[str, Callable[[Animal], float], tuple[float, ...]], ...] = (
    ("long side in the input, px", lambda a: a.long_px, (16, 24, 36, 60, 100, 320)),
    ("depth of the back under water, m", lambda a: a.depth_m, (0, 0.01, 0.3, 0.7, 1.2, 2.0, 3.5)),
    ("contrast with the water, grey levels", lambda a: a.contrast, (10, 15, 20, 30, 45, 70, 255)),
    ("glare (sheen and glitter), 0 to 1", lambda a: a.glare, (0, 0.1, 0.25, 0.5, 0.75, 1.01)),
    ("sea state", lambda a: a.sea_state, (0, 0.5, 1, 2, 3, 4, 5.01)),
)


def cells(
    animals: Sequence[Animal], value: Callable[[Animal], float], edges: Sequence[float]
) -> list[tuple[int, int]]:
    """(found, all) in each cell between two edges, at the confidence that flies."""
    values = np.array([value(animal) for animal in animals])
    found = np.array([animal.score >= CONFIDENCE for animal in animals], bool)
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return [(int(found[place == k].sum()), int((place == k).sum())) for k in range(len(edges) - 1)]


def by_hardness(tally: Tally) -> Iterator[tuple[str, list[tuple[int, int]], tuple[float, ...]]]:
    """(title, (found, all) of each cell, edges) for all that makes an animal hard to see.

    Posters lie on grass: they count by their size alone.
    """
    at_sea = [animal for animal in tally.animals if not animal.on_grass]
    for title, value, edges in HARDNESS:
        animals = tally.animals if title.startswith("long") else at_sea
        yield title, cells(animals, value, edges), edges


def draw(frames: Tally | None, counts: Mapping[int, Tally], folder: Path) -> Iterator[Path]:
    """Write detection_recall.png and detection_counts.png into `folder` -> their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    if frames is not None and frames.animals:
        yield _recall(frames, folder / "detection_recall.png")
    if counts:
        yield _counts(counts, folder / "detection_counts.png")


def _figure(n_rows: int, n_columns: int, width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    return figure, figure.subplots(n_rows, n_columns, squeeze=False)


def _recall(frames: Tally, path: Path) -> Path:
    figure, axes = _figure(2, 3, 11, 6)
    share = frames.faint_found / max(frames.faint, 1)
    figure.suptitle(
        f"Recall on rendered validation scenes ({frames.n_animals} animals; of {frames.faint} more, "
        f"too small or faint to count, {share:.0%} are found)",
        fontsize=11,
    )
    for axis, (title, found, edges) in zip(axes.flat, by_hardness(frames), strict=False):
        _bars(axis, found, edges, title)
    _precision(axes.flat[5], frames)
    figure.savefig(path)
    return path


def _bars(axis: "Axes", found: list[tuple[int, int]], edges: Sequence[float], title: str) -> None:
    shares = [100 * hits / n if n else 0.0 for hits, n in found]
    axis.bar(range(len(found)), shares, color="tab:blue", width=0.85)
    for place, (share, (_, n)) in enumerate(zip(shares, found, strict=True)):
        axis.text(place, 3, f"{share:.0f} %\nn {n}", ha="center", va="bottom", fontsize=7, color="white")
    labels = [f"{low:g}-{high:g}" for low, high in pairwise(edges)]
    axis.set_xticks(range(len(found)), labels, fontsize=8)
    axis.set(xlabel=title, ylabel="recall, %", ylim=(0, 100))
    axis.axhline(97, color="black", linewidth=0.8, linestyle=":")


def _precision(axis: "Axes", frames: Tally) -> None:
    """Precision over recall, with the place where the detector flies."""
    confidences = np.linspace(0.02, 0.95, 60)
    curve = np.array([_rates(frames, float(confidence)) for confidence in confidences])
    axis.plot(curve[:, 0], curve[:, 1], color="tab:blue")
    recall, precision = _rates(frames, CONFIDENCE)
    axis.plot(recall, precision, "o", color="tab:red", label=f"confidence {CONFIDENCE}")
    axis.plot(98.4, 94.7, "k*", label="the paper's, its own pictures")
    axis.set(xlabel="recall, %", ylabel="precision, %", xlim=(50, 100.5), ylim=(50, 100.5))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="lower left")


def _rates(frames: Tally, confidence: float) -> tuple[float, float]:
    found, false, missed = frames.counts(confidence)
    return 100 * found / max(found + missed, 1), 100 * found / max(found + false, 1)


def _counts(counts: Mapping[int, Tally], path: Path) -> Path:
    figure, axes = _figure(1, 1, 6.4, 3.8)
    axis, numbers = axes[0, 0], sorted(counts)
    for confidence, marker in zip(CONFIDENCES, "os^", strict=True):
        shares = [100 * counts[number].exact_share(confidence) for number in numbers]
        axis.plot(numbers, shares, marker=marker, label=f"confidence {confidence}")
    scenes = counts[numbers[0]].pictures
    axis.set(xlabel="animals in the scene", ylabel="exact counts, %", ylim=(0, 101), xticks=numbers)
    axis.set_title(f"Scenes counted exactly, {scenes} a point", fontsize=11)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    figure.savefig(path)
    return path
