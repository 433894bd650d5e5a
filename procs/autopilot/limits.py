"""The limits that no setpoint passes: speed, climb, descent, height, the fence round the fleet's origin."""

import math

from procs.settings import LimitSettings

__all__ = ["BRAKING_M_S2", "Envelope", "Follower", "Vector", "shorten"]

Vector = tuple[float, float, float]

BRAKING_M_S2 = 1.25  # that may be counted on to stop before a limit or over a goal
ACCELERATION_M_S2 = 2.5
VERTICAL_ACCELERATION_M_S2 = 1.0
APPROACH_1_S = 1.0  # near a goal or a limit the speed falls with the distance
LED_BACK_M_S = 0.5  # over the fence
LEASH_M = 5.0  # the followed point never runs farther ahead of the vehicle than this


class Envelope:
    """Clamps places and velocities, in the fleet's local NED frame, to the mission's limits."""

    def __init__(self, limits: LimitSettings) -> None:
        self.limits = limits

    def position(self, place: Vector) -> Vector:
        """The nearest place inside fence and heights."""
        limits = self.limits
        n, e = shorten(place[0], place[1], limits.fence_radius_m)
        return n, e, min(max(place[2], -limits.max_height_m), -limits.min_height_m)

    def speed(self, velocity: Vector) -> Vector:
        """The same direction over ground at no more than the allowed speed; climb and descent cut too."""
        limits = self.limits
        vn, ve = shorten(velocity[0], velocity[1], limits.speed_m_s)
        return vn, ve, min(max(velocity[2], -limits.climb_m_s), limits.descent_m_s)

    def velocity(self, place: Vector, velocity: Vector) -> Vector:
        """`speed`, without what would lead from `place` over a limit: it falls to nothing on the way there.

        Outside the limits what leads further out is taken away, so that a vehicle can always come back.
        Over the fence it is led back gently: a flight along the fence would drift out step by step.
        """
        limits = self.limits
        vn, ve, vd = self.speed(velocity)
        away_m = math.hypot(place[0], place[1])
        if away_m > 0:
            outward = (vn * place[0] + ve * place[1]) / away_m
            surplus = outward - _outward_allowed(limits.fence_radius_m - away_m)
            if surplus > 0:
                vn, ve = shorten(
                    vn - surplus * place[0] / away_m, ve - surplus * place[1] / away_m, limits.speed_m_s
                )
        height_m = -place[2]
        vd = max(vd, -approach_speed(limits.max_height_m - height_m))
        return vn, ve, min(vd, approach_speed(height_m - limits.min_height_m)) if vd > 0 else vd


class Follower:
    """A point that travels to a goal as a copter can, inside the envelope.

    A far goal alone would be flown at the autopilot's own speed, and a stream of positions lags 7 m at 4 m/s;
    with the velocity as feed-forward it lags 0.1 m (docs/autopilot_facts.md, fact 9).
    """

    def __init__(self, envelope: Envelope, place: Vector, velocity: Vector) -> None:
        self._envelope = envelope
        self.place = place
        self.velocity = velocity

    def step(self, goal: Vector, goal_velocity: Vector, vehicle: Vector, dt_s: float) -> None:
        """Travel on for `dt_s` towards `goal`, which itself moves at `goal_velocity`."""
        n, e, d = self.place
        to_n, to_e, to_d = goal[0] - n, goal[1] - e, goal[2] - d
        distance_m = math.hypot(to_n, to_e)
        share = approach_speed(distance_m) / distance_m if distance_m > 0 else 0.0
        down = math.copysign(approach_speed(abs(to_d)), to_d)
        vn, ve, vd = self._envelope.speed(
            (goal_velocity[0] + to_n * share, goal_velocity[1] + to_e * share, goal_velocity[2] + down)
        )
        most = ACCELERATION_M_S2 * dt_s
        change_n, change_e = shorten(vn - self.velocity[0], ve - self.velocity[1], most)
        most = VERTICAL_ACCELERATION_M_S2 * dt_s
        change_d = min(max(vd - self.velocity[2], -most), most)
        wanted = self.velocity[0] + change_n, self.velocity[1] + change_e, self.velocity[2] + change_d
        self.velocity = vn, ve, vd = self._envelope.velocity(self.place, wanted)
        n, e, d = n + vn * dt_s, e + ve * dt_s, d + vd * dt_s
        # Wind or a hand that holds the vehicle back: wait for it.
        ahead_n, ahead_e = shorten(n - vehicle[0], e - vehicle[1], LEASH_M)
        ahead_d = min(max(d - vehicle[2], -LEASH_M), LEASH_M)
        self.place = vehicle[0] + ahead_n, vehicle[1] + ahead_e, vehicle[2] + ahead_d


def _outward_allowed(inside_m: float) -> float:
    """Most speed away from the origin `inside_m` before the fence; negative beyond it, but slow."""
    return approach_speed(inside_m) if inside_m > 0 else max(APPROACH_1_S * inside_m, -LED_BACK_M_S)


def approach_speed(distance_m: float) -> float:
    """Speed at which a copter `distance_m` before a limit or goal still stops there; 0 at and beyond it."""
    if distance_m <= 0:
        return 0.0
    return min(APPROACH_1_S * distance_m, math.sqrt(2 * BRAKING_M_S2 * distance_m))


def shorten(x: float, y: float, most: float) -> tuple[float, float]:
    """(x, y) cut to the length `most` where it is longer."""
    length = math.hypot(x, y)
    if length <= most:
        return x, y
    return x * most / length, y * most / length
