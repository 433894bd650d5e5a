"""One look at one window: where the body lies, which pixels are its own, and how sure that is."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from procs.tracker._body import Body, body_of_weights

__all__ = ["Sight", "body_patch", "likeness", "locate", "outline_of", "segment"]

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

RING = (1.25, 2.0)  # normalised radii of the water ring that a body must stand out from
PRIOR_EDGE = 1.2  # radius at which place says nothing; flukes and flippers reach a little beyond the ellipse
PRIOR_SLOPE = 1.3  # evidence a radius: at twice the ellipse no evidence is enough
PRIOR_TOP = 0.3  # at most this much credit for place alone
PATCH = (48, 20)  # px, length and width of the body-aligned picture that is compared with the first one


@dataclass(frozen=True)
class Sight:
    """What a look found, in window pixels."""

    mask: Mask  # (height, width)
    body: Body  # the ellipse of the mask, or the located one where the frame's edge cuts it
    separation: float  # 0-1, mean evidence inside minus mean in the ring, halved
    area_ratio: float  # mask area over the body prior's area in view
    cut_by_edge: bool


def locate(evidence: Map, body: Body, search_px: float, stride: int = 2) -> Array:
    """(2,) window px: where an ellipse of this shape stands out most from its ring, near its centre.

    Places beyond `search_px` do not count.

    The filter's response is the mean evidence inside minus the mean in the ring: it needs no earlier picture
    and so cannot drift.
    """
    small = evidence[::stride, ::stride]
    reach = int(np.ceil(0.5 * RING[1] * body.length_px / stride))
    kernel_body = replace(
        body,
        centre=np.full(2, reach + 0.5),
        length_px=max(body.length_px / stride, 2.0),
        width_px=max(body.width_px / stride, 2.0),
    )
    radius = kernel_body.radius((2 * reach + 1, 2 * reach + 1))
    inside, ring = radius <= 1, (radius > RING[0]) & (radius < RING[1])
    kernel = inside / max(inside.sum(), 1) - ring / max(ring.sum(), 1)
    response = cv2.filter2D(small, cv2.CV_32F, kernel.astype(np.float32), borderType=cv2.BORDER_CONSTANT)
    # Far from the prediction only a clearly better place wins.
    u = (np.arange(small.shape[1]) + 0.5) * stride - body.centre[0]
    v = (np.arange(small.shape[0]) + 0.5) * stride - body.centre[1]
    squared = (u * u)[None, :] + (v * v)[:, None]
    response = response - 0.25 * (squared / search_px**2).astype(np.float32)
    response[squared > search_px**2] = -9
    row, column = np.unravel_index(int(np.argmax(response)), response.shape)
    return (np.array([column, row]) + 0.5) * stride


def segment(
    evidence: Map, body: Body, claimed: Mask, open_edges: tuple[bool, bool, bool, bool]
) -> Sight | None:
    """The pixels of the animal whose prior is `body` (window px); None where nothing stands out at its place.

    `claimed` (height, width): pixels of the other animals.
    """
    radius = body.radius((evidence.shape[1], evidence.shape[0]))
    prior = np.minimum(PRIOR_SLOPE * (PRIOR_EDGE - radius), PRIOR_TOP)
    candidate = (evidence + prior > 0) & (evidence > 0) & ~claimed
    mask = _pieces_on_body(candidate, radius)
    # What a neighbour claims counts as missing: an animal that has dived under another is not seen.
    in_view = int((radius <= 1).sum())
    if mask is None or in_view < 6:
        return None
    ring = (radius > RING[0]) & (radius < RING[1]) & ~claimed
    ring_mean = float(evidence[ring].mean()) if ring.any() else 0.0
    separation = float(np.clip((float(evidence[mask].mean()) - ring_mean) / 2, 0, 1))
    cut = _touches(mask, open_edges)
    seen = body_of_weights(mask.astype(np.float32), body.angle_rad)
    if seen is None:
        return None
    return Sight(mask, seen, separation, float(mask.sum()) / in_view, cut)


def _pieces_on_body(candidate: Mask, radius: Map) -> Mask | None:
    """The connected piece that overlaps the ellipse most, and those mostly inside it (foam cuts a whale)."""
    count, labels = cv2.connectedComponents(candidate.astype(np.uint8), connectivity=4, ltype=cv2.CV_32S)
    if count < 2:
        return None
    sizes = np.bincount(labels.ravel(), minlength=count)
    on_body = np.bincount(labels[radius <= 1].ravel(), minlength=count)
    on_body[0] = 0
    if on_body.max() < 4:
        return None
    kept = (on_body > 0.5 * sizes) & (on_body >= 4)
    kept[int(np.argmax(on_body))] = True
    kept[0] = False
    whole = kept[labels].astype(np.uint8)
    closed = cv2.morphologyEx(whole, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return np.asarray(closed) > 0


def _touches(mask: Mask, open_edges: tuple[bool, bool, bool, bool]) -> bool:
    left, top, right, bottom = open_edges
    return bool(
        (left and mask[:, 0].any())
        or (top and mask[0].any())
        or (right and mask[:, -1].any())
        or (bottom and mask[-1].any())
    )


def body_patch(light: NDArray[np.uint8], body: Body) -> Map:
    """(20, 48) lightness of the body turned so that its axis lies along the rows: a picture free of heading
    and size.
    """
    c, s = np.cos(body.angle_rad), np.sin(body.angle_rad)
    along, across = 1.2 * body.length_px / PATCH[0], 1.5 * body.width_px / PATCH[1]
    turn = np.array([[along * c, -across * s], [along * s, across * c]])
    shift = body.centre - 0.5 - turn @ (np.array(PATCH) / 2 - 0.5)
    warp = np.column_stack([turn, shift])
    patch = cv2.warpAffine(
        light, warp, PATCH, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(patch, dtype=np.float32)


def likeness(patch: Map, template: Map, either_way: bool = False) -> float:
    """Normalised correlation of two patches, -1..1; 0 for a flat one. `either_way`: head and tail may be
    swapped.
    """

    def correlate(a: Map) -> float:
        a0, b0 = a - a.mean(), template - template.mean()
        norm = float(np.sqrt((a0 * a0).sum() * (b0 * b0).sum()))
        return float((a0 * b0).sum()) / norm if norm > 1e-3 else 0.0

    return max(correlate(patch), correlate(patch[::-1, ::-1])) if either_way else correlate(patch)


def outline_of(mask: Mask, most: int) -> Array:
    """(<= most, 2) corners of the largest outer contour of a (height, width) mask, as pixel indices (u,
    v).
    """
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not contours:
        return np.zeros((0, 2))
    contour = max(contours, key=cv2.contourArea)
    tolerance_px = 0.7
    corners = cv2.approxPolyDP(contour, tolerance_px, True)
    while len(corners) > most:
        tolerance_px *= 1.5
        corners = cv2.approxPolyDP(contour, tolerance_px, True)
    return corners.reshape(-1, 2).astype(np.float64)
