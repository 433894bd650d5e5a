"""Labelled scenes: truth that fits the picture, the rule of what counts, and the files that are written."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from drivers.sim.render import AnimalView, SeaRenderer
from drivers.sim.render.clutter import KINDS, add_clutter, add_spout
from drivers.sim.render.effects import (
    blurred,
    compressed,
    glittering,
    hazy,
    motion_blurred,
    noisy,
    vignetted,
)
from drivers.sim.render.species import species_named
from tools.render import SPLITS, Scene, measured_right_whales, render_dataset, scenes
from tools.render.dataset import corners_inside
from tools.render.pods import varied
from tools.render.scenes import _place
from tools.render.visible import LEAST_CONTRAST, draw_and_see
from tools.train.detector.samples import read_yolo


@pytest.fixture(scope="module")
def drawn() -> list[Scene]:
    """Two dozen validation scenes as a small camera takes them."""
    return list(scenes(24, 4, "val", (320, 240), camera_effects=True))


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six rendered scenes in the YOLO layout."""
    out = tmp_path_factory.mktemp("set")
    return render_dataset(out, 6, seed=5, split="train", side=(160, 120)).parent


def test_a_rendered_set_has_pictures_labels_truth_and_a_data_file(data_set: Path) -> None:
    pictures = sorted((data_set / "images" / "train").glob("*.jpg"))
    assert len(pictures) == 6
    samples = read_yolo(pictures, data_set / "labels" / "train")
    for picture, sample in zip(pictures, samples, strict=True):
        truth = json.loads((data_set / "truth" / "train" / f"{picture.stem}.json").read_text())
        np.testing.assert_allclose(sample.boxes[:, :4], np.reshape(truth["boxes_px"], (-1, 4)), atol=0.02)
        assert len(truth["ids"]) == len(truth["boxes_px"])
        ground = apply_homography(np.array(truth["image_to_ground"]), np.array([[0.0, 0.0], [160.0, 0.0]]))
        assert np.hypot(*(ground[1] - ground[0])) > 1  # the picture is metres wide
    text = (data_set / "data.yaml").read_text()
    assert "train: images/train" in text
    assert "0: whale" in text


def turned(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """(4, 2) corners of the smallest turned box round (N, 2) points: what Ultralytics makes of a label."""
    return np.asarray(cv2.boxPoints(cv2.minAreaRect(points.astype(np.float32))), np.float32)


def share_alike(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """IoU of two convex polygons, drawn in tenths of a pixel."""
    low = np.floor(np.minimum(one.min(axis=0), other.min(axis=0)))
    size = np.ceil(np.maximum(one.max(axis=0), other.max(axis=0)) - low).astype(int) * 10 + 2
    drawn = [np.zeros((size[1], size[0]), np.uint8) for _ in range(2)]
    for mask, corners in zip(drawn, (one, other), strict=True):
        cv2.fillPoly(mask, [np.round((corners - low) * 10).astype(np.int32)], 1)
    return float(np.sum(drawn[0] & drawn[1]) / np.sum(drawn[0] | drawn[1]))


def test_turned_boxes_are_written_inside_the_picture_and_mean_the_same(data_set: Path) -> None:
    n_outside = 0
    for path in sorted((data_set / "oriented" / "train").glob("*.txt")):
        truth = json.loads((data_set / "truth" / "train" / f"{path.stem}.json").read_text())
        rows = np.loadtxt(path, np.float32, ndmin=2)
        assert len(rows) == len(truth["ids"])
        for row, given_box, upright in zip(rows, truth["oriented_px"], truth["boxes_px"], strict=True):
            assert row.min() >= 0
            assert row[1:].max() <= 1
            corners, given_px = row[1:].reshape(4, 2) * (160, 120), np.array(given_box, np.float32)
            assert share_alike(turned(corners), given_px) > 0.9
            low, high = corners.min(axis=0), corners.max(axis=0)
            shared = np.minimum(high, upright[2:]) - np.maximum(low, upright[:2])
            whole = np.maximum(high, upright[2:]) - np.minimum(low, upright[:2])
            assert shared.prod() > 0.6 * whole.prod(), "the box round the four corners is the upright one"
            n_outside += int(np.any((given_px < 0) | (given_px > (160, 120))))
    assert n_outside >= 3, "animals at the rim"


def test_a_turned_box_inside_the_picture_is_written_as_it_is() -> None:
    corners = np.array([[0, 10], [10, 0], [40, 30], [30, 40]], np.float32)
    assert corners_inside(corners, (40, 40)) is corners


def test_of_a_turned_box_that_the_rim_cuts_the_four_corners_that_span_most_stay() -> None:
    """A square on its corner, whose left corner lies outside: cut at (0, 10) and (0, 30), of which one stays;
    and a long one whose end is all outside, of which the whole rest stays.
    """
    square = np.array([[-10, 30], [20, 0], [50, 30], [20, 60]], np.float32)
    cut = corners_inside(square, (60, 60))
    assert cut.tolist() in [[[0, 20], [20, 0], [50, 30], [20, 60]], [[0, 40], [20, 0], [50, 30], [20, 60]]]
    long = np.array([[-20, 10], [-10, 0], [30, 40], [20, 50]], np.float32)
    np.testing.assert_allclose(
        sorted(corners_inside(long, (60, 60)).tolist()), [[0, 10], [0, 30], [20, 50], [30, 40]], atol=1e-4
    )


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(st.integers(0, 59), st.integers(0, 39)), min_size=3, max_size=12))
def test_a_turned_box_round_any_pixels_is_cut_to_most_of_what_lies_inside(
    pixels: list[tuple[int, int]],
) -> None:
    given_box = turned(np.array(pixels, np.float32) + 0.5)
    cut = corners_inside(given_box, (60, 40))
    assert cut.shape == (4, 2)
    assert cut.min() >= 0
    assert (cut <= (60, 40)).all()
    for x, y in cut.tolist():
        assert cv2.pointPolygonTest(given_box, (x, y), True) > -0.01
    area = cv2.contourArea(given_box)
    if area > 1:
        inside = np.zeros((400, 600), np.uint8)
        cv2.fillPoly(inside, [np.round(given_box * 10).astype(np.int32)], 1)
        assert cv2.contourArea(cut) > 0.6 * np.sum(inside) / 100 - 2


def test_scenes_depend_on_seed_and_index_alone() -> None:
    first, again = (list(scenes(2, 7, "train", (96, 96))) for _ in range(2))
    other = next(scenes(1, 8, "train", (96, 96)))
    for one, same in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.image, same.image)
        np.testing.assert_array_equal(one.boxes, same.boxes)
    assert np.any(first[0].image != other.image)
    assert next(scenes(1, 7, "empty", (96, 96))).boxes.shape == (0, 4)
    with pytest.raises(ValueError, match="split 'test' is not known; there are: train"):
        next(scenes(1, 0, "test"))
    with pytest.raises(ValueError, match="n 0"):
        render_dataset(Path("unused"), 0, 0)


def test_measured_widths_are_read_and_a_missing_table_gives_none(tmp_path: Path) -> None:
    assert measured_right_whales(tmp_path / "none.csv") == []
    names = ["head1", "head2", "eye", "body1", "body2", "body3", "peduncle_width"]
    columns, values = ["rostrum_x", "rostrum_y", "fluke_x", "fluke_y"], [100.0, 50.0, 0.0, 50.0]
    for index, name in enumerate(names):  # a straight body 20 px wide, 100 px long
        for side, y in ((1, 40.0), (2, 60.0)):
            columns += [f"side{side}_{name}_x", f"side{side}_{name}_y"]
            values += [90.0 - 12 * index, y]
    table = tmp_path / "outlines.csv"
    table.write_text(",".join(columns) + "\n" + ",".join(str(value) for value in values) + "\n")
    (shape,) = measured_right_whales(table)
    assert shape.name == "right"
    assert shape.widths[3:9] == pytest.approx((0.2,) * 6)


def test_boxes_hold_what_the_masks_show_of_each_animal(drawn: list[Scene]) -> None:
    checked = 0
    for scene in drawn:
        for identity, box, corners in zip(scene.ids, scene.boxes, scene.oriented, strict=True):
            rows, columns = np.nonzero(scene.mask == identity + 1)
            assert box[0] - 1 <= columns.min()
            assert columns.max() <= box[2] + 1
            assert box[1] - 1 <= rows.min()
            assert rows.max() <= box[3] + 1
            # The turned box goes round the same pixels, and is seldom the larger one.
            assert cv2.pointPolygonTest(corners, (float(columns[0]) + 0.5, float(rows[0]) + 0.5), True) > -2
            checked += 1
    assert checked > 30


def test_what_counts_obeys_the_rule_that_the_card_states(drawn: list[Scene]) -> None:
    assert any(len(scene.faint) for scene in drawn), "some animals show too little to count"
    for scene in drawn:
        assert (scene.contrast >= LEAST_CONTRAST).all()
        long_px = (scene.boxes[:, 2:] - scene.boxes[:, :2]).max(axis=1, initial=0)
        assert (long_px >= SPLITS["val"].least_long_px).all()  # px of 320, as wide as these pictures


def test_no_validation_scene_shows_a_species_or_a_water_of_the_trainer() -> None:
    for name in ("val", "empty"):
        assert not set(SPLITS[name].species) & set(SPLITS["train"].species)
        assert not set(SPLITS[name].waters) & set(SPLITS["train"].waters)
    seeds = [split.seed for split in SPLITS.values()]
    assert min(abs(a - b) for i, a in enumerate(seeds) for b in seeds[:i]) >= 100_000_000


def whole(scene: Scene) -> list[int]:
    """Animals that no edge of the picture cuts, and that do not hang into the deep."""
    inside = (scene.boxes > 1).all(axis=1) & (scene.boxes < (319, 239, 319, 239)).all(axis=1)
    return scene.ids[inside & (scene.depth_m < 0.5)].tolist()


def test_the_views_of_a_scene_show_the_same_animals_at_the_same_places() -> None:
    shared = 0
    drawn = list(scenes(12, 3, "val", (320, 240), views=3))
    assert len(drawn) == 36
    for first, *others in (drawn[k : k + 3] for k in range(0, 36, 3)):
        for other in others:
            assert not np.array_equal(first.image, other.image)
            assert other.species == first.species
            for identity in set(whole(first)) & set(whole(other)):
                places = [
                    apply_homography(view.image_to_ground, view.oriented[view.ids == identity].mean(axis=1))
                    for view in (first, other)
                ]
                assert np.linalg.norm(places[0] - places[1]) < 6.0, "the middle of what shows, m"
                shared += 1
    assert shared > 10


def test_so_many_animals_as_are_asked_for_and_all_of_them_count() -> None:
    for wanted in (1, 6):
        for scene in scenes(3, 2, "val", (320, 240), animals=wanted):
            assert len(scene.ids) == wanted
            assert len(scene.faint) == 0


CAMERA, ABOVE = Pinhole((320, 240), np.radians(60)), Pose(0.0, 0.0, -30.0)


def seen(*animals: AnimalView, tail_under: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """(boxes, shares) of sperm whales on a calm sea."""
    plain = species_named("sperm")
    species = type(plain)(**{**vars(plain), "tail_under": tail_under})
    sea = SeaRenderer(3, species=(), sea_state=0.5, water="caribbean", glint=0.0, shapes={"sperm": species})
    image = sea.render(CAMERA, ABOVE, 0.0)
    visible = draw_and_see(sea, image, CAMERA, ABOVE, list(animals), species)
    return visible.boxes, visible.shares


def whale(identity: int, n_m: float, depth_m: float = 0.0) -> AnimalView:
    return AnimalView(identity, n_m, 0.0, 0.0, 11.0, depth_m=depth_m)


def test_a_box_ends_where_the_animal_fades_under_water() -> None:
    whole, sunk = seen(whale(0, 0.0))[0][0], seen(whale(0, 0.0), tail_under=1.0)[0][0]
    assert sunk[1] == pytest.approx(whole[1], abs=1)  # the head, to the north, is as it was
    length = whole[3] - whole[1]
    assert 0.2 * length < whole[3] - sunk[3] < 0.6 * length


def test_a_poster_shows_the_whole_animal() -> None:
    lawns = replace(SPLITS["val"], posters=1.0)
    for seed in range(6):
        place = _place(np.random.default_rng(seed), lawns, seed, None, ())
        assert place.kind == "grass"
        assert place.species is not None
        assert place.species.head_under == place.species.tail_under == 0


def test_an_animal_under_another_shows_only_what_is_not_covered() -> None:
    _, shares = seen(whale(0, 0.0), whale(1, 1.0, depth_m=0.5))
    assert shares[0] > 0.7
    assert shares[1] < 0.5


def test_an_animal_behind_the_camera_or_out_of_sight_shows_nothing() -> None:
    boxes, shares = seen(whale(0, 200.0), whale(1, 0.0, depth_m=4.5))
    assert not boxes.any()
    assert not shares.any()


def test_varied_animals_differ_but_keep_their_species_name() -> None:
    rng = np.random.default_rng(0)
    plain = species_named("sperm")
    others = [varied(plain, rng, 1.0) for _ in range(20)]
    assert {other.name for other in others} == {"sperm"}
    assert len({other.back_bgr for other in others}) > 10
    assert any(other.tail_under > 0 for other in others)
    assert any(other.tail_under == 0 for other in others)


def test_clutter_of_every_kind_changes_the_picture_inside_it_and_at_its_border() -> None:
    for draw, *_ in KINDS:
        changed = 0
        for seed in range(6):
            rng = np.random.default_rng(seed)
            image = np.full((120, 160, 3), 90, np.uint8)
            for at in ((80, 60), (0, 119), (159, 0)):
                draw(image, rng, at, 40)
            changed += int((image != 90).any())
        assert changed >= 5, draw.__name__
    image = np.full((120, 160, 3), 90, np.uint8)
    add_spout(image, np.random.default_rng(0), (80, 60), 100.0)
    assert (image > 90).any()
    calm = np.full((120, 160, 3), 90, np.uint8)
    add_clutter(calm, np.random.default_rng(0), 40.0, share=0.0)
    assert (calm == 90).all()


def test_clutter_that_is_drawn_later_covers_no_animal() -> None:
    boxes = np.array([[20, 10, 90.5, 60.5, 1], [100, 70, 150, 110, 0]], np.float32)
    drawn = np.full((120, 160, 3), 90, np.uint8)
    for seed in range(30):
        add_clutter(drawn, np.random.default_rng(seed), 40.0, share=3.0, keep_clear=boxes)
    assert (drawn != 90).any()
    assert (drawn[10:61, 20:91] == 90).all()
    assert (drawn[70:111, 100:151] == 90).all()


def test_effects_do_what_they_say() -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(60, 120, (60, 80, 3)).astype(np.float32)
    assert hazy(image, 0.5, 200).std() == pytest.approx(image.std() / 2, rel=0.01)
    assert blurred(image, 1.0).std() < 0.7 * image.std()
    along = motion_blurred(image, 5, 0.0)
    assert np.abs(np.diff(along, axis=1)).mean() < 0.5 * np.abs(np.diff(along, axis=0)).mean()
    assert (noisy(image, rng, 4.0) - image).std() == pytest.approx(4.47, rel=0.05)
    dark = vignetted(image, 0.5) / image
    assert dark[0, 0].max() < 0.52
    assert dark[30, 40].min() > 0.99
    shining = glittering(image, rng, 0.8)
    assert shining.max() > 200
    assert (shining >= image - 1).all()
    bytes_ = image.astype(np.uint8)
    assert 0 < np.abs(compressed(bytes_, 40).astype(int) - bytes_).mean() < 30
