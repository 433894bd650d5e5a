"""Things on the water that are no whales: boats, birds, buoys, foam patches, spouts, glare. For training
alone.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.render.scene import Image

__all__ = ["add_clutter"]

Array = NDArray[np.float64]


def _stamp(image: Image, shape: NDArray[np.float32], colour: Array, at: tuple[int, int]) -> None:
    """Blend `colour` BGR into the image where `shape`, an opacity, has its middle at pixel `at` (u, v)."""
    height, width = shape.shape
    left, top = at[0] - width // 2, at[1] - height // 2
    x0, y0, x1, y1 = (
        max(left, 0),
        max(top, 0),
        min(left + width, image.shape[1]),
        min(top + height, image.shape[0]),
    )
    if x0 >= x1 or y0 >= y1:
        return
    share = shape[y0 - top : y1 - top, x0 - left : x1 - left, None]
    region = image[y0:y1, x0:x1]
    region[:] = (region + share * (colour - region)).astype(np.uint8)


def _blob(rng: np.random.Generator, size: int, grain: int, softness: float) -> NDArray[np.float32]:
    """A ragged cloud of opacity, (size, size)."""
    noise = rng.standard_normal((max(size // grain, 2), max(size // grain, 2))).astype(np.float32)
    noise = np.asarray(cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC), np.float32)
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    fall = np.clip(1.1 - (x**2 + (y * rng.uniform(1, 2)) ** 2) ** 0.5, 0, 1)
    return np.asarray(np.clip((noise + 0.6) * softness, 0, 1) * fall, np.float32)


def _boat(rng: np.random.Generator, length: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Opacities of a hull with its wake and of the deck's fittings, on one canvas."""
    side = length * 3
    middle = (side // 2, side // 2)
    hull, fittings = np.zeros((side, side), np.uint8), np.zeros((side, side), np.uint8)
    beam = length * rng.uniform(0.25, 0.4)
    x = np.array([-0.5, -0.5, 0.2, 0.42, 0.5, 0.42, 0.2]) * length
    y = np.array([-0.45, 0.45, 0.5, 0.25, 0.0, -0.25, -0.5]) * beam
    points = np.stack([x + middle[0], y + middle[1]], -1)
    cv2.fillPoly(hull, [np.round(points * 8).astype(np.int32)], 255, cv2.LINE_AA, 3)
    cabin = [
        (middle[0] - length // 5, middle[1] - int(beam / 4)),
        (middle[0] + length // 8, middle[1] + int(beam / 4)),
    ]
    cv2.rectangle(fittings, cabin[0], cabin[1], 255, -1)
    wake = np.zeros((side, side), np.uint8)
    for sign in (-1, 1):
        end = (0, int(middle[1] + sign * length * rng.uniform(0.1, 0.6)))
        cv2.line(
            wake, (middle[0] - length // 2, middle[1]), end, int(rng.integers(0, 140)), max(length // 10, 1)
        )
    turn = cv2.getRotationMatrix2D((float(middle[0]), float(middle[1])), float(rng.uniform(0, 360)), 1.0)
    both = np.maximum(hull, cv2.GaussianBlur(wake, (0, 0), max(length / 14, 0.6)))
    turned = [np.asarray(cv2.warpAffine(each, turn, (side, side)), np.float32) for each in (both, fittings)]
    return turned[0] / np.float32(255), turned[1] / np.float32(255)


def add_clutter(image: Image, rng: np.random.Generator, length_px: float, on_water: bool = True) -> None:
    """Draw a few random things into `image` in place; a whale there would be about `length_px` long."""
    height, width = image.shape[:2]

    def somewhere() -> tuple[int, int]:
        return int(rng.integers(width)), int(rng.integers(height))

    if on_water and rng.random() < 0.35:
        for _ in range(rng.integers(1, 5)):  # white water without an animal
            size = int(np.clip(length_px * rng.uniform(0.15, 0.9), 6, 160))
            _stamp(image, _blob(rng, size, max(size // 14, 2), 0.9), np.full(3, 236.0), somewhere())
    if on_water and rng.random() < 0.15:  # a spout's mist, or thin cloud
        size = int(np.clip(length_px * rng.uniform(0.3, 0.8), 8, 200))
        _stamp(
            image, _blob(rng, size, max(size // 4, 2), 0.5) * np.float32(0.6), np.full(3, 225.0), somewhere()
        )
    if on_water and rng.random() < 0.2:  # cloud shadow, deep patch or weed: dark and shapeless
        size = int(np.clip(length_px * rng.uniform(0.5, 3.0), 10, 300))
        strength = np.float32(rng.uniform(0.2, 0.7))
        _stamp(
            image, _blob(rng, size, max(size // 3, 2), 0.6) * strength, rng.uniform(10, 60, 3), somewhere()
        )
    if rng.random() < 0.22:
        for _ in range(rng.integers(1, 3)):
            length = int(np.clip(length_px * rng.uniform(0.25, 1.1), 6, 110))
            hull, fittings = _boat(rng, length)
            at = somewhere()
            _stamp(image, hull, rng.uniform(40, 250) + rng.uniform(-25, 25, 3), at)
            _stamp(image, fittings, rng.uniform(20, 250, 3), at)
    if rng.random() < 0.25:
        for _ in range(rng.integers(1, 12)):  # birds
            span, (u, v) = max(length_px * rng.uniform(0.03, 0.12), 1.5), somewhere()
            angle = rng.uniform(0, 2 * np.pi)
            wing = span / 2 * np.array([np.cos(angle), np.sin(angle)])
            back = span * 0.2 * np.array([-np.sin(angle), np.cos(angle)])
            points = np.array([back - wing, np.zeros(2), back + wing]) + np.array([u, v])
            tone = int(rng.choice([245, 235, 60]))
            thick = max(int(span / 7), 1)
            cv2.polylines(
                image, [np.round(points * 8).astype(np.int32)], False, (tone,) * 3, thick, cv2.LINE_AA, 3
            )
