"""The simulated autopilot does what was measured of a real one; numbers are those of
docs/autopilot_facts.md."""

import math

import numpy as np
import pytest

from drivers.autopilots.ardupilot import Codec, Mode, mavlink
from drivers.sim.autopilot import SimAutopilot
from drivers.sim.vehicle import Vehicle

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
FAILED = mavlink.MAV_RESULT_FAILED
ORIGIN = (15.30, -61.50, 0.0)
POSITION, VELOCITY, POSITION_VELOCITY = 0xDF8, 0xDC7, 0xDC0
POSITION_YAW, VELOCITY_YAW_RATE = 0x9F8, 0x5C7


class Station:
    """A ground station that drives one twin by hand."""

    def __init__(self, system_id: int = 255) -> None:
        self.vehicle = Vehicle((0.0, 0.0), np.random.default_rng(3))
        self.twin = SimAutopilot(
            self.vehicle, 1, np.random.default_rng(4), origin=ORIGIN, gps_noise_m=0.0, compass_error_deg=0.0
        )
        self.codec = Codec(system_id, 190)
        self.heard: list = []
        self.t_s = 0.0
        self.beats = True
        self._beat_s = 0.0

    @property
    def mode(self) -> int:
        return self.twin.flight.mode

    def run(self, seconds: float, every_tick=None) -> None:
        for _ in range(round(seconds * 50)):
            self.t_s = round(self.t_s + 0.02, 6)
            if self.beats and self.t_s >= self._beat_s:
                self._beat_s = self.t_s + 1.0
                self.codec.send.heartbeat_send(6, 8, 0, 0, 4)
            if every_tick is not None:
                every_tick()
            self.twin.receive(self.codec.take(), self.t_s)
            self.heard += self.codec.parse(self.twin.step(self.t_s))

    def run_until(self, condition, limit_s: float) -> float:
        began_s = self.t_s
        while not condition():
            assert self.t_s - began_s < limit_s, f"not within {limit_s} s"
            self.run(0.02)
        return self.t_s - began_s

    def command(self, command: int, *parameters: float) -> int | None:
        """The result of a command, None where no answer came."""
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        self.codec.send.command_long_send(1, 1, command, 0, *filled)
        self.heard.clear()
        self.run(0.02)
        acks = self.of("COMMAND_ACK")
        return acks[-1].result if acks else None

    def set_mode(self, mode: Mode) -> int | None:
        return self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, mode)

    def arm(self) -> int | None:
        return self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def parameter(self, name: str, value: float) -> None:
        self.codec.send.param_set_send(1, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32)
        self.run(0.02)

    def target(
        self, mask: int, place=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), yaw_rad: float = 0.0
    ) -> None:
        self.codec.send.set_position_target_local_ned_send(
            0, 1, 1, 1, mask, *place, *velocity, 0, 0, 0, yaw_rad, 0
        )

    def of(self, kind: str) -> list:
        return [m for m in self.heard if m.get_type() == kind]

    def fly_up(self, height_m: float = 20.0) -> None:
        self.run(4)
        assert self.set_mode(Mode.GUIDED) == ACCEPTED
        assert self.arm() == ACCEPTED
        assert self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m) == ACCEPTED
        self.run_until(lambda: not self.twin.flight.climbing, 40)


@pytest.fixture
def station() -> Station:
    return Station()


@pytest.fixture
def flying(station: Station) -> Station:
    station.fly_up()
    return station


def test_1_a_fresh_link_carries_only_heartbeats_until_streams_are_asked_for(station):
    station.run(5)
    assert {m.get_type() for m in station.heard} == {"HEARTBEAT"}
    assert len(station.heard) in (5, 6)
    assert station.command(511, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50_000) == ACCEPTED
    station.heard.clear()
    station.run(2)
    assert len(station.of("LOCAL_POSITION_NED")) == pytest.approx(40, abs=1)
    station.twin.restart(station.t_s)
    station.heard.clear()
    station.run(5)
    assert station.of("LOCAL_POSITION_NED") == []


def test_2_a_velocity_expires_after_3_s(flying):
    flying.run(4, lambda: flying.target(VELOCITY, velocity=(3.0, 0.0, 0.0)))
    last_n_m = flying.vehicle.position_ned[0]
    flying.run(3)
    assert flying.vehicle.position_ned[0] - last_n_m == pytest.approx(9, abs=0.5)
    flying.run(4)
    assert flying.vehicle.velocity_ned[0] == pytest.approx(0, abs=0.1)


def test_2_a_position_with_velocity_expires_after_3_s(flying):
    flying.target(POSITION_VELOCITY, (200.0, 0.0, -20.0), (3.0, 0.0, 0.0))
    flying.run(30)
    assert 5 < flying.vehicle.position_ned[0] < 60


def test_2_a_position_never_expires(flying):
    flying.target(POSITION, (120.0, 0.0, -20.0))
    flying.run(30)
    assert flying.vehicle.position_ned == pytest.approx((120, 0, -20), abs=0.3)


def test_3_the_ground_station_failsafe_returns_5_s_after_the_last_heartbeat_and_stays(flying):
    flying.parameter("FS_GCS_ENABLE", 1)
    flying.run(1.5)
    flying.beats = False
    last_s = flying._beat_s - 1.0
    flying.run_until(lambda: flying.mode == Mode.RTL, 7)
    assert flying.t_s - last_s == pytest.approx(5.0, abs=0.1)
    flying.beats = True
    flying.run(3, lambda: flying.target(VELOCITY, velocity=(3.0, 0.0, 0.0)))
    assert flying.mode == Mode.RTL


def test_3_the_failsafe_is_off_by_default(flying):
    flying.beats = False
    flying.run(20)
    assert flying.mode == Mode.GUIDED


def test_4_any_system_may_command_unless_mav_options_forbids_it():
    stranger = Station(system_id=42)
    stranger.run(4)
    assert stranger.set_mode(Mode.GUIDED) == ACCEPTED
    stranger.parameter("MAV_OPTIONS", 1)
    assert stranger.set_mode(Mode.LAND) is None
    assert stranger.mode == Mode.GUIDED


def test_5_setpoints_are_ignored_in_silence(flying):
    flying.set_mode(Mode.LOITER)
    flying.heard.clear()
    flying.run(5, lambda: flying.target(POSITION, (50.0, 0.0, -20.0)))
    assert {m.get_type() for m in flying.heard} == {"HEARTBEAT"}
    assert flying.vehicle.position_ned[0] == pytest.approx(0, abs=0.1)


def test_5_a_position_outside_the_fence_is_ignored(flying):
    flying.parameter("FENCE_RADIUS", 30)
    flying.parameter("FENCE_ENABLE", 1)
    flying.run(5, lambda: flying.target(POSITION, (40.0, 0.0, -20.0)))
    assert flying.vehicle.position_ned[0] == pytest.approx(0, abs=0.1)


@pytest.mark.parametrize(("mask", "turned_deg"), [(POSITION, 90), (POSITION_YAW, 0), (VELOCITY_YAW_RATE, 90)])
def test_6_without_a_yaw_the_nose_turns_along_the_path(flying, mask, turned_deg):
    flying.run(4, lambda: flying.target(mask, (0.0, 5.0, -20.0), (0.0, 1.0, 0.0)))
    assert math.degrees(flying.vehicle.yaw_rad) == pytest.approx(turned_deg, abs=5)


def test_7_take_off_needs_guided_and_armed(station):
    station.run(4)
    take_off = (mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 19.0)
    assert station.command(*take_off) == FAILED
    station.set_mode(Mode.GUIDED)
    assert station.command(*take_off) == FAILED
    assert station.arm() == ACCEPTED
    assert station.command(*take_off) == ACCEPTED


def test_7_an_armed_vehicle_that_does_not_take_off_disarms_after_10_s(station):
    station.run(4)
    station.set_mode(Mode.GUIDED)
    station.arm()
    assert station.run_until(lambda: not station.twin.flight.armed, 12) == pytest.approx(10, abs=0.1)


def test_7_a_setpoint_during_the_climb_ends_it(station):
    station.run(4)
    station.set_mode(Mode.GUIDED)
    station.arm()
    station.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 19.0)
    station.run_until(lambda: station.vehicle.position_ned[2] < -8, 20)
    station.target(VELOCITY)
    station.run(8)
    assert station.vehicle.position_ned[2] > -13


def test_8_disarming_in_the_air_is_refused_and_forcing_it_drops_the_vehicle(flying):
    disarm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    assert flying.command(disarm, 0) == FAILED
    assert flying.twin.flight.armed
    assert flying.command(disarm, 0, 21196) == ACCEPTED
    flying.run(3)
    assert flying.vehicle.on_ground


def test_10_local_positions_count_from_where_it_booted():
    vehicle = Vehicle((100.0, -50.0), np.random.default_rng(1))
    twin = SimAutopilot(vehicle, 7, np.random.default_rng(2), origin=ORIGIN)
    codec = Codec(255, 190)
    for message_id in (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN):
        codec.send.command_long_send(7, 1, 511, 0, message_id, 1e6, 0, 0, 0, 0, 0)
    twin.receive(codec.take(), 0.0)
    heard = [m for k in range(1, 300) for m in codec.parse(twin.step(k * 0.02))]
    position = next(m for m in heard if m.get_type() == "LOCAL_POSITION_NED")
    assert (position.x, position.y, position.z) == pytest.approx((0, 0, 0), abs=0.3)
    origin = next(m for m in heard if m.get_type() == "GPS_GLOBAL_ORIGIN")
    assert (origin.latitude * 1e-7 - 15.30) * 110_650 == pytest.approx(100, abs=8)
    assert (origin.longitude * 1e-7 + 61.50) * 107_400 == pytest.approx(-50, abs=8)


@pytest.mark.parametrize(("avoid", "mode", "farthest_m"), [(3, Mode.GUIDED, 28.2), (0, Mode.RTL, 34.0)])
def test_11_with_avoidance_it_stops_2_m_inside_the_fence_and_without_it_breaches_and_returns(
    flying, avoid, mode, farthest_m
):
    flying.parameter("FENCE_RADIUS", 30)
    flying.parameter("FENCE_ENABLE", 1)
    flying.parameter("AVOID_ENABLE", avoid)
    reached = []

    def stream():
        flying.target(VELOCITY, velocity=(3.0, 0.0, 0.0))
        reached.append(flying.vehicle.position_ned[0])

    flying.run(25, stream)
    assert flying.mode == mode
    assert 27 < max(reached) < farthest_m
    assert (max(reached) > 30) == (mode == Mode.RTL)


def test_14_an_unknown_parameter_gets_no_answer(station):
    station.codec.send.param_request_read_send(1, 1, b"SYSID_MYGCS", -1)
    station.codec.send.param_set_send(1, 1, b"WPNAV_SPEED", 500.0, 9)
    station.codec.send.param_request_read_send(1, 1, b"MAV_SYSID", -1)
    station.run(2)
    assert [(m.param_id, m.param_value) for m in station.of("PARAM_VALUE")] == [("MAV_SYSID", 1.0)]


def test_15_arming_waits_for_a_position_and_says_why(station):
    station.run(1)
    station.set_mode(Mode.GUIDED)
    assert station.arm() == FAILED
    assert "PreArm" in station.of("STATUSTEXT")[0].text
    station.run(3)
    assert station.arm() == ACCEPTED


def test_15_times_of_take_off_and_landing(station):
    station.run(4)
    station.set_mode(Mode.GUIDED)
    station.arm()
    station.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 19.0)
    assert station.run_until(lambda: station.vehicle.position_ned[2] < -18.5, 30) == pytest.approx(12, abs=1)
    station.target(POSITION, (0.0, 0.0, -15.0))
    station.run(10)
    station.set_mode(Mode.LAND)
    assert station.run_until(lambda: not station.twin.flight.armed, 40) == pytest.approx(27, abs=2)


def test_returning_flies_home_at_15_m_at_least_and_lands_there(flying):
    flying.target(POSITION, (40.0, 30.0, -8.0))
    flying.run(25)
    flying.set_mode(Mode.RTL)
    lowest_away = []

    def watch():
        n, e, d = flying.vehicle.position_ned
        if 5 < math.hypot(n, e) < 45:
            lowest_away.append(-d)

    flying.run(90, watch)
    assert min(lowest_away) > 13
    assert not flying.twin.flight.armed
    assert flying.vehicle.position_ned == pytest.approx((0, 0, 0), abs=0.5)


def test_the_estimate_errs_slowly_and_as_much_as_asked():
    """Over many flights the error has the asked spread, and it moves centimetres a second, not metres."""
    errors, steps = [], []
    for seed in range(60):
        vehicle = Vehicle((0.0, 0.0), np.random.default_rng(0))
        twin = SimAutopilot(vehicle, 1, np.random.default_rng(seed), origin=(0.0, 0.0, 0.0), gps_noise_m=1.5)
        estimate = twin._estimate
        estimate.origin_ned = (0.0, 0.0, 0.0)
        first = np.array(estimate.position_ned[:2])
        for _ in range(50):
            estimate.step(0.02)
        errors.append(first)
        steps.append(np.array(estimate.position_ned[:2]) - first)
    assert np.std(errors) == pytest.approx(1.5, rel=0.25)
    assert np.abs(steps).max() < 0.3


def test_the_same_seed_says_the_same_bytes():
    def said() -> bytes:
        vehicle = Vehicle((1.0, 2.0), np.random.default_rng(5))
        twin = SimAutopilot(vehicle, 1, np.random.default_rng(6), origin=ORIGIN)
        codec = Codec(255, 190)
        codec.send.command_long_send(
            1, 1, 511, 0, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50_000, 0, 0, 0, 0, 0
        )
        twin.receive(codec.take(), 0.0)
        return b"".join(twin.step(k * 0.02) for k in range(1, 400))

    assert said() == said()


def test_time_does_not_run_backwards(station):
    station.run(1)
    with pytest.raises(ValueError, match=r"step to 0.5 s after 1.0 s"):
        station.twin.step(0.5)
