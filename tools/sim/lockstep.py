"""A whole fleet in one operating-system process on a virtual clock: the same shells and cores, the same bytes
for the same seed.
"""

import importlib
from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np

from drivers.autopilots.memory import MemoryLink, link_pair
from drivers.frames import MemoryFrames
from drivers.radios.memory import MemoryEther
from drivers.sim.boxes import BoxDetector, BoxTracker
from drivers.sim.camera import SimCamera
from drivers.sim.surfaces import open_scene
from drivers.sim.world import STEP_US, World
from lcmtypes.podwatch import world_state_t
from procs import processes
from procs.detector.yolo import Detector
from procs.queue_executor import EventQueue, QueueRuntime, VirtualBus
from procs.relay.members import BOAT_ID
from procs.settings import DroneSettings
from procs.tracker.mask_tracker import MaskTracker
from tools.sim.plan import RunPlan
from tools.sim.truth import TruthWriter

__all__ = ["LockstepFleet"]

LINK_DELAY_US = 2_000
TRUTH_PERIOD_US = 50_000
WORLD_RANK = -1  # the world moves before anybody looks

Observer = Callable[[int, str, bytes], None]


class LockstepFleet:
    """All drones of a plan, ready to run; `observe(drone_id, channel, data)` sees every message."""

    def __init__(self, plan: RunPlan, observe: Observer) -> None:
        cv2.setNumThreads(1)
        self.plan = plan
        self.queue = EventQueue()
        seed = plan.mission.seed
        roster = plan.mission.roster
        self._cuts: dict[tuple[int, int], bool] = {}
        self.ether = MemoryEther(
            np.random.default_rng([seed, 5]),
            self._deliver_after,
            latency_s=plan.mission.world.radio_latency_s,
            loss=plan.mission.world.radio_loss,
        )
        self.ether.blocked = lambda sender, receiver: self._cuts.get((sender, receiver), False)
        pairs = {drone_id: link_pair(self._deliver, drone_id) for drone_id in roster}
        self.world = World(plan.world_settings(), {drone_id: pair[1] for drone_id, pair in pairs.items()})
        self._state = self.world.state()
        self._truth = TruthWriter(plan.folder, plan.scene_truth())
        self._surface = open_scene(**plan.surface_options())  # type: ignore[arg-type]
        self.runtimes: dict[int, list[QueueRuntime]] = {}
        for drone_id in roster:
            self._start_drone(drone_id, pairs[drone_id][0], observe)
        self.queue.schedule(STEP_US, self._step_world, rank=WORLD_RANK)

    @property
    def now_s(self) -> float:
        return self.queue.now_us / 1e6

    def run_until(self, end_s: float) -> None:
        """Fly on to `end_s` of simulation time."""
        self.queue.run_until(round(end_s * 1e6))

    def close(self) -> None:
        """Stop every process in the table's order and finish the truth."""
        for stop_order in sorted({process.stop_order for process in processes.PROCESSES}):
            for runtimes in self.runtimes.values():
                for runtime in runtimes:
                    if processes.BY_NAME[runtime.process].stop_order == stop_order:
                        runtime.stop()
        self._truth.close()

    def dive(self, on: bool) -> None:
        self.world.pod.diving = on

    def cut(self, first: int, second: int, on: bool) -> None:
        self._cuts[first, second] = self._cuts[second, first] = on

    def kill(self, drone_id: int) -> None:
        """Everything of one drone ends at once."""
        self.world.kill(drone_id)
        for runtime in self.runtimes.pop(drone_id, []):
            runtime.kill()

    def _start_drone(self, drone_id: int, link: MemoryLink, observe: Observer) -> None:
        bus = VirtualBus(self.queue)
        bus.observers.append(partial(observe, drone_id))
        settings = DroneSettings(
            drone_id=drone_id,
            mission=self.plan.plain_mission,
            seed=self.plan.mission.seed,
            run_dir=str(self.plan.folder),
            log_path=str(self.plan.log_path(drone_id)),
        )
        drivers = self._drivers(drone_id, link)
        clock = self.plan.clock(drone_id)
        runtimes = []
        for process in processes.PROCESSES:
            runtime = QueueRuntime(process.name, settings, bus, clock, drivers)
            importlib.import_module(process.module).setup(runtime)
            runtimes.append(runtime)
        for runtime in runtimes:
            runtime.start()
        self.runtimes[drone_id] = runtimes

    def _drivers(self, drone_id: int, link: MemoryLink) -> dict[str, Callable[[str], Any]]:
        frames = MemoryFrames()
        camera = SimCamera(
            drone_id, self.plan.camera, self._surface, self._look, poster=self.plan.mission.pod.poster
        )
        seed = self.plan.mission.seed * 100 + drone_id
        boxes = self.plan.sensor == "boxes"
        # A look takes its nominal time here, so that a slow machine cuts no frame into fewer tiles.
        nominal_ms = 1e3 * processes.BY_NAME["detector"].compute_s
        looks = {**self.plan.mission.detector.options(), "look_ms": nominal_ms}
        return {
            "frames": lambda _process: frames,
            "camera": lambda _process: camera,
            "detector": lambda _process: BoxDetector(seed) if boxes else Detector(**looks),
            "tracker": lambda _process: BoxTracker(seed) if boxes else MaskTracker(),
            "autopilot": lambda _process: link,
            # The boat has a radio too, where somebody sails one.
            "radio": lambda _process: self.ether.radio(drone_id, (BOAT_ID, *self.plan.mission.roster)),
        }

    def _look(self) -> tuple[world_state_t, float, float]:
        return self._state, (self.queue.now_us - self._state.utime) / 1e6, self.now_s

    def _deliver(self, action: Callable[[], None]) -> None:
        self.queue.schedule(self.queue.now_us + LINK_DELAY_US, action)

    def _deliver_after(self, delay_s: float, action: Callable[[], None]) -> None:
        self.queue.schedule(self.queue.now_us + round(delay_s * 1e6), action)

    def _step_world(self) -> None:
        self.world.step_to(self.queue.now_us)
        self._state = self.world.state()
        if self.world.now_us % TRUTH_PERIOD_US < STEP_US:
            self._truth.write(self._state)
        self.queue.schedule(self.queue.now_us + STEP_US, self._step_world, rank=WORLD_RANK)
