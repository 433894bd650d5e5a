"""What happened, in order: changes of state with their reason, losses, failures."""

from __future__ import annotations

from dataclasses import dataclass

from lcmtypes import channels
from lcmtypes.podwatch import heartbeat_t
from tools.evidence import state_name
from tools.report.flights import Flight
from tools.report.watching import lost_spans
from tools.report.words import PROCESS_WORDS, lasting, state_words
from tools.sights import Span

__all__ = ["Event", "list_events"]

MOST_WORDS = 200
MOST_EVENTS = 400


@dataclass(frozen=True)
class Event:
    """One line of the mission's story. is_trouble: worth a mark."""

    t_s: float
    drone_id: int
    text: str
    is_trouble: bool


def list_events(flight: Flight, watched: dict[int, list[Span]]) -> list[Event]:
    """By time; at most MOST_EVENTS, troubles of processes first left out."""
    events = [*_states(flight), *_losses(flight, watched)]
    events += _troubles(flight)[: max(MOST_EVENTS - len(events), 0)]
    return sorted(events, key=lambda event: (event.t_s, event.drone_id))[:MOST_EVENTS]


def _states(flight: Flight) -> list[Event]:
    events = []
    for log in flight.run.drones:
        last: tuple[int, str] | None = None
        for t_s, row in flight.run.messages[log.id][channels.MISSION_STATE]:
            if (row.state, row.reason) != last:
                state = state_name(row.state)
                reason = f": {row.reason[:MOST_WORDS]}" if row.reason else ""
                events.append(Event(t_s, log.id, f"{state_words(state)}{reason}", state == "HOLD"))
                last = (row.state, row.reason)
        if log.id in flight.run.truth.deaths:
            events.append(Event(flight.run.truth.deaths[log.id], log.id, "is not heard again", True))
    return events


def _losses(flight: Flight, watched: dict[int, list[Span]]) -> list[Event]:
    return [
        Event(from_s, drone_id, f"has lost its animal, for {lasting(to_s - from_s)}", True)
        for drone_id, gaps in lost_spans(flight, watched).items()
        for from_s, to_s in gaps
    ]


def _troubles(flight: Flight) -> list[Event]:
    """What processes said of themselves, at each change."""
    events = []
    for log in flight.run.drones:
        said: dict[str, str] = {}
        for t_s, beat in flight.run.messages[log.id][channels.HEARTBEAT]:
            detail = beat.detail[:MOST_WORDS] if beat.status != heartbeat_t.OK else ""
            if detail != said.get(beat.process, ""):
                said[beat.process] = detail
                what = PROCESS_WORDS.get(beat.process, beat.process[:MOST_WORDS])
                text = f"{what}: {detail or 'works again'}"
                events.append(Event(t_s, log.id, text, bool(detail)))
    return events
