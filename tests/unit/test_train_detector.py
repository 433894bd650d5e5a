"""Training in small: the assignment, the loss, a run killed and resumed, weights taken up, the exports."""

import re
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from procs.detector.yolo import Detector
from tools.cli import app
from tools.errors import UNUSABLE, UnusableError
from tools.render import render_dataset
from tools.train.detector.export import check_export, export, load_weights
from tools.train.detector.loss import assign, detection_loss, pair_iou
from tools.train.detector.model import Sizes, WhaleDetector, cell_centres, decode
from tools.train.detector.pictures import Mixture
from tools.train.detector.quantise import _check, quantise
from tools.train.detector.training import Settings, averaged, settings_of, train

torch.set_num_threads(1)  # on a busy machine two wait for each other
PICTURES = Mixture(batch=2, side=64, scenes=2)
TINY = Settings(PICTURES, steps=4, early_side=64, warmup_steps=1, save_every_steps=2, workers=0)


@pytest.fixture(scope="module", autouse=True)
def _no_real_data() -> Iterator[None]:
    """The tests must pass without the real data."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PODWATCH_REAL_DATA", "/nowhere")
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ONNX file of a run of four steps."""
    return train(tmp_path_factory.mktemp("whole") / "run", TINY)


def test_cells_inside_an_animal_answer_for_it_and_the_best_box_gives_the_score() -> None:
    centres, strides = cell_centres(64, 64)
    boxes = torch.cat([centres - 4, centres + 4], 1)
    right = int(((centres == 12).all(1) & (strides == 8)).nonzero())
    boxes[right] = torch.tensor([8.0, 8.0, 24.0, 24.0])  # one cell draws exactly the animal's box
    animal = torch.tensor([[8.0, 8.0, 24.0, 24.0]])
    owner, target = assign(torch.full((len(centres),), 0.5), boxes, centres, strides, animal)
    assert target.argmax() == right
    assert target[right] == pytest.approx(1.0)
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
    perfect = animal[0, :4].expand(1, len(grid[0]), 4).clone()
    answers = assign(torch.full((len(grid[0]),), 0.5), perfect[0], *grid, animal[:, :4])[0] >= 0
    right = torch.where(answers, 4.0, -6.0)[None, None]
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


def test_a_killed_run_goes_on_and_ends_like_one_that_was_not_killed(trained: Path, tmp_path: Path) -> None:
    (tmp_path / "detector_scenes").symlink_to(trained.parents[1] / "detector_scenes")
    train(tmp_path / "run", TINY, stop_after=2)
    resumed = train(tmp_path / "run", TINY)
    first, second = (averaged(path.parent).state_dict() for path in (trained, resumed))
    for name, value in first.items():
        torch.testing.assert_close(second[name], value, msg=name)
    assert "at most" in check_export(averaged(resumed.parent), resumed, 64)
    assert Detector(resumed).input_size == (64, 64)
    with pytest.raises(ValueError, match="differs from torch"):
        check_export(WhaleDetector(), resumed, 64)


def test_the_settings_are_the_usual_ones_but_for_what_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 16)
    for cuda, asked, workers in ((False, None, 1), (True, None, 15), (True, 3, 3), (False, 0, 0)):
        monkeypatch.setattr("torch.cuda.is_available", lambda cuda=cuda: cuda)
        expected = Settings(Mixture(seed=3), steps=7, width=0.5, workers=workers)
        assert settings_of(0.5, 7, None, 3, workers=asked) == expected


def test_pictures_made_by_other_processes_are_the_same(trained: Path, tmp_path: Path) -> None:
    (tmp_path / "detector_scenes").symlink_to(trained.parents[1] / "detector_scenes")
    model = train(tmp_path / "run", replace(TINY, workers=1))
    assert model.read_bytes() == trained.read_bytes()


def test_a_run_by_the_clock_ends_when_its_time_is_over(trained: Path, tmp_path: Path) -> None:
    (tmp_path / "detector_scenes").symlink_to(trained.parents[1] / "detector_scenes")
    model = train(tmp_path / "run", replace(TINY, minutes=0.0005))
    state = torch.load(model.parent / "checkpoint.pt", weights_only=True)
    assert state["step"] >= 1
    assert state["seconds"] >= 0.03


def test_weights_are_taken_up_from_an_export_and_from_a_checkpoint(trained: Path, tmp_path: Path) -> None:
    expected = averaged(trained.parent).state_dict()
    for source in (trained, trained.parent / "checkpoint.pt"):
        network = WhaleDetector()
        load_weights(network, source)
        for name, value in network.state_dict().items():
            if value.ndim:
                torch.testing.assert_close(value, expected[name], msg=name)
    before = tmp_path / "three_grids.pt"
    old = {name: value for name, value in expected.items() if not name.startswith(("heads.0.", "side4."))}
    old = {name: value for name, value in old.items() if not name.startswith("narrow.")}
    for number in (1, 2, 3):
        old = {n.replace(f"heads.{number}.", f"heads.{number - 1}."): value for n, value in old.items()}
    torch.save({"average": old}, before)
    network = WhaleDetector()
    load_weights(network, before)
    for name, value in network.state_dict().items():
        if value.ndim and not name.startswith(("heads.0.", "side4.", "narrow.")):
            torch.testing.assert_close(value, expected[name], msg=name)
    with pytest.raises(ValueError, match="width the same"):
        load_weights(WhaleDetector(sizes=Sizes().scaled(0.5)), trained)
    (tmp_path / "foreign.onnx").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"foreign\.onnx"):
        load_weights(WhaleDetector(), tmp_path / "foreign.onnx")


def test_a_training_begins_from_the_weights_that_are_given_at_their_own_rate(
    trained: Path, tmp_path: Path
) -> None:
    (tmp_path / "detector_scenes").symlink_to(trained.parents[1] / "detector_scenes")
    model = train(tmp_path / "run", TINY, begin_from=trained, stop_after=0)
    expected = averaged(trained.parent).state_dict()
    for name, value in averaged(model.parent).state_dict().items():
        if value.ndim:
            torch.testing.assert_close(value, expected[name], msg=name)
    state = torch.load(model.parent / "checkpoint.pt", weights_only=True)
    assert (state["step"], state["highest_rate"]) == (0, TINY.rate_from)


def test_an_export_says_what_ultralytics_exports_say(trained: Path) -> None:
    told = {entry.key: entry.value for entry in onnx.load(str(trained)).metadata_props}
    assert told["imgsz"] == "[64, 64]"
    assert (told["names"], told["stride"], told["task"]) == ("{0: 'whale'}", "32", "detect")


def test_half_the_width_is_a_network_of_its_own(tmp_path: Path) -> None:
    narrow, full = (WhaleDetector(sizes=Sizes().scaled(width)) for width in (0.5, 1.0))
    narrow_size, full_size = (sum(p.numel() for p in net.parameters()) for net in (narrow, full))
    assert 3 < full_size / narrow_size < 4.5
    model = export(narrow, tmp_path / "narrow.onnx", 64)
    assert "output (1, 5, 340)" in check_export(narrow, model, 64)
    assert Sizes().scaled(0.01).stem == 8
    with pytest.raises(ValueError, match=r"width 9.*between 0\.25 and 2"):
        settings_of(9, None, None, 0)


def test_eight_bits_keep_boxes_and_scores(trained: Path, tmp_path: Path) -> None:
    cache = trained.parents[1] / "detector_scenes"
    small = tmp_path / "int8.onnx"
    told = quantise(trained, small, PICTURES, cache, count=8)
    assert re.fullmatch(rf"{small}: scores 0\.0\d+ from float and boxes at an IoU of 0\.9\d+ .* MB", told)
    assert list(tmp_path.iterdir()) == [small]
    assert small.stat().st_size < 0.5 * trained.stat().st_size
    picture = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    whole, rounded = (Detector(path, confidence=0.0, iou=1.0) for path in (trained, small))
    assert rounded.names == {0: "whale"}
    first, second = whole.detect(picture), rounded.detect(picture)
    assert len(first) == len(second)
    # In 8 bits throughout, scores of a hundredth beside boxes of 64 px would all be one number.
    assert second.scores.std() > 0.2 * first.scores.std() > 0


def test_an_export_in_8_bits_that_is_none_leaves_the_last_one_in_its_place(
    trained: Path, tmp_path: Path
) -> None:
    cache, last = trained.parents[1] / "detector_scenes", tmp_path / "int8.onnx"
    last.write_bytes(b"the last one")
    foreign = onnx.load(str(trained))
    for node in foreign.graph.node:
        node.input[:] = [name.replace("network.heads.2.1.", "network.tails.2.1.") for name in node.input]
    for item in foreign.graph.initializer:
        item.name = item.name.replace("network.heads.2.1.", "network.tails.2.1.")
    onnx.save(foreign, str(tmp_path / "foreign.onnx"))
    with pytest.raises(UnusableError, match=r"foreign\.onnx: has the last convolutions of 3 heads, not of 4"):
        quantise(tmp_path / "foreign.onnx", last, PICTURES, cache, count=8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tools.train.detector.quantise.LEAST_IOU", 1.1)
        with pytest.raises(UnusableError, match=r"detector\.onnx in 8 bits has scores .* fly with the float"):
            quantise(trained, last, PICTURES, cache, count=8)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["foreign.onnx", "int8.onnx"]
    assert last.read_bytes() == b"the last one"


def test_scores_and_boxes_that_differ_from_those_in_float_are_found_out(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = WhaleDetector(sizes=Sizes().scaled(0.25))
    whole = export(network, tmp_path / "whole.onnx", 64)
    images = [np.random.default_rng(0).random((1, 3, 64, 64), np.float32)]
    assert _check(whole, whole, images).startswith("scores 0.000 from float and boxes at an IoU of 1.000")
    for rows, message in ((slice(4, 5), r"scores 0\.[1-9]"), (slice(0, 4), r"at an IoU of 0\.[0-8]")):
        other = deepcopy(network)
        with torch.no_grad():
            for head in other.heads:
                head.get_parameter("1.bias")[rows] += 3
        with pytest.raises(UnusableError, match=rf"whole\.onnx in 8 bits has .*{message}"):
            _check(whole, export(other, tmp_path / "other.onnx", 64), images)


def test_what_is_given_is_read_before_minutes_are_spent_on_rendering(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tools.train.detector.pictures._rendered", lambda *_, **__: pytest.fail("rendered"))
    with pytest.raises(UnusableError, match=r"none\.yaml: no such file"):
        train(tmp_path / "run", TINY, data=tmp_path / "none.yaml")
    with pytest.raises(UnusableError, match=r"none\.onnx: no such file"):
        train(tmp_path / "run", TINY, begin_from=tmp_path / "none.onnx")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("render OUT --split nope", "split 'nope' is not known; there are: train"),
        ("train detector --out OUT --width 0.1", "width 0.1"),
        ("train detector --out OUT --data OUT/data.yaml", "data.yaml: no such file"),
        ("train detector --out OUT --from OUT/detector.onnx", "detector.onnx: no such file"),
        ("train detector --out OUT --classes whale", "give --data as well"),
        ("train assigner --out OUT --loss nope", "loss 'nope'"),
    ],
)
def test_what_is_of_no_use_is_told_in_one_line(tmp_path: Path, words: str, message: str) -> None:
    result = CliRunner().invoke(app, [word.replace("OUT", str(tmp_path / "out")) for word in words.split()])
    assert result.exit_code == UNUSABLE
    assert message in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.timeout(240)
def test_the_smoke_run_of_the_command_line_leaves_a_model_that_loads(tmp_path: Path) -> None:
    data = render_dataset(tmp_path / "own", 2, seed=5, side=(160, 120))
    words = ["train", "detector", "--smoke", "--width", "0.5", "--data", str(data)]
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "run")])
    assert result.exit_code == 0, result.output
    assert re.search(r"2 pictures of your own with [1-9]\d* animals", result.output)
    assert "at most" in result.output, "the export was held against torch"
    assert re.search(r"n = 2 pictures \(2 learnt as well\) with [1-9]\d* animals .*recall", result.output)
    model = Detector(tmp_path / "run" / "smoke" / "detector.onnx")
    assert model.input_size == (320, 320)
    assert model.detect(np.zeros((480, 640, 3), np.uint8)).boxes.shape[1] == 4
