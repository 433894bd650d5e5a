"""The other animals in view: ellipses that claim their own pixels, so that a mask does not run over a
neighbour.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from procs.tracker._body import Body, body_of_weights
from procs.tracker._sight import locate

__all__ = ["claimed_by", "followed", "refreshed", "settle", "within_reach"]

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

CLAIM_REACH = 1.6  # radius of an ellipse within which pixels may be its own
BOX_SLACK = 1.08  # boxes are drawn loose, seldom tight
SETTLE_ROUNDS = 6
FOLLOW_REACH = 1.5  # radius within which a companion is looked for
FOLLOW_SEARCH = 0.35  # of its length, for one that the edge of the picture cuts
FOLLOW_RATE = 0.7  # share of the seen place that a companion takes over a look
TURN_RATE = 0.3
SIZE_RATE = 0.1
LEAST_SHARE = (
    0.35  # of a companion's area: with less evidence than this it is under water and stays where it is
)


def settle(evidence: Map, bodies: list[Body], boxes: list[Array | None]) -> list[Body]:
    """Ellipses of several animals from the evidence (height, width) that they share, all in window px.

    `bodies` are first guesses; an animal's pixels lie in its box (4,) where one is known. Each pixel goes to
    the ellipse that it is nearest to, then each ellipse is drawn anew from its pixels.
    """
    size = (evidence.shape[1], evidence.shape[0])
    rooms = [
        _inside(box, size) if box is not None else body.radius(size) < CLAIM_REACH
        for body, box in zip(bodies, boxes, strict=True)
    ]
    shown = evidence > 0
    for _ in range(SETTLE_ROUNDS):
        radii = np.stack([np.where(r, b.radius(size), np.inf) for b, r in zip(bodies, rooms, strict=True)])
        owner = np.argmin(radii, axis=0)
        settled = []
        for index, (body, room) in enumerate(zip(bodies, rooms, strict=True)):
            own = shown & room & (owner == index)
            seen = body_of_weights(own.astype(np.float32), body.angle_rad)
            settled.append(body if seen is None or seen.area_px < 8 else seen)
        bodies = settled
    return bodies


def _inside(box: Array, size: tuple[int, int]) -> Mask:
    middle, half = (box[:2] + box[2:]) / 2, BOX_SLACK * (box[2:] - box[:2]) / 2
    u = np.abs(np.arange(size[0]) + 0.5 - middle[0]) < half[0]
    v = np.abs(np.arange(size[1]) + 0.5 - middle[1]) < half[1]
    return np.asarray(v[:, None] & u[None, :])


def within_reach(other: Body, size: tuple[int, int]) -> bool:
    """Whether an ellipse may claim pixels of a window of `size` (width, height)."""
    reach = CLAIM_REACH * other.length_px / 2
    return bool((other.centre > -reach).all() and (other.centre < np.array(size) + reach).all())


def claimed_by(others: list[Body], own_radius: Map, *, outright: bool) -> Mask:
    """(height, width) bool: pixels of the other animals.

    A pixel is theirs if it is nearer to their ellipse than to the own one; `outright`, while the own animal
    is unseen and its place a guess, all that their ellipses cover.
    """
    size = (own_radius.shape[1], own_radius.shape[0])
    claimed = np.zeros(own_radius.shape, dtype=np.bool_)
    for other in others:
        if within_reach(other, size):
            theirs = other.radius(size)
            claimed |= (theirs < 1.3) if outright else (theirs < own_radius) & (theirs < CLAIM_REACH)
    return claimed


def followed(evidence: Map, body: Body, rivals: list[Body]) -> Body | None:
    """A companion (window px) moved towards the evidence that is nearer to it than to any rival; None if
    unseen.
    """
    size = (evidence.shape[1], evidence.shape[0])
    radius = body.radius(size)
    claimed = claimed_by(rivals, radius, outright=False)
    theirs = (evidence > 0) & (radius < FOLLOW_REACH) & ~claimed
    seen = body_of_weights(theirs.astype(np.float32), body.angle_rad)
    if seen is None or theirs.sum() < LEAST_SHARE * (radius < 1).sum():
        return None
    if _touches_edge(theirs):
        # Half an animal has another middle and another shape: only the whole ellipse is moved.
        free = np.where(claimed, np.float32(0), evidence)
        return replace(body, centre=locate(free, body, FOLLOW_SEARCH * body.length_px))
    return Body(
        body.centre + FOLLOW_RATE * (seen.centre - body.centre),
        body.length_px * (seen.length_px / body.length_px) ** SIZE_RATE,
        body.width_px * (seen.width_px / body.width_px) ** SIZE_RATE,
        body.angle_rad + TURN_RATE * (seen.angle_rad - body.angle_rad),
    )


def _touches_edge(mask: Mask) -> bool:
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def refreshed(known: list[Body], fresh: list[Body]) -> list[Body]:
    """Fresh boxes' ellipses, with the shape of the known one at the same place: a box does not tell a
    slant.
    """
    kept = []
    for body in fresh:
        near = [old for old in known if np.hypot(*(old.centre - body.centre)) < 0.35 * body.length_px]
        if near and 0.6 < near[0].length_px / body.length_px < 1.7:
            body = replace(near[0], centre=body.centre)
        kept.append(body)
    return kept
