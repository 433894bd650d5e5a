"""A fleet as real processes, and what becomes of it when they are killed one after another, and all at once.

One flight serves most of these tests: it is flown, disturbed and written down once. There is no fallback
here: where processes cannot fly, these tests fail.
"""

import fcntl
import json
import os
import signal
import subprocess
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import lcm
import numpy as np
import psutil
import pytest

from lcmtypes import channels
from logs.exceptions import LogWarning
from logs.reader import info, read, segments
from procs import processes
from procs.navigator.states import State
from procs.processes import Restart
from procs.relay.keys import make_key
from tests.fleet.conftest import new_plan
from tools.buses import N_SLOTS, Slot
from tools.heartbeats import Hung
from tools.judge import Verdict, judge, load_run
from tools.sim import processes as process_mode
from tools.sim.plan import RunPlan
from tools.sim.processes import SHARED_FOLDER, ProcessFleet
from tools.sim.run import fly_lockstep, write_truth_notes
from tools.sim.settings import SimMission
from tools.sim.watch import Watch
from tools.supervision import program

pytestmark = pytest.mark.timeout(600)

VICTIM = 2
HUNG_DRONE, HUNG_PROCESS = 3, "assigner"  # stopped in the air, not killed: only its heartbeats are missed
# The eyes and the memory are killed on the way: dead within the watch, they would take from the judge what he
# looks at.
KILLED_ON_THE_WAY = ("camera", "detector", "tracker", "logger", "registrar", "assigner", "relay")
KILLED_WHILE_WATCHING = ("navigator", "autopilot")
STARTED_S, BEAT_S = 2.0, 5.0  # promised of a killed process: there again, and heard again
KEPT_UP = (
    0.9  # of real time: below it the machine had other work, and the promise holds for the usual process
)
RESPAWN_LIMIT_S = 45.0  # of a machine that does five other things; an idle one takes about 2
GONE_LIMIT_S = 20.0
# The judge asks 90 %, and so does this test where the machine keeps up. On one that does not, processes that
# were killed within the window are away for longer: 80 to 98 % were measured at loads of 12 to 24 on 2 cores.
LEAST_DISTINCT_SHARE = 0.7
FLIGHT_LIMIT_S = 400.0  # about 150 where the machine keeps up
RATE_TOLERANCE = 0.35


def boot_time_s() -> float:
    """The clock by which the kernel says when a process was started."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def started_at_s(pid: int) -> float:
    """When a process was started, to 0.01 s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return int(fields[19]) / os.sysconf("SC_CLK_TCK")


@dataclass
class Killer:
    """The run's screen: kills one process of the victim after another, when the one before has come back."""

    pids: dict[str, int] = field(default_factory=dict)  # newest pid of each of the victim's processes
    respawn_s: dict[str, float] = field(default_factory=dict)  # until it beat again
    started_s: dict[str, float] = field(default_factory=dict)  # until there was a process again
    hung_pids: list[int] = field(default_factory=list)  # of the process that is stopped, one after another
    is_hung: bool = False
    notes: list[str] = field(default_factory=list)
    states: dict[int, State] = field(default_factory=dict)
    waiting: str = ""
    killed_s: float = 0.0
    killed_pid: int = 0

    def hear(self, drone_id: int, channel: str, message: Any, _now_s: float) -> None:
        if channel == channels.MISSION_STATE:
            self.states[drone_id] = State(message.state)
        elif channel == channels.HEARTBEAT and drone_id == VICTIM:
            self.pids[message.process] = message.pid
            if message.process == self.waiting and message.pid != self.killed_pid:
                self.respawn_s[self.waiting] = boot_time_s() - self.killed_s
                self.started_s[self.waiting] = started_at_s(message.pid) - self.killed_s
                self.waiting = ""
        elif channel == channels.HEARTBEAT and (drone_id, message.process) == (HUNG_DRONE, HUNG_PROCESS):
            if message.pid not in self.hung_pids:
                self.hung_pids.append(message.pid)

    def note(self, _now_s: float, text: str) -> None:
        self.notes.append(text)

    def tick(self, _now_s: float, _realtime_factor: float) -> None:
        """Kill the next one when it is time."""
        if not self.is_hung and self.hung_pids and self.states.get(HUNG_DRONE) == State.STANDBY:
            self.is_hung = True
            os.kill(self.hung_pids[0], signal.SIGSTOP)
        if self.waiting:
            waited_s = boot_time_s() - self.killed_s
            assert waited_s < RESPAWN_LIMIT_S, f"{self.waiting} has not come back for {waited_s:.0f} s"
            return
        victim = self.states.get(VICTIM, State.IDLE)
        is_up = victim not in (State.IDLE, State.TAKEOFF, State.LAND, State.LANDED)
        due = [*KILLED_ON_THE_WAY] if is_up else []
        if victim == State.MONITOR:
            due += KILLED_WHILE_WATCHING
        left = [name for name in due if name not in self.respawn_s]
        if left:
            self.waiting, self.killed_pid, self.killed_s = left[0], self.pids[left[0]], boot_time_s()
            os.kill(self.killed_pid, signal.SIGKILL)


@dataclass(frozen=True)
class Flight:
    """What one disturbed flight left behind."""

    plan: RunPlan
    respawn_s: dict[str, float]
    left_running: list[str]
    left_in_memory: list[str]
    realtime_factor: float
    verdict: Verdict
    screen: Killer


def running(folder: Path) -> list[psutil.Process]:
    """The processes whose command line names the run's folder."""
    return [
        process
        for process in psutil.process_iter(["cmdline"])
        if any(str(folder) in word for word in process.info["cmdline"] or [])
    ]


@pytest.fixture(scope="module")
def flight(near: SimMission, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    plan = new_plan(near, tmp_path_factory.mktemp("flight") / "run")
    make_key(plan.folder / near.radio.key_file)
    killer = Killer()
    watch = Watch(near, killer)
    with ProcessFleet(plan, watch) as fleet:
        fleet.wait_until_ready(lambda: None)
        began, over = time.monotonic(), False
        while not over:
            assert time.monotonic() - began < FLIGHT_LIMIT_S, f"states {killer.states} at {fleet.now_s:.0f} s"
            fleet.look()
            over = watch.step(fleet.now_s, fleet, 1.0)
        wall_s = time.monotonic() - began
        realtime_factor = fleet.now_s / wall_s
        write_truth_notes(plan, watch, "processes", "", fleet.now_s, wall_s)
        tree = running(plan.folder)
        assert len(tree) == 2 + 9 * len(near.roster), "supervisord, the world and nine processes a drone"
        os.kill(fleet.supervisor.pid, signal.SIGKILL)
        psutil.wait_procs(tree, timeout=GONE_LIMIT_S)
        left_running = [" ".join(process.cmdline()) for process in running(plan.folder) if is_alive(process)]
    memory = [path.name for path in SHARED_FOLDER.glob(f"podwatch_{fleet._run}_*")]
    truth = load_run(plan.folder)
    verdict = judge(truth.truth, truth.drones)
    return Flight(plan, killer.respawn_s, left_running, memory, realtime_factor, verdict, killer)


def is_alive(process: psutil.Process) -> bool:
    try:
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def test_every_process_of_a_drone_comes_back_from_kill_9(flight, record_property):
    record_property("respawn_s", flight.respawn_s)
    record_property("started_s", flight.screen.started_s)
    for name in flight.respawn_s:
        print(f"{name}: started {flight.screen.started_s[name]:.2f} s after its kill, beat after ", end="")
        print(f"{flight.respawn_s[name]:.2f} s")
    assert sorted(flight.respawn_s) == sorted(processes.BY_NAME)
    print(f"realtime factor {flight.realtime_factor:.2f}")
    worst = max if flight.realtime_factor >= KEPT_UP else np.median
    assert worst([*flight.screen.started_s.values()]) <= STARTED_S, flight.screen.started_s
    assert worst([*flight.respawn_s.values()]) <= BEAT_S, flight.respawn_s


def test_a_process_that_hangs_is_killed_and_comes_back_and_no_other_is_taken_for_hung(flight):
    assert len(flight.screen.hung_pids) == 2
    assert [note.split(" (")[0] for note in flight.screen.notes] == [
        f"{HUNG_PROCESS} of drone {HUNG_DRONE} hangs"
    ]


def test_the_drone_whose_processes_were_killed_ends_on_the_ground_like_the_others(flight):
    assert flight.screen.states == dict.fromkeys(flight.plan.mission.roster, State.LANDED)


def test_each_drone_still_watched_an_animal_of_its_own(flight):
    verdict = flight.verdict
    print(
        f"distinct: {verdict.distinct}, for {verdict.distinct_share or 0:.1%} of {verdict.monitor_window_s}"
    )
    animals = [drone.animal for drone in verdict.drones]
    assert None not in animals, verdict.reasons
    assert len(set(animals)) == len(animals), verdict.reasons
    assert all(drone.is_assigned for drone in verdict.drones)
    if flight.realtime_factor >= KEPT_UP:
        assert verdict.distinct, verdict.reasons
    assert (verdict.distinct_share or 0.0) >= LEAST_DISTINCT_SHARE, verdict.reasons


def test_the_run_says_that_processes_flew_and_nothing_fell_back(flight):
    about = json.loads((flight.plan.folder / "truth.json").read_text())
    assert (about["mode"], about["fallback_reason"]) == ("processes", None)
    pids = {
        message.pid
        for drone_id in flight.plan.mission.roster
        for message in said(flight.plan, drone_id, channels.HEARTBEAT)
    }
    assert len(pids - {0}) >= 9 * len(flight.plan.mission.roster)


def test_supervisord_killed_leaves_nothing_running_and_nothing_in_shared_memory(flight):
    assert flight.left_running == []
    assert flight.left_in_memory == []


def test_a_killed_logger_costs_a_second_and_its_successor_writes_a_segment_of_its_own(flight):
    logs = list(segments(flight.plan.log_path(VICTIM)))
    assert len(logs) == 2
    assert all(len(list(segments(flight.plan.log_path(other)))) == 1 for other in (1, 3))
    assert info(logs[1]).closed, "ended by the supervisor's death, yet in order"


def said(plan: RunPlan, drone_id: int, channel: str) -> list[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LogWarning)  # the killed logger left its file open
        return [message for _, _, message in read(plan.log_path(drone_id), channels=channel)]


def rates(plan: RunPlan, drone_id: int) -> dict[str, tuple[str, float]]:
    """Channel -> (type, how often it is said) in one drone's log.

    By the usual interval, since a channel may speak faster in one stage; nine processes share HEARTBEAT.
    """
    times: dict[str, list[float]] = {}
    kinds: dict[str, str] = {}
    for channel, log_time_ns, message in read(plan.log_path(drone_id), strict=True):
        times.setdefault(channel, []).append(log_time_ns / 1e9)
        kinds[channel] = type(message).__name__
    found = {}
    for channel, at_s in times.items():
        usual = np.mean if channel == channels.HEARTBEAT else np.median
        interval_s = float(usual(np.diff(at_s))) if len(at_s) > 1 else np.inf
        found[channel] = (kinds[channel], 1 / max(interval_s, 1e-6))
    return found


def test_both_modes_leave_the_same_channels_at_the_same_rates(flight, near, tmp_path):
    plan = new_plan(near, tmp_path / "run")
    fly_lockstep(plan, None)
    for drone_id in (1, 3):  # those that nobody killed
        real, virtual = rates(flight.plan, drone_id), rates(plan, drone_id)
        assert {name: kind for name, (kind, _) in real.items()} == {
            name: kind for name, (kind, _) in virtual.items()
        }
        for channel in channels.CHANNELS:
            if channel.rate_hz:
                for _, rate_hz in (real[channel.name], virtual[channel.name]):
                    assert rate_hz == pytest.approx(channel.rate_hz, rel=RATE_TOLERANCE), channel.name


class NoSupervisor:
    """In place of supervisord where a test needs only what a run lays out around it."""

    def __init__(self, *_options: object) -> None: ...

    def stop(self) -> None: ...

    def check(self, *, in_flight: bool = False) -> None: ...


@pytest.fixture
def laid_out(near: SimMission, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Makes fleets without processes; all are closed at the end."""
    monkeypatch.setattr(process_mode, "Supervisor", NoSupervisor)
    fleets: list[ProcessFleet] = []

    def lay_out(name: str) -> ProcessFleet:
        fleets.append(ProcessFleet(new_plan(near, tmp_path / name), Watch(near, None)))
        return fleets[-1]

    yield lay_out
    for fleet in fleets:
        fleet.close()


@pytest.mark.parametrize("state", [State.IDLE, State.MONITOR])
@pytest.mark.parametrize("policy", list(Restart))
def test_a_process_that_hangs_is_ended_by_its_policy_and_only_if_it_is_still_that_process(
    state, policy, laid_out, monkeypatch
):
    fleet = laid_out("run")
    name = "restart_ground" if state == State.IDLE else "restart_air"
    other = "restart_air" if state == State.IDLE else "restart_ground"
    opposite = Restart.NEVER if policy is Restart.ALWAYS else Restart.ALWAYS
    row = replace(processes.BY_NAME["tracker"], **{name: policy, other: opposite})
    monkeypatch.setitem(processes.BY_NAME, "tracker", row)
    fleet._watch.states[1] = state
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE) as sleeper:
        fleet.supervisor.states = lambda: {"tracker_1": ("RUNNING", sleeper.pid)}
        fleet._end(Hung(1, "tracker", sleeper.pid + 1, 12.0))
        assert sleeper.poll() is None, "it was started again meanwhile"
        fleet._end(Hung(1, "tracker", sleeper.pid, 12.0))
        if policy is Restart.ALWAYS:
            assert sleeper.wait(timeout=10) == -signal.SIGKILL
        else:
            assert sleeper.poll() is None


def test_while_processes_start_it_is_told_how_many_run(laid_out, monkeypatch):
    monkeypatch.setattr(process_mode, "TELL_EVERY_S", 0.0)
    fleet = laid_out("run")
    beats = iter(
        [program(drone_id, name) for drone_id in fleet.plan.mission.roster for name in processes.BY_NAME]
    )
    n_beats = 9 * len(fleet.plan.mission.roster)

    def look() -> None:
        beat = next(beats, None)
        if beat is None:
            fleet._page.set(0.0, 1.0)
        else:
            fleet._heard.add(beat)

    monkeypatch.setattr(fleet, "look", look)
    told: list[str] = []
    fleet.wait_until_ready(lambda: None, told.append)
    assert told[0].startswith(f"0 of {n_beats} run after ")
    assert told[4].startswith(f"4 of {n_beats} run after ")
    assert [line.split(" after")[0] for line in told[n_beats:]] == [f"All {n_beats} run"]


def test_two_runs_at_once_share_no_bus_no_port_and_no_memory_and_never_hear_each_other(laid_out):
    first, second = laid_out("first"), laid_out("second")
    one, two = (fleet.plan.folder / "output" for fleet in (first, second))
    settings = [json.loads((folder / "drone_1.json").read_text()) for folder in (one, two)]
    assert settings[0]["bus_url"] != settings[1]["bus_url"]
    worlds = [json.loads((folder / "world.json").read_text()) for folder in (one, two)]
    ports = Counter(
        port
        for world in worlds
        for table in ("mavlink_ports", "radio_ports", "ether_ports")
        for port in world[table].values()
    )
    assert max(ports.values()) == 1
    rings = [each["drivers"]["frames"]["options"]["run"] for each in settings]
    assert rings[0] != rings[1]

    heard: dict[int, list[bytes]] = {0: [], 1: []}
    buses = [lcm.LCM(each["bus_url"]) for each in settings]
    for number, bus in enumerate(buses):
        bus.subscribe(".*", lambda _channel, data, number=number: heard[number].append(data))
    for number, bus in enumerate(buses):
        bus.publish(channels.TRACK, bytes([number]))
        deadline = time.monotonic() + 10
        while not heard[number]:  # its own word comes back: so would the other's have come
            assert time.monotonic() < deadline
            bus.handle_timeout(100)
    assert [bus.handle_timeout(50) for bus in buses] == [0, 0]
    assert heard == {0: [b"\0"], 1: [b"\1"]}


def test_a_run_removes_what_a_dead_run_of_its_slot_left_behind_and_nobody_elses(laid_out):
    left = [SHARED_FOLDER / f"podwatch_s{number}xdead_1_ring" for number in range(N_SLOTS)]
    try:
        for path in left:
            path.touch()
        fleet = laid_out("run")
        number = fleet._slot.number
        assert not left[number].exists()
        assert left[-1].exists()
        assert fleet._page_path.exists()
        fleet.close()
        assert not fleet._page_path.exists()
    finally:
        for path in left:
            path.unlink(missing_ok=True)


def test_a_slot_stays_taken_until_the_last_process_of_its_run_has_ended():
    slot = Slot()
    number = slot.number
    holder = subprocess.Popen(["cat"], stdin=subprocess.PIPE, pass_fds=[slot.fileno()])
    slot.close()
    with Slot() as other:
        assert other.number != number
    assert holder.stdin is not None
    holder.stdin.close()
    holder.wait(timeout=10)
    lock = (Path(tempfile.gettempdir()) / f"podwatch-slot-{number}.lock").open("r+")
    with lock:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
