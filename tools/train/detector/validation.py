"""How well an exported model finds the animals of your own pictures that data.yaml keeps back as `val`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from procs.detector.yolo import CONFIDENCE, Detector
from tools.train.detector.own import learnt_as_well, validation_pictures
from tools.train.detector.scores import average_precision, match

__all__ = ["count_validation", "measure"]

LEAST_SCORE = 0.01  # average precision needs the low scores too
SMALL_PX = 16  # in the network's input; the detector looks at such animals in tiles


def count_validation(data: Path, classes: Sequence[str]) -> int:
    """How many pictures there are to measure on; each is read once, so that none is found unfit after hours.

    Says so where there are none. Raises UnusableError naming what is wrong.
    """
    count = sum(1 for _ in validation_pictures(data, classes))
    if not count:
        print(f"{data}: its val names no pictures; nothing will be measured on them", flush=True)
    return count


def measure(model: Path, data: Path, classes: Sequence[str]) -> str:
    """One line of recall, precision and AP50 on the pictures of `val`, each looked at as a whole."""
    detector = Detector(model, confidence=LEAST_SCORE)
    results: list[tuple[float, bool]] = []
    pictures = animals = small = 0
    for picture in validation_pictures(data, classes):
        results += match(detector.detect(picture.image), picture.boxes)
        height, width = picture.image.shape[:2]
        scale = min(detector.input_size[0] / width, detector.input_size[1] / height)
        lengths_px = (picture.boxes[:, 2:4] - picture.boxes[:, :2]).max(axis=1, initial=0) * scale
        pictures, animals = pictures + 1, animals + len(picture.boxes)
        small += int(np.sum(lengths_px < SMALL_PX))
    sure = [right for score, right in results if score >= CONFIDENCE]
    recall = f"{sum(sure) / animals:.3f}" if animals else "none"
    precision = f"{sum(sure) / len(sure):.3f}" if sure else "none"
    learnt = learnt_as_well(data, classes)
    told = f" ({learnt} learnt as well)" if learnt else ""
    return (
        f"val of {data}, n = {pictures} pictures{told} with {animals} animals ({small} under {SMALL_PX} px "
        f"at the network's size): recall {recall} and precision {precision} at confidence {CONFIDENCE}, "
        f"AP50 {average_precision(results, animals):.3f}"
    )
