"""Finds animals in a picture with an ONNX network in one of the layouts that Ultralytics exports.

    found = Detector().detect(image_bgr)      found.boxes (N, 4) float32 xyxy px, found.scores, found.classes

Ours ships as models/detector.onnx; any other detection model in these layouts is taken as it is.
"""

import ast
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

import models
from procs.detector.decode import Candidates, ModelError, decode_finished, decode_raw, layout_of, suppress
from procs.detector.tiles import drop_cut, tile_windows

__all__ = ["Detections", "Detector", "ModelError", "open_session"]

Image = NDArray[np.uint8]

PAD_GREY = 114  # round the picture, as in training
FLAT_LEVELS = (
    4  # a picture whose brightest and darkest values differ by less shows nothing (a dead or covered camera)
)


@dataclass(frozen=True)
class Detections:
    """What was found in one picture, best first."""

    boxes: NDArray[np.float32]  # (N, 4) xyxy px of the given picture
    scores: NDArray[np.float32]  # (N,) 0 to 1
    classes: NDArray[np.int64]  # (N,) keys of names
    names: dict[int, str]
    timings: dict[str, float] = field(default_factory=dict)  # ms: prepare, infer, decode

    def __len__(self) -> int:
        return len(self.scores)


class Detector:
    """One network, loaded once; `detect` may be called for any number of pictures of any size.

    model_path: an ONNX file, None for the one that ships. confidence: least score. iou: overlap above which
    the lesser of two boxes goes. classes: numbers of the classes to report, None for all. tile: None looks at
    the whole picture once; a number also looks at overlapping tiles of that many px, "auto" chooses that by
    the picture's size.

    Raises ModelError when the file is missing, empty, broken or of another layout; ValueError for bad
    settings.
    """

    def __init__(
        self,
        model_path: str | Path | None = None,
        confidence: float = 0.25,
        iou: float = 0.45,
        classes: Sequence[int] | None = None,
        tile: int | Literal["auto"] | None = None,
    ) -> None:
        for name, value in (("confidence", confidence), ("iou", iou)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name} {value}: must lie between 0 and 1")
        if tile is not None and tile != "auto" and (isinstance(tile, str) or tile < 32):
            raise ValueError(f"tile {tile!r}: must be None, 'auto' or at least 32 px")
        self._path = _model_file(model_path)
        self._confidence, self._iou, self._tile = confidence, iou, tile
        self._session = open_session(self._path)
        self._metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        self._task = self._metadata.get("task", "detect")
        if self._task not in ("detect", "obb"):
            raise ModelError(
                f"{self._path}: the model's task is {self._task!r}; export one with task 'detect' or 'obb'"
            )
        self.names = self._read_names()
        self._classes = None if classes is None else np.array(sorted(classes), np.int64)
        self.input_size = self._read_input()
        self._canvas = np.full((self.input_size[1], self.input_size[0], 3), PAD_GREY, np.uint8)
        # Run once: the layout of a dynamic export shows only now, and the first picture is not slower than
        # the rest.
        blank = np.zeros((1, 3, self.input_size[1], self.input_size[0]), self._dtype)
        try:
            output = self._run(blank)
            self._layout = layout_of(output.shape, len(self.names) or None, self._task)
        except ValueError as error:
            raise ModelError(
                f"{self._path}: {error}; metadata: {self._metadata or 'none'}; export it for detection"
            ) from error
        if not self.names and self._layout == "raw":
            self.names = {
                number: str(number) for number in range(output.shape[1] - 4 - (self._task == "obb"))
            }

    def detect(self, image_bgr: Image) -> Detections:
        """The animals in a picture (H, W, 3) uint8 BGR.

        Raises ValueError for another shape or type and ModelError when the network's output is mostly NaN.
        """
        if not isinstance(image_bgr, np.ndarray) or image_bgr.dtype != np.uint8:
            found = getattr(image_bgr, "dtype", type(image_bgr).__name__)
            raise ValueError(f"the picture is {found}; an array of uint8 is needed, BGR from 0 to 255")
        if image_bgr.ndim != 3 or image_bgr.shape[2] != 3 or min(image_bgr.shape[:2]) < 2:
            raise ValueError(f"the picture has shape {image_bgr.shape}; (height, width, 3) is needed, BGR")
        timings = {"prepare": 0.0, "infer": 0.0, "decode": 0.0}
        height, width = image_bgr.shape[:2]
        found = [self._look(image_bgr, timings)]
        for left, top, right, bottom in tile_windows((width, height), self._tile, self.input_size):
            piece = self._look(image_bgr[top:bottom, left:right], timings)
            piece = drop_cut(piece, (left, top, right, bottom), (width, height))
            found.append(piece._replace(boxes=piece.boxes + _row(left, top, left, top)))
        begun = time.perf_counter()
        merged = Candidates(
            np.concatenate([look.boxes for look in found]),
            np.concatenate([look.scores for look in found]),
            np.concatenate([look.classes for look in found]),
        )
        kept = suppress(merged, self._confidence, self._iou)
        boxes = np.clip(kept.boxes, 0, _row(width, height, width, height)).astype(np.float32)
        real = np.all(boxes[:, 2:] > boxes[:, :2], axis=1)
        timings["decode"] += (time.perf_counter() - begun) * 1e3
        return Detections(
            boxes[real], kept.scores[real].astype(np.float32), kept.classes[real], self.names, timings
        )

    def _look(self, image: Image, timings: dict[str, float]) -> Candidates:
        """The network's candidates for one picture, in its pixels, before the overlaps go."""
        begun = time.perf_counter()
        tensor, scale, left, top = self._prepare(image)
        prepared = time.perf_counter()
        timings["prepare"] += (prepared - begun) * 1e3
        if tensor is None:
            empty = np.zeros(0, np.float32)
            return Candidates(np.zeros((0, 4), np.float32), empty, np.zeros(0, np.int64))
        output = self._run(tensor)
        inferred = time.perf_counter()
        timings["infer"] += (inferred - prepared) * 1e3
        decode = decode_raw if self._layout == "raw" else decode_finished
        try:
            found = decode(output, self._confidence, self._task)
        except ModelError as error:
            raise ModelError(f"{self._path}: {error}") from error
        if self._classes is not None:
            found = found.take(np.isin(found.classes, self._classes))
        boxes = (found.boxes - _row(left, top, left, top)) / np.float32(scale)
        timings["decode"] += (time.perf_counter() - inferred) * 1e3
        return found._replace(boxes=boxes)

    def _prepare(self, image: Image) -> tuple[NDArray[np.generic] | None, float, int, int]:
        """(tensor (1, 3, H, W) RGB 0-1, scale, left, top) of the letterboxed picture; no tensor where it is
        flat.
        """
        width, height = self.input_size
        scale = min(width / image.shape[1], height / image.shape[0])
        size = (max(round(image.shape[1] * scale), 1), max(round(image.shape[0] * scale), 1))
        # Shrinking by area keeps waves from turning into false patterns; enlarging needs none of that.
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        small = cv2.resize(image, size, interpolation=how)
        if int(small.max()) - int(small.min()) < FLAT_LEVELS:
            return None, scale, 0, 0
        left, top = (width - size[0]) // 2, (height - size[1]) // 2
        self._canvas[:] = PAD_GREY
        self._canvas[top : top + size[1], left : left + size[0]] = small
        tensor = cv2.dnn.blobFromImage(self._canvas, 1 / 255, swapRB=True)
        return tensor.astype(self._dtype, copy=False), scale, left, top

    def _run(self, tensor: NDArray[np.generic]) -> NDArray[np.float32]:
        try:
            output = self._session.run(self._outputs, {self._input: tensor})[0]
        except (
            Exception
        ) as error:  # onnxruntime raises a dozen types of its own, all of them the model's fault
            raise ModelError(f"{self._path}: the model does not run: {error}; export it again") from error
        return np.asarray(output, np.float32)

    def _read_names(self) -> dict[int, str]:
        """Class names from the metadata: a Python dict (or list) as text."""
        text = self._metadata.get("names")
        if text is None:
            return {}
        try:
            names = ast.literal_eval(text)
            pairs = names.items() if isinstance(names, dict) else enumerate(names)
            return {int(number): str(name) for number, name in pairs}
        except (ValueError, SyntaxError, TypeError) as error:
            raise ModelError(
                f"{self._path}: metadata names is {text!r}, not a Python dict as text; export the model again"
            ) from error

    def _read_input(self) -> tuple[int, int]:
        """(width, height) that the network takes; also notes its input's name and type."""
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        self._input, self._outputs = inputs[0].name, [outputs[0].name]
        types = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
        shape = list(inputs[0].shape)
        if len(inputs) != 1 or inputs[0].type not in types or len(shape) != 4 or shape[1] not in (3, "3"):
            described = ", ".join(f"{item.name} {item.type} {item.shape}" for item in inputs)
            raise ModelError(
                f"{self._path}: the model's input is {described}; float (1, 3, height, width) is needed"
            )
        self._dtype = types[inputs[0].type]
        sides = shape[2:]
        if not all(
            isinstance(side, int) for side in sides
        ):  # a dynamic export: the metadata says what it is for
            try:
                said = ast.literal_eval(self._metadata.get("imgsz", "[640, 640]"))
                sides = [int(side) for side in (said if isinstance(said, (list, tuple)) else (said, said))]
            except (ValueError, SyntaxError, TypeError) as error:
                raise ModelError(
                    f"{self._path}: metadata imgsz {self._metadata['imgsz']!r} is not [height, width]"
                ) from error
        return int(sides[1]), int(sides[0])


def _row(*values: float) -> NDArray[np.float32]:
    return np.array(values, np.float32)


def _model_file(model_path: str | Path | None) -> Path:
    if model_path is None:
        try:
            return models.path("detector.onnx")
        except FileNotFoundError as error:
            raise ModelError(f"{error}; install podwatch again, or give a model of your own") from error
    path = Path(model_path)
    if not path.is_file():
        raise ModelError(
            f"{path}: no such model file; give the path of an ONNX file, or none for the one that ships"
        )
    return path


def open_session(path: Path) -> onnxruntime.InferenceSession:
    """A model file, to run on one thread of the processor. Raises ModelError."""
    if path.stat().st_size == 0:
        raise ModelError(f"{path}: the model file is empty; copy or export it again")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = (
        1  # the other cores belong to the other processes
    )
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # errors come as exceptions; the library would print them as well
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # see _run
        raise ModelError(
            f"{path}: not a model that onnxruntime loads ({error}); export it as ONNX again"
        ) from error
