"""The bridge's core: MAVLink bytes in and out, setpoints in, the vehicle's state out. No clock, no socket.

Every rule follows a measured fact of docs/autopilot_facts.md; docs/autopilot.md tells them in words. Three
rules are never broken: a setpoint older than its expiry is never sent; whoever takes the vehicle out of our
modes (the pilot's stick, a failsafe) keeps it; the bridge never disarms.
"""

import math
from typing import Any

from drivers.autopilots.ardupilot import AUTOPILOT_COMPONENT, GROUND_SYSTEM, Codec, Mode, mavlink
from lcmtypes.podwatch import setpoint_t
from procs.autopilot.flyer import LONG_AGO_US, Flyer
from procs.autopilot.limits import Vector
from procs.autopilot.requests import Parameters, Streams
from procs.autopilot.telemetry import STREAMS_HZ, Telemetry
from procs.settings import LimitSettings, Mission

__all__ = ["Bridge"]

HEARTBEAT_US = 1_000_000  # fact 3
SILENT_POSITION_US = 2_000_000  # after which the streams are asked for again
# The failsafe must outlast a restart of this process: 2 s until the supervisor acts and up to 3.3 s of
# imports.
GROUND_SILENCE_S = 10.0
FENCE_MARGIN_M = 20.0  # of the autopilot's own fence beyond ours, which acts first
LARGEST_CIRCLE_M = 10_000.0  # that ArduCopter's fence takes
FENCE_HEIGHT, FENCE_CIRCLE = 1.0, 2.0  # bits of FENCE_TYPE
# Return when the battery is low, land when it is nearly empty, should we fail to: at what voltages depends on
# the battery, and only its owner knows. Preferred only: without a monitor of it ArduPilot lacks these names.
BATTERY_FAILSAFES = ((("BATT_FS_LOW_ACT", 2.0),), (("BATT_FS_CRT_ACT", 1.0),))
NEVER_HEARD_MS = 2**31 - 1


class Bridge:
    """Flies one autopilot for one drone.

    Call `receive` with bytes from the link, `setpoint` with what the navigator says, and `step` at 20 Hz; the
    last two return what to write to the link. system_id: our own, the ground station's. target_system: the
    autopilot's, by default the drone's id.
    """

    def __init__(
        self,
        mission: Mission,
        drone_id: int,
        system_id: int = GROUND_SYSTEM,
        target_system: int | None = None,
    ) -> None:
        self.target_system = drone_id if target_system is None else target_system
        self.telemetry = Telemetry(mission.origin)
        self.flyer = Flyer(drone_id, mission.limits, self.telemetry, self._send_setpoint)
        self._codec = Codec(system_id, mavlink.MAV_COMP_ID_MISSIONPLANNER)
        self._streams = Streams(STREAMS_HZ)
        self._parameters = Parameters(
            _failsafes(mission, drone_id, system_id), preferred=[*BATTERY_FAILSAFES, *_speeds(mission.limits)]
        )
        self._heartbeat_due_us = LONG_AGO_US
        self._streams_asked_us = 0
        self._foreign_system = 0

    def receive(self, data: bytes, utime: int) -> None:
        """Bytes from the link. Only the target's autopilot component is heard (fact 13)."""
        for message in self._codec.parse(data):
            if message.get_srcComponent() != AUTOPILOT_COMPONENT:
                continue
            if message.get_srcSystem() != self.target_system:
                self._foreign_system = message.get_srcSystem()
                continue
            if self.telemetry.hear(message, utime):
                self._begin(utime)
            kind = message.get_type()
            if kind == "HEARTBEAT":
                self.flyer.authority.observe(self.telemetry.mode, utime)
            elif kind == "COMMAND_ACK" and message.target_system in (0, self._codec.send.srcSystem):
                self._answered(message, utime)
            elif kind == "PARAM_VALUE":
                self._parameters.heard(message.param_id, message.param_value)

    def setpoint(self, setpoint: setpoint_t, utime: int) -> bytes:
        """What the navigator wants now; returns what to write at once."""
        self.flyer.hear(setpoint, utime)
        return self._codec.take()

    def step(self, utime: int) -> bytes:
        """What to write to the link now."""
        if utime >= self._heartbeat_due_us:
            self._heartbeat_due_us = utime + HEARTBEAT_US
            self._codec.send.heartbeat_send(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
            )
        if self.telemetry.link_ok(utime):
            self._ask(utime)
            self.flyer.repeat(utime)
            for command in self.flyer.commands.due(utime):
                self._send_command(command.command, command.parameters, command.confirmation)
        return self._codec.take()

    def farewell(self, utime: int) -> bytes:
        """What to write when this process ends in the air: stop, or it would fly on for 3 s (fact 2)."""
        telemetry = self.telemetry
        if telemetry.link_ok(utime) and telemetry.mode == Mode.GUIDED and not telemetry.landed:
            self.flyer.hold(utime)
        return self._codec.take()

    def state(self, utime: int) -> dict[str, Any]:
        """The fields of vehicle_state_t by name; its `utime` is when the position arrived, 0 for never."""
        telemetry, flyer = self.telemetry, self.flyer
        n_m, e_m, d_m = telemetry.place
        vn_m_s, ve_m_s, vd_m_s = telemetry.velocity
        heard_us = telemetry.heartbeat_utime
        return {
            "utime": telemetry.position_utime or 0,
            "utc_us": telemetry.utc_us(telemetry.position_utime) if telemetry.position_utime else 0,
            "n_m": n_m,
            "e_m": e_m,
            "d_m": d_m,
            "vn_m_s": vn_m_s,
            "ve_m_s": ve_m_s,
            "vd_m_s": vd_m_s,
            "roll_rad": telemetry.roll_rad,
            "pitch_rad": telemetry.pitch_rad,
            "yaw_rad": telemetry.yaw_rad,
            "battery": telemetry.battery,
            "position_ok": telemetry.position_ok(utime),
            "armed": telemetry.armed,
            "landed": telemetry.landed,
            "guided": flyer.authority.is_ours and telemetry.link_ok(utime),
            "flight_mode": telemetry.mode,
            "link_age_ms": NEVER_HEARD_MS if heard_us is None else (utime - heard_us) // 1000,
            "setpoint_utime": flyer.passed_on[0],
            "setpoint_age_us": flyer.passed_on[1],
            "n_expired": flyer.n_expired,
            "n_clamped": flyer.n_clamped,
        }

    def problem(self, utime: int) -> str:
        """What is wrong, for the heartbeat; empty where nothing is."""
        telemetry = self.telemetry
        if not telemetry.link_ok(utime):
            if self._foreign_system:
                return (
                    f"heard an autopilot of system {self._foreign_system}, not {self.target_system}; "
                    "set its MAV_SYSID, or system_id in the link's options"
                )
            return "the autopilot is not heard; is it powered, and the link's address right?"
        if self.flyer.wants_to_take_off() and not telemetry.armed and telemetry.text:
            return f"the autopilot does not arm: {telemetry.text}"
        unset = self._parameters.problem()
        return f"the autopilot's failsafes are not all set: {unset}" if unset else ""

    def _begin(self, utime: int) -> None:
        """A new link or a restarted autopilot: ask for everything again."""
        self.flyer.restart()
        self._streams.restart(utime)
        self._streams_asked_us = utime
        self._parameters.restart(utime)

    def _ask(self, utime: int) -> None:
        position_us = self.telemetry.position_utime or LONG_AGO_US
        if self._streams.is_done and utime - max(position_us, self._streams_asked_us) > SILENT_POSITION_US:
            self._streams.restart(utime)
            self._streams_asked_us = utime
        stream = self._streams.due(utime)
        if stream is not None:
            self._send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, stream, 0)
        for name, value in self._parameters.due(utime):
            self._codec.send.param_set_send(
                self.target_system, AUTOPILOT_COMPONENT, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32
            )

    def _answered(self, message: Any, utime: int) -> None:
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self._streams.answered(utime)
            return
        command = self.flyer.commands.answered(message.command, message.result, utime)
        if command is not None:
            self.flyer.accepted(command, utime)

    def _send_command(self, command: int, parameters: tuple[float, ...], confirmation: int) -> None:
        filled = (*parameters, *([0.0] * (7 - len(parameters))))
        self._codec.send.command_long_send(
            self.target_system, AUTOPILOT_COMPONENT, command, confirmation, *filled
        )

    def _send_setpoint(self, mask: int, place: Vector, velocity: Vector, yaw_rad: float, utime: int) -> None:
        no_acceleration, no_yaw_rate = (0.0, 0.0, 0.0), 0.0
        self._codec.send.set_position_target_local_ned_send(
            utime // 1000 % 2**32,
            self.target_system,
            AUTOPILOT_COMPONENT,
            mavlink.MAV_FRAME_LOCAL_NED,
            mask,
            *place,
            *velocity,
            *no_acceleration,
            yaw_rad,
            no_yaw_rate,
        )


def _failsafes(mission: Mission, drone_id: int, system_id: int) -> list[tuple[tuple[str, float], ...]]:
    """The parameters by which the autopilot guards itself, in the names of all versions (fact 14)."""
    limits = mission.limits
    home = mission.home(drone_id)
    # The autopilot's circle is round its home, ours round the fleet's origin: wide enough to hold ours.
    radius_m = limits.fence_radius_m + math.hypot(home.home_n_m, home.home_e_m) + FENCE_MARGIN_M
    circle = FENCE_CIRCLE if radius_m <= LARGEST_CIRCLE_M else 0.0
    return [
        (("MAV_GCS_SYSID", float(system_id)), ("SYSID_MYGCS", float(system_id))),
        (("FS_GCS_ENABLE", 1.0),),
        (("FS_GCS_TIMEOUT", GROUND_SILENCE_S),),
        (("FENCE_TYPE", FENCE_HEIGHT + circle),),
        (("FENCE_RADIUS", min(radius_m, LARGEST_CIRCLE_M)),),
        (("FENCE_ALT_MAX", limits.max_height_m + FENCE_MARGIN_M),),
        (("FENCE_ENABLE", 1.0),),
    ]


def _speeds(limits: LimitSettings) -> list[tuple[tuple[str, float], ...]]:
    """The autopilot's own speeds, which RTL and LAND fly with: m/s in new versions, cm/s in old ones."""
    speeds = (("", limits.speed_m_s), ("_UP", limits.climb_m_s), ("_DN", limits.descent_m_s))
    return [((f"WP_SPD{axis}", speed), (f"WPNAV_SPEED{axis}", 100 * speed)) for axis, speed in speeds]
