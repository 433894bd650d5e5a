"""systemd units of one drone, from the fleet file and the process table.

One unit a process, one for the network of the bus, and a target for all of them. A unit cannot know whether
its drone flies, so it restarts by the table's policy for the air. It waits for the process's first heartbeat
(Type=notify) and ends a process whose heartbeat is missing for the table's limit (WatchdogSec). What must
stop later is started before: systemd stops units against the order of After=.
"""

import os
import stat
import sys
from pathlib import Path

from procs.bus_executor import ROUTE_COMMAND
from procs.processes import PROCESSES, Process, Restart
from procs.settings import DroneSettings, MachineSettings, Mission
from tools.buses import bus_url
from tools.doctor.machine import RECEIVE_BYTES
from tools.fleet.machine import drone_settings, machine_of

__all__ = ["STATE_FOLDER", "closed_folders", "unit_name", "write_units"]

ROOT = Path(__file__).resolve().parents[2]
USER = "podwatch"
STATE_FOLDER = Path("/var/lib/podwatch")
STOP_WAIT_S = 6
RESTART_WAIT_S = 1
CREDENTIAL = "fleet.key"
NET = "net"  # no process: the unit that sets up the bus's network
RMEM_MAX = "net.core.rmem_max"
SLOT = 0  # one drone's computer carries one drone's bus

# What every process does without (systemd.exec(5)).
HARDENING = """\
NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
ProtectSystem=strict
ProtectHome=read-only
PrivateTmp=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
ProtectClock=yes
ProtectHostname=yes
ProtectProc=invisible
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
LockPersonality=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
UMask=0077
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6
"""
BUS_ONLY = "IPAddressDeny=any\nIPAddressAllow=localhost multicast\n"


def unit_name(drone_id: int, process: str) -> str:
    """ "podwatch-3-relay.service"."""
    return f"podwatch-{drone_id}-{process}.service"


def closed_folders(out: Path) -> list[Path]:
    """Folders on the way to what the units start and read that others than their owner may not enter."""
    python = Path(sys.executable)
    ways = [path.absolute() for path in (out / "settings", ROOT / "procs", python, python.resolve())]
    folders = dict.fromkeys(folder for way in ways for folder in reversed(way.parents))
    return [folder for folder in folders if not folder.stat().st_mode & stat.S_IXOTH]


def write_units(mission: Mission, drone_id: int, out: Path) -> list[Path]:
    """Write target, units and settings of one drone into `out` -> the files. Raises MissionError."""
    machine = machine_of(mission, drone_id)
    key = mission.radio.key_file
    out.mkdir(parents=True, exist_ok=True)
    settings_path = out.resolve() / f"drone_{drone_id}.json"
    settings_path.write_text(_settings(mission, drone_id).model_dump_json(indent=1) + "\n")
    files = [settings_path, out / _target(drone_id)]
    files[1].write_text(_target_text(mission, drone_id))
    files.append(out / unit_name(drone_id, NET))
    files[-1].write_text(_net_text(drone_id))
    for process in PROCESSES:
        files.append(out / unit_name(drone_id, process.name))
        files[-1].write_text(_unit_text(process, drone_id, machine, settings_path, key))
    return files


def _settings(mission: Mission, drone_id: int) -> DroneSettings:
    """The key comes to the relay as a credential of its unit; nobody else may read it."""
    key = f"/run/credentials/{unit_name(drone_id, 'relay')}/{CREDENTIAL}"
    radio = mission.radio.model_copy(update={"key_file": key})
    return drone_settings(
        mission.model_copy(update={"radio": radio}),
        drone_id,
        bus_url=bus_url(drone_id, SLOT),
        run=f"unit{drone_id}",
        run_dir=STATE_FOLDER,
        log_path=STATE_FOLDER / f"drone_{drone_id}.mcap",
    )


def _target(drone_id: int) -> str:
    return f"podwatch-{drone_id}.target"


def _target_text(mission: Mission, drone_id: int) -> str:
    wanted = " ".join(unit_name(drone_id, process.name) for process in PROCESSES)
    return (
        f"[Unit]\nDescription=podwatch drone {drone_id} of {_plain(mission.name)}\nWants={wanted}\n"
        f"After=network.target\n\n[Install]\nWantedBy=multi-user.target\n"
    )


def _net_text(drone_id: int) -> str:
    """What a boot forgets and the bus needs: its route, and the kernel's leave to hold long messages."""
    room = f'test "$$(sysctl -n {RMEM_MAX})" -ge {RECEIVE_BYTES} || sysctl -w {RMEM_MAX}={RECEIVE_BYTES}'
    return (
        f"[Unit]\n"
        f"Description=podwatch: the network of drone {drone_id}'s bus\n"
        f"PartOf={_target(drone_id)}\n"
        f"\n[Service]\n"
        f"Type=oneshot\n"
        f"RemainAfterExit=yes\n"
        f"ExecStart=ip link set lo up\n"
        f"ExecStart={ROUTE_COMMAND}\n"
        f"ExecStart=-/bin/sh -c '{room}'\n"
        f"\n[Install]\nWantedBy=multi-user.target\n"
    )


def _unit_text(process: Process, drone_id: int, machine: MachineSettings, settings: Path, key: str) -> str:
    later = [unit_name(drone_id, other.name) for other in PROCESSES if other.stop_order > process.stop_order]
    net = unit_name(drone_id, NET)
    after = " ".join(["network.target", net, *later])
    restart = "always" if process.restart_air is Restart.ALWAYS else "no"
    return (
        f"[Unit]\n"
        f"Description=podwatch {process.name} of drone {drone_id}\n"
        f"PartOf={_target(drone_id)}\n"
        f"Wants={net}\n"
        f"After={after}\n"
        f"StartLimitIntervalSec=0\n"
        f"\n[Service]\n"
        f"Type=notify\n"
        f"NotifyAccess=main\n"
        f"ExecStart={_quoted(sys.executable)} -m procs.main {process.name} {_quoted(settings)}\n"
        f"WorkingDirectory={_plain(ROOT)}\n"
        f"User={USER}\n"
        f"Environment=OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1\n"
        f"Restart={restart}\n"
        f"RestartSec={RESTART_WAIT_S}\n"
        f"WatchdogSec={process.heartbeat_limit_s:g}\n"
        f"WatchdogSignal=SIGKILL\n"
        f"TimeoutStartSec=90\n"
        f"TimeoutStopSec={STOP_WAIT_S}\n"
        f"OOMScoreAdjust=-500\n"
        f"{HARDENING}{_rights(process.name, machine, key)}"
        f"\n[Install]\nWantedBy={_target(drone_id)}\n"
    )


def _rights(process: str, machine: MachineSettings, key: str) -> str:
    """What this one process may do beyond the others."""
    devices = _devices(process, machine)
    if devices:
        groups = "video" if process == "camera" else "dialout"
        rights = "DevicePolicy=closed\n" + "".join(f"DeviceAllow={_plain(one)} rw\n" for one in devices)
        rights += f"SupplementaryGroups={groups}\n"
    else:
        rights = "PrivateDevices=yes\n"
    if process == "relay":
        return rights + f"LoadCredential={CREDENTIAL}:{_plain(key)}\n"
    if process == "logger":
        return rights + f"StateDirectory={STATE_FOLDER.name}\n" + BUS_ONLY
    is_networked = (process == "autopilot" and not devices) or (
        process == "camera" and not devices and not machine.camera.startswith("pictures:")
    )
    return rights if is_networked else rights + BUS_ONLY


def _devices(process: str, machine: MachineSettings) -> list[str]:
    """Device files that a process opens."""
    kind, _, rest = (machine.camera if process == "camera" else machine.autopilot).partition(":")
    if process == "camera" and kind == "v4l2":
        return [rest]
    if process == "camera" and kind == "gstreamer":
        return ["char-video4linux"]
    if process == "autopilot" and kind == "serial":
        return [rest.rpartition(":")[0]]
    return []


def _plain(text: str | os.PathLike[str]) -> str:
    """Text in which systemd, which expands %i and the like, expands nothing."""
    return str(text).replace("%", "%%")


def _quoted(path: str | os.PathLike[str]) -> str:
    """A word of a command line, whatever the folders are called."""
    escaped = _plain(path).replace("\\", "\\\\").replace('"', '\\"').replace("$", "$$")
    return f'"{escaped}"'
