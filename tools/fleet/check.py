"""What a drone, or the fleet file itself, still lacks, each with the command or the line that mends it."""

import hashlib
import shlex
from collections.abc import Iterator
from pathlib import Path

from procs.bus_executor import load_driver
from procs.relay.keys import FleetKeyError, read_key
from procs.runtime import RuntimeFailure
from procs.settings import DriverSpec, Mission
from tools.doctor.machine import check_receive_buffer, check_route, check_shared_memory, frames_bytes
from tools.doctor.mend import restored_model
from tools.findings import Finding
from tools.fleet.edges import check_autopilot, check_camera, check_radio
from tools.fleet.machine import AUTOPILOT_DRIVER, drone_settings, machine_of

__all__ = ["check_boat", "check_drone", "check_fleet", "fingerprint"]

LISTEN_S = 3.0  # an autopilot beats once a second


def check_fleet(mission: Mission, path: Path, *, on_drone: bool = False) -> list[Finding]:
    """What every machine of the fleet needs: a mission, its key, and an address for each member.

    on_drone: this is a drone's machine, whose key was made elsewhere.
    """
    return [
        Finding("mission", f"{mission.name}: drones {', '.join(map(str, mission.roster))}"),
        _key(mission, path, on_drone=on_drone),
        *_addresses(mission),
    ]


def check_drone(mission: Mission, path: Path, drone_id: int) -> list[Finding]:
    """What one drone needs on this machine. Raises MissionError: no such drone, or no machine table."""
    machine = machine_of(mission, drone_id)
    settings = drone_settings(
        mission, drone_id, bus_url="", run="check", run_dir=Path(), log_path=Path("check.mcap")
    )
    return [
        *check_fleet(mission, path, on_drone=True),
        _model(settings.drivers["detector"]),
        check_camera(mission, machine, settings.drivers["camera"]),
        _autopilot(settings.drivers["autopilot"], drone_id),
        check_radio("radio", machine.radio),
        check_route(on_drone=True),
        check_receive_buffer(),
        check_shared_memory(frames_bytes(mission.camera, 1)),
    ]


def check_boat(mission: Mission, path: Path) -> list[Finding]:
    """What the boat needs on this machine."""
    if not mission.boat.radio:
        return [
            *check_fleet(mission, path),
            Finding("boat", lacks="the fleet file names none", mend='write: [boat] radio = "HOST:PORT"'),
        ]
    return [*check_fleet(mission, path), check_radio("radio", mission.boat.radio)]


def fingerprint(key: bytes) -> str:
    """8 digits by which two copies of a fleet key are told apart, and which tell nothing of it."""
    return hashlib.sha256(b"podwatch fleet key" + key).hexdigest()[:8]


def _key(mission: Mission, path: Path, *, on_drone: bool) -> Finding:
    key = Path(mission.radio.key_file)
    try:
        held = read_key(key)
    except FleetKeyError as error:
        is_missing = isinstance(error.__cause__, FileNotFoundError)
        return Finding(
            "key",
            lacks=f"{key} is not there" if is_missing else str(error),
            mend=_key_mend(mission, path, error, on_drone=on_drone),
        )
    return Finding("key", f"{key}, fingerprint {fingerprint(held)}: the same on every machine")


def _key_mend(mission: Mission, path: Path, error: FleetKeyError, *, on_drone: bool) -> str:
    """Where others may hold a key it is copied: one that is made anew shuts them out."""
    key = Path(mission.radio.key_file)
    place = shlex.quote(str(key))
    if isinstance(error.__cause__, PermissionError):
        return f"sudo chown $USER {place} && chmod 600 {place}"
    if key.exists() and key.stat().st_mode & 0o077:
        return f"chmod 600 {place}"
    force = "--force " if key.exists() else ""
    make = f"podwatch fleet keys {force}{shlex.quote(str(path))}"
    if len(mission.roster) == 1 and not mission.boat.radio:
        return make
    source = (on_drone and mission.boat.radio.rpartition(":")[0]) or "MACHINE"
    copy = f"scp -p {source}:FOLDER/{key.name} {shlex.quote(str(key.parent))}/"
    if on_drone:
        return f"{copy}  # the key that the others hold: one made here would shut this drone out"
    return f"{make}  # only where no machine of the fleet has a good one; else: {copy}"


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


def _autopilot(spec: DriverSpec, drone_id: int) -> Finding:
    """Listen, as the bridge would."""
    if spec.driver != AUTOPILOT_DRIVER:
        return Finding("autopilot", f"{spec.driver}: a driver of your own, not looked at")
    return check_autopilot(spec.options["address"], spec.options.get("system_id") or drone_id, LISTEN_S)


def _model(spec: DriverSpec) -> Finding:
    """Load it, as the detector will."""
    own = spec.options.get("model_path")
    try:
        load_driver(spec)
    except RuntimeFailure as error:
        mend = "[detector] model = ...: another file" if own else restored_model()
        return Finding("model", lacks=str(error), mend=mend)
    return Finding("model", str(own or "the detector that ships"))
