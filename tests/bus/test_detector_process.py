"""The detector as a real process on a real bus: a bad model at the start, and a new one on SIGHUP."""

import json
import os
import secrets
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import SharedFrames
from lcmtypes import channels, make
from lcmtypes.podwatch import detections_t, frame_t, heartbeat_t
from procs.settings import DriverSpec
from tests.bus.process_bench import Bench
from tests.unit.detector_networks import network, raw

ONE = raw((32, 32, 10, 10, 0.9))
THREE = raw((8, 32, 9, 9, 0.9), (32, 32, 9, 9, 0.9), (56, 32, 9, 9, 0.9))


class DetectorBench(Bench):
    """A detector process, a frame ring to show it pictures, and what it says."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.model = folder / "model.onnx"
        run = f"test{secrets.token_hex(4)}"
        self.ring = SharedFrames(run, 2)
        self.settings = self.settings.model_copy(
            update={
                "drivers": {
                    "frames": DriverSpec(
                        driver="drivers.frames:SharedFrames", options={"run": run, "drone_id": 2}
                    ),
                    "detector": DriverSpec(
                        driver="procs.detector.yolo:Detector", options={"model_path": str(self.model)}
                    ),
                }
            }
        )
        self.found: list[detections_t] = []
        self.bus.subscribe(
            channels.DETECTIONS, lambda _name, data: self.found.append(detections_t.decode(data))
        )
        self._random = np.random.default_rng(0)
        self._number = 0

    def start_detector(self) -> None:
        self.start("-m", "procs.main", "detector", "SETTINGS")

    def show(self) -> int:
        """Boxes found in one more frame, a second later by the camera's clock."""
        picture = self._random.integers(0, 255, (480, 640, 3), dtype=np.uint8)
        self._number += 1
        ring, token, slot = self.ring.write(picture, self._number)
        frame = make(frame_t, utime=1_000_000 * self._number, seq=self._number, drone_id=2)
        frame.ring, frame.token, frame.slot, frame.width, frame.height = ring, token, slot, 640, 480
        self.bus.publish(channels.FRAME, frame.encode())
        self.await_that(lambda: self.found and self.found[-1].frame_seq == self._number)
        return self.found[-1].n_boxes

    def await_beat(self, status: int) -> heartbeat_t:
        """The next heartbeat of that status."""
        n_heard = len(self.beats)
        self.await_that(lambda: any(beat.status == status for beat in self.beats[n_heard:]))
        return next(beat for beat in self.beats[n_heard:] if beat.status == status)

    def hang_up(self) -> None:
        assert self.process is not None
        os.kill(self.process.pid, signal.SIGHUP)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[DetectorBench]:
    made = DetectorBench(tmp_path)
    yield made
    made.ring.close()
    if made.process is not None and made.process.poll() is None:
        made.process.kill()
        made.process.communicate()


def test_a_new_model_on_sighup_and_a_bad_one_that_changes_nothing(bench: DetectorBench) -> None:
    network(bench.model, ONE)
    bench.start_detector()
    bench.await_that(lambda: bench.beats)
    pid = bench.beats[0].pid
    assert bench.show() == 1
    network(bench.model, THREE)
    bench.hang_up()
    bench.await_that(lambda: bench.show() == 3)
    bench.model.write_bytes(b"")
    bench.hang_up()
    beat = bench.await_beat(heartbeat_t.DEGRADED)
    assert "the new model is not used, the old one stays" in beat.detail
    assert "model.onnx: the model file is empty" in beat.detail
    assert bench.show() == 3, "it goes on with the old one"
    network(bench.model, ONE)
    bench.hang_up()
    bench.await_that(lambda: bench.show() == 1)
    assert bench.await_beat(heartbeat_t.OK).pid == pid, "the same process on the same bus"
    assert [beat.seq for beat in bench.beats] == list(range(len(bench.beats))), "not one beat was lost"


def test_sighup_reads_the_settings_again_and_survives_bad_ones(bench: DetectorBench) -> None:
    """Another model file, then a settings file that is none."""
    network(bench.model, ONE)
    bench.start_detector()
    bench.await_that(lambda: bench.beats)
    assert bench.show() == 1
    settings = bench.settings_path
    data = json.loads(settings.read_text())
    data["drivers"]["detector"]["options"]["model_path"] = str(
        network(bench.model.with_name("other.onnx"), THREE)
    )
    settings.write_text(json.dumps(data))
    bench.hang_up()
    bench.await_that(lambda: bench.show() == 3)
    settings.write_text("{")
    bench.hang_up()
    beat = bench.await_beat(heartbeat_t.DEGRADED)
    assert "drone.json: " in beat.detail
    assert "the old settings stay in force" in beat.detail
    assert bench.show() == 3


@pytest.mark.parametrize("kind", ["missing", "empty", "other"])
def test_a_bad_model_at_the_start_ends_with_code_3_and_the_remedy(bench: DetectorBench, kind: str) -> None:
    if kind == "empty":
        bench.model.write_bytes(b"")
    if kind == "other":
        network(bench.model, np.zeros((1, 1000), np.float32))
    bench.start_detector()
    code, said = bench.end()
    assert code == 3
    assert said.count("\n") == 1, said
    assert said.startswith("detector: ")
    assert "model.onnx: " in said
    remedies = {"missing": "give the path", "empty": "copy or export", "other": "export it for detection"}
    assert remedies[kind] in said
