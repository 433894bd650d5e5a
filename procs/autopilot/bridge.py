"""The bridge's core: MAVLink bytes in and out, setpoints in, the vehicle's state out. No clock, no socket.

Every rule follows a measured fact of ../shared/AUTOPILOT.md; docs/autopilot.md tells them in words. Three
rules are never broken: a setpoint older than its expiry is never sent; whoever takes the vehicle out of our
modes (the pilot's stick, a failsafe) keeps it; the bridge never disarms.
"""

import math
from typing import Any

from drivers.autopilots.ardupilot import (
    AUTOPILOT_COMPONENT,
    GROUND_SYSTEM,
    POSITION_VELOCITY_YAW,
    VELOCITY_YAW,
    Codec,
    Mode,
    mavlink,
)
from lcmtypes.podwatch import setpoint_t
from procs.autopilot.authority import Authority
from procs.autopilot.limits import Envelope, Follower, Vector
from procs.autopilot.requests import Commands, Parameters, Streams
from procs.autopilot.telemetry import STREAMS_HZ, Telemetry
from procs.settings import LimitSettings, Mission

__all__ = ["Bridge"]

HEARTBEAT_US = 1_000_000  # fact 3
WRITE_US = 45_000  # a live setpoint is written anew at 20 Hz
LONGEST_LIFE_US = 2_000_000  # whatever a setpoint says of its expiry
BRAKE_AFTER_US = 1_000_000  # of zero velocity without a live setpoint
SILENT_POSITION_US = 3_000_000  # after which the streams are asked for again
CLIMB_REACHED_M = 0.5
CLIMB_STALLED_US = 6_000_000  # without a new greatest height
CLIMB_PROGRESS_M = 0.2
LONGEST_STEP_S = 0.2
# The failsafe must outlast a restart of this process: 2 s until the supervisor acts and up to 3.3 s of
# imports.
GROUND_SILENCE_S = 10.0
FENCE_MARGIN_M = 20.0  # of the autopilot's own fence beyond ours, which acts first
LARGEST_CIRCLE_M = 10_000.0  # that ArduCopter's fence takes
KINDS = range(setpoint_t.IDLE, setpoint_t.LAND + 1)


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
        self.drone_id = drone_id
        self.target_system = drone_id if target_system is None else target_system
        self.telemetry = Telemetry(mission.origin)
        self.n_expired = 0
        self.n_clamped = 0
        self.n_refused = 0  # setpoints with a number that is none, of an unknown kind, or for another drone
        self._codec = Codec(system_id, mavlink.MAV_COMP_ID_MISSIONPLANNER)
        self._authority = Authority()
        self._envelope = Envelope(mission.limits)
        self._commands = Commands()
        self._streams = Streams(STREAMS_HZ)
        self._parameters = Parameters(_wishes(mission, drone_id, system_id))
        self._heartbeat_due_us = 0
        self._streams_asked_us = 0
        self._foreign_system = 0
        self._setpoint: setpoint_t | None = None
        self._received_us = 0
        self._passed_on: tuple[int, int] = (0, 0)  # utime of the last setpoint passed on, its age then
        self._clamped_utime = -1
        self._written_us = 0
        self._silent_since_us: int | None = None
        self._hold_yaw_rad: float | None = None
        self._follower: Follower | None = None
        self._climb_d: float | None = (
            None  # height to which NAV_TAKEOFF climbs, fleet's frame, None outside a climb
        )
        self._highest_d = 0.0
        self._highest_us = 0

    # In.

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
                self._authority.observe(self.telemetry.mode, utime)
            elif kind == "COMMAND_ACK" and message.target_system in (0, self._codec.send.srcSystem):
                self._answered(message, utime)
            elif kind == "PARAM_VALUE":
                name = message.param_id
                self._parameters.heard(name if isinstance(name, str) else name.decode(), message.param_value)

    def setpoint(self, setpoint: setpoint_t, utime: int) -> bytes:
        """What the navigator wants now; returns what to write at once."""
        if not self._is_sound(setpoint):
            self.n_refused += 1
            return b""
        if self._setpoint is not None and setpoint.utime < self._setpoint.utime:
            return b""  # an older one that came late
        if utime > setpoint.expiry_utime:
            self.n_expired += 1
            return b""
        self._setpoint = setpoint
        self._received_us = utime
        if self.telemetry.landed and setpoint.kind != setpoint_t.TAKEOFF:
            self._authority.may_begin_anew()
        self._fly(utime)
        return self._take()

    def step(self, utime: int) -> bytes:
        """What to write to the link now."""
        if utime >= self._heartbeat_due_us:
            self._heartbeat_due_us = utime + HEARTBEAT_US
            self._codec.send.heartbeat_send(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
            )
        if self.telemetry.link_ok(utime):
            self._ask(utime)
            if utime - self._written_us >= WRITE_US:
                self._fly(utime)
            self._send_commands(utime)
        return self._take()

    def farewell(self, utime: int) -> bytes:
        """What to write when this process ends in the air: stop, or it would fly on for 3 s (fact 2)."""
        telemetry = self.telemetry
        if telemetry.link_ok(utime) and telemetry.mode == Mode.GUIDED and not telemetry.landed:
            self._hold(utime)
        return self._take()

    # Out.

    def state(self, utime: int) -> dict[str, Any]:
        """The fields of vehicle_state_t by name; its `utime` is when the position arrived, 0 for never."""
        telemetry = self.telemetry
        n_m, e_m, d_m = telemetry.place
        vn_m_s, ve_m_s, vd_m_s = telemetry.velocity
        heard = telemetry.heartbeat_utime
        return {
            "utime": telemetry.position_utime,
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
            "guided": self._authority.is_ours and telemetry.link_ok(utime),
            "flight_mode": telemetry.mode,
            "link_age_ms": (utime - heard) // 1000 if heard else utime // 1000 % 2**31,
            "setpoint_utime": self._passed_on[0],
            "setpoint_age_us": self._passed_on[1],
            "n_expired": self.n_expired,
            "n_clamped": self.n_clamped,
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
        wants_off = self._setpoint is not None and self._setpoint.kind == setpoint_t.TAKEOFF
        if wants_off and not telemetry.armed and telemetry.text:
            return f"the autopilot does not arm: {telemetry.text}"
        unset = self._parameters.problem()
        return f"the autopilot's failsafes are not all set: {unset}" if unset else ""

    # Asking.

    def _begin(self, utime: int) -> None:
        """A new link or a restarted autopilot: ask for everything again."""
        self._authority = Authority()
        self._commands = Commands()
        self._streams.restart(utime)
        self._streams_asked_us = utime
        self._parameters.restart(utime)
        self._climb_d = None
        self._follower = None

    def _ask(self, utime: int) -> None:
        silent_since_us = max(self.telemetry.position_utime, self._streams_asked_us)
        if self._streams.is_done and utime - silent_since_us > SILENT_POSITION_US:
            self._streams.restart(utime)
            self._streams_asked_us = utime
        stream = self._streams.due(utime)
        if stream is not None:
            self._send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, stream, 0)
        for name, value in self._parameters.due(utime):
            self._codec.send.param_set_send(
                self.target_system, AUTOPILOT_COMPONENT, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32
            )

    def _send_commands(self, utime: int) -> None:
        for command in self._commands.due(utime):
            self._send_command(command.command, command.parameters, command.confirmation)

    def _send_command(self, command: int, parameters: tuple[float, ...], confirmation: int) -> None:
        filled = (*parameters, *([0.0] * (7 - len(parameters))))
        self._codec.send.command_long_send(
            self.target_system, AUTOPILOT_COMPONENT, command, confirmation, *filled
        )

    def _answered(self, message: Any, utime: int) -> None:
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self._streams.answered(utime)
            return
        done = self._commands.answered(message.command, message.result, utime)
        if done is None:
            return
        # An acknowledgement comes up to a second before the HEARTBEAT that shows its effect.
        if done.command == mavlink.MAV_CMD_DO_SET_MODE:
            self.telemetry.mode = int(done.parameters[1])
            self._authority.observe(self.telemetry.mode, utime)
        elif done.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            self.telemetry.armed = True
        elif done.command == mavlink.MAV_CMD_NAV_TAKEOFF:
            self._climb_d = self.telemetry.place[2] - done.parameters[6]
            self._highest_d, self._highest_us = self.telemetry.place[2], utime

    def _ask_mode(self, mode: Mode, utime: int) -> None:
        if self.telemetry.mode != mode:
            self._authority.ask(mode, utime)
            custom = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
            self._commands.ask(mavlink.MAV_CMD_DO_SET_MODE, custom, float(mode), utime=utime)

    # Flying.

    def _is_sound(self, setpoint: setpoint_t) -> bool:
        numbers = (
            setpoint.n_m,
            setpoint.e_m,
            setpoint.d_m,
            setpoint.vn_m_s,
            setpoint.ve_m_s,
            setpoint.vd_m_s,
        )
        return (
            setpoint.drone_id == self.drone_id
            and setpoint.kind in KINDS
            and all(math.isfinite(x) for x in (*numbers, setpoint.yaw_rad))
        )

    def _live(self, utime: int) -> setpoint_t | None:
        """The newest setpoint while it lives; counts it when it is found dead."""
        setpoint = self._setpoint
        if setpoint is None:
            return None
        if utime > min(setpoint.expiry_utime, self._received_us + LONGEST_LIFE_US):
            self.n_expired += 1
            self._setpoint = None
            return None
        return setpoint

    def _fly(self, utime: int) -> None:
        """Turn what is wanted into commands and setpoints."""
        setpoint = self._live(utime)
        if self.telemetry.landed:
            self._stand(setpoint, utime)
            return
        if not self._authority.is_ours:
            self._let_go()
            return
        if setpoint is None:
            self._wait(utime)
            return
        self._silent_since_us = None
        if setpoint.kind == setpoint_t.LAND:
            self._ask_mode(Mode.LAND, utime)
        elif setpoint.kind == setpoint_t.RETURN:
            self._ask_mode(Mode.RTL, utime)
        elif self.telemetry.mode != Mode.GUIDED:
            self._ask_mode(Mode.GUIDED, utime)
        elif not self._holds_back(setpoint, utime):
            self._pass_on(setpoint, utime)
        if self.telemetry.mode != Mode.GUIDED:
            self._follower = self._hold_yaw_rad = self._climb_d = None

    def _let_go(self) -> None:
        """Somebody else flies: want nothing."""
        self._follower = self._hold_yaw_rad = self._climb_d = self._silent_since_us = None
        self._commands.drop(mavlink.MAV_CMD_DO_SET_MODE)

    def _stand(self, setpoint: setpoint_t | None, utime: int) -> None:
        """On the ground only TAKEOFF does anything: GUIDED, arm, NAV_TAKEOFF, in this order (fact 7)."""
        self._follower = self._hold_yaw_rad = self._silent_since_us = None
        wanted = setpoint is not None and setpoint.kind == setpoint_t.TAKEOFF
        if setpoint is None or not wanted or not self._authority.may_take_off:
            self._climb_d = None
            for command in (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_NAV_TAKEOFF):
                self._commands.drop(command)
            return
        if self.telemetry.mode != Mode.GUIDED:
            self._ask_mode(Mode.GUIDED, utime)
        elif not self.telemetry.armed:
            self._climb_d = None
            self._commands.ask(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, utime=utime)
        elif self._climb_d is None:
            self._ask_take_off(setpoint, utime)
        elif utime - self._highest_us > CLIMB_STALLED_US:
            self._climb_d = None
        self._note_passed(setpoint, utime)

    def _ask_take_off(self, setpoint: setpoint_t, utime: int) -> None:
        if not self.telemetry.position_ok(utime):
            return
        _, _, goal_d = self._clamped_goal(setpoint)
        height_m = round(
            self.telemetry.place[2] - goal_d, 1
        )  # above home, which is here; rounded to be one wish
        self._commands.ask(mavlink.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height_m, utime=utime)

    def _holds_back(self, setpoint: setpoint_t, utime: int) -> bool:
        """Whether NAV_TAKEOFF still climbs: any setpoint would end it (fact 7). HOLD may."""
        if self._climb_d is None:
            return False
        d = self.telemetry.place[2]
        if d < self._highest_d - CLIMB_PROGRESS_M:
            self._highest_d, self._highest_us = d, utime
        stalled = utime - self._highest_us > CLIMB_STALLED_US
        if (
            d <= self._climb_d + CLIMB_REACHED_M
            or stalled
            or setpoint.kind in (setpoint_t.HOLD, setpoint_t.IDLE)
        ):
            self._climb_d = None
            return False
        self._note_passed(setpoint, utime)
        return True

    def _wait(self, utime: int) -> None:
        """No live setpoint in the air: stand still at once, and hand over to BRAKE soon after (fact 2)."""
        self._climb_d = None
        if self.telemetry.mode != Mode.GUIDED:
            return  # LAND, RTL or BRAKE, as asked
        if self._silent_since_us is None:
            self._silent_since_us = utime
        self._hold(utime)
        if utime - self._silent_since_us >= BRAKE_AFTER_US:
            self._ask_mode(Mode.BRAKE, utime)

    def _pass_on(self, setpoint: setpoint_t, utime: int) -> None:
        """Write a live setpoint, clamped."""
        self._note_passed(setpoint, utime)
        moves = setpoint.kind in (setpoint_t.GOTO, setpoint_t.VELOCITY, setpoint_t.TAKEOFF)
        if not moves or not self.telemetry.position_ok(utime):  # without a position no fence can be kept
            self._hold(utime)
            return
        self._hold_yaw_rad = None
        if setpoint.kind == setpoint_t.VELOCITY:
            self._follower = None
            wanted = (setpoint.vn_m_s, setpoint.ve_m_s, setpoint.vd_m_s)
            velocity = self._envelope.velocity(self.telemetry.place, wanted)
            self._count_clamped(velocity != wanted)
            self._write(VELOCITY_YAW, (0.0, 0.0, 0.0), velocity, setpoint.yaw_rad, utime)
        else:
            self._go(setpoint, utime)

    def _go(self, setpoint: setpoint_t, utime: int) -> None:
        """Lead the vehicle to a place by a stream of position and velocity (fact 9)."""
        telemetry = self.telemetry
        goal = self._clamped_goal(setpoint)
        moving = (setpoint.vn_m_s, setpoint.ve_m_s, setpoint.vd_m_s)
        if setpoint.kind == setpoint_t.TAKEOFF:  # in the air already: the rest of the climb, straight up
            goal = (*(self._follower.place if self._follower else telemetry.place)[:2], goal[2])
            moving = (0.0, 0.0, 0.0)
        allowed = self._envelope.speed(moving)
        self._count_clamped(allowed != moving)
        if self._follower is None:
            self._follower = Follower(self._envelope, telemetry.place, telemetry.velocity)
        dt_s = min((utime - self._written_us) / 1e6, LONGEST_STEP_S)
        self._follower.step(goal, allowed, telemetry.place, dt_s)
        place = telemetry.local(self._follower.place)
        self._write(POSITION_VELOCITY_YAW, place, self._follower.velocity, setpoint.yaw_rad, utime)

    def _clamped_goal(self, setpoint: setpoint_t) -> Vector:
        wanted = (setpoint.n_m, setpoint.e_m, setpoint.d_m)
        goal = self._envelope.position(wanted)
        self._count_clamped(goal != wanted)
        return goal

    def _hold(self, utime: int) -> None:
        """Zero velocity, nose where it was when the hold began."""
        self._follower = None
        if self._hold_yaw_rad is None:
            self._hold_yaw_rad = self.telemetry.yaw_rad
        zero = (0.0, 0.0, 0.0)
        self._write(VELOCITY_YAW, zero, zero, self._hold_yaw_rad, utime)

    def _write(self, mask: int, place: Vector, velocity: Vector, yaw_rad: float, utime: int) -> None:
        self._codec.send.set_position_target_local_ned_send(
            utime // 1000 % 2**32,
            self.target_system,
            AUTOPILOT_COMPONENT,
            mavlink.MAV_FRAME_LOCAL_NED,
            mask,
            *place,
            *velocity,
            0.0,
            0.0,
            0.0,
            yaw_rad,
            0.0,
        )
        self._written_us = utime

    def _note_passed(self, setpoint: setpoint_t, utime: int) -> None:
        """Remember a setpoint's age when it was first passed on."""
        if self._passed_on[0] != setpoint.utime:
            self._passed_on = (setpoint.utime, utime - setpoint.utime)

    def _count_clamped(self, was_clamped: bool) -> None:
        """Count each setpoint once, however often it is written."""
        if was_clamped and self._setpoint is not None and self._clamped_utime != self._setpoint.utime:
            self._clamped_utime = self._setpoint.utime
            self.n_clamped += 1

    def _take(self) -> bytes:
        return self._codec.take()


def _wishes(mission: Mission, drone_id: int, system_id: int) -> list[tuple[tuple[str, float], ...]]:
    """The parameters that the bridge sets; alternatives are the names, and units, of other versions (fact
    14).
    """
    limits = mission.limits
    home = mission.home(drone_id)
    # The autopilot's circle is round its home, ours round the fleet's origin: wide enough to hold ours.
    radius_m = limits.fence_radius_m + math.hypot(home.home_n_m, home.home_e_m) + FENCE_MARGIN_M
    circle = 2.0 if radius_m <= LARGEST_CIRCLE_M else 0.0
    return [
        (("MAV_GCS_SYSID", float(system_id)), ("SYSID_MYGCS", float(system_id))),
        (("FS_GCS_ENABLE", 1.0),),
        (("FS_GCS_TIMEOUT", GROUND_SILENCE_S),),
        (("FENCE_TYPE", 1.0 + circle),),
        (("FENCE_RADIUS", min(radius_m, LARGEST_CIRCLE_M)),),
        (("FENCE_ALT_MAX", limits.max_height_m + FENCE_MARGIN_M),),
        (("FENCE_ENABLE", 1.0),),
        *_speed_wishes(limits),
    ]


def _speed_wishes(limits: LimitSettings) -> list[tuple[tuple[str, float], ...]]:
    """The autopilot's own speeds, which RTL and LAND fly with: m/s in new versions, cm/s in old ones."""
    speeds = (("", limits.speed_m_s), ("_UP", limits.climb_m_s), ("_DN", limits.descent_m_s))
    return [((f"WP_SPD{axis}", speed), (f"WPNAV_SPEED{axis}", 100 * speed)) for axis, speed in speeds]
