"""`podwatch views`: pictures of one scene from several viewpoints stand for several drones (paper, three-view
experiment).

Each picture is one drone's camera: its animals are detected, the ring of views agrees which is which, and
each drone takes one. One figure shows it as the paper does: raw views, detections with each view's own
numbers, the agreed identities, and each drone's animal in red.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from procs.assigner.solve import assign
from procs.detector.yolo import Detector
from procs.registrar.ring import register_ring
from tools.errors import FAILED, UNUSABLE

__all__ = ["Agreement", "ViewsError", "agree", "command", "common_frame", "draw", "read_pictures"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SHOWN_PX = 900  # pictures are drawn no wider than this
COLUMN_IN = 3.6  # width of one drone's column
LETTER_IN = 0.095  # width of a letter of a title, at most on average
LABEL_SHARE = 0.05  # height of a box's label, of the picture's width
SAME_SHAPE = 0.02  # of the aspect ratio: views of one camera
# Okabe and Ito (2008), without the red that marks a drone's own animal.
COLOURS = ("#56B4E9", "#E69F00", "#009E73", "#F0E442", "#CC79A7", "#0072B2", "#FFFFFF", "#999999")
RED = "#FF2020"


class ViewsError(Exception):
    """Pictures that cannot stand for a fleet's views; the message names the picture and the remedy."""


@dataclass(frozen=True)
class Agreement:
    """What the ring of views came to; all lists in the order of the views."""

    boxes: list[Array]  # (Ni, 4) xyxy px of each picture
    identities: list[NDArray[np.int64]]  # (Ni,) agreed ids, -1 where unconfirmed
    consensus: bool
    confidence: float
    takes: list[int]  # the identity that each drone takes, -1 where it stands by
    is_distinct: bool


def command(pictures: Sequence[Path], out: Path, confidence: float = 0.25, model: Path | None = None) -> None:
    """Read, detect, register, assign, draw. Exit code 2 for pictures that cannot be used, 1 where no animal
    is found.
    """
    try:
        images = read_pictures(pictures)
    except ViewsError as error:
        typer.echo(f"podwatch: {error}", err=True)
        raise typer.Exit(UNUSABLE) from None
    detector = Detector(model, confidence=confidence)
    boxes = [np.asarray(detector.detect(image).boxes, dtype=np.float64) for image in images]
    for path, found in zip(pictures, boxes, strict=True):
        typer.echo(f"{path.name}: {len(found)} animal{'' if len(found) == 1 else 's'}")
    if not any(len(found) for found in boxes):
        typer.echo(
            f"podwatch: no animal found in any of {len(images)} pictures at confidence {confidence:g}; "
            "try a lower --confidence, pictures from nearer, or a --model of your own",
            err=True,
        )
        raise typer.Exit(FAILED)
    agreement = agree(boxes, [(image.shape[1], image.shape[0]) for image in images])
    out.parent.mkdir(parents=True, exist_ok=True)
    draw(images, agreement, [path.name for path in pictures]).savefig(out)
    typer.echo(_told(agreement))
    typer.echo(str(out))


def read_pictures(paths: Sequence[Path]) -> list[Image]:
    """(H, W, 3) BGR of each picture; the first frame of a video.

    Raises ViewsError: fewer than two, a file that is missing or that holds no picture.
    """
    if len(paths) < 2:
        raise ViewsError(f"{len(paths)} picture given: two or more views of one scene are needed")
    return [_read(path) for path in paths]


def _read(path: Path) -> Image:
    if not path.is_file():
        raise ViewsError(f"{path}: no such file; give pictures or videos of one scene")
    # Decoded from memory: cv2's own file reading writes a warning of its own for each failure.
    data = np.fromfile(path, dtype=np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if image is None and len(data):
        video = cv2.VideoCapture(str(path))
        image = video.read()[1]
        video.release()
    if image is None:
        raise ViewsError(
            f"{path}: holds no picture that can be read ({len(data)} bytes); give a JPEG, PNG or video"
        )
    return np.asarray(image, dtype=np.uint8)


def agree(boxes: Sequence[Array], sizes: Sequence[tuple[int, int]]) -> Agreement:
    """Register (Ni, 4) boxes of views round the ring, and give each view one animal.

    `sizes` are the pictures' (width, height) px. Views of other sizes are scaled to the first's width; where
    shapes differ too, registration is not told where views end.
    """
    width, height = sizes[0]
    scaled = [found * (width / size[0]) for found, size in zip(boxes, sizes, strict=True)]
    is_one_shape = all(abs(size[0] * height / (size[1] * width) - 1) < SAME_SHAPE for size in sizes)
    ring = register_ring(scaled, image_size=(width, height) if is_one_shape else None)
    known = sorted({int(i) for ids in ring.identities for i in ids if i >= 0})
    if not known:
        return Agreement(
            list(boxes), ring.identities, ring.consensus, ring.confidence, [-1] * len(boxes), False
        )
    centres = [(found[:, :2] + found[:, 2:]) / 2 for found in scaled]
    middles = [np.array([width, width * size[1] / size[0]]) / 2 for size in sizes]
    costs = common_frame(centres, ring.identities, middles, known)
    assignment = assign(costs)
    takes = [known[goal] if goal >= 0 else -1 for goal in assignment.goals]
    return Agreement(
        list(boxes), ring.identities, ring.consensus, ring.confidence, takes, assignment.is_distinct
    )


def common_frame(
    centres: Sequence[Array],
    identities: Sequence[NDArray[np.int64]],
    middles: Sequence[Array],
    known: Sequence[int],
) -> Array:
    """(n_views, n_known) distance of each view's image centre from each animal, in px of the first placed
    view.

    Views are laid over one another by the animals that they share, the best connected first, each by the
    similarity that fits its animals best. A view that shares none counts in its own pixels, and cannot take
    what it does not see.
    """
    places: dict[int, Array] = {}
    fits: dict[int, tuple[Array, Array]] = {}
    named = [
        {int(i): centre for i, centre in zip(ids, found, strict=True) if i >= 0}
        for ids, found in zip(identities, centres, strict=True)
    ]
    waiting = list(range(len(centres)))
    while waiting:
        view = max(waiting, key=lambda v: (sum(i in places for i in named[v]), len(named[v]), -v))
        waiting.remove(view)
        shared = [i for i in named[view] if i in places]
        if shared or not places:
            turn, shift = _similarity([named[view][i] for i in shared], [places[i] for i in shared])
            fits[view] = turn, shift
            places.update({i: turn @ centre + shift for i, centre in named[view].items() if i not in places})
    costs = np.full((len(centres), len(known)), np.inf)
    for view, middle in enumerate(middles):
        turn, shift = fits.get(view, (np.eye(2), np.zeros(2)))
        seen = places if view in fits else named[view]
        for column, animal in enumerate(known):
            if animal in seen:
                costs[view, column] = np.linalg.norm(seen[animal] - (turn @ middle + shift))
    return costs


def _similarity(source: Sequence[Array], target: Sequence[Array]) -> tuple[Array, Array]:
    """(2, 2) scaled rotation and (2,) shift that take source points nearest to target (Umeyama 1991).

    One pair gives the shift alone, none the identity.
    """
    if not source:
        return np.eye(2), np.zeros(2)
    from_middle, to_middle = np.mean(source, axis=0), np.mean(target, axis=0)
    a, b = np.asarray(source) - from_middle, np.asarray(target) - to_middle
    spread = float((a**2).sum())
    turn = np.eye(2)
    if spread > 1e-9:
        along, across = float((a * b).sum()), float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
        turn = np.array([[along, -across], [across, along]]) / spread
    return turn, to_middle - turn @ from_middle


def draw(images: Sequence[Image], agreement: Agreement, titles: Sequence[str]) -> Figure:
    """One column a view and four rows: raw, own numbers, agreed identities, the drone's own animal in red."""
    aspect = max(image.shape[0] / image.shape[1] for image in images)
    width_in = COLUMN_IN * len(images) + 0.5
    told = [_wrapped(part, width_in) for part in _told(agreement).split("; ")]
    figure = Figure(figsize=(width_in, 4 * COLUMN_IN * aspect + 1.2), dpi=150, layout="constrained")
    grid = figure.subplots(4, len(images), squeeze=False)
    rows = ("seen", "detected", "agreed", "taken")
    for column, (image, title) in enumerate(zip(images, titles, strict=True)):
        shown, scale = _shrunk(image)
        boxes, ids = agreement.boxes[column] * scale, agreement.identities[column]
        take = agreement.takes[column]
        for row, axes in enumerate(grid[:, column]):
            axes.imshow(shown)
            axes.set_xticks([])
            axes.set_yticks([])
            if column == 0:
                axes.set_ylabel(rows[row], fontsize=12)
        taken = f"takes animal {take}" if take >= 0 else "stands by"
        grid[0, column].set_title(f"drone {column + 1}\n{_wrapped(title, COLUMN_IN)}", fontsize=11)
        grid[3, column].set_xlabel(taken, fontsize=11)
        for number, (box, identity) in enumerate(zip(boxes, ids.tolist(), strict=True)):
            _frame(grid[1, column], box, str(number + 1), "#FFFFFF")
            colour = COLOURS[identity % len(COLOURS)] if identity >= 0 else "#000000"
            _frame(grid[2, column], box, str(identity) if identity >= 0 else "?", colour)
            is_own = identity >= 0 and identity == take
            label = str(identity) if identity >= 0 else "?"
            _frame(grid[3, column], box, label, RED if is_own else "#FFFFFF", width=3.0 if is_own else 0.8)
    figure.suptitle("\n".join(told), fontsize=12)
    return figure


def _wrapped(text: str, width_in: float) -> str:
    """In lines that fit into a figure of that width."""
    return textwrap.fill(text, round(width_in / LETTER_IN))


def _shrunk(image: Image) -> tuple[Image, float]:
    """(RGB picture no wider than SHOWN_PX, its px a px of the given one)."""
    scale = min(1.0, SHOWN_PX / image.shape[1])
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale < 1 else image
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB), dtype=np.uint8), scale


def _frame(axes: Axes, box: Array, label: str, colour: str, width: float = 1.6) -> None:
    left, top, right, bottom = box
    axes.add_patch(
        Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=colour, linewidth=width)
    )
    ink = "#000000" if colour in ("#FFFFFF", "#F0E442", "#56B4E9", "#E69F00") else "#FFFFFF"
    # Above a box at the picture's edge its label would be cut.
    place = "top" if top < LABEL_SHARE * axes.get_xlim()[1] else "bottom"
    axes.text(
        left, top, label, fontsize=9, fontweight="bold", color=ink, va=place, ha="left",
        bbox={"facecolor": colour, "edgecolor": "none", "pad": 1.5}, clip_on=True,
    )  # fmt: skip


def _told(agreement: Agreement) -> str:
    """One line for people: was it agreed, and who takes what."""
    n_views, n_animals = (
        len(agreement.boxes),
        len({int(i) for ids in agreement.identities for i in ids if i >= 0}),
    )
    agreed = "agree" if agreement.consensus else "do NOT agree for certain"
    count = "1 animal" if n_animals == 1 else f"{n_animals} animals"
    if agreement.consensus and max(len(boxes) for boxes in agreement.boxes) == 1:
        count += ", though one box in each view fits whatever animal it is"
    taken = ", ".join(
        f"drone {k + 1} takes animal {take}" if take >= 0 else f"drone {k + 1} stands by"
        for k, take in enumerate(agreement.takes)
    )
    return f"{n_views} views {agreed} on {count} (confidence {agreement.confidence:.2f}); {taken}"
