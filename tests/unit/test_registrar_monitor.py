"""MONITOR: boxes named by the map and the drone's own pose, where views share too little to be registered."""

import numpy as np
import pytest

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from procs.registrar.map import AxisState, MapAnimal
from procs.registrar.monitor import name_by_map
from procs.registrar.ring import ViewGeometry

CAMERA = Pinhole((1280, 960), float(np.deg2rad(70.0)))
PLACES = np.array([[0.0, 0], [26, 3], [-4, 27], [30, 31], [-27, -6], [5, -29], [-30, 24]])
SIZES = np.array([9.0, 11, 8, 12, 10, 9.5, 11.5])
POD = [
    MapAnimal(float(n), float(e), float(size), 0.0, 4, 0, 10 + row, AxisState.UNKNOWN)
    for row, ((n, e), size) in enumerate(zip(PLACES, SIZES, strict=True))
]
GOOD = ViewGeometry(height_m=30.0, yaw_rad=1.0, n_m=0.0, e_m=0.0, focal_px=CAMERA.focal_px)


def seen(pose, rows):
    """(N, 4) px: upright squares of the animals' size round where a camera at `pose` sees them."""
    centres = apply_homography(CAMERA.ground_to_image(pose), PLACES[rows])
    halves = (SIZES[rows] * CAMERA.focal_px / pose.height_m / np.sqrt(2) / 2)[:, None]
    return np.concatenate([centres - halves, centres + halves], axis=1)


def believed(pose, rng):
    """A GPS off by 1.5 m each way and a compass off by 5 degrees."""
    return ViewGeometry(
        height_m=pose.height_m * float(np.exp(rng.normal(0, 0.02))),
        yaw_rad=pose.yaw_rad + rng.normal(0, np.deg2rad(5.0)),
        n_m=pose.n_m + rng.normal(0, 1.5),
        e_m=pose.e_m + rng.normal(0, 1.5),
        focal_px=CAMERA.focal_px,
    )


@pytest.mark.parametrize("shared", [[0], [0, 1], [0, 2, 1], [3, 2, 1, 0]])
def test_a_view_of_one_to_four_animals_is_named_whatever_the_heading(shared):
    rng = np.random.default_rng(len(shared))
    right = 0
    for _ in range(10):
        pose = Pose(*(PLACES[shared[0]] + rng.normal(0, 1, 2)), -30.0, yaw_rad=rng.uniform(0, 2 * np.pi))
        named = name_by_map(seen(pose, shared), POD, believed(pose, rng), image_size=CAMERA.image_size)
        right += named.identities.tolist() == [10 + row for row in shared]
    assert right >= 9


def test_a_box_that_no_mapped_animal_explains_has_no_name():
    pose = Pose(0.0, 0.0, -30.0, yaw_rad=1.0)
    boxes = seen(pose, [0, 1])
    stranger = np.array([[1000.0, 40.0, 1200.0, 240.0]])
    named = name_by_map(np.vstack([boxes, stranger]), POD, GOOD, image_size=CAMERA.image_size)
    assert named.identities.tolist() == [10, 11, -1]
    # Alone it would lie well on any animal, but for what the drone knows of its place.
    alone = name_by_map(stranger, POD[:1], GOOD, image_size=CAMERA.image_size)
    assert alone.identities.tolist() == [-1]


def test_two_animals_at_one_place_are_ambiguous():
    twin = MapAnimal(1.0, 0.5, 9.0, 0.0, 4, 0, 99, AxisState.UNKNOWN)
    pose = Pose(0.5, 0.2, -30.0, yaw_rad=1.0)
    named = name_by_map(seen(pose, [0]), [*POD, twin], GOOD, image_size=CAMERA.image_size)
    assert named.confidence < 0.9


def test_nothing_seen_or_nothing_mapped_names_nothing():
    box = np.array([[600.0, 400, 700, 500]])
    assert name_by_map(box, [], GOOD, image_size=CAMERA.image_size).identities.tolist() == [-1]
    empty = name_by_map(np.zeros((0, 4)), POD, GOOD, image_size=CAMERA.image_size)
    assert empty.identities.shape == (0,)
    assert empty.confidence == 0.0


def test_what_cannot_be_is_refused_with_its_value():
    with pytest.raises(ValueError, match="position_std_m is 0"):
        name_by_map(np.zeros((0, 4)), POD, GOOD, image_size=CAMERA.image_size, position_std_m=0.0)
    with pytest.raises(ValueError, match="boxes row 0"):
        name_by_map([[5.0, 0, 1, 2]], POD, GOOD, image_size=CAMERA.image_size)
