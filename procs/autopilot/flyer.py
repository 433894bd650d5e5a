"""What the bridge makes of a setpoint: the order of commands at take-off, limits, watchdog, hand-over to the
pilot.

Each rule follows a fact of docs/autopilot_facts.md, named in the comments; docs/autopilot.md tells them in
words.
"""

import math
from collections.abc import Callable

from drivers.autopilots.ardupilot import POSITION_VELOCITY_YAW, VELOCITY_YAW, Mode, mavlink
from lcmtypes.podwatch import setpoint_t
from procs.autopilot.authority import Authority
from procs.autopilot.limits import Envelope, Follower, Vector
from procs.autopilot.requests import Command, Commands
from procs.autopilot.telemetry import Telemetry
from procs.settings import LimitSettings

__all__ = ["LONG_AGO_US", "Flyer"]

LONGEST_LIFE_US = 2_000_000  # whatever a setpoint says of its expiry
REPEAT_US = 45_000  # a live setpoint is written anew at 20 Hz
BRAKE_AFTER_US = 1_000_000  # of zero velocity without a live setpoint
CLIMB_REACHED_M = 0.5
CLIMB_STALLED_US = 6_000_000  # without a new greatest height
CLIMB_PROGRESS_M = 0.2
LONGEST_STEP_S = 0.2
KINDS = range(setpoint_t.IDLE, setpoint_t.LAND + 1)
LONG_AGO_US = -(2**62)
STILL: Vector = (0.0, 0.0, 0.0)

Write = Callable[[int, Vector, Vector, float, int], None]


class Flyer:
    """Turns the newest live setpoint into commands and `write(mask, local place, velocity, yaw, utime)`."""

    def __init__(self, drone_id: int, limits: LimitSettings, telemetry: Telemetry, write: Write) -> None:
        self.drone_id = drone_id
        self.n_expired = 0
        self.n_clamped = 0
        self.n_refused = 0  # setpoints with a number that is none, of an unknown kind, or for another drone
        self.passed_on = (0, 0)  # utime of the last setpoint passed on, its age then
        self._telemetry = telemetry
        self._envelope = Envelope(limits)
        self._send = write
        self._setpoint: setpoint_t | None = None
        self._received_us = 0
        self._clamped_utime = -1
        self._written_us = LONG_AGO_US
        self._follower: Follower | None = None
        self._hold_yaw_rad: float | None = None
        self._climb_d: float | None = None  # to where NAV_TAKEOFF climbs, fleet's frame; None outside a climb
        self._highest_d, self._highest_us = 0.0, 0
        self._silent_since_us: int | None = None
        self.restart()

    def restart(self) -> None:
        """The autopilot is new to us: nothing of what we knew of its modes holds."""
        self.authority = Authority()
        self.commands = Commands()
        self._silent_since_us = None
        self._release()

    def hear(self, setpoint: setpoint_t, utime: int) -> None:
        """A setpoint of the navigator. Refused, older and expired ones change nothing."""
        numbers = (
            setpoint.n_m,
            setpoint.e_m,
            setpoint.d_m,
            setpoint.vn_m_s,
            setpoint.ve_m_s,
            setpoint.vd_m_s,
        )
        is_sound = setpoint.drone_id == self.drone_id and setpoint.kind in KINDS
        if not is_sound or not all(math.isfinite(x) for x in (*numbers, setpoint.yaw_rad)):
            self.n_refused += 1
            return
        if self._setpoint is not None and setpoint.utime < self._setpoint.utime:
            return
        if utime > setpoint.expiry_utime:
            self.n_expired += 1
            return
        self._setpoint = setpoint
        self._received_us = utime
        if self._telemetry.landed and setpoint.kind != setpoint_t.TAKEOFF:
            self.authority.may_begin_anew()
        self.fly(utime)

    def wants_to_take_off(self) -> bool:
        """Whether the newest setpoint asks to leave the ground."""
        return self._setpoint is not None and self._setpoint.kind == setpoint_t.TAKEOFF

    def repeat(self, utime: int) -> None:
        """Say again what holds, unless it was said just now."""
        if utime - self._written_us >= REPEAT_US:
            self.fly(utime)

    def fly(self, utime: int) -> None:
        """Turn what is wanted now into commands and setpoints."""
        setpoint = self._live(utime)
        if self._telemetry.landed:
            self._stand(setpoint, utime)
        elif not self.authority.is_ours:
            self._silent_since_us = None
            self._release()
            self.commands.drop(mavlink.MAV_CMD_DO_SET_MODE)
        elif setpoint is None:
            self._wait(utime)
        else:
            self._silent_since_us = None
            self._obey(setpoint, utime)

    def hold(self, utime: int) -> None:
        """Zero velocity, the nose where it was when the hold began."""
        self._follower = None
        if self._hold_yaw_rad is None:
            self._hold_yaw_rad = self._telemetry.yaw_rad
        self._write(VELOCITY_YAW, STILL, STILL, self._hold_yaw_rad, utime)

    def accepted(self, command: Command, utime: int) -> None:
        """The autopilot has accepted a command: up to a second before the HEARTBEAT that shows its effect."""
        telemetry = self._telemetry
        if command.command == mavlink.MAV_CMD_DO_SET_MODE:
            telemetry.mode = int(command.parameters[1])
            self.authority.observe(telemetry.mode, utime)
        elif command.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            telemetry.armed = True
        elif command.command == mavlink.MAV_CMD_NAV_TAKEOFF:
            self._climb_d = telemetry.place[2] - command.parameters[6]
            self._highest_d, self._highest_us = telemetry.place[2], utime

    def _release(self) -> None:
        """Forget what only makes sense while we steer."""
        self._follower = self._hold_yaw_rad = self._climb_d = None

    def _live(self, utime: int) -> setpoint_t | None:
        """The newest setpoint while it lives; counts it when it is found dead."""
        setpoint = self._setpoint
        if setpoint is not None and utime > min(setpoint.expiry_utime, self._received_us + LONGEST_LIFE_US):
            self.n_expired += 1
            self._setpoint = setpoint = None
        return setpoint

    def _stand(self, setpoint: setpoint_t | None, utime: int) -> None:
        """On the ground only TAKEOFF does anything: GUIDED, arm, NAV_TAKEOFF, in this order (fact 7)."""
        self._follower = self._hold_yaw_rad = self._silent_since_us = None
        if setpoint is None or setpoint.kind != setpoint_t.TAKEOFF or not self.authority.may_take_off:
            self._climb_d = None
            self.commands.drop(mavlink.MAV_CMD_COMPONENT_ARM_DISARM)
            self.commands.drop(mavlink.MAV_CMD_NAV_TAKEOFF)
            return
        if self._telemetry.mode != Mode.GUIDED:
            self._ask_mode(Mode.GUIDED, utime)
        elif not self._telemetry.armed:
            self._climb_d = None
            self.commands.ask(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, utime=utime)
        elif self._climb_d is None:
            self._ask_take_off(setpoint, utime)
        elif utime - self._highest_us > CLIMB_STALLED_US:
            self._climb_d = None
        self._note_passed(setpoint, utime)

    def _ask_take_off(self, setpoint: setpoint_t, utime: int) -> None:
        if self._telemetry.position_ok(utime):
            _, _, goal_d = self._clamped_goal(setpoint)
            height_m = round(self._telemetry.place[2] - goal_d, 1)  # above home, which is here
            where = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            self.commands.ask(mavlink.MAV_CMD_NAV_TAKEOFF, *where, height_m, utime=utime)

    def _wait(self, utime: int) -> None:
        """No live setpoint in the air: stand still at once, and hand over to BRAKE soon after (fact 2)."""
        self._climb_d = None
        if self._telemetry.mode != Mode.GUIDED:
            return  # LAND, RTL or BRAKE, as we asked
        if self._silent_since_us is None:
            self._silent_since_us = utime
        self.hold(utime)
        if utime - self._silent_since_us >= BRAKE_AFTER_US:
            self._ask_mode(Mode.BRAKE, utime)

    def _obey(self, setpoint: setpoint_t, utime: int) -> None:
        """A live setpoint in the air."""
        if setpoint.kind == setpoint_t.LAND:
            self._ask_mode(Mode.LAND, utime)
        elif setpoint.kind == setpoint_t.RETURN:
            self._ask_mode(Mode.RTL, utime)
        elif self._telemetry.mode != Mode.GUIDED:
            self._ask_mode(Mode.GUIDED, utime)
        elif not self._holds_back(setpoint, utime):
            self._steer(setpoint, utime)
        if self._telemetry.mode != Mode.GUIDED:
            self._release()
        self._note_passed(setpoint, utime)

    def _ask_mode(self, mode: Mode, utime: int) -> None:
        if self._telemetry.mode == mode:
            self.commands.drop(mavlink.MAV_CMD_DO_SET_MODE)
            return
        self.authority.ask(mode, utime)
        custom = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        self.commands.ask(mavlink.MAV_CMD_DO_SET_MODE, custom, float(mode), utime=utime)

    def _holds_back(self, setpoint: setpoint_t, utime: int) -> bool:
        """Whether NAV_TAKEOFF still climbs: any setpoint would end it (fact 7). HOLD and IDLE may."""
        if self._climb_d is None:
            return False
        d = self._telemetry.place[2]
        if d < self._highest_d - CLIMB_PROGRESS_M:
            self._highest_d, self._highest_us = d, utime
        stalled = utime - self._highest_us > CLIMB_STALLED_US
        stops = setpoint.kind in (setpoint_t.HOLD, setpoint_t.IDLE)
        if d <= self._climb_d + CLIMB_REACHED_M or stalled or stops:
            self._climb_d = None
        return self._climb_d is not None

    def _steer(self, setpoint: setpoint_t, utime: int) -> None:
        """Write a live setpoint, clamped."""
        self.commands.drop(mavlink.MAV_CMD_DO_SET_MODE)
        telemetry = self._telemetry
        moves = setpoint.kind in (setpoint_t.GOTO, setpoint_t.VELOCITY, setpoint_t.TAKEOFF)
        if not moves or not telemetry.position_ok(utime):  # without a position no fence can be kept
            self.hold(utime)
            return
        self._hold_yaw_rad = None
        if setpoint.kind == setpoint_t.VELOCITY:
            self._follower = None
            wanted = (setpoint.vn_m_s, setpoint.ve_m_s, setpoint.vd_m_s)
            velocity = self._envelope.velocity(telemetry.place, wanted)
            self._count_clamped(velocity != wanted)
            self._write(VELOCITY_YAW, STILL, velocity, setpoint.yaw_rad, utime)
        else:
            self._go(setpoint, utime)

    def _go(self, setpoint: setpoint_t, utime: int) -> None:
        """Lead the vehicle to a place by a stream of position and velocity (fact 9)."""
        telemetry = self._telemetry
        goal = self._clamped_goal(setpoint)
        moving = (setpoint.vn_m_s, setpoint.ve_m_s, setpoint.vd_m_s)
        if self._follower is None:
            self._follower = Follower(self._envelope, telemetry.place, telemetry.velocity)
        if setpoint.kind == setpoint_t.TAKEOFF:  # in the air already: the rest of the climb, straight up
            n_m, e_m, _ = self._follower.place
            goal, moving = (n_m, e_m, goal[2]), STILL
        allowed = self._envelope.speed(moving)
        self._count_clamped(allowed != moving)
        dt_s = min((utime - self._written_us) / 1e6, LONGEST_STEP_S)
        self._follower.step(goal, allowed, telemetry.place, dt_s)
        place = telemetry.local(self._follower.place)
        self._write(POSITION_VELOCITY_YAW, place, self._follower.velocity, setpoint.yaw_rad, utime)

    def _clamped_goal(self, setpoint: setpoint_t) -> Vector:
        wanted = (setpoint.n_m, setpoint.e_m, setpoint.d_m)
        goal = self._envelope.position(wanted)
        self._count_clamped(goal != wanted)
        return goal

    def _write(self, mask: int, place: Vector, velocity: Vector, yaw_rad: float, utime: int) -> None:
        self._send(mask, place, velocity, yaw_rad, utime)
        self._written_us = utime

    def _note_passed(self, setpoint: setpoint_t, utime: int) -> None:
        """Remember a setpoint's age when it first took effect."""
        if self.passed_on[0] != setpoint.utime:
            self.passed_on = (setpoint.utime, utime - setpoint.utime)

    def _count_clamped(self, was_clamped: bool) -> None:
        """Count each setpoint once, however often it is written."""
        if was_clamped and self._setpoint is not None and self._clamped_utime != self._setpoint.utime:
            self._clamped_utime = self._setpoint.utime
            self.n_clamped += 1
