"""One judged look at a frame: window, evidence, place, mask, score."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from procs.tracker._appearance import Appearance
from procs.tracker._body import Body, body_of_weights
from procs.tracker._first_look import WORKING_LENGTH_PX, FirstLook, in_frame, in_window
from procs.tracker._pod import claimed_by, followed
from procs.tracker._sight import Map, Sight, body_patch, likeness, locate, segment
from procs.tracker._window import Window, window_round

__all__ = ["LEAST_SEPARATION", "Look", "Reference", "find_again", "look_for_companion", "take_look"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

LEAST_SEPARATION = 0.12  # of evidence, below which nothing stands out: noise alone reaches about 0.05
FLAT_LEVELS = 1.0  # grey levels of standard deviation: a covered lens or a dead camera shows less
WINDOW_MOST_PX = 176.0  # window side: wider searches are done at lower resolution
COMPANION_LENGTH_PX = 32.0  # window px of a companion
COMPANION_SEARCH_PX = 12.0  # beyond its ellipse
LIKENESS_SHARE = 0.2  # of the score; light only, since glints and foam change and a whale rolls
AREA_SPREAD = 0.5  # of the logarithm of the area: a mask of half or double size keeps 0.4 of its score
FOUND_LENGTH_PX = 24.0  # window px: the body's length in a search of the whole frame ...
FOUND_WIDTH_MOST_PX = 320  # ... which is never wider than this
FOUND_EVIDENCE = 0.2
FOUND_AREA = (0.35, 2.2)  # times the expected area
FOUND_TRIED = 6  # largest pieces that are looked at


@dataclass
class Reference:
    """What the first look promised, moved slowly by good ones: the score compares with it."""

    appearance: Appearance
    template: Map
    separation: float
    area_ratio: float

    @classmethod
    def of(cls, first: FirstLook) -> "Reference":
        return cls(first.appearance, first.template, first.sight.separation, first.sight.area_ratio)


@dataclass(frozen=True)
class Look:
    """One look; `located` and `others` are bodies in window px. `sight` is None where the animal was not
    seen.
    """

    window: Window
    lab: Image
    evidence: Map
    located: Body
    others: list[Body]
    sight: Sight | None
    patch: Map | None
    score: float


def take_look(
    image: Image,
    reference: Reference,
    body: Body,
    companions: list[Body],
    search_px: float,
    *,
    is_guess: bool,
) -> Look | None:
    """Look for `body` (frame px) within `search_px` of its place; None where the picture shows nothing there.

    `companions` are the other animals, frame px; `is_guess`: the place is a prediction from some time ago,
    and what the companions' ellipses cover is theirs.
    """
    frame_shape = (image.shape[0], image.shape[1])
    half_px = 0.65 * body.length_px + search_px
    scale = min(1.0, WORKING_LENGTH_PX / body.length_px, WINDOW_MOST_PX / (2 * half_px))
    window = window_round(body.centre, half_px, scale, frame_shape)
    if window is None:
        return None
    pixels = window.cut(image)
    if float(cv2.meanStdDev(pixels)[1].max()) < FLAT_LEVELS:
        return None
    lab = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2LAB), dtype=np.uint8)
    evidence = reference.appearance.evidence(lab)
    others = [in_window(other, window) for other in companions]
    expected = in_window(body, window)
    # Claims hold for the predicted places: an ellipse that slid towards a neighbour must not win its pixels
    # thereby.
    claimed = claimed_by(others, expected.radius(window.size), outright=is_guess)
    free = np.where(claimed, np.float32(-0.3), evidence)
    located = replace(expected, centre=locate(free, expected, search_px * window.scale))
    sight = segment(evidence, located, claimed, window.open_edges(frame_shape))
    if sight is None or sight.separation < LEAST_SEPARATION:
        return Look(window, lab, evidence, located, others, None, None, 0.0)
    patch = body_patch(np.ascontiguousarray(lab[..., 0]), sight.body)
    return Look(window, lab, evidence, located, others, sight, patch, _score(reference, sight, patch))


def look_for_companion(image: Image, reference: Reference, body: Body, rivals: list[Body]) -> Body | None:
    """Another animal's ellipse (frame px) after a coarse look at it, `rivals` being all the others; None if
    unseen.
    """
    half_px = 0.75 * body.length_px + COMPANION_SEARCH_PX
    scale = COMPANION_LENGTH_PX / body.length_px
    window = window_round(body.centre, half_px, scale, (image.shape[0], image.shape[1]))
    if window is None:
        return None
    lab = np.asarray(cv2.cvtColor(window.cut(image), cv2.COLOR_BGR2LAB), dtype=np.uint8)
    evidence = reference.appearance.evidence(lab)
    moved = followed(evidence, in_window(body, window), [in_window(rival, window) for rival in rivals])
    return None if moved is None else in_frame(moved, window)


def _score(reference: Reference, sight: Sight, patch: Map) -> float:
    """0-1: how far it stands out, times how well the area fits, times a little for its likeness to the first
    look.
    """
    stands_out = min(1.0, sight.separation / (0.8 * reference.separation))
    off = np.log(max(sight.area_ratio, 1e-3) / reference.area_ratio) / AREA_SPREAD
    alike = max(0.0, likeness(patch, reference.template, either_way=True))
    return float(stands_out * np.exp(-0.5 * off * off) * (1 - LIKENESS_SHARE + LIKENESS_SHARE * alike))


def find_again(image: Image, reference: Reference, body: Body, companions: list[Body]) -> Body | None:
    """Search the whole frame for a piece with the animal's colours and size; its ellipse in frame px, or
    None.
    """
    height, width = image.shape[:2]
    scale = min(1.0, FOUND_LENGTH_PX / body.length_px, FOUND_WIDTH_MOST_PX / width)
    window = Window(0, 0, width, height, (round(width * scale), round(height * scale)))
    pixels = window.cut(image)
    if float(cv2.meanStdDev(pixels)[1].max()) < FLAT_LEVELS:
        return None
    evidence = reference.appearance.evidence(
        np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2LAB), dtype=np.uint8)
    )
    for other in companions:
        evidence[in_window(other, window).radius(window.size) < 1.2] = -1
    _, labels, stats, _ = cv2.connectedComponentsWithStats((evidence > FOUND_EVIDENCE).astype(np.uint8))
    areas = stats[1:, cv2.CC_STAT_AREA]
    expected = max(body.area_px * window.scale**2, 4.0)
    fits = (areas > FOUND_AREA[0] * expected) & (areas < FOUND_AREA[1] * expected)
    best, best_value = None, 0.0
    for piece in sorted((np.flatnonzero(fits) + 1).tolist(), key=lambda i: -int(areas[i - 1]))[:FOUND_TRIED]:
        left, top, wide, high = (int(x) for x in stats[piece, :4])
        part = (slice(top, top + high), slice(left, left + wide))
        own = labels[part] == piece
        seen = body_of_weights(own.astype(np.float32), body.angle_rad)
        if seen is None:
            continue
        seen = replace(seen, centre=seen.centre + np.array([left, top]))
        off = float(np.log(areas[piece - 1] / expected))
        long = float(np.log(seen.length_px / (body.length_px * window.scale)))
        value = float(evidence[part][own].mean()) * float(np.exp(-off * off - 2 * long * long))
        if value > best_value:
            best, best_value = seen, value
    if best is None:
        return None
    return replace(body, centre=window.to_frame(best.centre), angle_rad=best.angle_rad)
