"""Renders what a downward camera sees of a sea (or a lawn with whale posters) and of the animals in it.

Cheap enough for the simulator, 20 views a second and drone on a share of one core, and varied enough to train
the detector on. A view depends only on (seed, settings, camera, pose, t_s, animals).
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from drivers.sim.render.labels import Labels, body_to_ground, label_animals, opacity_at, phase_index
from drivers.sim.render.scene import AnimalView, Image
from drivers.sim.render.species import Species, species_named
from drivers.sim.render.sprites import PHASES, Sprite, make_foam, make_poster, make_sprite
from drivers.sim.render.textures import VIEW_PX, Layer, colour_table, grass_layers, sea_layers

__all__ = ["MORE_WATERS", "WATERS", "SeaRenderer"]

Array = NDArray[np.float64]

INDIVIDUALS = 4  # differently marked pictures of a species; an animal's id picks one
HALF_TO_FULL = np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1.0]])  # centres of a half-size image's pixels
HAZE_BGR = (198, 190, 180)  # where the camera looks above the horizon

# BGR of the water under an overcast sky, picked from aerial photographs by eye: troughs are darker, crests
# lighter.
WATERS: dict[str, tuple[int, int, int]] = {
    "caribbean": (128, 82, 22),
    "deep": (98, 66, 34),
    "teal": (112, 108, 52),
    "atlantic": (122, 96, 62),
    "slate": (118, 112, 102),
    "green": (72, 72, 36),
    "dark": (52, 50, 42),
}
# For training and validation alone: no seed of a simulated sea draws them.
MORE_WATERS: dict[str, tuple[int, int, int]] = {
    "murky": (70, 98, 96),
    "milky": (150, 146, 112),
    "silver": (160, 156, 150),
    "violet": (96, 56, 46),
    "lagoon": (150, 142, 66),
    "pewter": (134, 124, 110),
    "bottle": (66, 82, 30),
    "ink": (62, 40, 22),
}
GRASS_BGR = ((38, 88, 62), (52, 118, 84), (74, 146, 112), (96, 160, 150))


class SeaRenderer:
    """A sea, or a lawn, seen from above; one object a simulated camera.

    seed: decides waves, water and the animals' markings.
    species: drawn ahead of time, so that the first view with one of them costs no more than the others.
    sea_state: 0 (glass) to 5 (whitecaps everywhere). sun_elevation_rad, sun_azimuth_rad: where the glint
    comes from. water: one of WATERS, or None for the seed's choice. shapes: replaces the proportions of a
    species by name.
    """

    def __init__(
        self,
        seed: int,
        *,
        kind: Literal["sea", "grass"] = "sea",
        species: Sequence[str] = ("sperm",),
        sea_state: float = 2.0,
        sun_elevation_rad: float = 0.8,
        sun_azimuth_rad: float = 2.4,
        glint: float = 0.5,
        water: str | None = None,
        shapes: dict[str, Species] | None = None,
    ) -> None:
        if kind not in ("sea", "grass"):
            raise ValueError(f"kind {kind!r}: a surface is 'sea' or 'grass'")
        if not 0 <= sea_state <= 5:
            raise ValueError(
                f"sea_state {sea_state}: must lie between 0 (glass) and 5 (whitecaps everywhere)"
            )
        if water is not None and water not in {**WATERS, **MORE_WATERS}:
            raise ValueError(f"water {water!r} is not known; there are: {', '.join([*WATERS, *MORE_WATERS])}")
        self._seed, self._kind = seed, kind
        self._shapes = dict(shapes or {})
        known = [self._species(name) for name in species]
        self._layers = _cached_layers(seed, kind, sea_state)
        self._table = _sea_table(seed, water) if kind == "sea" else _grass_table()
        self._glint = glint if kind == "sea" else 0.0
        self._sun = np.array(
            [
                np.cos(sun_elevation_rad) * np.cos(sun_azimuth_rad),
                np.cos(sun_elevation_rad) * np.sin(sun_azimuth_rad),
                -np.sin(sun_elevation_rad),
            ]
        )
        self._roughness = 0.12 + 0.05 * sea_state
        for each in known:
            for individual in range(INDIVIDUALS):
                for picture in range(PHASES + 1) if kind == "sea" else (PHASES + 1,):
                    self._sprite(each, individual, picture)

    def render(
        self,
        camera: Pinhole,
        pose: Pose,
        t_s: float,
        animals: Sequence[AnimalView] = (),
        out: Image | None = None,
    ) -> Image:
        """The view at time `t_s`, (H, W, 3) uint8 BGR; written into `out` where given (same shape and type).

        Raises ValueError when the camera is not above the surface or a species is not known.
        """
        width, height = camera.image_size
        if out is not None and (out.shape != (height, width, 3) or out.dtype != np.uint8):
            raise ValueError(f"out is {out.dtype} {out.shape}; the camera needs uint8 {(height, width, 3)}")
        to_ground = camera.image_to_ground(pose)
        brightness = self._warp(self._layers[0], to_ground, t_s, (width, height))
        # The cross waves at half the resolution: a third of the time, unseen under the sharp ones.
        half_size = ((width + 1) // 2, (height + 1) // 2)
        cross = self._warp(self._layers[1], to_ground @ HALF_TO_FULL, t_s, half_size)
        cv2.add(brightness, cv2.resize(cross, (width, height)), dst=brightness)
        if self._glint > 0:
            cv2.add(brightness, self._glint_image(camera, to_ground, pose), dst=brightness)
        image = np.asarray(cv2.applyColorMap(brightness, self._table), np.uint8)
        _paint_sky(image, to_ground)
        self.draw(image, camera, pose, animals)
        if out is None:
            return image
        out[:] = image
        return out

    def draw(self, image: Image, camera: Pinhole, pose: Pose, animals: Sequence[AnimalView]) -> None:
        """Draw the animals alone into a view of (H, W, 3) uint8 BGR, in place, the deepest first."""
        to_image = camera.ground_to_image(pose)
        for animal in sorted(animals, key=lambda item: (-item.depth_m, item.id)):
            self._draw(image, to_image, animal)

    def labels(self, camera: Pinhole, pose: Pose, animals: Sequence[AnimalView]) -> Labels:
        """Where each animal lies in the view that `render` makes; see `label_animals`."""
        return label_animals(camera, pose, animals, self._shapes)

    def _species(self, name: str) -> Species:
        return self._shapes.get(name) or species_named(name)

    def _sprite(self, species: Species, individual: int, picture: int) -> Sprite:
        return _cached_sprite(self._seed, species, individual, picture)

    def _warp(self, layer: Layer, to_ground: Array, t_s: float, size: tuple[int, int]) -> Image:
        """The layer as the camera sees it, one channel."""
        width, height = size
        corners = np.array([[0.0, 0], [width, 0], [0, height], [width, height]])
        ground = apply_homography(to_ground, corners) - np.asarray(layer.velocity_mps) * t_s
        extent_m = float(np.ptp(ground, axis=0).max())
        level = 0
        while level < len(layer.levels) - 1 and extent_m / (layer.texel_m * 2**level) > VIEW_PX - 4:
            level += 1
        texel_m = layer.texel_m * 2**level
        # Moved by whole periods so that the view starts inside the first one; the padding holds the rest.
        origin = np.floor(ground.min(axis=0) / layer.period_m) * layer.period_m
        shift = np.asarray(layer.velocity_mps) * t_s + origin
        to_texel = np.array(
            [[0, 1 / texel_m, -shift[1] / texel_m], [1 / texel_m, 0, -shift[0] / texel_m], [0, 0, 1]]
        )
        fits = extent_m / texel_m <= VIEW_PX - 4
        return np.asarray(
            cv2.warpPerspective(
                layer.levels[level] if fits else layer.levels[level][:-VIEW_PX, :-VIEW_PX],
                to_texel @ to_ground,
                size,
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REFLECT
                if fits
                else cv2.BORDER_WRAP,  # wrapping round is ten times slower
            ),
            np.uint8,
        )

    def _glint_image(self, camera: Pinhole, to_ground: Array, pose: Pose) -> Image:
        """Brightness that the sun and the sky add, (H, W) uint8, computed on a coarse grid and enlarged."""
        width, height = camera.image_size
        columns, rows = np.meshgrid(np.linspace(0, width, 20), np.linspace(0, height, 15))
        ground = apply_homography(to_ground, np.stack([columns.ravel(), rows.ravel()], axis=-1))
        ray = np.column_stack([ground - (pose.n_m, pose.e_m), np.full(len(ground), pose.height_m)])
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        # The facet that would mirror the sun into the camera halves the angle between the sun and the way
        # back.
        facet = self._sun - ray
        facet /= np.linalg.norm(facet, axis=1, keepdims=True)
        tilt = np.arccos(np.clip(-facet[:, 2], -1, 1))
        glint = 90 * self._glint * np.exp(-0.5 * (tilt / self._roughness) ** 2)
        sky = 22 * self._glint * (1 - ray[:, 2]) ** 2 * 4  # water mirrors more sky at a flat angle (Fresnel)
        coarse = np.clip(glint + sky, 0, 120).reshape(15, 20).astype(np.uint8)
        return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)

    def _draw(self, image: Image, to_image: Array, animal: AnimalView) -> None:
        species = self._species(animal.species)
        individual = animal.id % INDIVIDUALS
        opacity = 1.0 if animal.poster else opacity_at(animal.depth_m)
        if opacity <= 0.01:
            return
        placed = to_image @ body_to_ground(animal)
        if animal.poster:
            _blend(image, self._sprite(species, individual, PHASES + 1), placed, 1.0)
            return
        # Water takes the light's red first and blurs: deep animals lean to the water's own colour.
        tint = self._table[110, 0].astype(float)
        body = self._sprite(species, individual, phase_index(animal.phase_rad))
        _blend(image, body, placed, opacity, tint, 1 - np.exp(-max(animal.depth_m, 0.0) / 1.5))
        foam = 1 - max(animal.depth_m, 0.0) / 0.7
        if foam > 0:
            _blend(image, self._sprite(species, individual, PHASES), placed, foam)


@lru_cache(maxsize=2)
def _cached_layers(seed: int, kind: str, sea_state: float) -> tuple[Layer, Layer]:
    """Shared by all the cameras that one process simulates: a layer takes a fifth of a second, 14 MB."""
    rng = np.random.default_rng([seed, 1])
    return sea_layers(rng, sea_state) if kind == "sea" else grass_layers(rng)


@lru_cache(maxsize=128)
def _cached_sprite(seed: int, species: Species, individual: int, picture: int) -> Sprite:
    """Stroke picture `picture`; PHASES stands for the foam and PHASES + 1 for the poster."""
    # The same generator for all strokes of an individual: its markings must not flicker.
    rng = np.random.default_rng([seed, 2, individual, *species.name.encode()])
    if picture < PHASES:
        return make_sprite(species, rng, picture)
    return (make_foam if picture == PHASES else make_poster)(species, rng)


def _sea_table(seed: int, water: str | None) -> Image:
    rng = np.random.default_rng([seed, 3])
    name = water if water is not None else list(WATERS)[int(rng.integers(len(WATERS)))]
    middle = (
        np.asarray({**WATERS, **MORE_WATERS}[name], float) * rng.uniform(0.9, 1.1, 3) * rng.uniform(0.9, 1.1)
    )
    light = middle * 1.25 + rng.uniform(18, 34)
    return colour_table(middle * 0.5, middle, light, np.array([236.0, 234.0, 228.0]))


def _grass_table() -> Image:
    return colour_table(*(np.asarray(colour, float) for colour in GRASS_BGR))


def _paint_sky(image: Image, to_ground: Array) -> None:
    """Haze over the pixels that look above the horizon, if there are any."""
    height, width = image.shape[:2]
    # A pixel sees ground where the homography's last coordinate has the sign that it has below the horizon.
    row = to_ground[2]
    corners = np.array([[0.0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]) @ row
    if np.all(corners > 0) or np.all(corners < 0):
        return
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    below = row[0] * columns + row[1] * rows + row[2]
    # image_to_ground is the inverse of K R^T [I | -c]; its last row is positive in front of the camera.
    image[below <= 1e-9] = HAZE_BGR


def _blend(
    image: Image,
    sprite: Sprite,
    body_to_image: Array,
    opacity: float,
    tint_bgr: Array | None = None,
    tint_share: float = 0.0,
) -> None:
    """Draw the sprite over the part of `image` that it covers, `tint_share` of a tint mixed in."""
    height, width = image.shape[:2]
    corners = sprite.corners
    if np.any(corners @ body_to_image[2, :2] + body_to_image[2, 2] <= 1e-9):
        return  # part of it lies behind the camera
    pixels = apply_homography(body_to_image, corners)
    left, top = np.clip(np.floor(pixels.min(axis=0)).astype(int), 0, (width, height)).tolist()
    right, bottom = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 1, 0, (width, height)).tolist()
    if right - left < 1 or bottom - top < 1:
        return
    px_per_length = float(np.hypot(*(pixels[2] - pixels[0]))) / float(corners[2, 0] - corners[0, 0])
    level = int(np.clip(np.floor(np.log2(sprite.px_per_length / max(px_per_length, 1.0)) + 0.3), 0, 3))
    # The centres of the region's pixels lie half a pixel inside.
    offset = np.array([[1, 0, left + 0.5], [0, 1, top + 0.5], [0, 0, 1.0]])
    to_sprite = sprite.from_body(level) @ np.linalg.inv(body_to_image) @ offset
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    piece = cv2.warpPerspective(sprite.levels[level], to_sprite, (right - left, bottom - top), flags=flags)
    # Colours come multiplied by their opacity, so mixing is linear: region * (1 - a) + ((1 - t) colour + t
    # tint) a. Six OpenCV calls on bytes: 0.1 ms for a typical animal, a tenth of the same in numpy on floats.
    share = np.empty((*piece.shape[:2], 3), np.uint8)
    cv2.mixChannels([piece], [share], [3, 0, 3, 1, 3, 2])
    front = cv2.convertScaleAbs(cv2.cvtColor(piece, cv2.COLOR_BGRA2BGR), alpha=opacity * (1 - tint_share))
    if tint_bgr is not None:
        tint: Any = (
            *tint_bgr.tolist(),
            0.0,
        )  # a scalar, one value a channel, where the type stubs know arrays alone
        cv2.add(front, cv2.multiply(share, tint, scale=opacity * tint_share / 255), dst=front)
    region = image[top:bottom, left:right]
    behind = cv2.convertScaleAbs(share, alpha=-opacity, beta=255.0)
    cv2.add(cv2.multiply(region, behind, scale=1 / 255), front, dst=region)
