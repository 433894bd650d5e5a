"""The mission's table [detector], and how it reaches the detector of a drone."""

from pathlib import Path

import pytest

from procs.bus_executor import load_driver
from procs.detector.yolo import Detector
from procs.settings import DetectorSettings, DriverSpec, MissionError
from tests.unit.detector_networks import NAMES, PICTURE, network, raw
from tools.fleet.machine import drone_settings, read_fleet
from tools.sim.flight import read_mission

FLEET = """
[detector]
model = "own.onnx"
confidence = 0.5
classes = ["whale"]
tile = 48
provider = "cpu"

[[drones]]
id = 1
[drones.machine]
radio = "10.0.0.1:14600"
"""


def test_a_fleet_files_model_and_thresholds_are_the_detectors(tmp_path: Path) -> None:
    """Two classes, one of them asked for; what is found at 0.4 is not said."""
    names = {**NAMES, "names": "{0: 'boat', 1: 'whale'}"}
    rows = [(10, 10, 9, 9, 0.9, 0.0), (30, 30, 9, 9, 0.0, 0.8), (50, 50, 9, 9, 0.0, 0.4)]
    network(tmp_path / "own.onnx", raw(*rows), names)
    (tmp_path / "fleet.toml").write_text(FLEET)
    mission = read_fleet(tmp_path / "fleet.toml")
    settings = drone_settings(
        mission, 1, bus_url="", run="test", run_dir=tmp_path, log_path=tmp_path / "log.mcap"
    )
    detector = load_driver(settings.drivers["detector"])
    found = detector.detect(PICTURE)
    assert {found.names[number] for number in found.classes.tolist()} == {"whale"}
    assert found.scores.min() > 0.5
    assert found.n_looks == 5, "the whole and four tiles"


def test_a_simulated_missions_model_lies_beside_its_file(tmp_path: Path) -> None:
    (tmp_path / "mission.toml").write_text('[detector]\nmodel = "own.onnx"\n')
    mission = read_mission(str(tmp_path / "mission.toml"))
    assert mission.detector.model == str(tmp_path / "own.onnx")
    assert read_mission("default").detector.model == "", "none named: the one that ships"


def test_what_no_table_says_is_the_detectors_own_default() -> None:
    options = DetectorSettings().options()
    assert options == {
        "model_path": None,
        "confidence": 0.25,
        "iou": 0.45,
        "classes": None,
        "tile": "auto",
        "tile_limit_ms": 100.0,
        "provider": "cpu",
    }
    detector = load_driver(DriverSpec(driver="procs.detector.yolo:Detector", options=options))
    assert isinstance(detector, Detector)
    assert DetectorSettings(tile="off").options()["tile"] is None


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("tile = 8", ("tile = 8", '"auto", "off", or 32 to 8192 px')),
        ('provider = "npu"', ("detector.provider", "'openvino'", "'npu'")),
        ("confidence = 0", ("detector.confidence", "greater than or equal to 0.01")),
        ("clases = [1]", ("detector.clases", "did you mean 'classes'")),
    ],
)
def test_a_table_that_cannot_be_is_refused(tmp_path: Path, line: str, words: tuple[str, ...]) -> None:
    (tmp_path / "fleet.toml").write_text(f"[detector]\n{line}\n")
    with pytest.raises(MissionError) as caught:
        read_fleet(tmp_path / "fleet.toml")
    assert [word for word in words if word not in str(caught.value)] == [], str(caught.value)
