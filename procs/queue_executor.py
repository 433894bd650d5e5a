"""The executor in virtual time: every process of every drone in one operating-system process, one event
queue.

Events are ordered by (time, drone, process, sequence of scheduling), so the same seed gives the same run. A
handler that says something takes its process's nominal compute time (process table): what it said arrives
that much later, and the process is busy until then. Messages cross as encoded bytes and each hearer decodes
its own copy, as on a real bus.
"""

import heapq
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from procs import processes
from procs.runtime import HEARTBEAT_PERIOD_S, Runtime, RuntimeFailure, Subscription, Timer, Transport
from procs.settings import DroneSettings

__all__ = ["ClockError", "EventQueue", "QueueRuntime", "VirtualBus"]

PROCESS_RANK = {process.name: rank for rank, process in enumerate(processes.PROCESSES)}


class EventQueue:
    """Virtual time in microseconds and what happens next."""

    def __init__(self) -> None:
        self.now_us = 0
        self._heap: list[tuple[int, int, int, int, Callable[[], None]]] = []
        self._n_scheduled = 0

    def schedule(self, at_us: int, action: Callable[[], None], *, drone: int = 0, rank: int = 0) -> None:
        """Run `action` at `at_us`, never before what is due now."""
        self._n_scheduled += 1
        heapq.heappush(self._heap, (max(at_us, self.now_us), drone, rank, self._n_scheduled, action))

    def run_until(self, end_us: int) -> None:
        """Run every event up to and at `end_us`."""
        while self._heap and self._heap[0][0] <= end_us:
            self.now_us, _, _, _, action = heapq.heappop(self._heap)
            action()
        self.now_us = max(self.now_us, end_us)


@dataclass(frozen=True)
class ClockError:
    """How one drone's clock runs beside virtual time."""

    offset_us: int = 0
    drift_ppm: float = 0.0

    def utime(self, true_us: int) -> int:
        """The drone's clock at virtual time `true_us`."""
        return self.offset_us + true_us + round(true_us * self.drift_ppm * 1e-6)

    def true_us(self, utime: int) -> int:
        """The first virtual time at which the drone's clock shows `utime`."""
        guess = round((utime - self.offset_us) / (1 + self.drift_ppm * 1e-6))
        while self.utime(guess) < utime:
            guess += 1
        while self.utime(guess - 1) >= utime:  # a slow clock shows the same instant twice now and then
            guess -= 1
        return guess


class VirtualBus:
    """One drone's bus: hands every message to every process that listens."""

    def __init__(self, queue: EventQueue) -> None:
        self.queue = queue
        self._hearers: dict[str, list[tuple[QueueRuntime, Subscription]]] = {}
        self._hear_all: list[QueueRuntime] = []
        self.observers: list[Callable[[str, bytes], None]] = []  # who only looks on, outside the drone

    def listen(self, runtime: "QueueRuntime", subscription: Subscription) -> None:
        self._hearers.setdefault(subscription.channel, []).append((runtime, subscription))

    def listen_all(self, runtime: "QueueRuntime") -> None:
        self._hear_all.append(runtime)

    def leave(self, runtime: "QueueRuntime") -> None:
        """A process has ended: it hears nothing any more."""
        for channel, hearers in self._hearers.items():
            self._hearers[channel] = [pair for pair in hearers if pair[0] is not runtime]
        self._hear_all = [other for other in self._hear_all if other is not runtime]

    def deliver(self, channel: str, data: bytes) -> None:
        """Arrival of one message at all hearers, now."""
        for runtime, subscription in self._hearers.get(channel, ()):
            runtime.message_arrived(subscription, data)
        for runtime in self._hear_all:
            runtime.raw_arrived(channel, data)
        for observe in self.observers:
            observe(channel, data)


class QueueRuntime(Runtime):
    """One process of one drone in virtual time."""

    def __init__(
        self,
        process: str,
        settings: DroneSettings,
        bus: VirtualBus,
        clock: ClockError,
        drivers: dict[str, Callable[[str], Any]],
    ) -> None:
        super().__init__(process, settings)
        self._bus = bus
        self._queue = bus.queue
        self._clock = clock
        self._drivers = drivers
        self._compute_us = round(processes.BY_NAME[process].compute_s * 1e6)
        self._rank = PROCESS_RANK[process]
        self._began_us = bus.queue.now_us
        self._said: list[tuple[str, bytes]] = []
        self._busy_until_us = 0
        self._run_at_us: int | None = None
        self._ready_transports: list[Callable[[], None]] = []
        self._alive = True

    @property
    def utime(self) -> int:
        return self._clock.utime(self._began_us)

    @property
    def elapsed_us(self) -> int:
        return self._compute_us

    def open(self, name: str) -> Any:
        if name not in self._drivers:
            have = ", ".join(sorted(self._drivers)) or "none"
            raise RuntimeFailure(f"{self.process}: there is no driver for {name!r} (there are: {have})")
        return self._drivers[name](self.process)

    def attach(self, transport: Transport, handler: Callable[[], None]) -> None:
        transport.on_arrival(lambda: self._transport_arrived(handler))  # type: ignore[attr-defined]

    def aside(self, work: Callable[[], Any], then: Callable[["Future[Any]"], None]) -> None:
        then(self._outcome(work))  # virtual time stands still meanwhile

    def publish_raw(self, channel: str, data: bytes) -> None:
        self._said.append((channel, data))

    def start(self) -> None:
        """Begin to beat and to run timers; call after the shell's setup."""
        self.every(HEARTBEAT_PERIOD_S, self._beat)
        self._beat()
        self._flush(0)

    def reload(self, settings: DroneSettings) -> None:
        """Put new settings in force now."""
        self._began_us = self._queue.now_us
        self._reload(lambda: settings)

    def kill(self) -> None:
        """End at once, without stop handlers, as kill -9 does."""
        self._alive = False
        self._bus.leave(self)

    def stop(self) -> None:
        """End cleanly."""
        self._began_us = self._queue.now_us
        self._stop()
        said, self._said = self._said, []
        for channel, data in said:
            self._bus.deliver(channel, data)
        self.kill()

    def message_arrived(self, subscription: Subscription, data: bytes) -> None:
        """A message for one of our handlers has arrived."""
        self._arrive(subscription, data)
        self._wake()

    def raw_arrived(self, channel: str, data: bytes) -> None:
        """A message of the bus, for the handler of everything."""
        self._began_us = self._queue.now_us
        self._counts["handled"] += 1
        assert self._raw_handler is not None
        self._raw_handler(channel, data, self.utime)
        self._flush(self._compute_us)

    def _listen(self, subscription: Subscription) -> None:
        self._bus.listen(self, subscription)

    def _listen_all(self) -> None:
        self._bus.listen_all(self)

    def _timer_added(self) -> None:
        self._schedule_timer(self._timers[-1])

    def _schedule_timer(self, timer: Timer) -> None:
        self._queue.schedule(
            self._clock.true_us(timer.due_utime),
            lambda: self._timer_due(timer),
            drone=self.drone_id,
            rank=self._rank,
        )

    def _timer_due(self, timer: Timer) -> None:
        if not self._alive:
            return
        if self._busy_until_us > self._queue.now_us:
            at_us = self._busy_until_us
            self._queue.schedule(at_us, lambda: self._timer_due(timer), drone=self.drone_id, rank=self._rank)
            return
        self._began_us = self._queue.now_us
        self._run_timer(timer, self.utime)
        self._flush(self._compute_us if timer.handler != self._beat else 0)
        self._schedule_timer(timer)

    def _transport_arrived(self, handler: Callable[[], None]) -> None:
        if self._alive:
            if handler not in self._ready_transports:
                self._ready_transports.append(handler)
            self._wake()

    def _wake(self) -> None:
        """Run as soon as the process is free."""
        if self._run_at_us is not None:
            return
        self._run_at_us = max(self._queue.now_us, self._busy_until_us)
        self._queue.schedule(self._run_at_us, self._run_one, drone=self.drone_id, rank=self._rank)

    def _run_one(self) -> None:
        self._run_at_us = None
        if not self._alive:
            return
        if self._busy_until_us > self._queue.now_us:
            self._wake()
            return
        self._began_us = self._queue.now_us
        if self._ready_transports:
            self._ready_transports.pop(0)()
        else:
            subscription = self._next_waiting()
            if subscription is not None:
                self._handle_one(subscription)
        self._flush(self._compute_us)
        if self._ready_transports or self._next_waiting() is not None:
            self._wake()

    def _flush(self, compute_us: int) -> None:
        """Send what the handler said, after its compute time; a silent handler costs nothing."""
        if not self._said:
            return
        said, self._said = self._said, []
        self._busy_until_us = self._queue.now_us + compute_us
        bus = self._bus

        def arrive() -> None:
            if not self._alive:  # killed while it still computed
                return
            for channel, data in said:
                bus.deliver(channel, data)

        self._queue.schedule(self._busy_until_us, arrive, drone=self.drone_id, rank=self._rank)
