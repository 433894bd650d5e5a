"""Whether the detector lives through 64 corruptions of its input, and works again right after each.

    python -m tools.bench.detection_corruptions [MODEL.onnx]

Each is tried twice: on the Detector alone, which may refuse the picture with a ValueError or a ModelError,
and on the camera and detector processes of a drone in the air, in virtual time: good frames, 2.6 s of bad
ones, good frames. It is survived when nothing else is raised, both processes go on beating, a heartbeat says
what is wrong where it can be told, no heartbeat says so any more at the end, and animals are found again in
the first good frame and in all after it.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose
from drivers.frames import MemoryFrames
from drivers.sim.render import AnimalView, SeaRenderer
from lcmtypes import channels, make
from lcmtypes.podwatch import detections_t, frame_t, heartbeat_t, vehicle_state_t
from procs.camera.process import setup as set_up_camera
from procs.detector.process import setup as set_up_detector
from procs.detector.yolo import Detector, ModelError
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.settings import CameraSettings, DroneSettings, Mission
from tools.bench.detection_faults import FRAMES, OUTPUTS, PICTURES

__all__ = ["Corruption", "corruptions", "good_picture", "survival", "why_not"]

Image = NDArray[np.uint8]

S = 1_000_000
GOOD_S = 0.95
BAD_S = 2.6  # two heartbeats at least
AGAIN_S = 1.5
RATE_HZ = 10.0
DETECT_HZ = 5.0
SHIFT_PX = 2  # from frame to frame, since no two pictures of a camera are the same
SIZE = (320, 240)
SEED = 64
CLOCK = ClockError(offset_us=10 * S)


@dataclass(frozen=True)
class Corruption:
    """One way in which the input goes wrong. told: a word that a heartbeat must say meanwhile, empty where
    nobody can tell; corrupt: see tools.bench.detection_faults.
    """

    name: str
    kind: Literal["picture", "output", "frame"]
    told: str
    corrupt: Callable[..., Any]


def corruptions() -> list[Corruption]:
    """All of them, in the table's order."""
    return [
        *(Corruption(name, "picture", told, corrupt) for name, told, corrupt in PICTURES),
        *(Corruption(name, "output", told, corrupt) for name, told, corrupt in OUTPUTS),
        *(Corruption(name, "frame", told, corrupt) for name, told, corrupt in FRAMES),
    ]


def survival(model_path: str | Path | None = None) -> tuple[dict[str, str], int]:
    """(why not, for people, by the name of each that was not survived; how many were tried)."""
    detector, good, tried = Detector(model_path), good_picture(), corruptions()
    return {one.name: why for one in tried if (why := why_not(one, detector, good))}, len(tried)


def why_not(corruption: Corruption, detector: Detector, good: Image) -> str:
    """Why a corruption was not survived, for people; empty where it was. `good`: (240, 320, 3), with an
    animal that the detector finds wherever it is shifted to.
    """
    try:
        return _alone(corruption, detector, good) or _Drone(corruption, detector, good).fly()
    except Exception as error:  # whatever it is, it would have ended the process
        return f"{type(error).__name__}: {error}"


def good_picture() -> Image:
    """(240, 320, 3) uint8 BGR: two whales seen from 25 m."""
    camera = Pinhole(SIZE, float(np.radians(60.0)))
    whales = [AnimalView(1, 0.0, -4.0, 0.4, 11.0), AnimalView(2, 4.0, 6.0, 1.2, 11.0)]
    return SeaRenderer(5, water="atlantic").render(camera, Pose(0.0, 0.0, -25.0), 0.0, whales)


def _shifted(good: Image, number: int) -> Image:
    """The good picture as frame `number` shows it."""
    return np.roll(good, SHIFT_PX * (number % 8), axis=1)


class _Output:
    """A network whose output can be made to go wrong."""

    def __init__(self, network: Any) -> None:
        self._network = network
        self.corrupt: Callable[[NDArray[np.float32]], Any] | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._network, name)

    def run(self, tensor: Any) -> NDArray[np.float32]:
        output = self._network.run(tensor)
        return output if self.corrupt is None else np.asarray(self.corrupt(output), np.float32)


def _alone(corruption: Corruption, detector: Detector, good: Image) -> str:
    """Why the Detector by itself does not survive one bad picture."""
    if corruption.kind != "picture":
        return ""
    before = detector.detect(good)
    if len(before) == 0:
        return "nothing is found in the good picture"
    try:
        found = detector.detect(corruption.corrupt(good, np.random.default_rng(SEED)))
    except (ValueError, ModelError):
        found = before
    if not (np.isfinite(found.boxes).all() and np.isfinite(found.scores).all()):
        return "it gives boxes that are no numbers"
    after = detector.detect(good)
    return (
        ""
        if np.array_equal(before.boxes, after.boxes)
        else "it finds something else in the same picture after"
    )


class _Drone:
    """Camera and detector of one drone in virtual time, with a corruption that comes and goes."""

    def __init__(self, corruption: Corruption, detector: Detector, good: Image) -> None:
        self._corruption, self._good = corruption, good
        self._random = np.random.default_rng(SEED)
        self._is_bad = False
        self._n_captured = 0
        self._found: list[tuple[int, int]] = []  # capture, us, and number of boxes of each searched frame
        self._beats: dict[str, list[heartbeat_t]] = {"camera": [], "detector": []}
        self._queue = EventQueue()
        self._first, self._second = VirtualBus(self._queue), VirtualBus(self._queue)
        self._first.observers.append(self._cross)
        for bus in (self._first, self._second):
            bus.observers.append(self._hear)
        self._detector = detector
        self._network = detector.network

    def capture(self) -> Any:
        """What the camera's driver gives."""
        picture = _shifted(self._good, self._n_captured)
        self._n_captured += 1
        if not (self._is_bad and self._corruption.kind == "picture"):
            return picture
        given = self._corruption.corrupt(picture, self._random)
        if isinstance(given, OSError):
            raise given
        return given

    def fly(self) -> str:
        """Good, bad, good again -> why it was not survived."""
        self._start()
        output = _Output(self._network)
        self._detector.network = output  # type: ignore[assignment]
        try:
            self._run(GOOD_S)
            before = self._boxes_since(0)
            if not before or min(before) == 0:
                return f"good frames, and the detector found boxes: {before}"
            self._is_bad = True
            output.corrupt = self._corruption.corrupt if self._corruption.kind == "output" else None
            n_beats = {name: len(beats) for name, beats in self._beats.items()}
            self._run(BAD_S)
            said = self._said(n_beats)
            self._is_bad, output.corrupt = False, None
            mended_utime = self._utime
            self._run(AGAIN_S)
        finally:
            self._detector.network = self._network
        if self._corruption.told not in said:
            return f"no heartbeat said {self._corruption.told!r}, they said: {said or 'ok'}"
        again = self._boxes_since(mended_utime)
        if len(again) < AGAIN_S * DETECT_HZ - 1 or min(again) == 0:
            return f"good frames again, and the detector found boxes: {again}"
        for name, beats in self._beats.items():
            if len(beats) < int(GOOD_S + BAD_S + AGAIN_S) or beats[-1].status != heartbeat_t.OK:
                return f"the {name}'s last heartbeat, number {len(beats)}: {beats[-1].detail}"
        return ""

    def _start(self) -> None:
        camera = CameraSettings(
            width_px=SIZE[0], height_px=SIZE[1], rate_hz=RATE_HZ, preview_hz=0.5, detect_hz=DETECT_HZ
        )
        settings = DroneSettings(drone_id=1, mission=Mission(camera=camera))
        frames = MemoryFrames()
        drivers: dict[str, Callable[[str], Any]] = {
            "camera": lambda _process: self,
            "frames": lambda _process: frames,
            "detector": lambda _process: self._detector,
        }
        for name, setup, bus in (
            ("camera", set_up_camera, self._first),
            ("detector", set_up_detector, self._second),
        ):
            runtime = QueueRuntime(name, settings, bus, CLOCK, drivers)
            setup(runtime)
            runtime.start()
        # On the ground a camera may give the same picture for ever.
        in_the_air = make(vehicle_state_t, utime=self._utime, drone_id=1, armed=True, landed=False)
        self._second.deliver(channels.VEHICLE_STATE, in_the_air.encode())

    @property
    def _utime(self) -> int:
        return CLOCK.utime(self._queue.now_us)

    def _boxes_since(self, utime: int) -> list[int]:
        """How many boxes were found in each frame captured at that time or later."""
        return [n_boxes for captured, n_boxes in self._found if captured >= utime]

    def _run(self, seconds: float) -> None:
        self._queue.run_until(self._queue.now_us + round(seconds * S))

    def _cross(self, channel: str, data: bytes) -> None:
        """From the camera's bus to the detector's, as good or as bad as it is now."""
        if channel != channels.FRAME:
            return
        frames = [frame_t.decode(data)]
        if self._is_bad and self._corruption.kind == "frame":
            frames = self._corruption.corrupt(frames[0])
        for frame in frames:
            self._second.deliver(channel, frame.encode())

    def _hear(self, channel: str, data: bytes) -> None:
        if channel == channels.DETECTIONS:
            found = detections_t.decode(data)
            self._found.append((found.utime, found.n_boxes))
        elif channel == channels.HEARTBEAT:
            beat = heartbeat_t.decode(data)
            self._beats[beat.process].append(beat)

    def _said(self, n_beats: dict[str, int]) -> str:
        """All that heartbeats said was wrong since those."""
        return "; ".join(
            beat.detail
            for name, beats in self._beats.items()
            for beat in beats[n_beats[name] :]
            if beat.detail
        )


def main() -> None:
    """Print each that is not survived, and the count."""
    cv2.setNumThreads(1)
    problems, n_tried = survival(sys.argv[1] if len(sys.argv) > 1 else None)
    for name, why in problems.items():
        print(f"{name}: {why}")
    print(f"{n_tried - len(problems)} of {n_tried} survived")


if __name__ == "__main__":
    main()
