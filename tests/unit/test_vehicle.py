"""The simulated copter meets the times measured of a real one (docs/autopilot_facts.md, facts 9, 15)."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.sim.vehicle import Battery, Target, Vehicle, Wind

STEP_S = 0.02
UP = -20.0


def hovering(wind: Wind | None = None) -> Vehicle:
    vehicle = Vehicle((0.0, 0.0), np.random.default_rng(1), wind or Wind())
    vehicle.target = Target((0.0, 0.0, UP), yaw_rad=0.0)
    vehicle.step(40.0)
    return vehicle


def north_over(vehicle: Vehicle, seconds: float) -> np.ndarray:
    """(N, 2) north position and velocity at each step."""
    rows = []
    for _ in range(round(seconds / STEP_S)):
        vehicle.step(STEP_S)
        rows.append((vehicle.position_ned[0], vehicle.velocity_ned[0]))
    return np.array(rows)


@pytest.mark.parametrize("wind", [Wind(), Wind((4.0, 3.0), 1.0)], ids=["calm", "wind"])
def test_a_step_of_22_m_is_done_in_9_s_with_little_overshoot(wind):
    vehicle = hovering(wind)
    vehicle.target = Target((22.0, 0.0, UP), yaw_rad=0.0)
    north_m = north_over(vehicle, 20)[:, 0]
    assert np.abs(north_m[round(9 / STEP_S) :] - 22).max() < 0.5
    assert 0.05 < north_m.max() - 22 < 0.6


def test_3_m_s_are_reached_in_1_6_s():
    vehicle = hovering()
    vehicle.target = Target(None, (3.0, 0.0, 0.0), yaw_rad=0.0)
    speed = north_over(vehicle, 4)[:, 1]
    assert np.argmax(speed > 2.85) * STEP_S == pytest.approx(1.6, abs=0.2)
    assert speed.max() < 3.2


@pytest.mark.parametrize(("feed_forward_m_s", "lag_m", "tolerance_m"), [(0.0, 7.2, 0.4), (4.0, 0.1, 0.15)])
def test_a_stream_of_positions_lags_and_one_with_velocity_does_not(feed_forward_m_s, lag_m, tolerance_m):
    vehicle = hovering()
    goal_m = 0.0
    for tick in range(1000):
        goal_m = 4.0 * tick * STEP_S
        if tick % 5 == 0:
            vehicle.target = Target((goal_m, 0.0, UP), (feed_forward_m_s, 0.0, 0.0), yaw_rad=0.0)
        vehicle.step(STEP_S)
    assert goal_m - vehicle.position_ned[0] == pytest.approx(lag_m, abs=tolerance_m)


def test_it_leans_into_the_wind_and_stays():
    vehicle = hovering(Wind((0.0, 8.0)))
    assert vehicle.position_ned == pytest.approx((0, 0, UP), abs=0.05)
    assert vehicle.roll_rad == pytest.approx(-math.atan2(0.25 * 8, 9.80665), abs=0.01)
    assert vehicle.pitch_rad == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize(("yaw_deg", "pitches"), [(0, True), (90, False)])
def test_accelerating_north_lowers_the_nose_or_the_left_side(yaw_deg, pitches):
    vehicle = Vehicle((0.0, 0.0), np.random.default_rng(1), yaw_rad=math.radians(yaw_deg))
    vehicle.target = Target((0.0, 0.0, UP), yaw_rad=math.radians(yaw_deg))
    vehicle.step(40.0)
    vehicle.target = Target(None, (5.0, 0.0, 0.0), yaw_rad=math.radians(yaw_deg))
    vehicle.step(0.8)
    pose = vehicle.pose
    if pitches:
        assert pose.pitch_rad < math.radians(-8)
        assert pose.roll_rad == pytest.approx(0, abs=0.01)
    else:
        assert pose.roll_rad < math.radians(-8)
        assert pose.pitch_rad == pytest.approx(0, abs=0.01)


def test_motors_off_stands_on_the_ground_and_falls_in_the_air():
    vehicle = Vehicle((3.0, 4.0), np.random.default_rng(1), Wind((10.0, 0.0), 2.0))
    vehicle.step(5.0)
    assert vehicle.position_ned == (3.0, 4.0, 0.0)
    flying = hovering()
    flying.target = None
    flying.step(1.0)
    assert flying.position_ned[2] == pytest.approx(UP + 9.80665 / 2, abs=0.7)
    flying.step(3.0)
    assert flying.on_ground
    assert flying.velocity_ned == (0.0, 0.0, 0.0)


def test_an_empty_battery_brings_it_down():
    vehicle = Vehicle((0.0, 0.0), np.random.default_rng(1), battery=Battery(0.01, 1000.0))
    vehicle.target = Target((0.0, 0.0, -5.0), yaw_rad=0.0)
    vehicle.step(8.0)
    assert not vehicle.on_ground
    vehicle.step(6.0)
    assert vehicle.battery == 0
    assert vehicle.on_ground


def test_gusts_have_the_asked_spread():
    vehicle = Vehicle((0.0, 0.0), np.random.default_rng(1), Wind(gust_m_s=2.0, gust_time_s=1.0))
    gusts = []
    for _ in range(20_000):
        vehicle._blow(STEP_S)
        gusts.append((vehicle._gust_n, vehicle._gust_e))
    assert np.std(gusts) == pytest.approx(2.0, rel=0.1)


def test_time_does_not_run_backwards():
    with pytest.raises(ValueError, match=r"a step of -0\.1 s"):
        Vehicle((0.0, 0.0), np.random.default_rng(1)).step(-0.1)


@settings(max_examples=30, deadline=None)
@given(
    place=st.tuples(st.floats(-80, 80), st.floats(-80, 80), st.floats(-60, -3)),
    velocity=st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-2, 1)),
    wind=st.tuples(st.floats(-8, 8), st.floats(-8, 8)),
)
def test_it_keeps_its_limits_and_arrives(place, velocity, wind):
    vehicle = hovering(Wind(wind))
    vehicle.target = Target(None, velocity, yaw_rad=1.0)
    vehicle.step(2.0)
    vehicle.target = Target(place, yaw_rad=1.0)
    for _ in range(60):
        vehicle.step(0.5)
        assert math.hypot(*vehicle.velocity_ned[:2]) < 11.5
        assert -3.0 < vehicle.velocity_ned[2] < 2.0
        assert vehicle.pose.tilt_rad < math.radians(35)
    vehicle.step(20.0)
    assert vehicle.position_ned == pytest.approx(place, abs=0.2)
