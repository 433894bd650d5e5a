"""What the autopilot says of itself, put together, and turned into the fleet's frame."""

import math
from typing import Any

import pymap3d

from drivers.autopilots.ardupilot import mavlink
from procs.autopilot.limits import Vector
from procs.settings import OriginSettings

__all__ = ["EARLIEST_UTC_US", "LATEST_UTC_US", "STREAMS_HZ", "Telemetry"]

POSITION_FRESH_US = 1_000_000
LINK_LOST_US = 3_000_000  # three heartbeats missed: the autopilot may have restarted
# 2020 to 2100: a clock without GPS counts from 1970, from its making, or says all ones.
EARLIEST_UTC_US, LATEST_UTC_US = 1_577_836_800_000_000, 4_102_444_800_000_000
CLOCK_SLACK_MS = 1000  # of disorder in time_boot_ms that is not yet a restart

STREAMS_HZ = (
    (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 20.0),
    (mavlink.MAVLINK_MSG_ID_ATTITUDE, 20.0),
    (mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 5.0),
    (mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, 1.0),
    (mavlink.MAVLINK_MSG_ID_SYS_STATUS, 1.0),
    (mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, 1.0),
)


class Telemetry:
    """The newest of each message; times are the bridge's, us."""

    def __init__(self, origin: OriginSettings) -> None:
        self._fleet_origin = origin
        self.heartbeat_utime: int | None = None
        self.battery = -1.0  # 0-1, the last that was told; below 0 until one is
        self._is_armed_known = False
        self.is_known = False  # heard enough to speak for the vehicle: armed, and what the battery holds
        self._utc_offset_us: int | None = None  # UTC = the bridge's time + this
        self.text = ""  # the last warning that the autopilot sent, for people
        self.forget()

    def forget(self) -> None:
        """What a restart of the autopilot makes untrue."""
        self.mode = 0
        self.armed = False
        self.roll_rad = self.pitch_rad = self.yaw_rad = 0.0
        self.position_utime: int | None = None
        self._landed_state = mavlink.MAV_LANDED_STATE_UNDEFINED
        self._local: Vector = (0.0, 0.0, 0.0)
        self.velocity: Vector = (0.0, 0.0, 0.0)
        self._offset: Vector | None = None  # of the autopilot's origin in the fleet's frame
        self._boot_ms = 0

    @property
    def landed(self) -> bool:
        """On the ground, or with idle motors, which is the same to us."""
        return not self.armed or self._landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND

    @property
    def place(self) -> Vector:
        """Position in the fleet's frame, or the autopilot's own while its origin is unknown."""
        n, e, d = self._offset or (0.0, 0.0, 0.0)
        return self._local[0] + n, self._local[1] + e, self._local[2] + d

    def local(self, place: Vector) -> Vector:
        """A place of the fleet's frame in the autopilot's own."""
        n, e, d = self._offset or (0.0, 0.0, 0.0)
        return place[0] - n, place[1] - e, place[2] - d

    def position_ok(self, utime: int) -> bool:
        """Whether position and origin are known, and fresh."""
        if self._offset is None or self.position_utime is None:
            return False
        return utime - self.position_utime <= POSITION_FRESH_US

    def utc_us(self, utime: int) -> int:
        """Microseconds since 1970 at `utime`, 0 while the autopilot does not know them."""
        return 0 if self._utc_offset_us is None else utime + self._utc_offset_us

    def link_ok(self, utime: int) -> bool:
        """Whether the autopilot was heard lately."""
        return self.heartbeat_utime is not None and utime - self.heartbeat_utime <= LINK_LOST_US

    def hear(self, message: Any, utime: int) -> bool:
        """Take in one message; True where it shows a new link or a restarted autopilot."""
        kind = message.get_type()
        is_new = False
        if kind == "HEARTBEAT":
            is_new = not self.link_ok(utime)
            self.heartbeat_utime = utime
            if is_new:
                self.forget()
            self.mode = int(message.custom_mode)
            self._is_armed_known = True
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        elif kind in ("LOCAL_POSITION_NED", "ATTITUDE"):
            is_new = message.time_boot_ms + CLOCK_SLACK_MS < self._boot_ms
            if is_new:
                # Whether it is armed only its next HEARTBEAT tells: till then nobody may take it for landed.
                self.forget()
                self.is_known = self._is_armed_known = False
            self._boot_ms = message.time_boot_ms
            if kind == "ATTITUDE":
                self.roll_rad, self.pitch_rad, self.yaw_rad = message.roll, message.pitch, message.yaw
            elif math.isfinite(sum((message.x, message.y, message.z, message.vx, message.vy, message.vz))):
                self._local = (message.x, message.y, message.z)
                self.velocity = (message.vx, message.vy, message.vz)
                self.position_utime = utime
        elif kind == "EXTENDED_SYS_STATE":
            self._landed_state = message.landed_state
        elif kind == "GPS_GLOBAL_ORIGIN":
            self._set_origin(message.latitude * 1e-7, message.longitude * 1e-7)
        elif kind == "SYS_STATUS":
            self.is_known = self._is_armed_known
            if message.battery_remaining >= 0:
                self.battery = message.battery_remaining / 100
        elif kind == "SYSTEM_TIME" and EARLIEST_UTC_US <= message.time_unix_usec < LATEST_UTC_US:
            self._utc_offset_us = message.time_unix_usec - utime
        elif kind == "STATUSTEXT" and message.severity <= mavlink.MAV_SEVERITY_WARNING:
            text = message.text
            self.text = text if isinstance(text, str) else text.decode(errors="replace")
        return is_new

    def _set_origin(self, latitude_deg: float, longitude_deg: float) -> None:
        """Place the autopilot's origin in the fleet's frame, over ground only (fact 10).

        Heights count from where the vehicle booted, on the surface: its barometer is right within a metre
        there, while the GPS altitude of its origin and the altitude of the sea in a mission file may be tens
        of metres apart.
        """
        fleet = self._fleet_origin
        n, e, _ = pymap3d.geodetic2ned(
            latitude_deg,
            longitude_deg,
            fleet.altitude_m,
            fleet.latitude_deg,
            fleet.longitude_deg,
            fleet.altitude_m,
        )
        self._offset = (float(n), float(e), 0.0)
