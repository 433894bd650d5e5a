"""Checks of one drone on its own machine, by its fleet file: those of `podwatch fleet check`, and whether the
autopilot speaks.
"""

import select
import time
from pathlib import Path

from drivers.autopilots.mavlink_link import AutopilotLink, open_link
from drivers.frames import SHARED_FOLDER
from procs.settings import Mission
from tools.findings import Finding
from tools.fleet.check import check_drone, check_fleet
from tools.fleet.machine import machine_of

__all__ = ["check_autopilot", "fleet_findings"]

LISTEN_S = 3.0  # an autopilot beats once a second
MAVLINK_STARTS = (0xFE, 0xFD)  # MAVLink 1 and 2
HEARTBEAT_BYTES = 17  # the shortest frame that holds one
OWN = ("multicast", "rmem_max", str(SHARED_FOLDER))  # of the machine: doctor looks at them in any case


def fleet_findings(mission: Mission, path: Path, drone_id: int | None) -> list[Finding]:
    """The key and the addresses of a fleet file and, for one drone, its edges. Raises MissionError."""
    if drone_id is None:
        return check_fleet(mission, path)
    found = [one for one in check_drone(mission, path, drone_id) if one.what not in OWN]
    machine = machine_of(mission, drone_id)
    deeper = "autopilot" not in machine.drivers
    return [
        check_autopilot(machine.autopilot, LISTEN_S)
        if one.what == "autopilot" and deeper and not one.lacks
        else one
        for one in found
    ]


def check_autopilot(address: str, listen_s: float) -> Finding:
    """Whether an autopilot says MAVLink at `address` within `listen_s`."""
    try:
        link = open_link(address)
    except (OSError, ValueError) as error:
        return Finding("autopilot", lacks=str(error), mend=_mend(address))
    try:
        heard = _listen(link, listen_s)
    finally:
        link.close()
    if not heard:
        return Finding("autopilot", lacks=f"{address}: silent for {listen_s:g} s", mend=_mend(address))
    if not any(start in heard for start in MAVLINK_STARTS) or len(heard) < HEARTBEAT_BYTES:
        lacks = f"{address}: {len(heard)} bytes that are no MAVLink; is the baud rate right?"
        return Finding("autopilot", lacks=lacks, mend=_mend(address))
    return Finding("autopilot", f"{address} speaks MAVLink")


def _listen(link: AutopilotLink, listen_s: float) -> bytes:
    heard, ends_s = b"", time.monotonic() + listen_s
    while len(heard) < HEARTBEAT_BYTES and (left_s := ends_s - time.monotonic()) > 0:
        select.select([link], [], [], min(left_s, 0.2))
        link.write(b"")  # a TCP link goes on connecting
        heard += link.receive()
    return heard


def _mend(address: str) -> str:
    """What makes an autopilot speak there."""
    kind, _, rest = address.partition(":")
    if kind == "serial":
        device, _, baud = rest.rpartition(":")
        return f"mavproxy.py --master={device} --baudrate={baud}  # then: param show SERIAL*_PROTOCOL"
    if kind == "udp":
        return f"mavproxy.py --out=udp:{rest}  # on the autopilot's side"
    return f"nc -vz {rest.replace(':', ' ')}  # then start the autopilot there"
