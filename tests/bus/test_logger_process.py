"""The logger as a real process on a real bus: killed at work, started again, and stopped."""

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import lcm
import pytest

from drivers.clocks.monotonic import BOOT_ID, MonotonicClock
from lcmtypes import channels, make, podwatch
from logs.reader import info, read, segments
from procs.settings import DroneSettings, Mission

ROOT = Path(__file__).parents[2]
DEADLINE_S = 30.0
LATE_US = 500_000  # what a busy machine may run a timer late
PERIOD_MS = 10


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


class Drone:
    """A bus with a logger process on it, and VEHICLE_STATE said every 10 ms while we wait."""

    def __init__(self, folder: Path) -> None:
        url = f"udpm://239.255.76.190:{free_port()}?ttl=0&recv_buf_size=4194304"
        self.log = folder / "drone1.mcap"
        self._settings = folder / "drone1.json"
        settings = DroneSettings(drone_id=1, mission=Mission(), bus_url=url, log_path=str(self.log))
        self._settings.write_text(settings.model_dump_json())
        self._bus = lcm.LCM(url)
        self._bus.subscribe(channels.LOG_STATE, self._heard)
        self._clock = MonotonicClock()
        self.states: list[podwatch.log_state_t] = []
        self.said: dict[int, int] = {}  # seq -> utime
        self.process: subprocess.Popen[bytes] | None = None

    def start_logger(self) -> None:
        command = [sys.executable, "-m", "procs.main", "logger", str(self._settings)]
        self.process = subprocess.Popen(command, cwd=ROOT)

    def wait_for_states(self, n_states: int) -> None:
        """Go on saying VEHICLE_STATE until the logger has given `n_states` more accounts."""
        wanted = len(self.states) + n_states
        deadline = time.monotonic() + DEADLINE_S
        while len(self.states) < wanted:
            assert time.monotonic() < deadline, (
                f"{len(self.states)} LOG_STATE of {wanted} within {DEADLINE_S} s"
            )
            self._bus.handle_timeout(PERIOD_MS)
            utime, seq = self._clock.utime(), len(self.said)
            self.said[seq] = utime
            message = make(podwatch.vehicle_state_t, utime=utime, seq=seq, drone_id=1)
            self._bus.publish(channels.VEHICLE_STATE, message.encode())

    def _heard(self, _channel: str, data: bytes) -> None:
        self.states.append(podwatch.log_state_t.decode(data))


@pytest.fixture
def drone(tmp_path: Path) -> Iterator[Drone]:
    drone = Drone(tmp_path)
    yield drone
    if drone.process is not None:
        drone.process.kill()
        drone.process.wait()


def test_a_killed_logger_leaves_a_log_up_to_its_last_second_and_its_successor_goes_on(drone):
    drone.start_logger()
    drone.wait_for_states(3)
    assert drone.states[-1].ok
    assert (drone.states[-1].path, drone.states[-1].n_lost) == ("drone1.mcap", 0)
    drone.process.send_signal(signal.SIGKILL)
    drone.process.wait()
    killed_utime = drone.said[len(drone.said) - 1]

    with pytest.warns(match="was not closed"):
        logged = [message.seq for _, _, message in read(drone.log, channels=channels.VEHICLE_STATE)]
    assert logged == list(range(logged[0], logged[-1] + 1))
    assert drone.said[logged[-1]] >= killed_utime - 1_000_000 - LATE_US
    assert drone.said[logged[0]] <= drone.states[0].utime - 900_000

    first_log = drone.log.read_bytes()
    drone.start_logger()
    drone.wait_for_states(2)
    drone.process.send_signal(signal.SIGTERM)
    assert drone.process.wait(timeout=DEADLINE_S) == 0
    assert drone.log.read_bytes() == first_log
    _, successor = segments(drone.log)
    log = info(successor)
    assert (log.closed, log.problems) == (True, ())
    assert log.metadata["boot"] == BOOT_ID.read_text().strip()
    assert {channel.name: channel.n_lost for channel in log.channels} == {
        "HEARTBEAT": 0,
        "LOG_STATE": 0,
        "VEHICLE_STATE": 0,
    }
    assert list(read(successor, strict=True))
