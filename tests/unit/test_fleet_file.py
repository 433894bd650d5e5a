"""The fleet file: what `podwatch fleet` writes, what a drone is told from it, and what it still lacks."""

import os
import shutil
import socket
import stat
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from procs.bus_executor import load_driver
from procs.relay.keys import read_key
from procs.runtime import RuntimeFailure
from procs.settings import MAX_DRONES, Mission, MissionError, load_mission
from tests.talker import beat, talking
from tools import errors
from tools.buses import free_udp_ports
from tools.cli import app
from tools.doctor.mend import restored_model
from tools.findings import Finding
from tools.fleet import check
from tools.fleet.machine import boat_radio, drone_settings, machine_of, read_fleet
from tools.sim.settings import SimMission

NOBODY = 65534


def podwatch(*arguments: object) -> Any:
    result = CliRunner().invoke(app, ["fleet", *map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    return result


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    """A new fleet file of three drones, with its key."""
    path = tmp_path / "fleet.toml"
    assert podwatch("new", path).exit_code == 0
    assert podwatch("keys", path).exit_code == 0
    return path


@pytest.fixture
def bench(fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same, wired to what every machine has, on a machine with a bus."""
    cv2.imwrite(str(tmp_path / "sea.png"), np.full((480, 640, 3), 90, np.uint8))
    ports = iter(free_udp_ports(7))
    text = fleet.read_text().replace("v4l2:/dev/video0", f"pictures:{tmp_path}")
    for k in (1, 2, 3):
        text = text.replace(f"10.76.0.{k}:14600", f"127.0.0.1:{next(ports)}")
        text = text.replace("serial:/dev/ttyAMA0:921600", f"udp:127.0.0.1:{next(ports)}", 1)
    fleet.write_text(text)
    monkeypatch.setattr(check, "check_route", lambda on_drone: Finding("multicast", "a route"))
    return fleet


def lacking(*arguments: object) -> str:
    """What `check` says that lacks something."""
    result = podwatch("check", *arguments)
    assert result.exit_code == errors.MISSING, result.output
    return " ".join(str(result.stdout).split())


@pytest.mark.parametrize("n_drones", [1, 12])
def test_a_new_file_loads_as_a_mission_and_flies_as_a_rehearsal(tmp_path, n_drones):
    path = tmp_path / "north sea.toml"
    assert podwatch("new", path, "--drones", n_drones, "--name", "north").exit_code == 0
    mission = load_mission(path, Mission)
    assert (mission.name, mission.roster) == ("north", tuple(range(1, n_drones + 1)))
    assert mission.search.start == "operator"
    assert load_mission(path, SimMission).roster == mission.roster
    sections = tomllib.loads(path.read_text())
    values = [line for line in path.read_text().splitlines() if "=" in line and not line.startswith("#")]
    assert len([line for line in values if "#" in line]) > len(values) / 2, (
        "most values say what they are for"
    )
    assert set(sections) <= set(Mission.model_fields)


@pytest.mark.parametrize("n_drones", range(1, MAX_DRONES + 1))
def test_a_new_file_of_any_allowed_number_of_drones_lacks_nothing_but_its_key(tmp_path, n_drones):
    path = tmp_path / "fleet.toml"
    assert podwatch("new", path, "--drones", n_drones).exit_code == 0
    mission = read_fleet(path)
    assert len(load_mission(path, SimMission).roster) == n_drones
    assert [one.what for one in check.check_fleet(mission, path) if one.lacks] == ["key"]


def test_a_file_that_is_there_is_never_overwritten(fleet):
    before = fleet.read_text()
    assert podwatch("new", fleet).exit_code == errors.UNUSABLE
    assert fleet.read_text() == before


def test_the_key_is_its_owners_alone_and_replaced_only_by_force(fleet):
    key = fleet.parent / "fleet.key"
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    first = read_key(key)
    refused = podwatch("keys", fleet)
    assert refused.exit_code == errors.UNUSABLE
    assert "shuts out every drone" in refused.stderr
    assert first.hex() not in refused.output
    assert read_key(key) == first
    assert podwatch("keys", fleet, "--force").exit_code == 0
    assert read_key(key) != first


def test_a_drone_on_a_machine_that_has_everything_lacks_nothing(bench):
    port = int(machine_of(read_fleet(bench), 2).autopilot.rpartition(":")[2])
    with talking(beat(2), port):
        result = podwatch("check", bench, "--drone", 2)
    assert result.exit_code == 0, result.output
    assert "lacks" not in result.output


def test_each_thing_that_lacks_is_named_with_what_mends_it(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(check, "LISTEN_S", 0.05)
    text = bench.read_text()
    key = tmp_path / "fleet.key"
    key.chmod(0o644)
    assert f"chmod 600 {key}" in lacking(bench)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        used = machine_of(read_fleet(bench), 1).radio
        bench.write_text(text.replace(used, f"127.0.0.1:{port}"))
        assert f"ss -lunp sport = :{port}" in lacking(bench, "--drone", 1)
    bench.write_text(text.replace(f"pictures:{tmp_path}", "v4l2:/dev/video77"))
    assert "/dev/video77 is not there" in lacking(bench, "--drone", 1)
    bench.write_text(text.replace("width_px = 640", "width_px = 800"))
    assert "width_px = 640, height_px = 480" in lacking(bench, "--drone", 1)
    bench.write_text(text.replace(machine_of(read_fleet(bench), 1).autopilot, "serial:/dev/ttyNONE7:57600"))
    assert "/dev/ttyNONE7 is not there" in lacking(bench, "--drone", 1)


def test_a_key_that_a_drone_lacks_is_copied_and_never_made_anew(monkeypatch, fleet):
    key = fleet.parent / "fleet.key"
    whole = key.read_text()
    monkeypatch.setattr(check, "LISTEN_S", 0.05)
    for broken in ("", "no key", whole[:40]):
        key.write_text(broken)
        said = lacking(fleet, "--drone", 1)
        assert f"scp -p 10.76.0.100:FOLDER/fleet.key {fleet.parent}/" in said
        assert "fleet keys" not in said, "another key shuts the drone out, and every check is well"
        assert f"podwatch fleet keys --force {fleet} # only where no machine of the fleet has" in lacking(
            fleet
        )
    key.unlink()
    assert "scp -p 10.76.0.100:" in lacking(fleet, "--drone", 1)
    assert f"podwatch fleet keys {fleet} # only where no machine of the fleet has" in lacking(fleet)
    assert "else: scp -p MACHINE:FOLDER/fleet.key" in lacking(fleet)
    assert podwatch("keys", fleet).exit_code == 0, "what was told"


def test_two_keys_are_told_apart_without_a_word_of_either(fleet):
    keys, fingerprints = [], []
    for _ in range(2):
        made = podwatch("keys", fleet, "--force").stdout
        keys.append((fleet.parent / "fleet.key").read_text().strip())
        fingerprints.append(made.partition("fingerprint ")[2][:8])
        assert f"fingerprint {fingerprints[-1]}: the same on every machine" in podwatch("check", fleet).stdout
        assert fingerprints[-1] not in keys[-1]
    assert fingerprints[0] != fingerprints[1]


def test_a_key_that_this_user_may_not_read_is_given_to_this_user():
    folder = Path(tempfile.mkdtemp(dir="/tmp"))  # tmp_path is closed to others
    path, key = folder / "fleet.toml", folder / "fleet.key"
    try:
        podwatch("new", path)
        podwatch("keys", path)
        key.chmod(0)
        folder.chmod(0o755)
        mission = read_fleet(path)
        if is_root := os.geteuid() == 0:  # whom no mode stops
            os.seteuid(NOBODY)
        try:
            found = {one.what: one for one in check.check_fleet(mission, path, on_drone=True)}["key"]
        finally:
            if is_root:
                os.seteuid(0)
        assert "Permission denied" in found.lacks
        assert found.mend == f"sudo chown $USER {key} && chmod 600 {key}"
    finally:
        shutil.rmtree(folder)


def test_a_radio_address_that_this_machine_does_not_have_is_named(monkeypatch, fleet):
    monkeypatch.setattr(check, "LISTEN_S", 0.05)
    fleet.write_text(fleet.read_text().replace("10.76.0.", "240.0.0."))  # reserved: nobody's
    said = lacking(fleet, "--drone", 2)
    assert "udp 240.0.0.2:14600: this machine has no address 240.0.0.2, where the others reach it" in said
    assert "ip -br address" in said


def test_the_boats_machine_is_looked_at_too(fleet):
    [port] = free_udp_ports(1)
    assert "this machine has no address 10.76.0.100" in lacking(fleet, "--boat")
    fleet.write_text(fleet.read_text().replace("10.76.0.100:14600", f"127.0.0.1:{port}"))
    assert f"udp 127.0.0.1:{port} is free" in podwatch("check", fleet, "--boat").stdout
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", port))
        assert f"ss -lunp sport = :{port}" in lacking(fleet, "--boat")
    assert podwatch("check", fleet, "--boat", "--drone", 1).exit_code == errors.UNUSABLE
    fleet.write_text(fleet.read_text().partition("[boat]")[0])
    assert '[boat] radio = "HOST:PORT"' in lacking(fleet, "--boat")


def test_a_pipeline_that_the_installed_opencv_cannot_open_is_told_as_that(monkeypatch, fleet):
    monkeypatch.setattr(check, "LISTEN_S", 0.05)
    assert not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER), "the wheels of PyPI are built without it"
    fleet.write_text(fleet.read_text().replace("v4l2:/dev/video0", "gstreamer:videotestsrc ! appsink"))
    said = lacking(fleet, "--drone", 1)
    assert "gstreamer:videotestsrc ! appsink: the OpenCV that pip installs is built without GStreamer" in said
    assert '"ffmpeg:ADDRESS"' in said


def test_a_model_that_is_broken_is_brought_back_as_doctor_says(monkeypatch, fleet):
    def broken(spec):
        if "Detector" in spec.driver:
            raise RuntimeFailure("detector.onnx: it is cut")
        return load_driver(spec)

    monkeypatch.setattr(check, "LISTEN_S", 0.05)
    monkeypatch.setattr(check, "load_driver", broken)
    assert restored_model() in lacking(fleet, "--drone", 1)


def test_members_that_share_an_address_or_have_none_are_named(fleet):
    text = fleet.read_text()
    fleet.write_text(text.replace("10.76.0.2:14600", "10.76.0.1:14600"))
    assert "radio 10.76.0.1:14600 is drone 1's too" in lacking(fleet)
    fleet.write_text(text.partition("[boat]")[0] + "".join(text.partition("\n[[drones]]")[1:]))
    assert "no boat is named that could say so" in lacking(fleet)
    fleet.write_text(text + "[[drones]]\nid = 9\nhome_n_m = 50.0\n")
    assert "drone 9 address" in lacking(fleet)


def test_a_file_that_cannot_be_flown_and_a_stranger_are_refused(fleet):
    assert podwatch("check", fleet, "--drone", 8).exit_code == errors.UNUSABLE
    fleet.write_text(fleet.read_text().replace("fence_radius_m", "fence_m"))
    refused = podwatch("check", fleet)
    assert refused.exit_code == errors.UNUSABLE
    assert "did you mean 'fence_radius_m'" in refused.stderr
    fleet.write_text(fleet.read_text().replace("fence_m", "fence_radius_m") + "camra = 'v4l2:0'\n")
    assert "did you mean 'camera'" in podwatch("check", fleet).stderr


def test_what_a_drone_is_told_names_drivers_that_can_be_made(bench, tmp_path):
    mission = read_fleet(bench)
    settings = drone_settings(mission, 2, bus_url="", run="t", run_dir=tmp_path, log_path=tmp_path / "a.mcap")
    radio = settings.drivers["radio"].options
    assert sorted(radio["peers"]) == ["0", "1", "3"]
    assert radio["bind"] == machine_of(mission, 2).radio, "a loopback address is bound as it is"
    assert Path(settings.mission.radio.key_file) == bench.parent / "fleet.key"
    for name, spec in settings.drivers.items():
        assert "drivers.sim" not in spec.driver
        if name != "tracker":
            driver = load_driver(spec)
            getattr(driver, "close", lambda: None)()
    boat = boat_radio(mission)
    assert boat.options["bind"] == "0.0.0.0:14600"
    assert sorted(boat.options["peers"]) == ["1", "2", "3"]


def test_a_driver_of_ones_own_takes_the_place_of_the_one_that_follows(fleet, tmp_path):
    own = '[drones.machine.drivers.camera]\ndriver = "my.camera:Camera"\noptions = { port = 3 }\n'
    fleet.write_text(fleet.read_text() + own)
    settings = drone_settings(
        read_fleet(fleet), 3, bus_url="", run="t", run_dir=tmp_path, log_path=tmp_path / "a.mcap"
    )
    assert settings.drivers["camera"].options == {"port": 3}
    fleet.write_text(fleet.read_text().replace("driver = ", "drver = "))
    with pytest.raises(MissionError, match="did you mean 'driver'"):
        read_fleet(fleet)
