"""Animals as small pictures with transparency, drawn once per species, individual and phase of the tail's
stroke.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.render.scene import Image
from drivers.sim.render.species import STATIONS, Species, body_outline, fin_outlines, fluke_outline

__all__ = ["PHASES", "Sprite", "animal_ring", "make_foam", "make_poster", "make_sprite", "stroke_of"]

Array = NDArray[np.float64]
FloatImage = NDArray[np.float32]

PHASES = 8  # pictures a stroke
BEND = 0.1  # sideways bend of the tail at full stroke, body lengths per (body length)^2
PX_PER_LENGTH = 320  # of the finest level
LEVELS = 4
# The canvas in body coordinates: forward from -0.95 to 0.65 (room for the wake), 0.45 to either side.
CANVAS_BACK, CANVAS_FRONT, CANVAS_SIDE = 0.95, 0.65, 0.45


@dataclass(frozen=True)
class Sprite:
    """A BGRA picture in body coordinates at halving resolutions, colours multiplied by their opacity."""

    levels: tuple[Image, ...]
    px_per_length: float  # of the finest level
    corners: Array  # (4, 2) of the part that is not empty, in body coordinates (forward, right)

    def from_body(self, level: int) -> Array:
        """(3, 3) from body coordinates (forward, right, 1) in body lengths to this level's pixels."""
        scale = self.px_per_length / 2**level
        # Pixel centres lie half a pixel inside, at every level.
        return np.array(
            [[-scale, 0, CANVAS_FRONT * scale - 0.5], [0, scale, CANVAS_SIDE * scale - 0.5], [0, 0, 1.0]]
        )


def stroke_of(phase: int) -> tuple[float, float]:
    """(bend, chord share) of stroke picture `phase` of PHASES: the tail beats up and down, yaws a little."""
    angle = 2 * np.pi * phase / PHASES
    return BEND * np.sin(angle), 0.82 + 0.18 * np.cos(angle)


def animal_ring(species: Species, phase: int) -> list[Array]:
    """Outlines in body coordinates that count as the animal: trunk, flukes, fins where they are long."""
    bend, chord_share = stroke_of(phase)
    fins = fin_outlines(species) if species.fin_length > 0.2 else []
    return [body_outline(species, bend), fluke_outline(species, bend, chord_share), *fins]


def _canvas_size() -> tuple[int, int]:
    return round((CANVAS_BACK + CANVAS_FRONT) * PX_PER_LENGTH), round(2 * CANVAS_SIDE * PX_PER_LENGTH)


def _fill(outlines: list[Array]) -> FloatImage:
    """Coverage 0 to 1 of outlines in body coordinates, antialiased."""
    width, height = _canvas_size()
    mask = np.zeros((height, width), np.uint8)
    for outline in outlines:
        x = (CANVAS_FRONT - outline[:, 0]) * PX_PER_LENGTH - 0.5
        y = (outline[:, 1] + CANVAS_SIDE) * PX_PER_LENGTH - 0.5
        points = np.round(np.stack([x, y], axis=-1) * 16).astype(np.int32)
        cv2.fillPoly(mask, [points], 255, cv2.LINE_AA, 4)
    return mask.astype(np.float32) / np.float32(255)


def _noise(rng: np.random.Generator, along: int, across: int) -> FloatImage:
    """Smooth noise, zero mean and about unit deviation, with grains `along` x `across` px."""
    width, height = _canvas_size()
    coarse = rng.standard_normal((height // across + 4, width // along + 4)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)


def _body_grid() -> tuple[FloatImage, FloatImage]:
    """Station (0 snout, 1 notch) and sideways position in body lengths of each canvas pixel."""
    width, height = _canvas_size()
    forward = CANVAS_FRONT - (np.arange(width) + 0.5) / PX_PER_LENGTH
    sideways = (np.arange(height) + 0.5) / PX_PER_LENGTH - CANVAS_SIDE
    station, side = np.meshgrid(0.5 - forward, sideways)
    return station.astype(np.float32), side.astype(np.float32)


def _sprite_of(colours: FloatImage, opacity: FloatImage) -> Sprite:
    """The sprite of (H, W, 3) colours in 0-255 under (H, W) opacity in 0-1."""
    opacity = np.clip(opacity, 0, 1)[..., None]
    picture = np.concatenate([np.clip(colours, 0, 255) * opacity, 255 * opacity], axis=-1, dtype=np.float32)
    rows, columns = np.nonzero(opacity[..., 0] > 0.004)
    forward = CANVAS_FRONT - np.array([columns.max() + 2, columns.min() - 1]) / PX_PER_LENGTH
    right = np.array([rows.min() - 1, rows.max() + 2]) / PX_PER_LENGTH - CANVAS_SIDE
    corners = np.array([[f, s] for f in forward for s in right])
    levels = []
    for _ in range(LEVELS):
        levels.append(np.round(picture).astype(np.uint8))
        picture = np.asarray(
            cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.float32
        )
    return Sprite(tuple(levels), PX_PER_LENGTH, corners)


def _skin(species: Species, rng: np.random.Generator, bend: float) -> FloatImage:
    """(H, W, 3) colours of the whole animal before it is cut out."""
    station, side = _body_grid()
    side = side - bend * np.clip(station - 0.3, 0, None) ** 2
    half = np.interp(station, STATIONS, species.widths).astype(np.float32) / 2 + 1e-3
    across = np.clip(np.abs(side) / half, 0, 1.2)
    tone = 0.8 + 0.4 * rng.random()
    # Light falls from above: bright along the spine, dark on the flanks; one side is lit more than the other.
    light = 1.16 - 0.5 * across**2 + rng.uniform(-0.22, 0.22) * np.clip(side / half, -1, 1)
    light += 0.10 * _noise(rng, 24, 10) + 0.05 * _noise(rng, 5, 5)
    wrinkled = species.wrinkles * np.clip((station - 0.32) * 12, 0, 1)
    light += 0.13 * wrinkled * _noise(rng, 34, 3)
    light += (
        0.4
        * np.exp(-((across / 0.14) ** 2))
        * np.clip(1 - np.abs(station - 0.45) * 2, 0, 1)
        * rng.uniform(0, 1)
    )
    skin = np.asarray(species.back_bgr, np.float32) * (tone * np.clip(light, 0.25, 2.0))[..., None]
    blotches = np.clip(_noise(rng, 10, 8) + 0.6 * _noise(rng, 30, 24) - 1.1, 0, 1) * species.mottling
    head = np.clip(_noise(rng, 9, 9) + 0.9, 0, 1) * np.clip((0.22 - station) * 14, 0, 1)
    head *= np.clip(1.25 - across * 1.1, 0, 1) * (_noise(rng, 16, 12) < 3 * species.head_patches - 0.9)
    scratch = np.clip(np.abs(_noise(rng, 60, 2)) - 2.3, 0, 1) * 0.5
    light_share = np.clip(blotches + head + scratch, 0, 1)[..., None]
    return np.asarray(skin + light_share * (np.asarray(species.patch_bgr, np.float32) - skin), np.float32)


def _above_water(species: Species, station: FloatImage) -> FloatImage:
    """Share of the opacity left where head or tail hang in the water, 0 to 1."""
    sunk = species.head_under * np.clip(1 - station / 0.45, 0, 1)
    sunk += species.tail_under * np.clip((station - 0.35) / 0.4, 0, 1)
    return np.asarray(np.clip(1 - sunk, 0, 1), np.float32)


def make_sprite(species: Species, rng: np.random.Generator, phase: int) -> Sprite:
    """The animal seen from above, just awash: opaque along the back, fading where it lies deeper."""
    bend, chord_share = stroke_of(phase)
    skin = _skin(species, rng, bend)
    station, side = _body_grid()
    trunk = _fill([body_outline(species, bend, 60)])
    flukes = _fill([fluke_outline(species, bend, chord_share)]) * np.float32(0.86)
    fins = _fill(fin_outlines(species)) * np.float32(0.55)
    # The edge of a round body goes down into the water, so it never ends in a hard line.
    soft = cv2.GaussianBlur(trunk, (0, 0), 2.2)
    depth_fade = np.clip(1.02 - 0.45 * np.clip(station - 0.6, 0, 1), 0.6, 1)
    opacity = np.maximum(trunk * np.clip(soft * 1.25 - 0.1, 0, 1) * depth_fade, np.maximum(flukes, fins))
    if species.dorsal_station > 0:
        fin_shape = np.exp(-(((station - species.dorsal_station) / 0.025) ** 2) - (side / 0.008) ** 2)
        skin *= (1 - 0.6 * np.clip(fin_shape * 25 * species.dorsal_height, 0, 1))[..., None].astype(
            np.float32
        )
    if species.head_under > 0 or species.tail_under > 0:
        opacity = opacity * _above_water(species, station)
    opacity = cv2.GaussianBlur(opacity.astype(np.float32), (0, 0), 0.8)
    return _sprite_of(skin.astype(np.float32), np.asarray(opacity, np.float32))


def make_foam(species: Species, rng: np.random.Generator) -> Sprite:
    """Opacity of the white water round an animal at the surface: a broken rim, wash over the back, a short
    wake.
    """
    station, side = _body_grid()
    body = _fill([body_outline(species, 0.0, 60)])
    rim = cv2.GaussianBlur(body, (0, 0), 6.0)
    edge = np.clip(4 * rim * (1 - rim), 0, 1) * np.clip(1.35 - 1.1 * np.abs(station - 0.35) / 0.45, 0, 1)
    spread = 0.03 + 0.05 * np.clip(station, 0, None)
    wake = (
        np.exp(-((side / spread) ** 2))
        * np.clip((station - 0.75) * 5, 0, 1)
        * np.clip((1.4 - station) * 2.5, 0, 1)
    )
    lace = np.clip(1.15 - np.abs(_noise(rng, 7, 5)) * 1.6, 0, 1)
    patches = np.clip(0.75 * _noise(rng, 34, 26) + 0.5 * _noise(rng, 14, 12) + rng.uniform(-0.9, 0.5), 0, 1)
    foam = (
        np.clip(edge * 1.1 + wake * 0.55 + 0.25 * body * (_noise(rng, 40, 12) > 1.3), 0, 1) * lace * patches
    )
    if species.head_under > 0 or species.tail_under > 0:
        foam = foam * _above_water(species, station)  # what hangs in the water breaks no surface
    opacity = cv2.GaussianBlur((foam * 0.92).astype(np.float32), (0, 0), 0.7)
    return _sprite_of(np.full((*opacity.shape, 3), 240, np.float32), np.asarray(opacity, np.float32))


def make_poster(species: Species, rng: np.random.Generator) -> Sprite:
    """A whale printed on a rectangular sheet: 1.16 x 0.56 body lengths of printed sea, a white margin."""
    animal = make_sprite(species, rng, 0).levels[0].astype(np.float32)
    station, side = _body_grid()
    sheet = (np.abs(station - 0.5) < 0.58) & (np.abs(side) < 0.28)
    print_area = (np.abs(station - 0.5) < 0.565) & (np.abs(side) < 0.265)
    blues = np.array([rng.uniform(110, 170), rng.uniform(70, 120), rng.uniform(15, 70)], np.float32)
    printed = blues if rng.random() < 0.7 else np.full(3, 205, np.float32)  # some sheets are left white
    picture = np.where(print_area[..., None], printed + 5 * _noise(rng, 30, 20)[..., None], np.float32(225))
    picture = picture * (1 - animal[..., 3:] / 255) + animal[..., :3]
    crease = 1 + 0.05 * _noise(rng, 90, 60)
    return _sprite_of(np.asarray(picture * crease[..., None], np.float32), sheet.astype(np.float32))
