"""The bridge as a process of a drone in virtual time, its link in memory."""

import math
import subprocess
import sys

import numpy as np

from drivers.autopilots.memory import link_pair
from drivers.sim.autopilot import SimAutopilot
from drivers.sim.vehicle import Vehicle
from lcmtypes import channels, make
from lcmtypes.podwatch import heartbeat_t, setpoint_t, vehicle_state_t
from procs.autopilot import process
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.settings import DroneSettings, Mission

LINK_DELAY_US = 2000
STEP_US = 20_000


class Drone:
    """One bus with the bridge on it, a twin at the far end of its link, and a navigator's voice."""

    def __init__(self, clock: ClockError = ClockError()) -> None:  # noqa: B008
        self.queue = EventQueue()
        self.bus = VirtualBus(self.queue)
        self.clock = clock
        near, self.far = link_pair(self._deliver, 2)
        self.runtime = QueueRuntime(
            "autopilot",
            DroneSettings(drone_id=2, mission=Mission()),
            self.bus,
            clock,
            {"autopilot": lambda _process: near},
        )
        process.setup(self.runtime)
        self.runtime.start()
        vehicle = Vehicle((0.0, 6.0), np.random.default_rng(1))
        self.twin = SimAutopilot(vehicle, 2, np.random.default_rng(2), origin=(15.30, -61.50, 0.0))
        self.twin_is_on = True
        self.heard: dict[str, list] = {channels.VEHICLE_STATE: [], channels.HEARTBEAT: []}
        self.deliver, self.bus.deliver = self.bus.deliver, self._hear
        self.n_said = 0

    @property
    def utime(self) -> int:
        return self.clock.utime(self.queue.now_us)

    def run(self, seconds: float) -> None:
        end_us = self.queue.now_us + round(seconds * 1e6)
        while self.queue.now_us < end_us:
            self.queue.run_until(self.queue.now_us + STEP_US)
            if self.twin_is_on:
                self.twin.receive(self.far.receive(), self.queue.now_us / 1e6)
                self.far.write(self.twin.step(self.queue.now_us / 1e6))

    def say(self, kind: int, **members: float) -> None:
        message = make(
            setpoint_t,
            utime=self.utime,
            seq=self.n_said,
            drone_id=2,
            expiry_utime=self.utime + 500_000,
            **members,
        )
        message.kind = kind
        self.n_said += 1
        self.deliver(channels.SETPOINT, message.encode())

    def states(self) -> list[vehicle_state_t]:
        return self.heard[channels.VEHICLE_STATE]

    def beat(self) -> heartbeat_t:
        return self.heard[channels.HEARTBEAT][-1]

    def _deliver(self, action) -> None:
        self.queue.schedule(self.queue.now_us + LINK_DELAY_US, action)

    def _hear(self, channel: str, data: bytes) -> None:
        self.heard[channel].append(channels.BY_NAME[channel].kind.decode(data))


def test_vehicle_state_is_said_at_20_hz_with_the_time_at_which_the_position_arrived():
    drone = Drone(ClockError(offset_us=-2_000_000, drift_ppm=50.0))
    drone.run(6)
    drone.states().clear()
    drone.run(5)
    assert 99 <= len(drone.states()) <= 101
    newest = drone.states()[-1]
    assert newest.position_ok
    assert 0 <= drone.utime - newest.utime < 150_000
    assert (newest.n_m, newest.e_m) != (0, 0)
    assert math.hypot(newest.n_m, newest.e_m - 6.0) < 8
    assert newest.drone_id == 2
    assert drone.beat().status == heartbeat_t.OK


def test_a_setpoint_heard_takes_the_drone_up_and_its_age_is_told():
    drone = Drone()
    for _ in range(250):
        drone.say(setpoint_t.TAKEOFF, e_m=6.0, d_m=-15.0)
        drone.run(0.1)
    newest = drone.states()[-1]
    assert newest.d_m < -13
    assert newest.armed
    assert newest.guided
    assert drone.utime - 600_000 < newest.setpoint_utime <= drone.utime
    assert 0 <= newest.setpoint_age_us < 5000


def test_a_silent_autopilot_is_named_in_the_heartbeat_and_forgotten_when_it_speaks_again():
    drone = Drone()
    drone.run(6)
    assert drone.beat().status == heartbeat_t.OK
    drone.twin_is_on = False
    drone.run(4)
    assert drone.beat().status == heartbeat_t.DEGRADED
    assert "not heard" in drone.beat().detail
    assert not drone.states()[-1].position_ok
    assert not drone.states()[-1].guided
    assert drone.states()[-1].link_age_ms > 3000
    drone.twin_is_on = True
    drone.run(4)
    assert drone.beat().status == heartbeat_t.OK
    assert drone.states()[-1].position_ok


def test_the_heartbeat_says_why_the_autopilot_does_not_arm():
    drone = Drone()
    drone.twin.flight.boot(ready_at_s=60.0)
    for _ in range(30):
        drone.say(setpoint_t.TAKEOFF, d_m=-15.0)
        drone.run(0.1)
    assert "PreArm: Need Position Estimate" in drone.beat().detail


def test_a_process_that_ends_in_the_air_stops_the_vehicle():
    drone = Drone()
    for _ in range(200):
        drone.say(setpoint_t.TAKEOFF, e_m=6.0, d_m=-15.0)
        drone.run(0.1)
    for _ in range(30):
        drone.say(setpoint_t.VELOCITY, vn_m_s=4.0)
        drone.run(0.1)
    assert drone.twin.vehicle.velocity_ned[0] > 3.5
    drone.runtime.stop()
    drone.queue.run_until(drone.queue.now_us + LINK_DELAY_US)
    drone.run(2.7)  # a velocity that was left standing would still be flown
    assert abs(drone.twin.vehicle.velocity_ned[0]) < 0.7


def test_the_process_imports_nothing_heavy():
    script = (
        "import sys, procs.autopilot.process; "
        "print([m for m in ('cv2', 'scipy', 'onnxruntime', 'matplotlib') if m in sys.modules])"
    )
    printed = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True, text=True)
    assert printed.stdout.strip() == "[]"
