"""Figures of the assignment benchmark: distinct answers, quality, bytes and rounds against fleet size and
against loss.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tools.bench.assignment_large import AT_FIVE, AT_RING, LOSS_SIZES, Point

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw"]

COLOURS = {
    "exact": "black",
    "gnn": "tab:red",
    "gnn+resolve": "tab:orange",
    "flooding": "tab:blue",
    "nearest top 3": "tab:cyan",
    "CBAA": "tab:green",
    "auction 0.02": "tab:purple",
    "best of a window": "gray",
}
PANELS: tuple[tuple[str, Callable[[Point], float], bool], ...] = (
    ("distinct answers D, %", lambda point: 100 * point.scores.distinct, False),
    ("quality Q0, %", lambda point: 100 * point.scores.quality, False),
    ("bytes that one agent sends", lambda point: point.bytes_sent, True),
    ("rounds", lambda point: float(point.rounds), True),
)
RATIO = 1.5  # the goals an agent of the figure against fleet size


def draw(points: Sequence[Point], folder: Path) -> Iterator[Path]:
    """Write assignment_rings.png and assignment_loss.png into `folder` -> their paths; nothing where there
    are no points.
    """
    if not points:
        return
    folder.mkdir(parents=True, exist_ok=True)
    yield _rings([point for point in points if point.budget in (AT_FIVE, AT_RING)], folder)
    lossy = [point for point in points if point.budget == "loss"]
    if lossy:
        yield _loss(lossy, folder)


def _figure(n_rows: int, n_columns: int, title: str) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * n_columns, 3.3 * n_rows + 0.9), dpi=110, layout="constrained")
    figure.suptitle(title, fontsize=12)
    return figure, figure.subplots(n_rows, n_columns, squeeze=False)


def _rings(points: Sequence[Point], folder: Path) -> Path:
    title = f"{RATIO:g} goals an agent: five rounds (solid), floor(n/2) rounds (dashed)"
    figure, axes = _figure(2, 2, title)
    chosen = [point for point in points if point.n_goals == round(RATIO * point.n_agents)]
    for axis, (label, value, is_log) in zip(axes.flat, PANELS, strict=True):
        for budget, style in ((AT_FIVE, "-"), (AT_RING, "--")):
            _lines(axis, [point for point in chosen if point.budget == budget], value, style, "n_agents")
        _dress(axis, label, is_log, "agents")
        axis.set_xscale("log")
        sizes = sorted({point.n_agents for point in chosen})
        axis.set_xticks(sizes, [str(size) for size in sizes])
        axis.minorticks_off()
    return _save(figure, axes, folder / "assignment_rings.png")


def _loss(points: Sequence[Point], folder: Path) -> Path:
    sizes = [size for size in LOSS_SIZES if any((p.n_agents, p.n_goals) == size for p in points)]
    title = "What loss does: max(5, floor(n/2)) rounds, exact with its own repeats"
    figure, axes = _figure(len(sizes), 3, title)
    for row, (n_agents, n_goals) in zip(axes, sizes, strict=True):
        chosen = [point for point in points if (point.n_agents, point.n_goals) == (n_agents, n_goals)]
        for axis, (label, value, is_log) in zip(row, PANELS[:3], strict=True):
            _lines(axis, chosen, value, "-", "loss")
            _dress(axis, label, is_log, "share of messages lost")
            axis.set_title(f"{n_agents} agents, {n_goals} goals", fontsize=10)
    return _save(figure, axes, folder / "assignment_loss.png")


def _lines(
    axis: "Axes", points: Sequence[Point], value: Callable[[Point], float], style: str, against: str
) -> None:
    for method, colour in COLOURS.items():
        mine = [point for point in points if point.method == method]
        mine.sort(key=lambda point: float(getattr(point, against)))
        if mine:
            xs = [getattr(point, against) for point in mine]
            axis.plot(xs, [value(point) for point in mine], style, color=colour, marker="o", markersize=3.5)


def _dress(axis: "Axes", label: str, is_log: bool, below: str) -> None:
    axis.set_ylabel(label)
    axis.set_xlabel(below)
    axis.grid(alpha=0.3)
    if is_log:
        axis.set_yscale("log")
    else:
        axis.set_ylim(-3, 103)


def _save(figure: Any, axes: Any, path: Path) -> Path:
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], color=colour, label=method) for method, colour in COLOURS.items()]
    figure.legend(handles=lines, loc="outside lower center", ncol=4, frameon=False)
    figure.savefig(path)
    return path
