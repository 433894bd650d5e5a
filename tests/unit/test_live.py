"""The display of a running mission says what was heard, at which rate, and what is wrong."""

from io import StringIO
from typing import Any

import pytest
from rich.console import Console

from lcmtypes import channels, make
from lcmtypes.podwatch import heartbeat_t, link_state_t, link_t, log_state_t, mission_state_t, vehicle_state_t
from procs.navigator.states import State
from tools.live import LiveView


def text_of(view: LiveView) -> str:
    out = StringIO()
    Console(file=out, width=140).print(view.render())
    return out.getvalue()


def plain_view(**options: Any) -> tuple[LiveView, StringIO]:
    out = StringIO()
    return LiveView([1, 2], console=Console(file=out, width=140), **options), out


def say(
    view: LiveView, drone_id: int, state: State, now_s: float, animal: int = -1, reason: str = ""
) -> None:
    message = make(mission_state_t, state=int(state), animal=animal, reason=reason)
    view.hear(drone_id, channels.MISSION_STATE, message, now_s)


def beat(process: str, pid: int = 7, status: int = 0, detail: str = "", **rates_hz: float) -> heartbeat_t:
    return make(
        heartbeat_t, process=process, pid=pid, status=status, detail=detail,
        rate_names=list(rates_hz), rates_hz=list(rates_hz.values()),
    )  # fmt: skip


def test_a_row_shows_what_its_drone_said() -> None:
    view, _ = plain_view()
    say(view, 1, State.MONITOR, 50.0, animal=14)
    view.hear(1, channels.VEHICLE_STATE, make(vehicle_state_t, d_m=-31.4, battery=0.82), 50.0)
    links = [make(link_t, up=True), make(link_t, up=False)]
    view.hear(1, channels.LINK_STATE, make(link_state_t, n_links=2, links=links), 50.0)
    view.hear(1, channels.LOG_STATE, make(log_state_t, n_bytes=2_340_000), 50.0)
    view.hear(1, channels.HEARTBEAT, beat("registrar", DETECTIONS=4.9), 50.0)
    view.hear(1, channels.HEARTBEAT, beat("tracker", FRAME=20.1), 50.0)
    view.hear(1, channels.HEARTBEAT, beat("navigator", TRACK=19.6), 50.0)
    view.tick(50.5, 0.9)
    row = next(line for line in text_of(view).splitlines() if "MONITOR" in line)
    assert row.split() == [
        "1", "MONITOR", "14", "31", "m", "82%", "1/2", "20", "Hz", "5", "Hz", "20", "Hz", "2.3", "MB",
    ]  # fmt: skip


def test_a_drone_and_a_process_that_fall_silent_are_named() -> None:
    view, _ = plain_view()
    for drone_id in (1, 2):
        say(view, drone_id, State.MONITOR, 10.0)
        view.hear(drone_id, channels.HEARTBEAT, beat("tracker", FRAME=20), 10.0)
    say(view, 1, State.MONITOR, 20.0)
    view.tick(20.0, 1.0)
    text = text_of(view)
    assert "tracker silent" in text
    assert "silent for 10 s" in text
    assert "20 Hz" not in text


def test_the_progress_line_follows_the_furthest_drone_that_is_heard() -> None:
    view, _ = plain_view(watch_s=60.0)
    say(view, 1, State.SCOUT, 1.0)
    say(view, 2, State.STANDBY, 1.0)
    view.tick(1.0, 1.0)
    assert "◉ search" in text_of(view)
    say(view, 1, State.MONITOR, 40.0)
    view.tick(42.0, 1.0)
    assert "◉ watch 2/60 s" in text_of(view)
    say(view, 2, State.RETURN, 103.0)
    view.tick(105.0, 1.0)
    assert "◉ return" in text_of(view)


def test_plain_text_says_each_change_of_state_and_a_line_every_ten_seconds() -> None:
    view, out = plain_view()
    with view:
        for step in range(101):
            now_s = step * 0.25
            say(view, 1, State.SCOUT if now_s < 12 else State.FOUND, now_s, reason="animals in view")
            view.tick(now_s, 1.0)
    lines = out.getvalue().splitlines()
    assert lines == [
        "   10.0 s  search: drones 1 SCOUT, 2 -; 1.00 x real time",
        "   12.0 s  drone 1: SCOUT → FOUND (animals in view)",
        "   20.0 s  gather: drones 1 FOUND, 2 -; 1.00 x real time",
    ]


def test_events_tell_faults_respawns_and_trouble_once() -> None:
    view, out = plain_view()
    view.note(5.0, "the link between 1 and 2 is cut for 15 s")
    for now_s in (6.0, 7.0, 8.0):
        view.hear(2, channels.HEARTBEAT, beat("camera", pid=9 if now_s > 6 else 8), now_s)
        trouble = beat("detector", status=heartbeat_t.DEGRADED, detail="no frame for 1 s")
        view.hear(2, channels.HEARTBEAT, trouble, now_s)
    assert out.getvalue().splitlines() == [
        "    5.0 s  the link between 1 and 2 is cut for 15 s",
        "    6.0 s  drone 2: detector: no frame for 1 s",
        "    7.0 s  drone 2: camera was started again, process 9",
    ]


def test_a_terminal_is_redrawn_in_place_and_not_too_often() -> None:
    out = StringIO()
    wall_s = iter(float(i) / 100 for i in range(1000))
    console = Console(file=out, width=100, force_terminal=True)
    with LiveView([1], console=console, wall_clock=lambda: next(wall_s)) as view:
        for step in range(100):  # a second of wall time
            say(view, 1, State.SCOUT, step / 100)
            view.tick(step / 100, 1.0)
    assert 5 <= out.getvalue().count("◉ search") <= 8


@pytest.mark.parametrize("state", [99, -1])
def test_a_state_of_another_version_is_shown_by_its_number(state: int) -> None:
    view, _ = plain_view()
    view.hear(1, channels.MISSION_STATE, make(mission_state_t, state=state), 1.0)
    view.tick(1.0, 1.0)
    assert f"STATE_{state}" in text_of(view)
