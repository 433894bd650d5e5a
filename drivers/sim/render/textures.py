"""Periodic brightness textures for water and grass, and the colours that a brightness stands for.

A surface is two grey textures that slide over each other; their sum, 0 to 255, picks a colour from a table of
256. One channel is warped in place of three, so a 640x480 view costs about two milliseconds, and sliding
waves never look like a moving photograph.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from drivers.sim.render.scene import Image

__all__ = ["PERIOD_PX", "Layer", "colour_table", "grass_layers", "sea_layers"]

Array = NDArray[np.float64]

PERIOD_PX = 1024  # texels of the finest level: 50 m of sea at 5 cm
VIEW_PX = (
    1400  # a view may span this many texels: textures are padded by it so that no warp has to wrap round
)
LEVELS = 4  # each level halves the one before


@dataclass(frozen=True)
class Layer:
    """One sliding texture: grey levels at finer to coarser resolution, each padded by wrapping round."""

    levels: tuple[Image, ...]
    texel_m: float  # of the finest level
    velocity_mps: tuple[float, float]  # north, east

    @property
    def period_m(self) -> float:
        return PERIOD_PX * self.texel_m


def _wave_numbers(texel_m: float) -> tuple[Array, Array, Array]:
    k = 2 * np.pi * np.fft.fftfreq(PERIOD_PX, texel_m)
    kn, ke = np.meshgrid(k, k[: PERIOD_PX // 2 + 1], indexing="ij")
    return kn, ke, np.hypot(kn, ke) + 1e-9


def _white(rng: np.random.Generator) -> NDArray[np.complex64]:
    """The spectrum of white noise; single precision halves the time and is far finer than the 256 grey
    levels.
    """
    return np.asarray(fft.rfft2(rng.standard_normal((PERIOD_PX, PERIOD_PX)).astype(np.float32)))


def _field(spectrum: NDArray[np.complexfloating]) -> Array:
    return np.asarray(fft.irfft2(spectrum.astype(np.complex64)), float)


def _normalised(field: Array) -> Array:
    return np.asarray((field - field.mean()) / (field.std() + 1e-12))


def _noise(rng: np.random.Generator, texel_m: float, scale_m: float, power: float = 1.5) -> Array:
    """Periodic cloud-like noise with features of about `scale_m`, zero mean and unit deviation."""
    _, _, k = _wave_numbers(texel_m)
    spectrum = (k**2 + (2 * np.pi / scale_m) ** 2) ** (-power / 2)
    return _normalised(_field(_white(rng) * spectrum))


def _waves(
    rng: np.random.Generator, texel_m: float, longest_m: float, wind_rad: float
) -> tuple[Array, Array]:
    """Height and slope towards the wind of a sea whose longest waves have `longest_m`, both of unit
    deviation.
    """
    kn, ke, k = _wave_numbers(texel_m)
    along = (kn * np.cos(wind_rad) + ke * np.sin(wind_rad)) / k
    spread = 0.12 + along**2  # waves run mostly along the wind, never all of them
    # Phillips' spectrum, with the shortest ripples damped; its square root is the amplitude.
    amplitude = k**-2 * np.exp(-0.5 * (2 * np.pi / longest_m / k) ** 2) * np.exp(-((k * 0.09) ** 2)) * spread
    white = _white(rng)
    height = _field(white * amplitude)
    facing = kn * np.cos(wind_rad + 0.5) + ke * np.sin(wind_rad + 0.5)
    slope = _field(white * (1j * amplitude * facing))
    return _normalised(height), _normalised(slope)


def _pyramid(field: Array) -> tuple[Image, ...]:
    """`field` (grey values, any range) as padded uint8 levels."""
    level = np.clip(field, 0, 255).astype(np.float32)
    levels = []
    for _ in range(LEVELS):
        levels.append(np.pad(np.round(level).astype(np.uint8), ((0, VIEW_PX), (0, VIEW_PX)), mode="wrap"))
        level = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA).astype(np.float32)
    return tuple(levels)


def _crest_foam(rng: np.random.Generator, height: Array, texel_m: float, sea_state: float) -> Array:
    """Extra brightness of whitecaps: on the highest crests, broken up, only where the wind is strong."""
    patches = _noise(rng, texel_m, 6.0)
    lace = np.abs(_noise(rng, texel_m, 1.2, power=1.2))
    limit = 4.4 - 0.5 * sea_state  # the rougher, the more crests break
    return np.asarray(np.clip((height + patches - limit) * 1.6, 0, 1) * np.clip(1.3 - 1.4 * lace, 0, 1) * 130)


def sea_layers(rng: np.random.Generator, sea_state: float) -> tuple[Layer, Layer]:
    """Waves and cross waves for a sea state from 0 (glass) to 5 (many whitecaps), on the Douglas scale."""
    wind_rad = rng.uniform(-np.pi, np.pi)
    contrast = 3.0 + 5.5 * sea_state**0.7
    longest_m = 1.5 + 2.2 * sea_state
    layers = []
    for share, texel_m, turn_rad, speed in ((0.8, 0.05, 0.0, 1.0), (0.55, 0.037, rng.uniform(0.5, 1.0), 0.6)):
        height, slope = _waves(rng, texel_m, longest_m, wind_rad + turn_rad)
        # Crests are sharper and brighter than troughs are dark, and gusts roughen patches of the sea.
        gusts = 1 + 0.25 * _noise(rng, texel_m, 12.0)
        field = 64 + share * contrast * gusts * (slope + 0.18 * np.clip(slope, 0, None) ** 2 + 0.35 * height)
        field += 2.0 * _noise(rng, texel_m, 15.0) + _crest_foam(rng, height, texel_m, sea_state)
        wave_speed = (
            speed * 0.6 * np.sqrt(longest_m)
        )  # a share of the deep-water phase speed of the longest waves
        heading = wind_rad + turn_rad
        layers.append(
            Layer(_pyramid(field), texel_m, (wave_speed * np.cos(heading), wave_speed * np.sin(heading)))
        )
    return layers[0], layers[1]


def grass_layers(rng: np.random.Generator) -> tuple[Layer, Layer]:
    """A mown lawn: stripes of 6.4 m, worn patches, blades; nothing moves."""
    texel_m = 0.05
    north_m = np.arange(PERIOD_PX) * texel_m
    stripes = np.sign(np.sin(2 * np.pi * north_m / (PERIOD_PX * texel_m / 4)))[:, None] * 4.0
    worn = np.clip(_noise(rng, texel_m, 8.0) - 1.2, 0, None) * 14
    first = 64 + stripes + worn + 5 * _noise(rng, texel_m, 0.6, power=1.0) + 5 * _noise(rng, texel_m, 5.0)
    second = 64 + 7 * _noise(rng, 0.037, 0.25, power=0.8)
    still = (0.0, 0.0)
    return Layer(_pyramid(first), texel_m, still), Layer(_pyramid(second), 0.037, still)


def colour_table(dark: Array, middle: Array, light: Array, top: Array) -> Image:
    """(256, 1, 3) BGR for a brightness: dark at 60, middle at 128, light at 185, top (foam, worn earth) from
    225.
    """
    stops = np.array([60.0, 128.0, 185.0, 225.0])
    colours = np.stack([dark, middle, light, top])
    table = np.stack([np.interp(np.arange(256), stops, colours[:, channel]) for channel in range(3)], axis=-1)
    return np.clip(np.round(table), 0, 255).astype(np.uint8)[:, None, :]
