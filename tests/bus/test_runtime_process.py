"""A process of a drone as a real process: how it starts, how it ends, and what it says where it cannot."""

import os
import select
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from lcmtypes import channels, make
from lcmtypes.podwatch import track_t
from procs import processes
from procs.bus_executor import HARD_STOP_S
from procs.settings import DriverSpec
from tests.bus.process_bench import DEADLINE_S, Bench

EXIT_CANNOT_START = 3
# A process whose handler of TRACK is busy, deaf or hung, as its second argument says.
SHELL = """
import os, select, sys, time
from pathlib import Path
from lcmtypes import channels, make
from lcmtypes.podwatch import setpoint_t
from procs.bus_executor import BusRuntime
from procs.settings import DroneSettings

runtime = BusRuntime("navigator", DroneSettings.read(Path(sys.argv[1])))
def handle(message):
    runtime.publish(channels.SETPOINT, make(setpoint_t, utime=1))
    if sys.argv[2] == "hung":
        select.select([], [], [])
    until = time.monotonic() + 1.0
    while sys.argv[2] == "busy" and time.monotonic() < until:
        pass
    runtime.publish(channels.SETPOINT, make(setpoint_t, utime=2))
runtime.on(channels.TRACK, handle)
runtime.on_stop(lambda: runtime.publish(channels.SETPOINT, make(setpoint_t, utime=3)))
runtime.run()
"""


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    if made.process is not None and made.process.poll() is None:
        made.process.kill()
        made.process.communicate()


def say_track(bench: Bench) -> None:
    bench.bus.publish(channels.TRACK, make(track_t, utime=1).encode())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_process_that_is_told_to_end_ends_at_once_and_in_order(bench, number):
    bench.start("-c", SHELL, "SETTINGS", "quick")
    bench.await_that(lambda: bench.beats)
    assert bench.process is not None
    assert bench.beats[0].pid == bench.process.pid
    told = time.monotonic()
    os.kill(bench.process.pid, number)
    assert bench.end()[0] == 0
    assert time.monotonic() - told < HARD_STOP_S
    assert bench.setpoints == [3]


def test_told_to_end_within_a_handler_it_finishes_the_handler_and_begins_no_other(bench):
    bench.start("-c", SHELL, "SETTINGS", "busy")
    bench.await_that(lambda: bench.beats)
    say_track(bench)
    say_track(bench)
    bench.await_that(lambda: bench.setpoints == [1])
    os.kill(bench.process.pid, signal.SIGTERM)
    assert bench.end() == (0, "")
    assert bench.setpoints == [1, 2, 3]


def test_a_hung_handler_is_ended_by_the_kernel(bench):
    bench.start("-c", SHELL, "SETTINGS", "hung")
    bench.await_that(lambda: bench.beats)
    say_track(bench)
    bench.await_that(lambda: bench.setpoints == [1])
    told = time.monotonic()
    os.kill(bench.process.pid, signal.SIGTERM)
    code, _ = bench.end()
    assert code == -signal.SIGALRM
    assert HARD_STOP_S - 0.1 <= time.monotonic() - told < HARD_STOP_S + 3
    assert bench.setpoints == [1]


def test_signals_by_the_hundred_between_messages_break_nothing(bench):
    """A signal in LCM's own wait raises OSError: the runtime waits in select (test_lcm_facts.py, fact 3)."""
    bench.start("-c", SHELL.replace("runtime.run()", HARMLESS), "SETTINGS", "quick")
    bench.await_that(lambda: bench.beats)
    for round_number in range(1, 21):
        for _ in range(10):
            os.kill(bench.process.pid, signal.SIGUSR1)
            say_track(bench)
        bench.await_that(lambda: bench.setpoints.count(2) == 10 * round_number)  # noqa: B023 - awaited here
    os.kill(bench.process.pid, signal.SIGTERM)
    assert bench.end() == (0, "")


# LCM as it is when signals fall into it: it raises, N times out of each N + 1, and keeps what waits.
INTERRUPTED = """
class Interrupted:
    def __init__(self, real):
        self.real, self.failed = real, 0
    def __getattr__(self, name):
        return getattr(self.real, name)
    def handle_timeout(self, limit):
        self.failed = (self.failed + 1) % (FAILURES + 1)
        if self.failed:
            raise OSError("lcm_handle_timeout() returned -1")
        return self.real.handle_timeout(limit)
runtime._lcm = Interrupted(runtime._lcm)
runtime.run()
"""


def test_a_signal_that_falls_into_lcm_loses_no_message(bench):
    bench.start(
        "-c", SHELL.replace("runtime.run()", INTERRUPTED.replace("FAILURES", "3")), "SETTINGS", "quick"
    )
    bench.await_that(lambda: bench.beats)
    for _ in range(10):
        say_track(bench)
    bench.await_that(lambda: bench.setpoints.count(2) == 10)
    os.kill(bench.process.pid, signal.SIGTERM)
    assert bench.end() == (0, "")


def test_a_bus_that_always_fails_ends_the_process(bench):
    """Its supervisor starts it anew; going round for ever would look alive and hear nothing."""
    bench.start(
        "-c", SHELL.replace("runtime.run()", INTERRUPTED.replace("FAILURES", "1000")), "SETTINGS", "quick"
    )
    bench.await_that(lambda: bench.beats)
    say_track(bench)
    code, said = bench.end()
    assert code == 1
    assert "lcm_handle_timeout() returned -1" in said


# Work that ends when a second message is handled: no process could hear that one while it waits for the work.
ASIDE = """
import threading
second = threading.Event()
def begin(message):
    if threading.active_count() > 1:
        second.set()
        return
    runtime.aside(lambda: second.wait(60), lambda done: runtime.publish(
        channels.SETPOINT, make(setpoint_t, utime=7 if done.result() else 8)))
    runtime.publish(channels.SETPOINT, make(setpoint_t, utime=1))
runtime._subscriptions[channels.TRACK].handler = begin
runtime.run()
"""


def test_what_is_done_aside_keeps_nobody_waiting(bench):
    bench.start("-c", SHELL.replace("runtime.run()", ASIDE), "SETTINGS", "quick")
    bench.await_that(lambda: bench.beats)
    say_track(bench)
    bench.await_that(lambda: bench.setpoints == [1])
    say_track(bench)
    bench.await_that(lambda: bench.setpoints == [1, 7])
    os.kill(bench.process.pid, signal.SIGTERM)
    assert bench.end() == (0, "")


def test_an_end_does_not_wait_for_what_is_done_aside(bench):
    bench.start("-c", SHELL.replace("runtime.run()", ASIDE), "SETTINGS", "quick")
    bench.await_that(lambda: bench.beats)
    say_track(bench)
    bench.await_that(lambda: bench.setpoints == [1])
    told = time.monotonic()
    os.kill(bench.process.pid, signal.SIGTERM)
    assert bench.end() == (0, "")
    assert time.monotonic() - told < HARD_STOP_S


HARMLESS = """
import signal
signal.signal(signal.SIGUSR1, lambda *_: None)
runtime.run()
"""


@pytest.mark.parametrize("process", ["navigator", "assigner", "registrar", "logger"])
def test_a_process_of_the_table_starts_from_its_settings_and_ends_within_its_limit(bench, process):
    bench.start("-m", "procs.main", process, "SETTINGS")
    bench.await_that(lambda: bench.beats)
    beat = bench.beats[0]
    assert (beat.process, beat.pid, beat.drone_id) == (process, bench.process.pid, 2)
    assert beat.memory_mb > 10
    bench.process.send_signal(signal.SIGTERM)
    assert bench.end() == (0, "")


def test_a_process_dies_with_its_supervisor(bench):
    """Its parent here is a shell that is killed with -9 and can stop nobody."""
    parent = (
        "import subprocess, sys; command = [sys.executable, '-m', 'procs.main', 'navigator', sys.argv[1]]; "
        "sys.exit(subprocess.call([*command, '--end-with-parent']))"
    )
    bench.start("-c", parent, "SETTINGS")
    bench.await_that(lambda: bench.beats)
    child = bench.beats[0].pid
    assert child != bench.process.pid
    ended = os.pidfd_open(child)
    bench.process.kill()
    ready, _, _ = select.select([ended], [], [], DEADLINE_S)
    os.close(ended)
    assert ready, "the child lives on without its supervisor"


def cannot_start(bench: Bench, *command: str) -> str:
    bench.start(*command)
    code, said = bench.end()
    assert code == EXIT_CANNOT_START
    return said


NO_ROUTE = """
import ctypes, sys
CLONE_NEWUSER, CLONE_NEWNET = 0x10000000, 0x40000000
if ctypes.CDLL(None).unshare(CLONE_NEWUSER | CLONE_NEWNET) != 0:
    from procs import settings
    read = settings.DroneSettings.read
    settings.DroneSettings.read = lambda path: read(path).model_copy(update={"bus_url": "udpm://no.group:1"})
from procs import main
sys.argv = ["main", "navigator", sys.argv[1]]
main.main()
"""


def test_without_a_multicast_route_it_says_which_command_to_run(bench):
    """In a network of its own that has no route; where that is not allowed, with a group that cannot be."""
    said = cannot_start(bench, "-c", NO_ROUTE, "SETTINGS")
    assert "navigator: no bus at udpm://" in said
    assert "ip route replace 239.255.76.0/24 dev lo" in said


def test_a_process_that_cannot_start_says_what_is_wrong_in_one_line(bench, tmp_path):
    def last(said: str) -> str:
        assert "Traceback" not in said
        return said.strip().splitlines()[-1]

    assert "the settings name no driver for 'frames'" in last(
        cannot_start(bench, "-m", "procs.main", "detector", "SETTINGS")
    )
    specs: dict[str, Any] = {"detector": "drivers.frames:Nothing", "frames": "drivers.frames:MemoryFrames"}
    bench.settings = bench.settings.model_copy(
        update={"drivers": {name: DriverSpec(driver=driver) for name, driver in specs.items()}}
    )
    assert "driver drivers.frames:Nothing: cannot be loaded" in last(
        cannot_start(bench, "-m", "procs.main", "detector", "SETTINGS")
    )
    wrong = tmp_path / "wrong.json"
    wrong.write_text('{"drone_id": 2, "mission": {"nmae": "x"}}')
    assert "nmae" in cannot_start(bench, "-m", "procs.main", "navigator", str(wrong))
    bench.settings = bench.settings.model_copy(update={"drone_id": 9})
    assert "drone 9 is not in the roster [1, 2, 3]" in cannot_start(
        bench, "-m", "procs.main", "navigator", "SETTINGS"
    )
    assert "missing.json" in cannot_start(
        bench, "-m", "procs.main", "navigator", str(tmp_path / "missing.json")
    )


def test_only_processes_of_the_table_can_be_started(bench):
    bench.start("-m", "procs.main", "pilot", "SETTINGS")
    code, said = bench.end()
    assert code == 2
    assert all(process.name in said for process in processes.PROCESSES)
