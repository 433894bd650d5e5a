"""Training in small: scenes and labels on disk, samples, the loss, a run killed and resumed, the export, the
scores.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from drivers.cameras.pinhole import apply_homography
from procs.detector.yolo import Detections, Detector
from tools.cli import app
from tools.render import measured_right_whales, render_dataset, scenes
from tools.train.detector.loss import assign, detection_loss, pair_iou
from tools.train.detector.model import WhaleDetector, cell_centres, decode
from tools.train.detector.samples import (
    Sample,
    augment,
    letterboxed,
    numbered,
    photograph_sample,
    read_yolo,
    scene_sample,
)
from tools.train.detector.scores import average_precision, match, recall_by_length, score
from tools.train.detector.training import Settings, averaged, check_export, held_out, real_data, train

TINY = Settings(steps=4, batch=2, scenes=2, early_side=64, side=64, warmup_steps=1, save_every_steps=2)


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve rendered scenes in the YOLO layout."""
    out = tmp_path_factory.mktemp("set")
    return render_dataset(out, 6, seed=5, split="train", side=(160, 120)).parent


@pytest.fixture(autouse=True)
def _no_real_data(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """Only the tests that name the real data see it: the rest must pass without it."""
    if "real" not in request.node.name:
        monkeypatch.setenv("PODWATCH_REAL_DATA", str(tmp_path / "nowhere"))


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


def test_files_are_ordered_by_number_and_every_fifth_is_held_out() -> None:
    paths = [Path(f"w_{number}.jpg") for number in (10, 2, 1, 11, 3, 0)]
    assert [path.stem for path in sorted(paths, key=numbered)] == ["w_0", "w_1", "w_2", "w_3", "w_10", "w_11"]
    kept, out = held_out(paths)
    assert [path.stem for path in out] == ["w_0", "w_11"]
    assert not set(kept) & set(out)


def test_a_bad_label_or_picture_is_named(tmp_path: Path) -> None:
    picture = tmp_path / "a.png"
    cv2.imwrite(str(picture), np.zeros((10, 20, 3), np.uint8))
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.2\n")
    with pytest.raises(ValueError, match=r"a\.txt.*0\.5 0\.5 0\.2"):
        read_yolo([picture], tmp_path)
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.2 0.4\n")
    np.testing.assert_allclose(read_yolo([picture], tmp_path)[0].boxes, [[8, 3, 12, 7, 1]], atol=1e-5)
    (tmp_path / "b.jpg").write_text("no picture")
    with pytest.raises(ValueError, match=r"b\.jpg"):
        read_yolo([tmp_path / "b.jpg"], tmp_path)


def marked(seed: int, width: int, height: int) -> Sample:
    """Dark noise with one white rectangle, which is the animal."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 40, (height, width, 3), dtype=np.uint8)
    x, y, w, h = (
        int(rng.integers(0, width - 60)),
        int(rng.integers(0, height - 40)),
        50,
        int(rng.integers(12, 34)),
    )
    image[y : y + h, x : x + w] = 255
    half = Sample(
        np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8),
        np.array([[x / 2, y / 2, (x + w) / 2, (y + h) / 2, 1]], np.float32),
    )
    return Sample(image, np.array([[x, y, x + w, y + h, 1]], np.float32), half)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.booleans())
def test_samples_keep_boxes_on_their_animals(seed: int, rendered: bool) -> None:
    rng = np.random.default_rng(seed)
    photos = [marked(seed + k, 240, 160) for k in range(3)]
    empty = [Sample(np.full((96, 96, 3), 20, np.uint8), np.zeros((0, 5), np.float32))]
    sample = scene_sample(photos[0], rng, 96) if rendered else photograph_sample(photos, empty, rng, 96)
    if rng.random() < 0.3:
        sample = letterboxed(sample, rng)
    assert sample.image.shape == (96, 96, 3)
    for box in sample.boxes[sample.boxes[:, 4] > 0]:
        left, top, right, bottom = box[:4]
        assert 0 <= left < right <= 96
        assert 0 <= top < bottom <= 96
        x0, y0, x1, y1 = int(left + 2), int(top + 2), int(right - 1), int(bottom - 1)
        if x1 - x0 >= 2 and y1 - y0 >= 2:  # the animal is white, the water dark
            assert np.median(sample.image[y0:y1, x0:x1]) > 120


def test_augmentation_keeps_the_shape_and_repeats_for_the_same_generator() -> None:
    image = marked(0, 64, 48).image[:48, :64]
    for seed in range(30):
        one, same = (augment(image, np.random.default_rng(seed)) for _ in range(2))
        assert one.shape == image.shape
        assert one.dtype == np.uint8
        np.testing.assert_array_equal(one, same)


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


def test_cells_inside_an_animal_answer_for_it_and_the_best_box_gives_the_score() -> None:
    centres, strides = cell_centres(64, 64)
    boxes = torch.cat([centres - 4, centres + 4], 1)
    boxes[9] = torch.tensor([8.0, 8.0, 24.0, 24.0])  # one cell draws exactly the animal's box
    animal = torch.tensor([[8.0, 8.0, 24.0, 24.0]])
    owner, target = assign(torch.full((len(centres),), 0.5), boxes, centres, strides, animal)
    assert target.argmax() == 9
    assert target[9] == pytest.approx(1.0)
    mine = owner >= 0
    # Inside, or within three quarters of a cell of the middle: a coarse cell may answer for a small animal.
    reach = torch.clamp(0.75 * strides, min=8.0)[:, None]
    assert ((centres - 16).abs() < reach)[mine].all()
    assert (target[~mine] == 0).all()


def test_two_animals_never_share_a_cell() -> None:
    centres, strides = cell_centres(64, 64)
    boxes = torch.cat([centres - 8, centres + 8], 1)
    animals = torch.tensor([[4.0, 4.0, 40.0, 30.0], [10.0, 10.0, 44.0, 40.0]])
    owner, target = assign(torch.rand(len(centres)), boxes, centres, strides, animals)
    assert sorted(owner.unique().tolist()) == [-1, 0, 1]
    assert ((target > 0) <= (owner >= 0)).all()


def test_a_perfect_answer_costs_less_than_silence_and_faint_animals_cost_nothing() -> None:
    grid = cell_centres(64, 64)
    animal = torch.tensor([[8.0, 8.0, 40.0, 40.0, 1.0]])
    inside = ((grid[0] > 8) & (grid[0] < 40)).all(1)
    perfect = animal[0, :4].expand(1, len(grid[0]), 4).clone()
    right = torch.where(inside, 4.0, -6.0)[None, None]
    silent = torch.full_like(right, -6.0)
    good, bad = (sum(detection_loss(logits, perfect, *grid, [animal])) for logits in (right, silent))
    assert good < bad
    faint = animal * torch.tensor([1, 1, 1, 1, 0.0])
    shout, _ = detection_loss(right, perfect, *grid, [faint])
    water, _ = detection_loss(right, perfect, *grid, [torch.zeros(0, 5)])
    assert shout < 0.2 * water


@settings(deadline=None, max_examples=40)
@given(st.lists(st.integers(0, 30), min_size=8, max_size=8))
def test_pair_iou_agrees_with_counting_unit_squares(numbers: list[int]) -> None:
    x0, y0, w0, h0, x1, y1, w1, h1 = numbers
    grids = np.zeros((2, 64, 64), bool)
    grids[0, y0 : y0 + h0 + 1, x0 : x0 + w0 + 1] = True
    grids[1, y1 : y1 + h1 + 1, x1 : x1 + w1 + 1] = True
    expected = (grids[0] & grids[1]).sum() / (grids[0] | grids[1]).sum()
    first = torch.tensor([[x0, y0, x0 + w0 + 1, y0 + h0 + 1]], dtype=torch.float32)
    second = torch.tensor([[x1, y1, x1 + w1 + 1, y1 + h1 + 1]], dtype=torch.float32)
    assert float(pair_iou(first, second)[0, 0]) == pytest.approx(expected, abs=1e-5)


def test_the_network_learns_one_picture_by_heart() -> None:
    torch.manual_seed(0)
    network, grid = WhaleDetector().train(), cell_centres(64, 64)
    optimiser = torch.optim.AdamW(network.parameters(), 3e-3)
    images = torch.zeros(2, 3, 64, 64)
    images[0, :, 12:36, 20:52] = 1.0
    animals = [torch.tensor([[20.0, 12.0, 52.0, 36.0, 1.0]]), torch.zeros(0, 5)]
    for _ in range(40):
        logits, distances = network(images)
        loss = sum(detection_loss(logits, decode(distances, *grid), *grid, animals))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        logits, distances = network(images)
    best = int(logits[0, 0].argmax())
    assert pair_iou(decode(distances, *grid)[:1, best], animals[0][:, :4]).item() > 0.6
    assert logits[0].max() > logits[1].max() + 1


def test_a_killed_run_goes_on_and_ends_like_one_that_was_not_killed(tmp_path: Path) -> None:
    whole = train(tmp_path / "a" / "run", TINY)
    (tmp_path / "b").mkdir()
    (tmp_path / "a" / "detector_cache").rename(tmp_path / "b" / "detector_cache")
    train(tmp_path / "b" / "run", TINY, stop_after=2)
    resumed = train(tmp_path / "b" / "run", TINY)
    first, second = (averaged(path.parent).state_dict() for path in (whole, resumed))
    for name, value in first.items():
        torch.testing.assert_close(second[name], value, msg=name)
    assert "at most" in check_export(averaged(resumed.parent), resumed, TINY.side)
    assert Detector(resumed).input_size == (64, 64)
    with pytest.raises(ValueError, match="differs from torch"):
        check_export(WhaleDetector(), resumed, TINY.side)


@pytest.mark.timeout(240)
def test_the_smoke_run_of_the_command_line_leaves_a_model_that_loads(tmp_path: Path) -> None:
    words = ["train", "detector", "--smoke", "--out", str(tmp_path / "run")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "at most" in result.output, "the export was held against torch"
    model = Detector(tmp_path / "run" / "smoke" / "detector.onnx")
    assert model.input_size == (Settings.side, Settings.side)
    assert model.detect(np.zeros((480, 640, 3), np.uint8)).boxes.shape[1] == 4


def test_own_pictures_are_read_from_a_yolo_data_file(data_set: Path, tmp_path: Path) -> None:
    train(tmp_path / "run", Settings(**{**TINY.__dict__, "steps": 1}), data=data_set / "data.yaml")
    (tmp_path / "bad.yaml").write_text("names:\n  0: whale\n")
    for path, message in (
        (tmp_path / "none.yaml", "no such file"),
        (tmp_path / "bad.yaml", "no entry 'train'"),
    ):
        with pytest.raises(ValueError, match=message):
            train(tmp_path / "run", TINY, data=path)


def found(*rows: tuple[float, ...]) -> Detections:
    table = np.array(rows, np.float32).reshape(-1, 5)
    return Detections(table[:, :4], table[:, 4], np.zeros(len(table), np.int64), {0: "whale"})


def test_each_animal_is_found_once_and_faint_ones_are_left_out() -> None:
    known = np.array([[0, 0, 10, 10, 1], [50, 50, 60, 60, 0]], np.float32)
    seen = found((0, 0, 10, 9, 0.9), (0, 0, 10, 10, 0.8), (50, 50, 58, 60, 0.7), (80, 80, 90, 90, 0.6))
    assert [right for _, right in match(seen, known)] == [True, False, False]
    assert [right for _, right in match(seen, known, extras_allowed=True)] == [True]


def test_average_precision_by_hand() -> None:
    # Right, wrong, right of two animals: precision 1 up to recall 1/2, then 2/3 up to 1.
    assert average_precision([(0.9, True), (0.8, False), (0.7, True)], 2) == pytest.approx(0.5 + 0.5 * 2 / 3)
    assert average_precision([(0.9, True)], 2) == pytest.approx(0.5)
    assert average_precision([], 3) == 0.0


@pytest.mark.parametrize("confidence", [0.25])
def test_the_shipped_model_finds_sperm_whales_that_the_trainer_never_drew(confidence: float) -> None:
    samples = []
    for scene in scenes(12, 900, "val_sperm", (320, 240)):
        rows = [(scene.boxes, 1), (scene.faint, 0)]
        boxes = [np.column_stack([part, np.full(len(part), flag)]) for part, flag in rows]
        samples.append(Sample(scene.image, np.concatenate(boxes).astype(np.float32)))
    result = score(lambda least: Detector(confidence=least), samples, confidence)
    assert result.average_precision > 0.6
    assert result.precision > 0.6


@pytest.mark.skipif(not (real_data() / "right_whales").is_dir(), reason="needs ../shared/data")
def test_the_shipped_model_finds_real_whales_that_were_held_out() -> None:
    folder = real_data() / "right_whales"
    _, kept = held_out(sorted((folder / "images").glob("*.jpg")))
    result = score(lambda least: Detector(confidence=least), read_yolo(kept, folder / "labels"))
    assert result.average_precision >= 0.9


def test_recall_is_counted_by_length_in_the_input() -> None:
    scene = next(item for item in scenes(20, 900, "val_sperm", (320, 320)) if len(item.boxes) > 2)
    boxes = np.column_stack([scene.boxes, np.ones(len(scene.boxes))]).astype(np.float32)
    counts = recall_by_length(Detector(), [Sample(scene.image, boxes)])
    assert sum(total for _, total in counts.values()) == len(boxes)
    assert all(0 <= hits <= total for hits, total in counts.values())
    assert next(iter(counts)) == "0-12 px"
