"""What animal and water look like: two colour histograms, and the evidence that they give each pixel.

Colours are CIE Lab, counted relative to the water's present middle colour, so that a camera that changes its
exposure or white balance does not change the model. The bins span the contrast of the first window: a black
whale on black water gets fine bins, a pale one on green water coarse ones.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Appearance", "water_colour"]

Image = NDArray[np.uint8]
Map = NDArray[np.float32]

BINS = 16  # a channel
RANGE_PERCENTILE = 90  # of the contrast in the first window: three quarters of the bins lie inside it
MIN_RANGE = 6.0  # Lab levels: below this span bins would count sensor noise
FLOOR = 0.03  # share of each histogram that is spread evenly: a colour never seen says nothing either way
SMOOTHING_PX = 1.2  # window px: waves and glints are smaller than a body
EM_ROUNDS = 6
# Of the evidence, how much is the first look (the anchor) and how much the slowly adapted one: drift stays
# bounded.
ANCHOR_SHARE = 0.4


def water_colour(lab: Image, outside: NDArray[np.bool_]) -> Map:
    """(3,) median Lab colour of the pixels in the (height, width) bool map `outside` (of all, where it is
    empty).
    """
    pixels = lab[::2, ::2][outside[::2, ::2]]
    if len(pixels) < 16:
        pixels = lab[::2, ::2].reshape(-1, 3)
    return np.asarray(np.median(pixels, axis=0), dtype=np.float32)


class Appearance:
    """Colour models of the animal and of its water."""

    def __init__(self, lab: Image, prior: Map, outside: NDArray[np.bool_]) -> None:
        """Learn from one window.

        `lab` (height, width, 3); `prior` (height, width) 0-1, how likely each pixel is the animal's by place
        alone; `outside` (height, width) bool, pixels that are water for sure.
        """
        self.water = water_colour(lab, outside)
        contrast = np.abs(lab.astype(np.float32) - self.water).reshape(-1, 3)
        self._range = np.maximum(np.percentile(contrast, RANGE_PERCENTILE, axis=0), MIN_RANGE).astype(
            np.float32
        )
        index = self._index(lab)
        self._inside, self._outside = _separate(index, prior, outside)
        self._anchor = self._inside.copy()
        self._table = self._make_table()

    def evidence(self, lab: Image) -> Map:
        """(height, width) float32 in -1..1: +1 surely animal, -1 surely water, 0 cannot tell."""
        raw = self._table[self._index(lab)]
        return np.asarray(cv2.GaussianBlur(raw, (0, 0), SMOOTHING_PX), dtype=np.float32)

    def adapt(self, lab: Image, inside: NDArray[np.bool_], outside: NDArray[np.bool_], rate: float) -> None:
        """Move both models a share `rate` towards the pixels of this window; the anchor stays."""
        index = self._index(lab)
        self._inside += rate * (_histogram(index[inside]) - self._inside)
        self._outside += 2 * rate * (_histogram(index[outside]) - self._outside)
        self._table = self._make_table()

    def follow_water(self, lab: Image, outside: NDArray[np.bool_], rate: float) -> None:
        """Move the reference colour a share `rate` towards the water of this window."""
        self.water += np.float32(rate) * (water_colour(lab, outside) - self.water)

    def _index(self, lab: Image) -> NDArray[np.intp]:
        levels = np.arange(256, dtype=np.float32)[:, None]
        # Fine bins near the water's colour, coarse ones for foam and glint: black whales on black water
        # differ little.
        table = np.minimum(BINS / 2 * (1 + np.tanh((levels - self.water) / self._range)), BINS - 1)
        table = (table.astype(np.intp) * np.array([BINS * BINS, BINS, 1])).astype(np.intp)
        return np.asarray(table[:, 0][lab[..., 0]] + table[:, 1][lab[..., 1]] + table[:, 2][lab[..., 2]])

    def _make_table(self) -> Map:
        animal = ANCHOR_SHARE * self._anchor + (1 - ANCHOR_SHARE) * self._inside
        return _evidence_table(animal, self._outside)


def _evidence_table(animal: Map, water: Map) -> Map:
    """(BINS^3,) tanh of half the log likelihood ratio: the difference of the two posteriors at even odds."""
    return ((animal - water) / (animal + water)).astype(np.float32)


def _histogram(index: NDArray[np.intp], weights: Map | None = None) -> Map:
    """(BINS^3,) smoothed shares, with the floor, of bin numbers of any shape."""
    counts = np.bincount(index.ravel(), None if weights is None else weights.ravel(), BINS**3)
    total = max(float(counts.sum()), 1.0)
    cube = counts.reshape(BINS, BINS, BINS).astype(np.float32)
    for axis in range(3):
        padded = np.pad(cube, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge")
        cube = 0.5 * cube + 0.25 * (
            np.take(padded, range(BINS), axis) + np.take(padded, range(2, BINS + 2), axis)
        )
    return np.asarray((1 - FLOOR) / total * cube.ravel() + FLOOR / BINS**3, dtype=np.float32)


def _separate(index: NDArray[np.intp], prior: Map, outside: NDArray[np.bool_]) -> tuple[Map, Map]:
    """Histograms of animal and water from a rough place prior, by expectation maximisation.

    A detector's box round a slanting body is mostly water; the rounds take that water out of the animal's
    model.
    """
    water = _histogram(index[outside])
    animal = _histogram(index, prior)
    # The excess over the water's own colours is a better first guess than all that is in the box.
    animal = np.maximum(animal - 0.6 * water, FLOOR / BINS**3).astype(np.float32)
    animal /= animal.sum()
    for _ in range(EM_ROUNDS):
        ratio = _evidence_table(animal, water)[index]
        ratio = np.asarray(cv2.GaussianBlur(ratio, (0, 0), SMOOTHING_PX), dtype=np.float32)
        share = np.clip((1 + ratio) / 2, 1e-3, 1 - 1e-3)
        odds = share / (1 - share) * prior / np.maximum(1 - prior, 1e-3)
        posterior = (odds / (1 + odds)).astype(np.float32)
        animal = _histogram(index, posterior)
        water = _histogram(index, np.where(outside | (prior > 0), 1 - posterior, 0).astype(np.float32))
    return animal, water
