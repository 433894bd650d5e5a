"""What the air, the sun on the waves and the camera do to a view: for training and validation pictures.

Each takes and returns (H, W, 3) BGR, float32 in 0-255 but for `compressed`, and leaves the geometry alone.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.render.scene import Image

__all__ = ["blurred", "compressed", "glittering", "hazy", "motion_blurred", "noisy", "vignetted"]

FloatImage = NDArray[np.float32]


def _float(image: object) -> FloatImage:
    return np.asarray(image, np.float32)


def hazy(image: FloatImage, share: float, level: float) -> FloatImage:
    """Air light of brightness `level` mixed in; a distant or steamy view has a large `share`."""
    return _float(image * np.float32(1 - share) + np.float32(share * level))


def glittering(image: FloatImage, rng: np.random.Generator, strength: float) -> FloatImage:
    """The sun's glitter: bright sparks within one broad patch, thinning out towards its rim.

    strength 0 to 1: the share of pixels that spark in the middle of the patch, and how much they merge.
    """
    height, width = image.shape[:2]
    u, v = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    middle, angle = rng.uniform(-0.9, 0.9, 2), rng.uniform(0, np.pi)
    along = (u - middle[0]) * np.cos(angle) + (v - middle[1]) * np.sin(angle)
    across = (v - middle[1]) * np.cos(angle) - (u - middle[0]) * np.sin(angle)
    patch = np.exp(-((along / rng.uniform(0.4, 1.6)) ** 2) - (across / rng.uniform(0.2, 0.7)) ** 2)
    grain_px = float(rng.uniform(1.0, 2.6))
    grid = (int(height / grain_px) + 2, int(width / grain_px) + 2)
    sparks = cv2.resize(_float(rng.standard_normal(grid)), (width, height), interpolation=cv2.INTER_CUBIC)
    limit = 2.6 - 2.2 * strength * patch
    shine = np.clip((sparks - limit) * 1.2, 0, 1) + 0.35 * strength * patch
    return _float(image + np.clip(shine, 0, 1)[..., None].astype(np.float32) * (np.float32(250) - image))


def blurred(image: FloatImage, sigma_px: float) -> FloatImage:
    """Out of focus."""
    return _float(cv2.GaussianBlur(image, (0, 0), sigma_px))


def motion_blurred(image: FloatImage, length_px: int, angle_rad: float) -> FloatImage:
    """The drone moves or turns while the shutter is open."""
    kernel = np.zeros((length_px, length_px), np.float32)
    middle_px = (length_px - 1) / 2
    for step in np.linspace(-middle_px, middle_px, 2 * length_px):
        row, column = middle_px + step * np.sin(angle_rad), middle_px + step * np.cos(angle_rad)
        kernel[round(row), round(column)] = 1
    return _float(cv2.filter2D(image, -1, kernel / kernel.sum()))


def noisy(image: FloatImage, rng: np.random.Generator, deviation: float) -> FloatImage:
    """Noise of the sensor, grey levels; about a third of it is common to the colours."""
    grain = rng.standard_normal(image.shape, dtype=np.float32)
    grain += 0.5 * rng.standard_normal((*image.shape[:2], 1), dtype=np.float32)
    return _float(image + np.float32(deviation) * grain)


def vignetted(image: FloatImage, strength: float) -> FloatImage:
    """Darker towards the corners, by `strength` there."""
    height, width = image.shape[:2]
    u, v = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    return _float(image * (1 - strength * (u**2 + v**2) / 2)[..., None].astype(np.float32))


def compressed(image: Image, quality: int) -> Image:
    """(H, W, 3) uint8 through JPEG and back."""
    _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
