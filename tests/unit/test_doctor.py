"""`podwatch doctor`: each thing is really broken, and exit code and the command that mends it are told."""

import os
import shutil
import socket
import subprocess
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.talker import beat, saying_again, talking
from tools import errors
from tools.buses import N_SLOTS, bus_url, free_udp_ports
from tools.cli import app
from tools.doctor import machine
from tools.doctor.mend import as_root, restored_model
from tools.findings import Finding
from tools.fleet.edges import check_autopilot
from tools.fleet.machine import machine_of, read_fleet

PODWATCH = f"{sys.executable} -c 'from tools.cli import main; main()'"
NAMESPACES = ("unshare", "--map-root-user", "--mount", "--net")


def can_unshare() -> bool:
    """Whether this kernel lets this user have a network and mounts of their own."""
    if shutil.which("unshare") is None:
        return False
    return subprocess.run([*NAMESPACES, "true"], capture_output=True, check=False).returncode == 0


def apart(script: str) -> str:
    """What a shell script says in a network and with mounts of its own, nothing of which leaves it."""
    done = subprocess.run([*NAMESPACES, "sh", "-c", script], capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def doctor(*arguments: object) -> tuple[int, str]:
    """(exit code, what it said on one line)."""
    result = CliRunner().invoke(app, ["doctor", *map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    return result.exit_code, " ".join(result.output.split())


def broken(monkeypatch: pytest.MonkeyPatch, name: str, **inputs: Any) -> str:
    """What doctor says of one check with other inputs, once it has said that something is wrong."""
    monkeypatch.setattr(machine, name, partial(getattr(machine, name), **inputs))
    only = {
        "check_receive_buffer": "rmem_max",
        "check_slots": "slots",
        "check_model": "model",
        "check_java": "java",
    }[name]
    code, said = doctor("--only", only)
    assert code == errors.MISSING == 3
    assert said.startswith("wrong")
    return said


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    """A fleet file of one drone with its key; its edges are what every machine has."""
    path = tmp_path / "fleet.toml"
    for words in (["new", path, "--drones", 1], ["keys", path]):
        assert CliRunner().invoke(app, ["fleet", *map(str, words)]).exit_code == 0
    ports = free_udp_ports(2)
    text = path.read_text().replace("10.76.0.1:14600", f"127.0.0.1:{ports[0]}")
    path.write_text(text.replace("serial:/dev/ttyAMA0:921600", f"udp:127.0.0.1:{ports[1]}"))
    return path


def test_without_a_route_the_command_that_is_told_makes_a_bus(monkeypatch):
    mend = "ip link set lo up && ip route replace 239.255.76.0/24 dev lo"
    check = f"{PODWATCH} doctor --only multicast; echo exit $?;"
    bus = f"import lcm; lcm.LCM({bus_url(1, 0)!r}); print('a bus')"
    if can_unshare():
        said = apart(f'{check} {mend}; {check} {sys.executable} -c "{bus}"')
        assert "wrong multicast" in said
        assert said.index(mend) < said.index("exit 3") < said.index("exit 0") < said.index("a bus")
    else:
        monkeypatch.setattr(machine, "has_multicast_route", lambda: False)
        code, said = doctor("--only", "multicast")
        assert code == 3
        assert "ip route replace 239.255.76.0/24 dev lo" in said


def test_a_drones_bus_that_leaves_the_loopback_is_told(monkeypatch):
    monkeypatch.setattr(machine, "has_multicast_route", lambda: True)
    monkeypatch.setattr(machine, "_source_address", lambda: "10.1.2.3")
    finding = machine.check_route(on_drone=True)
    assert "interface of 10.1.2.3" in finding.lacks
    assert finding.mend.startswith(
        as_root("ip route replace 239.255.76.0/24 dev lo") + "  # until the next boot"
    )
    assert "podwatch fleet units" in finding.mend


def test_a_bus_that_is_not_heard_is_told(monkeypatch):
    monkeypatch.setattr(machine, "has_multicast_route", lambda: True)
    monkeypatch.setattr(machine, "_source_address", lambda: "127.0.0.1")
    monkeypatch.setattr(machine, "_hears_itself", lambda: False)
    assert "iptables -I INPUT" in machine.check_route().mend


def test_a_kernel_that_grants_less_than_is_wanted_is_told(monkeypatch):
    granted = machine.check_receive_buffer(1 << 30)
    assert granted.lacks, "no kernel grants a bus 1 GiB"
    said = broken(monkeypatch, "check_receive_buffer", wanted_bytes=1 << 30)
    assert f"echo net.core.rmem_max={1 << 30} | {as_root('tee /etc/sysctl.d/90-podwatch.conf')} && " in said
    assert as_root("sysctl -p /etc/sysctl.d/90-podwatch.conf") in said, "at once, and at every boot"
    monkeypatch.undo()
    assert machine.check_receive_buffer(4096).lacks == ""
    assert machine.RECEIVE_BYTES == 4194304


def test_a_port_that_a_program_has_for_itself_is_told_with_that_program(monkeypatch):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("", 0))
        port = taken.getsockname()[1]
        said = broken(monkeypatch, "check_slots", first_port=port - 3, taken=lambda: [0, 1, 2])
    assert f"udp {port} of slot 3" in said
    assert f"kill {os.getpid()}" in said
    monkeypatch.undo()
    assert machine.check_slots(port - 3, lambda: [0, 1, 2]).lacks == ""


def test_no_free_slot_is_told(monkeypatch):
    said = broken(monkeypatch, "check_slots", taken=lambda: range(N_SLOTS))
    assert "lsof /tmp/podwatch-slot-*.lock" in said


@pytest.mark.parametrize(
    ("options", "mend"), [("ro", "mount -o remount,rw /dev/shm"), ("size=1m", "mount -o remount,size=")]
)
def test_shared_memory_that_is_full_or_read_only_is_mended_by_what_is_told(tmp_path, options, mend):
    if can_unshare():
        check = f"{PODWATCH} doctor --only shm > {tmp_path}/said; echo exit $?; cat {tmp_path}/said;"
        told = f'eval "$(grep remount {tmp_path}/said)"'
        said = apart(f"mount -t tmpfs -o {options} tmpfs /dev/shm && {check} {told} && {check}")
        assert mend in said
        assert "for good" in said
        assert "/etc/fstab" in said
        assert [line for line in said.splitlines() if line.startswith("exit")] == ["exit 3", "exit 0"], said
    else:
        free_bytes = shutil.disk_usage(tmp_path).free
        assert "remount,size=" in machine.check_shared_memory(2 * free_bytes, tmp_path).mend


def test_shared_memory_that_is_not_there_is_told(tmp_path):
    finding = machine.check_shared_memory(1, tmp_path / "none")
    assert f"mount -t tmpfs tmpfs {tmp_path / 'none'}" in finding.mend
    assert machine.check_shared_memory(1, tmp_path).lacks == ""
    assert list(tmp_path.iterdir()) == [], "it leaves nothing behind"


@pytest.mark.parametrize("kept", [0, 1000])
def test_a_broken_model_is_told(monkeypatch, tmp_path, kept):
    from models import path

    model = tmp_path / "detector.onnx"
    model.write_bytes(path("detector.onnx").read_bytes()[:kept])
    said = broken(monkeypatch, "check_model", path=model)
    assert str(model) in said
    assert restored_model() in said


def test_a_model_comes_back_from_the_checkout_or_from_where_it_was_installed(monkeypatch, tmp_path):
    (tmp_path / "a copy" / ".git").mkdir(parents=True)
    copy = tmp_path / "a copy"
    assert restored_model(copy) == f"git -C '{copy}' checkout models/detector.onnx"
    wheel = SimpleNamespace(read_text=lambda _: '{"url": "file:///srv/podwatch-0.1.0.whl"}')
    for told, source in (
        (wheel, "file:///srv/podwatch-0.1.0.whl"),
        (SimpleNamespace(read_text=lambda _: None), "PATH"),
    ):
        monkeypatch.setattr("importlib.metadata.distribution", lambda _, told=told: told)
        command = restored_model(tmp_path)
        assert f"pip install --force-reinstall --no-deps {source}" in command, "it is in no registry"


def test_a_checkout_whose_model_is_lost_is_mended_by_what_is_told(tmp_path):
    root = tmp_path / "podwatch"
    (root / "models").mkdir(parents=True)
    model = root / "models" / "detector.onnx"
    model.write_bytes(b"whole")
    git = ["git", "-C", str(root), "-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "all"]):
        subprocess.run([*git, *words], check=True)
    model.write_bytes(b"wh")
    subprocess.run(restored_model(root), shell=True, check=True, capture_output=True)
    assert model.read_bytes() == b"whole"


def test_a_key_that_others_can_read_is_told(fleet):
    key = fleet.parent / "fleet.key"
    assert doctor(fleet, "--only", "slots")[0] == 0
    key.chmod(0o644)
    code, said = doctor(fleet, "--only", "slots")
    assert code == 3
    assert f"chmod 600 {key}" in said


def test_a_camera_that_is_not_there_is_told(monkeypatch, fleet):
    monkeypatch.setattr("tools.fleet.check.LISTEN_S", 0.1)
    fleet.write_text(fleet.read_text().replace("v4l2:/dev/video0", "v4l2:/dev/video77"))
    code, said = doctor(fleet, "--drone", 1, "--only", "slots")
    assert code == 3
    assert "/dev/video77 is not there" in said
    assert "ls /dev/tty* /dev/video*" in said


def test_an_autopilots_port_that_is_taken_and_a_silent_one_are_told(monkeypatch, fleet):
    monkeypatch.setattr("tools.fleet.check.LISTEN_S", 0.1)
    [port] = free_udp_ports(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", port))
        finding = check_autopilot(f"udp:127.0.0.1:{port}", 1, 0.05)
    assert "does another program use it" in finding.lacks
    assert f"ss -lunp sport = :{port}" in finding.mend
    silent = check_autopilot(f"udp:127.0.0.1:{port}", 1, 0.05)
    assert "silent for 0.05 s" in silent.lacks
    assert silent.mend.startswith(f"mavproxy.py --out=udp:127.0.0.1:{port}")
    assert "/dev/ttyNONE is not there" in check_autopilot("serial:/dev/ttyNONE:57600", 1, 0.05).lacks
    mute, far = os.openpty()
    try:
        silent = check_autopilot(f"serial:{os.ttyname(far)}:57600", 1, 0.05)
        assert silent.mend.startswith(f"mavproxy.py --master={os.ttyname(far)} --baudrate=57600")
    finally:
        os.close(mute)
        os.close(far)
    assert check_autopilot(f"tcp:127.0.0.1:{port}", 1, 0.05).mend.startswith(f"nc -vz 127.0.0.1 {port}")
    code, said = doctor(fleet, "--drone", 1, "--only", "slots")
    assert code == 3
    assert "mavproxy.py --out=udp:127.0.0.1:" in said


def test_the_autopilot_of_the_drones_own_id_is_well_and_nothing_else_is():
    [port] = free_udp_ports(1)
    address = f"udp:127.0.0.1:{port}"
    with talking(beat(7) + beat(2), port):
        assert check_autopilot(address, 2, 5.0) == Finding("autopilot", f"{address}: system 2 speaks MAVLink")
    with talking(beat(1), port):
        other = check_autopilot(address, 2, 0.2)
    assert "the autopilot of system 1 beats, only 2 would be heard" in other.lacks
    assert "param set MAV_SYSID 2 (before ArduPilot 4.7: SYSID_THISMAV)" in other.mend
    with talking(beat(2, 191), port):
        assert "MAVLink, but no autopilot's heartbeat" in check_autopilot(address, 2, 0.2).lacks
    with talking(b"x" * 40, port):
        assert "bytes that are no MAVLink" in check_autopilot(address, 2, 0.2).lacks


def test_an_autopilot_that_waits_to_be_spoken_to_is_heard():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as far:
        far.bind(("127.0.0.1", 0))
        far.setblocking(False)

        def answer() -> None:
            with suppress(BlockingIOError):
                far.sendto(beat(2), far.recvfrom(100)[1])

        with saying_again(answer, 0.01):
            assert check_autopilot(f"udpout:127.0.0.1:{far.getsockname()[1]}", 2, 5.0).lacks == ""


@pytest.mark.parametrize("command", ["doctor", "fleet check"])
def test_both_commands_hear_that_an_autopilot_has_another_drones_id(monkeypatch, fleet, command):
    monkeypatch.setattr("tools.fleet.check.LISTEN_S", 0.2)
    address = machine_of(read_fleet(fleet), 1).autopilot
    with talking(beat(3), int(address.rpartition(":")[2])):
        result = CliRunner().invoke(app, [*command.split(), str(fleet), "--drone", "1"])
    assert "the autopilot of system 3 beats, only 1 would be heard" in " ".join(result.output.split())
    assert result.exit_code == errors.MISSING


def test_without_java_the_command_that_installs_it_is_told(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    code, said = doctor("--only", "java")
    assert code == 3
    assert as_root("apt-get install default-jre") in said


def test_a_drones_machine_needs_no_java(monkeypatch, fleet):
    monkeypatch.setattr("tools.fleet.check.LISTEN_S", 0.1)
    assert "java" not in doctor(fleet, "--drone", 1)[1]


def test_what_is_well_is_said_and_ends_with_0(monkeypatch):
    for name in ("check_route", "check_receive_buffer", "check_java"):
        monkeypatch.setattr(machine, name, lambda **_: Finding("thing", "as it should be"))
    code, said = doctor("--without", "shm")
    assert code == 0
    assert "wrong" not in said
    assert "/dev/shm" not in said


def test_a_name_that_is_no_check_and_a_drone_without_its_file_are_refused():
    assert doctor("--only", "coffee")[0] == errors.UNUSABLE
    assert doctor("--drone", 1)[0] == errors.UNUSABLE


def test_a_drone_that_the_file_does_not_have_is_told_before_anything_is_looked_at(fleet):
    code, said = doctor(fleet, "--drone", 9)
    assert code == errors.UNUSABLE
    assert said.startswith("podwatch: drone 9 is not in the roster [1]")
