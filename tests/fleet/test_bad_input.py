"""What bad input gets, a row each: clear words that name the value and the remedy, the right exit code, and
nothing else lost. And one promise beside them: an old setpoint never reaches the autopilot.
"""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.autopilots.ardupilot import VELOCITY_YAW, Codec
from drivers.autopilots.memory import link_pair
from drivers.sim.autopilot import SimAutopilot
from drivers.sim.vehicle import Vehicle
from lcmtypes import channels, make
from lcmtypes.podwatch import detections_t, frame_t, heartbeat_t, setpoint_t, track_t
from logs.reader import info
from logs.writer import LogWriter
from procs.autopilot.process import setup as set_up_bridge
from procs.camera.process import setup as set_up_camera
from procs.detector.process import setup as set_up_detector
from procs.detector.yolo import Detections
from procs.relay.keys import make_key
from procs.relay.seal import Sessions
from procs.settings import DriverSpec, DroneSettings, Mission
from tests.fleet.bad_inputs import SEA, Bench, Camera, Relays, S, registrar, sea_with_boxes, show_registrar
from tools.cli import app

ROOT = Path(__file__).parents[2]
GOES_ON = -1  # a process that flies on has no exit code


@dataclass(frozen=True)
class Outcome:
    """What somebody who gave bad input sees of it."""

    told: str
    code: int
    lost: int = 0  # good inputs beside the bad one that had no effect


def camera(bad: Any, *, seconds: float = 2.0, refused: bool = True) -> Outcome:
    """One second of sea, the bad images, one second of sea."""
    source = Camera()
    bench = Bench("camera", set_up_camera, {"camera": source})
    bench.run(1.02)  # between two captures
    source.gives = bad
    bench.run(seconds)
    told = bench.beat.detail
    n_bad = 0 if refused else round(20 * seconds)
    source.gives = SEA
    bench.run(2.0)
    assert bench.beat.status == heartbeat_t.OK, bench.beat.detail
    return Outcome(told, GOES_ON, lost=60 + n_bad - bench.count(channels.FRAME))


def frame_of_the_wrong_size(_folder: Path) -> Outcome:
    return camera(np.zeros((720, 1280, 3), np.uint8))


def frame_of_the_wrong_type(_folder: Path) -> Outcome:
    return camera(np.zeros((480, 640, 3), np.float32))


def frame_that_is_no_image(_folder: Path) -> Outcome:
    return camera("a picture")


def black_frame(_folder: Path) -> Outcome:
    return camera(np.zeros((480, 640, 3), np.uint8), refused=False)


def camera_that_stops(_folder: Path) -> Outcome:
    return camera(None, seconds=3.0)


def camera_that_fails(_folder: Path) -> Outcome:
    return camera(OSError("/dev/video0: no such device"), seconds=3.0)


def registered(bad: Callable[[int], bytes]) -> Outcome:
    """A registrar hears one bad message after each good one."""
    bench = registrar()
    good: list[int] = []

    def said(utime: int) -> detections_t:
        bench.bus.deliver(channels.DETECTIONS, bad(utime))
        good.append(utime)
        return sea_with_boxes(utime)

    show_registrar(bench, 2.0, said)
    told = bench.beat.detail
    bench.run(0.1)
    named = [message.utime for message in bench.heard[channels.IDENTITIES]]
    return Outcome(told, GOES_ON, lost=len(set(good) - set(named)))


def message_that_does_not_decode(_folder: Path) -> Outcome:
    return registered(lambda utime: sea_with_boxes(utime).encode()[:-5])


def message_of_another_version(_folder: Path) -> Outcome:
    return registered(lambda utime: bytes(8) + sea_with_boxes(utime).encode()[8:])


def message_of_another_type(_folder: Path) -> Outcome:
    return registered(lambda utime: make(track_t, utime=utime).encode())


def nan_boxes_on_the_bus(_folder: Path) -> Outcome:
    bench = registrar()
    told: list[str] = []
    show_registrar(bench, 2.0, lambda utime: sea_with_boxes(utime, right_px=float("nan")))
    told.append(bench.beat.detail)
    show_registrar(bench, 2.0, sea_with_boxes)
    bench.run(0.1)
    return Outcome(told[0], GOES_ON, lost=10 - bench.count(channels.IDENTITIES))


class BrokenNetwork:
    """Finds one animal, and one that is nowhere."""

    def detect(self, _image: Any) -> Detections:
        boxes = np.array([[10, 10, 50, 90], [np.nan, 10, 50, 90]], np.float32)
        return Detections(boxes, np.array([0.9, 0.8], np.float32), np.zeros(2, np.int64), {0: "whale"})


def nan_boxes_of_the_network(_folder: Path) -> Outcome:
    bench = Bench("detector", set_up_detector, {"detector": BrokenNetwork()})
    for number in range(10):
        ring, token, slot = bench.drivers["frames"].write(SEA, number)
        bench.say(
            channels.FRAME,
            make(frame_t, utime=S + S * number // 5, seq=number, ring=ring, token=token, slot=slot),
        )
        bench.run(0.2)
    said = bench.heard[channels.DETECTIONS]
    assert all(message.n_boxes == 1 for message in said)
    return Outcome(bench.beat.detail, GOES_ON, lost=10 - len(said))


def relayed(folder: Path, disturb: Callable[[Relays], None], *, restarted: bool = False) -> Outcome:
    """Two relays that know each other, then 3 s with something bad on the air."""
    make_key(folder / "fleet.key")
    relays = Relays(folder)
    relays.run(6.0)
    if restarted:
        for drone_id in (1, 2):
            relays.start(drone_id)
        relays.run(4.0)
    lost = relays.run(3.0, lambda: disturb(relays))
    return Outcome(relays.beats[-1].detail, GOES_ON, lost)


def datagram_of_a_stranger(folder: Path) -> Outcome:
    stranger = Sessions(bytes(32), 2, 5, (1, 2))
    return relayed(folder, lambda relays: relays.feed(stranger.seal(1, b"I am drone 2")))


def datagram_that_is_noise(folder: Path) -> Outcome:
    return relayed(folder, lambda relays: relays.feed(b"noise"))


def datagram_repeated(folder: Path) -> Outcome:
    return relayed(folder, lambda relays: relays.feed(relays.recorded[-1]))


def datagram_altered(folder: Path) -> Outcome:
    def alter(relays: Relays) -> None:
        newest = relays.recorded[-1]
        relays.feed(newest[:-20] + bytes([newest[-20] ^ 1]) + newest[-19:])

    return relayed(folder, alter)


def datagram_replayed_after_both_ends_restarted(folder: Path) -> Outcome:
    old: list[bytes] = []

    def replay(relays: Relays) -> None:
        old.extend([] if old else relays.recorded[:40])
        relays.feed(old.pop())

    return relayed(folder, replay, restarted=True)


def command(*arguments: object) -> Outcome:
    """`podwatch ...` in this process; a traceback would be an exception here."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    return Outcome(result.stderr, result.exit_code)


def a_log(folder: Path) -> Path:
    path = folder / "drone_1.mcap"
    writer = LogWriter(path, drone_id=1)
    for k in range(200):
        message = make(track_t, utime=k * 50_000, seq=k, drone_id=1)
        writer.write(channels.TRACK, message.encode(), message.utime)
    writer.close()
    return path


def log_row(folder: Path, damage: Callable[[bytes], bytes], least: int) -> Outcome:
    """`least`: how many of the log's 200 messages must still be read."""
    path = a_log(folder)
    path.write_bytes(damage(path.read_bytes()))
    seen = command("log", "info", path)
    n_read = info(path).n_messages if seen.code == 0 else 0
    return Outcome(seen.told, seen.code, lost=max(least - n_read, 0))


def corrupt_log(folder: Path) -> Outcome:
    def flip(data: bytes) -> bytes:
        middle = len(data) // 2
        return data[:middle] + bytes(byte ^ 0xFF for byte in data[middle : middle + 8]) + data[middle + 8 :]

    return log_row(folder, flip, least=160)


def truncated_log(folder: Path) -> Outcome:
    return log_row(folder, lambda data: data[: len(data) // 2], least=60)


def empty_log(folder: Path) -> Outcome:
    return log_row(folder, lambda _data: b"", least=0)


def folder_without_logs(folder: Path) -> Outcome:
    return command("report", folder)


def start(process: str, folder: Path, **drivers: DriverSpec) -> Outcome:
    """The real process, as its supervisor starts it."""
    settings = folder / "drone_1.json"
    settings.write_text(
        DroneSettings(
            drone_id=1, mission=Mission(), bus_url="memq://", run_dir=str(folder), drivers=drivers
        ).model_dump_json()
    )
    words = [sys.executable, "-m", "procs.main", process, str(settings)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.stdout == ""
    return Outcome(done.stderr, done.returncode)


def start_detector(folder: Path) -> Outcome:
    return start(
        "detector",
        folder,
        frames=DriverSpec(driver="drivers.frames:SharedFrames", options={"run": "bad", "drone_id": 1}),
        detector=DriverSpec(
            driver="procs.detector.yolo:Detector", options={"model_path": str(folder / "a.onnx")}
        ),
    )


def missing_model(folder: Path) -> Outcome:
    return start_detector(folder)


def broken_model(folder: Path) -> Outcome:
    (folder / "a.onnx").write_text("no network")
    return start_detector(folder)


def driver_of_no_such_name(folder: Path) -> Outcome:
    return start("camera", folder, camera=DriverSpec(driver="drivers.cameras.nobody:Camera"))


def address_that_is_none(folder: Path) -> Outcome:
    link = DriverSpec(driver="drivers.autopilots.mavlink_link:open_link", options={"address": "udp:nowhere"})
    return start("autopilot", folder, autopilot=link)


def key_that_others_can_read(folder: Path) -> Outcome:
    make_key(folder / "fleet.key")
    (folder / "fleet.key").chmod(0o644)
    return start("relay", folder)


def key_that_others_can_read_in_a_mission(folder: Path) -> Outcome:
    make_key(folder / "fleet.key")
    (folder / "fleet.key").chmod(0o644)
    text = f'[radio]\nkey_file = "{folder / "fleet.key"}"\n'
    return mission_row(folder, text, "--lockstep", "--sensor", "boxes", "--headless")


def mission_row(folder: Path, text: str, *options: str) -> Outcome:
    """`podwatch sim` on a mission file; nothing is left of a run that could not begin."""
    path = folder / "mission.toml"
    path.write_text(text)
    seen = command("sim", path, "--out", folder / "runs", *options)
    left = [] if options else list(folder.glob("runs/*"))
    return Outcome(seen.told, seen.code, lost=len(left))


def unit_that_no_key_has(folder: Path) -> Outcome:
    return mission_row(folder, "[search]\nheight_ft = 130\n")


def value_with_a_unit_of_its_own(folder: Path) -> Outcome:
    return mission_row(folder, '[watch]\nheight_m = "30 m"\n')


def negative_height(folder: Path) -> Outcome:
    return mission_row(folder, "[search]\nheight_m = -40\n")


def two_drones_with_one_id(folder: Path) -> Outcome:
    return mission_row(folder, "[[drones]]\nid = 2\n[[drones]]\nid = 2\n")


ROWS: list[tuple[Callable[[Path], Outcome], tuple[str, ...], int]] = [
    (frame_of_the_wrong_size, ("gave 1280x720 uint8", "wants 640x480", "set [camera] width_px"), GOES_ON),
    (frame_of_the_wrong_type, ("gave 640x480 float32", "wants 640x480 uint8"), GOES_ON),
    (frame_that_is_no_image, ("gave a str", "wants 640x480 uint8"), GOES_ON),
    (black_frame, ("black images", "is the lens covered?"), GOES_ON),
    (camera_that_stops, ("no image for 2.", "is the camera connected?"), GOES_ON),
    (camera_that_fails, ("/dev/video0: no such device", "is it connected?"), GOES_ON),
    (
        message_that_does_not_decode,
        ("bytes does not decode", "same podwatch version?"),
        GOES_ON,
    ),
    (message_of_another_version, ("does not decode as detections_t", "same podwatch version?"), GOES_ON),
    (message_of_another_type, ("does not decode as detections_t", "same podwatch version?"), GOES_ON),
    (nan_boxes_on_the_bus, ("a box that is not a number", "the frame is left out"), GOES_ON),
    (nan_boxes_of_the_network, ("1 boxes that are no numbers", "nan", "export the model again"), GOES_ON),
    (datagram_of_a_stranger, ("10 stranger", "hold this fleet's key"), GOES_ON),
    (datagram_that_is_noise, ("10 stranger", "hold this fleet's key"), GOES_ON),
    (datagram_repeated, ("10 replayed", "hold this fleet's key"), GOES_ON),
    (datagram_altered, ("10 altered", "hold this fleet's key"), GOES_ON),
    (datagram_replayed_after_both_ends_restarted, ("10 unproven", "hold this fleet's key"), GOES_ON),
    (corrupt_log, ("warning: ", "drone_1.mcap"), 0),
    (truncated_log, ("drone_1.mcap: was not closed",), 0),
    (empty_log, ("drone_1.mcap: is empty (0 bytes)",), 2),
    (folder_without_logs, ("no drone_<id>.mcap in this folder", "give a run's folder, or drones' logs"), 2),
    (missing_model, ("detector: ", "a.onnx: no such model file", "give the path of an ONNX file"), 3),
    (broken_model, ("a.onnx: not a model that onnxruntime loads", "export it as ONNX again"), 3),
    (driver_of_no_such_name, ("camera: driver drivers.cameras.nobody:Camera", "check its name"), 3),
    (address_that_is_none, ("autopilot: driver", "'nowhere' is no address", "write host:port"), 3),
    (key_that_others_can_read, ("relay: ", "fleet.key: mode 0644", "chmod 600"), 3),
    (key_that_others_can_read_in_a_mission, ("fleet.key: mode 0644", "chmod 600"), 3),
    (unit_that_no_key_has, ("search.height_ft", "did you mean 'height_m'?"), 2),
    (value_with_a_unit_of_its_own, ("watch.height_m", "valid number", "'30 m'"), 2),
    (negative_height, ("search.height_m", "greater than or equal to 5", "-40"), 2),
    (two_drones_with_one_id, ("id 2 is given to 2 drones; each needs its own",), 2),
]


@pytest.mark.parametrize(("give", "words", "code"), ROWS, ids=[row[0].__name__ for row in ROWS])
def test_bad_input(give, words, code, tmp_path):
    outcome = give(tmp_path)
    assert [word for word in words if word not in outcome.told] == [], outcome.told
    assert "Traceback" not in outcome.told
    assert (outcome.code, outcome.lost) == (code, 0), outcome.told
    if code > 0:
        assert outcome.told.count("\n") == 1, outcome.told


def test_a_setpoint_older_than_its_expiry_never_reaches_the_autopilot():
    """Setpoints reach the bridge after 0 to 1 s, with a life of 0.5 s: those too late ask for 3 m/s to the
    east, the others for 2 m/s to the north. The autopilot hears the first never, the second never after
    their expiry.
    """
    drone = Flight()
    drone.climb()
    random = np.random.default_rng(7)
    expiries: list[int] = []
    for k in range(200):
        late_us = int(random.integers(0, S))
        written_us = drone.queue.now_us - late_us
        is_late = late_us > 500_000
        wish = {"ve_m_s": 3.0} if is_late else {"vn_m_s": 2.0}
        if not is_late:
            expiries.append(written_us + 500_000)
        drone.say(written_us, seq=k, **wish)
        drone.run(float(random.choice([0.05, 0.1, 0.7])))
    drone.run(3.0)
    heard = drone.targets
    assert drone.masks == {VELOCITY_YAW}
    assert max(east for _, _, east in heard) < 0.1
    moving = [at_us for at_us, north, _ in heard if north > 0.1]
    assert len(moving) > 100
    for at_us in moving:
        assert any(at_us - LINK_DELAY_US <= expiry for expiry in expiries), at_us
    last = max(expiries)
    assert max(moving) <= last + LINK_DELAY_US
    assert any(at_us > last and north == 0.0 for at_us, north, _ in heard), "it stands still after the last"


LINK_DELAY_US = 2000


class Flight:
    """The bridge's process with a simulated autopilot at the far end of its link, which is listened to."""

    def __init__(self) -> None:
        near, self._far = link_pair(self._deliver, 1)
        self._ear = Codec(1, 1)
        self.targets: list[tuple[int, float, float]] = []  # when it arrived, velocity north and east
        self.masks: set[int] = set()
        vehicle = Vehicle((0.0, 0.0), np.random.default_rng(1))
        self.twin = SimAutopilot(vehicle, 1, np.random.default_rng(2), origin=(15.3, -61.5, 0.0))
        self._bench: Bench | None = None
        self._bench = Bench("autopilot", set_up_bridge, {"autopilot": near})

    @property
    def queue(self) -> Any:
        assert self._bench is not None
        return self._bench.queue

    def run(self, seconds: float) -> None:
        end_us = self.queue.now_us + round(seconds * S)
        while self.queue.now_us < end_us:
            self.queue.run_until(min(self.queue.now_us + 5000, end_us))
            data = self._far.receive()
            for message in self._ear.parse(data):
                if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                    self.masks.add(message.type_mask)
                    self.targets.append((self.queue.now_us, message.vx, message.vy))
            self.twin.receive(data, self.queue.now_us / 1e6)
            self._far.write(self.twin.step(self.queue.now_us / 1e6))

    def climb(self) -> None:
        while self.twin.vehicle.position_ned[2] > -14.0:
            assert self.queue.now_us < 60 * S
            self.say(self.queue.now_us, kind=setpoint_t.TAKEOFF, d_m=-15.0)
            self.run(0.1)
        self.say(self.queue.now_us)
        self.run(0.3)
        self.targets.clear()
        self.masks.clear()

    def say(self, utime: int, seq: int = 0, kind: int = setpoint_t.VELOCITY, **members: float) -> None:
        message = make(setpoint_t, utime=utime, seq=seq, expiry_utime=utime + 500_000, **members)
        message.kind = kind
        assert self._bench is not None
        self._bench.say(channels.SETPOINT, message)

    def _deliver(self, action: Callable[[], None]) -> None:
        if self._bench is not None:
            self.queue.schedule(self.queue.now_us + LINK_DELAY_US, action)
