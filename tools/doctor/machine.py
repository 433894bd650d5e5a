"""Checks of the machine itself. Each is a function of what it looks at, so that a test can break that."""

import contextlib
import errno
import os
import shutil
import socket
from collections.abc import Callable, Sequence
from pathlib import Path

import psutil

import models
from drivers.frames import SHARED_FOLDER
from procs.bus_executor import ROUTE_COMMAND
from procs.detector.decode import ModelError
from procs.settings import CameraSettings
from tools.buses import FIRST_PORT, N_SLOTS, has_multicast_route, taken_slots
from tools.doctor.mend import SHIPPED, as_root, restored_model, until_boot
from tools.findings import Finding
from tools.spy.gui import what_is_missing

__all__ = [
    "RECEIVE_BYTES",
    "check_java",
    "check_model",
    "check_receive_buffer",
    "check_route",
    "check_shared_memory",
    "check_slots",
    "frames_bytes",
]

SYSCTL_FILE = "/etc/sysctl.d/90-podwatch.conf"  # read at every boot
RECEIVE_BYTES = 4194304  # every bus asks for it: with less, long messages are lost (docs/architecture.md)
GROUP = "239.255.76.100"  # no drone's: ids begin at 1
HEAR_S = 0.5
LOOPBACK = "127."
SLOTS_OF_A_RING = 16  # frames that drivers.frames keeps


def check_route(*, on_drone: bool = False) -> Finding:
    """Whether a message to a drone's group leaves and is heard again; on a drone, over the loopback alone."""
    what = "multicast"
    up = f"{as_root('ip link set lo up')} && " if not _is_loopback_up() else ""
    mend = until_boot(up + as_root(ROUTE_COMMAND), "podwatch fleet units")
    if not has_multicast_route():
        return Finding(what, lacks="no multicast route: there can be no bus", mend=mend)
    source = _source_address()
    if on_drone and not source.startswith(LOOPBACK):
        lacks = f"the bus hangs on the interface of {source}: when that goes down, the bus dies"
        return Finding(what, lacks=lacks, mend=mend)
    if not _hears_itself():
        return Finding(
            what,
            lacks=f"what is said to {GROUP} is not heard here: does a firewall stop it?",
            mend=as_root("iptables -I INPUT -d 239.255.76.0/24 -j ACCEPT"),
        )
    return Finding(what, f"a route, by {source}")


def check_receive_buffer(wanted_bytes: int = RECEIVE_BYTES) -> Finding:
    """What the kernel grants a bus that asks for `wanted_bytes` (net.core.rmem_max)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted_bytes)
        granted_bytes = probe.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2  # Linux doubles it
    if granted_bytes < wanted_bytes:
        kept = f"echo net.core.rmem_max={wanted_bytes} | {as_root(f'tee {SYSCTL_FILE}')}"
        return Finding(
            "rmem_max",
            lacks=f"{granted_bytes} bytes, {wanted_bytes} wanted: long messages will be lost",
            mend=f"{kept} && {as_root(f'sysctl -p {SYSCTL_FILE}')}",
        )
    return Finding("rmem_max", f"a bus may hold {granted_bytes} bytes")


def check_slots(
    first_port: int = FIRST_PORT, taken: Callable[[], Sequence[int]] = taken_slots, n_slots: int = N_SLOTS
) -> Finding:
    """Whether a run finds a free slot, and its port."""
    used = taken()
    free = [number for number in range(n_slots) if number not in used]
    in_use = f"in use: {', '.join(map(str, used))}" if used else "none in use"
    if not free:
        return Finding(
            "slots", lacks=f"all {n_slots} are in use", mend="lsof /tmp/podwatch-slot-*.lock; end one of them"
        )
    port = first_port + free[0]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as every bus does
        try:
            probe.bind(("", port))
        except OSError as error:
            who, mend = _holder(port)
            return Finding(
                "slots",
                lacks=f"udp {port} of slot {free[0]} cannot be had: {who or error.strerror}",
                mend=mend,
            )
    return Finding("slots", f"{in_use}; slot {free[0]} and its udp port {port} are free")


def frames_bytes(camera: CameraSettings, n_cameras: int) -> int:
    """What the rings of frames of so many cameras take."""
    return n_cameras * SLOTS_OF_A_RING * camera.width_px * camera.height_px * 3


def check_shared_memory(wanted_bytes: int, folder: Path = SHARED_FOLDER) -> Finding:
    """Whether the cameras' rings of frames fit."""
    what = str(folder)
    if not folder.is_dir():
        mend = f"{as_root(f'mkdir {folder}')} && {as_root(f'mount -t tmpfs tmpfs {folder}')}"
        return Finding(what, lacks="it is not there", mend=mend)
    probe = folder / f"podwatch_doctor_{os.getpid()}"
    try:
        probe.write_bytes(b"podwatch")
        free_bytes = shutil.disk_usage(folder).free
    except OSError as error:
        free_bytes = 0
        if error.errno != errno.ENOSPC:  # a full one is told below
            return Finding(
                what,
                lacks=f"it cannot be written: {error.strerror}",
                mend=until_boot(as_root(f"mount -o remount,rw {folder}"), f"rw for {folder} in /etc/fstab"),
            )
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
    if free_bytes < wanted_bytes:
        lacks = f"{_mb(free_bytes)} MB are free, {_mb(wanted_bytes)} MB wanted for the frames"
        size_mb = _mb(shutil.disk_usage(folder).used + wanted_bytes) + 1
        mend = until_boot(
            as_root(f"mount -o remount,size={size_mb}M {folder}"),
            f"in /etc/fstab: tmpfs {folder} tmpfs size={size_mb}M 0 0",
        )
        return Finding(what, lacks=lacks, mend=mend)
    return Finding(what, f"{_mb(free_bytes)} MB free, {_mb(wanted_bytes)} MB wanted")


def check_model(path: Path | None = None) -> Finding:
    """Whether the detector's model loads and runs; None is the one that ships."""
    from procs.detector.yolo import Detector

    shipped = Path(models.__file__).parent / SHIPPED
    try:
        Detector(path or shipped)
    except ModelError as error:
        return Finding("model", lacks=str(error), mend=restored_model())
    return Finding("model", f"{(path or shipped).name} loads and runs")


def check_java(which: Callable[[str], str | None] = shutil.which) -> Finding:
    """Whether lcm-spy (`podwatch spy --gui`) could start, given a screen; nothing else needs Java."""
    missing = what_is_missing(which=which, needs_screen=False)
    if missing is not None:
        lacks, mend = missing
        return Finding("java", lacks=f"{lacks} (only `podwatch spy --gui` needs it)", mend=mend)
    return Finding("java", "lcm-spy can start with our message types")


def _is_loopback_up() -> bool:
    stats = psutil.net_if_stats().get("lo")
    return stats is not None and stats.isup


def _source_address() -> str:
    """The interface by which a drone's bus goes out."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((GROUP, FIRST_PORT))
        return str(probe.getsockname()[0])


def _hears_itself() -> bool:
    """Whether a datagram to a group that this socket has joined comes back."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        probe.bind((GROUP, 0))
        probe.settimeout(HEAR_S)
        try:
            membership = socket.inet_aton(GROUP) + socket.inet_aton("0.0.0.0")
            probe.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            probe.sendto(b"podwatch doctor", (GROUP, probe.getsockname()[1]))
            return probe.recv(100) == b"podwatch doctor"
        except OSError:
            return False


def _holder(port: int) -> tuple[str, str]:
    """(who has a UDP port, the command that ends it or finds it)."""
    for connection in psutil.net_connections("udp"):
        if connection.laddr and connection.laddr.port == port and connection.pid:
            name = psutil.Process(connection.pid).name()
            return f"process {connection.pid} ({name}) has it for itself", f"kill {connection.pid}"
    return "", as_root(f"ss -lunp sport = :{port}")


def _mb(n_bytes: int) -> int:
    return round(n_bytes / 1e6)
