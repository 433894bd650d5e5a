"""The world of a run in processes mode: `python -m tools.sim.world_process PLAN.json`, under the run's
supervisor.

Owns the simulation clock, the true state, the simulated autopilots (real MAVLink over UDP), the air between
the radios and the truth's files. It hears commands (faults) on its own group. When processes tell that they
are late it slows the clock. Where real autopilots fly (`--autopilot`) it carries their bytes,
takes the vehicles' places from what they say, and never slows the clock: it warns instead.
"""

import argparse
import json
import select
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import lcm
import numpy as np

from drivers.autopilots.mavlink_link import MavlinkUdpClient, open_link
from drivers.sim.clock import ClockPage
from drivers.sim.ether import UdpEther
from drivers.sim.remote import world_url
from drivers.sim.routed_autopilot import MisplacedError, RoutedAutopilot
from drivers.sim.world import STEP_US, World
from lcmtypes import channels
from procs.main import EXIT_CANNOT_START, end_with_parent
from tools.sim.plan import RunPlan
from tools.sim.settings import SimMission
from tools.sim.truth import TruthWriter

__all__ = ["WorldProcess", "main"]

TRUTH_PERIOD_US = 50_000
PACE_PERIOD_US = 500_000
LATE_LIMIT_S = 0.15  # of simulation time: later than this, setpoints come near their expiry
LATE_FINE_S = 0.05
SLOWER, FASTER = 0.85, 1.05
SLOWEST = 0.05


class WorldProcess:
    """Paces, steps and tells."""

    def __init__(self, settings: dict[str, Any]) -> None:
        mission = SimMission.model_validate(settings["mission"])
        scene = Path(settings["scene"]) if settings["scene"] else None
        plan = RunPlan(mission, Path(settings["folder"]), settings["sensor"], scene)
        self._clock = ClockPage(Path(settings["clock_page"]))
        self._rate = 0.0
        self._lcm = lcm.LCM(world_url(settings["slot"]))
        self._lcm.subscribe(channels.WORLD_COMMAND, self._command)
        self._links = {
            int(drone_id): MavlinkUdpClient(f"127.0.0.1:{port}", int(drone_id))
            for drone_id, port in settings["mavlink_ports"].items()
        }
        world = replace(plan.world_settings(), utc_us=time.time_ns() // 1000)
        self._routed = {
            int(drone_id): RoutedAutopilot(
                open_link(address, int(drone_id)),
                int(drone_id),
                origin=world.origin,
                home=world.homes[int(drone_id)],
            )
            for drone_id, address in settings["autopilots"].items()
        }
        self._told: dict[int, str] = {}
        self._world = World(world, self._links, self._routed)
        self._ether = UdpEther(
            {int(drone_id): port for drone_id, port in settings["radio_ports"].items()},
            np.random.default_rng([mission.seed, 5]),
            mission.world.radio_latency_s,
            mission.world.radio_loss,
            {int(drone_id): port for drone_id, port in settings["ether_ports"].items()},
        )
        self._truth = TruthWriter(plan.folder, plan.scene_truth())
        self._running = True
        self._next_truth_us = 0
        self._next_pace_us = 0

    def run(self) -> None:
        """Until SIGTERM."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._stop)
        while self._running:
            now_us, _ = self._clock.read()
            wait_s = (self._world.now_us + STEP_US - now_us) / 1e6 / self._rate if self._rate else 0.1
            wait_s = max(wait_s, 0.0)
            sockets: list[Any] = [self._lcm, *self._ether.sockets.values()]
            select.select(sockets, [], [], min(wait_s, 0.1))
            while self._lcm.handle_timeout(0) > 0:
                pass
            now_us, _ = self._clock.read()
            self._ether.take(now_us / 1e6)
            self._ether.forward(now_us / 1e6)
            self._step(int(now_us))
        self._truth.close()
        self._ether.close()
        for autopilot in self._routed.values():
            autopilot.close()

    def _step(self, now_us: int) -> None:
        if now_us < self._world.now_us + STEP_US:
            return
        self._world.step_to(now_us)
        state = self._world.state()
        self._lcm.publish(channels.WORLD_STATE, state.encode())
        if self._world.now_us >= self._next_truth_us:
            self._next_truth_us += TRUTH_PERIOD_US
            self._truth.write(state)
        if now_us >= self._next_pace_us:
            self._next_pace_us = now_us + PACE_PERIOD_US
            self._pace()

    def _pace(self) -> None:
        """Slow the clock for everybody while anybody is late, and let it recover."""
        late_s = self._clock.take_late()
        if self._routed:
            self._warn(late_s)
            return
        rate = self._rate
        if late_s > LATE_LIMIT_S:
            rate = max(rate * SLOWER, SLOWEST)
        elif late_s < LATE_FINE_S:
            rate = min(rate * FASTER, 1.0)
        if rate != self._rate:
            now_us, _ = self._clock.read()
            self._rate = rate
            self._clock.set(now_us, rate)

    def _warn(self, late_s: float) -> None:
        """A real autopilot's time cannot be slowed: say on stderr that this machine is too slow for it, and
        what is wrong with the autopilots; each once until it is over.
        """
        now_s = self._world.now_us / 1e6
        told = {drone_id: autopilot.problem(now_s) for drone_id, autopilot in self._routed.items()}
        told[0] = "this machine is too slow for real time; fly fewer drones, or with --sensor boxes"
        if late_s <= LATE_LIMIT_S:
            told[0] = ""
        for drone_id, text in told.items():
            if text and not self._told.get(drone_id):
                sys.stderr.write(f"world: at {now_s:.1f} s: {text}\n")
                sys.stderr.flush()
        self._told = told

    def _command(self, _channel: str, data: bytes) -> None:
        """A fault, as JSON, from the run's own tool."""
        command = json.loads(data)
        if command["kind"] == "go" and not self._rate:
            self._rate = 1.0
            self._clock.set(0.0, self._rate)
        elif command["kind"] == "dive":
            self._world.pod.diving = command["on"]
        elif command["kind"] == "kill":
            self._world.kill(command["drone"])
        elif command["kind"] == "cut":
            first, second = command["between"]
            self._ether.cut(first, second, command["on"])

    def _stop(self, _number: int, _frame: object) -> None:
        self._running = False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("settings", type=Path)
    arguments = parser.parse_args()
    end_with_parent()
    try:
        world = WorldProcess(json.loads(arguments.settings.read_text()))
    except (OSError, ValueError, RuntimeError) as error:
        sys.stderr.write(f"world: {error}\n")
        sys.exit(EXIT_CANNOT_START)
    try:
        world.run()
    except MisplacedError as error:
        sys.stderr.write(f"world: {error}\n")
        sys.exit(EXIT_CANNOT_START)


if __name__ == "__main__":
    main()
