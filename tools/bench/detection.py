"""`podwatch bench detection`: the model that ships and its half-width and 8-bit sisters against their bars.

Rendered scenes come from the split `val`: species, waters and seeds that the trainer never draws, seen as a
drone's camera of 640x480 px sees them. An animal counts where a person who draws boxes would mark it; the
rule is in tools/render/visible.py, and the figures show how recall falls towards it. All shares are at IoU
0.5 and the confidence at which the detector flies.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import models
from procs.detector.yolo import Detector
from tools.bench.detection_figures import by_hardness, draw
from tools.bench.detection_measure import (
    CONFIDENCE,
    CONFIDENCES,
    Tally,
    held_out_photographs,
    look,
    open_detector,
    rendered,
)
from tools.bench.table import Row, bench_console, measured, print_table, write_table
from tools.errors import UnusableError

__all__ = ["FRAMES", "QUICK", "Measures", "available", "command", "sets"]

FRAMES = 1407  # as many as the paper has
SPERM_SCENES = 500
COUNT_SCENES = 200
COUNTS = range(1, 11)
EMPTY_SCENES = 500
QUICK = 24  # scenes a set, for a look
FILES = {"ours": "detector.onnx", "half width": "detector_half.onnx", "int8": "detector_int8.onnx"}
# The paper's Table 1: overall accuracy, false positive and false negative rate, %.
PAPER = {
    "YOLOv8s": (98.29, 1.05, 0.66),
    "YOLOv8n": (96.88, 1.95, 1.17),
    "YOLOv11n": (96.25, 2.46, 1.29),
    "YOLOv11s": (95.81, 1.18, 3.01),
    "DETR": (58.08, 9.70, 32.22),
}


@dataclass
class Measures:
    """What the rows and the figures are made of; filled set by set."""

    seed: int
    most: int = FRAMES  # scenes a set
    paths: dict[str, Path] = field(default_factory=dict)  # by model
    is_own: bool = False  # the caller's own model, beside which no other is measured
    frames: dict[str, Tally] = field(default_factory=dict)  # by model
    counts: dict[int, Tally] = field(default_factory=dict)  # by number of animals, ours

    @property
    def ours(self) -> dict[str, Detector]:
        return {"ours": open_detector(self.paths["ours"])}

    def scenes(self, full: int) -> int:
        return min(full, self.most)

    def why_missing(self, name: str) -> str:
        """Why a model that ships is not among those measured."""
        return "not measured with --model" if self.is_own else f"there is no models/{FILES[name]}"


def available(model: Path | None = None) -> dict[str, Path]:
    """The models that ship and are there; or the caller's own one. Raises UnusableError where it is not."""
    if model is not None:
        if not model.is_file():
            raise UnusableError(f"{model}: no such file; give an ONNX model")
        return {"ours": model}
    folder = models.path(FILES["ours"]).parent
    return {name: folder / file for name, file in FILES.items() if (folder / file).is_file()}


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %"


def _frame_rows(m: Measures) -> Iterator[Row]:
    """Recall and precision, then Table 1's columns of every model and of the paper's."""
    n, seed = m.scenes(FRAMES), f"val {m.seed}"
    detectors = {name: open_detector(path) for name, path in m.paths.items()}
    m.frames = look(detectors, rendered(n, m.seed, "val"))
    found, false, missed = m.frames["ours"].counts()
    recall, precision = found / max(found + missed, 1), found / max(found + false, 1)
    yield Row("rendered validation: recall", n, seed, _percent(recall), "97 %", "99 %", recall >= 0.97)
    yield Row(
        "rendered validation: precision", n, seed, _percent(precision), "95 %", "98.5 %", precision >= 0.95
    )
    for name in FILES:
        if name not in m.frames:
            yield Row(f"Table 1, {name}", n, seed, None, why=m.why_missing(name))
            continue
        yield from _table_1(f"Table 1, {name}", m.frames[name], n, seed)


def _table_1(name: str, tally: Tally, n: int, seed: str) -> Iterator[Row]:
    """Shares of all boxes, right, false and missing, which add up to one as the paper's do."""
    found, false, missed = tally.counts()
    whole = max(found + false + missed, 1)
    yield Row(
        f"{name}: overall accuracy", n, seed, _percent(found / whole), "97 %", "98.5 %", found / whole >= 0.97
    )
    yield Row(
        f"{name}: false positives", n, seed, _percent(false / whole), "2 %", "0.8 %", false / whole <= 0.02
    )
    yield Row(
        f"{name}: false negatives",
        n,
        seed,
        _percent(missed / whole),
        "1.5 %",
        "0.6 %",
        missed / whole <= 0.015,
    )


def paper_rows() -> Iterator[Row]:
    """The paper's own, for comparison: other pictures, other animals."""
    for name, (accuracy, false, missed) in PAPER.items():
        yield Row(f"Table 1, {name}, the paper's", 1407, "-", f"{accuracy} / {false} / {missed} %")


def _hardness_rows(m: Measures) -> Iterator[Row]:
    """Recall by what makes an animal hard to see; drawn as well."""
    ours = m.frames["ours"]
    for title, found, edges in by_hardness(ours):
        parts = [
            f"{low:g}-{high:g}: {100 * hits / n:.0f} ({n})"
            for (low, high), (hits, n) in zip(pairwise(edges), found, strict=True)
            if n
        ]
        yield Row(f"recall % (animals) by {title}", ours.pictures, f"val {m.seed}", ", ".join(parts))
    clear = [a for a in ours.animals if a.long_px >= 24 and a.depth_m < 0.3 and a.contrast >= 20]
    hits = sum(animal.score >= CONFIDENCE for animal in clear)
    name = "recall of the clear ones: 24 px, awash, 20 grey levels"
    yield Row(name, len(clear), f"val {m.seed}", _percent(hits / max(len(clear), 1)))
    share = ours.faint_found / max(ours.faint, 1)
    name = "too small or faint to count, found all the same"
    yield Row(name, ours.faint, f"val {m.seed}", _percent(share))


def _sperm_rows(m: Measures) -> Iterator[Row]:
    """The paper's own species, which the trainer drew too, on water that it never drew: no bar names it."""
    n, seed = m.scenes(SPERM_SCENES), f"val_sperm {m.seed}"
    found, false, missed = look(m.ours, rendered(n, m.seed, "val_sperm"))["ours"].counts()
    recall, precision = found / max(found + missed, 1), found / max(found + false, 1)
    yield Row(
        "rendered sperm whales: recall, precision", n, seed, f"{_percent(recall)}, {_percent(precision)}"
    )


def _count_rows(m: Measures) -> Iterator[Row]:
    """Exact counts of one to ten animals."""
    n, ours = m.scenes(COUNT_SCENES), m.ours
    for animals in COUNTS if m.most > QUICK else (1, 5, 10):
        m.counts[animals] = look(ours, rendered(n, m.seed, "val", animals))["ours"]
        shares = [m.counts[animals].exact_share(confidence) for confidence in CONFIDENCES]
        floor, aim = {5: ("90 %", ""), 10: ("", "95 %")}.get(animals, ("", ""))
        figure = " / ".join(f"{100 * share:.1f}" for share in shares) + " %"
        passed = shares[0] >= 0.9 if floor else None
        name = f"exact count of {animals}, at confidence {' / '.join(map(str, CONFIDENCES))}"
        yield Row(name, n, f"val {m.seed}", figure, floor, aim, passed)


def _photograph_rows(m: Measures) -> Iterator[Row]:
    tally = held_out_photographs(m.ours)["ours"]
    figure = tally.average_precision()
    name = "right whale photographs, the held-out fifth: AP50"
    yield Row(name, tally.pictures, "-", f"{figure:.3f}", "0.85", "0.95", figure >= 0.85)


def _empty_rows(m: Measures) -> Iterator[Row]:
    n = m.scenes(EMPTY_SCENES)
    tally = look(m.ours, rendered(n, m.seed, "empty"))["ours"]
    _, false, _ = tally.counts()
    name = "false alarms an empty sea picture"
    yield Row(name, n, f"empty {m.seed}", f"{false / n:.3f}", "0.05", "0.01", false / n <= 0.05)


def _time_rows(m: Measures) -> Iterator[Row]:
    from tools.bench.detection_speed import speed

    for name, floor, aim in (("ours", 10.0, 5.0), ("int8", 7.0, 3.0)):
        title = f"ms an image at 320 from 720p, one thread, {'float' if name == 'ours' else name}"
        if name not in m.paths:
            yield Row(title, 0, "-", None, why=m.why_missing(name))
            continue
        parts = speed(m.paths[name])
        whole, outside = parts["infer"] + parts["outside"], parts["outside"]
        yield Row(title, 210, "5", f"{whole:.1f} ms", f"{floor:g} ms", f"{aim:g} ms", whole <= floor)
        if name == "ours":
            title = "of it, before and after the network"
            yield Row(title, 210, "5", f"{outside:.2f} ms", "0.8 ms", passed=outside <= 0.8)


def _corruption_rows(m: Measures) -> Iterator[Row]:
    from tools.bench.detection_corruptions import survival

    problems, n = survival(m.paths["ours"])
    figure, why = f"{n - len(problems)} of {n}", "; ".join(f"{name}: {why}" for name, why in problems.items())
    yield Row("corruptions of the input survived", n, "-", figure, "all", "all", not problems, why)


def sets(m: Measures) -> list[tuple[str, Callable[[], Iterator[Row]]]]:
    """The parts of the benchmark in the order of the bars."""
    return [
        ("rendered validation", lambda: _frame_rows(m)),
        ("the paper's Table 1", paper_rows),
        ("hard to see", lambda: _hardness_rows(m)),
        ("sperm whales", lambda: _sperm_rows(m)),
        ("exact counts", lambda: _count_rows(m)),
        ("photographs", lambda: _photograph_rows(m)),
        ("empty seas", lambda: _empty_rows(m)),
        ("time", lambda: _time_rows(m)),
        ("corruptions", lambda: _corruption_rows(m)),
    ]


def command(seed: int, out: Path, *, most: int = FRAMES, model: Path | None = None) -> None:
    """Measure all, print the table, write bench_detection.json and the figures.

    most: scenes a set, of those that the bars ask for. model: another ONNX file than the one that ships.
    """
    console = bench_console()
    m = Measures(seed, most, available(model), is_own=model is not None)
    rows: list[Row] = []
    for name, measure in sets(m):
        with console.status(name):
            rows += measured(measure(), name)
    print_table(f"podwatch bench detection, confidence {CONFIDENCE}", rows, console)
    write_table(out / "bench_detection.json", rows)
    for path in draw(m.frames.get("ours"), m.counts, out):
        console.print(f"Figure: {path}", highlight=False)
