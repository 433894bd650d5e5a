"""The detector's shell in virtual time: which frames it searches, what it says of them, and a new model in
flight.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcmtypes import channels, make
from lcmtypes.podwatch import frame_t, heartbeat_t, vehicle_state_t
from procs.detector.process import setup
from procs.detector.yolo import Detections, Detector, ModelError
from procs.runtime import RuntimeFailure
from procs.settings import CameraSettings, DroneSettings, Mission, WatchSettings
from tests.fleet.bad_inputs import Bench
from tests.unit.detector_networks import blob_network, network, raw


class Recorder:
    """A detector that notes what it was told and finds one animal in everything."""

    def __init__(self) -> None:
        self.animal_px: float | None = None
        self.told: list[float | None] = []
        self.n_repeats = 0

    def detect(self, image: np.ndarray) -> Detections:
        self.told.append(self.animal_px)
        box = np.array([[10, 20, 30, 40]], np.float32)
        one = np.ones(1, np.float32)
        return Detections(box, one, one.astype(np.int64), {}, n_repeats=self.n_repeats)


def bench(detector: Any) -> Bench:
    return Bench("detector", setup, {"detector": detector})


def show(bench: Bench, number: int, image: np.ndarray | None = None) -> None:
    """Frame `number`, a fifth of a second after the last."""
    picture = np.zeros((480, 640, 3), np.uint8) if image is None else image
    ring, token, slot = bench.drivers["frames"].write(picture, number)
    height, width = picture.shape[:2]
    frame = make(frame_t, seq=number, ring=ring, token=token, slot=slot, width=width, height=height)
    bench.say(channels.FRAME, frame)
    bench.run(0.2)


def fly_at(bench: Bench, height_m: float, position_ok: bool = True) -> None:
    bench.say(channels.VEHICLE_STATE, make(vehicle_state_t, d_m=-height_m, position_ok=position_ok))


def test_it_knows_from_height_and_lens_how_long_an_animal_is() -> None:
    """480 px over 60 degrees: a focal length of 415.7 px, so 10 m are 104 px from 40 m, 52 px from 80 m."""
    detector = Recorder()
    drone = bench(detector)
    drone.run(1.0)
    show(drone, 0)
    for number, height_m in enumerate((40.0, 80.0, 1.0), start=1):
        fly_at(drone, height_m)
        show(drone, number)
    fly_at(drone, 40.0)
    drone.run(0.01)
    fly_at(drone, 80.0, position_ok=False)
    show(drone, 4)
    drone.run(3.0)
    show(drone, 5)
    assert detector.told[0] is None, "nobody has said how high it is"
    assert detector.told[1:3] == pytest.approx([103.9, 51.96], abs=0.1)
    assert detector.told[3] is None, "it stands on the ground"
    assert detector.told[4] == pytest.approx(103.9, abs=0.1), "a position that is not ok says nothing"
    assert detector.told[5] is None, "the height is too old"


def test_another_species_has_another_length() -> None:
    """4 m from 40 m, through a lens of 60 and one of 90 degrees: 415.7 and 240 px of focal length."""
    detector = Recorder()
    drone = bench(detector)
    drone.run(1.0)
    for number, vfov_deg in enumerate((60.0, 90.0)):
        mission = Mission(watch=WatchSettings(animal_length_m=4.0), camera=CameraSettings(vfov_deg=vfov_deg))
        drone.runtime.reload(DroneSettings(drone_id=1, mission=mission))
        fly_at(drone, 40.0)
        show(drone, number)
    assert detector.told == pytest.approx([41.57, 24.0], abs=0.01)


def test_a_camera_that_hangs_for_a_second_gets_no_answer() -> None:
    detector = Recorder()
    drone = bench(detector)
    drone.run(1.0)
    fly_at(drone, 40.0)
    for number in range(10):
        detector.n_repeats = number
        show(drone, number)
    assert drone.count(channels.DETECTIONS) == 5, "less than a second: it may be chance"
    drone.run(1.0)
    assert drone.beat.status == heartbeat_t.DEGRADED
    assert "the camera gives the same picture for 1.8 s" in drone.beat.detail
    detector.n_repeats = 0
    show(drone, 10)
    drone.run(1.0)
    assert drone.count(channels.DETECTIONS) == 6
    assert drone.beat.status == heartbeat_t.OK


@pytest.mark.parametrize("has_autopilot", [True, False])
def test_on_the_ground_and_on_a_bench_a_view_may_lie_still(has_autopilot: bool) -> None:
    detector = Recorder()
    drone = bench(detector)
    drone.run(1.0)
    if has_autopilot:
        drone.say(channels.VEHICLE_STATE, make(vehicle_state_t, position_ok=True, landed=True))
    for number in range(10):
        detector.n_repeats = number
        show(drone, number)
    assert drone.count(channels.DETECTIONS) == 10
    assert drone.beat.status == heartbeat_t.OK


def test_an_autopilot_that_falls_silent_in_the_air_leaves_the_drone_in_the_air() -> None:
    detector = Recorder()
    drone = bench(detector)
    drone.run(1.0)
    fly_at(drone, 40.0)
    drone.run(5.0)
    for number in range(10):
        detector.n_repeats = number
        show(drone, number)
    assert drone.count(channels.DETECTIONS) == 5


def test_a_drone_that_takes_off_has_a_second_to_see_another_picture() -> None:
    detector = Recorder()
    drone = bench(detector)
    drone.run(1.0)
    for number in range(20):
        detector.n_repeats = number
        if number == 10:
            fly_at(drone, 3.0)
        show(drone, number)
    assert 14 <= drone.count(channels.DETECTIONS) <= 15, "ten on the ground, and a second's"


def test_what_is_wrong_with_a_picture_goes_to_the_heartbeat(tmp_path: Path) -> None:
    detector = Detector(network(tmp_path / "raw.onnx", raw((32, 32, 10, 10, 0.9))))
    drone = bench(detector)
    drone.run(1.0)
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    noise[240:] = 0
    show(drone, 0, noise)
    drone.run(1.0)
    assert "50 % of the picture's rows are empty" in drone.beat.detail
    assert drone.heard[channels.DETECTIONS][-1].n_boxes == 1, "the rest is searched"


def test_where_it_runs_elsewhere_than_asked_the_heartbeat_says_so(tmp_path: Path) -> None:
    with pytest.warns(RuntimeWarning, match="openvino"):
        detector = Detector(network(tmp_path / "raw.onnx", raw((32, 32, 10, 10, 0.9))), provider="openvino")
    drone = bench(detector)
    drone.run(1.0)
    assert drone.beat.status == heartbeat_t.DEGRADED
    assert "provider 'openvino'" in drone.beat.detail
    show(drone, 0, np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8))
    assert drone.count(channels.DETECTIONS) == 1


def test_a_new_model_is_taken_and_a_bad_one_leaves_the_old_at_work(tmp_path: Path) -> None:
    """One model finds one animal in everything, the next one three."""
    path = tmp_path / "model.onnx"
    one, three = raw((32, 32, 10, 10, 0.9)), raw((8, 32, 9, 9, 0.9), (32, 32, 9, 9, 0.9), (56, 32, 9, 9, 0.9))
    random = np.random.default_rng(0)

    def found(number: int) -> int:
        show(drone, number, random.integers(0, 255, (480, 640, 3), dtype=np.uint8))
        return int(drone.heard[channels.DETECTIONS][-1].n_boxes)

    network(path, one)
    drone = bench(lambda: Detector(path))
    drone.run(1.0)
    settings = DroneSettings(drone_id=1, mission=Mission())
    assert found(0) == 1
    network(path, three)
    assert found(1) == 1, "nobody asked for it yet"
    drone.runtime.reload(settings)
    assert found(2) == 3
    path.write_text("no network")
    drone.runtime.reload(settings)
    assert found(3) == 3
    drone.run(1.0)
    assert "the new model is not used, the old one stays: " in drone.beat.detail
    assert "model.onnx: not a model that onnxruntime loads" in drone.beat.detail
    network(path, one)
    drone.runtime.reload(settings)
    assert found(4) == 1
    drone.run(1.0)
    assert drone.beat.status == heartbeat_t.OK


def test_new_settings_are_in_force_at_once() -> None:
    drone = bench(Recorder())
    drone.run(1.0)
    for number in range(5):
        show(drone, number)
    assert drone.count(channels.DETECTIONS) == 5
    slower = DroneSettings(drone_id=1, mission=Mission(camera=CameraSettings(detect_hz=1.0)))
    drone.runtime.reload(slower)
    for number in range(5, 15):
        show(drone, number)
    assert drone.count(channels.DETECTIONS) == 7


def test_a_bad_model_at_the_start_ends_the_process(tmp_path: Path) -> None:
    with pytest.raises(RuntimeFailure, match=r"gone\.onnx: no such model file"):
        bench(lambda: Detector(tmp_path / "gone.onnx"))


def test_a_detector_that_cannot_be_made_again_leaves_the_old_at_work(
    tmp_path: Path,
) -> None:
    made: list[Detector] = []

    def make_detector() -> Detector:
        if made:
            raise ModelError("it went away")
        made.append(Detector(blob_network(tmp_path / "blobs.onnx")))
        return made[0]

    drone = bench(make_detector)
    drone.runtime.reload(DroneSettings(drone_id=1, mission=Mission()))
    drone.run(1.1)
    assert "the old one stays: it went away" in drone.beat.detail
