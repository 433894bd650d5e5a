"""The logger: what it keeps, what it says, and that no disk trouble ever stops its drone."""

import dataclasses
import resource
import shutil
import signal
from collections import namedtuple
from pathlib import Path

import pytest

from lcmtypes import channels, make, podwatch
from logs.reader import info, read, segments
from procs.logger import process as logger_process
from procs.logger.selection import Selection, disk_is_full, disk_trouble
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.runtime import RuntimeFailure
from procs.settings import DroneSettings, Mission

Usage = namedtuple("Usage", "total used free")


class Bench:
    """A logger and one publisher on a virtual bus."""

    def __init__(self, log_path: Path, offset_us: int = 0) -> None:
        self.queue = EventQueue()
        bus = VirtualBus(self.queue)
        clock = ClockError(offset_us=offset_us)
        settings = DroneSettings(drone_id=4, mission=Mission(name="bench"), seed=9, log_path=str(log_path))
        self.logger = QueueRuntime("logger", settings, bus, clock, {})
        self.publisher = QueueRuntime("navigator", settings, bus, clock, {})
        self.states: list[podwatch.log_state_t] = []
        self.beats: list[podwatch.heartbeat_t] = []
        self.publisher.on(channels.LOG_STATE, self.states.append)
        self.publisher.on(channels.HEARTBEAT, self.beats.append)
        self.publisher.every(0.05, self._say)
        logger_process.setup(self.logger)
        self.publisher.start()
        self.logger.start()

    def _say(self) -> None:
        self.publisher.publish(channels.SETPOINT, podwatch.setpoint_t())

    def run(self, until_s: float) -> None:
        self.queue.run_until(round(until_s * 1e6))

    @property
    def logger_beat(self) -> podwatch.heartbeat_t:
        return [beat for beat in self.beats if beat.process == "logger"][-1]


def test_the_whole_bus_is_kept_and_the_file_is_closed(tmp_path):
    bench = Bench(tmp_path / "new" / "drone4.mcap")
    bench.run(3.5)
    bench.logger.stop()
    log = info(tmp_path / "new" / "drone4.mcap")
    counts = {channel.name: channel.n_messages for channel in log.channels}
    # each 50 ms and 1 ms of computing: 69 up to 3.5 s; two processes beat at 0 to 3 s; its state at 1 to 3 s
    assert counts == {"HEARTBEAT": 8, "LOG_STATE": 3, "SETPOINT": 69}
    assert (log.closed, log.problems) == (True, ())
    assert [channel.n_lost for channel in log.channels] == [0, 0, 0]
    assert log.metadata["drone_id"] == "4"
    assert log.metadata["seed"] == "9"
    assert "boot" not in log.metadata, "virtual time has no boot: the same run gives the same bytes"
    assert Mission.model_validate_json(log.metadata["mission"]).name == "bench"


def test_log_state_gives_an_account_each_second(tmp_path):
    bench = Bench(tmp_path / "drone4.mcap")
    bench.run(2.5)
    first, second = bench.states
    assert second.utime - first.utime == 1_000_000
    assert (second.path, second.ok, second.problem, second.n_lost) == ("drone4.mcap", True, "", 0)
    # up to 2 s: 39 setpoints, two beats at 0 and 1 s and the navigator's at 2 s, its own first state
    assert second.n_messages == 39 + 5 + 1
    assert second.n_bytes > first.n_bytes > 0
    assert bench.logger_beat.status == podwatch.heartbeat_t.OK


def test_a_gap_is_counted(tmp_path):
    bench = Bench(tmp_path / "drone4.mcap")
    bench.run(1.2)
    bench.publisher._sequence[channels.SETPOINT] += 3
    bench.run(2.2)
    assert [state.n_lost for state in bench.states] == [0, 3]


def test_a_respawned_logger_goes_on_in_a_new_file(tmp_path):
    path = tmp_path / "drone4.mcap"
    bench = Bench(path)
    bench.run(2.5)
    bench.logger.kill()
    Bench(path, offset_us=3_000_000).run(1.5)
    assert segments(path) == [path, tmp_path / "drone4.1.mcap"]
    with pytest.warns(match="was not closed"):
        assert len(list(read(path))) > 20


def test_the_same_run_gives_the_same_bytes_wherever_it_is_written(tmp_path):
    for name in ("a", "b"):
        bench = Bench(tmp_path / name / "drone4.mcap")
        bench.run(3.2)
        bench.logger.stop()
    assert (tmp_path / "a/drone4.mcap").read_bytes() == (tmp_path / "b/drone4.mcap").read_bytes()


def test_a_failed_write_stops_the_log_and_nothing_else(tmp_path):
    path = tmp_path / "drone4.mcap"
    bench = Bench(path)
    bench.run(2.5)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 100, hard))
    try:
        bench.run(4.5)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, ignored)
    assert not bench.states[-1].ok
    assert "drone4.mcap: writing failed (File too large); logging has stopped" in bench.states[-1].problem
    assert bench.logger_beat.status == podwatch.heartbeat_t.DEGRADED
    assert "writing failed" in bench.logger_beat.detail
    written = bench.states[-1].n_messages
    bench.run(6.5)
    assert bench.states[-1].n_messages == written
    bench.logger.stop()
    with pytest.warns(match="was not closed"):
        assert len(list(read(path))) > 20


def test_a_full_disk_closes_the_log_in_time(tmp_path, monkeypatch):
    free_gb = 0.7
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(64e9, 0, free_gb * 1e9))
    bench = Bench(tmp_path / "drone4.mcap")
    bench.run(2.5)
    assert bench.states[-1].ok
    assert bench.states[-1].disk_free_gb == pytest.approx(0.7)
    assert "disk nearly full: 0.70 GB left" in bench.logger_beat.detail
    free_gb = 0.1
    bench.run(4.5)
    assert not bench.states[-1].ok
    assert "disk full: 0.10 GB left" in bench.states[-1].problem
    assert "disk full" in bench.logger_beat.detail
    assert info(tmp_path / "drone4.mcap").closed


def test_space_that_comes_back_is_no_trouble_any_more(tmp_path, monkeypatch):
    free_gb = 0.7
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(64e9, 0, free_gb * 1e9))
    bench = Bench(tmp_path / "drone4.mcap")
    bench.run(2.5)
    free_gb = 50.0
    bench.run(4.5)
    assert bench.logger_beat.status == podwatch.heartbeat_t.OK
    assert bench.states[-1].disk_free_gb == 2.0  # all that it says


def test_a_log_that_cannot_be_made_leaves_the_logger_beating(tmp_path):
    (tmp_path / "file").write_text("")
    bench = Bench(tmp_path / "file" / "drone4.mcap")
    bench.run(2.5)
    assert not bench.states[-1].ok
    assert "nothing is logged" in bench.logger_beat.detail
    bench.logger.stop()


def test_a_time_that_a_log_cannot_hold_is_told_and_logging_goes_on(tmp_path):
    bench = Bench(tmp_path / "drone4.mcap", offset_us=-1_500_000)
    bench.run(3.5)
    bench.logger.stop()
    assert "outside 0 to" in bench.logger_beat.detail
    assert info(tmp_path / "drone4.mcap").span_s > 1.8


def test_settings_without_a_log_are_refused_with_the_remedy(tmp_path):
    settings = DroneSettings(drone_id=4, mission=Mission())
    runtime = QueueRuntime("logger", settings, VirtualBus(EventQueue()), ClockError(), {})
    with pytest.raises(RuntimeFailure, match=r'set "log_path" to the \.mcap file'):
        logger_process.setup(runtime)


@pytest.mark.parametrize(
    ("log_every", "kept"),
    [(1, [True] * 6), (3, [True, False, False, True, False, False]), (0, [False] * 6)],
)
def test_the_channel_table_says_which_messages_are_kept(monkeypatch, log_every, kept):
    frames = dataclasses.replace(channels.BY_NAME[channels.FRAME], log_every=log_every)
    monkeypatch.setitem(channels.BY_NAME, channels.FRAME, frames)
    selection = Selection()
    assert [selection.keeps(channels.FRAME) for _ in range(6)] == kept
    assert [selection.keeps(channels.received(2, channels.FRAME)) for _ in range(6)] == kept
    assert selection.keeps("STRANGER")


@pytest.mark.parametrize(
    ("free_gb", "is_full", "words"),
    [
        (5.0, False, ""),
        (1.0, False, ""),
        (0.99, False, "nearly full: 0.99 GB"),
        (0.19, True, "full: 0.19 GB"),
    ],
)
def test_disk_space(free_gb, is_full, words):
    assert disk_is_full(free_gb) == is_full
    assert words in disk_trouble(free_gb)
    assert bool(disk_trouble(free_gb)) == bool(words)


def test_messages_of_another_version_are_kept_raw(tmp_path):
    bench = Bench(tmp_path / "drone4.mcap")
    bench.logger.raw_arrived(channels.TRACK, b"other version's bytes")
    bench.logger.raw_arrived(channels.TRACK, make(podwatch.track_t, utime=1, seq=1).encode())
    bench.logger.stop()
    with pytest.warns(match="carries fingerprint"):
        tracks = [message for name, _, message in read(tmp_path / "drone4.mcap") if name == channels.TRACK]
    assert tracks[0] == b"other version's bytes"
    assert tracks[1].seq == 1
