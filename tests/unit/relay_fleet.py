"""Relays of a whole fleet in memory, for the tests of the ring."""

from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.radios.memory import MemoryEther, MemoryRadio
from lcmtypes import channels, make
from lcmtypes.podwatch import (
    fleet_state_t,
    link_t,
    mission_state_t,
    vehicle_state_t,
)
from procs.queue_executor import ClockError, EventQueue
from procs.relay.relay import TICK_S, Copy, Relay

KEY = bytes(range(32))
S = 1_000_000
MAP = channels.BY_NAME[channels.RING_MAP]
EPISODE = channels.BY_NAME[channels.RING_EPISODE]


class Drone:
    """One relay, its clock, its radio and what its navigator and autopilot say."""

    def __init__(self, fleet: "Fleet", drone_id: int, clock: ClockError) -> None:
        self.fleet, self.id, self.clock = fleet, drone_id, clock
        self.mission = make(mission_state_t, state=2, animal=-1)
        self.vehicle = make(vehicle_state_t, n_m=10.0 * drone_id, battery=0.5, position_ok=True)
        self.copies: list[Copy] = []
        self.alive = False
        self.start()

    @property
    def now_us(self) -> int:
        return self.clock.utime(self.fleet.queue.now_us)

    def start(self) -> None:
        """A relay that has just started, with nothing remembered."""
        self.radio: MemoryRadio = self.fleet.ether.radio(self.id, self.fleet.ids)
        self.core = Relay(
            own_id=self.id,
            roster=self.fleet.roster,
            fleet_key=KEY,
            session=self.radio.session_id(),
            send=self.radio.send,
            reachable=self.fleet.ids,
            bytes_per_s=self.fleet.bytes_per_s,
            lost_after_s=3.0,
            now_us=self.now_us,
        )
        self.radio.on_arrival(self._arrived)
        self.alive = True
        self.fleet.after(TICK_S * self.fleet.random.random(), lambda core=self.core: self._tick(core))

    def die(self) -> None:
        self.alive = False
        self.radio.close()

    def say(self, channel: channels.Channel, message: Any) -> None:
        message.utime, message.drone_id = self.now_us, self.id
        payload = len(getattr(message, "packet", b""))
        self.core.say(channel, message.encode(), message.utime, payload, self.now_us)

    @property
    def state(self) -> fleet_state_t:
        return self.core.fleet_state(self.now_us)

    @property
    def fleet_us(self) -> int:
        return self.now_us + int(self.state.fleet_offset_us)

    def row(self, drone_id: int) -> Any:
        return next(row for row in self.state.rows if row.id == drone_id)

    def _arrived(self) -> None:
        for data in self.radio.receive():
            copy = self.core.receive(data, self.now_us)
            if copy is not None:
                self.copies.append(copy)

    def _tick(self, core: Relay) -> None:
        if self.alive and core is self.core:
            if self.id:
                self.vehicle.utime = self.now_us
                self.core.describe(self.mission, self.vehicle, self.now_us)
            self.core.tick(self.now_us)
            self.core.pump(self.now_us)
            self.fleet.after(TICK_S, lambda: self._tick(core))


class Fleet:
    """Drones with clocks that are off by up to 2 s and drift by up to 50 ppm, on one ether."""

    def __init__(
        self,
        n: int,
        loss: float = 0.0,
        seed: int = 1,
        boat: bool = False,
        bytes_per_s: int = 6000,
        jitter_s: float = 0.005,
    ) -> None:
        self.queue, self.random, self.bytes_per_s = EventQueue(), np.random.default_rng(seed), bytes_per_s
        self.roster = tuple(range(1, n + 1))
        self.ids = (0, *self.roster) if boat else self.roster
        self.ether = MemoryEther(self.random, self.after, latency_s=0.005, jitter_s=jitter_s, loss=loss)
        self.drones: dict[int, Drone] = {}
        for drone_id in self.ids:
            offset_us = 500 * S + int(self.random.uniform(-2, 2) * S)
            clock = ClockError(offset_us, self.random.uniform(-50, 50))
            self.drones[drone_id] = Drone(self, drone_id, clock)

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        self.queue.schedule(self.queue.now_us + round(delay_s * S), action)

    def run(self, seconds: float, each_s: Callable[[], None] | None = None) -> None:
        """Let time pass; `each_s` is called once a second."""
        end_us = self.queue.now_us + round(seconds * S)
        while self.queue.now_us < end_us:
            self.queue.run_until(min(end_us, self.queue.now_us + S))
            if each_s is not None:
                each_s()

    def cut(self, *pairs: tuple[int, int]) -> None:
        """Block these links both ways, and no others."""
        self.ether.blocked = lambda a, b: (a, b) in pairs or (b, a) in pairs

    def __getitem__(self, drone_id: int) -> Drone:
        return self.drones[drone_id]

    @property
    def living(self) -> list[Drone]:
        return [drone for drone in self.drones.values() if drone.alive and drone.id]

    def members(self) -> list[int]:
        return [drone.state.members for drone in self.living]

    def clock_spread_us(self) -> int:
        times = [drone.fleet_us for drone in self.living]
        return max(times) - min(times)


def link(drone: Drone, peer_id: int) -> link_t:
    return next(entry for entry in drone.core.link_state(drone.now_us).links if entry.peer_id == peer_id)
