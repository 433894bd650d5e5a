"""What the simulated autopilot believes of its place and heading: the truth plus its sensors' errors."""

import math

import numpy as np

from drivers.sim.vehicle import Vehicle

__all__ = ["Estimate"]

# The error of an estimated position wanders slowly and smoothly: a second-order Gauss-Markov process, whose
# correlation falls to 1/e after CORRELATION_S (its natural rate is 2.146 over that time).
CORRELATION_S = 60.0
RATE_1_S = 2.146 / CORRELATION_S
HEIGHT_NOISE_SHARE = 0.2  # a barometer wanders less than GPS: this share of its error
POSITION_NOISE_M = 0.02
VELOCITY_NOISE_M_S = 0.05
ANGLE_NOISE_RAD = math.radians(0.1)

Vector = tuple[float, float, float]


class Estimate:
    """Error state and the autopilot's own local frame, whose origin is where it booted (fact 10).

    gps_noise_m: standard deviation of the wandering error a horizontal axis. compass_error_deg: standard
    deviation of the constant heading error.
    """

    def __init__(
        self, vehicle: Vehicle, random: np.random.Generator, gps_noise_m: float, compass_error_deg: float
    ) -> None:
        self._vehicle = vehicle
        self._random = random
        self._spread_m = gps_noise_m * np.array([1.0, 1.0, HEIGHT_NOISE_SHARE])
        self._error_m = self._spread_m * random.standard_normal(3)
        self._error_m_s = self._spread_m * RATE_1_S * random.standard_normal(3)
        self.compass_error_rad = math.radians(compass_error_deg) * float(random.standard_normal())
        self.origin_ned: Vector = (0.0, 0.0, 0.0)
        self.set_origin()

    def set_origin(self) -> None:
        """The place that the vehicle now believes to be at becomes the origin of its local frame."""
        self.origin_ned = (0.0, 0.0, 0.0)
        self.origin_ned = self.position_ned

    def step(self, dt_s: float) -> None:
        """Let the errors wander on."""
        stir = self._spread_m * (2.0 * RATE_1_S**1.5 * math.sqrt(dt_s)) * self._random.standard_normal(3)
        pull = -2 * RATE_1_S * self._error_m_s - RATE_1_S**2 * self._error_m
        self._error_m_s += pull * dt_s + stir
        self._error_m += self._error_m_s * dt_s

    @property
    def position_ned(self) -> Vector:
        """Believed position in the autopilot's local frame, metres, without the noise of a single reading."""
        n, e, d = self._vehicle.position_ned
        error_n, error_e, error_d = self._error_m.tolist()
        origin_n, origin_e, origin_d = self.origin_ned
        return n + error_n - origin_n, e + error_e - origin_e, d + error_d - origin_d

    @property
    def yaw_rad(self) -> float:
        """Believed heading."""
        return math.remainder(self._vehicle.yaw_rad + self.compass_error_rad, math.tau)

    def true_position(self, local_ned: Vector) -> Vector:
        """Where the vehicle truly ends up that flies to `local_ned` by its own belief."""
        error_n, error_e, error_d = self._error_m.tolist()
        origin_n, origin_e, origin_d = self.origin_ned
        return (
            local_ned[0] + origin_n - error_n,
            local_ned[1] + origin_e - error_e,
            local_ned[2] + origin_d - error_d,
        )

    def true_yaw(self, yaw_rad: float) -> float:
        """The true heading that the compass reads as `yaw_rad`."""
        return yaw_rad - self.compass_error_rad

    def reading(self) -> tuple[list[float], list[float], list[float]]:
        """(position, velocity, roll-pitch-yaw) as one set of telemetry tells them."""
        vehicle = self._vehicle
        noise = self._random.standard_normal(9).tolist()
        position = [p + POSITION_NOISE_M * x for p, x in zip(self.position_ned, noise[:3], strict=True)]
        velocity = [v + VELOCITY_NOISE_M_S * x for v, x in zip(vehicle.velocity_ned, noise[3:6], strict=True)]
        angles = (vehicle.roll_rad, vehicle.pitch_rad, self.yaw_rad)
        return position, velocity, [a + ANGLE_NOISE_RAD * x for a, x in zip(angles, noise[6:], strict=True)]
