"""The executor on a real bus: one process, one select loop, one LCM handle.

Traps of lcm 1.5.3 that shape it: a signal during `handle()` raises OSError, so the loop waits in select,
handles only what is there, and looks again where a signal still fell into it; the C queue drops the newest
message when it is full, so it is made deep and drained at once into the runtime's own queues; an LCM made
before a fork is broken, so it is made here, after the process has started.
"""

import importlib
import os
import select
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import lcm

from procs.notify import Notifier
from procs.runtime import HEARTBEAT_PERIOD_S, Runtime, RuntimeFailure, Subscription, Transport
from procs.settings import DriverSpec, DroneSettings

__all__ = ["ROUTE_COMMAND", "BusRuntime", "load_driver"]

# A route for the groups of all drones (docs/architecture.md), over the loopback: a bus stays on its drone.
ROUTE_COMMAND = "ip route replace 239.255.76.0/24 dev lo"

# Deep enough for the longest handler: messages wait in C for as long as one handler runs.
C_QUEUE_CAPACITY = 2000
MOST_FAILED_TAKES = 100  # in a row: so many signals never fall into LCM's system calls
LONGEST_WAIT_S = 0.5
SELF_TEST = "LCM_SELF_TEST"  # what each new LCM says to itself, to see whether there is a route
# A process that a stop signal finds inside a hung handler is ended by the kernel after this long.
HARD_STOP_S = 4.0
DEFAULT_CLOCK = DriverSpec(driver="drivers.clocks.monotonic:MonotonicClock")


def load_driver(spec: DriverSpec) -> Any:
    """The driver that `spec` names, made with its options. Raises RuntimeFailure naming what is wrong.

    A driver is any class that the settings name: whatever goes wrong in its making is the settings' fault or
    the machine's.
    """
    module, _, name = spec.driver.partition(":")
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise RuntimeFailure(
            f"driver {spec.driver}: cannot be loaded ({error}); check its name in the settings"
        ) from error
    try:
        return factory(**spec.options)
    except Exception as error:
        said = str(error) or type(error).__name__
        raise RuntimeFailure(f"driver {spec.driver}: {said} (its options are in the settings)") from error


class BusRuntime(Runtime):
    """One process on its drone's multicast group."""

    def __init__(self, process: str, settings: DroneSettings, settings_path: Path | None = None) -> None:
        """`settings_path`: where SIGHUP finds new ones."""
        self._settings_path = settings_path
        self._reload_asked = False
        self._clock = load_driver(settings.drivers.get("clock", DEFAULT_CLOCK))
        self._now: int = self._clock.utime()
        super().__init__(process, settings)
        try:
            self._lcm = lcm.LCM(settings.bus_url)
        except RuntimeError as error:
            raise RuntimeFailure(
                f"no bus at {settings.bus_url} ({error}); is there a multicast route? "
                f"As root: {ROUTE_COMMAND}"
            ) from error
        self._transports: list[tuple[Transport, Callable[[], None]]] = []
        self._ready: list[Any] = []
        self._raw: list[tuple[str, bytes]] = []
        self._failed_takes = 0
        self._running = True
        self._done_aside: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._notifier = Notifier()
        self._cpu_s = 0.0
        self._cpu_utime = self._now
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_write, False)

    @property
    def utime(self) -> int:
        return self._now

    @property
    def elapsed_us(self) -> int:
        return int(self._clock.utime()) - self._now

    @property
    def boot(self) -> str:
        return str(getattr(self._clock, "boot", ""))

    def open(self, name: str) -> Any:
        spec = self.settings.drivers.get(name)
        if spec is None:
            have = ", ".join(sorted(self.settings.drivers)) or "none"
            raise RuntimeFailure(
                f"{self.process}: the settings name no driver for {name!r} (they name: {have})"
            )
        return load_driver(spec)

    def attach(self, transport: Transport, handler: Callable[[], None]) -> None:
        self._transports.append((transport, handler))

    def aside(self, work: Callable[[], Any], then: Callable[["Future[Any]"], None]) -> None:
        def run() -> None:
            done = self._outcome(work)
            self._done_aside.put(lambda: then(done))
            with suppress(BlockingIOError):  # full: there is enough in it to wake us
                os.write(self._wake_write, b"\0")

        # A daemon: a process that is told to end does not wait for it.
        threading.Thread(target=run, daemon=True).start()

    def publish_raw(self, channel: str, data: bytes) -> None:
        self._lcm.publish(channel, data)

    def _listen(self, subscription: Subscription) -> None:
        handle = self._lcm.subscribe(
            subscription.channel, lambda _channel, data: self._arrive(subscription, data)
        )
        handle.set_queue_capacity(C_QUEUE_CAPACITY)

    def _listen_all(self) -> None:
        handle = self._lcm.subscribe(".*", self._hear_raw)
        handle.set_queue_capacity(C_QUEUE_CAPACITY)

    def _hear_raw(self, channel: str, data: bytes) -> None:
        if channel != SELF_TEST:
            self._raw.append((channel, data))

    def _vital_signs(self) -> tuple[int, float, float]:
        times = os.times()
        cpu_s = times.user + times.system
        elapsed_s = (self._now - self._cpu_utime) / 1e6
        # The first beat says nothing yet of what is used: it comes right after the start.
        used = (cpu_s - self._cpu_s) / elapsed_s if elapsed_s > HEARTBEAT_PERIOD_S / 2 else 0.0
        self._cpu_s, self._cpu_utime = cpu_s, self._now
        with open("/proc/self/statm") as statm:
            pages = int(statm.read().split()[1])
        return os.getpid(), used, pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def stop(self) -> None:
        """End the loop after the handler that runs."""
        self._running = False

    def run(self) -> None:
        """Run until a SIGTERM or SIGINT, then run the stop handlers. SIGHUP reads the settings again
        where a handler wants them.
        """
        signal.set_wakeup_fd(self._wake_write)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._signalled)
        if self._reload_handlers:
            signal.signal(signal.SIGHUP, self._ask_reload)
        self._now = self._clock.utime()
        for timer in self._timers:  # a slow setup is no lateness
            timer.due_utime = self._now + timer.period_us
        self.every(HEARTBEAT_PERIOD_S, self._beat)
        self._beat()
        while self._running:
            self._wait()
            self._drain()
            self._read_transports()
            self._reload_if_asked()
            self._take_what_is_done()
            self._run_due()
        self._notifier.stopping()
        self._stop()

    def _beat(self) -> None:
        super()._beat()
        self._notifier.beat("; ".join(self._trouble.values()) or "ok")

    def _signalled(self, _number: int, _frame: object) -> None:
        self._running = False
        signal.setitimer(signal.ITIMER_REAL, HARD_STOP_S)

    def _ask_reload(self, _number: int, _frame: object) -> None:
        self._reload_asked = True

    def _reload_if_asked(self) -> None:
        if not self._reload_asked:
            return
        self._reload_asked = False
        path = self._settings_path
        self._reload(lambda: DroneSettings.read(path) if path is not None else self.settings)

    def _wait(self) -> None:
        """Wait until the bus, a transport, a signal or the next timer has something for us."""
        self._now = self._clock.utime()
        due = min(timer.due_utime for timer in self._timers)
        wait_s = min(max(self._clock.real_seconds((due - self._now) / 1e6), 0.0), LONGEST_WAIT_S)
        if self._next_waiting() is not None:
            wait_s = 0.0
        sources: list[Any] = [self._lcm, self._wake_read, *(transport for transport, _ in self._transports)]
        self._ready, _, _ = select.select(sources, [], [], wait_s)

    def _drain(self) -> None:
        """Take what waits out of LCM's queue, so that it never fills."""
        self._now = self._clock.utime()
        if self._wake_read in self._ready:
            os.read(self._wake_read, 1024)
        for _ in range(C_QUEUE_CAPACITY):  # a flood that never ends must not keep the timers waiting
            if not self._running or not self._take_from_lcm():
                break
        if self._raw and self._raw_handler is not None:
            raw, self._raw = self._raw, []
            self._counts["handled"] += len(raw)
            for channel, data in raw:
                self._raw_handler(channel, data, self._now)

    def _take_from_lcm(self) -> bool:
        """One message out of LCM's queue into ours; False where none waits, or a signal came between."""
        try:
            taken = self._lcm.handle_timeout(0) > 0
        except OSError:
            # A signal inside LCM's own system calls looks like this, and loses nothing; a dead bus lasts.
            self._failed_takes += 1
            if self._failed_takes > MOST_FAILED_TAKES:
                raise
            return False
        self._failed_takes = 0
        return taken

    def _read_transports(self) -> None:
        for transport, handler in self._transports:
            if transport in self._ready:
                self._now = self._clock.utime()
                handler()

    def _take_what_is_done(self) -> None:
        while not self._done_aside.empty():
            self._now = self._clock.utime()
            self._done_aside.get()()

    def _run_due(self) -> None:
        """One message, then every due timer: a flood of messages never starves the timers."""
        subscription = self._next_waiting()
        if subscription is not None:
            self._now = self._clock.utime()
            self._handle_one(subscription)
        for _ in self._timers:
            self._now = self._clock.utime()
            timer = self._due_timer(self._now)
            if timer is None:
                return
            self._clock.late((self._now - timer.due_utime) / 1e6)
            self._run_timer(timer, self._now)
