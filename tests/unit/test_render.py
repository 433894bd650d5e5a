"""The rendered sea: what it shows is where the geometry says, fades with depth, moves, and is the same every
time.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from drivers.sim.render import SPECIES, AnimalView, SeaRenderer, renderer
from drivers.sim.render.labels import body_to_ground, label_animals, opacity_at
from drivers.sim.render.species import STATIONS, species_named, with_widths

CAMERA = Pinhole((320, 240), np.radians(60))
ABOVE = Pose(0.0, 0.0, -25.0)


@pytest.fixture(scope="module")
def sea() -> SeaRenderer:
    return SeaRenderer(3, species=(), sea_state=1.0, water="atlantic")


@pytest.fixture(scope="module")
def lawn() -> SeaRenderer:
    return SeaRenderer(3, kind="grass", species=())


def whale(n_m: float = 0.0, e_m: float = 0.0, **more: object) -> AnimalView:
    values: dict[str, object] = {"id": 1, "heading_rad": 0.0, "length_m": 11.0, "species": "sperm"}
    return AnimalView(n_m=n_m, e_m=e_m, **{**values, **more})  # type: ignore[arg-type]


def changed_box(before: np.ndarray, after: np.ndarray, least: int = 12) -> tuple[int, int, int, int]:
    """The upright box round all pixels that differ by at least `least` levels."""
    rows, columns = np.nonzero(np.abs(before.astype(int) - after).max(axis=2) >= least)
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def test_a_whale_appears_where_its_label_says(sea: SeaRenderer) -> None:
    # Under water there is no foam, so all that changes is the animal.
    animal = whale(4.0, -3.0, heading_rad=0.7, depth_m=0.8)
    empty, full = sea.render(CAMERA, ABOVE, 0.0), sea.render(CAMERA, ABOVE, 0.0, [animal])
    labels = sea.labels(CAMERA, ABOVE, [animal])
    assert labels.ids.tolist() == [1]
    np.testing.assert_allclose(labels.boxes[0], changed_box(empty, full, 4), atol=5)


def test_the_head_points_along_the_heading(sea: SeaRenderer) -> None:
    # North is up at yaw 0. A whale heading north has its flukes, twice as wide as its head, at the lower end.
    animal = whale(depth_m=0.8)
    difference = np.abs(sea.render(CAMERA, ABOVE, 0.0, [animal]).astype(int) - sea.render(CAMERA, ABOVE, 0.0))
    top, bottom = sea.labels(CAMERA, ABOVE, [animal]).boxes[0, [1, 3]].round().astype(int)
    tenth = (bottom - top) // 10
    wide = [
        np.ptp(np.nonzero(difference[rows].max(axis=(0, 2)) > 4)[0])
        for rows in (slice(top, top + tenth), slice(bottom - tenth, bottom))
    ]
    assert wide[1] > 1.6 * wide[0] > 0


def test_an_animal_fades_with_depth_and_is_gone_at_four_metres(sea: SeaRenderer) -> None:
    empty = sea.render(CAMERA, ABOVE, 0.0).astype(int)
    contrast = [
        np.abs(sea.render(CAMERA, ABOVE, 0.0, [whale(depth_m=depth)]) - empty).sum()
        for depth in (1.0, 2.0, 3.0, 4.0)
    ]
    assert contrast[0] > 2 * contrast[1] > 2 * contrast[2] > 0
    assert contrast[3] == 0
    assert len(sea.labels(CAMERA, ABOVE, [whale(depth_m=4.0)]).ids) == 0
    assert opacity_at(-1.0) == 1.0  # a breaching animal is as opaque as one at the surface


def test_the_same_call_gives_the_same_pixels_and_another_seed_other_ones(sea: SeaRenderer) -> None:
    animals = [whale(), whale(5.0, 5.0, id=2, heading_rad=2.0)]
    view = sea.render(CAMERA, ABOVE, 7.3, animals)
    renderer._cached_layers.cache_clear()  # else the second sea would be the first one's own textures
    renderer._cached_sprite.cache_clear()
    again = SeaRenderer(3, species=(), sea_state=1.0, water="atlantic")
    np.testing.assert_array_equal(view, again.render(CAMERA, ABOVE, 7.3, animals))
    other = SeaRenderer(4, species=(), sea_state=1.0, water="atlantic").render(CAMERA, ABOVE, 7.3, animals)
    assert np.any(view != other)


def test_waves_move_but_the_lawn_does_not(sea: SeaRenderer, lawn: SeaRenderer) -> None:
    assert np.any(sea.render(CAMERA, ABOVE, 0.0) != sea.render(CAMERA, ABOVE, 1.0))
    np.testing.assert_array_equal(lawn.render(CAMERA, ABOVE, 0.0), lawn.render(CAMERA, ABOVE, 1.0))


def test_the_ground_stays_put_while_the_camera_moves(lawn: SeaRenderer) -> None:
    # 10 px north at 25 m is 10 times the ground sample distance: the picture shifts down by 10 px.
    step_m = 10 * CAMERA.metres_per_px(25.0)
    here = lawn.render(CAMERA, ABOVE, 0.0).astype(int)
    north = lawn.render(CAMERA, Pose(step_m, 0.0, -25.0), 0.0).astype(int)
    assert np.abs(north[10:] - here[:-10]).mean() < 1.0 < np.abs(north - here).mean()


def test_out_is_written_in_place_and_a_wrong_one_is_refused(sea: SeaRenderer) -> None:
    out = np.empty((240, 320, 3), np.uint8)
    assert sea.render(CAMERA, ABOVE, 0.0, out=out) is out
    np.testing.assert_array_equal(out, sea.render(CAMERA, ABOVE, 0.0))
    with pytest.raises(ValueError, match=r"240, 320, 4.*240, 320, 3"):
        sea.render(CAMERA, ABOVE, 0.0, out=np.empty((240, 320, 4), np.uint8))


def test_a_tilted_camera_sees_haze_above_the_horizon(sea: SeaRenderer) -> None:
    view = sea.render(CAMERA, Pose(0.0, 0.0, -25.0, pitch_rad=np.radians(80)), 0.0, [whale(), whale(-60.0)])
    assert (view[0] == (198, 190, 180)).all()
    assert not (view[-1] == (198, 190, 180)).all()


def test_a_camera_under_water_is_refused(sea: SeaRenderer) -> None:
    with pytest.raises(ValueError, match=r"height -2\.00 m"):
        sea.render(CAMERA, Pose(0.0, 0.0, 2.0), 0.0)


@pytest.mark.parametrize(
    ("settings_given", "message"),
    [
        ({"kind": "ice"}, "kind 'ice'"),
        ({"sea_state": 6.0}, "sea_state 6"),
        ({"water": "wine"}, "water 'wine'.*slate"),
        ({"species": ("unicorn",)}, "species 'unicorn'.*sperm"),
    ],
)
def test_bad_settings_are_refused_by_name(settings_given: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SeaRenderer(0, **settings_given)  # type: ignore[arg-type]


def test_a_poster_is_a_whale_on_a_sheet_and_its_box_is_the_whale_alone(lawn: SeaRenderer) -> None:
    poster = whale(poster=True, length_m=5.0)
    near = Pose(0.0, 0.0, -12.0)
    empty, full = lawn.render(CAMERA, near, 0.0), lawn.render(CAMERA, near, 0.0, [poster])
    left, top, right, bottom = changed_box(empty, full)
    box = lawn.labels(CAMERA, near, [poster]).boxes[0]
    px_per_m = 1 / CAMERA.metres_per_px(12.0)
    assert bottom - top == pytest.approx(1.16 * 5 * px_per_m, abs=3)
    assert right - left == pytest.approx(0.56 * 5 * px_per_m, abs=3)
    assert box[3] - box[1] == pytest.approx(5 * px_per_m, abs=3)
    assert box[0] > left + 10
    assert box[2] < right - 10


def test_half_a_whale_outside_counts_half_and_its_box_ends_at_the_border() -> None:
    # Broadside in the middle of the left border: the head is inside, the tail outside.
    edge_m = 160 * CAMERA.metres_per_px(25.0)
    labels = label_animals(CAMERA, ABOVE, [whale(0.0, -edge_m, heading_rad=np.pi / 2)])
    assert labels.boxes[0, 0] == 0
    assert 0.45 < labels.visible[0] < 0.7  # the front half of a sperm whale is the larger one
    assert len(label_animals(CAMERA, ABOVE, [whale(0.0, -edge_m - 20)]).ids) == 0


@settings(deadline=None, max_examples=40)
@given(
    n_m=st.floats(-30, 30),
    e_m=st.floats(-30, 30),
    heading_rad=st.floats(-3.2, 3.2),
    height_m=st.floats(8, 100),
    roll_rad=st.floats(-0.5, 0.5),
    pitch_rad=st.floats(-0.5, 0.5),
    name=st.sampled_from(sorted(SPECIES)),
)
def test_labels_lie_inside_the_image_and_hold_the_spine(
    n_m: float, e_m: float, heading_rad: float, height_m: float, roll_rad: float, pitch_rad: float, name: str
) -> None:
    animal = whale(n_m, e_m, heading_rad=heading_rad, species=name)
    pose = Pose(0.0, 0.0, -height_m, roll_rad, pitch_rad, 0.3)
    labels = label_animals(CAMERA, pose, [animal])
    spine = apply_homography(
        CAMERA.ground_to_image(pose) @ body_to_ground(animal), np.array([[x, 0.0] for x in (-0.4, 0.0, 0.45)])
    )
    inside = ((spine > 0) & (spine < CAMERA.image_size)).all(axis=1)
    assert len(labels.ids) == 1 or not inside.any()
    for box, visible in zip(labels.boxes, labels.visible, strict=True):
        assert 0 < visible <= 1.0001
        assert 0 <= box[0] <= box[2] <= 320.001
        assert 0 <= box[1] <= box[3] <= 240.001
        assert ((spine[inside] >= box[:2] - 0.01) & (spine[inside] <= box[2:] + 0.01)).all()


def test_measured_widths_replace_a_species_proportions() -> None:
    thin = with_widths(species_named("right"), np.full(len(STATIONS), 0.1))
    broad = label_animals(CAMERA, ABOVE, [whale(species="right")])
    labels = label_animals(CAMERA, ABOVE, [whale(species="right")], {"right": thin})
    # The flukes are the widest part of both; the outline's area, seen as the share inside, stays whole.
    assert labels.visible[0] == pytest.approx(broad.visible[0])
    with pytest.raises(ValueError, match="3 widths were given, 14"):
        with_widths(species_named("right"), np.ones(3))
