"""What a machine's edges lack: its camera, its autopilot, its radio. Each is really opened."""

import os
import select
import socket
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2

from drivers.autopilots.ardupilot import AUTOPILOT_COMPONENT, Codec, mavlink
from drivers.autopilots.mavlink_link import AutopilotLink, MavlinkUdpClient, open_link
from procs.bus_executor import load_driver
from procs.runtime import RuntimeFailure
from procs.settings import DriverSpec, MachineSettings, Mission
from tools.findings import Finding
from tools.fleet.machine import listen_address

__all__ = ["check_autopilot", "check_camera", "check_radio"]

LOOK_S = 0.2
# Who asks where the autopilot speaks only to those who spoke: neither a vehicle nor a ground station, whose
# silence afterwards would be a failsafe's business.
ASKING_SYSTEM = 254
ASKING_COMPONENT = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER


def check_camera(mission: Mission, machine: MachineSettings, spec: DriverSpec) -> Finding:
    """Open it and take a picture: its size is what the mission says."""
    kind, _, source = machine.camera.partition(":")
    if "camera" not in machine.drivers:
        lacking = _lacking_device("camera", source, "video") if kind == "v4l2" else None
        if kind == "gstreamer" and not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER):
            lacking = Finding(
                "camera",
                lacks=f"{machine.camera}: the OpenCV that pip installs is built without GStreamer",
                mend='camera = "v4l2:DEVICE" or "ffmpeg:ADDRESS", which it has; or build an OpenCV with '
                "GStreamer: docs/operate.md",
            )
        if lacking is not None:
            return lacking
    try:
        image = load_driver(spec).capture()
    except (RuntimeFailure, OSError) as error:
        mend = "v4l2-ctl --list-devices  # of: sudo apt-get install v4l-utils; then set camera in the file"
        return Finding("camera", lacks=str(error), mend=mend)
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


def check_autopilot(address: str, system_id: int, listen_s: float) -> Finding:
    """Whether the autopilot of `system_id`, the only one that the bridge hears, beats within `listen_s`."""
    what = "autopilot"
    kind, _, rest = address.partition(":")
    if kind == "serial" and (lacking := _lacking_device(what, rest.rpartition(":")[0], "dialout")):
        return lacking
    try:
        link = open_link(address)
    except (OSError, ValueError) as error:
        taken = f"ss -lunp sport = :{rest.rpartition(':')[2]}; end that program"
        return Finding(what, lacks=str(error), mend=taken if kind == "udp" else _mend(address))
    try:
        heard = _listen(link, system_id, listen_s)
    finally:
        link.close()
    if system_id in heard.autopilots:
        return Finding(what, f"{address}: system {system_id} speaks MAVLink")
    if heard.autopilots:
        others = ", ".join(map(str, heard.autopilots))
        return Finding(
            what,
            lacks=f"{address}: the autopilot of system {others} beats, only {system_id} would be heard",
            mend=f"{_console(address)}  # of: pip install MAVProxy; then type: param set MAV_SYSID "
            f"{system_id} (before ArduPilot 4.7: SYSID_THISMAV), and: reboot",
        )
    if heard.n_messages:
        lacks = f"{address}: MAVLink, but no autopilot's heartbeat in {listen_s:g} s"
    elif heard.n_bytes:
        lacks = f"{address}: {heard.n_bytes} bytes that are no MAVLink; is the baud rate right?"
    else:
        lacks = f"{address}: silent for {listen_s:g} s"
    return Finding(what, lacks=lacks, mend=_mend(address))


def check_radio(what: str, address: str) -> Finding:
    """Whether this machine hears what is sent to `address`: it has that host, and the port is free."""
    host, _, port = address.rpartition(":")
    listen_host = listen_address(address).rpartition(":")[0]
    try:
        _bind(listen_host, int(port))
    except (OSError, OverflowError) as error:
        mend = f"ss -lunp sport = :{port}; end that program"
        return Finding(what, lacks=f"udp {address}: {error}", mend=mend)
    try:
        _bind(host, 0)
    except OSError:
        return Finding(
            what,
            lacks=f"udp {address}: this machine has no address {host}, where the others reach it",
            mend="ip -br address  # the right machine? Then give it that address, or set radio to its own",
        )
    return Finding(what, f"udp {address} is free")


@dataclass
class _Heard:
    """What came over a link. autopilots: ids of the systems whose autopilot beat, in the order heard."""

    n_bytes: int = 0
    n_messages: int = 0
    autopilots: list[int] = field(default_factory=list)


def _listen(link: AutopilotLink, system_id: int, listen_s: float) -> _Heard:
    """Until the autopilot of `system_id` beats, or the time is over."""
    codec = Codec(ASKING_SYSTEM, ASKING_COMPONENT)
    heard, ends_s = _Heard(), time.monotonic() + listen_s
    while system_id not in heard.autopilots and (left_s := ends_s - time.monotonic()) > 0:
        if isinstance(link, MavlinkUdpClient):  # the far end does not know of us before we speak
            codec.send.heartbeat_send(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0
            )
        link.write(codec.take())  # also of nothing: a TCP link goes on connecting
        select.select([link], [], [], min(left_s, LOOK_S))
        data = link.receive()
        heard.n_bytes += len(data)
        for message in codec.parse(data):
            heard.n_messages += 1
            is_autopilot = message.get_srcComponent() == AUTOPILOT_COMPONENT
            if message.get_type() == "HEARTBEAT" and is_autopilot:
                if message.get_srcSystem() not in heard.autopilots:
                    heard.autopilots.append(message.get_srcSystem())
    return heard


def _console(address: str) -> str:
    """The command that opens a console to the autopilot there."""
    kind, _, rest = address.partition(":")
    device, _, baud = rest.rpartition(":")
    link = f"{device} --baudrate={baud}" if kind == "serial" else address
    return f"mavproxy.py --master={link}"


def _mend(address: str) -> str:
    """What makes an autopilot speak there."""
    kind, _, rest = address.partition(":")
    if kind == "serial":
        return f"{_console(address)}  # of: pip install MAVProxy; then type: param show SERIAL*"
    if kind == "tcp":
        return f"nc -vz {rest.replace(':', ' ')}  # of: netcat-openbsd; then start the autopilot there"
    if kind == "udpout":
        return f"ping {rest.rpartition(':')[0]}  # then start the autopilot's link there"
    return f"mavproxy.py --out=udp:{rest}  # on the autopilot's side; of: pip install MAVProxy"


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


def _bind(host: str, port: int) -> None:
    """Take a UDP port for a moment. Raises OSError where it is taken, or the host is not this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((host, port))
