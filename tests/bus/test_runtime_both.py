"""The same shell on both executors: a real bus in a select loop, and the queue in virtual time.

The drone's clock of the real executor runs ten times as fast as the wall's, which saves time.
"""

import signal
import socket
import time
from pathlib import Path
from typing import Any, Protocol

import lcm
import pytest

from drivers.sim.clock import ClockPage
from lcmtypes import channels, make
from lcmtypes.podwatch import heartbeat_t, setpoint_t, track_t, vehicle_state_t
from procs.bus_executor import BusRuntime
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.runtime import Runtime, RuntimeFailure
from procs.settings import DriverSpec, DroneSettings, Mission

RATE = 10.0
DEADLINE_S = 20.0
QUIET_MS = 300
PROCESS = "navigator"


class Bench(Protocol):
    """One process on its bus, and somebody who says things to it beforehand."""

    runtime: Runtime

    def say(self, channel: str, data: bytes) -> None:
        """Something that waits for the process when it begins."""

    def run(self, seconds: float) -> list[tuple[str, bytes]]:
        """Let the process live so long by its own clock -> all that was on the bus meanwhile."""


class BusBench:
    def __init__(self, folder: Path) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("", 0))
            url = f"udpm://239.255.76.191:{probe.getsockname()[1]}?ttl=0&recv_buf_size=4194304"
        page = folder / "clock"
        self._page = ClockPage(page, create=True)
        clock = DriverSpec(driver="drivers.sim.clock:SimClock", options={"page": str(page), "offset_us": 7})
        settings = DroneSettings(drone_id=3, mission=Mission(), bus_url=url, drivers={"clock": clock})
        self._others = lcm.LCM(url)
        self._others.subscribe(".*", self._heard).set_queue_capacity(5000)
        self._said: list[tuple[str, bytes]] = []
        self._n_said = 0
        self.runtime = BusRuntime(PROCESS, settings)

    def say(self, channel: str, data: bytes) -> None:
        self._others.publish(channel, data)
        self._n_said += 1

    def run(self, seconds: float) -> list[tuple[str, bytes]]:
        runtime = self.runtime
        deadline = time.monotonic() + DEADLINE_S
        while runtime._arrivals + len(runtime._raw) < self._n_said:
            assert time.monotonic() < deadline, "the bus lost a message"
            runtime._lcm.handle_timeout(100)
        self._page.set(0.0, RATE)
        self.runtime.every(seconds, self.runtime.stop)
        kept = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            self.runtime.run()
        finally:
            signal.set_wakeup_fd(-1)
            for number, handler in kept.items():
                signal.signal(number, handler)
        while self._others.handle_timeout(QUIET_MS) > 0:  # the last words may still be on their way
            pass
        return self._said

    def _heard(self, channel: str, data: bytes) -> None:
        self._said.append((channel, data))


class QueueBench:
    def __init__(self, _folder: Path) -> None:
        self._queue = EventQueue()
        self._bus = VirtualBus(self._queue)
        self._said: list[tuple[str, bytes]] = []
        self._bus.observers.append(lambda channel, data: self._said.append((channel, data)))
        settings = DroneSettings(drone_id=3, mission=Mission())
        self.runtime = QueueRuntime(PROCESS, settings, self._bus, ClockError(7), {})

    def say(self, channel: str, data: bytes) -> None:
        self._queue.schedule(0, lambda: self._bus.deliver(channel, data))

    def run(self, seconds: float) -> list[tuple[str, bytes]]:
        self.runtime.start()
        self._queue.run_until(round(seconds * 1e6))
        self.runtime.stop()
        return self._said


@pytest.fixture(params=[BusBench, QueueBench])
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Bench:
    return request.param(tmp_path)


def track(seq: int, utime: int | None = None) -> bytes:
    return make(track_t, utime=utime or seq + 1, seq=seq, drone_id=3, animal=seq % 100).encode()


def beats(said: list[tuple[str, bytes]], process: str = PROCESS) -> list[heartbeat_t]:
    heard = [heartbeat_t.decode(data) for channel, data in said if channel == channels.HEARTBEAT]
    return [beat for beat in heard if beat.process == process]


def test_newest_only_handles_the_last_of_what_waits_and_counts_the_rest(bench):
    handled: list[int] = []
    bench.runtime.on(channels.TRACK, lambda message: handled.append(message.seq), newest=True)
    for seq in range(40):
        bench.say(channels.TRACK, track(seq))
    last = beats(bench.run(2.5))[-1]
    assert handled == [39]
    assert (last.n_dropped, last.n_gaps, last.n_bad) == (39, 0, 0)


def test_what_came_during_a_slow_handler_is_taken_at_once_and_the_newest_comes_next(tmp_path):
    bench = BusBench(tmp_path)
    handled: list[int] = []

    def slow(message: track_t) -> None:
        for seq in range(1, 201) if not handled else ():
            bench._others.publish(channels.TRACK, track(seq))
        handled.append(message.seq)
        deadline = time.monotonic() + DEADLINE_S
        while sum(channel == channels.TRACK for channel, _ in bench._said) < 201:
            assert time.monotonic() < deadline, "the bus lost a message"
            bench._others.handle_timeout(100)

    bench.runtime.on(channels.TRACK, slow, newest=True)
    bench.say(channels.TRACK, track(0))
    last = beats(bench.run(3.0))[-1]
    assert (handled[0], handled[-1]) == (0, 200)
    assert len(handled) < 10, "LCM's own thread may hand over the last few a moment later"
    assert last.n_dropped == 201 - len(handled)


def test_a_full_queue_drops_the_oldest_and_counts_it(bench):
    handled: list[int] = []
    bench.runtime.on(channels.TRACK, lambda message: handled.append(message.seq), capacity=5)
    for seq in range(12):
        bench.say(channels.TRACK, track(seq))
    assert beats(bench.run(2.5))[-1].n_dropped == 7
    assert handled == [7, 8, 9, 10, 11]


def test_messages_of_several_channels_are_handled_in_the_order_of_their_arrival(bench):
    handled: list[tuple[str, int]] = []
    bench.runtime.on(channels.TRACK, lambda message: handled.append(("track", message.seq)))
    bench.runtime.on(channels.SETPOINT, lambda message: handled.append(("setpoint", message.seq)))
    for seq in range(4):
        bench.say(channels.TRACK, track(seq))
        bench.say(channels.SETPOINT, make(setpoint_t, utime=1, seq=seq).encode())
    bench.run(1.5)
    assert handled == [(kind, seq) for seq in range(4) for kind in ("track", "setpoint")]


def test_a_gap_in_seq_is_counted_but_neither_a_new_publisher_nor_an_overtaken_message(bench):
    bench.runtime.on(channels.TRACK, lambda _message: None)
    # 4 and 5 are missing; 7 comes late, after 8 (so one is missing before 8); then a publisher starts anew.
    said = [(2, 2), (3, 3), (6, 6), (8, 8), (7, 7), (9, 9), (0, 100), (1, 101)]
    for seq, utime in said:
        bench.say(channels.TRACK, track(seq, utime))
    assert beats(bench.run(2.5))[-1].n_gaps == 3


def test_each_process_counts_its_own_heartbeats(bench):
    bench.runtime.on(channels.HEARTBEAT, lambda _message: None)
    for seq in (0, 1, 2):
        for process in ("camera", "relay", "logger"):
            if (process, seq) != ("relay", 1):
                beat = make(heartbeat_t, utime=seq + 1, seq=seq, drone_id=3, process=process)
                bench.say(channels.HEARTBEAT, beat.encode())
    assert beats(bench.run(2.5))[-1].n_gaps == 1  # of the relay's second


@pytest.mark.parametrize("data", [b"", b"no message", track(1)[:-3], b"\0" * 60], ids=len)
def test_what_does_not_decode_is_counted_named_once_and_leaves_the_process_alone(bench, data):
    handled: list[int] = []
    bench.runtime.on(channels.TRACK, lambda message: handled.append(message.seq))
    for each in (track(1), data, track(2)):
        bench.say(channels.TRACK, each)
    first, second, third = beats(bench.run(2.9))
    assert handled == [1, 2]
    assert (first.status, first.detail) == (heartbeat_t.OK, "")
    assert (second.status, second.n_bad) == (heartbeat_t.DEGRADED, 1)
    assert f"TRACK: a message of {len(data)} bytes does not decode as track_t" in second.detail
    assert (third.status, third.detail, third.n_bad) == (heartbeat_t.OK, "", 1)


def test_trouble_is_said_for_as_long_as_it_lasts(bench):
    runtime = bench.runtime
    runtime.degraded("the lens is covered", cause="lens")
    runtime.degraded("the disk is full", cause="disk")
    runtime.every(1.5, lambda: runtime.ok("lens"))
    first, second, third = beats(bench.run(2.9))
    assert first.detail == second.detail == "the disk is full; the lens is covered"
    assert (third.status, third.detail) == (heartbeat_t.DEGRADED, "the disk is full")


def test_the_heartbeat_tells_what_is_heard_and_how_often(bench):
    bench.runtime.on(channels.TRACK, lambda _message: None)
    bench.runtime.on(channels.VEHICLE_STATE, lambda _message: None)
    for seq in range(6):
        bench.say(channels.TRACK, track(seq))
    first, second = beats(bench.run(1.8))
    assert (second.drone_id, second.process) == (3, PROCESS)
    assert first.rate_names == second.rate_names == ["TRACK", "VEHICLE_STATE"]
    rates = [sum(pair) for pair in zip(first.rates_hz, second.rates_hz, strict=True)]
    assert rates == [6.0, 0.0]
    assert second.loop_hz >= 6


def test_a_timer_keeps_its_phase_and_skips_the_beats_that_it_missed(bench):
    runtime = bench.runtime
    periods: list[int] = []
    due = {"phase": -1}

    def handle() -> None:
        (timer,) = [timer for timer in runtime._timers if timer.handler is handle]
        if due["phase"] < 0:
            due["phase"], due["began"] = timer.due_utime % 100_000, timer.due_utime
        assert timer.due_utime % 100_000 == due["phase"]
        assert timer.due_utime > runtime.utime  # the next beat lies ahead: none is made up for
        periods.append(timer.due_utime // 100_000)
        runtime.publish(channels.SETPOINT, setpoint_t())
        if len(periods) == 2:
            hold_up(runtime, 0.35)

    runtime.every(0.1, handle)
    bench.run(1.95)
    assert periods == sorted(set(periods))
    assert len(periods) <= 19 - 2
    assert periods[2] - periods[1] >= 3


def hold_up(runtime: Runtime, seconds: float) -> None:
    """Be busy for so long: real time on the real bus, compute time on the queue."""
    if isinstance(runtime, QueueRuntime):
        compute_us, runtime._compute_us = runtime._compute_us, round(seconds * 1e6)
        runtime._flush(runtime._compute_us)
        runtime._compute_us = compute_us
    else:
        while runtime.elapsed_us < seconds * 1e6:
            pass


def test_a_late_timer_is_told_in_the_heartbeat(bench):
    runtime = bench.runtime
    runtime.every(0.2, lambda: None)
    calls: list[int] = []

    def slow() -> None:
        calls.append(runtime.utime)
        if len(calls) == 3:
            runtime.publish(channels.SETPOINT, setpoint_t())
            hold_up(runtime, 0.5)

    runtime.every(0.11, slow)
    assert beats(bench.run(1.9))[1].late_ms > 250


def test_publish_fills_in_who_when_and_the_count_of_each_channel(bench):
    runtime = bench.runtime

    def speak() -> None:
        runtime.publish(channels.TRACK, track_t())
        runtime.publish(channels.SETPOINT, make(setpoint_t, utime=5))

    runtime.every(0.5, speak)
    said = bench.run(1.3)
    tracks = [track_t.decode(data) for channel, data in said if channel == channels.TRACK]
    setpoints = [setpoint_t.decode(data) for channel, data in said if channel == channels.SETPOINT]
    assert [message.seq for message in tracks] == [message.seq for message in setpoints] == [0, 1]
    assert all(message.drone_id == 3 for message in (*tracks, *setpoints))
    assert tracks[0].utime >= 500_007
    assert [message.utime for message in setpoints] == [5, 5]


def test_whoever_hears_everything_hears_every_byte_of_every_channel(bench):
    heard: list[tuple[str, bytes]] = []
    bench.runtime.on_all(lambda channel, data, _utime: heard.append((channel, data)))
    said = [(channels.TRACK, track(1)), (channels.received(2, channels.RING_MAP), b"raw"), ("ODD", b"")]
    for channel, data in said:
        bench.say(channel, data)
    bench.run(0.5)
    assert [pair for pair in heard if pair[0] != channels.HEARTBEAT] == said


def test_a_clean_stop_runs_the_stop_handlers_last_registered_first_and_their_words_arrive(bench):
    runtime = bench.runtime
    order: list[str] = []
    runtime.on_stop(lambda: order.append("first registered"))
    runtime.on_stop(lambda: order.append("last registered"))
    runtime.on_stop(lambda: runtime.publish(channels.SETPOINT, make(setpoint_t, kind=setpoint_t.HOLD)))
    said = bench.run(0.3)
    assert order == ["last registered", "first registered"]
    assert [setpoint_t.decode(data).kind for channel, data in said if channel == channels.SETPOINT] == [
        setpoint_t.HOLD
    ]


def test_a_shell_that_asks_for_what_cannot_be_is_told_so(bench):
    runtime = bench.runtime
    with pytest.raises(ValueError, match="'NOWHERE' is not in the channel table"):
        runtime.on("NOWHERE", lambda _message: None)
    runtime.on(channels.TRACK, lambda _message: None)
    with pytest.raises(ValueError, match="navigator has a handler for TRACK already"):
        runtime.on(channels.TRACK, lambda _message: None)
    with pytest.raises(ValueError, match="a period of 0 s: it must be above 0"):
        runtime.every(0, lambda: None)
    with pytest.raises(RuntimeFailure, match="no driver for 'camera'"):
        runtime.open("camera")


def test_the_generator_of_a_process_is_its_own_and_the_same_in_every_run(bench, tmp_path):
    def draws(seed: int, drone_id: int, process: str) -> Any:
        settings = DroneSettings(drone_id=drone_id, mission=Mission(), seed=seed)
        runtime = QueueRuntime(process, settings, VirtualBus(EventQueue()), ClockError(), {})
        return runtime.random.integers(0, 2**62, 4).tolist()

    own = bench.runtime.random.integers(0, 2**62, 4).tolist()
    assert own == draws(0, 3, PROCESS)
    assert own not in (draws(1, 3, PROCESS), draws(0, 2, PROCESS), draws(0, 3, "relay"))


def test_a_message_that_is_sent_is_another_object_for_each_who_hears_it(bench):
    """As over a real bus, what one handler does to its message changes nobody else's."""
    kept: list[vehicle_state_t] = []
    bench.runtime.on(channels.VEHICLE_STATE, kept.append)
    data = make(vehicle_state_t, utime=1, n_m=4.0).encode()
    bench.say(channels.VEHICLE_STATE, data)
    bench.say(channels.VEHICLE_STATE, data)
    bench.run(0.3)
    kept[0].n_m = 9.0
    assert kept[1].n_m == 4.0
