"""Writes an exported network in 8-bit integers, and holds what it finds against the network in float."""

import re
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from procs.detector.yolo import CONFIDENCE, open_session
from tools.errors import UnusableError
from tools.train.detector.export import describe
from tools.train.detector.model import STRIDES
from tools.train.detector.pictures import Batches, Mixture
from tools.train.detector.scores import box_iou

__all__ = ["quantise"]

CHECKED_PICTURES = 16
BEST_CELLS = 10  # of a picture: those that answer for its animals, if it has any
LARGEST_SCORE_DIFFERENCE = 0.05  # 0.02 is usual; scores without their own scale differ by 0.5
LEAST_IOU = 0.9  # 0.975 is usual


def quantise(model: Path, out: Path, pictures: Mixture, cache: Path, count: int = 128) -> str:
    """Write `model` in 8-bit integers to `out`: what follows the heads' last convolutions stays in float.

    Boxes and scores share one tensor; in 8 bits one scale for both would leave nothing of the scores. The
    ranges are those seen on `count` training pictures. Returns one line on how well both agree; raises
    UnusableError, and leaves `out` as it was, where they do not, or where `model` is none of this trainer.
    """
    whole, part = out.with_suffix(".folded.onnx"), out.with_suffix(".part.onnx")
    try:
        quant_pre_process(str(model), str(whole), skip_symbolic_shape=True)
        kept = _last_nodes(onnx.load(str(whole)).graph, model)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            quantize_static(
                str(whole),
                str(part),
                _TrainingPictures(pictures, cache, count),
                quant_format=QuantFormat.QDQ,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                per_channel=True,
                nodes_to_exclude=kept,
            )
        finished = onnx.load(str(part))
        describe(finished, pictures.side)
        onnx.save(finished, str(part))
        told = _check(model, part, _images(pictures, cache, CHECKED_PICTURES))
        part.replace(out)
    finally:
        whole.unlink(missing_ok=True)
        part.unlink(missing_ok=True)
    return f"{out}: {told}, {out.stat().st_size / 1e6:.2f} MB"


def _images(pictures: Mixture, cache: Path, count: int) -> Iterator[NDArray[np.float32]]:
    """Training pictures as the network takes them, (1, 3, side, side) in 0-1; whole batches of them."""
    batches = Batches(pictures, cache, steps=max(count // pictures.batch, 1))
    for index in range(len(batches)):
        for image in batches[index][0]:
            yield image.permute(2, 0, 1)[None].float().div(255).numpy()


class _TrainingPictures(CalibrationDataReader):  # type: ignore[misc]
    """Training pictures for the ranges of a quantised network's values."""

    def __init__(self, pictures: Mixture, cache: Path, count: int) -> None:
        self._images = _images(pictures, cache, count)

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:
        image = next(self._images, None)
        return None if image is None else {"images": image}


def _check(model: Path, rounded: Path, images: Iterable[NDArray[np.float32]]) -> str:
    """How far scores and boxes in 8 bits lie from those in float, in one line; UnusableError if too far."""
    whole, small = open_session(model), open_session(rounded)
    rows = []  # (3, BEST_CELLS) a picture: scores in float and in 8 bits, IoU of their boxes
    for image in images:
        (expected,), (found,) = (session.run(None, {"images": image})[0] for session in (whole, small))
        best = np.argsort(-expected[4], kind="stable")[:BEST_CELLS]
        boxes = [_corners(each[:4, best].T) for each in (expected, found)]
        rows.append(np.stack([expected[4, best], found[4, best], np.diag(box_iou(*boxes))]))
    expected, found, overlaps = np.concatenate(rows, axis=1)
    sure = expected >= min(CONFIDENCE, expected.max())  # a young network is sure of nothing
    difference, overlap = float(np.abs(expected - found)[sure].mean()), float(overlaps[sure].mean())
    told = f"scores {difference:.3f} from float and boxes at an IoU of {overlap:.3f} with it, on average"
    if not (difference <= LARGEST_SCORE_DIFFERENCE and overlap >= LEAST_IOU):
        raise UnusableError(
            f"{model} in 8 bits has {told} (limits {LARGEST_SCORE_DIFFERENCE} and {LEAST_IOU}); "
            "fly with the float model, or train longer and export again"
        )
    return told


def _corners(boxes: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 4) middles and sides -> xyxy."""
    return np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], axis=1)


def _last_nodes(graph: onnx.GraphProto, model: Path) -> list[str]:
    """Names of the heads' last convolutions and of all nodes after them; UnusableError where one lacks."""
    last = [node for node in graph.node if _is_last_convolution(node)]
    if len(last) != len(STRIDES):
        raise UnusableError(
            f"{model}: has the last convolutions of {len(last)} heads, not of {len(STRIDES)}: "
            "no export of this trainer; export it again from its checkpoint"
        )
    reached = {node.output[0] for node in last}
    names = [node.name for node in last]
    for node in graph.node:  # in the order of computation
        if any(name in reached for name in node.input):
            names.append(node.name)
            reached.update(node.output)
    return names


def _is_last_convolution(node: onnx.NodeProto) -> bool:
    return node.op_type == "Conv" and any(
        re.fullmatch(r"network\.heads\.\d\.1\.weight", n) for n in node.input
    )
