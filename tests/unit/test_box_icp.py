"""Box-ICP on cases worked by hand, on its symmetries, and in small on the benchmark's pods."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from procs.registrar.box_icp import box_icp
from tools.bench.registration import IMAGE_SIZE, PAIRS, Cell, draw_views, pair_success
from tools.bench.registration_scenes import true_matches

QUIET = settings(deadline=None, max_examples=8)
SEEDS = st.integers(0, 2**32 - 1)

# Five whales, no two alike in size or place.
POD = np.array(
    [
        [100.0, 100.0, 180.0, 130.0],
        [400.0, 120.0, 430.0, 230.0],
        [250.0, 330.0, 330.0, 380.0],
        [600.0, 420.0, 690.0, 440.0],
        [150.0, 600.0, 190.0, 660.0],
    ]
)


def rotated_half_turn(boxes):
    """The same boxes in an image turned by 180 degrees, 1000 x 800 px."""
    return np.column_stack([1000 - boxes[:, 2], 800 - boxes[:, 3], 1000 - boxes[:, 0], 800 - boxes[:, 1]])


def rotated_quarter_turn(boxes):
    """The same boxes in an image turned by 90 degrees: (u, v) -> (-v, u)."""
    return np.column_stack([-boxes[:, 3], boxes[:, 0], -boxes[:, 1], boxes[:, 2]])


def pairs_of(alignment):
    return {(int(row), int(column)) for row, column in alignment.matches}


def test_the_same_view_matches_itself():
    alignment = box_icp(POD, POD)
    assert pairs_of(alignment) == {(k, k) for k in range(5)}
    np.testing.assert_allclose(alignment.transform, np.eye(3), atol=1e-3)
    assert alignment.residual_px < 0.1
    assert alignment.confidence > 0.95
    assert not alignment.is_ambiguous
    assert len(alignment.unmatched_source) == len(alignment.unmatched_target) == 0


def test_a_half_turn_is_found_with_its_transform():
    alignment = box_icp(POD, rotated_half_turn(POD))
    assert pairs_of(alignment) == {(k, k) for k in range(5)}
    np.testing.assert_allclose(alignment.transform[:2], [[-1, 0, 1000], [0, -1, 800]], atol=1.0)


def test_a_missing_animal_is_left_unmatched():
    alignment = box_icp(POD, POD[[4, 3, 1, 0]], image_size=(1000, 800))
    assert pairs_of(alignment) == {(0, 3), (1, 2), (3, 1), (4, 0)}
    assert alignment.unmatched_source.tolist() == [2]
    assert alignment.unmatched_target.tolist() == []


@pytest.mark.parametrize("away_px", [120.0, 240.0])
def test_a_false_alarm_is_not_taken_for_the_animal_that_was_missed_beside_it(away_px):
    other = POD.copy()
    other[2] += [away_px, 0, away_px, 0]  # one missed, and a splash of its shape beside it
    answer = box_icp(POD, rotated_half_turn(other), image_size=(1000, 800))
    assert pairs_of(answer) == {(k, k) for k in (0, 1, 3, 4)}


def test_one_animal_of_five_that_swam_on_by_a_third_of_its_length_is_kept():
    other = POD.copy()
    other[2] += [30.0, 0, 30.0, 0]
    assert pairs_of(box_icp(POD, rotated_half_turn(other), image_size=(1000, 800))) == {
        (k, k) for k in range(5)
    }


def test_bodies_as_broad_as_long_are_matched_by_place_and_size():
    rng = np.random.default_rng(8)
    for _ in range(10):
        places, sizes = rng.uniform(100, 900, (9, 2)), rng.uniform(30, 60, 9)
        turn = rng.uniform(0, 2 * np.pi)
        cos, sin = np.cos(turn), np.sin(turn)
        others = (places - 500) @ np.array([[cos, sin], [-sin, cos]]) + 500
        views = []
        for centres in (places, others):
            sides = sizes[:, None] * np.exp(rng.normal(0, 0.07, (9, 2)))
            views.append(np.concatenate([centres - sides / 2, centres + sides / 2], axis=1))
        assert pairs_of(box_icp(*views)) == {(k, k) for k in range(9)}


def test_a_mirror_image_is_no_view_of_the_same_scene():
    mirrored = np.column_stack([1000 - POD[:, 2], POD[:, 1], 1000 - POD[:, 0], POD[:, 3]])
    alignment = box_icp(POD, mirrored)
    assert np.linalg.det(alignment.transform[:2, :2]) > 0  # a camera never mirrors
    assert alignment.residual_px > 20.0 or len(alignment.matches) < 5
    assert alignment.confidence < 0.9


def test_two_boxes_are_told_apart_by_their_sizes():
    source = np.array([[100.0, 100.0, 200.0, 130.0], [500.0, 300.0, 560.0, 318.0]])
    alignment = box_icp(source, source[::-1])
    assert pairs_of(alignment) == {(0, 1), (1, 0)}


def test_two_alike_boxes_are_ambiguous_and_a_heading_prior_settles_them():
    source = np.array([[100.0, 100.0, 200.0, 130.0], [500.0, 100.0, 600.0, 130.0]])
    assert box_icp(source, source).is_ambiguous
    assert pairs_of(box_icp(source, source, heading_prior_rad=0.0)) == {(0, 0), (1, 1)}
    turned = rotated_half_turn(source)
    assert pairs_of(box_icp(source, turned, heading_prior_rad=(np.pi, 0.1))) == {(0, 0), (1, 1)}
    assert pairs_of(box_icp(source, turned, heading_prior_rad=(0.0, 0.1))) == {(0, 1), (1, 0)}


def test_a_positive_heading_difference_turns_the_scene_the_other_way():
    source = np.array([[100.0, 100.0, 160.0, 160.0], [500.0, 100.0, 560.0, 160.0]])
    # The target's camera has turned right (clockwise), so the scene in it turns left: (u, v) -> (v, -u).
    target = np.column_stack([source[:, 1], -source[:, 2], source[:, 3], -source[:, 0]])
    assert pairs_of(box_icp(source, target, heading_prior_rad=np.pi / 2)) == {(0, 0), (1, 1)}
    assert pairs_of(box_icp(source, target, heading_prior_rad=-np.pi / 2)) == {(0, 1), (1, 0)}


def test_a_square_of_equal_boxes_is_ambiguous():
    square = np.array([[u, v, u + 60.0, v + 60.0] for u in (100.0, 400.0) for v in (100.0, 400.0)])
    alignment = box_icp(square, square)
    assert len(alignment.matches) == 4
    assert alignment.is_ambiguous
    assert alignment.confidence < 0.9


@pytest.mark.parametrize("mode", ["robust", "literal"])
@pytest.mark.parametrize(("n_source", "n_target"), [(0, 0), (0, 3), (3, 0)])
def test_an_empty_view_matches_nothing(mode, n_source, n_target):
    alignment = box_icp(POD[:n_source], POD[:n_target], mode=mode)
    assert alignment.matches.shape == (0, 2)
    assert alignment.confidence == 0.0
    assert alignment.unmatched_source.tolist() == list(range(n_source))
    assert alignment.unmatched_target.tolist() == list(range(n_target))
    np.testing.assert_array_equal(alignment.transform, np.eye(3))


@pytest.mark.parametrize("mode", ["robust", "literal"])
def test_one_box_matches_one_box(mode):
    alignment = box_icp(POD[:1], POD[:1] + 50, mode=mode)
    assert pairs_of(alignment) == {(0, 0)}
    centre = np.array([140.0, 115.0, 1.0])
    np.testing.assert_allclose((alignment.transform @ centre)[:2], [190.0, 165.0], atol=0.5)


@pytest.mark.parametrize("mode", ["robust", "literal"])
def test_duplicate_boxes_are_matched_once_each(mode):
    doubled = np.concatenate([POD, POD[:1]])
    alignment = box_icp(doubled, POD, mode=mode)
    assert len(alignment.matches) == 5
    assert pairs_of(alignment) >= {(k, k) for k in range(1, 5)}
    assert len({int(row) for row in alignment.matches[:, 0]}) == 5


def test_boxes_of_no_extent_do_not_break_it():
    points = POD.copy()
    points[:, 2:] = points[:, :2]
    assert np.isfinite(box_icp(points, points).transform).all()


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ([[0, 0, 10, 10], [0, 0, np.nan, 10]], "source row 1"),
        ([[0, 0, np.inf, 10]], "source row 0"),
        ([[10, 0, 0, 10]], "right must not be less than left"),
        ([[0, 10, 10, 0]], "source row 0"),
        ([[0, 0, 10]], r"shape \(1, 3\)"),
    ],
)
@pytest.mark.parametrize("mode", ["robust", "literal"])
def test_a_bad_box_is_refused_by_row(bad, message, mode):
    with pytest.raises(ValueError, match=message):
        box_icp(bad, POD, mode=mode)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"image_size": (0, 480)}, r"image_size is \(0, 480\)"),
        ({"mode": "exact"}, "mode is 'exact'"),
        ({"heading_prior_rad": np.nan}, "heading_prior_rad is nan"),
        ({"heading_prior_rad": (0.0, -1.0)}, "std above 0"),
        ({"heading_prior_rad": (0.0, 1.0, 2.0)}, "heading_prior_rad"),
    ],
)
def test_a_bad_argument_is_refused_with_its_value(arguments, message):
    with pytest.raises(ValueError, match=message):
        box_icp(POD, POD, **arguments)


@QUIET
@given(SEEDS)
def test_the_order_of_the_boxes_orders_the_answer(seed):
    rng = np.random.default_rng(seed)
    source, target = draw_views(Cell("", 5), rng)
    first, second = rng.permutation(len(source.boxes)), rng.permutation(len(target.boxes))
    plain = box_icp(source.boxes, target.boxes, image_size=IMAGE_SIZE)
    mixed = box_icp(source.boxes[first], target.boxes[second], image_size=IMAGE_SIZE)
    if not plain.is_ambiguous:
        assert {(int(first[a]), int(second[b])) for a, b in mixed.matches} == pairs_of(plain)


@QUIET
@given(SEEDS, st.integers(4, 9), st.floats(-5e3, 5e3), st.floats(0.1, 10.0), st.integers(0, 3))
def test_moving_scaling_and_quarter_turns_of_either_view_change_no_match(seed, count, shift, scale, turns):
    source, target = draw_views(Cell("", count), np.random.default_rng(seed))
    plain = box_icp(source.boxes, target.boxes)
    assert pairs_of(plain) == set(true_matches(source, target))
    moved, turned = target.boxes, source.boxes
    for _ in range(turns):
        moved, turned = rotated_quarter_turn(moved), rotated_quarter_turn(turned)
    assert pairs_of(box_icp(source.boxes, moved * scale + shift)) == pairs_of(plain)
    assert pairs_of(box_icp(turned * scale + shift, target.boxes)) == pairs_of(plain)


@QUIET
@given(SEEDS)
def test_the_way_back_is_the_way_there_transposed(seed):
    cell = Cell("", 5, missed=0.1, false=0.05)
    source, target = draw_views(cell, np.random.default_rng(seed))
    there = box_icp(source.boxes, target.boxes, image_size=IMAGE_SIZE)
    back = box_icp(target.boxes, source.boxes, image_size=IMAGE_SIZE)
    if not there.is_ambiguous:
        assert {(b, a) for a, b in pairs_of(back)} == pairs_of(there)


@pytest.mark.parametrize(
    ("name", "least"),
    [
        ("full view N=3", 0.95),
        ("full view N=9", 1.0),
        ("10 % missed, 5 % false, N=9", 0.9),
        ("20 % missed, 10 % false, N=9", 0.75),
        ("10 % missed, 5 % false, moved 0.25, tilt 15, N=9", 0.9),
        ("shifted 25 %, N=12", 0.95),
    ],
)
def test_the_benchmark_in_small(name, least):
    cell = next(one for one in PAIRS if one.name == name)
    assert pair_success(cell, 12, seed=3)["right"] >= least


def test_confidence_is_low_for_views_of_different_pods():
    rng = np.random.default_rng(5)
    sure = 0
    for _ in range(20):
        source, target = draw_views(Cell("", 6), rng)[0], draw_views(Cell("", 6), rng)[1]
        sure += box_icp(source.boxes, target.boxes, image_size=IMAGE_SIZE).confidence >= 0.9
    assert sure <= 1
