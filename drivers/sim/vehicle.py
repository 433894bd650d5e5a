"""A quadrotor as a point mass that tilts to accelerate, flown by controllers shaped like ArduCopter's.

A target is first shaped into a path that a copter can follow (limited speed, acceleration and jerk); a
position and velocity controller then asks for an acceleration, the attitude follows it with a lag, and wind
and drag push. The constants are chosen so that the vehicle meets the times of docs/autopilot_facts.md, fact
15; tests/unit/test_vehicle.py holds them. Plain floats: at 50 Hz a copter costs a thousandth of a core, with
arrays ten times as much.
"""

import math
from dataclasses import dataclass

import numpy as np

from drivers.cameras.pinhole import Pose

__all__ = ["Battery", "Target", "Vehicle", "Wind"]

GRAVITY_M_S2 = 9.80665
LONGEST_STEP_S = 0.02

# Shaping, with ArduCopter's defaults (WP_ACC, PSC_JERK_NE); it plans to stop with half the acceleration that
# it may use.
ACCELERATION_M_S2 = 2.5
STOPPING_M_S2 = 1.25
JERK_M_S3 = 5.0
POSITION_GAIN_1_S = 1.0
SHAPING_GAIN_1_S = 2.5
VERTICAL_ACCELERATION_M_S2 = 1.0
VERTICAL_STOPPING_M_S2 = 0.5
# Control: PSC_NE_POS_P, PSC_NE_VEL_P, PSC_NE_VEL_I.
VELOCITY_GAIN_1_S = 2.0
INTEGRAL_GAIN_1_S2 = 1.0
INTEGRAL_LIMIT_M_S2 = 4.0
# Airframe.
TILT_LIMIT_M_S2 = GRAVITY_M_S2 * math.tan(math.radians(30.0))
TILT_LAG_S = 0.15
LIFT_LAG_S = 0.15
LIFT_LIMIT_M_S2 = 4.0
DRAG_1_S = 0.25  # 10 m/s of airspeed costs a tilt of 14 degrees
YAW_RATE_RAD_S = math.radians(60.0)  # ATC_SLEW_YAW
YAW_GAIN_1_S = 3.0
NOSE_ALONG_PATH_M_S = 0.3  # above it a nose without a commanded yaw turns along the path


@dataclass(frozen=True)
class Target:
    """What to fly, in true local NED metres; with `position_ned` None the velocity alone.

    `yaw_rad` None turns the nose along the path, as ArduCopter does where no yaw is sent.
    """

    position_ned: tuple[float, float, float] | None
    velocity_ned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_rad: float | None = None
    speed_m_s: float = 10.0
    climb_m_s: float = 2.5
    descent_m_s: float = 1.5


@dataclass(frozen=True)
class Wind:
    """Mean wind (n, e) in m/s; standard deviation and correlation time of its gusts."""

    mean_ne_m_s: tuple[float, float] = (0.0, 0.0)
    gust_m_s: float = 0.0
    gust_time_s: float = 3.0


@dataclass(frozen=True)
class Battery:
    """How full it is at the start (0-1) and how long a full one lasts in flight."""

    start: float = 1.0
    endurance_s: float = 1500.0


class Vehicle:
    """One simulated copter over ground at d = 0. With `target` None the motors are off.

    home: (n, e) metres where it stands at first. random: for the gusts.
    """

    def __init__(
        self,
        home: tuple[float, float],
        random: np.random.Generator,
        wind: Wind = Wind(),
        battery: Battery = Battery(),
        yaw_rad: float = 0.0,
    ) -> None:
        self.target: Target | None = None
        self.battery = battery.start
        self.roll_rad = self.pitch_rad = 0.0
        self.yaw_rad = yaw_rad
        self._random = random
        self._wind = wind
        self._endurance_s = battery.endurance_s
        self._n, self._e, self._d = float(home[0]), float(home[1]), 0.0
        self._vn = self._ve = self._vd = 0.0
        self._gust_n = self._gust_e = 0.0
        self._tilt_n = self._tilt_e = self._lift = (
            0.0  # accelerations that attitude and thrust give, lift downwards
        )
        self._forget_path()

    @property
    def position_ned(self) -> tuple[float, float, float]:
        """True position, metres."""
        return self._n, self._e, self._d

    @property
    def velocity_ned(self) -> tuple[float, float, float]:
        """True velocity, m/s."""
        return self._vn, self._ve, self._vd

    @property
    def pose(self) -> Pose:
        """True position and attitude."""
        return Pose(self._n, self._e, self._d, self.roll_rad, self.pitch_rad, self.yaw_rad)

    @property
    def on_ground(self) -> bool:
        """Whether it stands on the ground."""
        return self._d >= 0.0

    def step(self, dt_s: float) -> None:
        """Fly on by `dt_s` seconds, in steps of at most 20 ms; ValueError for a negative time."""
        if dt_s < 0:
            raise ValueError(f"a step of {dt_s} s: time does not run backwards")
        n_steps = math.ceil(dt_s / LONGEST_STEP_S - 1e-9)
        for _ in range(n_steps):
            self._step(dt_s / n_steps)

    def _step(self, dt: float) -> None:
        self._blow(dt)
        target = self.target if self.battery > 0 else None
        if target is None:
            self._stop_motors()
        else:
            self.battery = max(0.0, self.battery - dt / self._endurance_s)
            self._shape_horizontal(target, dt)
            self._shape_vertical(target, dt)
            self._control(dt)
            self._turn(target, dt)
        self._move(dt)

    def _blow(self, dt: float) -> None:
        wind = self._wind
        if wind.gust_m_s > 0:
            stir = wind.gust_m_s * math.sqrt(2 * dt / wind.gust_time_s)
            north, east = self._random.standard_normal(2)
            self._gust_n += -self._gust_n * dt / wind.gust_time_s + stir * float(north)
            self._gust_e += -self._gust_e * dt / wind.gust_time_s + stir * float(east)

    def _stop_motors(self) -> None:
        """On the ground it stands; in the air it falls."""
        self._tilt_n = self._tilt_e = 0.0
        self._lift = GRAVITY_M_S2
        self._forget_path()

    def _forget_path(self) -> None:
        """Let the shaped path begin where the vehicle is."""
        self._path_n, self._path_e, self._path_d = self._n, self._e, self._d
        self._path_vn, self._path_ve, self._path_vd = self._vn, self._ve, self._vd
        self._path_an = self._path_ae = 0.0
        self._integral_n = self._integral_e = 0.0

    def _shape_horizontal(self, target: Target, dt: float) -> None:
        """Move the path towards the target within speed, acceleration and jerk."""
        vn, ve, _ = target.velocity_ned
        if target.position_ned is not None:
            to_n, to_e = target.position_ned[0] - self._path_n, target.position_ned[1] - self._path_e
            distance = math.hypot(to_n, to_e)
            if distance > 0:
                share = _approach_speed(distance, STOPPING_M_S2) / distance
                vn, ve = vn + to_n * share, ve + to_e * share
        vn, ve = _limit(vn, ve, target.speed_m_s)
        want_n, want_e = _limit(
            SHAPING_GAIN_1_S * (vn - self._path_vn),
            SHAPING_GAIN_1_S * (ve - self._path_ve),
            ACCELERATION_M_S2,
        )
        change_n, change_e = _limit(want_n - self._path_an, want_e - self._path_ae, JERK_M_S3 * dt)
        self._path_an += change_n
        self._path_ae += change_e
        self._path_vn += self._path_an * dt
        self._path_ve += self._path_ae * dt
        self._path_n += self._path_vn * dt
        self._path_e += self._path_ve * dt

    def _shape_vertical(self, target: Target, dt: float) -> None:
        vd = target.velocity_ned[2]
        if target.position_ned is not None:
            down = target.position_ned[2] - self._path_d
            vd += math.copysign(_approach_speed(abs(down), VERTICAL_STOPPING_M_S2), down)
        vd = min(max(vd, -target.climb_m_s), target.descent_m_s)
        most = VERTICAL_ACCELERATION_M_S2 * dt
        self._path_vd += min(max(vd - self._path_vd, -most), most)
        self._path_d += self._path_vd * dt
        if self.on_ground and self._path_vd >= 0:  # standing: nothing of the path builds up
            self._forget_path()

    def _control(self, dt: float) -> None:
        """Tilt and lift that bring the vehicle onto its path."""
        error_n = self._path_vn + POSITION_GAIN_1_S * (self._path_n - self._n) - self._vn
        error_e = self._path_ve + POSITION_GAIN_1_S * (self._path_e - self._e) - self._ve
        error_d = self._path_vd + POSITION_GAIN_1_S * (self._path_d - self._d) - self._vd
        self._integral_n, self._integral_e = _limit(
            self._integral_n + INTEGRAL_GAIN_1_S2 * error_n * dt,
            self._integral_e + INTEGRAL_GAIN_1_S2 * error_e * dt,
            INTEGRAL_LIMIT_M_S2,
        )
        want_n, want_e = _limit(
            self._path_an + VELOCITY_GAIN_1_S * error_n + self._integral_n,
            self._path_ae + VELOCITY_GAIN_1_S * error_e + self._integral_e,
            TILT_LIMIT_M_S2,
        )
        self._tilt_n += (want_n - self._tilt_n) * dt / TILT_LAG_S
        self._tilt_e += (want_e - self._tilt_e) * dt / TILT_LAG_S
        want_d = min(max(2 * VELOCITY_GAIN_1_S * error_d, -LIFT_LIMIT_M_S2), LIFT_LIMIT_M_S2)
        self._lift += (want_d - self._lift) * dt / LIFT_LAG_S

    def _turn(self, target: Target, dt: float) -> None:
        yaw_rad = target.yaw_rad
        if yaw_rad is None:
            moving = math.hypot(self._path_vn, self._path_ve) > NOSE_ALONG_PATH_M_S
            yaw_rad = math.atan2(self._path_ve, self._path_vn) if moving else self.yaw_rad
        if self.on_ground:
            return
        turn = YAW_GAIN_1_S * math.remainder(yaw_rad - self.yaw_rad, math.tau)
        turn = min(max(turn, -YAW_RATE_RAD_S), YAW_RATE_RAD_S)
        self.yaw_rad = math.remainder(self.yaw_rad + turn * dt, math.tau)

    def _move(self, dt: float) -> None:
        """Newton, drag, the ground, and the attitude that belongs to the accelerations."""
        wind_n, wind_e = self._wind.mean_ne_m_s
        self._vd += self._lift * dt
        if self._d + self._vd * dt >= 0:
            self._d = self._vn = self._ve = self._vd = 0.0
            self._tilt_n = self._tilt_e = self.roll_rad = self.pitch_rad = 0.0
            return
        self._vn += (self._tilt_n + DRAG_1_S * (wind_n + self._gust_n - self._vn)) * dt
        self._ve += (self._tilt_e + DRAG_1_S * (wind_e + self._gust_e - self._ve)) * dt
        self._n += self._vn * dt
        self._e += self._ve * dt
        self._d += self._vd * dt
        cos_yaw, sin_yaw = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        forward = self._tilt_n * cos_yaw + self._tilt_e * sin_yaw
        right = -self._tilt_n * sin_yaw + self._tilt_e * cos_yaw
        upward = max(GRAVITY_M_S2 - self._lift, 1.0)
        self.pitch_rad = -math.atan2(forward, upward)
        self.roll_rad = math.atan2(right, math.hypot(upward, forward))


def _approach_speed(distance_m: float, stopping_m_s2: float) -> float:
    """Speed towards a target: in proportion when near, farther away such that constant braking stops."""
    near_m = stopping_m_s2 / POSITION_GAIN_1_S**2
    if distance_m <= near_m:
        return POSITION_GAIN_1_S * distance_m
    return math.sqrt(2 * stopping_m_s2 * (distance_m - near_m / 2))


def _limit(x: float, y: float, most: float) -> tuple[float, float]:
    """(x, y) shortened to length `most` where it is longer."""
    length = math.hypot(x, y)
    if length <= most:
        return x, y
    return x * most / length, y * most / length
