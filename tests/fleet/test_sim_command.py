"""`podwatch sim` as people start it: on a machine without a multicast route, and stopped by Ctrl-C."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner

from drivers.sim.clock import ClockPage
from tools import buses
from tools.buses import has_multicast_route
from tools.cli import app
from tools.sim.processes import SHARED_FOLDER

ROOT = Path(__file__).parents[2]
PODWATCH = (sys.executable, "-c", "from tools.cli import main; main()")
QUICK = ("sim", "--headless", "--sensor", "boxes", "--drones", "1")
REASON = "no multicast route; for real buses, as root: ip route replace 239.255.76.0/24 dev lo"
START_LIMIT_S = 120.0
STOP_LIMIT_S = 60.0


def a_network_without_routes() -> tuple[str, ...]:
    """The words that run a command in a network namespace of its own; none where that is not allowed."""
    for words in (("unshare", "-n"), ("unshare", "-r", "-n")):
        try:
            if subprocess.run([*words, "true"], capture_output=True, timeout=20).returncode == 0:
                return words
        except OSError:
            break
    return ()


def no_way_out(*_: object) -> int:
    raise OSError(101, "Network is unreachable")


class CutSocket(socket.socket):
    """A socket of a machine without a route."""

    sendto = no_way_out  # type: ignore[assignment]


def fell_back(said: str, folder: Path) -> None:
    """The run flew in lockstep, and says so where people look."""
    assert f"Flying in lockstep: {REASON}" in said.replace("\n", " ")
    [path] = folder.glob("*/summary.json")
    summary = json.loads(path.read_text())
    assert (summary["mode"], summary["fallback_reason"]) == ("lockstep", REASON)


def test_a_machine_whose_packets_find_no_way_out_has_no_route_and_falls_back(tmp_path, monkeypatch):
    monkeypatch.setattr(buses.socket, "socket", CutSocket)
    assert not has_multicast_route()
    result = CliRunner().invoke(app, [*QUICK, "--duration", "2", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    fell_back(result.stdout, tmp_path)
    result = CliRunner().invoke(app, [*QUICK, "--autopilot", "127.0.0.1:1", "--out", str(tmp_path)])
    assert result.exit_code == 3
    assert REASON in result.stderr


def test_in_a_network_without_routes_it_falls_back(tmp_path, monkeypatch):
    words = a_network_without_routes()
    if not words:  # this machine allows no network of our own: the probe's answer must do
        monkeypatch.setattr(buses.socket, "socket", CutSocket)
        assert not has_multicast_route()
        return
    command = [*words, *PODWATCH, *QUICK, "--duration", "2", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    fell_back(done.stdout, tmp_path)


def processes_of(folder: Path) -> list[psutil.Process]:
    """What runs with the folder in its command line."""
    return [
        process
        for process in psutil.process_iter(["cmdline"])
        if any(str(folder) in word for word in process.info["cmdline"] or [])
    ]


def clock_page(folder: Path) -> Path:
    """The run's clock in shared memory, from the world's settings."""
    return Path(json.loads((folder / "output" / "world.json").read_text())["clock_page"])


def simulated_s(parent: Path) -> float:
    """How far the run in this folder has come, 0 before it begins."""
    begun = [path.parent.parent for path in parent.glob("*/output/supervisord.conf")]
    return ClockPage(clock_page(begun[0])).read()[0] / 1e6 if begun else 0.0


@pytest.mark.timeout(240)
def test_ctrl_c_stops_a_fleet_of_processes_in_order_and_judges_what_was_logged(tmp_path):
    runs = tmp_path / "my runs, 100 %"  # as people call folders
    command = [*PODWATCH, *QUICK, "--duration", "300", "--out", str(runs)]
    # Its own group, as at a prompt: Ctrl-C reaches all of the group at once.
    sim = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        deadline = time.monotonic() + START_LIMIT_S
        while simulated_s(runs) < 1.0:
            assert time.monotonic() < deadline, "the clock has not begun to run"
            assert sim.poll() is None, sim.communicate()
            select.select([], [], [], 0.1)
        os.killpg(sim.pid, signal.SIGINT)
        said, errors = sim.communicate(timeout=STOP_LIMIT_S)
    finally:
        sim.kill()
        sim.communicate()
    assert sim.returncode == 130, errors
    assert "Stopped before its end; what was logged is judged." in said
    assert errors == ""
    [folder] = runs.iterdir()
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["mode"], summary["fallback_reason"]) == ("processes", None)
    assert (folder / "report.html").exists()
    assert processes_of(folder) == []
    named = clock_page(folder).name.removesuffix("clock")
    assert [path.name for path in SHARED_FOLDER.glob(f"{named}*")] == []


def test_a_process_that_cannot_start_ends_the_run_at_once_and_says_why(tmp_path):
    """The address of the autopilot is another program's."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{other.getsockname()[1]}"
        done = subprocess.run(
            [*PODWATCH, *QUICK, "--out", str(tmp_path), "--autopilot", address],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=START_LIMIT_S,
        )
    assert done.returncode == 3, done.stderr
    assert f"world: cannot listen on udp {address}" in done.stderr
    assert "does another program use it?" in done.stderr
    assert "Traceback" not in done.stderr
    [folder] = tmp_path.iterdir()
    assert processes_of(folder) == []
