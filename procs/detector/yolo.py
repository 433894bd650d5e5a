"""Finds animals in a picture with an ONNX network in one of the layouts that Ultralytics exports.

    found = Detector().detect(image_bgr)      found.boxes (N, 4) float32 xyxy px, found.scores, found.classes

Ours ships as models/detector.onnx; any other detection model in these layouts is taken as it is.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

import models
from procs.detector.decode import Candidates, ModelError, best_first, decode, suppress
from procs.detector.letterbox import Letterbox
from procs.detector.network import PROVIDERS, Names, Network, open_session
from procs.detector.sight import Sight
from procs.detector.tiles import SeenLength, Tile, merge, owned, pieces, plan, shortfall

__all__ = ["CONFIDENCE", "Detections", "Detector", "ModelError", "open_session"]

Image = NDArray[np.uint8]
CONFIDENCE = 0.25  # least score of a find, where nobody asks for another
LOOKS_KEPT = 9  # whose median says how long a look takes


@dataclass(frozen=True)
class Detections:
    """What was found in one picture, best first."""

    boxes: NDArray[np.float32]  # (N, 4) xyxy px of the given picture
    scores: NDArray[np.float32]  # (N,) 0 to 1
    classes: NDArray[np.int64]  # (N,) keys of names
    names: dict[int, str]
    timings: dict[str, float] = field(default_factory=dict)  # ms: prepare, infer, decode
    n_looks: int = 1  # at the whole picture, and at its tiles
    trouble: str = ""  # what is wrong with the picture, or with the tiles it is cut into, for people
    n_repeats: int = 0  # pictures right before this one that were the same to the last bit

    def __len__(self) -> int:
        return len(self.scores)


class Detector:
    """One network, loaded once; `detect` may be called for any number of pictures of any size.

    model_path: an ONNX file, None for the one that ships. confidence: least score. iou: overlap above which
    the lesser of two boxes goes. classes: numbers or names of the classes to report, None for all. tile: None
    looks at the whole picture once; a number also looks at overlapping tiles of that many px; "auto" does so
    where animals would be too small (procs.detector.tiles.plan), as far as `tile_limit_ms` allows. provider:
    "cpu", "cuda", "tensorrt" or "openvino"; one that is not there is told in `warning`. look_ms: what a look
    takes, for "auto"; None measures it, and then the number of tiles follows the machine's mood.

    `animal_px` may be set at any time: how long an animal is in the pictures to come, px, None where that is
    to be learnt from the boxes.

    Raises ModelError when the file is missing, empty, broken or of another layout; ValueError for bad
    settings.
    """

    def __init__(
        self,
        model_path: str | Path | None = None,
        confidence: float = CONFIDENCE,
        iou: float = 0.45,
        classes: Sequence[int | str] | None = None,
        tile: int | Literal["auto"] | None = None,
        *,
        tile_limit_ms: float = 100.0,
        provider: str = "cpu",
        look_ms: float | None = None,
    ) -> None:
        for name, value in (("confidence", confidence), ("iou", iou)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name} {value}: must lie between 0 and 1")
        if tile is not None and tile != "auto" and (isinstance(tile, str) or tile < 32):
            raise ValueError(f"tile {tile!r}: must be None, 'auto' or at least 32 px")
        if not tile_limit_ms > 0 or (look_ms is not None and not look_ms > 0):
            raise ValueError(f"tile_limit_ms {tile_limit_ms}, look_ms {look_ms}: must be above 0")
        if provider not in PROVIDERS:
            raise ValueError(f"provider {provider!r}: must be one of {', '.join(PROVIDERS)}")
        self.network = Network(_model_file(model_path), provider)
        self.names: dict[int, str] = self.network.names
        self.input_size = self.network.input_size
        self.warning = self.network.warning
        self.animal_px: float | None = None
        self._confidence, self._iou, self._tile = confidence, iou, tile
        self._tile_limit_ms, self._given_look_ms = tile_limit_ms, look_ms
        self._classes = _numbers(classes, self.network.names)
        stretch = self.network.layout.kind == "queries"  # RT-DETR learns from stretched pictures
        self._letterbox = Letterbox(self.input_size, self.network.dtype, stretch)
        self._sight = Sight()
        self._seen_length = SeenLength()
        self._looks_ms: list[float] = []

    def detect(self, image_bgr: Image) -> Detections:
        """The animals in a picture (H, W, 3) uint8 BGR.

        Raises ValueError for another shape or type and ModelError when the network's output is mostly NaN.
        """
        image = _checked(image_bgr)
        timings = {"prepare": 0.0, "infer": 0.0, "decode": 0.0}
        height, width = image.shape[:2]
        whole = self._look(image, timings, is_whole=True)
        looks = []
        tiles = self._tiles((width, height))
        for tile in tiles:
            left, top, right, bottom = tile.window
            piece = self._look(image[top:bottom, left:right], timings)
            begun = time.perf_counter()
            piece = piece._replace(boxes=piece.boxes + np.array([left, top, left, top], np.float32))
            shrink = max((right - left) / self.input_size[0], (bottom - top) / self.input_size[1])
            piece = owned(piece, tile, (width, height), shrink)
            looks.append(piece.take(~pieces(piece, whole, min(right - left, bottom - top))))
            timings["decode"] += (time.perf_counter() - begun) * 1e3
        begun = time.perf_counter()
        # The whole comes last: where a tile has an animal too, it has it larger.
        found = best_first(merge([*looks, whole])) if looks else whole
        limit = np.array([width, height, width, height], np.float32)
        boxes = np.minimum(np.maximum(found.boxes, 0), limit)
        real = ((boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])).nonzero()[0]
        boxes = boxes[real]
        if self._tile == "auto":
            self._seen_length.see(boxes)
        timings["decode"] += (time.perf_counter() - begun) * 1e3
        missed = shortfall(tiles, (width, height), self._tile, self.input_size, self.animal_px)
        return Detections(
            boxes,
            found.scores[real],
            found.classes[real],
            self.names,
            timings,
            1 + len(looks),
            "; ".join(filter(None, (self._sight.trouble, missed))),
            self._sight.n_repeats,
        )

    def _look(self, image: Image, timings: dict[str, float], is_whole: bool = False) -> Candidates:
        """What the network finds in one picture or tile, in its pixels."""
        begun = time.perf_counter()
        fitted = self._letterbox.fit(image)
        is_flat = self._sight.look(fitted.planes) if is_whole else self._sight.is_flat(fitted.planes)
        prepared = time.perf_counter()
        timings["prepare"] += (prepared - begun) * 1e3
        if is_flat:
            return Candidates(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int64))
        output = self.network.run(fitted.tensor)
        inferred = time.perf_counter()
        timings["infer"] += (inferred - prepared) * 1e3
        layout = self.network.layout
        try:
            found = decode(output, layout, self._confidence, self.input_size)
        except ModelError as error:
            raise ModelError(f"{self.network.path}: {error}") from error
        if self._classes is not None:
            found = found.take(np.isin(found.classes, self._classes))
        found = suppress(found, self._iou) if layout.kind == "raw" else best_first(found)
        found = Candidates(fitted.to_picture(found.boxes), found.scores, found.classes)
        done = time.perf_counter()
        timings["decode"] += (done - inferred) * 1e3
        self._looks_ms = [*self._looks_ms[1 - LOOKS_KEPT :], (done - begun) * 1e3]
        return found

    def _tiles(self, size: tuple[int, int]) -> list[Tile]:
        """The tiles to look at beside the whole picture."""
        if self._tile != "auto":
            return plan(size, self._tile, self.input_size)
        animal_px = self.animal_px if self.animal_px is not None else self._seen_length.ask()
        look_ms = self._given_look_ms
        if look_ms is None:
            look_ms = float(np.median(self._looks_ms)) if self._looks_ms else self._tile_limit_ms
        most = int(self._tile_limit_ms / look_ms) - 1  # the whole is a look too
        return plan(size, "auto", self.input_size, animal_px, most)


def _checked(image: Image) -> Image:
    """The picture, if it is one, as opencv can read it."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        found = getattr(image, "dtype", type(image).__name__)
        raise ValueError(f"the picture is {found}; an array of uint8 is needed, BGR from 0 to 255")
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 2:
        raise ValueError(f"the picture has shape {image.shape}; (height, width, 3) is needed, BGR")
    return np.ascontiguousarray(image)


def _numbers(classes: Sequence[int | str] | None, names: Names) -> NDArray[np.int64] | None:
    """Class numbers of what was asked for. Raises ValueError for a class that the model does not have."""
    if classes is None:
        return None
    by_name = {name: number for number, name in names.items()}
    numbers = [by_name.get(one, -1) if isinstance(one, str) else int(one) for one in classes]
    unknown = [one for one, number in zip(classes, numbers, strict=True) if names and number not in names]
    if unknown or -1 in numbers:
        have = ", ".join(f"{number} {name}" for number, name in names.items()) or "numbers alone"
        raise ValueError(f"classes {unknown or list(classes)}: the model has {have}")
    return np.array(sorted(numbers), np.int64)


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
