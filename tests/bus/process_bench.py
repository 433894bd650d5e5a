"""One real process of a drone on a bus of its own, and what it says there."""

import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import lcm
import pytest

from lcmtypes import channels
from lcmtypes.podwatch import heartbeat_t, setpoint_t
from procs.settings import DroneSettings, Mission

ROOT = Path(__file__).parents[2]
DEADLINE_S = 40.0


class Bench:
    """A bus, what is said on it, and one process."""

    def __init__(self, folder: Path) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("", 0))
            url = f"udpm://239.255.76.194:{probe.getsockname()[1]}?ttl=0&recv_buf_size=4194304"
        self.settings = DroneSettings(
            drone_id=2, mission=Mission(), bus_url=url, run_dir=str(folder), log_path=str(folder / "log.mcap")
        )
        self.settings_path = folder / "drone.json"
        self.bus = lcm.LCM(url)
        self.bus.subscribe(channels.SETPOINT, self._hear_setpoint)
        self.bus.subscribe(channels.HEARTBEAT, self._hear_beat)
        self.setpoints: list[int] = []
        self.beats: list[heartbeat_t] = []
        self.process: subprocess.Popen[str] | None = None

    def start(self, *command: str) -> None:
        self.settings_path.write_text(self.settings.model_dump_json())
        words = [str(self.settings_path) if word == "SETTINGS" else word for word in command]
        self.process = subprocess.Popen(
            [sys.executable, *words], cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True
        )

    def await_that(self, what: Callable[[], object]) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not what():
            assert time.monotonic() < deadline
            if self.process is not None and self.process.poll() is not None:
                pytest.fail(f"it ended with {self.end()}")
            self.bus.handle_timeout(50)

    def end(self) -> tuple[int, str]:
        """The exit code of the process, once it has ended, and what it said."""
        assert self.process is not None
        _, said = self.process.communicate(timeout=DEADLINE_S)
        while self.bus.handle_timeout(0) > 0:
            pass
        return self.process.returncode, said

    def _hear_setpoint(self, _channel: str, data: bytes) -> None:
        self.setpoints.append(setpoint_t.decode(data).utime)

    def _hear_beat(self, _channel: str, data: bytes) -> None:
        self.beats.append(heartbeat_t.decode(data))
