"""A process under systemd: it says when it is up, that it lives, and that it ends."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from procs.notify import Notifier
from procs.settings import DroneSettings, Mission
from tools.buses import free_udp_ports

ROOT = Path(__file__).parents[2]
DEADLINE_S = 40.0


@pytest.fixture(params=["path", "abstract"])
def systemd(request, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """The socket on which systemd listens, and its name as a unit's process is given it."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@podwatch-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(name.replace("@", "\0", 1))
        listener.settimeout(DEADLINE_S)
        yield listener, name


def test_a_process_says_that_it_is_up_lives_and_ends(systemd, tmp_path):
    listener, name = systemd
    url = f"udpm://239.255.76.195:{free_udp_ports(1)[0]}?ttl=0"
    settings = DroneSettings(
        drone_id=2, mission=Mission(), bus_url=url, run_dir=str(tmp_path), log_path=str(tmp_path / "log.mcap")
    )
    path = tmp_path / "drone.json"
    path.write_text(settings.model_dump_json())
    command = [sys.executable, "-m", "procs.main", "assigner", str(path)]
    with subprocess.Popen(command, cwd=ROOT, env={**os.environ, "NOTIFY_SOCKET": name}) as process:
        try:
            beats = [listener.recv(1024).decode() for _ in range(3)]
            process.terminate()
            while (last := listener.recv(1024).decode()) in beats:
                continue
        finally:
            process.kill()
    assert beats == ["READY=1\nWATCHDOG=1\nSTATUS=ok"] * 3, "one at each heartbeat"
    assert last == "STOPPING=1"


def test_what_a_process_starts_itself_does_not_speak_for_it(systemd, monkeypatch):
    listener, name = systemd
    monkeypatch.setenv("NOTIFY_SOCKET", name)
    notifier = Notifier()
    assert "NOTIFY_SOCKET" not in os.environ
    notifier.beat("camera:\nno image " + "x" * 500)
    said = listener.recv(4096).decode().split("\n")
    assert said[:2] == ["READY=1", "WATCHDOG=1"]
    assert said[2].startswith("STATUS=camera: no image xx")
    assert len(said) == 3
    assert len(said[2]) < 300
    notifier.stopping()
    assert listener.recv(4096) == b"STOPPING=1"
    notifier.beat("ok")
    listener.setblocking(False)
    with pytest.raises(BlockingIOError):
        listener.recv(4096)


def test_without_systemd_nothing_is_said(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    opened: list[object] = []
    monkeypatch.setattr(socket, "socket", lambda *kind: opened.append(kind))
    notifier = Notifier()
    notifier.beat("ok")
    notifier.stopping()
    assert opened == []
