"""The systemd units of a drone: what the process table says, and no right more than each process needs."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from procs import processes
from procs.processes import PROCESSES, Restart
from procs.relay.keys import make_key
from procs.settings import DroneSettings
from tools.buses import bus_url
from tools.cli import app
from tools.fleet import units
from tools.fleet.machine import read_fleet
from tools.fleet.template import fleet_text

DRONE = 2
NAMESPACES = ("unshare", "--map-root-user", "--net")


class Unit:
    """One unit file."""

    def __init__(self, path: Path) -> None:
        self._values: dict[str, list[str]] = {}
        for line in path.read_text().splitlines():
            name, equals, value = line.partition("=")
            if equals:
                self._values.setdefault(name, []).append(value)

    def get(self, name: str) -> str:
        """What it says, "" where nothing; joined by spaces where the name stands more than once."""
        return " ".join(self._values.get(name, []))


@pytest.fixture
def mission(tmp_path: Path) -> Any:
    path = tmp_path / "fleet.toml"
    path.write_text(fleet_text("north 100%", "fleet.toml", 3))
    make_key(tmp_path / "fleet.key")
    return read_fleet(path)


def written(mission: Any, folder: Path) -> dict[str, Unit]:
    units.write_units(mission, DRONE, folder)
    return {process.name: Unit(folder / units.unit_name(DRONE, process.name)) for process in PROCESSES}


def test_every_process_has_its_unit_and_systemd_finds_nothing_wrong(mission, tmp_path):
    files = units.write_units(mission, DRONE, tmp_path / "of 1 drone, 100%")
    named = {path.name for path in files}
    assert named == {
        "drone_2.json",
        "podwatch-2.target",
        "podwatch-2-net.service",
        *(f"podwatch-2-{process.name}.service" for process in PROCESSES),
    }
    checker = shutil.which("systemd-analyze")
    if checker is not None:  # where systemd is
        paths = [str(path) for path in files if path.suffix != ".json"]
        done = subprocess.run(
            [checker, "verify", "--man=no", *paths], capture_output=True, text=True, timeout=60
        )
        assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_what_a_unit_does_about_what_ends_or_hangs_is_the_tables(mission, tmp_path, monkeypatch):
    changed = tuple(
        replace(p, restart_air=Restart.NEVER, heartbeat_limit_s=7.5) if p.name == "camera" else p
        for p in PROCESSES
    )
    monkeypatch.setattr(units, "PROCESSES", changed)
    for name, unit in written(mission, tmp_path / "units").items():
        assert unit.get("Restart") == ("no" if name == "camera" else "always")
        limit_s = processes.BY_NAME[name].heartbeat_limit_s if name != "camera" else 7.5
        assert float(unit.get("WatchdogSec")) == limit_s
        assert unit.get("Type") == "notify"
        assert unit.get("StartLimitIntervalSec") == "0", "in the air nobody gives up"


def test_units_stop_in_the_order_of_the_table(mission, tmp_path):
    """systemd stops a unit before those that it is after."""
    made = written(mission, tmp_path / "units")
    for process in PROCESSES:
        after = made[process.name].get("After").split()
        later = {p.name for p in PROCESSES if p.stop_order > process.stop_order}
        assert {name for name in processes.BY_NAME if units.unit_name(DRONE, name) in after} == later
        assert made[process.name].get("PartOf") == "podwatch-2.target"


def test_the_bus_has_its_route_before_any_process_starts(mission, tmp_path):
    made = written(mission, tmp_path / "units")
    for unit in made.values():
        assert "podwatch-2-net.service" in unit.get("Wants").split()
        assert "podwatch-2-net.service" in unit.get("After").split()
    net = Unit(tmp_path / "units" / "podwatch-2-net.service")
    assert (net.get("Type"), net.get("RemainAfterExit")) == ("oneshot", "yes")
    assert "239.255.76.0/24 dev lo" in net.get("ExecStart")
    assert "-ge 4194304" in net.get("ExecStart"), "a kernel that grants more keeps it"


def test_what_the_network_unit_starts_makes_a_bus_where_there_is_none(mission, tmp_path):
    written(mission, tmp_path / "units")
    lines = (tmp_path / "units" / "podwatch-2-net.service").read_text().splitlines()
    starts = [line.partition("=")[2].replace("$$", "$") for line in lines if line.startswith("ExecStart=")]
    commands = [f"{one[1:]} || true" if one.startswith("-") else one for one in starts]
    assert len(commands) == 3
    if shutil.which("unshare") is None or subprocess.run([*NAMESPACES, "true"], check=False).returncode != 0:
        return  # no machine of one's own to try them on
    bus = f"{sys.executable} -c 'import lcm; lcm.LCM({chr(34)}{bus_url(DRONE, 0)}{chr(34)})'"
    for script, code in ((bus, 1), (" && ".join([*commands, bus]), 0)):
        done = subprocess.run([*NAMESPACES, "sh", "-c", script], capture_output=True, text=True, check=False)
        assert done.returncode == code, done.stdout + done.stderr


def test_each_has_only_the_rights_that_it_needs(mission, tmp_path):
    made = written(mission, tmp_path / "units")
    for name, unit in made.items():
        assert unit.get("User") == "podwatch"
        assert unit.get("NoNewPrivileges") == "yes"
        assert unit.get("ProtectSystem") == "strict"
        assert unit.get("CapabilityBoundingSet") == ""
        assert unit.get("LoadCredential") == (f"fleet.key:{tmp_path}/fleet.key" if name == "relay" else "")
        assert (unit.get("IPAddressDeny") == "any") == (name != "relay"), "the relay alone leaves the machine"
        assert unit.get("StateDirectory") == ("podwatch" if name == "logger" else "")
        devices = {"camera": "/dev/video0 rw", "autopilot": "/dev/ttyAMA0 rw"}.get(name, "")
        assert unit.get("DeviceAllow") == devices
        assert unit.get("PrivateDevices") == ("" if devices else "yes")


def test_what_the_units_name_is_there_and_holds_no_key(mission, tmp_path):
    made = written(mission, tmp_path / "units")
    settings = DroneSettings.read(tmp_path / "units" / "drone_2.json")
    assert settings.drone_id == DRONE
    assert settings.mission.radio.key_file == "/run/credentials/podwatch-2-relay.service/fleet.key"
    key = (tmp_path / "fleet.key").read_text().strip()
    assert not [path for path in (tmp_path / "units").iterdir() if key in path.read_text()]
    for name, unit in made.items():
        assert f" -m procs.main {name} " in unit.get("ExecStart")
        assert str(tmp_path / "units" / "drone_2.json") in unit.get("ExecStart")


def test_an_autopilot_over_the_network_may_use_it_and_no_device(mission, tmp_path):
    entries = [
        entry.model_copy(
            update={"machine": entry.machine.model_copy(update={"autopilot": "udp:0.0.0.0:14550"})}
        )
        for entry in mission.drones
    ]
    made = written(mission.model_copy(update={"drones": tuple(entries)}), tmp_path / "units")
    assert made["autopilot"].get("PrivateDevices") == "yes"
    assert made["autopilot"].get("IPAddressDeny") == ""


def test_a_place_that_the_units_user_may_not_enter_is_told(mission, tmp_path, monkeypatch):
    """tmp_path is its owner's alone, as a home is."""
    closed = tmp_path / "closed"
    (closed / "out").mkdir(parents=True, mode=0o755)
    closed.chmod(0o700)
    assert closed in units.closed_folders(closed / "out")
    closed.chmod(0o755)
    assert closed not in units.closed_folders(closed / "out")
    monkeypatch.setattr(units, "ROOT", closed / "out")
    closed.chmod(0o700)
    assert closed in units.closed_folders(tmp_path)
    told = CliRunner().invoke(
        app, ["fleet", "units", str(tmp_path / "fleet.toml"), "--drone", "2", "--out", str(closed / "out")]
    )
    assert told.exit_code == 0
    assert f"the user podwatch may not enter {closed}," in told.stderr
    assert "/opt/podwatch" in told.stderr
    assert "sudo systemctl restart podwatch-2.target" in told.stdout
