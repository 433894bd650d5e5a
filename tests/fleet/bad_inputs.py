"""What the rows of test_bad_input drive: one process of a drone, or two relays, in virtual time."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.frames import MemoryFrames
from drivers.radios.memory import MemoryEther
from lcmtypes import channels, make
from lcmtypes.podwatch import box_t, detections_t, heartbeat_t, ring_map_t, vehicle_state_t
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.registrar.process import setup as set_up_registrar
from procs.relay.process import setup as set_up_relay
from procs.settings import DroneEntry, DroneSettings, Mission

S = 1_000_000
Image = NDArray[np.uint8]
SEA = np.full((480, 640, 3), 90, np.uint8)


class Bench:
    """One process of drone 1 on its bus; `heard` holds what is said there, decoded, by channel."""

    def __init__(self, process: str, setup: Callable[[Any], None], drivers: dict[str, Any]) -> None:
        self.queue = EventQueue()
        self.bus = VirtualBus(self.queue)
        self.bus.observers.append(self._hear)
        self.heard: dict[str, list[Any]] = {}
        self.drivers = {"frames": MemoryFrames(), **drivers}
        settings = DroneSettings(drone_id=1, mission=Mission())
        self.runtime = QueueRuntime(
            process,
            settings,
            self.bus,
            ClockError(),
            {name: lambda _process, name=name: self._made(name) for name in self.drivers},
        )
        setup(self.runtime)
        self.runtime.start()

    def run(self, seconds: float) -> None:
        self.queue.run_until(self.queue.now_us + round(seconds * S))

    def say(self, channel: str, message: Any) -> None:
        message.utime = message.utime or self.queue.now_us
        message.drone_id = 1
        self.bus.deliver(channel, message.encode())

    def count(self, channel: str) -> int:
        return len(self.heard.get(channel, []))

    @property
    def beat(self) -> heartbeat_t:
        """The newest heartbeat."""
        newest: heartbeat_t = self.heard[channels.HEARTBEAT][-1]
        return newest

    def _made(self, name: str) -> Any:
        driver = self.drivers[name]
        return driver() if callable(driver) else driver

    def _hear(self, channel: str, data: bytes) -> None:
        kind = channels.kind_of(channel)
        assert kind is not None
        try:
            self.heard.setdefault(channel, []).append(kind.decode(data))
        except (ValueError, struct.error):
            return  # what does not decode is what some rows say


class Camera:
    """Gives whatever it is told to; an exception is raised."""

    def __init__(self) -> None:
        self.gives: Any = SEA

    def capture(self) -> Any:
        if isinstance(self.gives, Exception):
            raise self.gives
        return self.gives


def sea_with_boxes(utime: int, *, right_px: float = 140.0) -> detections_t:
    """Two animals in a frame of the mission's size."""
    boxes = [
        make(box_t, left_px=100.0, top_px=100.0, right_px=right_px, bottom_px=220.0, score=0.9),
        make(box_t, left_px=400.0, top_px=200.0, right_px=440.0, bottom_px=320.0, score=0.8),
    ]
    return make(detections_t, utime=utime, width=640, height=480, n_boxes=2, boxes=boxes)


def registrar() -> Bench:
    """A registrar that knows where its drone is."""
    bench = Bench("registrar", set_up_registrar, {})
    show_registrar(bench, 1.0, lambda utime: None)
    return bench


def show_registrar(bench: Bench, seconds: float, detections: Callable[[int], detections_t | None]) -> None:
    """Poses at 20 Hz, and detections at 5 Hz where there are any."""
    for k in range(round(seconds * 20)):
        state = make(vehicle_state_t, d_m=-30.0, position_ok=True, battery=0.9)
        bench.say(channels.VEHICLE_STATE, state)
        bench.run(0.05)
        said = detections(bench.queue.now_us - S // 20) if k % 4 == 3 else None
        if said is not None:
            bench.say(channels.DETECTIONS, said)


class Relays:
    """The relays of drones 1 and 2, and a tap on what goes from 2 to 1."""

    def __init__(self, folder: Path) -> None:
        self.queue = EventQueue()
        self.ether = MemoryEther(np.random.default_rng(3), self._after)
        self.mission = Mission(drones=(DroneEntry(id=1), DroneEntry(id=2, home_e_m=10.0)))
        self._folder = folder
        self.recorded: list[bytes] = []
        self.beats: list[heartbeat_t] = []
        self.copies: list[ring_map_t] = []
        self.buses: dict[int, VirtualBus] = {}
        self.runtimes: dict[int, QueueRuntime] = {}
        self._carry, self.ether.carry = self.ether.carry, self._tap  # type: ignore[method-assign]
        self._n_said = 0
        for drone_id in (1, 2):
            self.start(drone_id)

    def start(self, drone_id: int) -> None:
        """Start a relay, or start it anew: nothing of its earlier life is left."""
        if drone_id in self.runtimes:
            self.runtimes[drone_id].kill()
        bus = VirtualBus(self.queue)
        settings = DroneSettings(drone_id=drone_id, mission=self.mission, run_dir=str(self._folder))
        radio = {"radio": lambda _process: self.ether.radio(drone_id, (1, 2))}
        runtime = QueueRuntime("relay", settings, bus, ClockError(10 * S * drone_id), radio)
        set_up_relay(runtime)
        runtime.start()
        if drone_id == 1:
            bus.observers.append(self._hear)
        self.buses[drone_id], self.runtimes[drone_id] = bus, runtime

    def run(self, seconds: float, disturb: Callable[[], None] = lambda: None) -> int:
        """Drone 2 says one map every 0.2 s -> how many of them did not arrive at drone 1."""
        before, n_said = len(self.copies), 0
        for k in range(round(seconds * 10)):
            disturb()
            if k % 2 == 0:
                utime = 20 * S + self.queue.now_us
                message = make(ring_map_t, utime=utime, seq=self._n_said, drone_id=2, n_bytes=1, packet=b"m")
                self.buses[2].deliver(channels.RING_MAP, message.encode())
                self._n_said += 1
                n_said += 1
            self.queue.run_until(self.queue.now_us + S // 10)
        return n_said - (len(self.copies) - before)

    def feed(self, data: bytes) -> None:
        """A datagram reaches drone 1, from whomever."""
        self._carry(2, 1, data)

    def _tap(self, sender: int, receiver: int, data: bytes) -> None:
        if sender == 2:
            self.recorded.append(data)
        self._carry(sender, receiver, data)

    def _after(self, delay_s: float, action: Callable[[], None]) -> None:
        self.queue.schedule(self.queue.now_us + round(delay_s * S), action)

    def _hear(self, channel: str, data: bytes) -> None:
        if channel == channels.HEARTBEAT:
            self.beats.append(heartbeat_t.decode(data))
        elif channel == channels.received(2, channels.RING_MAP):
            self.copies.append(ring_map_t.decode(data))
