"""A running mission in the terminal: one row a drone, how far the mission is, and what happened last.

`LiveView` hears messages and renders; it decides nothing and reads no bus. On a terminal it redraws itself in
place; into a pipe or a file it says a line each 10 s and one for each change of state.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from lcmtypes import channels
from lcmtypes.podwatch import heartbeat_t
from procs.navigator.states import State
from tools.evidence import state_name

__all__ = ["SHOWN", "LiveView"]

# The channels that it shows.
SHOWN = frozenset(
    {
        channels.MISSION_STATE,
        channels.VEHICLE_STATE,
        channels.LINK_STATE,
        channels.LOG_STATE,
        channels.HEARTBEAT,
        channels.ASSIGNMENT,
    }
)

PLAIN_PERIOD_S = 10.0  # of simulation time, between status lines in plain text
REDRAW_S = 0.2  # of wall time, between pictures on a terminal
SILENT_AFTER_S = 3.0  # a drone or a process not heard for so long is shown as silent
N_EVENTS = 7

# The mission as a person tells it; the first stage whose states any drone is in is where the fleet is.
STAGES = (
    ("take-off", (State.TAKEOFF,)),
    ("search", (State.SCOUT, State.STANDBY)),
    ("gather", (State.FOUND, State.RENDEZVOUS)),
    ("agree", (State.REGISTER, State.ASSIGN)),
    ("watch", (State.MONITOR,)),
    ("return", (State.RETURN, State.LAND)),
    ("landed", (State.LANDED,)),
)
STAGE_ORDER = ("watch", "agree", "gather", "take-off", "return", "search", "landed")
STATE_STYLE = {
    State.MONITOR: "bold green",
    State.HOLD: "bold yellow",
    State.LAND: "yellow",
    State.LANDED: "dim",
    State.IDLE: "dim",
}


@dataclass
class _Row:
    """What was last heard of one drone."""

    state: int | None = None
    reason: str = ""
    identity: int = -1
    heard_s: float = 0.0
    height_m: float | None = None
    battery: float | None = None
    links: tuple[int, int] | None = None  # up, of
    log_bytes: int | None = None
    beats: dict[str, tuple[float, heartbeat_t]] = field(default_factory=dict)  # process -> (when, its newest)


class LiveView:
    """The display of one run. `roster`: drone ids. `watch_s`: how long MONITOR shall last, for the progress
    line.

    Use it as a context, feed `hear` and `note`, and call `tick` often; all times are the run's own clock in
    seconds.
    """

    def __init__(
        self,
        roster: Sequence[int],
        *,
        title: str = "",
        watch_s: float | None = None,
        console: Console | None = None,
        wall_clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._rows = {drone_id: _Row() for drone_id in sorted(roster)}
        self._title = title
        self._watch_s = watch_s
        self._watch_from_s: float | None = None
        self._console = console or Console()
        self._wall_clock = wall_clock
        self._drawn_at = -REDRAW_S
        self._now_s = 0.0
        self._factor = 0.0
        self._plain_due_s = PLAIN_PERIOD_S
        self._events: deque[tuple[float, str]] = deque(maxlen=N_EVENTS)
        self._live: Live | None = None

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False, transient=False)
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.update(self.render(), refresh=True)
            self._live.stop()
            self._live = None

    def hear(self, drone_id: int, channel: str, message: Any, now_s: float) -> None:
        """One message of one drone's bus; channels that are not shown are ignored."""
        row = self._rows.setdefault(drone_id, _Row())
        row.heard_s = now_s
        if channel == channels.MISSION_STATE:
            self._hear_state(drone_id, row, message, now_s)
        elif channel == channels.VEHICLE_STATE:
            row.height_m, row.battery = -message.d_m, message.battery
        elif channel == channels.LINK_STATE:
            row.links = sum(link.up for link in message.links), len(message.links)
        elif channel == channels.LOG_STATE:
            row.log_bytes = message.n_bytes
        elif channel == channels.HEARTBEAT:
            self._hear_beat(drone_id, row, message, now_s)

    def note(self, now_s: float, text: str) -> None:
        """Something that people should read: a fault begins, a process came back."""
        self._events.append((now_s, text))
        if self._live is None:
            self._console.print(f"{now_s:7.1f} s  {text}", highlight=False, markup=False, soft_wrap=True)

    def tick(self, now_s: float, realtime_factor: float) -> None:
        """Time passes: redraw where it is due."""
        self._now_s, self._factor = now_s, realtime_factor
        wall_s = self._wall_clock()
        if self._live is not None and wall_s - self._drawn_at >= REDRAW_S:
            self._drawn_at = wall_s
            self._live.update(self.render(), refresh=True)
        elif self._live is None and now_s >= self._plain_due_s:
            self._plain_due_s = now_s + PLAIN_PERIOD_S
            self._console.print(self._status_line(), highlight=False, markup=False, soft_wrap=True)

    def render(self) -> RenderableType:
        """The picture of this moment."""
        return Group(
            self._progress_line(), Text(), self._table(), Text(), *self._trouble_lines(), *self._event_lines()
        )

    def _hear_state(self, drone_id: int, row: _Row, message: Any, now_s: float) -> None:
        before, row.state, row.reason = row.state, message.state, message.reason
        row.identity = message.animal
        if message.state == State.MONITOR and self._watch_from_s is None:
            self._watch_from_s = now_s
        if before is not None and before != message.state:
            why = f" ({message.reason})" if message.reason else ""
            self.note(now_s, f"drone {drone_id}: {state_name(before)} → {state_name(message.state)}{why}")

    def _hear_beat(self, drone_id: int, row: _Row, beat: heartbeat_t, now_s: float) -> None:
        before = row.beats.get(beat.process)
        row.beats[beat.process] = now_s, beat
        if before is not None and before[1].pid != beat.pid:
            self.note(now_s, f"drone {drone_id}: {beat.process} was started again, process {beat.pid}")
        was_well = before is None or before[1].status == heartbeat_t.OK
        if beat.status != heartbeat_t.OK and was_well:
            self.note(now_s, f"drone {drone_id}: {beat.process}: {beat.detail}")

    def _stage(self) -> str | None:
        states = {row.state for row in self._rows.values() if self._now_s - row.heard_s <= SILENT_AFTER_S}
        by_name = dict(STAGES)
        return next((name for name in STAGE_ORDER if states.intersection(by_name[name])), None)

    def _progress_line(self) -> Text:
        stage = self._stage()
        line = Text(f"{self._title}  " if self._title else "", style="bold")
        line.append(f"{self._now_s:.0f} s, {self._factor:.2f} x real time\n", style="default not bold")
        names = [name for name, _ in STAGES]
        reached = names.index(stage) if stage else -1
        for index, name in enumerate(names):
            mark, style = ("●", "green") if index < reached else ("○", "dim")
            if index == reached:
                mark, style = "◉", "bold cyan"
            line.append(f"{mark} {self._stage_text(name, index == reached)}  ", style=style)
        return line

    def _stage_text(self, name: str, is_now: bool) -> str:
        if name == "watch" and is_now and self._watch_s and self._watch_from_s is not None:
            return f"watch {min(self._now_s - self._watch_from_s, self._watch_s):.0f}/{self._watch_s:.0f} s"
        return name

    def _table(self) -> Table:
        table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
        table.add_column("drone", no_wrap=True)
        table.add_column("state", min_width=10, no_wrap=True)
        for title in ("animal", "height", "battery", "links", "camera", "detect", "track", "log"):
            table.add_column(title, justify="right", no_wrap=True, min_width=5)
        for drone_id, row in self._rows.items():
            table.add_row(str(drone_id), self._state(row), *_cells(row, self._now_s))
        return table

    def _state(self, row: _Row) -> Text:
        if row.state is None:
            return Text("-", style="dim")
        style = STATE_STYLE.get(State(row.state), "") if row.state in State.__members__.values() else "red"
        return Text(state_name(row.state), style=style)

    def _trouble_lines(self) -> list[Text]:
        """What is wrong now, one line a drone and process."""
        lines = []
        for drone_id, row in self._rows.items():
            silent_s = self._now_s - row.heard_s
            if row.state is not None and silent_s > SILENT_AFTER_S:
                lines.append(Text(f" ! drone {drone_id}: silent for {silent_s:.0f} s", style="bold red"))
                continue
            for process, (when_s, beat) in sorted(row.beats.items()):
                if self._now_s - when_s > SILENT_AFTER_S:
                    lines.append(Text(f" ! drone {drone_id}: {process} silent", style="bold red"))
                elif beat.status != heartbeat_t.OK:
                    lines.append(Text(f" ! drone {drone_id}: {process}: {beat.detail}", style="yellow"))
        return [*lines, Text()] if lines else []

    def _event_lines(self) -> list[Text]:
        return [Text(f"{t_s:7.1f} s  {text}", style="dim", no_wrap=True) for t_s, text in self._events]

    def _status_line(self) -> str:
        drones = ", ".join(
            f"{drone_id} {state_name(row.state) if row.state is not None else '-'}"
            + (f" over {row.identity}" if row.identity >= 0 else "")
            for drone_id, row in self._rows.items()
        )
        stage = self._stage() or "start"
        return f"{self._now_s:7.1f} s  {stage}: drones {drones}; {self._factor:.2f} x real time"


def _cells(row: _Row, now_s: float) -> tuple[str, ...]:
    """Animal, height, battery, links, camera, detector, tracker, log."""
    return (
        str(row.identity) if row.identity >= 0 else "-",
        "-" if row.height_m is None else f"{round(row.height_m)} m",
        "-" if row.battery is None or row.battery < 0 else f"{row.battery:.0%}",
        "-" if row.links is None else f"{row.links[0]}/{row.links[1]}",
        _rate(row, channels.FRAME, now_s),
        _rate(row, channels.DETECTIONS, now_s),
        _rate(row, channels.TRACK, now_s),
        "-" if row.log_bytes is None else f"{row.log_bytes / 1e6:.1f} MB",
    )


def _rate(row: _Row, channel: str, now_s: float) -> str:
    """How often a channel is heard by the process that hears it most, by its newest heartbeat."""
    rates = [
        rate_hz
        for when_s, beat in row.beats.values()
        if now_s - when_s <= SILENT_AFTER_S
        for name, rate_hz in zip(beat.rate_names, beat.rates_hz, strict=True)
        if name == channel
    ]
    return f"{max(rates):.0f} Hz" if rates else "-"
