"""The bridge and the simulated autopilot, joined by MAVLink bytes in virtual time."""

import math

import numpy as np
import pytest

from drivers.autopilots.ardupilot import Codec, Mode, mavlink
from drivers.sim.autopilot import SimAutopilot
from drivers.sim.autopilot_flight import Setpoint
from drivers.sim.vehicle import Vehicle, Wind
from lcmtypes import make
from lcmtypes.podwatch import setpoint_t
from procs.autopilot.bridge import Bridge
from procs.autopilot.telemetry import STREAMS_HZ
from procs.settings import Mission

TICK_US = 10_000
TWIN_US = 20_000
BRIDGE_US = 50_000
HOME = (10.0, 20.0)
DRONE_ID = 1
CALM = Wind()
ORIGIN = (15.30, -61.50, 0.0)
UTC_US = 1_790_000_000_000_000  # when the bridge's clock was 0


class Rig:
    """A bridge and a twin; `want` is said 10 times a second while it is set."""

    def __init__(
        self, *, gps_noise_m: float = 0.0, compass_error_deg: float = 0.0, wind: Wind = CALM
    ) -> None:
        self.utime = 5_000_000
        self.mission = Mission()
        self.bridge = Bridge(self.mission, DRONE_ID)
        random = np.random.default_rng(7)
        self.vehicle = Vehicle(HOME, random, wind)
        self.twin = SimAutopilot(
            self.vehicle,
            DRONE_ID,
            random,
            origin=ORIGIN,
            gps_noise_m=gps_noise_m,
            compass_error_deg=compass_error_deg,
            start_s=self.utime / 1e6,
            utc_us=UTC_US,
        )
        self.want: setpoint_t | None = None
        self.bridge_alive = True
        self.sent: list[object] = []
        self.trace: list[tuple[float, float, float]] = []
        self._listener = Codec(1, 1)
        self._sequence = 0

    @property
    def state(self) -> dict:
        return self.bridge.state(self.utime)

    def say(self, kind: int, life_s: float = 0.5, **members: float) -> None:
        """One setpoint, now."""
        self._sequence += 1
        message = make(
            setpoint_t,
            utime=self.utime,
            seq=self._sequence,
            drone_id=DRONE_ID,
            expiry_utime=self.utime + round(life_s * 1e6),
            **members,
        )
        message.kind = kind
        self._carry(self.bridge.setpoint(message, self.utime))

    def fly(self, seconds: float, **members: float) -> None:
        """Let time pass while the navigator says the same, or nothing."""
        for _ in range(round(seconds * 1e6 / TICK_US)):
            self.tick(members)

    def fly_until(self, condition, limit_s: float, **members: float) -> float:
        """Let time pass until `condition()`; how long it took in seconds."""
        began = self.utime
        while not condition():
            assert self.utime - began < limit_s * 1e6, f"not within {limit_s} s: {self.state}"
            self.tick(members)
        return (self.utime - began) / 1e6

    def tick(self, members: dict) -> None:
        self.utime += TICK_US
        if members and self.utime % 100_000 == 0:
            self.say(**members)
        if self.bridge_alive and self.utime % BRIDGE_US == 0:
            self._carry(self.bridge.step(self.utime))
        if self.utime % TWIN_US == 0:
            data = self.twin.step(self.utime / 1e6)
            if self.bridge_alive:
                self.bridge.receive(data, self.utime)
            self.trace.append(self.vehicle.position_ned)

    def _carry(self, data: bytes) -> None:
        self.sent += self._listener.parse(data)
        self.twin.receive(data, self.utime / 1e6)

    def take_off(self, height_m: float = 20.0) -> float:
        kind = setpoint_t.TAKEOFF
        return self.fly_until(
            lambda: self.state["d_m"] < -height_m + 0.5,
            40,
            kind=kind,
            n_m=HOME[0],
            e_m=HOME[1],
            d_m=-height_m,
        )

    def setpoints(self) -> list:
        return [m for m in self.sent if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]

    def commands(self, command: int) -> list:
        return [m for m in self.sent if m.get_type() == "COMMAND_LONG" and m.command == command]


@pytest.fixture
def rig() -> Rig:
    return Rig()


@pytest.fixture
def flying(rig: Rig) -> Rig:
    rig.take_off()
    return rig


def test_take_off_goes_guided_arm_take_off_and_holds_setpoints_back_in_the_climb(rig):
    took_s = rig.take_off(19.0)
    assert took_s < 20
    asked = [m.command for m in rig.sent if m.get_type() == "COMMAND_LONG" and m.command != 511]
    assert asked == [
        mavlink.MAV_CMD_DO_SET_MODE,
        *[mavlink.MAV_CMD_COMPONENT_ARM_DISARM] * asked.count(mavlink.MAV_CMD_COMPONENT_ARM_DISARM),
        mavlink.MAV_CMD_NAV_TAKEOFF,
    ]
    assert rig.setpoints() == []
    assert rig.state["guided"]
    assert rig.state["armed"]
    assert not rig.state["landed"]
    rig.fly(3, kind=setpoint_t.HOLD)
    assert rig.vehicle.position_ned == pytest.approx((*HOME, -19.0), abs=0.6)


def test_a_goto_said_during_the_climb_waits_for_the_height(rig):
    rig.fly_until(lambda: rig.state["d_m"] < -5, 30, kind=setpoint_t.TAKEOFF, d_m=-20.0)
    rig.fly_until(lambda: rig.state["d_m"] < -19.5, 20, kind=setpoint_t.GOTO, n_m=60.0, e_m=20.0, d_m=-20.0)
    assert math.hypot(rig.state["n_m"] - 10, rig.state["e_m"] - 20) < 1
    assert rig.bridge.state(rig.utime)["n_clamped"] == 0
    rig.fly(5, kind=setpoint_t.GOTO, n_m=60.0, e_m=20.0, d_m=-20.0)
    assert rig.state["n_m"] > 20


def test_hold_stops_the_climb(rig):
    rig.fly_until(lambda: rig.state["d_m"] < -8, 30, kind=setpoint_t.TAKEOFF, d_m=-20.0)
    rig.fly(8, kind=setpoint_t.HOLD)
    assert -14 < rig.state["d_m"] < -8


@pytest.mark.parametrize("at_d_m", [0.5, -6.0], ids=["on the ground", "in the air"])
def test_a_climb_that_somebody_else_ends_is_taken_up_again(rig, at_d_m):
    wanted = {"kind": setpoint_t.TAKEOFF, "d_m": -20.0}
    rig.fly_until(lambda: rig.twin.flight.climbing and rig.state["d_m"] < at_d_m, 30, **wanted)
    rig.twin.flight.accept(Setpoint(None, (0.0, 0.0, 0.0), None, rig.utime / 1e6))
    assert not rig.twin.flight.climbing
    rig.fly_until(lambda: rig.state["d_m"] < -19, 50, **wanted)


def test_without_a_fresh_position_only_zero_velocity_is_sent(flying):
    flying.fly(1, kind=setpoint_t.VELOCITY, vn_m_s=3.0)
    del flying.twin._streams[mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED]
    flying.fly(1.5, kind=setpoint_t.VELOCITY, vn_m_s=3.0)
    assert not flying.state["position_ok"]
    assert flying.setpoints()[-1].vx == 0
    flying.fly(4, kind=setpoint_t.VELOCITY, vn_m_s=3.0)  # it asks for the stream again
    assert flying.setpoints()[-1].vx == pytest.approx(3.0)


def test_a_respawned_bridge_leaves_the_brake_of_its_forerunner(flying):
    flying.fly(3)
    assert flying.twin.flight.mode == Mode.BRAKE
    flying.bridge = Bridge(flying.mission, DRONE_ID)
    flying.fly(5, kind=setpoint_t.VELOCITY, vn_m_s=2.0)
    assert flying.vehicle.velocity_ned[0] == pytest.approx(2, abs=0.3)


def test_position_is_told_in_the_fleets_frame(flying):
    """The autopilot's own origin is at its home: its local position there is 0, the fleet's is HOME."""
    assert (flying.state["n_m"], flying.state["e_m"]) == pytest.approx(HOME, abs=0.2)
    assert flying.state["position_ok"]


def test_goto_arrives_within_the_speed_limit(flying):
    fastest = 0.0
    for _ in range(3000):
        flying.tick({"kind": setpoint_t.GOTO, "n_m": 110.0, "e_m": 20.0, "d_m": -30.0, "yaw_rad": 1.0})
        fastest = max(fastest, math.hypot(*flying.vehicle.velocity_ned[:2]))
    assert flying.vehicle.position_ned == pytest.approx((110, 20, -30), abs=0.5)
    assert flying.vehicle.yaw_rad == pytest.approx(1.0, abs=0.05)
    assert 8 < fastest < flying.mission.limits.speed_m_s + 0.5


def test_a_moving_goal_is_followed_without_lag(flying):
    speed_m_s = 4.0
    began = flying.utime
    for _ in range(2000):
        n_m = HOME[0] + speed_m_s * (flying.utime - began) / 1e6
        flying.tick({"kind": setpoint_t.GOTO, "n_m": n_m, "e_m": HOME[1], "d_m": -20.0, "vn_m_s": speed_m_s})
    lag_m = HOME[0] + speed_m_s * (flying.utime - began) / 1e6 - flying.vehicle.position_ned[0]
    assert abs(lag_m) < 1.0  # of which 0.4 m is the 100 ms between two setpoints


def test_velocity_is_flown(flying):
    took_s = flying.fly_until(
        lambda: flying.vehicle.velocity_ned[1] > 2.8, 3, kind=setpoint_t.VELOCITY, ve_m_s=3.0, yaw_rad=0.5
    )
    assert took_s == pytest.approx(1.6, abs=0.3)
    flying.fly(2, kind=setpoint_t.VELOCITY, ve_m_s=3.0, yaw_rad=0.5)
    assert flying.vehicle.yaw_rad == pytest.approx(0.5, abs=0.1)


def test_every_setpoint_carries_a_yaw(flying):
    flying.fly(1, kind=setpoint_t.GOTO, n_m=15.0, e_m=20.0, d_m=-20.0)
    flying.fly(1, kind=setpoint_t.VELOCITY, vn_m_s=1.0)
    flying.fly(1, kind=setpoint_t.HOLD)
    flying.fly(1)
    masks = {m.type_mask for m in flying.setpoints()}
    assert masks == {0x9C0, 0x9C7}
    assert all(mask & 0x400 == 0 for mask in masks)


def test_an_expired_setpoint_never_reaches_the_autopilot(flying):
    flying.fly(1, kind=setpoint_t.VELOCITY, vn_m_s=3.0)
    flying.sent.clear()
    before = flying.state["n_expired"]
    flying.say(life_s=-0.001, kind=setpoint_t.VELOCITY, vn_m_s=7.0)
    flying.fly(1)
    assert flying.state["n_expired"] == before + 2  # this one, and the last live one that ran out
    assert all(m.vx < 7.0 for m in flying.setpoints())
    assert flying.setpoints()[-1].vx == 0


def test_a_setpoint_that_claims_a_long_life_dies_after_2_s(flying):
    flying.say(life_s=3600, kind=setpoint_t.VELOCITY, vn_m_s=3.0)
    flying.fly(1.9)
    assert flying.setpoints()[-1].vx == pytest.approx(3.0)
    flying.fly(0.2)
    assert flying.setpoints()[-1].vx == 0


def test_an_older_setpoint_that_comes_late_changes_nothing(flying):
    late = make(
        setpoint_t, utime=flying.utime, drone_id=DRONE_ID, expiry_utime=flying.utime + 10**6, vn_m_s=9.0
    )
    late.kind = setpoint_t.VELOCITY
    flying.fly(0.2, kind=setpoint_t.VELOCITY, vn_m_s=1.0)
    flying.bridge.setpoint(late, flying.utime)
    flying.fly(0.2)
    assert flying.setpoints()[-1].vx == pytest.approx(1.0)


def test_silence_means_zero_velocity_at_once_and_brake_a_second_later(flying):
    flying.fly(3, kind=setpoint_t.VELOCITY, vn_m_s=5.0)
    flying.sent.clear()
    flying.fly(0.7)
    assert flying.setpoints()[-1].vx == 0
    assert flying.twin.flight.mode == Mode.GUIDED
    flying.fly(1.2)
    assert flying.twin.flight.mode == Mode.BRAKE
    assert flying.state["guided"]  # we braked ourselves, and may go on
    flying.fly(4, kind=setpoint_t.VELOCITY, vn_m_s=5.0)
    assert flying.vehicle.velocity_ned[0] == pytest.approx(5, abs=0.3)


def test_the_pilot_keeps_the_vehicle(flying):
    flying.fly(1, kind=setpoint_t.VELOCITY, vn_m_s=3.0)
    flying.twin.pilot_mode(Mode.LOITER)
    flying.fly(1.1, kind=setpoint_t.VELOCITY, vn_m_s=3.0)
    assert not flying.state["guided"]
    flying.sent.clear()
    for kind in range(setpoint_t.TAKEOFF, setpoint_t.LAND + 1):
        flying.fly(2, kind=kind, d_m=-20.0)
    flying.fly(3)
    assert flying.setpoints() == []
    assert flying.commands(mavlink.MAV_CMD_DO_SET_MODE) == []
    assert flying.twin.flight.mode == Mode.LOITER
    flying.twin.pilot_mode(Mode.GUIDED)  # the pilot gives it back
    flying.fly(4, kind=setpoint_t.VELOCITY, vn_m_s=3.0)
    assert flying.state["guided"]
    assert flying.vehicle.velocity_ned[0] == pytest.approx(3, abs=0.3)


def test_after_a_pilots_landing_only_a_take_off_asked_anew_goes_up(flying):
    flying.twin.pilot_mode(Mode.LAND)
    hold = {"kind": setpoint_t.TAKEOFF, "d_m": -20.0}
    flying.fly_until(lambda: not flying.twin.flight.armed, 60, **hold)
    flying.fly(5, **hold)
    assert flying.state["landed"]
    assert not flying.twin.flight.armed
    flying.fly(1, kind=setpoint_t.IDLE)
    flying.take_off()


def test_land_and_return(flying):
    flying.fly(4, kind=setpoint_t.GOTO, n_m=40.0, e_m=20.0, d_m=-15.0)
    flying.fly_until(lambda: flying.state["landed"] and not flying.state["armed"], 90, kind=setpoint_t.RETURN)
    assert flying.vehicle.position_ned == pytest.approx((*HOME, 0), abs=1.0)
    flying.fly(1, kind=setpoint_t.IDLE)
    flying.take_off(15.0)
    took_s = flying.fly_until(lambda: not flying.state["armed"], 40, kind=setpoint_t.LAND)
    assert took_s == pytest.approx(25, abs=2)  # 27 at 1.5 m/s, but our limit lets it come down at 2 m/s
    assert flying.twin.flight.mode == Mode.LAND


def test_a_landing_can_be_called_off(flying):
    flying.fly(3, kind=setpoint_t.LAND)
    assert flying.twin.flight.mode == Mode.LAND
    flying.fly(9, kind=setpoint_t.GOTO, n_m=10.0, e_m=20.0, d_m=-20.0)
    assert flying.twin.flight.mode == Mode.GUIDED
    assert flying.vehicle.position_ned[2] == pytest.approx(-20, abs=1)


def test_streams_are_asked_for_again_after_the_autopilot_restarts(rig):
    rig.fly(6)
    assert rig.state["position_ok"]
    rig.twin.restart(rig.utime / 1e6)
    rig.sent.clear()
    rig.fly(2.9)
    assert len({m.param1 for m in rig.commands(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL)}) == len(STREAMS_HZ)
    assert not rig.state["position_ok"]
    rig.fly(8)
    assert rig.state["position_ok"]
    rig.take_off()


def test_all_is_asked_for_again_after_a_gap_in_the_heartbeats(rig):
    rig.fly(6)
    rig.bridge_alive = False
    rig.fly(4)
    rig.twin.restart(rig.utime / 1e6)
    rig.bridge_alive = True
    rig.sent.clear()
    rig.fly(1.5)
    assert len(rig.commands(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL)) == len(STREAMS_HZ)
    asked = [m.param_id for m in rig.sent if m.get_type() == "PARAM_SET"]
    names = [name for name in asked if name in rig.twin.flight.parameters]  # others it repeats: no answer
    assert sorted(names) == sorted(set(names))
    assert "FS_GCS_ENABLE" in names


def test_the_ground_station_failsafe_is_set_and_brings_the_vehicle_home(flying):
    parameters = flying.twin.flight.parameters
    assert (parameters["FS_GCS_ENABLE"], parameters["FENCE_ENABLE"], parameters["FENCE_TYPE"]) == (1, 1, 3)
    assert parameters["FENCE_RADIUS"] > flying.mission.limits.fence_radius_m
    timeout_s = parameters["FS_GCS_TIMEOUT"]
    flying.fly(2, kind=setpoint_t.HOLD)
    flying.bridge_alive = False
    flying.fly(timeout_s - 1)
    assert flying.twin.flight.mode == Mode.GUIDED
    flying.fly(2)
    assert flying.twin.flight.mode == Mode.RTL
    flying.bridge_alive = True
    flying.fly(3, kind=setpoint_t.HOLD)
    assert flying.twin.flight.mode == Mode.RTL  # and stays so: nobody asked us
    assert not flying.state["guided"]


@pytest.mark.parametrize("has_monitor", [True, False])
def test_the_battery_failsafes_are_set_where_the_autopilot_has_them_and_missed_by_nobody_else(
    rig, has_monitor
):
    parameters = rig.twin.flight.parameters
    if has_monitor:
        parameters |= {"BATT_FS_LOW_ACT": 0.0, "BATT_FS_CRT_ACT": 0.0}
    rig.fly(8)
    if has_monitor:
        assert (parameters["BATT_FS_LOW_ACT"], parameters["BATT_FS_CRT_ACT"]) == (2, 1)
    names = [m.param_id for m in rig.sent if m.get_type() == "PARAM_SET"]
    assert names.count("BATT_FS_LOW_ACT") == (1 if has_monitor else 3), "asked for a limited time"
    assert rig.bridge.problem(rig.utime) == ""


def test_a_respawned_bridge_carries_on_in_the_air(flying):
    flying.fly(2, kind=setpoint_t.HOLD)
    flying.bridge = Bridge(flying.mission, DRONE_ID)
    flying.sent.clear()
    flying.fly(4, kind=setpoint_t.VELOCITY, vn_m_s=2.0)
    assert flying.state["guided"]
    assert flying.vehicle.velocity_ned[0] == pytest.approx(2, abs=0.3)
    assert flying.commands(mavlink.MAV_CMD_COMPONENT_ARM_DISARM) == []
    assert flying.commands(mavlink.MAV_CMD_NAV_TAKEOFF) == []


def test_it_never_disarms(flying):
    for kind in range(setpoint_t.IDLE, setpoint_t.LAND + 1):
        flying.fly(3, kind=kind, d_m=-20.0, n_m=10.0, e_m=20.0)
    flying.fly(60, kind=setpoint_t.LAND)
    arms = flying.commands(mavlink.MAV_CMD_COMPONENT_ARM_DISARM)
    assert arms
    assert all(m.param1 == 1 and m.param2 == 0 for m in arms)


def test_the_fence_holds_in_wind_and_noise():
    rig = Rig(gps_noise_m=1.5, compass_error_deg=5.0, wind=Wind((5.0, 3.0), 1.0))
    rig.mission = Mission(limits={"fence_radius_m": 60.0}, search={"north_m": 0.0, "radius_m": 50.0})
    rig.bridge = Bridge(rig.mission, DRONE_ID)
    rig.take_off()
    rig.fly(25, kind=setpoint_t.VELOCITY, vn_m_s=10.0, ve_m_s=2.0)
    assert 50 < math.hypot(rig.state["n_m"], rig.state["e_m"]) < 61
    assert rig.state["n_clamped"] > 100
    n_clamped = rig.state["n_clamped"]
    rig.fly(15, kind=setpoint_t.GOTO, n_m=0.0, e_m=500.0, d_m=-200.0)
    assert rig.state["n_clamped"] - n_clamped == pytest.approx(150, abs=1)
    assert math.hypot(rig.state["n_m"], rig.state["e_m"]) < 61
    assert -rig.state["d_m"] < rig.mission.limits.max_height_m + 1
    assert rig.twin.flight.mode == Mode.GUIDED


def test_a_setpoint_with_no_number_or_for_another_drone_is_refused(flying):
    flying.fly(1, kind=setpoint_t.HOLD)
    flying.sent.clear()
    flying.say(kind=setpoint_t.VELOCITY, vn_m_s=math.nan)
    flying.say(kind=99)
    other = make(setpoint_t, utime=flying.utime, drone_id=2, expiry_utime=flying.utime + 10**6)
    flying.bridge.setpoint(other, flying.utime)
    assert flying.bridge.flyer.n_refused == 3
    assert flying.sent == []


def test_only_component_1_of_the_target_is_heard(rig):
    stranger = Codec(2, 1)
    stranger.send.heartbeat_send(2, 3, 0, 4, 4)
    gimbal = Codec(DRONE_ID, 154)
    gimbal.send.heartbeat_send(26, 8, 0, 4, 4)
    rig.bridge.receive(stranger.take() + gimbal.take(), rig.utime)
    assert not rig.bridge.telemetry.link_ok(rig.utime)
    assert "system 2, not 1" in rig.bridge.problem(rig.utime)


def test_the_whole_of_both_costs_little(flying):
    """Messages a second, which the cost of both ends follows: what is sent is needed."""
    flying.sent.clear()
    flying.fly(10, kind=setpoint_t.GOTO, n_m=12.0, e_m=20.0, d_m=-20.0)
    assert len(flying.sent) / 10 < 32


def test_the_time_of_day_is_that_of_the_gps_once_it_has_a_fix():
    rig = Rig()
    rig.tick({})
    assert rig.state["utc_us"] == 0
    rig.fly_until(lambda: rig.state["utc_us"] > 0, 30.0)
    rig.fly(5.0)
    assert rig.state["utc_us"] - rig.state["utime"] == pytest.approx(UTC_US, abs=100_000)
