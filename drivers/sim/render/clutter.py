"""Things in a view that are no whales: boats, birds, buoys, logs, rocks, foam, spouts, weed, shadows. For
training and validation pictures alone.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.render.scene import Image

__all__ = ["add_clutter", "add_spout"]

Array = NDArray[np.float64]
Opacity = NDArray[np.float32]

FOAM = np.array([240.0, 238.0, 233.0])


def _stamp(image: Image, shape: Opacity, colour: Array, at: tuple[int, int]) -> None:
    """Blend `colour` BGR into the image where `shape`, an opacity, has its middle at pixel `at` (u, v)."""
    height, width = shape.shape
    left, top = at[0] - width // 2, at[1] - height // 2
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(left + width, image.shape[1]), min(top + height, image.shape[0])
    if x0 >= x1 or y0 >= y1:
        return
    share = shape[y0 - top : y1 - top, x0 - left : x1 - left, None]
    region = image[y0:y1, x0:x1]
    region[:] = (region + share * (colour - region)).astype(np.uint8)


def _noise(rng: np.random.Generator, size: int, octaves: int = 4) -> Opacity:
    """Cloud-like noise (size, size) of unit deviation: grains of all sizes, the coarse ones stronger."""
    field = np.zeros((size, size), np.float32)
    for octave in range(octaves):
        cells = min(3 * 2**octave, size)
        coarse = rng.standard_normal((cells, cells)).astype(np.float32)
        field += cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC) * np.float32(0.7**octave)
    return np.asarray(field / max(float(field.std()), 1e-6), np.float32)


def _blob(rng: np.random.Generator, size: int, limit: float, softness: float) -> Opacity:
    """A ragged, turned, stretched cloud of opacity, (size, size): noise above `limit` within an oval."""
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    angle, stretch = rng.uniform(0, np.pi), rng.uniform(1, 3)
    along, across = x * np.cos(angle) + y * np.sin(angle), (y * np.cos(angle) - x * np.sin(angle)) * stretch
    inside = 1 - np.hypot(along, across)
    field = _noise(rng, size) + 2.5 * np.clip(inside, -1, 0.5) - limit
    return np.asarray(np.clip(field * softness, 0, 1) * np.clip(inside * 4, 0, 1), np.float32)


def _turned(rng: np.random.Generator, pictures: list[NDArray[np.uint8]]) -> list[Opacity]:
    """Square pictures of opacities 0-255, all turned by the same random angle, as 0-1."""
    side = pictures[0].shape[0]
    turn = cv2.getRotationMatrix2D((side / 2, side / 2), float(rng.uniform(0, 360)), 1.0)
    return [
        np.asarray(cv2.warpAffine(each, turn, (side, side)), np.float32) / np.float32(255)
        for each in pictures
    ]


def _boat(image: Image, rng: np.random.Generator, at: tuple[int, int], length: int) -> None:
    """A hull with deck, cabin and fittings; most leave a wake, some cast a shadow."""
    side, middle = length * 4, length * 2
    hull, deck, fittings, wake = (np.zeros((side, side), np.uint8) for _ in range(4))
    beam = length * rng.uniform(0.2, 0.42)
    x = np.array([-0.5, -0.5, 0.15, 0.38, 0.5, 0.38, 0.15]) * length
    y = np.array([-0.42, 0.42, 0.5, 0.28, 0.0, -0.28, -0.5]) * beam
    outline = np.stack([x, y], -1)
    for picture, scale in ((hull, 1.0), (deck, rng.uniform(0.6, 0.85))):
        points = [np.round((outline * scale + middle) * 8).astype(np.int32)]
        cv2.fillPoly(picture, points, 255, cv2.LINE_AA, 3)
    for _ in range(int(rng.integers(1, 5))):
        corner = np.array([rng.uniform(-0.4, 0.15) * length, rng.uniform(-0.3, 0.1) * beam]) + middle
        extent = np.array([rng.uniform(0.05, 0.3) * length, rng.uniform(0.15, 0.5) * beam])
        low, high = np.round(corner).astype(int).tolist(), np.round(corner + extent).astype(int).tolist()
        cv2.rectangle(fittings, low, high, int(rng.integers(140, 256)), -1)
    if rng.random() < 0.6:
        spread = rng.uniform(0.1, 0.7)
        for sign in (-1, 1):
            end = (0, int(middle + sign * 2 * length * spread))
            cv2.line(wake, (middle - length // 3, middle), end, 170, max(length // 9, 1))
        cv2.line(wake, (middle - length // 2, middle), (0, middle), 200, max(length // 6, 1))
        reach = np.linspace(1.0, 0.0, side)[::-1] ** rng.uniform(0.4, 2)
        wake = (cv2.GaussianBlur(wake, (0, 0), max(length / 14, 0.6)) * reach).astype(np.uint8)
    turned = _turned(rng, [wake, hull, deck, fittings])
    turned[0] *= np.clip(0.6 + 0.5 * _noise(rng, side), 0, 1)
    if rng.random() < 0.4:
        _stamp(
            image, turned[1] * np.float32(0.5), np.full(3, 15.0), (at[0] + length // 10, at[1] + length // 12)
        )
    _stamp(image, turned[0], FOAM, at)
    light = rng.uniform(20, 250)
    _stamp(image, turned[1], np.clip(light + rng.uniform(-40, 40, 3), 0, 255), at)
    _stamp(image, turned[2], np.clip(light + rng.uniform(-90, 90) + rng.uniform(-20, 20, 3), 0, 255), at)
    _stamp(image, turned[3], rng.uniform(0, 255, 3), at)


def _foam(image: Image, rng: np.random.Generator, at: tuple[int, int], length: int) -> None:
    """White water without an animal: a torn patch, or a thin veil of old foam."""
    size = int(np.clip(length * rng.uniform(0.15, 1.2), 6, 220))
    fresh = rng.random() < 0.6
    shape = _blob(rng, size, float(rng.uniform(0.2, 1.2)), 1.6 if fresh else 0.5)
    _stamp(image, shape * np.float32(rng.uniform(0.6, 1.0) if fresh else 0.4), FOAM, at)


def _streaks(image: Image, rng: np.random.Generator, at: tuple[int, int], length: int) -> None:
    """Windrows: long thin lines of foam or slick along the wind."""
    lines = np.zeros((image.shape[0] * 2, image.shape[0] * 2), np.uint8)
    side, tone = lines.shape[0], int(rng.integers(60, 160))
    for offset in rng.uniform(0, side, int(rng.integers(2, 8))):
        cv2.line(lines, (0, int(offset)), (side, int(offset)), tone, max(int(length * 0.04), 1))
    (opacity,) = _turned(rng, [lines])
    soft = cv2.GaussianBlur(opacity, (0, 0), max(length * 0.02, 0.7)) * np.clip(_noise(rng, side), 0, 1)
    _stamp(image, np.asarray(soft, np.float32), FOAM if rng.random() < 0.7 else np.full(3, 40.0), at)


def _dark_patch(image: Image, rng: np.random.Generator, at: tuple[int, int], length: int) -> None:
    """A cloud's shadow, weed, a shoal or a deep place: dark and shapeless."""
    size = int(np.clip(length * rng.uniform(0.4, 3.0), 10, 360))
    strength = np.float32(rng.uniform(0.2, 0.75))
    _stamp(image, _blob(rng, size, 0.0, float(rng.uniform(0.3, 1.5))) * strength, rng.uniform(5, 70, 3), at)


def _rock(image: Image, rng: np.random.Generator, at: tuple[int, int], length: int) -> None:
    """A rock awash: hard-edged, brown or grey, with a broken white rim."""
    size = int(np.clip(length * rng.uniform(0.3, 1.2), 8, 200))
    shape = _blob(rng, size, -0.3, 6.0)
    rim = cv2.dilate(shape, np.ones((3, 3), np.uint8), iterations=max(size // 20, 1))
    _stamp(image, rim * np.clip(0.3 + 0.6 * _noise(rng, size), 0, 1), FOAM, at)
    tone = rng.uniform(25, 110)
    _stamp(image, shape, np.clip(tone * np.array([0.75, 0.9, 1.0]) + rng.uniform(-8, 8, 3), 0, 255), at)
    _stamp(image, shape * np.clip(0.4 * _noise(rng, size), 0, 0.6), np.full(3, tone * 0.4), at)


def _log(image: Image, rng: np.random.Generator, at: tuple[int, int], length: int) -> None:
    """Something long and thin that has no flukes: a log, a kayak, a surfboard, a pipe, a pole."""
    size = int(np.clip(length * rng.uniform(0.2, 1.0), 6, 200))
    shape = np.zeros((size, size), np.uint8)
    thick = max(round(size * rng.uniform(0.04, 0.2)), 1)
    cv2.line(shape, (size // 6, size // 2), (size - size // 6, size // 2), 255, thick, cv2.LINE_AA)
    (opacity,) = _turned(rng, [shape])
    _stamp(image, opacity * np.float32(rng.uniform(0.5, 1.0)), rng.uniform(10, 240, 3), at)


def _buoy(image: Image, rng: np.random.Generator, at: tuple[int, int], length: int) -> None:
    radius = max(int(length * rng.uniform(0.02, 0.08)), 1)
    bright = [
        int(value) for value in rng.choice([(40, 60, 220), (30, 200, 240), (235, 235, 235), (30, 30, 30)])
    ]
    cv2.circle(image, at, radius, bright, -1, cv2.LINE_AA)


def _birds(image: Image, rng: np.random.Generator, at: tuple[int, int], length: int) -> None:
    tone = int(rng.choice([250, 238, 60, 30]))
    for _ in range(int(rng.integers(1, 12))):
        span = max(length * rng.uniform(0.03, 0.14), 1.5)
        u, v = at + rng.normal(0, 2.5 * length, 2)
        angle, sag = rng.uniform(0, 2 * np.pi), rng.uniform(-0.1, 0.3)
        wing = span / 2 * np.array([np.cos(angle), np.sin(angle)])
        back = span * sag * np.array([-np.sin(angle), np.cos(angle)])
        points = np.array([back - wing, np.zeros(2), back + wing]) + np.array([u, v])
        line = [np.round(points * 8).astype(np.int32)]
        cv2.polylines(image, line, False, (tone,) * 3, max(int(span / 7), 1), cv2.LINE_AA, 3)


def add_spout(image: Image, rng: np.random.Generator, at: tuple[int, int], length_px: float) -> None:
    """The mist of a breath over the head at pixel `at`, drifting off with the wind."""
    size = int(np.clip(length_px * rng.uniform(0.15, 0.5), 5, 160))
    shape = cv2.GaussianBlur(_blob(rng, size, -0.2, 0.8), (0, 0), max(size / 16, 0.6))
    drift = rng.normal(0, 0.15 * size, 2).round().astype(int)
    place = (at[0] + int(drift[0]), at[1] + int(drift[1]))
    _stamp(image, shape * np.float32(rng.uniform(0.3, 0.9)), np.full(3, 235.0), place)


_Drawn = Callable[[Image, np.random.Generator, tuple[int, int], int], None]
# How often each is there at all, how many at most, whether it needs water.
KINDS: tuple[tuple[_Drawn, float, int, bool], ...] = (
    (_dark_patch, 0.18, 3, True),
    (_streaks, 0.08, 1, True),
    (_foam, 0.35, 4, True),
    (_rock, 0.08, 4, True),
    (_boat, 0.2, 2, True),
    (_log, 0.15, 3, False),
    (_buoy, 0.08, 3, False),
    (_birds, 0.22, 1, False),
)


def add_clutter(
    image: Image,
    rng: np.random.Generator,
    length_px: float,
    on_water: bool = True,
    share: float = 1.0,
    keep_clear: NDArray[np.float32] | None = None,
) -> None:
    """Draw a few random things into `image` in place; a whale there would be about `length_px` long.

    `share` times the usual chances: above 1 for views that show no animal. keep_clear (N, 4) xyxy px: what
    would change a pixel of these boxes is left out.
    """
    height, width = image.shape[:2]
    for draw, chance, most, needs_water in KINDS:
        if rng.random() >= chance * share or (needs_water and not on_water):
            continue
        for _ in range(int(rng.integers(1, most + 1))):
            at = (int(rng.integers(width)), int(rng.integers(height)))
            length = int(np.clip(length_px * rng.uniform(0.25, 1.3), 8, 130))
            if keep_clear is None:
                draw(image, rng, at, length)
                continue
            tried = image.copy()
            draw(tried, rng, at, length)
            if not _changes_within(keep_clear, tried, image):
                image[:] = tried
    if on_water and keep_clear is None and rng.random() < 0.08 * share:  # a breath whose animal is gone
        add_spout(image, rng, (int(rng.integers(width)), int(rng.integers(height))), length_px)


def _changes_within(boxes: NDArray[np.float32], image: Image, before: Image) -> bool:
    corners = [np.clip(box, 0, None).astype(int).tolist() for box in boxes[:, :4]]
    return any(
        not np.array_equal(
            image[top : bottom + 1, left : right + 1], before[top : bottom + 1, left : right + 1]
        )
        for left, top, right, bottom in corners
    )
