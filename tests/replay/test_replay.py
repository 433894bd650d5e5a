"""One process over a recorded log: the same code says the same to the bit, and a change is told by name."""

import re
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from drivers.frames import MemoryFrames
from lcmtypes import channels, make, podwatch
from logs.copying import copy_message, open_like
from logs.exceptions import LogError
from logs.fleet import DroneLog
from logs.reader import info
from logs.scan import Scan
from logs.writer import LogWriter
from procs import processes
from procs.camera import process as camera_process
from procs.detector import process as detector_process
from procs.logger import process as logger_process
from procs.navigator.states import State
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.settings import CameraSettings, DroneSettings, LogSettings, Mission, load_mission
from procs.tracker import process as tracker_process
from procs.tracker.mask_tracker import MaskTracker
from tools.replay import _clock, replay_command
from tools.replaying.compare import Tolerance, compare
from tools.replaying.run import SAYS, UNLOGGED, Said, replay
from tools.sim.lockstep import LockstepFleet
from tools.sim.plan import RunPlan
from tools.sim.run import prepare, write_truth_notes
from tools.sim.settings import SimMission
from tools.sim.watch import Watch

FLOWN_S = 9.0


def ignore(_):
    """A log's warnings are not what is tested here."""


EXACT = Tolerance()


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """The folder of three drones' first seconds: start, take-off, the scout's way, the ring's first words."""
    folder = tmp_path_factory.mktemp("flight")
    mission = load_mission(_near(), SimMission)
    plan = RunPlan(mission, folder, sensor="boxes")
    prepare(plan)
    watch = Watch(mission, None)
    fleet = LockstepFleet(plan, watch.hear)
    fleet.run_until(FLOWN_S)
    fleet.close()
    write_truth_notes(plan, watch, "lockstep", "", FLOWN_S, 1.0)
    return folder


def _near():
    return Path(__file__).parents[1] / "fleet" / "near.toml"


def rerun(process, path, **drivers):
    log = DroneLog(path, ignore)
    return replay(process, log, drivers, _clock(log))


@pytest.mark.parametrize("drone_id", [1, 3])
@pytest.mark.parametrize("process", ["navigator", "registrar", "assigner"])
def test_the_same_code_says_the_same_to_the_bit(flight, process, drone_id):
    done = rerun(process, flight / f"drone_{drone_id}.mcap")
    assert done.is_virtual
    assert {said.channel for said in done.recorded} <= {*SAYS[process], channels.HEARTBEAT}
    assert [(s.at_us, s.channel, s.data) for s in done.replayed] == list(done.recorded)
    assert all(account.agrees for account in compare(done.recorded, done.replayed, EXACT))


def test_a_change_in_the_code_is_found(flight, monkeypatch):
    log = flight / "drone_1.mcap"
    assert any(
        podwatch.mission_state_t.decode(said.data).state == State.TAKEOFF
        for said in rerun("navigator", log).recorded
        if said.channel == channels.MISSION_STATE
    )
    monkeypatch.setattr(podwatch.setpoint_t, "encode", _faster(podwatch.setpoint_t.encode))
    done = rerun("navigator", log)
    accounts = {account.channel: account for account in compare(done.recorded, done.replayed, EXACT)}
    setpoints = accounts[channels.SETPOINT]
    assert setpoints.n_different == setpoints.n_recorded > 50
    assert {one.member for one in setpoints.differences} == {"yaw_rad"}
    assert accounts[channels.MISSION_STATE].agrees


def _faster(encode):
    def changed(message):
        message.yaw_rad += 1.0
        return encode(message)

    return changed


def run(*arguments):
    app = typer.Typer()
    app.command()(replay_command)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_table_tells_what_differs_and_the_exit_code_is_1(flight, tmp_path):
    """A recorded log with one message changed, one taken out and one put in."""
    scan = Scan(flight / "drone_2.mcap", ignore)
    messages = list(scan.messages())
    setpoints = [i for i, raw in enumerate(messages) if raw.channel == channels.SETPOINT]
    changed = podwatch.setpoint_t.decode(messages[setpoints[10]].data)
    changed.yaw_rad += 0.5
    messages[setpoints[10]] = messages[setpoints[10]]._replace(data=changed.encode())
    extra = podwatch.setpoint_t.decode(messages[setpoints[30]].data)
    extra.utime += 7
    messages.insert(setpoints[30] + 1, messages[setpoints[30]]._replace(data=extra.encode()))
    del messages[setpoints[20]]
    writer = open_like(scan, tmp_path / "drone_2.mcap")
    for raw in messages:
        copy_message(writer, raw)
    writer.close()
    (tmp_path / "truth.json").write_bytes((flight / "truth.json").read_bytes())

    result = run("navigator", tmp_path / "drone_2.mcap")
    assert result.exit_code == 1
    rows = [line.split() for line in result.stdout.splitlines()]
    [counts] = [row for row in rows if row[:1] == [channels.SETPOINT]]
    n = len(setpoints)
    assert counts[1:] == [str(n), str(n), str(n - 2), "1", "1", "1"]
    told = [row[1:3] for row in rows if row and re.fullmatch(r"\d+\.\d{6}", row[0])]
    assert told == [
        [channels.SETPOINT, "yaw_rad"], [channels.SETPOINT, "(the"], [channels.SETPOINT, "(the"],
    ]  # fmt: skip
    same = run("navigator", flight / "drone_2.mcap")
    assert same.exit_code == 0
    assert "Every message is the same." in same.stdout


@pytest.mark.parametrize(
    ("process", "words"),
    [
        ("relay", "what came over its radio is in no log"),
        ("tracker", "holds no whole frames, which tracker needs; record one with podwatch sim --log-frames"),
        ("cook", "there is no process 'cook'"),
    ],
)
def test_what_a_log_cannot_replay_is_told(flight, process, words):
    result = run(process, flight / "drone_1.mcap")
    assert result.exit_code == 2
    assert words in result.stderr


def test_every_process_can_be_replayed_or_says_why_not():
    assert {*SAYS, *UNLOGGED} == set(processes.BY_NAME)
    for name, said in SAYS.items():
        module = __import__(processes.BY_NAME[name].module, fromlist=["__doc__"])
        assert all(channel in module.__doc__ for channel in said), name


# Pixels: a camera, a detector and a tracker on one virtual bus, whose logger keeps whole frames.

SIZE = (160, 120)


class Sea:
    """A bright animal that swims over a dark noisy sea."""

    def __init__(self):
        self._random = np.random.default_rng(3)
        self._n = 0

    def capture(self):
        image = self._random.integers(20, 60, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
        cv2.ellipse(image, (40 + self._n, 60), (18, 7), 10, 0, 360, (210, 200, 190), -1)
        self._n += 1
        return image


class Threshold:
    """A detector of what is bright."""

    def detect(self, image):
        v, u = np.nonzero(image[..., 0] > 128)
        box = [[u.min(), v.min(), u.max() + 1, v.max() + 1]] if u.size else np.empty((0, 4))
        n = len(box)
        return SimpleNamespace(boxes=np.asarray(box, np.float32), scores=np.ones(n), classes=np.zeros(n, int))


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """The log of three seconds of looking, with whole frames."""
    path = tmp_path_factory.mktemp("seen") / "drone_1.mcap"
    mission = Mission(
        camera=CameraSettings(width_px=SIZE[0], height_px=SIZE[1]), log=LogSettings(frames=True)
    )
    settings = DroneSettings(drone_id=1, mission=mission, seed=5, log_path=str(path))
    queue, frames = EventQueue(), MemoryFrames()
    bus = VirtualBus(queue)
    clock = ClockError(90_000_000, 40.0)
    drivers = {
        "camera": lambda _: Sea(), "frames": lambda _: frames, "detector": lambda _: Threshold(),
        "tracker": lambda _: MaskTracker(),
    }  # fmt: skip
    shells = {
        "camera": camera_process, "detector": detector_process, "tracker": tracker_process,
        "logger": logger_process,
    }  # fmt: skip
    runtimes = [QueueRuntime(name, settings, bus, clock, drivers) for name in shells]
    for runtime, module in zip(runtimes, shells.values(), strict=True):
        module.setup(runtime)
    ring = QueueRuntime("registrar", settings, bus, clock, {})
    ring.on(channels.DETECTIONS, lambda found: _name_the_animal(ring, found))
    for runtime in (*runtimes, ring):
        runtime.start()
    queue.run_until(3_000_000)
    for runtime in runtimes:
        runtime.stop()
    clocks = '{"clocks": {"1": {"offset_us": 90000000, "drift_ppm": 40.0}}}'
    path.with_name("truth.json").write_text(clocks)
    return path


def _name_the_animal(ring, found):
    ring.publish(
        channels.IDENTITIES,
        make(
            podwatch.identities_t, utime=found.utime, width=SIZE[0], height=SIZE[1], n_boxes=found.n_boxes,
            boxes=found.boxes, ids=[7] * found.n_boxes,
        ),
    )  # fmt: skip
    ring.publish(channels.ASSIGNMENT, make(podwatch.assignment_t, animal=7, certified=True))


@pytest.mark.parametrize("process", ["camera", "detector", "tracker"])
def test_a_log_with_whole_frames_replays_what_looks_at_pixels(seen, process):
    done = rerun(process, seen, detector=Threshold, tracker=MaskTracker)
    accounts = compare(done.recorded, done.replayed, EXACT)
    assert all(account.agrees for account in accounts), accounts
    assert {account.channel for account in accounts} == {*SAYS[process], channels.HEARTBEAT}
    assert min(account.n_recorded for account in accounts) >= 3


def test_the_tracker_of_that_log_really_tracked(seen):
    states = [
        podwatch.track_t.decode(said.data).state
        for said in rerun("tracker", seen, tracker=MaskTracker).recorded
        if said.channel == channels.TRACK
    ]
    assert states.count(podwatch.track_t.TRACKING) > 40


def test_other_pixels_give_other_words(seen, monkeypatch):
    monkeypatch.setattr(
        "tools.replaying.run.decode_picture", lambda picture: np.zeros((120, 160, 3), np.uint8)
    )
    done = rerun("detector", seen, detector=Threshold)
    [found] = [
        account
        for account in compare(done.recorded, done.replayed, EXACT)
        if account.channel == channels.DETECTIONS
    ]
    assert found.n_different == found.n_recorded
    assert {one.member for one in found.differences} == {"n_boxes", "boxes"}


def test_whole_frames_lie_beside_the_log(seen):
    assert channels.IMAGE not in {channel.name for channel in info(seen).channels}
    [images] = info(seen.with_name("drone_1.pictures.mcap")).channels
    assert (images.name, images.n_messages) == (channels.IMAGE, 59)


# The comparison.


def track(utime, **members):
    return Said(utime, channels.TRACK, make(podwatch.track_t, utime=utime, **members).encode())


def test_messages_are_paired_by_their_time_within_the_tolerance():
    then = [track(0), track(100), track(200)]
    now = [track(3), track(190, seq=8)]
    [account] = compare(then, now, Tolerance(time_us=20))
    assert (account.n_same, account.n_missing, account.n_extra) == (2, 1, 0)
    [account] = compare(then, now, EXACT)
    assert (account.n_same, account.n_missing, account.n_extra) == (0, 3, 2)
    assert [one.at_us for one in account.differences] == [0, 3, 100, 190, 200]


def test_of_two_messages_within_the_tolerance_the_nearest_is_the_pair():
    """One message too many at the beginning must not shift all pairs by one."""
    then = [track(k * 100, frame_seq=k) for k in range(1, 5)]
    now = [track(k * 100 + 2, frame_seq=k) for k in range(5)]
    [account] = compare(then, now, Tolerance(time_us=150))
    assert (account.n_same, account.n_different, account.n_missing, account.n_extra) == (4, 0, 0, 1)
    [account] = compare(now, then, Tolerance(time_us=150))
    assert (account.n_same, account.n_different, account.n_missing, account.n_extra) == (4, 0, 1, 0)


@pytest.mark.parametrize(("relative", "agrees"), [(0.0, False), (0.005, False), (0.02, True)])
def test_numbers_may_differ_by_a_share(relative, agrees):
    [account] = compare([track(0, u_px=100.0)], [track(0, u_px=101.0)], Tolerance(relative=relative))
    assert account.agrees == agrees


def test_a_number_that_is_none_on_both_sides_is_the_same():
    both = [track(0, u_px=float("nan"))]
    assert compare(both, both, EXACT)[0].agrees
    assert not compare(both, [track(0, u_px=1.0)], Tolerance(relative=0.5))[0].agrees


def test_nested_members_are_named_by_their_place():
    def row(n_m):
        box = make(podwatch.box_t, left_px=n_m)
        found = make(podwatch.detections_t, n_boxes=2, boxes=[make(podwatch.box_t), box])
        return [Said(0, channels.DETECTIONS, found.encode())]

    [account] = compare(row(1.0), row(2.0), EXACT)
    assert [(one.member, one.recorded, one.replayed) for one in account.differences] == [
        ("boxes[1].left_px", 1.0, 2.0)
    ]


def test_a_mission_that_the_log_does_not_tell_is_an_error(tmp_path):
    scan = Scan(_lonely(tmp_path), ignore)
    assert scan.closed
    with pytest.raises(LogError, match="does not say with which mission and seed"):
        rerun("navigator", tmp_path / "a.mcap")


def _lonely(folder):
    writer = LogWriter(folder / "a.mcap", drone_id=1)
    beat = make(podwatch.heartbeat_t, process="navigator")
    writer.write(channels.HEARTBEAT, beat.encode(), 0)
    writer.close()
    return folder / "a.mcap"
