"""A flight over a real link, for a simulated autopilot in a process of its own and for a real one alike."""

import select
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from drivers.autopilots.mavlink_link import AutopilotLink
from lcmtypes import make
from lcmtypes.podwatch import setpoint_t
from procs.autopilot.bridge import Bridge

ROOT = Path(__file__).parents[2]
PERIOD_US = 50_000
SETPOINT_US = 100_000

TWIN = """
import select, sys, time
import numpy as np
from drivers.autopilots.mavlink_link import open_link
from drivers.sim.autopilot import SimAutopilot
from drivers.sim.vehicle import Vehicle

address, scale, system_id = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
link = open_link(address)
vehicle = Vehicle((0.0, 0.0), np.random.default_rng(1))
twin = SimAutopilot(vehicle, system_id, np.random.default_rng(2), origin=(15.3, -61.5, 0.0))
began_s = time.monotonic()
while True:
    select.select([link], [], [], 0.02 / scale)
    t_s = (time.monotonic() - began_s) * scale
    twin.receive(link.receive(), t_s)
    link.write(twin.step(t_s))
"""


def start_twin(address: str, *, scale: float, system_id: int) -> subprocess.Popen[bytes]:
    """A simulated autopilot whose time runs `scale` times as fast as real time."""
    return subprocess.Popen([sys.executable, "-c", TWIN, address, str(scale), str(system_id)], cwd=ROOT)


class Pilot:
    """Drives a bridge over a link, as the process does, by a clock that may run faster than real time."""

    def __init__(self, bridge: Bridge, link: AutopilotLink, *, drone_id: int, scale: float = 1.0) -> None:
        self.bridge = bridge
        self.link = link
        self.overhear: Callable[[bytes], None] = lambda _data: None
        self._drone_id = drone_id
        self._scale = scale
        self._began_s = time.monotonic()
        self._step_us = self._say_us = 0

    @property
    def utime(self) -> int:
        return 1_000_000 + round((time.monotonic() - self._began_s) * 1e6 * self._scale)

    @property
    def state(self) -> dict:
        return self.bridge.state(self.utime)

    def fly_until(self, condition: Callable[[], bool], limit_s: float, **members: float) -> None:
        """Say one setpoint again and again until `condition()`, or fail after `limit_s` seconds of flight."""
        end_us = self.utime + round(limit_s * 1e6)
        while not condition():
            utime = self.utime
            assert utime < end_us, f"not within {limit_s} s: {self.state}, {self.bridge.problem(utime)}"
            wait_s = max(self._step_us - utime, 0) / 1e6 / self._scale
            if select.select([self.link], [], [], wait_s)[0]:
                data = self.link.receive()
                self.overhear(data)
                self.bridge.receive(data, self.utime)
            utime = self.utime
            if utime >= self._step_us:
                self._step_us = utime + PERIOD_US
                self.link.write(self.bridge.step(utime))
            if members and utime >= self._say_us:
                self._say_us = utime + SETPOINT_US
                self.link.write(self.bridge.setpoint(self._setpoint(members), utime))

    def _setpoint(self, members: dict) -> setpoint_t:
        utime = self.utime
        life_us = round(1e6 * max(self._scale, 1.0))
        message = make(setpoint_t, utime=utime, drone_id=self._drone_id, expiry_utime=utime + life_us)
        for name, value in members.items():
            setattr(message, name, value)
        return message


FLOWN_M = [20.0, 0.0, -15.0, 20.0, 0.0, 0.0]
FLOWN_WITHIN_M = 3.0  # GPS and barometer of a real autopilot


def there_and_back(pilot: Pilot, *, ready_s: float) -> list[float]:
    """Up to 15 m, 20 m north, and down there -> (north, east, down) in m from the start, of the place aloft
    and then of the end. FLOWN_M is what was asked.
    """

    def moved() -> list[float]:
        state = pilot.state
        return [state["n_m"] - home_n, state["e_m"] - home_e, state["d_m"] - home_d]

    pilot.fly_until(lambda: pilot.state["position_ok"], ready_s)
    home_n, home_e, home_d = pilot.state["n_m"], pilot.state["e_m"], pilot.state["d_m"]
    pilot.fly_until(lambda: pilot.state["d_m"] < -14, ready_s + 60, kind=setpoint_t.TAKEOFF, d_m=-15.0)
    goal = {"n_m": home_n + 20.0, "e_m": home_e, "d_m": -15.0}
    # At rest there: who lands on the move comes down some metres further on.
    pilot.fly_until(
        lambda: abs(pilot.state["n_m"] - goal["n_m"]) < 1.0 and abs(pilot.state["vn_m_s"]) < 0.3,
        90,
        kind=setpoint_t.GOTO,
        **goal,
    )
    aloft = moved()
    pilot.fly_until(lambda: pilot.state["landed"] and not pilot.state["armed"], 120, kind=setpoint_t.LAND)
    return aloft + moved()
