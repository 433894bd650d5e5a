"""The runtime: what a process's shell may use, and what both executors share.

A shell is a module with `setup(runtime)`. It registers handlers with `on` and `every` and says messages with
`publish`; it never loops, sleeps, reads a clock, opens a socket or starts a thread. Two executors drive it:
`procs.bus_executor` (a select loop on a real bus) and `procs.queue_executor` (a queue in virtual time). Queue
capacity, newest- only and gap counting are done here, the same in both (docs/architecture.md: LCM's own full
queue drops the *newest* message).
"""

import struct
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

from lcmtypes import channels, make
from lcmtypes.podwatch import heartbeat_t
from logs.sequence import GapCounter
from procs.settings import DroneSettings, MissionError

if TYPE_CHECKING:
    import numpy as np

__all__ = ["DEFAULT_CAPACITY", "HEARTBEAT_PERIOD_S", "RawHandler", "Runtime", "RuntimeFailure", "Transport"]

DEFAULT_CAPACITY = 30
HEARTBEAT_PERIOD_S = 1.0

Handler = Callable[[Any], None]
RawHandler = Callable[[str, bytes, int], None]


class RuntimeFailure(Exception):
    """A process cannot start or go on; the message names the cause and the remedy. Exit code 3."""


class Transport(Protocol):
    """An edge that has something to read at times: a socket, or its in-memory counterpart."""

    def fileno(self) -> int: ...


@dataclass
class Subscription:
    """Messages of one channel that wait for their handler."""

    channel: str
    handler: Handler
    newest: bool
    capacity: int
    waiting: deque[tuple[int, bytes]] = field(default_factory=deque)  # (order of arrival, encoded message)
    n_heard: int = 0
    heard_at_beat: int = 0


@dataclass
class Timer:
    """A handler that runs every `period_us` of the drone's clock."""

    period_us: int
    handler: Callable[[], None]
    due_utime: int


class Runtime(ABC):
    """One process of one drone. Executors subclass it; shells see only the public names."""

    def __init__(self, process: str, settings: DroneSettings) -> None:
        self.process = process
        self.settings = settings
        self.drone_id = settings.drone_id
        self._subscriptions: dict[str, Subscription] = {}
        self._raw_handler: RawHandler | None = None
        self._timers: list[Timer] = []
        self._stop_handlers: list[Callable[[], None]] = []
        self._reload_handlers: list[Callable[[], None]] = []
        self._sequence: dict[str, int] = {}
        self._arrivals = 0
        self._trouble: dict[str, str] = {}
        self._gaps = GapCounter()
        self._counts = {"dropped": 0, "bad": 0, "handled": 0}
        self._late_us = 0

    # What a shell uses.

    @property
    @abstractmethod
    def utime(self) -> int:
        """The drone's clock, us: the instant at which the running handler began."""

    @property
    def boot(self) -> str:
        """From which start of the computer `utime` counts, "" where the clock does not say: virtual time."""
        return ""

    @property
    @abstractmethod
    def elapsed_us(self) -> int:
        """How long the running handler has taken so far, us (its nominal time on the virtual clock)."""

    @abstractmethod
    def open(self, name: str) -> Any:
        """The driver that the settings name for this edge ("camera", "radio", ...). Raises RuntimeFailure."""

    @abstractmethod
    def attach(self, transport: Transport, handler: Callable[[], None]) -> None:
        """Call `handler` whenever `transport` has something to read."""

    @abstractmethod
    def publish_raw(self, channel: str, data: bytes) -> None:
        """Say an encoded message as it is."""

    @cached_property
    def random(self) -> "np.random.Generator":
        """This process's own generator, seeded by (run's seed, drone, process)."""
        import numpy as np

        return np.random.default_rng([self.settings.seed, self.drone_id, *self.process.encode()])

    def on(
        self, channel: str, handler: Handler, *, newest: bool = False, capacity: int = DEFAULT_CAPACITY
    ) -> None:
        """Call `handler(message)` for each message of `channel`.

        newest: only the newest message that waits is handled, older ones are dropped and counted. capacity:
        where more wait, the oldest are dropped and counted. Raises ValueError for an unknown channel or a
        second handler.
        """
        if channels.kind_of(channel) is None:
            raise ValueError(f"channel {channel!r} is not in the channel table (lcmtypes/channels.py)")
        if channel in self._subscriptions:
            raise ValueError(f"{self.process} has a handler for {channel} already")
        subscription = Subscription(channel, handler, newest, 1 if newest else capacity)
        self._subscriptions[channel] = subscription
        self._listen(subscription)

    def on_all(self, handler: RawHandler) -> None:
        """Call `handler(channel, data, utime of arrival)` for every message of the bus, undecoded."""
        self._raw_handler = handler
        self._listen_all()

    def every(self, period_s: float, handler: Callable[[], None]) -> None:
        """Call `handler()` every `period_s` seconds of the drone's clock, first one period from now."""
        period_us = round(period_s * 1e6)
        if period_us <= 0:
            raise ValueError(f"a period of {period_s} s: it must be above 0")
        self._timers.append(Timer(period_us, handler, self.utime + period_us))
        self._timer_added()

    def on_stop(self, handler: Callable[[], None]) -> None:
        """Call `handler()` once when the process is asked to end."""
        self._stop_handlers.append(handler)

    def on_reload(self, handler: Callable[[], None]) -> None:
        """Call `handler()` when somebody wants new settings in force; `settings` are the new ones by then."""
        self._reload_handlers.append(handler)

    @abstractmethod
    def aside(self, work: Callable[[], Any], then: Callable[["Future[Any]"], None]) -> None:
        """Do `work()` beside the handlers, which go on, and hand what came of it to the handler `then`.

        For what takes longer than a watchdog waits. `work` changes nothing that a handler uses.
        """

    def publish(self, channel: str, message: Any) -> None:
        """Say `message`; drone_id and seq are filled in, and utime where it is 0."""
        seq = self._sequence.get(channel, 0)
        self._sequence[channel] = seq + 1
        message.drone_id = self.drone_id
        message.seq = seq
        if not message.utime:
            message.utime = self.utime
        self.publish_raw(channel, message.encode())

    def degraded(self, detail: str, cause: str = "") -> None:
        """Say in the heartbeat that something is wrong; `cause` tells one trouble from another."""
        self._trouble[cause] = detail

    def ok(self, cause: str = "") -> None:
        """Take back what `degraded` said of `cause`."""
        self._trouble.pop(cause, None)

    # What the executors fill in.

    @abstractmethod
    def _listen(self, subscription: Subscription) -> None:
        """Begin to hear a channel."""

    @abstractmethod
    def _listen_all(self) -> None:
        """Begin to hear every channel."""

    def _timer_added(self) -> None:  # noqa: B027 - only one executor needs to know
        """A timer was registered."""

    def _vital_signs(self) -> tuple[int, float, float]:
        """(pid, cores used since the last call, MB resident); zeros on the virtual clock."""
        return 0, 0.0, 0.0

    # What both share.

    def _arrive(self, subscription: Subscription, data: bytes) -> None:
        """Queue one message, dropping the oldest beyond the capacity."""
        subscription.n_heard += 1
        self._gaps.see(subscription.channel, data)
        self._arrivals += 1
        subscription.waiting.append((self._arrivals, data))
        while len(subscription.waiting) > subscription.capacity:
            subscription.waiting.popleft()
            self._counts["dropped"] += 1

    def _next_waiting(self) -> Subscription | None:
        """The subscription whose oldest message arrived first."""
        waiting = [subscription for subscription in self._subscriptions.values() if subscription.waiting]
        return min(waiting, key=lambda subscription: subscription.waiting[0][0]) if waiting else None

    def _handle_one(self, subscription: Subscription) -> None:
        """Decode and handle the oldest message of a subscription; one that does not decode is counted."""
        _, data = subscription.waiting.popleft()
        kind = channels.kind_of(subscription.channel)
        assert kind is not None
        try:
            message = kind.decode(data)
        except (ValueError, struct.error, IndexError, UnicodeDecodeError, MemoryError) as error:
            self._counts["bad"] += 1
            self.degraded(
                f"{subscription.channel}: a message of {len(data)} bytes does not decode as {kind.__name__} "
                f"({error}); is every process of the same podwatch version?",
                cause=f"decode {subscription.channel}",
            )
            return
        self._counts["handled"] += 1
        subscription.handler(message)

    def _due_timer(self, utime: int) -> Timer | None:
        """The timer that has been due longest, None where none is due."""
        due = [timer for timer in self._timers if timer.due_utime <= utime]
        return min(due, key=lambda timer: timer.due_utime) if due else None

    def _run_timer(self, timer: Timer, utime: int) -> None:
        """Run a due timer; beats that were missed are skipped, the phase is kept."""
        late_us = utime - timer.due_utime
        self._late_us = max(self._late_us, late_us)
        timer.due_utime += timer.period_us * (1 + late_us // timer.period_us)
        self._counts["handled"] += 1
        timer.handler()

    def _beat(self) -> None:
        """Say HEARTBEAT: the runtime's own account of this process."""
        pid, cpu, memory_mb = self._vital_signs()
        heard = sorted(self._subscriptions.values(), key=lambda subscription: subscription.channel)
        rates = [(s.n_heard - s.heard_at_beat) / HEARTBEAT_PERIOD_S for s in heard]
        for subscription in heard:
            subscription.heard_at_beat = subscription.n_heard
        self.publish(
            channels.HEARTBEAT,
            make(
                heartbeat_t,
                process=self.process,
                pid=pid,
                status=heartbeat_t.DEGRADED if self._trouble else heartbeat_t.OK,
                detail="; ".join(self._trouble[cause] for cause in sorted(self._trouble))[:400],
                loop_hz=self._counts["handled"] / HEARTBEAT_PERIOD_S,
                late_ms=self._late_us / 1000,
                cpu=cpu,
                memory_mb=memory_mb,
                n_gaps=self._gaps.n_lost,
                n_dropped=self._counts["dropped"],
                n_bad=self._counts["bad"],
                n_rates=len(heard),
                rate_names=[subscription.channel for subscription in heard],
                rates_hz=rates,
            ),
        )
        self._counts["handled"] = 0
        self._late_us = 0
        for cause in [cause for cause in self._trouble if cause.startswith("decode ")]:
            del self._trouble[cause]

    def _reload(self, read: Callable[[], DroneSettings]) -> None:
        """Put new settings in force for the handlers that asked; those that cannot be read change nothing."""
        if not self._reload_handlers:
            return
        try:
            self.settings = read()
        except MissionError as error:
            self.degraded(f"{error}; the old settings stay in force", cause="reload settings")
            return
        self.ok("reload settings")
        for handler in self._reload_handlers:
            handler()

    @staticmethod
    def _outcome(work: Callable[[], Any]) -> "Future[Any]":
        """What `work()` gives, or its error."""
        done: Future[Any] = Future()
        try:
            done.set_result(work())
        except Exception as error:  # whatever it is: the handler that waits for it must know
            done.set_exception(error)
        return done

    def _stop(self) -> None:
        """Run the stop handlers, last registered first."""
        while self._stop_handlers:
            self._stop_handlers.pop()()
