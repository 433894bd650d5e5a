"""Which animals of a rendered view can be seen, and where: by what each changed in the picture itself."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from drivers.sim.render import AnimalView, Image, SeaRenderer, Species
from drivers.sim.render.labels import body_to_ground, phase_index
from drivers.sim.render.sprites import animal_ring

__all__ = ["LEAST_CONTRAST", "LEAST_SHARE", "Visible", "draw_and_see"]

Array = NDArray[np.float64]

# The rule: an animal counts where a person who draws boxes would mark it.
LEAST_SHARE = 0.3  # of its outline lies inside the picture, uncovered, and differs from the water
LEAST_CONTRAST = 10.0  # grey levels between what shows of it and the water, and as much as the waves' own
# A pixel shows the animal where it changed by so much, in the colour that changed most, and by this share of
# what the animal changes at its clearest: the rest is a fading tail that nobody would draw a box round.
SEEN_LEVELS, SEEN_SHARE = 6.0, 0.25


@dataclass(frozen=True)
class Visible:
    """What shows of the animals of one view, row by row in the order they were given."""

    boxes: NDArray[np.float32]  # (N, 4) xyxy px round what shows; zeros where nothing does
    oriented: NDArray[np.float32]  # (N, 4, 2) corners px of the smallest turned box round the same
    shares: NDArray[np.float32]  # (N,) of the outline
    contrast: NDArray[np.float32]  # (N,) grey levels
    noise: NDArray[np.float32]  # (N,) deviation of the water's own grey levels round the animal
    mask: NDArray[np.uint8]  # (H, W): 0 for none, else the animal's id + 1; ids up to 254


def draw_and_see(
    renderer: SeaRenderer,
    image: Image,
    camera: Pinhole,
    pose: Pose,
    animals: list[AnimalView],
    species: Species,
    clear: float = 1.0,
) -> Visible:
    """Draw the animals into `image` in place, the deepest first, and say what each of them shows.

    clear: the share of a difference in brightness that air and exposure leave to the camera.
    """
    count, (height, width) = len(animals), image.shape[:2]
    water = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    mask = np.zeros((height, width), np.uint8)
    change = np.zeros((height, width), np.float32)
    rings: list[list[Array]] = [[] for _ in animals]
    to_image = camera.ground_to_image(pose)
    for row in sorted(range(count), key=lambda k: (-animals[k].depth_m, animals[k].id)):
        rings[row] = _rings(to_image, animals[row], species)
        if not rings[row]:
            continue
        before = image.copy()
        renderer.draw(image, camera, pose, [animals[row]])
        inside = np.zeros((height, width), np.uint8)
        cv2.fillPoly(inside, [np.round(ring).astype(np.int32) for ring in rings[row]], 255)
        own = cv2.absdiff(image, before).max(axis=2)
        mask[(inside > 0) & (own >= _least_change(own[inside > 0], clear))] = animals[row].id + 1
        np.copyto(change, own.astype(np.float32), where=inside > 0)
    boxes, oriented = np.zeros((count, 4), np.float32), np.zeros((count, 4, 2), np.float32)
    shares, contrast, noise = (np.zeros(count, np.float32) for _ in range(3))
    for row in range(count):
        rows, columns = np.nonzero(mask == animals[row].id + 1)
        if not len(rows):
            continue
        boxes[row], oriented[row] = _box(rings[row], rows, columns, (width, height))
        whole = sum(float(cv2.contourArea(ring.astype(np.float32))) for ring in rings[row])
        shares[row] = min(len(rows) / max(whole, 1.0), 1.0)
        contrast[row] = float(change[rows, columns].mean())
        noise[row] = float(_around(water, boxes[row]).std())
    return Visible(boxes, oriented, shares, contrast, noise, mask)


def _least_change(changes: NDArray[np.uint8], clear: float) -> float:
    """From which change on a pixel of an animal counts as showing it to the camera."""
    clearest = float(np.percentile(changes, 95)) if len(changes) else 0.0
    return max(SEEN_LEVELS / clear, SEEN_SHARE * clearest)


def _rings(to_image: Array, animal: AnimalView, species: Species) -> list[Array]:
    """Outlines (N, 2) in px; none where part of the animal lies behind the camera or far off."""
    placed = to_image @ body_to_ground(animal)
    outlines = animal_ring(species, 0 if animal.poster else phase_index(animal.phase_rad))
    if any(np.any(ring @ placed[2, :2] + placed[2, 2] <= 1e-9) for ring in outlines):
        return []
    rings = [apply_homography(placed, ring) for ring in outlines]
    return rings if all(np.all(np.abs(ring) < 1e4) for ring in rings) else []


def _box(
    rings: list[Array], rows: NDArray[np.intp], columns: NDArray[np.intp], size: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Upright and turned box of what shows: the outline's own sides, but where it fades out of sight."""
    outline = np.concatenate(rings)
    low = np.maximum(outline.min(axis=0), (columns.min() - 1.0, rows.min() - 1.0))
    high = np.minimum(outline.max(axis=0), (columns.max() + 2.0, rows.max() + 2.0))
    upright = np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)]).astype(np.float32)
    shown = np.stack([columns, rows], axis=-1)[:: max(len(rows) // 2000, 1)].astype(np.float32) + 0.5
    return upright, np.asarray(cv2.boxPoints(cv2.minAreaRect(shown)), np.float32)


def _around(water: NDArray[np.uint8], box: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The water in a box half as large again."""
    margin = 0.25 * (box[2:] - box[:2])
    left, top = np.maximum(box[:2] - margin, 0).astype(int)
    right, bottom = np.ceil(box[2:] + margin).astype(int)
    return water[top : bottom + 1, left : right + 1]
