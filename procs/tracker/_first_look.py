"""The first look at an animal: from a point and, if there is one, a detector's box to its models of place and
colour.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from procs.tracker._appearance import Appearance
from procs.tracker._body import Body, body_of_box, body_of_weights
from procs.tracker._pod import claimed_by, settle
from procs.tracker._sight import Map, Sight, body_patch, segment
from procs.tracker._window import Window, window_round

__all__ = ["WORKING_LENGTH_PX", "Companion", "FirstLook", "first_look"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

WORKING_LENGTH_PX = 64.0  # window px: longer bodies are looked at in a reduced picture
# Without a box: sides of the squares tried round the point, as shares of the frame's height.
GUESSED_SIDES = (0.08, 0.16, 0.3, 0.5)
# Models fitted to open water "find" something too. Over 80 boxes of whales (photographs and rendered) the
# separation
# was 0.28 or more and the ellipse at most 1.2 of the box; over 160 of water the medians are 0.09 and 1.6.
FIRST_SEPARATION = 0.22
BOX_FILL_MOST = 1.3
FIRST_FILL = 0.62  # of its ellipse: shreds between neighbours, where the animal itself has dived, fill less
POD_REACH = 1.8  # of the own length: companions this near are told apart by their pixels
POD_LENGTH_PX = 40.0  # window px of a body in that wider window
BOX_EDGE = 1.12  # boxes are loose, seldom tight: this far beyond its edge no pixel is thought the animal's


@dataclass(frozen=True)
class Companion:
    """Another animal in view, frame px: a guess of its ellipse, and its box (4,) where the detector gave
    one.
    """

    body: Body
    box: Array | None


@dataclass(frozen=True)
class FirstLook:
    """What the first look found; `body` and `companions` are in frame px, `sight` in the window's."""

    appearance: Appearance
    window: Window
    sight: Sight
    body: Body
    companions: list[Body]
    template: Map


def first_look(
    image: Image, point: Array, box: Array | None, companions: list[Companion]
) -> FirstLook | None:
    """Learn the animal at `point` (2,) px, inside `box` (4,) px where one is given; None where nothing stands
    out.
    """
    if box is not None:
        return _look_in_box(image, point, box, companions)
    best: FirstLook | None = None
    best_value = 0.0
    for share in GUESSED_SIDES:
        half = share * image.shape[0] / 2
        look = _look_in_box(image, point, np.concatenate([point - half, point + half]), companions)
        if look is None:
            continue
        value = look.sight.separation * _fits(look.body, point, half)
        if value > best_value:
            best, best_value = look, value
    return best


def _fits(body: Body, point: Array, half_px: float) -> float:
    """How well a guessed square of `half_px` round `point` holds the body: low where it is cut or lost in
    it.
    """
    reach = float(np.max(np.abs(body.box - np.concatenate([point, point])))) / half_px
    return float(np.clip(2.4 - 1.6 * reach, 0.05, 1)) * float(np.clip(reach / 0.35, 0.2, 1))


def _look_in_box(image: Image, point: Array, box: Array, companions: list[Companion]) -> FirstLook | None:
    frame_shape = (image.shape[0], image.shape[1])
    rough = body_of_box(box)
    window = window_round(rough.centre, rough.length_px, WORKING_LENGTH_PX / rough.length_px, frame_shape)
    if window is None:
        return None
    pixels = window.cut(image)
    if float(pixels.std(axis=(0, 1)).max()) < 1.0:
        return None
    lab = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2LAB), dtype=np.uint8)
    others = [in_window(other.body, window) for other in companions]
    boxes = [None if other.box is None else box_in_window(other.box, window) for other in companions]
    prior, outside = _place_prior(window, point, box, others, boxes)
    if int(outside.sum()) < 32:
        return None
    appearance = Appearance(lab, prior, outside)
    own, around = _settle_pod(
        image, appearance, appearance.evidence(lab), prior, window, rough, box, companions
    )
    others = [in_window(other, window) for other in around]
    body = in_window(own, window)
    sight = None
    for _ in range(2):
        claimed = claimed_by(others, body.radius(window.size), outright=False)
        latest = segment(appearance.evidence(lab), body, claimed, window.open_edges(frame_shape))
        if latest is None:
            break
        sight, body = latest, latest.body
    if sight is None or sight.separation < FIRST_SEPARATION:
        return None
    if sight.area_ratio < FIRST_FILL:
        return None
    if in_frame(sight.body, window).area_px > BOX_FILL_MOST * float(np.prod(box[2:] - box[:2])):
        return None
    template = body_patch(np.ascontiguousarray(lab[..., 0]), sight.body)
    return FirstLook(appearance, window, sight, in_frame(sight.body, window), around, template)


def _settle_pod(
    image: Image,
    appearance: Appearance,
    evidence: Map,
    prior: Map,
    window: Window,
    rough: Body,
    box: Array,
    companions: list[Companion],
) -> tuple[Body, list[Body]]:
    """From boxes to bodies, frame px: moments of the own box's evidence, then shares of all that the pod
    shows.
    """
    weights = np.where(prior > 0.2, np.maximum(evidence, 0) * prior, 0).astype(np.float32)
    own = body_of_weights(weights, 0.0)
    guess = rough if own is None or own.area_px < 8 else in_frame(own, window)
    wide = window_round(
        rough.centre,
        POD_REACH * rough.length_px,
        POD_LENGTH_PX / rough.length_px,
        (image.shape[0], image.shape[1]),
    )
    if wide is None or not companions:
        return guess, [other.body for other in companions]
    shown = appearance.evidence(np.asarray(cv2.cvtColor(wide.cut(image), cv2.COLOR_BGR2LAB), dtype=np.uint8))
    # Only those in view: half an animal would give half an ellipse.
    near = [i for i, other in enumerate(companions) if _is_in(wide, other.body)]
    rooms: list[Array | None] = [box_in_window(box, wide)]
    bodies = [in_window(guess, wide)]
    for index in near:
        theirs = companions[index].box
        rooms.append(None if theirs is None else box_in_window(theirs, wide))
        bodies.append(in_window(companions[index].body, wide))
    settled = [in_frame(body, wide) for body in settle(shown, bodies, rooms)]
    around = [other.body for other in companions]
    for place, index in enumerate(near):
        around[index] = settled[place + 1]
    return settled[0], around


def _is_in(window: Window, body: Body) -> bool:
    left, top, right, bottom = body.box
    return bool(
        left > window.left - 2
        and top > window.top - 2
        and right < window.right + 2
        and bottom < window.bottom + 2
    )


def _place_prior(
    window: Window, point: Array, box: Array, others: list[Body], boxes: list[Array | None]
) -> tuple[Map, NDArray[np.bool_]]:
    """How likely each window pixel is the animal's by place, and which ones are water for sure."""
    width, height = window.size
    centre = window.to_window((box[:2] + box[2:]) / 2)
    half = (box[2:] - box[:2]) / 2 * window.scale
    middle = window.to_window(point)
    u, v = np.arange(width) + 0.5, np.arange(height) + 0.5
    in_box = np.maximum(np.abs(u - centre[0])[None, :] / half[0], np.abs(v - centre[1])[:, None] / half[1])
    from_point = np.hypot((u - middle[0])[None, :] / half[0], (v - middle[1])[:, None] / half[1])
    prior = np.where(in_box < BOX_EDGE, np.clip(0.75 - 0.4 * from_point, 0.05, 0.75), 0)
    outside = in_box > BOX_EDGE
    for other, theirs in zip(others, boxes, strict=True):
        radius = other.radius(window.size)
        prior = np.where(radius < 0.7, np.minimum(prior, 0.1), prior)
        outside &= radius > 1.4
        if theirs is not None:
            away = np.abs(u - (theirs[0] + theirs[2]) / 2)[None, :] > 0.55 * (theirs[2] - theirs[0])
            outside &= away | (
                np.abs(v - (theirs[1] + theirs[3]) / 2)[:, None] > 0.55 * (theirs[3] - theirs[1])
            )
    return prior.astype(np.float32), outside


def in_window(body: Body, window: Window) -> Body:
    """A body in frame px as one in window px."""
    scaled = body.scaled(window.scale)
    return Body(window.to_window(body.centre), scaled.length_px, scaled.width_px, body.angle_rad)


def box_in_window(box: Array, window: Window) -> Array:
    """A (4,) box in frame px as one in window px."""
    return window.to_window(box.reshape(2, 2)).ravel()


def in_frame(body: Body, window: Window) -> Body:
    """A body in window px as one in frame px."""
    scaled = body.scaled(1 / window.scale)
    return Body(window.to_frame(body.centre), scaled.length_px, scaled.width_px, body.angle_rad)
