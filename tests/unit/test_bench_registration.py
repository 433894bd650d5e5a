"""The registration benchmark: its scenes are what they say, it counts strictly, and in small it still finds
registration good."""

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.cameras.pinhole import Pose, apply_homography
from procs.registrar._literal import corner_costs, corners_of
from procs.registrar.map import Memory
from procs.registrar.ring import RingRegistration
from tools.bench.registration_cells import MONITOR, PAIRS, PROMISES, RINGS, Promise, row_of
from tools.bench.registration_composite import FRAME_SIZE, VIEW_SIZE, composite_views
from tools.bench.registration_figure import AXES, POINTS, draw
from tools.bench.registration_monitor import draw_monitor, monitor_counts
from tools.bench.registration_pairs import pair_counts
from tools.bench.registration_peers import METHODS, PEERS, peer_key, peer_matches, peer_table
from tools.bench.registration_pixels import pixel_rows
from tools.bench.registration_rings import _switches, is_ring_right, ring_success
from tools.bench.registration_scenes import (
    CAMERA,
    IMAGE_SIZE,
    LAYOUTS,
    MEAN_LENGTH_M,
    Cell,
    View,
    detected,
    draw_centres,
    draw_pod,
    draw_views,
    inside_image,
    trial_rng,
    true_boxes,
    true_matches,
)
from tools.bench.registration_speed import printed_costs
from tools.cli import app
from tools.train.detector.samples import Sample
from tools.train.detector.scores import box_iou

DEG = np.pi / 180
CLEAN = Cell("clean", 9, jitter=0.0, full_view=True)
FLAT = replace(CLEAN, heading_rad=0.0, tilt_rad=0.0, height_ratio=(1.0, 1.0))


def scenes(cell, count, seed=5):
    return [draw_views(cell, trial_rng(seed, cell.name, trial)) for trial in range(count)]


def centres_of(view):
    return (view.boxes[:, :2] + view.boxes[:, 2:]) / 2


def ground_of(view):
    """(N, 2) m under each box's centre, in the order of the animals."""
    return apply_homography(CAMERA.image_to_ground(view.pose), centres_of(view))[np.argsort(view.animals)]


def pose(n_m=0.0):
    return Pose(n_m, 0.0, -50.0)


def named(name):
    return next(cell for cell in (*PAIRS, *RINGS) if cell.name == name)


# the scenes


def test_a_trial_is_the_same_again_and_another_trial_or_cell_is_another():
    first, again = (draw_views(CLEAN, trial_rng(5, "a", 3)) for _ in range(2))
    np.testing.assert_array_equal(first[1].boxes, again[1].boxes)
    others = [trial_rng(5, "a", 4), trial_rng(5, "b", 3), trial_rng(6, "a", 3)]
    assert all((draw_views(CLEAN, rng)[1].boxes != first[1].boxes).any() for rng in others)


def test_matched_boxes_lie_over_the_same_ground():
    for source, target in scenes(CLEAN, 10):
        matches = np.array(true_matches(source, target))
        assert len(matches) == 9
        here = apply_homography(CAMERA.image_to_ground(source.pose), centres_of(source))
        there = apply_homography(CAMERA.image_to_ground(target.pose), centres_of(target))
        apart = np.linalg.norm(here[matches[:, 0]] - there[matches[:, 1]], axis=1)
        assert apart.max() < 3.0  # boxes round a body seen from two headings, 25 m from the next


def test_boxes_come_in_no_order_that_tells_them():
    assert any(view.animals.tolist() != sorted(view.animals) for view in scenes(CLEAN, 1)[0])


@pytest.mark.parametrize("cell", [cell for cell in PAIRS if cell.full_view], ids=lambda cell: cell.name)
def test_in_a_full_view_cell_every_animal_is_in_every_image(cell):
    for views in scenes(cell, 15):
        for view in views:
            assert sorted(view.animals) == list(range(cell.n_animals))
            assert inside_image(view.boxes).mean() > 0.99  # an edge's error may push a centre out


def test_heights_headings_and_tilts_fill_what_the_cell_says_and_no_more():
    cell = replace(CLEAN, heading_rad=40 * DEG)
    drawn = scenes(cell, 150)
    headings = np.array([views[1].pose.yaw_rad for views in drawn])
    ratios = np.array([views[1].pose.height_m / views[0].pose.height_m for views in drawn])
    tilts = np.array([view.pose.tilt_rad for views in drawn for view in views])
    assert all(views[0].pose.yaw_rad == 0.0 for views in drawn)
    assert 38 * DEG < np.abs(headings).max() <= 40 * DEG
    assert 0.7 <= ratios.min() < 0.73
    assert 1.33 < ratios.max() <= 1.4
    assert 9.5 * DEG < tilts.max() <= 10 * DEG


def test_an_exact_heading_is_exact_to_both_sides():
    cell = replace(CLEAN, heading_rad=30 * DEG, exact_heading=True)
    headings = [views[1].pose.yaw_rad for views in scenes(cell, 20)]
    np.testing.assert_allclose(np.abs(headings), 30 * DEG)
    assert len(set(np.sign(headings))) == 2


def test_shear_is_0_2_along_one_axis():
    axes = []
    for source, target in scenes(replace(FLAT, shear=0.2), 12):
        order = np.array(true_matches(source, target))
        points = np.column_stack([centres_of(source)[order[:, 0]], np.ones(9)])
        linear = np.linalg.lstsq(points, centres_of(target)[order[:, 1]], rcond=None)[0][:2].T
        off = np.abs([linear[0, 1], linear[1, 0]])
        assert off.max() == pytest.approx(0.2, abs=0.05)
        assert off.min() == pytest.approx(0.0, abs=0.05)
        axes.append(int(off.argmax()))
    assert sorted(set(axes)) == [0, 1]


def test_animals_move_by_just_the_lengths_that_the_cell_says():
    for source, target in scenes(replace(FLAT, moved=0.5, full_view=False), 5):
        moved = np.linalg.norm(ground_of(target) - ground_of(source), axis=1)
        np.testing.assert_allclose(moved, 0.5 * MEAN_LENGTH_M, atol=0.8)
    for source, target in scenes(FLAT, 2):
        np.testing.assert_allclose(ground_of(target), ground_of(source), atol=0.8)


def test_shifted_views_are_apart_by_their_share_of_the_image_and_lose_animals():
    shares = []
    for source, target in scenes(Cell("s", 12, shift=0.5, tilt_rad=0.0, height_ratio=(1.0, 1.0)), 20):
        wide = 2 * source.pose.height_m * np.tan(CAMERA.vfov_rad / 2) * IMAGE_SIZE[0] / IMAGE_SIZE[1]
        apart = np.hypot(target.pose.n_m - source.pose.n_m, target.pose.e_m - source.pose.e_m)
        assert apart / wide == pytest.approx(0.5, abs=0.15)  # both cameras also drift a little
        shares.append(len(true_matches(source, target)) / 12)
    assert 0.3 < np.mean(shares) < 0.75


def test_misses_false_alarms_and_jitter_are_as_frequent_as_the_cell_says():
    views = [view for pair in scenes(Cell("m", 9, missed=0.2, false=0.1), 150) for view in pair]
    seen = sum((view.animals >= 0).sum() for view in views) / (9 * len(views))
    false = sum((view.animals < 0).sum() for view in views) / (9 * len(views))
    assert seen == pytest.approx(0.8, abs=0.03)
    assert false == pytest.approx(0.1, abs=0.02)
    sharp, noisy = (scenes(replace(CLEAN, name="j", jitter=jitter), 40) for jitter in (0.0, 0.05))
    errors = []
    for (one, _), (other, _) in zip(sharp, noisy, strict=True):
        true, seen_boxes = one.boxes[np.argsort(one.animals)], other.boxes[np.argsort(other.animals)]
        errors.append((seen_boxes - true) / np.tile(true[:, 2:] - true[:, :2], 2))
    assert np.std(np.concatenate(errors)) == pytest.approx(0.05, rel=0.1)


def test_a_false_alarm_is_on_no_animal():
    cell, low = Cell("f", 12, false=1.0, jitter=0.0), Pose(0.0, 0.0, -40.0)
    for trial in range(40):
        rng = trial_rng(5, "f", trial)
        everything = true_boxes(*draw_pod(12, rng), CAMERA.ground_to_image(low))
        view = detected(everything, low, cell, rng)
        false = view.boxes[view.animals < 0].astype(np.float32)
        assert len(false) == 12
        assert box_iou(false, everything.astype(np.float32)).max() < 0.451


@pytest.mark.parametrize("n", [3, 5, 9, 20])
def test_neighbours_in_a_crowd_are_two_and_a_half_lengths_apart_and_none_nearer_than_one_and_a_half(n):
    rng = np.random.default_rng(1)
    nearest = []
    for _ in range(100):
        centres = draw_centres(n, rng)
        apart = np.linalg.norm(centres[:, None] - centres[None], axis=2) + np.diag(np.full(n, np.inf))
        nearest.append(apart.min(axis=1))
    assert np.min(nearest) > 15.0
    assert np.mean(nearest) == pytest.approx(25.0, abs=3.0)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_symmetric_layout_is_its_own_half_turn_or_mirror_image_but_for_a_little(layout):
    centres = draw_centres(6, np.random.default_rng(2), layout)
    other = centres * ([-1, 1] if layout == "mirror" else [-1, -1])
    nearest = np.linalg.norm(centres[:, None] - other[None], axis=2).min(axis=1)
    assert 0.0 < nearest.max() < 8.0
    if layout == "line":
        assert np.linalg.svd(centres)[1][1] < 5.0


def test_an_unknown_layout_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="'heap': choose 'crowd' or one of grid, ring, line, mirror"):
        draw_centres(6, np.random.default_rng(2), "heap")


def test_in_monitor_each_drone_sees_its_own_animal_and_shares_up_to_three_boxes_with_a_neighbour():
    shared, apart = [], []
    for trial in range(60):
        scene = draw_monitor(MONITOR, trial_rng(5, MONITOR.name, trial))
        seen = [set(view.animals.tolist()) for view in scene.views]
        assert all(seen)
        shared += [len(seen[row] & seen[(row + 1) % 5]) for row in range(5)]
        assert [animal.id for animal in scene.animals] == list(range(7))
        for view, believed in zip(scene.views, scene.believed, strict=True):
            apart.append([believed.n_m - view.pose.n_m, believed.e_m - view.pose.e_m])
            under = [(one.n_m, one.e_m) for one in scene.animals if one.id in view.animals]
            nearest = np.linalg.norm(np.array(under) - [view.pose.n_m, view.pose.e_m], axis=1).min()
            assert nearest < 8.0  # over one of them
    assert set(shared) == {0, 1, 2, 3}
    assert np.std(apart) == pytest.approx(1.5, rel=0.1)


# what is counted


def test_one_wrong_match_makes_a_pair_wrong(monkeypatch):
    def with_two_exchanged(source, target, **given):
        answer = real(source, target, **given)
        wrong = answer.matches.copy()
        wrong[:2, 1] = wrong[1::-1, 1]
        return replace(answer, matches=wrong, confidence=0.95)

    module = __import__("tools.bench.registration_pairs", fromlist=["box_icp"])
    real = module.box_icp
    assert pair_counts(CLEAN, 1, range(3))["right"] == 3
    monkeypatch.setattr(module, "box_icp", with_two_exchanged)
    counts = pair_counts(CLEAN, 1, range(3))
    assert (counts["right"], counts["sure"], counts["sure_wrong"]) == (0, 3, 3)
    assert (counts["true_found"], counts["found"], counts["true_total"]) == (21, 27, 27)


def answer_of(*identities):
    return RingRegistration(
        identities=[np.array(ids) for ids in identities],
        consensus=True,
        repaired=False,
        laps=2,
        bytes_sent=np.zeros(len(identities), dtype=np.intp),
        memory=Memory(),
        confidence=1.0,
    )


def view_of(*animals):
    boxes = np.array([[100.0 * row, 0.0, 100.0 * row + 40, 20.0] for row in range(len(animals))])
    return View(boxes.reshape(-1, 4), np.array(animals), pose())


def test_a_ring_is_right_only_where_every_animal_has_one_id_of_its_own():
    views = [view_of(0, 1), view_of(1, 0)]
    assert is_ring_right(views, answer_of([7, 8], [8, 7]))
    assert not is_ring_right(views, answer_of([7, 8], [7, 8]))  # exchanged
    assert not is_ring_right(views, answer_of([7, 7], [7, 7]))  # shared
    assert not is_ring_right(views, answer_of([7, -1], [8, 7]))  # one unnamed


def test_a_switch_is_another_id_in_any_view_and_absence_is_none():
    last = {0: 7, 1: 8}
    views = [view_of(0, 1), view_of(1, 0)]
    assert _switches(views, answer_of([7, 8], [8, 7]), last)["switches"] == 0
    assert _switches(views, answer_of([7, 8], [9, 7]), last)["switches"] == 1
    assert last == {0: 7, 1: 8}  # the first of two that are as frequent
    counts = _switches([view_of(0), view_of(0)], answer_of([-1], [-1]), last)
    assert (counts["sightings"], counts["switches"], counts["unnamed"]) == (1, 0, 1)
    assert _switches([view_of(1), view_of(1)], answer_of([5], [5]), last)["switches"] == 1
    assert _switches([view_of(1), view_of(1)], answer_of([5], [5]), last)["switches"] == 0  # counted once


def test_a_row_passes_by_its_floor_and_says_missing_where_a_part_fell():
    more, fewer = Promise("a", ("x",), 99, 100), Promise("b", ("x",), 1.5, 0.5, "wrong", "n", at_most=True)
    counts = Counter({"n": 200, "right": 198, "wrong": 4})
    assert (row_of(more, 1, counts, []).figure, row_of(more, 1, counts, []).passed) == ("99.0 %", True)
    assert (row_of(fewer, 1, counts, []).figure, row_of(fewer, 1, counts, []).passed) == ("2.0 %", False)
    missing = row_of(more, 1, counts, ["ValueError: no box"])
    assert missing.figure is None
    assert missing.why == "ValueError: no box"
    assert row_of(more, 1, Counter(), []).figure is None


def test_every_promise_rests_on_cells_that_there_are_and_has_a_name_of_its_own():
    names = [promise.name for promise in PROMISES]
    assert len(dict.fromkeys(names)) == len(names)
    assert len(dict.fromkeys(point.key for point in POINTS)) == len(POINTS)


# peers and speed


def test_the_loops_as_printed_and_the_numpy_iteration_give_the_same_costs():
    source, target = (corners_of(view.boxes) for view in scenes(Cell("", 6, jitter=0.1), 1)[0])
    np.testing.assert_allclose(corner_costs(source, target)[0], printed_costs(source, target))


@pytest.mark.parametrize("peer", PEERS)
def test_a_peer_matches_two_views_of_one_heading(peer):
    for source, target in scenes(replace(FLAT, height_ratio=(0.7, 1.4), jitter=0.02), 3):
        assert peer_matches(peer, source.boxes, target.boxes) == set(true_matches(source, target))
    assert peer_matches(peer, source.boxes[:0], target.boxes) == set()
    assert peer_matches(peer, source.boxes[:1], target.boxes[:1]) <= {(0, 0)}


def test_36_headings_find_a_half_turn_that_one_does_not():
    source, target = scenes(replace(CLEAN, heading_rad=np.pi, exact_heading=True), 1)[0]
    wanted = set(true_matches(source, target))
    assert peer_matches("literal from 36 headings", source.boxes, target.boxes) == wanted
    assert peer_matches("CPD rigid", source.boxes, target.boxes) != wanted


def test_the_peers_table_and_the_figure_take_what_was_measured_and_say_what_was_not():
    counts = {peer_key(METHODS[0], PAIRS[0].name): Counter(n=4, right=3, microseconds=8000)}
    table = peer_table(counts, PAIRS[:1], [PAIRS[0].name])
    cells = [list(column.cells) for column in table.columns]
    assert cells[1:4] == [["4", "4"], ["75", "2.0"], ["MISSING", "MISSING"]]
    point = POINTS[0]
    figure = draw({peer_key("ours", point.key): Counter(n=10, right=9)}, 10, 1)
    lines = figure.axes[0].get_lines()
    assert [line.get_ydata().tolist() for line in lines if len(line.get_ydata())] == [[90.0]]
    assert len(figure.axes) == len(AXES)


# real pixels


def test_composites_hold_nine_animals_in_each_of_39_views():
    rng = np.random.default_rng(3)
    photos = []
    for _ in range(10):
        image = rng.integers(90, 100, (120, 200, 3)).astype(np.uint8)
        image[30:50, 20:70] = 230
        photos.append(Sample(image, np.array([[20, 30, 70, 50, 1]], np.float32)))
    views = composite_views(photos, rng)
    assert Counter(view.instant for view in views) == {0: 13, 1: 13, 2: 13}
    for view in views:
        assert view.image.shape == (VIEW_SIZE[1], VIEW_SIZE[0], 3)
        middles = view.quads.mean(axis=1)
        assert ((middles > 0) & (middles < VIEW_SIZE)).all()
        seen = [view.image[int(v), int(u)].mean() for u, v in middles]
        assert min(seen) > 180  # the bright animal lies where the label says
        assert np.median(view.image) < 110
    assert FRAME_SIZE[0] > VIEW_SIZE[0]
    with pytest.raises(ValueError, match="8 photographs with an animal: 9 are needed"):
        composite_views(photos[:8], rng)


def test_without_the_photographs_the_row_says_missing_and_where_they_should_be(tmp_path, monkeypatch):
    monkeypatch.setenv("PODWATCH_REAL_DATA", str(tmp_path))
    (row,) = pixel_rows(1, tmp_path)
    assert row.figure is None
    assert str(tmp_path / "right_whales") in row.why


# the benchmark in small


@pytest.mark.parametrize(
    ("name", "pairs", "least"),
    [
        ("literal mode, heading 15, shear 0.2, jitter 2 %, N=9", 60, 0.96),
        ("full view N=9", 25, 0.99),
        ("full view N=2, heading prior", 25, 0.92),
        ("tilt 20, jitter 10 %, N=5", 25, 0.92),
        ("near-symmetric layout: ring, N=6", 25, 0.92),
        ("moved 2 lengths, N=9", 25, 0.45),
        ("20 % missed, 10 % false, N=9", 25, 0.75),
        ("shifted 50 %, N=12", 25, 0.6),
        ("10 % missed, 5 % false, moved 0.25, tilt 15, N=9", 25, 0.8),
    ],
)
def test_pairs_in_small(name, pairs, least):
    counts = pair_counts(named(name), 11, range(pairs))
    assert counts["right"] >= least * pairs
    assert named(name).literal or counts["sure_wrong"] <= 0.1 * pairs


@pytest.mark.parametrize(
    ("name", "rings", "least"), [("ring, full view N=9 n=6", 4, 1.0), ("ring, jitter 10 %, N=3 n=6", 5, 0.7)]
)
def test_rings_in_small(name, rings, least):
    success = ring_success(named(name), rings, seed=11)
    assert success["right"] >= least
    assert success["wrongly_called"] == 0.0


def test_monitor_in_small():
    counts = monitor_counts(MONITOR, 11, range(15))
    assert counts["right"] / counts["boxes"] >= 0.96


def test_the_command_prints_its_rows_and_writes_them(tmp_path):
    arguments = ["bench", "registration", "--pairs", "4", "--only", "view N=3", "--rings", "1"]
    result = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "bench_registration.json").read_text())
    assert [row["name"] for row in rows] == ["full view N=3"]
    assert [row["n"] for row in rows] == [4]
    assert all(row["figure"] for row in rows)
    assert "full view N=3" in result.output
