"""ONNX files made by hand, in the layouts that people's models have."""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

NAMES = {"task": "detect", "names": "{0: 'whale'}", "imgsz": "[64, 64]"}
PICTURE = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)


def save(graph: onnx.GraphProto, path: Path, metadata: dict[str, str], opset: int = 17) -> Path:
    """Write a graph with its metadata."""
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    for key, value in metadata.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    onnx.save(model, str(path))
    return path


def network(
    path: Path,
    output: np.ndarray,
    metadata: dict[str, str] | None = None,
    shape: tuple[int | str, ...] = (1, 3, 64, 64),
    kind: int = TensorProto.FLOAT,
) -> Path:
    """An ONNX file that answers `output` whatever it is shown."""
    constant = helper.make_node("Constant", [], ["output0"], value=numpy_helper.from_array(output, "value"))
    graph = helper.make_graph(
        [constant],
        "test",
        [helper.make_tensor_value_info("images", kind, shape)],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, output.shape)],
    )
    return save(graph, path, NAMES if metadata is None else metadata)


def raw(*rows: tuple[float, ...], cells: int = 100) -> np.ndarray:
    """(1, len(row), cells): the rows given, then cells that found nothing."""
    output = np.zeros((1, len(rows[0]), cells), np.float32)
    for index, row in enumerate(rows):
        output[0, :, index] = row
    return output


def blob_network(path: Path, side: int = 64, share: float = 1.0) -> Path:
    """A network that really looks: one box round all that is bright in red, one for green, one for blue.

    share: of what is bright, each way, that the box holds; below 1 it ends short of where an animal is cut.
    """
    axis = np.arange(side, dtype=np.float32)
    constants = {
        "threshold": np.float32(0.6),
        "column": axis.reshape(1, 1, side),
        "far": np.full((1, 1, side), 1e4, np.float32),
        "near": np.full((1, 1, side), -1.0, np.float32),
        "one": np.float32(1),
        "half": np.float32(0.5),
        "share": np.float32(share),
        "zero": np.float32(0),
        "rows": np.array([1], np.int64),
    }
    nodes = [helper.make_node("Greater", ["images", "threshold"], ["bright"])]
    nodes.append(helper.make_node("Cast", ["bright"], ["light"], to=TensorProto.FLOAT))
    for name, gone in (("x", 2), ("y", 3)):
        lit, first, last = f"lit_{name}", f"first_{name}", f"last_{name}"
        nodes += [
            helper.make_node("ReduceMax", ["light"], [f"{lit}_any"], axes=[gone], keepdims=0),  # (1, 3, side)
            helper.make_node("Greater", [f"{lit}_any", "zero"], [lit]),
            helper.make_node("Where", [lit, "column", "far"], [f"{first}_all"]),
            helper.make_node("Where", [lit, "column", "near"], [f"{last}_all"]),
            helper.make_node("ReduceMin", [f"{first}_all"], [first], axes=[2], keepdims=0),  # (1, 3)
            helper.make_node("ReduceMax", [f"{last}_all"], [f"{last}_px"], axes=[2], keepdims=0),
            helper.make_node("Add", [f"{last}_px", "one"], [last]),
            helper.make_node("Add", [first, last], [f"sum_{name}"]),
            helper.make_node("Mul", [f"sum_{name}", "half"], [f"centre_{name}"]),
            helper.make_node("Sub", [last, first], [f"seen_{name}"]),
            helper.make_node("Mul", [f"seen_{name}", "share"], [f"size_{name}"]),
        ]
    nodes.append(helper.make_node("ReduceMax", ["light"], ["score"], axes=[2, 3], keepdims=0))
    parts = ["centre_x", "centre_y", "size_x", "size_y", "score"]
    nodes += [helper.make_node("Unsqueeze", [part, "rows"], [f"{part}_row"]) for part in parts]
    nodes.append(helper.make_node("Concat", [f"{part}_row" for part in parts], ["output0"], axis=1))
    graph = helper.make_graph(
        nodes,
        "blobs",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, side, side))],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, (1, 5, 3))],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    return save(graph, path, NAMES, opset=13)
