"""The detector's core: layouts told apart and decoded by hand-made networks, bad files and pictures refused
by name.
"""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

import models
from procs.detector.decode import Candidates, Layout, layout_of, suppress
from procs.detector.network import open_session
from procs.detector.yolo import Detector, ModelError
from tests.unit.detector_networks import NAMES, PICTURE, network, raw


def test_a_raw_output_is_decoded_and_overlaps_go(tmp_path: Path) -> None:
    # Centre (20, 30), 10 x 20 px; its double 1 px beside it, less sure; one apart; one too unsure.
    rows = [(20, 30, 10, 20, 0.9), (21, 30, 10, 20, 0.8), (50, 50, 6, 6, 0.5), (10, 10, 6, 6, 0.2)]
    found = Detector(network(tmp_path / "raw.onnx", raw(*rows))).detect(PICTURE)
    np.testing.assert_allclose(found.boxes, [[15, 20, 25, 40], [47, 47, 53, 53]], atol=1e-4)
    np.testing.assert_allclose(found.scores, [0.9, 0.5])
    assert found.classes.tolist() == [0, 0]
    assert found.names == {0: "whale"}
    assert found.boxes.dtype == np.float32
    assert set(found.timings) == {"prepare", "infer", "decode"}


def test_a_finished_output_is_taken_as_it_is(tmp_path: Path) -> None:
    output = np.zeros((1, 30, 6), np.float32)
    output[0, :2] = [(15, 20, 25, 40, 0.9, 1), (47, 47, 53, 53, 0.1, 0)]
    model = network(tmp_path / "done.onnx", output, {**NAMES, "names": "{0: 'boat', 1: 'whale'}"})
    found = Detector(model).detect(PICTURE)
    np.testing.assert_allclose(found.boxes, [[15, 20, 25, 40]])
    assert [found.names[kind] for kind in found.classes] == ["whale"]


def test_an_oriented_box_becomes_the_upright_one_round_it(tmp_path: Path) -> None:
    output = raw((32, 32, 20, 10, 0.9, np.pi / 2))
    model = network(tmp_path / "obb.onnx", output, {**NAMES, "task": "obb"})
    np.testing.assert_allclose(Detector(model).detect(PICTURE).boxes, [[27, 22, 37, 42]], atol=1e-3)


def test_boxes_come_back_in_the_given_pictures_pixels(tmp_path: Path) -> None:
    # 128 x 96 px shrinks by half to 64 x 48, with bars of 8 px: a box at (32, 32) is at (64, 48) in the
    # picture.
    model = network(tmp_path / "raw.onnx", raw((32, 32, 10, 8, 0.9)))
    wide = np.random.default_rng(1).integers(0, 255, (96, 128, 3), dtype=np.uint8)
    np.testing.assert_allclose(Detector(model).detect(wide).boxes, [[54, 40, 74, 56]], atol=1e-3)


def test_boxes_are_cut_at_the_pictures_border(tmp_path: Path) -> None:
    model = network(tmp_path / "raw.onnx", raw((2, 60, 20, 20, 0.9), (-50, -50, 10, 10, 0.9)))
    np.testing.assert_allclose(Detector(model).detect(PICTURE).boxes, [[0, 50, 12, 64]], atol=1e-4)


def test_only_the_classes_asked_for_are_reported(tmp_path: Path) -> None:
    output = raw((20, 20, 10, 10, 0.9, 0.1), (50, 50, 10, 10, 0.1, 0.8))
    model = network(tmp_path / "two.onnx", output, {**NAMES, "names": "['boat', 'whale']"})
    assert Detector(model).detect(PICTURE).classes.tolist() == [0, 1]
    assert Detector(model, classes=[1]).detect(PICTURE).classes.tolist() == [1]


def test_a_model_without_metadata_numbers_its_classes(tmp_path: Path) -> None:
    found = Detector(network(tmp_path / "bare.onnx", raw((20, 20, 10, 10, 0.1, 0.8)), {})).detect(PICTURE)
    assert found.names == {0: "0", 1: "1"}
    assert found.classes.tolist() == [1]


def test_the_picture_reaches_the_network_as_rgb_from_0_to_1(tmp_path: Path) -> None:
    # The scores of three cells are the mean red, green and blue of the picture.
    graph = helper.make_graph(
        [
            helper.make_node("ReduceMean", ["images"], ["mean"], axes=[2, 3], keepdims=0),  # (1, 3)
            helper.make_node("Unsqueeze", ["mean", "one"], ["scores"]),  # (1, 1, 3)
            helper.make_node("Concat", ["boxes", "scores"], ["output0"], axis=1),  # (1, 5, 3)
        ],
        "colours",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 64, 64))],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, (1, 5, 3))],
        [
            numpy_helper.from_array(np.array([1]), "one"),
            numpy_helper.from_array(
                np.array([[[10, 30, 50], [9, 9, 9], [8, 8, 8], [8, 8, 8]]], np.float32), "boxes"
            ),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(tmp_path / "colours.onnx"))
    picture = np.full((64, 64, 3), (51, 102, 204), np.uint8)  # BGR
    found = Detector(tmp_path / "colours.onnx", confidence=0.1).detect(picture)
    np.testing.assert_allclose(found.scores, [0.8, 0.4, 0.2], atol=1e-5)
    np.testing.assert_allclose(found.boxes[0, :2], [6, 5], atol=1e-4)  # red is the first channel


def test_half_precision_and_dynamic_inputs_work(tmp_path: Path) -> None:
    half = network(tmp_path / "half.onnx", raw((20, 30, 10, 20, 0.9)), kind=TensorProto.FLOAT16)
    assert len(Detector(half).detect(PICTURE)) == 1
    free = network(tmp_path / "free.onnx", raw((20, 30, 10, 20, 0.9)), shape=(1, 3, "height", "width"))
    detector = Detector(free)
    assert detector.input_size == (64, 64)
    assert len(detector.detect(PICTURE)) == 1


def test_a_few_nan_rows_are_left_out_and_a_nan_model_is_refused(tmp_path: Path) -> None:
    output = raw((20, 30, 10, 20, 0.9), (np.nan, 1, 1, 1, 0.9), (1, 1, 1, 1, np.nan), (np.inf, 1, 1, 1, 0.9))
    found = Detector(network(tmp_path / "some.onnx", output)).detect(PICTURE)
    np.testing.assert_allclose(found.boxes, [[15, 20, 25, 40]], atol=1e-4)
    with pytest.raises(ModelError, match=r"all\.onnx: 100 of 100 rows .* NaN"):
        Detector(network(tmp_path / "all.onnx", np.full((1, 5, 100), np.nan, np.float32))).detect(PICTURE)


@pytest.mark.parametrize("level", [0, 3, 255])
def test_a_flat_frame_shows_nothing_whatever_the_model_says(tmp_path: Path, level: int) -> None:
    detector = Detector(network(tmp_path / "raw.onnx", raw((20, 30, 10, 20, 0.9))))
    assert detector.detect(np.full((480, 640, 3), level, np.uint8)).boxes.shape == (0, 4)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (np.zeros((64, 64), np.uint8), r"shape \(64, 64\)"),
        (np.zeros((64, 64, 4), np.uint8), r"shape \(64, 64, 4\)"),
        (np.zeros((0, 64, 3), np.uint8), r"shape \(0, 64, 3\)"),
        (np.zeros((64, 64, 3), np.float32), "float32"),
        (None, "NoneType"),
    ],
)
def test_a_picture_of_another_shape_or_type_is_refused(tmp_path: Path, picture: object, message: str) -> None:
    detector = Detector(network(tmp_path / "raw.onnx", raw((20, 30, 10, 20, 0.9))))
    with pytest.raises(ValueError, match=message):
        detector.detect(picture)  # type: ignore[arg-type]


def test_missing_empty_and_broken_files_are_named_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "empty.onnx").write_bytes(b"")
    (tmp_path / "text.onnx").write_text("version https://git-lfs.github.com/spec/v1")
    whole = network(tmp_path / "whole.onnx", raw((20, 30, 10, 20, 0.9))).read_bytes()
    (tmp_path / "cut.onnx").write_bytes(whole[: len(whole) // 2])
    for name, message in (
        ("gone.onnx", "no such model file; give the path"),
        ("empty.onnx", "is empty; copy or export"),
        ("text.onnx", "not a model that onnxruntime loads.*again"),
        ("cut.onnx", "not a model that onnxruntime loads.*again"),
    ):
        with pytest.raises(ModelError, match=f"{name}.*{message}"):
            Detector(tmp_path / name)


@pytest.mark.parametrize(
    ("output", "metadata", "more", "message"),
    [
        (np.zeros((1, 1000), np.float32), NAMES, {}, r"\(1, 1000\) is neither.*whale"),
        (np.zeros((1, 9, 50), np.float32), NAMES, {}, r"\(1, 9, 50\) is neither \(1, 5, A\)"),
        (np.zeros((1, 5, 50), np.float32), {**NAMES, "task": "segment"}, {}, "task is 'segment'"),
        (np.zeros((1, 5, 50), np.float32), {**NAMES, "names": "whale"}, {}, "names is 'whale'"),
        (np.zeros((1, 5, 50), np.float32), NAMES, {"shape": (1, 4, 64, 64)}, r"input is images .*4, 64, 64"),
        (np.zeros((1, 5, 50), np.float32), NAMES, {"kind": TensorProto.INT64}, r"tensor\(int64\)"),
        (
            np.zeros((1, 5, 50), np.float32),
            {**NAMES, "imgsz": "big"},
            {"shape": (1, 3, "h", "w")},
            "imgsz 'big'",
        ),
    ],
)
def test_a_model_of_another_kind_is_refused_by_what_is_wrong(
    tmp_path: Path, output: np.ndarray, metadata: dict[str, str], more: dict[str, object], message: str
) -> None:
    path = network(tmp_path / "odd.onnx", output, metadata, **more)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=f"odd.onnx.*{message}"):
        Detector(path)


@pytest.mark.parametrize("bad", [{"confidence": 1.5}, {"iou": -0.1}, {"tile": 8}, {"tile": "all"}])
def test_settings_out_of_range_are_refused(bad: dict[str, object]) -> None:
    name = next(iter(bad))
    with pytest.raises(ValueError, match=name):
        Detector(**bad)  # type: ignore[arg-type]


def test_layouts_are_told_apart_by_shape_and_names() -> None:
    assert layout_of((1, 5, 2100), 1) == Layout("raw")
    assert layout_of((1, 84, 8400), 80, "detect") == Layout("raw")
    assert layout_of((1, 300, 6), 1) == Layout("finished")
    assert layout_of((1, 300, 7), 15, "obb") == Layout("finished", oriented=True)
    assert layout_of((1, 20, 8400), 15, "obb") == Layout("raw", oriented=True)
    with pytest.raises(ValueError, match="neither"):
        layout_of((1, 8400, 84), 80)


boxes = st.lists(
    st.tuples(st.floats(0, 90), st.floats(0, 90), st.floats(2, 40), st.floats(2, 40), st.floats(0.3, 1)),
    max_size=12,
)


@settings(deadline=None, max_examples=40)
@given(boxes)
def test_suppression_leaves_no_pair_that_overlaps_and_drops_nothing_else(
    rows: list[tuple[float, ...]],
) -> None:
    table = np.array(rows, np.float32).reshape(-1, 5)
    corners = np.concatenate([table[:, :2], table[:, :2] + table[:, 2:4]], axis=1)
    found = Candidates(corners, table[:, 4], np.zeros(len(table), np.int64))
    kept = suppress(found, 0.45)

    def iou(one: np.ndarray, other: np.ndarray) -> float:
        shared = np.clip(np.minimum(one[2:], other[2:]) - np.maximum(one[:2], other[:2]), 0, None).prod()
        return float(shared / ((one[2:] - one[:2]).prod() + (other[2:] - other[:2]).prod() - shared))

    for index, one in enumerate(kept.boxes):
        assert all(iou(one, other) <= 0.451 for other in kept.boxes[:index])
    assert np.all(np.diff(kept.scores) <= 0)
    for one, score in zip(found.boxes, found.scores, strict=True):  # each that went had a better one over it
        assert any(
            iou(one, other) > 0.449 and better >= score
            for other, better in zip(kept.boxes, kept.scores, strict=True)
        )


def test_the_shipped_model_is_small_and_says_what_it_is() -> None:
    path = models.path("detector.onnx")
    assert path.stat().st_size <= 4_000_000
    detector = Detector()
    assert detector.names == {0: "whale"}
    assert detector.input_size == (320, 320)
    metadata = {entry.key: entry.value for entry in onnx.load(str(path)).metadata_props}
    assert metadata["task"] == "detect"
    assert metadata["license"] == "Apache-2.0"


def test_the_model_card_is_about_the_files_that_ship() -> None:
    card = models.path("detector.md").read_text()
    for name in ("detector.onnx", "detector_half.onnx", "detector_int8.onnx"):
        data = models.path(name).read_bytes()
        said = f"`{name}`, {len(data) / 1e6:.2f} MB, sha256 `{hashlib.sha256(data).hexdigest()}`"
        assert said in card
    (output,) = open_session(models.path("detector.onnx")).get_outputs()
    assert f"`output0` {tuple(output.shape)}" in card


def test_the_library_under_it_keeps_and_sends_no_word_of_the_drone(tmp_path: Path) -> None:
    """onnxruntime would write a device's number into the home folder and call its maker."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "XDG_"))}
    subprocess.run(
        [sys.executable, "-c", "from procs.detector.yolo import Detector; Detector()"],
        env=environment | {"HOME": str(tmp_path)},
        cwd=Path(__file__).parents[2],
        check=True,
    )
    assert list(tmp_path.rglob("*")) == []
