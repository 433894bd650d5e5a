"""Every corruption of the input stream is survived, by the Detector alone and by a drone's processes."""

from typing import Any

import numpy as np
import pytest

from procs.detector.yolo import Detections, Detector
from tests.unit.detector_networks import blob_network
from tools.bench.detection_corruptions import Corruption, corruptions, why_not

TABLE = corruptions()


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    return Detector(blob_network(tmp_path_factory.mktemp("model") / "blobs.onnx"))


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    """Dim water with something bright and red in it."""
    made = np.random.default_rng(0).integers(20, 90, (240, 320, 3), dtype=np.uint8)
    made[100:150, 120:200, 2] = 250
    return made


def test_the_table_has_64_rows_of_different_names() -> None:
    assert len(TABLE) == len({one.name for one in TABLE}) == 64


@pytest.mark.parametrize("corruption", TABLE, ids=lambda one: one.name)
def test_a_corruption_is_survived(corruption: Corruption, detector: Detector, picture: np.ndarray) -> None:
    assert why_not(corruption, detector, picture) == ""


class Fragile:
    """A detector that one black picture spoils for good, in one way or another."""

    warning = ""

    def __init__(self, sound: Detector, way: str) -> None:
        self._sound, self._way, self._is_spoilt = sound, way, False
        self.network: Any = sound.network
        self.animal_px: float | None = None

    def detect(self, image: np.ndarray) -> Detections:
        self._is_spoilt |= image.max() == 0
        if self._is_spoilt and self._way == "dies":
            raise KeyError("spoilt")
        found = self._sound.detect(image)
        if self._is_spoilt and self._way == "blind":
            return Detections(found.boxes[:0], found.scores[:0], found.classes[:0], found.names)
        return found


@pytest.mark.parametrize(("way", "why"), [("dies", "KeyError"), ("blind", "finds something else")])
def test_what_is_not_survived_is_named(way: str, why: str, detector: Detector, picture: np.ndarray) -> None:
    fragile: Any = Fragile(detector, way)
    assert why in why_not(TABLE[0], fragile, picture)


def test_a_trouble_that_no_heartbeat_tells_is_not_survived(detector: Detector, picture: np.ndarray) -> None:
    silent = Corruption("silent", "picture", "on fire", lambda good, _random: good[::-1])
    assert "no heartbeat said 'on fire'" in why_not(silent, detector, picture)


def test_good_frames_in_which_nothing_is_found_are_no_proof(detector: Detector, picture: np.ndarray) -> None:
    blind = Corruption("blind", "frame", "", lambda frame: [])
    assert why_not(blind, detector, picture) == ""
    assert "good frames, and the detector found boxes: [0, 0" in why_not(blind, detector, picture // 2)


def test_the_shipped_model_survives_what_it_answers_itself() -> None:
    from tools.bench.detection_corruptions import good_picture

    shipped = Detector()
    for one in TABLE[::13]:
        assert why_not(one, shipped, good_picture()) == "", one.name
