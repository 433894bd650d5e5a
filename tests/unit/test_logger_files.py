"""The logger's files: a new one now and then, and what a quota drops first."""

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.frames import MemoryFrames
from lcmtypes import channels, make, podwatch
from logs.fleet import DroneLog
from logs.reader import info, pictures, read, segments
from logs.scan import Scan
from procs.logger import process as logger_process
from procs.logger.files import LogFiles, SegmentedLog
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.settings import DroneSettings, LogSettings, Mission
from tools.cli import app
from tools.sim.flight import read_mission, with_overrides

SECOND_US = 1_000_000


def track(utime, n_corners=0):
    outline = [[(utime * 7 + k * k) % 640, (utime + k) % 480] for k in range(n_corners)]
    return make(podwatch.track_t, utime=utime, n_outline=n_corners, outline=outline).encode()


def picture(utime, n_bytes=20_000):
    """A picture that does not compress."""
    data = np.random.default_rng(utime).bytes(n_bytes)
    return make(podwatch.preview_t, utime=utime, format="jpeg", n_bytes=n_bytes, data=data).encode()


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_new_file_begins_when_a_segments_time_is_over(tmp_path):
    log = SegmentedLog(tmp_path / "drone_1.mcap", 1, {"seed": "3"}, segment_s=2.0)
    for k in range(11):
        log.write(channels.TRACK, track(k * SECOND_US // 2), k * SECOND_US // 2)
    log.close()
    files = segments(tmp_path / "drone_1.mcap")
    assert [path.name for path in files] == ["drone_1.mcap", "drone_1.1.mcap", "drone_1.2.mcap"]
    assert [info(path).n_messages for path in files] == [4, 4, 3]
    assert all(info(path).closed and info(path).metadata["seed"] == "3" for path in files)
    utimes = [raw.log_time_ns for raw in DroneLog(files[0], pytest.fail).messages()]
    assert utimes == [k * SECOND_US // 2 * 1000 for k in range(11)]


def test_without_a_length_there_is_one_file(tmp_path):
    log = SegmentedLog(tmp_path / "a.mcap", 1, {}, segment_s=0.0)
    for k in range(3):
        log.write(channels.TRACK, track(k), k * 10**9)
    log.close()
    assert names(tmp_path) == ["a.mcap"]


def written(folder, quota_gb, n_s=12):
    """Segments of 2 s: a 20 kB picture and ten tracks a second, the quota held each second."""
    settings = LogSettings(segment_s=2.0, quota_gb=quota_gb)
    files = LogFiles(folder / "drone_1.mcap", 1, {}, settings)
    dropped = []
    for k in range(n_s):
        utime = k * SECOND_US
        files.write_picture(channels.PREVIEW, picture(utime), utime)
        for i in range(10):
            files.write(channels.TRACK, track(utime + i, 60), utime + i)
        files.flush_due(utime + SECOND_US)
        dropped += [path.name for path in files.keep_quota()]
    files.close()
    return dropped, sum(path.stat().st_size for path in folder.iterdir())


def test_a_quota_drops_the_oldest_pictures_and_no_log(tmp_path):
    dropped, n_bytes = written(tmp_path, 200e3 / 1e9)
    assert dropped[:2] == ["drone_1.pictures.mcap", "drone_1.pictures.1.mcap"]
    assert all(".pictures." in name for name in dropped)
    assert n_bytes < 220e3
    assert [path.name for path in pictures(tmp_path / "drone_1.mcap")][-1] == "drone_1.pictures.5.mcap"
    shown = [raw.log_time_ns for path in pictures(tmp_path / "drone_1.mcap") for _, raw in _pairs(path)]
    assert shown[-1] == 11 * SECOND_US * 1000
    tracks = [m.utime for path in segments(tmp_path / "drone_1.mcap") for _, _, m in read(path)]
    assert len(tracks) == 120


def _pairs(path):
    return [(path, raw) for raw in Scan(path, pytest.fail).messages()]


def test_without_pictures_the_oldest_log_goes_and_its_number_is_not_used_again(tmp_path):
    settings = LogSettings(segment_s=1.0, quota_gb=15e3 / 1e9)
    files = LogFiles(tmp_path / "drone_1.mcap", 1, {}, settings)
    for k in range(10):
        for i in range(10):
            files.write(channels.TRACK, track(k * SECOND_US + i, 60), k * SECOND_US + i)
        files.keep_quota()
    files.close()
    kept = [path.name for path in segments(tmp_path / "drone_1.mcap")]
    assert kept[-1] == "drone_1.9.mcap"
    assert "drone_1.mcap" not in kept
    assert 1 < len(kept) < 9
    successor = LogFiles(tmp_path / "drone_1.mcap", 1, {}, settings)
    assert successor.path.name == "drone_1.10.mcap"
    successor.close()


def test_a_quota_too_small_for_one_segment_is_held_all_the_same(tmp_path):
    dropped, n_bytes = written(tmp_path, 60e3 / 1e9)
    assert n_bytes < 110e3
    assert dropped


def test_without_a_quota_nothing_is_dropped(tmp_path):
    dropped, n_bytes = written(tmp_path, 0.0)
    assert dropped == []
    assert n_bytes > 240e3


# The logger itself.


def fly(folder, log, seconds, frames=None):
    queue = EventQueue()
    bus = VirtualBus(queue)
    settings = DroneSettings(drone_id=1, mission=Mission(log=log), log_path=str(folder / "drone_1.mcap"))
    drivers = {} if frames is None else {"frames": lambda _: frames}
    logger = QueueRuntime("logger", settings, bus, ClockError(), drivers)
    camera = QueueRuntime("camera", settings, bus, ClockError(), {})
    states = []
    camera.on(channels.LOG_STATE, states.append)
    beats = []
    camera.on(channels.HEARTBEAT, beats.append)
    logger_process.setup(logger)
    camera.every(0.5, lambda: camera.publish(channels.PREVIEW, podwatch.preview_t.decode(picture(0, 3000))))
    if frames is not None:
        camera.every(0.1, lambda: _say_frame(camera, frames))
    camera.start()
    logger.start()
    queue.run_until(round(seconds * 1e6))
    logger.stop()
    return states, [beat for beat in beats if beat.process == "logger"]


def _say_frame(camera, frames):
    number = camera._sequence.get(channels.FRAME, 0)
    ring, token, slot = frames.write(np.full((6, 8, 3), number, np.uint8), number)
    if number == 7:
        frames.write(np.zeros((6, 8, 3), np.uint8), number + 16)  # overwritten before anybody looked
    handle = make(podwatch.frame_t, ring=ring, token=token, slot=slot, width=8, height=6)
    camera.publish(channels.FRAME, handle)


def test_pictures_lie_in_the_log_unless_a_quota_may_drop_them(tmp_path):
    for name, quota_gb in (("plain", 0.0), ("quota", 1.0)):
        (tmp_path / name).mkdir()
        fly(tmp_path / name, LogSettings(quota_gb=quota_gb), 2.2)
    in_log = {one.name for one in info(tmp_path / "plain" / "drone_1.mcap").channels}
    assert channels.PREVIEW in in_log
    assert names(tmp_path / "plain") == ["drone_1.mcap"]
    assert names(tmp_path / "quota") == ["drone_1.mcap", "drone_1.pictures.mcap"]
    [apart] = info(tmp_path / "quota" / "drone_1.pictures.mcap").channels
    assert (apart.name, apart.n_messages) == (channels.PREVIEW, 4)


def test_log_state_names_the_file_that_is_written(tmp_path):
    states, _ = fly(tmp_path, LogSettings(segment_s=2.0), 5.5)
    assert [state.path for state in states][-1] == "drone_1.2.mcap"
    assert all(state.ok for state in states)


def test_whole_frames_are_kept_and_a_lost_one_is_told(tmp_path):
    _, beats = fly(tmp_path, LogSettings(frames=True), 1.55, MemoryFrames())
    images = [image for _, _, image in read(tmp_path / "drone_1.pictures.mcap")]
    assert [image.frame_seq for image in images] == [0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11, 12, 13, 14]
    assert [set(image.data) for image in images[:3]] == [{0}, {1}, {2}]
    assert "1 frames were gone before they were logged" in beats[-1].detail


def test_the_command_line_asks_for_whole_frames():
    assert with_overrides(read_mission("default"), log_frames=True).log.frames
    assert not with_overrides(read_mission("default")).log.frames


def test_whole_frames_of_a_flight_without_pixels_are_refused(tmp_path):
    arguments = ["sim", "--log-frames", "--sensor", "boxes", "--out", str(tmp_path / "runs")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "--log-frames: --sensor boxes looks at no pixels; drop one of them" in result.stderr
    assert not (tmp_path / "runs").exists()
