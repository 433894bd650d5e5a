"""`podwatch fly`: one drone on its own machine by the fleet file, its autopilot in another process."""

import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import lcm
import numpy as np
import psutil
import pytest

from lcmtypes import channels
from lcmtypes.podwatch import frame_t, heartbeat_t, vehicle_state_t
from logs.reader import info
from procs import processes
from procs.relay.keys import make_key
from tests.bus.autopilot_flights import start_twin
from tools.buses import free_udp_ports
from tools.errors import INTERRUPTED, MISSING, UNUSABLE

ROOT = Path(__file__).parents[2]
DRONE = 7
READY_S = 90.0
CLIMB_S = 90.0
SHARED = Path("/dev/shm")

pytestmark = pytest.mark.timeout(240)

FLEET = """
name = "bench"
[search]
start = "auto"
[camera]
rate_hz = 5.0
[[drones]]
id = 7
[drones.machine]
radio = "127.0.0.1:{radio}"
autopilot = "udp:127.0.0.1:{autopilot}"
camera = "pictures:{pictures}"
"""


def written_fleet(folder: Path) -> tuple[Path, int]:
    """A fleet file of one drone with its key and camera -> (the file, the autopilot's port)."""
    radio, autopilot = free_udp_ports(2)
    pictures = folder / "pictures"
    pictures.mkdir()
    random = np.random.default_rng(1)
    for k in range(2):
        cv2.imwrite(str(pictures / f"{k}.png"), random.integers(60, 120, (480, 640, 3), np.uint8))
    path = folder / "fleet.toml"
    path.write_text(FLEET.format(radio=radio, autopilot=autopilot, pictures=pictures))
    make_key(folder / "fleet.key")
    return path, autopilot


def command(path: Path, drone: int = DRONE) -> list[str]:
    out = str(path.parent / "runs")
    return [
        sys.executable,
        "-c",
        "from tools.cli import main; main()",
        "fly",
        str(path),
        "--drone",
        str(drone),
        "--out",
        out,
    ]


class Flight:
    """The command in a process of its own, and what its drone's bus says."""

    def __init__(self, path: Path) -> None:
        self.beats: dict[str, heartbeat_t] = {}
        self.vehicle: vehicle_state_t | None = None
        self.frames: list[frame_t] = []
        self.popen = subprocess.Popen(
            command(path), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def listen(self) -> None:
        """Join the bus that the command names."""
        assert self.popen.stdout is not None
        line = self.popen.stdout.readline()
        found = re.search(r"-> (\S+), bus (\S+)", line)
        assert found, line + self.popen.stdout.read()
        self.folder = Path(found[1])
        self.bus = lcm.LCM(found[2])
        self.bus.subscribe(channels.HEARTBEAT, self._beat)
        self.bus.subscribe(channels.FRAME, lambda _, data: self.frames.append(frame_t.decode(data)))
        self.bus.subscribe(channels.VEHICLE_STATE, self._flies)

    def _beat(self, _channel: str, data: bytes) -> None:
        beat = heartbeat_t.decode(data)
        self.beats[beat.process] = beat

    def _flies(self, _channel: str, data: bytes) -> None:
        self.vehicle = vehicle_state_t.decode(data)

    def await_that(self, what: Callable[[], object], limit_s: float) -> None:
        deadline = time.monotonic() + limit_s
        while not what():
            assert time.monotonic() < deadline, (sorted(self.beats), self.vehicle and vars(self.vehicle))
            assert self.popen.poll() is None, self.popen.stdout and self.popen.stdout.read()
            if select.select([self.bus], [], [], 0.5)[0]:
                self.bus.handle()


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flight]:
    path, port = written_fleet(tmp_path_factory.mktemp("fly"))
    twin = start_twin(f"udpout:127.0.0.1:{port}", scale=1.0, system_id=DRONE)
    flown = Flight(path)
    try:
        flown.listen()
        yield flown
    finally:
        twin.kill()
        twin.wait()
        if flown.popen.poll() is None:
            flown.popen.terminate()
        flown.popen.wait(timeout=60)
        assert flown.popen.stdout is not None
        flown.popen.stdout.close()


def test_every_process_beats_and_the_drone_takes_off_by_the_real_links(flight):
    flight.await_that(lambda: len(flight.beats) == len(processes.PROCESSES), READY_S)
    assert set(flight.beats) == set(processes.BY_NAME)
    flight.await_that(lambda: flight.frames and flight.vehicle and flight.vehicle.d_m < -3, CLIMB_S)
    assert flight.frames[-1].width == 640
    tree = psutil.Process(flight.popen.pid).children(recursive=True)
    words = [" ".join(process.cmdline()) for process in tree]
    assert not [line for line in words if "tools.sim" in line or "drivers.sim" in line]


def test_one_that_is_killed_is_started_again(flight):
    first = flight.beats["navigator"].pid
    os.kill(first, signal.SIGKILL)
    flight.await_that(lambda: flight.beats["navigator"].pid != first, READY_S)
    assert not psutil.pid_exists(first)
    assert psutil.Process(flight.beats["navigator"].pid).is_running()
    assert set(flight.beats) == set(processes.BY_NAME), "and nobody else is missing"


def test_sigterm_ends_all_in_order_and_leaves_nothing(flight):
    tree = psutil.Process(flight.popen.pid).children(recursive=True)
    ring = flight.frames[-1].ring
    assert (SHARED / ring).exists()
    flight.popen.terminate()
    assert flight.popen.wait(timeout=60) == INTERRUPTED
    _, alive = psutil.wait_procs(tree, timeout=10)
    assert not alive
    assert not (SHARED / ring).exists()
    log = info(flight.folder / f"drone_{DRONE}.mcap")
    assert log.closed


def test_a_machine_or_file_that_cannot_fly_is_told_before_anything_starts(tmp_path):
    path, _ = written_fleet(tmp_path)
    stranger = subprocess.run(command(path, 3), cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert stranger.returncode == UNUSABLE
    assert "drone 3 is not in the roster [7]" in stranger.stderr
    (tmp_path / "fleet.key").unlink()
    keyless = subprocess.run(command(path), cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert keyless.returncode == MISSING
    assert "no fleet key can be read" in keyless.stderr
    assert not (tmp_path / "runs").exists()


def test_nothing_of_the_simulator_is_imported_to_fly():
    code = "import sys, tools.fleet.flight, tools.fly;print([name for name in sys.modules if '.sim' in name])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr
