"""Runs several detectors over the same labelled pictures once, and keeps what every figure needs."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from procs.detector.yolo import CONFIDENCE, Detections, Detector
from tools.render import Scene, scenes
from tools.train.detector.samples import WITH_EXTRAS, held_out, read_yolo, real_data
from tools.train.detector.scores import MATCH_IOU, average_precision, box_iou, match, match_animals

__all__ = [
    "CONFIDENCE",
    "CONFIDENCES",
    "Animal",
    "Tally",
    "held_out_photographs",
    "look",
    "open_detector",
    "rendered",
]

CONFIDENCES = (0.25, 0.4, 0.55)  # the paper's figure has three; it does not say which
LEAST = 0.01  # average precision needs the low scores too
SIDE = (640, 480)  # px, as the drones' cameras


@dataclass(frozen=True)
class Animal:
    """One animal that counts: with what score it was found (0: not), and how hard it was to see."""

    score: float
    long_px: float  # long side of its box in the network's input
    depth_m: float
    contrast: float
    glare: float
    sea_state: float
    on_grass: bool


@dataclass
class Tally:
    """What one detector made of one set of pictures."""

    animals: list[Animal] = field(default_factory=list)
    results: list[tuple[float, bool]] = field(
        default_factory=list
    )  # (score, is right) of every box that counts
    boxes_a_picture: list[NDArray[np.float64]] = field(default_factory=list)  # scores of those boxes
    animals_a_picture: list[int] = field(default_factory=list)
    faint: int = 0  # animals that show too little to count
    faint_found: int = 0  # by a box that found no animal that counts

    @property
    def pictures(self) -> int:
        return len(self.animals_a_picture)

    @property
    def n_animals(self) -> int:
        return sum(self.animals_a_picture)

    def counts(self, confidence: float = CONFIDENCE) -> tuple[int, int, int]:
        """(found, false alarms, missed) at a confidence."""
        found = sum(right for score, right in self.results if score >= confidence)
        false = sum(not right for score, right in self.results if score >= confidence)
        return found, false, self.n_animals - found

    def exact_share(self, confidence: float = CONFIDENCE) -> float:
        """Share of the pictures with as many boxes as animals."""
        pairs = zip(self.boxes_a_picture, self.animals_a_picture, strict=True)
        return sum(int((scores >= confidence).sum()) == count for scores, count in pairs) / max(
            self.pictures, 1
        )

    def average_precision(self) -> float:
        return average_precision(self.results, self.n_animals)


def look(detectors: Mapping[str, Detector], pictures: Iterable[Scene]) -> dict[str, Tally]:
    """Each detector over each picture, rendered once for all of them."""
    tallies = {name: Tally() for name in detectors}
    for scene in pictures:
        known = _known(scene.boxes, scene.faint)
        for name, detector in detectors.items():
            found, tally = detector.detect(scene.image), tallies[name]
            results, scores = match_animals(found, known)
            _add(tally, results, len(scene.boxes))
            tally.animals += list(_animals(scene, scores, detector.input_size))
            free = found.boxes[(found.scores >= CONFIDENCE) & ~_on_counted(found, scene.boxes, scores)]
            tally.faint += len(scene.faint)
            tally.faint_found += sum(_lies_in(box, free) for box in scene.faint)
    return tallies


def _add(tally: Tally, results: list[tuple[float, bool]], animals: int) -> None:
    tally.results += results
    tally.boxes_a_picture.append(np.array([score for score, _ in results], float))
    tally.animals_a_picture.append(animals)


def _known(counted: NDArray[np.float32], faint: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 5): boxes and 1 for those that count, 0 for the faint."""
    rows = [np.column_stack([part, np.full(len(part), flag)]) for part, flag in ((counted, 1), (faint, 0))]
    return np.concatenate(rows).astype(np.float32)


def _animals(scene: Scene, scores: NDArray[np.float32], input_size: tuple[int, int]) -> Iterator[Animal]:
    height, width = scene.image.shape[:2]
    scale = min(input_size[0] / width, input_size[1] / height)
    long_px = (scene.boxes[:, 2:] - scene.boxes[:, :2]).max(axis=1, initial=0) * scale
    rows = zip(scores, long_px, scene.depth_m, scene.contrast, strict=True)
    for score, length, depth, contrast in rows:
        yield Animal(
            float(score),
            float(length),
            float(depth),
            float(contrast),
            scene.conditions.glare,
            scene.conditions.sea_state,
            scene.kind == "grass",
        )


def _on_counted(
    found: Detections, counted: NDArray[np.float32], scores: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """(N,) which boxes are those that found an animal that counts, each with the score noted of it."""
    with_its_score = found.scores[:, None] == scores[None]
    return np.asarray((with_its_score & (box_iou(found.boxes, counted) >= MATCH_IOU)).any(axis=1))


def _lies_in(box: NDArray[np.float32], found: NDArray[np.float32]) -> bool:
    """Whether the middle of a box that was found lies in this one."""
    middle = (found[:, :2] + found[:, 2:]) / 2
    return bool(np.any(np.all((middle > box[:2]) & (middle < box[2:]), axis=1)))


def rendered(count: int, seed: int, split: str, animals: int | None = None) -> Iterator[Scene]:
    """Scenes as a drone's camera takes them."""
    cv2.setNumThreads(1)
    yield from scenes(count, seed, split, SIDE, animals=animals, camera_effects=True)


def held_out_photographs(detectors: Mapping[str, Detector]) -> dict[str, Tally]:
    """The fifth of the right whale photographs that the trainer never sees.

    Raises FileNotFoundError where they are missing.
    """
    folder = real_data() / "right_whales"
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no {folder}; PODWATCH_REAL_DATA may name the folder of real data")
    _, kept = held_out(sorted((folder / "images").glob("*.jpg")))
    tallies = {name: Tally() for name in detectors}
    for path, sample in zip(kept, read_yolo(kept, folder / "labels"), strict=True):
        for name, detector in detectors.items():
            results = match(detector.detect(sample.image), sample.boxes, path.stem in WITH_EXTRAS)
            _add(tallies[name], results, len(sample.boxes))
    return tallies


def open_detector(model: Path) -> Detector:
    """For measuring: every box that might count, whatever its score."""
    return Detector(model, confidence=LEAST)
