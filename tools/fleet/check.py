"""What a drone, or the fleet file itself, still lacks, each with the command or the line that mends it."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

from procs.bus_executor import load_driver
from procs.relay.keys import FleetKeyError, read_key
from procs.runtime import RuntimeFailure
from procs.settings import DriverSpec, MachineSettings, Mission
from tools.doctor.machine import check_receive_buffer, check_route, check_shared_memory, frames_bytes
from tools.findings import Finding
from tools.fleet.machine import drone_settings, listen_address, machine_of

__all__ = ["check_drone", "check_fleet"]


def check_fleet(mission: Mission, path: Path) -> list[Finding]:
    """What every machine of the fleet needs: a mission, its key, and an address for each member."""
    return [
        Finding("mission", f"{mission.name}: drones {', '.join(map(str, mission.roster))}"),
        _key(mission, path),
        *_addresses(mission),
    ]


def check_drone(mission: Mission, path: Path, drone_id: int) -> list[Finding]:
    """What one drone needs on this machine. Raises MissionError: no such drone, or no machine table."""
    machine = machine_of(mission, drone_id)
    settings = drone_settings(
        mission, drone_id, bus_url="", run="check", run_dir=Path(), log_path=Path("check.mcap")
    )
    return [
        *check_fleet(mission, path),
        _model(settings.drivers["detector"]),
        _camera(mission, machine, settings.drivers["camera"]),
        _device("autopilot", machine.autopilot),
        _port("radio", listen_address(machine.radio)),
        check_route(on_drone=True),
        check_receive_buffer(),
        check_shared_memory(frames_bytes(mission.camera, 1)),
    ]


def _key(mission: Mission, path: Path) -> Finding:
    key = Path(mission.radio.key_file)
    try:
        read_key(key)
    except FleetKeyError as error:
        if not key.exists():
            return Finding("key", lacks=f"{key} is not there", mend=f"podwatch fleet keys {path}")
        mode = key.stat().st_mode & 0o777
        mend = f"chmod 600 {key}" if mode & 0o077 else f"podwatch fleet keys --force {path}"
        return Finding("key", lacks=str(error), mend=mend)
    return Finding("key", f"{key}, readable by its owner alone")


def _addresses(mission: Mission) -> Iterator[Finding]:
    """Each member has a radio address, and no two the same."""
    owners: dict[str, str] = {}
    named = {f"drone {entry.id}": entry.machine for entry in mission.drones}
    for name, machine in named.items():
        if machine is None:
            yield Finding(
                f"{name} address",
                lacks="its [[drones]] entry has no [drones.machine] table",
                mend='below the entry write: [drones.machine] and radio = "HOST:PORT"',
            )
    given = {name: machine.radio for name, machine in named.items() if machine is not None}
    if mission.boat.radio:
        given["the boat"] = mission.boat.radio
    for name, address in given.items():
        other = owners.setdefault(address, name)
        if other != name:
            yield Finding(
                f"{name} address",
                lacks=f"radio {address} is {other}'s too",
                mend=f"give {name} a radio address of its own",
            )
    if not mission.boat.radio and mission.search.start == "operator":
        yield Finding(
            "boat",
            lacks='search.start = "operator", and no boat is named that could say so',
            mend='write: [boat] radio = "HOST:PORT"; or search.start = "auto"',
        )


def _model(spec: DriverSpec) -> Finding:
    """Load it, as the detector will."""
    own = spec.options.get("model_path")
    try:
        load_driver(spec)
    except RuntimeFailure as error:
        mend = "[detector] model = ...: another file" if own else "pip install --force-reinstall podwatch"
        return Finding("model", lacks=str(error), mend=mend)
    return Finding("model", str(own or "the detector that ships"))


def _camera(mission: Mission, machine: MachineSettings, spec: DriverSpec) -> Finding:
    """Open it and take a picture: its size is what the mission says."""
    kind, _, source = machine.camera.partition(":")
    is_device = kind == "v4l2" and "camera" not in machine.drivers
    if is_device and (lacking := _lacking_device("camera", source, "video")):
        return lacking
    try:
        image = load_driver(spec).capture()
    except (RuntimeFailure, OSError) as error:
        return Finding(
            "camera", lacks=str(error), mend="v4l2-ctl --list-devices; then set camera in the file"
        )
    width, height = mission.camera.width_px, mission.camera.height_px
    if image is None:
        return Finding(
            "camera",
            lacks=f"{machine.camera} gives no picture",
            mend="see that it is connected; dmesg | tail",
        )
    if image.shape[:2] != (height, width):
        given = f"{image.shape[1]}x{image.shape[0]}"
        return Finding(
            "camera",
            lacks=f"{machine.camera} gives {given}, the mission wants {width}x{height}",
            mend=f"[camera] width_px = {image.shape[1]}, height_px = {image.shape[0]}",
        )
    return Finding("camera", f"{machine.camera} gives {width}x{height}")


def _device(what: str, address: str) -> Finding:
    """The autopilot's device, or its port where it is reached over a socket."""
    kind, _, rest = address.partition(":")
    if kind == "serial":
        device = rest.rpartition(":")[0]
        return _lacking_device(what, device, "dialout") or Finding(what, address)
    if kind == "udp":
        return _port(what, rest)
    return Finding(what, f"{address} (reached when it answers)")


def _lacking_device(what: str, device: str, group: str) -> Finding | None:
    path = Path(device)
    if not path.exists():
        there = ", ".join(sorted(str(one) for one in path.parent.glob(path.name.rstrip("0123456789") + "*")))
        return Finding(
            what,
            lacks=f"{device} is not there" + (f" (there are: {there})" if there else ""),
            mend="connect it; ls /dev/tty* /dev/video*; then set it in the file",
        )
    if not os.access(path, os.R_OK | os.W_OK):
        return Finding(
            what,
            lacks=f"this user may not use {device}",
            mend=f"sudo usermod -aG {group} $USER, and log in anew",
        )
    return None


def _port(what: str, address: str) -> Finding:
    """Whether a UDP port can be had here."""
    host, _, port = address.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((host, int(port)))
        except (OSError, OverflowError) as error:
            return Finding(
                what, lacks=f"udp {address}: {error}", mend=f"ss -lunp sport = :{port}; end that program"
            )
    return Finding(what, f"udp {address} is free")
