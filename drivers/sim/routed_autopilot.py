"""A real autopilot in the place of a simulated one: `podwatch sim --autopilot ADDRESS[,ADDRESS...]`.

The world passes bytes unchanged between the drone's bridge and the real link, and listens: where the
autopilot says that its vehicle is, there the world's cameras look from. The link is one channel to the
autopilot, so the streams that the bridge asks for come here too; what does not come is asked for here, under
a system id of our own, so that no answer is taken for one to the bridge.

Units: metres in the fleet's NED frame, radians, seconds of simulation time, which is real time here.
"""

import math
from typing import Any

import pymap3d

from drivers.autopilots.ardupilot import AUTOPILOT_COMPONENT, Codec, mavlink
from drivers.autopilots.mavlink_link import AutopilotLink
from drivers.cameras.pinhole import Pose

__all__ = ["MisplacedError", "RoutedAutopilot"]

OWN_SYSTEM = 254  # not 255: that is the bridge, whose HEARTBEAT alone may feed the failsafe
FARTHEST_M = 20_000.0  # of an autopilot's origin from the fleet's: farther is another place's settings
HOME_SLACK_M = 30.0
SILENT_S = 2.0
ASK_S = 1.0
# The rates of the bridge, so that neither unsets what the other asked for.
WANTED_HZ = {
    "LOCAL_POSITION_NED": (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 20.0),
    "ATTITUDE": (mavlink.MAVLINK_MSG_ID_ATTITUDE, 20.0),
    "GPS_GLOBAL_ORIGIN": (mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, 1.0),
}


class MisplacedError(Exception):
    """An autopilot that is nowhere near the fleet; the message says where it is and what to set."""


class RoutedAutopilot:
    """One real autopilot with its vehicle, as the world sees it.

    origin: (latitude deg, longitude deg, altitude m) of the fleet's frame. home: (n, e) m where the mission
    expects the vehicle at first; there it is until it has said where it is.
    """

    def __init__(
        self,
        link: AutopilotLink,
        drone_id: int,
        *,
        origin: tuple[float, float, float],
        home: tuple[float, float],
    ) -> None:
        self._link = link
        self._drone_id = drone_id
        self._origin = origin
        self._home = home
        self._codec = Codec(OWN_SYSTEM, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._system = 0  # the autopilot's, once it was heard
        self._heard_s: dict[str, float] = {}
        self._asked_s = -math.inf
        self._offset: tuple[float, float] | None = None  # of the autopilot's origin in the fleet's frame
        self._local = (0.0, 0.0, 0.0)
        self._velocity = (0.0, 0.0, 0.0)
        self._angles = (0.0, 0.0, 0.0)
        self._stands_off_m: float | None = None  # of its home, when it was first placed

    @property
    def pose(self) -> Pose:
        """Position and attitude as the autopilot last said them."""
        if not self._is_placed:
            return Pose(*self._home, 0.0, *self._angles)
        assert self._offset is not None
        n_m, e_m, d_m = self._local
        return Pose(n_m + self._offset[0], e_m + self._offset[1], d_m, *self._angles)

    @property
    def velocity_ned(self) -> tuple[float, float, float]:
        """Velocity as the autopilot last said it, m/s."""
        return self._velocity

    def receive(self, data: bytes, t_s: float) -> None:
        """Bytes from the bridge go to the autopilot as they are."""
        self._link.write(data)

    def step(self, t_s: float) -> bytes:
        """What the autopilot has said since the last step, for the bridge. Raises MisplacedError."""
        data = self._link.receive()
        for message in self._codec.parse(data):
            if message.get_srcComponent() == AUTOPILOT_COMPONENT:
                self._hear(message, t_s)
        if t_s - self._asked_s >= ASK_S:
            self._asked_s = t_s
            self._ask(t_s)
            self._link.write(self._codec.take())
        return data

    def problem(self, t_s: float) -> str:
        """What is wrong, for people; empty where nothing is."""
        name = f"drone {self._drone_id}'s autopilot"
        if t_s - self._heard_s.get("HEARTBEAT", 0.0) > SILENT_S * 2:
            return f"{name} is not heard; is it running, and its address right?"
        if self._heard_s and self._system != self._drone_id:
            return f"{name} is system {self._system}; set its MAV_SYSID to {self._drone_id}"
        if self._stands_off_m is not None and self._stands_off_m > HOME_SLACK_M:
            return (
                f"{name} stands {self._stands_off_m:.0f} m from its home in the mission file; set home_n_m "
                "and home_e_m of [[drones]], or start it there"
            )
        return ""

    def close(self) -> None:
        self._link.close()

    @property
    def _is_placed(self) -> bool:
        return self._offset is not None and "LOCAL_POSITION_NED" in self._heard_s

    def _hear(self, message: Any, t_s: float) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self._system = message.get_srcSystem()
        elif kind == "ATTITUDE":
            angles = (message.roll, message.pitch, message.yaw)
            if math.isfinite(sum(angles)):
                self._angles = angles
        elif kind == "LOCAL_POSITION_NED":
            place, velocity = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
            if not math.isfinite(sum((*place, *velocity))):
                return
            self._local, self._velocity = place, velocity
        elif kind == "GPS_GLOBAL_ORIGIN":
            self._place_origin(message.latitude * 1e-7, message.longitude * 1e-7)
        else:
            return
        self._heard_s[kind] = t_s
        if self._stands_off_m is None and self._is_placed:
            self._stands_off_m = math.hypot(self.pose.n_m - self._home[0], self.pose.e_m - self._home[1])

    def _place_origin(self, latitude_deg: float, longitude_deg: float) -> None:
        """Over ground only, as the bridge does: heights count from the surface, where the vehicle booted."""
        fleet_latitude_deg, fleet_longitude_deg, altitude_m = self._origin
        n_m, e_m, _ = pymap3d.geodetic2ned(latitude_deg, longitude_deg, altitude_m, *self._origin)
        if not math.hypot(n_m, e_m) <= FARTHEST_M:
            raise MisplacedError(
                f"drone {self._drone_id}'s autopilot counts from {latitude_deg:.5f}, {longitude_deg:.5f}, "
                f"{math.hypot(n_m, e_m) / 1000:.0f} km from the fleet's origin {fleet_latitude_deg:.5f}, "
                f"{fleet_longitude_deg:.5f}; set [origin] in the mission file to where the drones stand"
            )
        self._offset = (float(n_m), float(e_m))

    def _ask(self, t_s: float) -> None:
        """Make ourselves known to one that waits to be spoken to; ask for what does not come."""
        if not self._system:
            self._codec.send.heartbeat_send(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                mavlink.MAV_AUTOPILOT_INVALID,
                0,
                0,
                mavlink.MAV_STATE_ACTIVE,
            )
            return
        for kind, (message_id, rate_hz) in WANTED_HZ.items():
            if t_s - self._heard_s.get(kind, -math.inf) > SILENT_S:
                self._codec.send.command_long_send(
                    self._system,
                    AUTOPILOT_COMPONENT,
                    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                    0,
                    message_id,
                    1e6 / rate_hz,
                    *[0.0] * 5,
                )
