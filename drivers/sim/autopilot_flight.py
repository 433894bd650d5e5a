"""How the simulated autopilot flies: modes, arming, take-off, the life of setpoints, failsafes, fence.

Each rule imitates a measured fact of docs/autopilot_facts.md, named in the comments. No MAVLink here: see
drivers.sim.autopilot.
"""

import math
from dataclasses import dataclass, replace

from drivers.autopilots.ardupilot import Mode
from drivers.sim.autopilot_estimate import Estimate, Vector
from drivers.sim.vehicle import Target, Vehicle

__all__ = ["DEFAULT_PARAMETERS", "Flight", "Setpoint"]

SETPOINT_LIFE_S = 3.0  # fact 2: velocity and position+velocity; positions live for ever
IDLE_DISARM_S = 10.0  # fact 7
SPOOL_S = 2.0  # from NAV_TAKEOFF to lift-off; 19 m up then takes 12 s (fact 15)
TAKEOFF_REACHED_M = 0.3
LANDED_DISARM_S = 2.0
LAND_SLOW_BELOW_M = 10.0
LAND_SLOW_M_S = 0.5
RETURN_HEIGHT_M = 15.0
RETURN_NEAR_M = 1.0
RETURN_WAIT_S = 5.0
BRAKING_M_S2 = 1.25  # that the fence's avoidance counts on
ARMABLE = (Mode.STABILIZE, Mode.ALT_HOLD, Mode.GUIDED, Mode.LOITER)

DEFAULT_PARAMETERS = {
    "FS_GCS_ENABLE": 0.0,  # fact 3: off by default
    "FS_GCS_TIMEOUT": 5.0,
    "FENCE_ENABLE": 0.0,  # fact 11: off by default
    "FENCE_TYPE": 3.0,  # bit 0 height, bit 1 circle
    "FENCE_RADIUS": 300.0,
    "FENCE_ALT_MAX": 100.0,
    "FENCE_ACTION": 1.0,
    "FENCE_MARGIN": 2.0,
    "AVOID_ENABLE": 3.0,
    "MAV_OPTIONS": 0.0,
    "MAV_GCS_SYSID": 255.0,
    "WP_SPD": 10.0,
    "WP_SPD_UP": 2.5,
    "WP_SPD_DN": 1.5,
}
FENCE_HEIGHT = 1
FENCE_CIRCLE = 2


@dataclass(frozen=True)
class Setpoint:
    """A target in the autopilot's local frame; None where masked out, never the first two both."""

    position_ned: Vector | None
    velocity_ned: Vector | None
    yaw_rad: float | None
    t_s: float


class Flight:
    """Flies a vehicle by what the estimate believes."""

    def __init__(self, vehicle: Vehicle, estimate: Estimate, ready_at_s: float) -> None:
        self.parameters = dict(DEFAULT_PARAMETERS)
        self._vehicle = vehicle
        self._estimate = estimate
        self.boot(ready_at_s)

    def boot(self, ready_at_s: float) -> None:
        """All that a restart forgets; parameters stay."""
        self.mode: int = Mode.STABILIZE
        self.armed = False
        self.climbing = False
        self._ready_at_s = ready_at_s
        self._setpoint: Setpoint | None = None
        self._hold_yaw_rad = self._vehicle.yaw_rad
        self._home: Vector = (0.0, 0.0, 0.0)
        self._ground_since_s = 0.0
        self._lift_off_s = 0.0
        self._climb_to: Vector = (0.0, 0.0, 0.0)
        self._heard_ground_s: float | None = None
        self._over_home_since_s: float | None = None

    @property
    def landed(self) -> bool:
        return self._vehicle.on_ground

    def is_ready(self, t_s: float) -> bool:
        """Whether it has a position, and so may arm."""
        return t_s >= self._ready_at_s

    def heard_ground(self, t_s: float) -> None:
        """A HEARTBEAT of the ground station."""
        self._heard_ground_s = t_s

    def set_mode(self, mode: int) -> bool:
        """Enter a flight mode; False where it is none of ArduCopter's that we know."""
        if mode not in list(Mode):
            return False
        if mode != self.mode:
            self.mode = mode
            self.climbing = False
            self._setpoint = None
            self._hold_yaw_rad = self._vehicle.yaw_rad
            self._over_home_since_s = None
        return True

    def arm(self, t_s: float) -> bool:
        """Start the motors: refused before there is a position and in modes that cannot arm."""
        if self.armed:
            return True
        if not self.is_ready(t_s) or self.mode not in ARMABLE:
            return False
        self.armed = True
        self._ground_since_s = t_s
        self._home = self._estimate.position_ned
        return True

    def disarm(self, force: bool = False) -> bool:
        """Stop the motors: refused in the air; forcing it drops the vehicle (fact 8)."""
        if self.armed and not self.landed and not force:
            return False
        self.armed = self.climbing = False
        self._setpoint = None
        return True

    def take_off(self, height_m: float, t_s: float) -> bool:
        """Climb to `height_m` above home; only in GUIDED, armed and on the ground (fact 7)."""
        if self.mode != Mode.GUIDED or not self.armed or not self.landed or height_m <= 0:
            return False
        n, e, _ = self._estimate.position_ned
        self._climb_to = (n, e, self._home[2] - height_m)
        self._lift_off_s = t_s + SPOOL_S
        self._hold_yaw_rad = self._vehicle.yaw_rad
        self._setpoint = None
        self.climbing = True
        return True

    def accept(self, setpoint: Setpoint) -> None:
        """Take a setpoint or ignore it in silence (fact 5); during the climb it ends the climb (fact 7)."""
        if self.mode != Mode.GUIDED or not self.armed:
            return
        if setpoint.position_ned is not None and not self._is_inside(setpoint.position_ned):
            return
        self.climbing = False
        if not self.landed:
            self._setpoint = setpoint

    def step(self, t_s: float) -> None:
        """Decide what the vehicle flies from now on."""
        if not self.landed or self.climbing:
            self._ground_since_s = t_s
        self._fail_safe(t_s)
        if self.armed and self._should_disarm(t_s):
            self.disarm()
        self._vehicle.target = self._target(t_s) if self.armed else None

    def _should_disarm(self, t_s: float) -> bool:
        waited_s = t_s - self._ground_since_s
        return waited_s >= (LANDED_DISARM_S if self.mode in (Mode.LAND, Mode.RTL) else IDLE_DISARM_S)

    def _fail_safe(self, t_s: float) -> None:
        """Return home when the ground station falls silent (fact 3) or the fence is broken (fact 11)."""
        if not self.armed or self.landed or self.mode in (Mode.LAND, Mode.RTL):
            return
        heard_s = self._heard_ground_s
        silent_s = 0.0 if heard_s is None else t_s - heard_s
        if self.parameters["FS_GCS_ENABLE"] and silent_s > self.parameters["FS_GCS_TIMEOUT"]:
            self.set_mode(Mode.RTL)
        if self.parameters["FENCE_ACTION"] and not self._is_inside(self._estimate.position_ned):
            self.set_mode(Mode.RTL)

    def _target(self, t_s: float) -> Target:
        hold = Target(
            None,
            yaw_rad=self._hold_yaw_rad,
            speed_m_s=self.parameters["WP_SPD"],
            climb_m_s=self.parameters["WP_SPD_UP"],
            descent_m_s=self.parameters["WP_SPD_DN"],
        )
        if self.climbing:
            return self._climb(hold, t_s)
        if self.mode == Mode.GUIDED and self._setpoint is not None:
            return self._guided(hold, self._setpoint, t_s)
        if self.mode == Mode.LAND:
            return self._descend(hold)
        if self.mode == Mode.RTL:
            return self._return(hold, t_s)
        return hold

    def _climb(self, hold: Target, t_s: float) -> Target:
        if t_s < self._lift_off_s:
            return hold
        if abs(self._estimate.position_ned[2] - self._climb_to[2]) < TAKEOFF_REACHED_M:
            self.climbing = False
            self._setpoint = Setpoint(self._climb_to, None, None, t_s)
            return hold
        return replace(hold, position_ned=self._estimate.true_position(self._climb_to))

    def _guided(self, hold: Target, setpoint: Setpoint, t_s: float) -> Target:
        position, velocity = setpoint.position_ned, setpoint.velocity_ned
        if velocity is not None and t_s - setpoint.t_s > SETPOINT_LIFE_S:
            self._setpoint = None
            self._hold_yaw_rad = self._vehicle.yaw_rad
            return hold
        if position is None:
            velocity = self._avoid(velocity or (0.0, 0.0, 0.0))
        return replace(
            hold,
            position_ned=None if position is None else self._estimate.true_position(position),
            velocity_ned=velocity or (0.0, 0.0, 0.0),
            # Fact 6: without a yaw the nose turns along the path.
            yaw_rad=None if setpoint.yaw_rad is None else self._estimate.true_yaw(setpoint.yaw_rad),
        )

    def _descend(self, hold: Target) -> Target:
        height_m = self._home[2] - self._estimate.position_ned[2]
        speed_m_s = LAND_SLOW_M_S if height_m < LAND_SLOW_BELOW_M else hold.descent_m_s
        return replace(hold, velocity_ned=(0.0, 0.0, speed_m_s))

    def _return(self, hold: Target, t_s: float) -> Target:
        """Climb, fly home, wait a little, land."""
        n, e, d = self._estimate.position_ned
        home_n, home_e, home_d = self._home
        away_m = math.hypot(n - home_n, e - home_e)
        if self._over_home_since_s is None and away_m < RETURN_NEAR_M:
            self._over_home_since_s = t_s
        if self._over_home_since_s is not None and t_s - self._over_home_since_s > RETURN_WAIT_S:
            return self._descend(hold)
        height_d = min(d, home_d - RETURN_HEIGHT_M)
        is_low = d > home_d - RETURN_HEIGHT_M + 1.0
        goal = (n, e, height_d) if is_low and away_m > RETURN_NEAR_M else (home_n, home_e, height_d)
        return replace(hold, position_ned=self._estimate.true_position(goal))

    def _is_inside(self, local_ned: Vector) -> bool:
        """Whether a place lies inside the fence; always where the fence is off."""
        if not self.parameters["FENCE_ENABLE"]:
            return True
        kinds = int(self.parameters["FENCE_TYPE"])
        if kinds & FENCE_HEIGHT and self._home[2] - local_ned[2] > self.parameters["FENCE_ALT_MAX"]:
            return False
        away_m = math.hypot(local_ned[0] - self._home[0], local_ned[1] - self._home[1])
        return not kinds & FENCE_CIRCLE or away_m <= self.parameters["FENCE_RADIUS"]

    def _avoid(self, velocity_ned: Vector) -> Vector:
        """Take the outward part from a velocity: it slides to a stop at the fence's margin (fact 11)."""
        kinds = int(self.parameters["FENCE_TYPE"])
        if not self.parameters["FENCE_ENABLE"] or not int(self.parameters["AVOID_ENABLE"]) & 1:
            return velocity_ned
        vn, ve, vd = velocity_ned
        n, e, d = self._estimate.position_ned
        margin_m = self.parameters["FENCE_MARGIN"]
        if kinds & FENCE_CIRCLE:
            out_n, out_e = n - self._home[0], e - self._home[1]
            away_m = math.hypot(out_n, out_e)
            outward = (vn * out_n + ve * out_e) / away_m if away_m > 0 else 0.0
            allowed = _stopping_speed(self.parameters["FENCE_RADIUS"] - margin_m - away_m)
            if outward > allowed:
                vn -= (outward - allowed) * out_n / away_m
                ve -= (outward - allowed) * out_e / away_m
        if kinds & FENCE_HEIGHT:
            vd = max(vd, -_stopping_speed(self.parameters["FENCE_ALT_MAX"] - margin_m - (self._home[2] - d)))
        return vn, ve, vd


def _stopping_speed(distance_m: float) -> float:
    """The speed from which braking stops within the distance, with some of it kept back for the reaction."""
    return math.sqrt(2 * BRAKING_M_S2 * distance_m) / 2 if distance_m > 0 else 0.0
