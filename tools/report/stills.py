"""Pictures: the best one of each animal, and a few of every camera for the time slider."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from lcmtypes import channels
from lcmtypes.podwatch import track_t
from tools.report.flights import Flight
from tools.report.watching import true_number
from tools.sights import state_spans

__all__ = ["Mark", "Still", "best_stills", "camera_stills"]

SIGHT_S = 0.3  # boxes and tracks this near in time to a picture are drawn on it
LOOKED_AT = 8  # of the likeliest pictures of an animal are decoded
LEAST_CONTRAST = 1.0  # grey levels; a picture with less is black, or empty
ODD = 1.3  # times an animal's usual size: a box round two
LARGE = 0.06  # of a picture; a larger box is not better
ROUND_ABOUT = 1.7  # times its box is cut out round an animal
LEAST_CUT = 0.45  # of the picture's width; less would only show pixels
JPEG_START = b"\xff\xd8"


@dataclass(frozen=True)
class Mark:
    """A box on a picture, in px of the picture. number: the animal on the page, None where it has no name."""

    x: float
    y: float
    width: float
    height: float
    number: int | None
    is_own: bool  # the drone says that it watches this one


@dataclass(frozen=True)
class Still:
    """What a drone's camera saw at one instant."""

    t_s: float
    drone_id: int
    width: int
    height: int
    jpeg: bytes
    marks: tuple[Mark, ...]

    @property
    def uri(self) -> str:
        return "data:image/jpeg;base64," + base64.b64encode(self.jpeg).decode("ascii")


def best_stills(flight: Flight) -> dict[int, Still]:
    """Animal -> its best picture, cut out round it: large, whole, in the middle, sharp."""
    rated: dict[int, list[tuple[float, Still, Mark]]] = {}
    for log in flight.run.drones:
        for still in _stills(flight, log.id, _previews(flight, log.id)):
            for mark in still.marks:
                if mark.number is not None:
                    rated.setdefault(mark.number, []).append((_size_and_place(still, mark), still, mark))
    best = {}
    for number, entries in sorted(rated.items()):
        usual_px = float(np.median([_diagonal(mark) for _, _, mark in entries]))
        entries.sort(key=lambda entry: -entry[0] * (_diagonal(entry[2]) <= ODD * usual_px))
        looked = [
            (score * _sharpness(still, mark), still, mark) for score, still, mark in entries[:LOOKED_AT]
        ]
        score, still, mark = max(looked, key=lambda entry: entry[0])
        if score > 0:
            best[number] = _cut_out(still, mark)
    return best


def camera_stills(flight: Flight, n_most: int) -> list[Still]:
    """At most `n_most` pictures of all cameras, evenly over the time in the air."""
    ids = [log.id for log in flight.run.drones if _previews(flight, log.id)]
    stills: list[Still] = []
    for drone_id in ids:
        log = next(log for log in flight.run.drones if log.id == drone_id)
        flown = [span for span in state_spans(log.states) if span.what not in ("IDLE", "LANDED")]
        if not flown:
            continue
        previews = _previews(flight, drone_id)
        t_s = np.array([row[0] for row in previews])
        count = max(n_most // len(ids), 1)
        wanted = flown[0].from_s + (np.arange(count) + 0.5) / count * (flown[-1].to_s - flown[0].from_s)
        picked = sorted({int(np.abs(t_s - instant).argmin()) for instant in wanted})
        stills += _stills(flight, drone_id, [previews[k] for k in picked])
    return stills


def _previews(flight: Flight, drone_id: int) -> list[tuple[float, Any]]:
    return [
        (t_s, preview)
        for t_s, preview in flight.run.messages[drone_id][channels.PREVIEW]
        if preview.format == "jpeg" and bytes(preview.data[:2]) == JPEG_START
        if preview.width > 0 and preview.height > 0
    ]


def _stills(flight: Flight, drone_id: int, previews: Sequence[tuple[float, Any]]) -> Iterator[Still]:
    """Pictures with what the drone saw and named in them."""
    named = _Nearest(flight.run.messages[drone_id][channels.IDENTITIES])
    tracks = _Nearest(flight.run.messages[drone_id][channels.TRACK])
    for t_s, preview in previews:
        found = _marks(flight, drone_id, preview, named.at(t_s), tracks.at(t_s))
        marks = tuple(mark for mark in found if np.isfinite([mark.x, mark.y, mark.width, mark.height]).all())
        yield Still(t_s, drone_id, preview.width, preview.height, bytes(preview.data), marks)


def _marks(flight: Flight, drone_id: int, preview: Any, named: Any, track: Any) -> Iterator[Mark]:
    is_tracking = track is not None and track.state in (track_t.TRACKING, track_t.PREDICTED)
    own = track.animal if is_tracking and track.width > 0 else -1
    has_own = False
    if named is not None and named.width > 0:
        for box, identity in zip(named.boxes, named.ids, strict=True):
            is_own = identity >= 0 and identity == own
            has_own |= is_own
            yield _mark(box, preview.width / named.width, true_number(flight, drone_id, identity), is_own)
    if own >= 0 and not has_own:
        yield _mark(track, preview.width / track.width, true_number(flight, drone_id, own), True)


def _mark(edges: Any, scale: float, number: int | None, is_own: bool) -> Mark:
    return Mark(
        edges.left_px * scale,
        edges.top_px * scale,
        max(edges.right_px - edges.left_px, 0) * scale,
        max(edges.bottom_px - edges.top_px, 0) * scale,
        number,
        is_own,
    )


class _Nearest:
    """Messages by time, for the one nearest to an instant."""

    def __init__(self, samples: Sequence[tuple[float, Any]]) -> None:
        self._samples = samples
        self._t_s = np.array([t_s for t_s, _ in samples])

    def at(self, t_s: float) -> Any:
        """The message within SIGHT_S, None where there is none."""
        if not len(self._t_s):
            return None
        after = int(np.searchsorted(self._t_s, t_s))
        near = [k for k in (after - 1, after) if 0 <= k < len(self._t_s)]
        best = min(near, key=lambda k: abs(self._t_s[k] - t_s))
        return self._samples[best][1] if abs(self._t_s[best] - t_s) <= SIGHT_S else None


def _size_and_place(still: Still, mark: Mark) -> float:
    """The box's share of the picture; less at its edge or far from its middle, more where it is tracked."""
    size = min(mark.width * mark.height / (still.width * still.height), LARGE) / LARGE
    u, v = mark.x + mark.width / 2, mark.y + mark.height / 2
    off = np.hypot(u / still.width - 0.5, v / still.height - 0.5)
    is_whole = mark.x > 1 and mark.y > 1
    is_whole &= mark.x + mark.width < still.width - 1 and mark.y + mark.height < still.height - 1
    return float((0.2 + size) * (1.2 - off) * (1.0 if is_whole else 0.4) * (1.5 if mark.is_own else 1.0))


def _diagonal(mark: Mark) -> float:
    return float(np.hypot(mark.width, mark.height))


def _cut_out(still: Still, mark: Mark) -> Still:
    """The part of a picture round one box, in the picture's own proportions, at most as large as it is."""
    share = max(mark.width / still.width, mark.height / still.height) * ROUND_ABOUT
    share = min(max(share, LEAST_CUT), 1.0)
    width, height = round(share * still.width), round(share * still.height)
    left = round(min(max(mark.x + mark.width / 2 - width / 2, 0), still.width - width))
    top = round(min(max(mark.y + mark.height / 2 - height / 2, 0), still.height - height))
    image = np.asarray(cv2.imdecode(np.frombuffer(still.jpeg, np.uint8), cv2.IMREAD_COLOR))
    image = cv2.resize(
        image[top : top + height, left : left + width], None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC
    )
    _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 82])
    cut = replace(
        mark, x=2 * (mark.x - left), y=2 * (mark.y - top), width=2 * mark.width, height=2 * mark.height
    )
    return replace(still, width=2 * width, height=2 * height, jpeg=jpeg.tobytes(), marks=(cut,))


def _sharpness(still: Still, mark: Mark) -> float:
    """How much there is to see in the box; 0 of a picture that does not decode, is black or empty."""
    grey = cv2.imdecode(np.frombuffer(still.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    if grey is None or grey.std() < LEAST_CONTRAST:
        return 0.0
    top, left = max(int(mark.y), 0), max(int(mark.x), 0)
    crop = grey[top : max(int(mark.y + mark.height), top + 3), left : max(int(mark.x + mark.width), left + 3)]
    return 1.0 + float(np.log1p(cv2.Laplacian(crop, cv2.CV_64F).std())) if crop.size else 0.0
