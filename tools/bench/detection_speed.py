"""Milliseconds of a picture of 1280x720 px in the detector, on one thread: made to fit, looked at, decoded.

    python -m tools.bench.detection_speed [MODEL.onnx]

The picture is a rendered sea with whales, so that there are boxes to make; it comes as a fresh copy, as out
of the frame ring. Each figure is the least of several medians: what the machine does beside it makes some of
them longer, never shorter.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose
from drivers.sim.render import AnimalView, SeaRenderer
from procs.detector.yolo import Detector

__all__ = ["picture_720p", "speed"]

ROUNDS = 7
PICTURES_A_ROUND = 30
SEED = 5


def speed(model_path: str | Path | None = None) -> dict[str, float]:
    """ms: prepare, infer, decode, and outside = prepare + decode; each the least of the rounds' medians.

    outside is measured as a whole: its parts' least medians may come from different rounds. boxes: how many
    were found in the picture.
    """
    cv2.setNumThreads(1)
    detector = Detector(model_path)
    picture = picture_720p()
    parts = ("prepare", "infer", "decode")
    rounds = []
    for _ in range(ROUNDS):
        timings = [detector.detect(picture.copy()).timings for _ in range(PICTURES_A_ROUND)]
        table = np.array([[timing[part] for part in parts] for timing in timings])
        rounds.append(np.median(np.column_stack([table, table[:, 0] + table[:, 2]]), axis=0))
    least = np.min(rounds, axis=0).tolist()
    boxes = float(len(detector.detect(picture)))
    return {**dict(zip((*parts, "outside"), least, strict=True)), "boxes": boxes}


def picture_720p() -> NDArray[np.uint8]:
    """(720, 1280, 3) uint8 BGR: four whales seen from 30 m."""
    camera = Pinhole((1280, 720), float(np.radians(60.0)))
    whales = [AnimalView(k + 1, 9.0 * k - 14.0, 3.0 * (k % 2), 0.5 * k, 11.0) for k in range(4)]
    return SeaRenderer(SEED, water="atlantic").render(camera, Pose(0.0, 0.0, -30.0), 0.0, whales)


def main() -> None:
    """Print the figures."""
    for name, value in speed(sys.argv[1] if len(sys.argv) > 1 else None).items():
        print(f"{name:8} {value:7.3f}")


if __name__ == "__main__":
    main()
