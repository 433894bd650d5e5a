"""MAVLink as ArduCopter speaks it: the codec on bytes in memory, flight modes, type masks of setpoints.

pymavlink reads MAVLINK20 when it is first imported, so it is imported here only.
"""

import os
from enum import IntEnum
from typing import Any

os.environ.setdefault("MAVLINK20", "1")

from pymavlink.dialects.v20 import ardupilotmega as mavlink

__all__ = [
    "AUTOPILOT_COMPONENT",
    "GROUND_SYSTEM",
    "POSITION_VELOCITY_YAW",
    "POSITION_YAW",
    "VELOCITY_YAW",
    "Codec",
    "Mode",
    "mavlink",
]

GROUND_SYSTEM = 255  # whose HEARTBEAT feeds the ground-station failsafe
AUTOPILOT_COMPONENT = 1

# Type masks of SET_POSITION_TARGET_LOCAL_NED; a set bit means "ignore this field". Yaw is always sent:
# without it the nose turns along the path (docs/autopilot_facts.md, 5 and 6, which measured the same
# masks without yaw).
POSITION_YAW = 0x9F8
VELOCITY_YAW = 0x9C7
POSITION_VELOCITY_YAW = 0x9C0


class Mode(IntEnum):
    """ArduCopter's flight modes that matter here (HEARTBEAT.custom_mode)."""

    STABILIZE = 0
    ALT_HOLD = 2
    AUTO = 3
    GUIDED = 4
    LOITER = 5
    RTL = 6
    LAND = 9
    BRAKE = 17


class _Outbox:
    """The file that pymavlink writes to."""

    def __init__(self) -> None:
        self.data = bytearray()

    def write(self, data: bytes) -> None:
        self.data += data


class Codec:
    """Packs and parses MAVLink 2 in memory. `send` is pymavlink's own sender (`send.heartbeat_send(...)`)."""

    def __init__(self, system_id: int, component_id: int) -> None:
        if not 1 <= system_id <= 255:
            raise ValueError(f"MAVLink system id {system_id}: it must be 1 to 255")
        self._outbox = _Outbox()
        self.send: Any = mavlink.MAVLink(self._outbox, srcSystem=system_id, srcComponent=component_id)
        self._parser: Any = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self.n_bad = 0  # pieces that were no valid message

    def take(self) -> bytes:
        """What was sent since the last call."""
        data = bytes(self._outbox.data)
        self._outbox.data.clear()
        return data

    def parse(self, data: bytes) -> list[Any]:
        """The whole messages in what has arrived so far; damaged and unknown ones are counted and dropped."""
        messages = []
        for message in self._parser.parse_buffer(data) or ():
            if message.get_type() == "BAD_DATA" or message.get_type().startswith("UNKNOWN"):
                self.n_bad += 1
            else:
                messages.append(message)
        return messages
