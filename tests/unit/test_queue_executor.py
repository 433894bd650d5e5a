"""The executor in virtual time: order of events, compute time, clocks, death."""

from hypothesis import example, given, settings
from hypothesis import strategies as st

from lcmtypes import channels, make
from lcmtypes.podwatch import detections_t, heartbeat_t, setpoint_t, track_t
from procs import processes
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.settings import DroneSettings, Mission

MS = 1000


class Drone:
    """A bus of one drone with an observer who notes when each message was on it."""

    def __init__(self, queue: EventQueue | None = None, drone_id: int = 1) -> None:
        self.queue = queue or EventQueue()
        self.bus = VirtualBus(self.queue)
        self.said: list[tuple[int, str, bytes]] = []
        self.bus.observers.append(lambda name, data: self.said.append((self.queue.now_us, name, data)))
        self._settings = DroneSettings(drone_id=drone_id, mission=Mission())

    def process(self, name: str, clock: ClockError | None = None) -> QueueRuntime:
        return QueueRuntime(name, self._settings, self.bus, clock or ClockError(), {})

    def times(self, channel: str) -> list[int]:
        return [at_us for at_us, name, _ in self.said if name == channel]


def compute_us(name: str) -> int:
    return round(processes.BY_NAME[name].compute_s * 1e6)


def test_what_a_handler_says_arrives_when_its_compute_time_is_over():
    drone = Drone()
    detector = drone.process("detector")
    detector.every(0.1, lambda: detector.publish(channels.DETECTIONS, detections_t()))
    drone.queue.run_until(250 * MS)
    cost = compute_us("detector")
    assert cost == 12 * MS
    assert drone.times(channels.DETECTIONS) == [100 * MS + cost, 200 * MS + cost]


def test_a_handler_that_says_nothing_costs_nothing():
    drone = Drone()
    tracker = drone.process("tracker")
    handled: list[int] = []
    tracker.on(channels.SETPOINT, lambda _message: handled.append(drone.queue.now_us))
    for _ in range(5):
        drone.bus.deliver(channels.SETPOINT, setpoint_t().encode())
    drone.queue.run_until(100 * MS)
    assert handled == [0] * 5


def test_a_busy_process_handles_the_next_message_when_it_is_free_and_a_timer_too():
    drone = Drone()
    tracker = drone.process("tracker")
    began: list[int] = []

    def handle(_message: object = None) -> None:
        began.append(drone.queue.now_us)
        tracker.publish(channels.TRACK, track_t())

    tracker.on(channels.SETPOINT, handle)
    tracker.every(0.015, handle)
    for _ in range(2):
        drone.bus.deliver(channels.SETPOINT, setpoint_t().encode())
    drone.queue.run_until(44 * MS)
    # 10 ms a handler: messages at 0 and 10 ms, the timer of 15 ms at 20 ms, that of 30 ms on time.
    assert began == [0, 10 * MS, 20 * MS, 30 * MS]
    assert drone.times(channels.TRACK) == [10 * MS, 20 * MS, 30 * MS, 40 * MS]


def test_a_slow_hearer_of_the_newest_only_works_at_its_own_rate_and_never_behind():
    """20 Hz of frames against a process that needs 150 ms: LCM's own queue would run seconds behind."""
    drone = Drone()
    tracker = drone.process("tracker")
    tracker._compute_us = 150 * MS
    ages: list[int] = []

    def handle(message: setpoint_t) -> None:
        ages.append(drone.queue.now_us - message.utime)
        tracker.publish(channels.TRACK, track_t())

    tracker.on(channels.SETPOINT, handle, newest=True)
    for k in range(100):
        data = make(setpoint_t, utime=k * 50 * MS + 1, seq=k).encode()
        drone.queue.schedule(k * 50 * MS, lambda data=data: drone.bus.deliver(channels.SETPOINT, data))
    drone.queue.run_until(5000 * MS)
    assert len(ages) == 34
    assert max(ages) < 50 * MS


def test_events_of_one_instant_run_by_drone_then_by_the_order_of_the_process_table():
    queue = EventQueue()
    order: list[tuple[int, str]] = []
    for drone_id in (2, 1):
        drone = Drone(queue, drone_id)
        for name in ("logger", "camera", "navigator"):
            runtime = drone.process(name)
            runtime.every(0.1, lambda who=(drone_id, name): order.append(who))
    queue.run_until(100 * MS)
    assert order == [(d, name) for d in (1, 2) for name in ("camera", "navigator", "logger")]


def test_what_is_scheduled_in_the_past_runs_now_and_time_never_goes_back():
    queue = EventQueue()
    ran: list[int] = []
    queue.schedule(50, lambda: queue.schedule(10, lambda: ran.append(queue.now_us)))
    queue.run_until(60)
    assert ran == [50]
    assert queue.now_us == 60
    queue.run_until(20)
    assert queue.now_us == 60


def test_a_killed_process_says_nothing_more_not_even_what_it_was_computing():
    drone = Drone()
    tracker = drone.process("tracker")
    tracker.every(0.1, lambda: tracker.publish(channels.TRACK, track_t()))
    stopped: list[int] = []
    tracker.on_stop(lambda: stopped.append(1))
    tracker.start()
    drone.queue.run_until(205 * MS)  # within the second handler's 10 ms
    tracker.kill()
    drone.bus.deliver(channels.SETPOINT, setpoint_t().encode())
    drone.queue.run_until(3000 * MS)
    assert drone.times(channels.TRACK) == [110 * MS]
    assert drone.times(channels.HEARTBEAT) == [0]
    assert stopped == []


def test_a_stopped_process_hears_nothing_more_and_its_neighbours_go_on():
    drone = Drone()
    heard: dict[str, list[int]] = {"tracker": [], "navigator": []}
    runtimes = {name: drone.process(name) for name in heard}
    for name, runtime in runtimes.items():
        runtime.on(channels.SETPOINT, lambda message, name=name: heard[name].append(message.seq))
    for seq in (1, 2):
        drone.bus.deliver(channels.SETPOINT, make(setpoint_t, seq=seq).encode())
        drone.queue.run_until(drone.queue.now_us + MS)
        if seq == 1:
            runtimes["tracker"].stop()
    assert heard == {"tracker": [1], "navigator": [1, 2]}


def test_heartbeats_tell_no_pid_and_no_machine_so_that_two_runs_are_the_same_bytes():
    def run() -> list[tuple[int, str, bytes]]:
        drone = Drone()
        runtime = drone.process("navigator", ClockError(5_000_000, 20.0))
        runtime.every(0.1, lambda: runtime.publish(channels.SETPOINT, setpoint_t()))
        runtime.start()
        drone.queue.run_until(5000 * MS)
        return drone.said

    first = run()
    assert first == run()
    beats = [heartbeat_t.decode(data) for _, name, data in first if name == channels.HEARTBEAT]
    assert {(beat.pid, beat.cpu, beat.memory_mb) for beat in beats} == {(0, 0.0, 0.0)}
    assert [beat.loop_hz for beat in beats[2:]] == [11.0] * 4  # ten of the timer, one beat


@settings(max_examples=60, deadline=None)
@given(
    offset_us=st.integers(0, 10**12),
    drift_ppm=st.floats(-500, 500),
    true_us=st.integers(0, 10**11),
)
@example(offset_us=0, drift_ppm=-274.87890625, true_us=60026)
def test_a_drones_clock_and_virtual_time_are_each_others_inverse(offset_us, drift_ppm, true_us):
    clock = ClockError(offset_us, drift_ppm)
    utime = clock.utime(true_us)
    first = clock.true_us(utime)
    assert clock.utime(first) >= utime
    assert clock.utime(first - 1) < utime or first == 0
    assert abs(first - true_us) <= 1


def test_a_timer_beats_by_the_drones_own_clock():
    drone = Drone()
    fast = drone.process("navigator", ClockError(7, 1000.0))  # gains 1 ms a second
    beats: list[tuple[int, int]] = []
    fast.every(1.0, lambda: beats.append((drone.queue.now_us, fast.utime)))
    drone.queue.run_until(3_000_000)
    assert [utime for _, utime in beats] == [1_000_007, 2_000_007, 3_000_007]
    assert [true_us for true_us, _ in beats] == [999_001, 1_998_002, 2_997_003]
