"""A model is measured on the pictures that data.yaml keeps back, and only where there are any."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from procs.detector.yolo import Detections
from tools.errors import UnusableError
from tools.train.detector import validation
from tools.train.detector.validation import count_validation, measure


class Looker:
    """Finds the left animal of each picture surely and exactly, water with some doubt, and little more."""

    input_size = (320, 320)

    def __init__(self, model: Path, confidence: float) -> None:
        assert (model.name, confidence) == ("detector.onnx", 0.01), "low scores count in AP50"

    def detect(self, image: Any) -> Detections:
        boxes = np.array([[64, 48, 192, 144], [500, 400, 600, 450], [300, 300, 330, 315]], np.float32)
        scores = np.array([0.9, 0.5, 0.02], np.float32)
        return Detections(boxes, scores, np.zeros(3, np.int64), {0: "whale"})


def data_of(folder: Path, entries: str, *labels: str) -> Path:
    """A data.yaml with pictures of 640x480 px in `kept/images`, one for each text of labels."""
    for name in ("images", "labels"):
        (folder / "kept" / name).mkdir(parents=True)
    for index, text in enumerate(labels):
        cv2.imwrite(str(folder / "kept" / "images" / f"{index}.png"), np.full((480, 640, 3), 90, np.uint8))
        (folder / "kept" / "labels" / f"{index}.txt").write_text(text)
    (folder / "data.yaml").write_text(f"train: images\nnames: [whale]\n{entries}\n")
    return folder / "data.yaml"


def test_pictures_that_were_kept_back_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "Detector", Looker)
    left, right = "0 0.2 0.2 0.2 0.2\n", "0 0.8 0.3 0.04 0.04\n"  # the right one is 25.6 px long
    data = data_of(tmp_path, "val: kept/images", left + right, left, "")
    assert count_validation(data, ()) == 3
    # 2 of 3 animals; of 6 sure boxes two are right, and they come first.
    assert measure(tmp_path / "detector.onnx", data, ()) == (
        f"val of {data}, n = 3 pictures with 3 animals (1 under 16 px at the network's size): "
        "recall 0.667 and precision 0.333 at confidence 0.25, AP50 0.667"
    )


def test_pictures_without_animals_have_no_recall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "Detector", Looker)
    told = measure(tmp_path / "detector.onnx", data_of(tmp_path, "val: kept/images", ""), ())
    assert "n = 1 pictures with 0 animals" in told
    assert "recall none and precision 0.000" in told


def test_pictures_that_were_learnt_as_well_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "Detector", Looker)
    data = data_of(tmp_path, "", "", "")
    (tmp_path / "list.txt").write_text("kept/images/1.png\n")
    data.write_text("train: list.txt\nval: kept/images\nnames: [whale]\n")
    assert "n = 2 pictures (1 learnt as well) with" in measure(tmp_path / "detector.onnx", data, ())


@pytest.mark.parametrize("entries", ["", "val:", "val: ../valid/images"])
def test_where_nothing_is_kept_back_that_is_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], entries: str
) -> None:
    data = data_of(tmp_path, entries)
    assert count_validation(data, ()) == 0
    assert capsys.readouterr().out == f"{data}: its val names no pictures; nothing will be measured on them\n"


def test_pictures_of_no_use_are_refused_before_the_training(tmp_path: Path) -> None:
    with pytest.raises(UnusableError, match=r"1\.txt: line 1"):
        count_validation(data_of(tmp_path, "val: kept/images", "", "0 1 2 3\n"), ())
