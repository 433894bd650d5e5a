"""Box-ICP: which box of one view is which box of another (paper, Algorithm 1; docs/registration.md).

`mode="literal"` is the algorithm as printed. `mode="robust"`, the default, holds at any relative heading,
with misses, false alarms, tilt and partly overlapping views: hypotheses from pairs of boxes, one coarse
score for all of them, refinement from wide to narrow with a dustbin, and a confidence from the margin over
every other matching that was met.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.cameras.pinhole import inverse
from procs.registrar._literal import literal_alignment
from procs.registrar._marks import Marks, check_boxes, marks_from_boxes
from procs.registrar._pair import Pair, Prior, apply_homographies
from procs.registrar._refine import Candidate, refine
from procs.registrar._search import find_similarities

__all__ = ["BoxAlignment", "Marks", "Prior", "align_marks", "box_icp", "marks_from_boxes"]

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

HEADING_PRIOR_STD_RAD = float(np.deg2rad(8.0))  # two compasses of 5 degrees and a little
CONFIDENCE_TEMPERATURE = 1.6  # margins are over-confident by about this factor: boxes err together
# Log evidence that views of different pods of 3 animals reach by chance, and what each of two more adds.
UNRELATED_SCORE, UNRELATED_PER_BOX = 2.0, 3.0
AMBIGUOUS_MARGIN = 2.2  # nats; a rival matching this near is as good as the answer


@dataclass(frozen=True)
class BoxAlignment:
    """How the source view's boxes lie in the target view.

    `transform` (3, 3) source px to target px; `matches` (K, 2) int rows of (source, target), by source;
    `unmatched_source`, `unmatched_target` int rows without a partner; `residual_px` the root mean square
    distance of the matched centres in target px, 0 where none; `confidence` 0-1, the chance that every
    match is right; `is_ambiguous` True where another matching explains the boxes nearly as well;
    `iterations` rounds of assignment and fit.
    """

    transform: Array
    matches: Ints
    unmatched_source: Ints
    unmatched_target: Ints
    residual_px: float
    confidence: float
    is_ambiguous: bool
    iterations: int


def box_icp(
    source: ArrayLike,
    target: ArrayLike,
    *,
    image_size: tuple[int, int] | None = None,
    heading_prior_rad: float | Sequence[float] | None = None,
    mode: Literal["robust", "literal"] = "robust",
) -> BoxAlignment:
    """Match the boxes of two views of one scene.

    source, target: (N1, 4), (N2, 4) left, top, right, bottom in px (u right, v down). image_size: (width,
    height) px of both views; with it an unmatched box counts against a matching only where the other camera
    should have seen it. heading_prior_rad: compass heading of the target's camera minus that of the
    source's, clockwise positive, or that with its standard deviation (default 8 degrees); robust mode only.
    Either view may be empty: no match, confidence 0.

    Raises ValueError for a NaN or reversed box (naming the row), a bad image size, prior or mode.
    """
    source_boxes, target_boxes = check_boxes(source, "source"), check_boxes(target, "target")
    if image_size is not None and not (image_size[0] > 0 and image_size[1] > 0):
        raise ValueError(f"image_size is {image_size}: give (width, height) in pixels, both above 0, or None")
    if mode not in ("robust", "literal"):
        raise ValueError(f"mode is {mode!r}: choose 'robust' or 'literal'")
    prior = _heading_prior(heading_prior_rad)
    if mode == "literal":
        return _literal(source_boxes, target_boxes)
    return align_marks(
        marks_from_boxes(source_boxes, image_size), marks_from_boxes(target_boxes, image_size), prior=prior
    )


def _heading_prior(heading_prior_rad: float | Sequence[float] | None) -> Prior:
    if heading_prior_rad is None:
        return Prior()
    values = np.atleast_1d(np.asarray(heading_prior_rad, dtype=np.float64))
    if (
        values.shape not in ((1,), (2,))
        or not np.isfinite(values).all()
        or (len(values) == 2 and values[1] <= 0)
    ):
        raise ValueError(
            f"heading_prior_rad is {heading_prior_rad!r}: give radians, or (radians, std above 0), or None"
        )
    # A camera that turns clockwise sees the scene turn the other way; in px (v down) clockwise is positive.
    return Prior(
        rotation_rad=(-float(values[0]), float(values[1]) if len(values) == 2 else HEADING_PRIOR_STD_RAD)
    )


def align_marks(source: Marks, target: Marks, *, prior: Prior | None = None) -> BoxAlignment:
    """Robust Box-ICP on marks in any length unit: a view in metres against a map, or a view against a
    view.
    """
    prior = prior or Prior()
    if not len(source) or not len(target):
        return _unmatched(len(source), len(target))
    if (len(source), *_fingerprint(source)) > (len(target), *_fingerprint(target)):
        # One order for both directions, so that the answer for (b, a) is that for (a, b) transposed.
        return _transposed(align_marks(target, source, prior=_reversed(prior, source)), source, target)
    pair = Pair(source, target, prior)
    candidates = refine(pair, find_similarities(pair))
    if not candidates:
        return _unmatched(len(source), len(target))
    best = candidates[0]
    rows = np.flatnonzero(best.columns >= 0)
    matches = np.column_stack([rows, best.columns[rows]])
    transform = pair.denormalised(best.homography)
    confidence, is_ambiguous = _judge(candidates)
    return _alignment(source, target, transform, matches, confidence, is_ambiguous, ITERATIONS)


ITERATIONS = 10


def _alignment(
    source: Marks,
    target: Marks,
    transform: Array,
    matches: Ints,
    confidence: float,
    is_ambiguous: bool,
    iterations: int,
) -> BoxAlignment:
    mapped = apply_homographies(transform[None], source.centres)[0][0]
    apart = mapped[matches[:, 0]] - target.centres[matches[:, 1]]
    residual = float(np.sqrt((apart**2).sum(axis=1).mean())) if len(matches) else 0.0
    return BoxAlignment(
        transform=transform,
        matches=matches[np.argsort(matches[:, 0], kind="stable")].astype(np.intp),
        unmatched_source=np.setdiff1d(np.arange(len(source)), matches[:, 0]).astype(np.intp),
        unmatched_target=np.setdiff1d(np.arange(len(target)), matches[:, 1]).astype(np.intp),
        residual_px=residual,
        confidence=confidence,
        is_ambiguous=is_ambiguous,
        iterations=iterations,
    )


def _unmatched(n_source: int, n_target: int) -> BoxAlignment:
    empty = np.zeros((0, 2), dtype=np.intp)
    return BoxAlignment(np.eye(3), empty, np.arange(n_source), np.arange(n_target), 0.0, 0.0, False, 0)


def _fingerprint(marks: Marks) -> tuple[float, ...]:
    """Numbers that order two views whatever the order, place, scale or quarter turn of their boxes."""
    sizes = np.sort(marks.sizes)
    return tuple(np.round(sizes / sizes.mean(), 9).tolist())


def _reversed(prior: Prior, source: Marks) -> Prior:
    rotation, log_scale, position = prior.rotation_rad, prior.log_scale, None
    if rotation is not None:
        rotation = (-rotation[0], rotation[1])
    if log_scale is not None:
        log_scale = (-log_scale[0], log_scale[1])
    return Prior(rotation, log_scale, position, None)


def _transposed(alignment: BoxAlignment, source: Marks, target: Marks) -> BoxAlignment:
    return _alignment(
        source,
        target,
        inverse(alignment.transform) if len(alignment.matches) else np.eye(3),
        alignment.matches[:, ::-1],
        alignment.confidence,
        alignment.is_ambiguous,
        alignment.iterations,
    )


def _judge(candidates: list[Candidate]) -> tuple[float, bool]:
    """Confidence and ambiguity of the best matching from its margins over all that could stand in its
    place.
    """
    best = candidates[0]
    margins = [best.score - other.score for other in candidates[1:]]
    contradicting = [
        margin
        for margin, other in zip(margins, candidates[1:], strict=True)
        if _contradicts(best.columns, other.columns)
    ]
    swaps, lone = _exchange_margins(best)
    everything = np.concatenate([margins, swaps, lone])
    # With fewer boxes nothing could tell different pods apart; two drones over one pod are taken at that.
    if (n_boxes := min(best.gains.shape)) >= 3:
        unrelated = UNRELATED_SCORE + UNRELATED_PER_BOX * (min(n_boxes, 5) - 3)
        everything = np.append(everything, best.score - unrelated)
    rivals = np.exp(-np.maximum(everything, 0.0) / CONFIDENCE_TEMPERATURE).sum()
    nearest = min([np.inf, *contradicting, *swaps])
    return float(1 / (1 + rivals)), bool(nearest < AMBIGUOUS_MARGIN)


def _contradicts(one: Ints, other: Ints) -> bool:
    both = (one >= 0) & (other >= 0)
    return bool((one[both] != other[both]).any()) or not both.any()


def _exchange_margins(best: Candidate) -> tuple[Array, Array]:
    """Loss from exchanging two partners (P,), and from adding, dropping or moving one match (L,), under the
    best fit.
    """
    rows = np.flatnonzero(best.columns >= 0)
    columns = best.columns[rows]
    own = best.gains[rows, columns]
    crossed = best.gains[np.ix_(rows, columns)]
    first, second = np.triu_indices(len(rows), 1)
    swaps = (
        own[first]
        + own[second]
        - np.maximum(crossed[first, second], 0)
        - np.maximum(crossed[second, first], 0)
    )
    free_columns = np.setdiff1d(np.arange(best.gains.shape[1]), columns)
    free_rows = np.setdiff1d(np.arange(best.gains.shape[0]), rows)
    moved = (own[:, None] - best.gains[np.ix_(rows, free_columns)]).ravel()
    taken = (own[None, :] - best.gains[np.ix_(free_rows, columns)]).ravel()
    added = -best.gains[np.ix_(free_rows, free_columns)].ravel()
    return swaps, np.concatenate([own, moved, taken, added])


def _literal(source: Array, target: Array) -> BoxAlignment:
    """Confidence is 1 less the mean corner distance in mean box sides: the paper gives none, and no
    ambiguity either.
    """
    if not len(source) or not len(target):
        return _unmatched(len(source), len(target))
    transform, matches, costs, iterations = literal_alignment(source, target)
    side = max(float((target[:, 2:] - target[:, :2]).mean()), 1e-9)
    confidence = float(np.clip(1 - costs.mean() / 4 / side, 0.0, 1.0))
    source_marks, target_marks = marks_from_boxes(source, None), marks_from_boxes(target, None)
    return _alignment(source_marks, target_marks, transform, matches, confidence, False, iterations)
