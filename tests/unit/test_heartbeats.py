"""Who hangs: silent for its limit by both clocks, and only after its first heartbeat."""

from dataclasses import replace

import pytest

from procs import processes
from tools.heartbeats import PATIENCE, HeartbeatGuard

LIMIT_S = processes.BY_NAME["tracker"].heartbeat_limit_s
REAL_LIMIT_S = PATIENCE * LIMIT_S
STEP_S = 0.1


def silent_for(guard: HeartbeatGuard, seconds: float, rate: float = 1.0, at: float = 0.0) -> list:
    """Look ten times a second for `seconds` of real time from `at`, the simulation at `rate` of real time."""
    steps = range(round(seconds / STEP_S) + 1)
    return [hung for k in steps for hung in guard.look(at + k * STEP_S, (at + k * STEP_S) * rate)]


def test_one_that_is_silent_for_too_long_is_said_once_and_one_that_beats_is_not():
    guard, said = HeartbeatGuard(), []
    guard.beat(2, "tracker", 41)
    for k in range(300):
        if k % 10 == 0:
            guard.beat(1, "tracker", 40)
        said += [(0.1 * k, hung) for hung in guard.look(0.1 * k, 0.1 * k)]
    assert [(hung.drone_id, hung.process, hung.pid) for _, hung in said] == [(2, "tracker", 41)]
    assert said[0][0] == pytest.approx(REAL_LIMIT_S, abs=0.3)


def test_nobody_hangs_before_its_first_heartbeat():
    assert silent_for(HeartbeatGuard(), 60.0) == []


@pytest.mark.parametrize(
    ("rate", "hangs"), [(0.0, False), (LIMIT_S / REAL_LIMIT_S / 3, False), (0.5, True)], ids=str
)
def test_a_clock_that_stands_or_goes_slowly_excuses_silence(rate, hangs):
    """Heartbeats come once a second of simulation time: where it goes slowly they come seldom."""
    guard = HeartbeatGuard()
    guard.beat(1, "tracker", 40)
    assert bool(silent_for(guard, 2 * REAL_LIMIT_S, rate)) is hangs


def test_a_watcher_that_was_held_up_itself_accuses_nobody():
    guard = HeartbeatGuard()
    guard.look(0.0, 0.0)
    guard.beat(1, "tracker", 40)
    assert guard.look(60.0, 60.0) == []
    guard.beat(1, "tracker", 40)
    assert silent_for(guard, 5.0, at=60.0) == []


def test_one_that_was_started_again_is_judged_anew():
    guard = HeartbeatGuard()
    guard.beat(1, "tracker", 40)
    assert [hung.pid for hung in silent_for(guard, 12.0)] == [40]
    assert silent_for(guard, 60.0, at=12.0) == [], "it may take its time to start"
    guard.beat(1, "tracker", 77)
    assert [hung.pid for hung in silent_for(guard, 12.0, at=72.0)] == [77]


def test_a_drone_that_is_dead_is_not_waited_for():
    guard = HeartbeatGuard()
    guard.beat(1, "tracker", 40)
    guard.beat(2, "tracker", 41)
    guard.forget(1)
    assert [hung.drone_id for hung in silent_for(guard, 12.0)] == [2]


def test_the_limit_is_the_process_tables(monkeypatch):
    row = replace(processes.BY_NAME["tracker"], heartbeat_limit_s=10 * LIMIT_S)
    monkeypatch.setitem(processes.BY_NAME, "tracker", row)
    guard = HeartbeatGuard()
    guard.beat(1, "tracker", 40)
    assert silent_for(guard, 2 * REAL_LIMIT_S) == []
