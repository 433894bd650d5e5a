"""What went wrong, in plain words, the worst first; and the one sentence that a mission comes to."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby, pairwise

from lcmtypes import channels
from procs.navigator.states import Event
from tools.called import call_words
from tools.report.flights import Flight
from tools.report.watching import lost_spans, shared_spans
from tools.report.words import PROCESS_WORDS, clock, count, drones, lasting, plain, state_words
from tools.sights import Span, monitor_spans, state_spans
from tools.summary import headline

__all__ = ["Finding", "find_findings", "sentence"]

LOW_SHARE = 0.9  # an animal in the picture for less than this is worth a word
LOW_BATTERY = 0.15
POOR_LINK = 0.15  # of its messages lost
SILENT_S = 5.0  # a link that is down for so long
TROUBLE_S = 2.0  # a process that is in trouble for less is not worth a word
MOST_WORDS = 160
GRAVE, WRONG, NOTE = 0, 1, 2
# Reasons for which a drone leaves its work that people should hear of.
SETBACKS = {
    Event.NOT_CLIMBING.value: "did not take off",
    Event.NOT_AGREED.value: "could not agree with the others which animal is which, and tried again",
    Event.NOT_CERTIFIED.value: "could not agree with the others who takes which animal, and tried again",
    Event.ANIMAL_LOST.value: "lost its animal for too long and gathered with the others again",
    Event.CONFLICT.value: "found another drone over its animal and gave way",
    Event.STUCK.value: "went home, as the fleet could not agree in time",
    Event.BLIND.value: "went home, as its camera or its finding of animals was silent",
    Event.BATTERY_LOW.value: "went home early, its battery was low",
    Event.BATTERY_EMPTY.value: "landed where it was, its battery was nearly empty",
    Event.SEARCHED.value: "searched the whole area and found no animal",
    Event.DOUBT.value: "stopped in the air, its position or its autopilot was in doubt",
    Event.PILOT.value: "stopped, a pilot took it over",
    Event.HELD_TOO_LONG.value: "went home after it had held in the air for too long",
}


@dataclass(frozen=True)
class Finding:
    """One sentence; at_s: where to look on the time slider, None where there is no such instant."""

    rank: int  # GRAVE, WRONG or NOTE
    text: str
    at_s: float | None = None
    is_last: bool = False  # of its rank


def sentence(flight: Flight, watched: dict[int, list[Span]]) -> tuple[bool | None, str]:
    """(whether it went well, None where nobody can know; the mission in one sentence)."""
    if flight.knows_animals:
        is_good, words = headline(flight.summary)
        words = plain(words)
        if is_good and flight.run.truth.deaths:
            words = words.replace(" in view", " in view for as long as it flew")
        return is_good, words
    n_watched = sum(1 for log in flight.run.drones if monitor_spans(log))
    call = plain(call_words(flight.summary))
    if not n_watched and flight.summary["ordered"]:
        return None, f"{call}, before it came to watch an animal."
    is_good, words = _by_their_word(flight, watched, n_watched)
    return is_good, f"{words} {call}." if call else words


def _by_their_word(flight: Flight, watched: dict[int, list[Span]], n_watched: int) -> tuple[bool | None, str]:
    if not n_watched:
        return False, "No drone came to watch an animal."
    shared = shared_spans(watched)
    if shared:
        return False, "Two drones watched the same animal for a time, by their own word."
    window = flight.verdict.monitor_window_s
    # Where a log ends early, the window is that of the drones that are left.
    is_whole = window is not None and not flight.cut_short
    together = f", all at the same time for {lasting(window[1] - window[0])}" if window and is_whole else ""
    if n_watched == 1:
        return (
            None,
            f"One drone says that it watched an animal{together.replace('all at the same time ', '')}.",
        )
    return (
        None,
        f"{count(n_watched, 'drone').capitalize()} say that each watched an animal of its own{together}.",
    )


def find_findings(flight: Flight, watched: dict[int, list[Span]], is_good: bool | None) -> list[Finding]:
    """Everything that people should know beside the sentence, the worst first, then by time."""
    found = [
        *_judged(flight, watched, is_good),
        *_ends(flight),
        *_lost(flight, watched),
        *_setbacks(flight),
        *_batteries(flight),
        *_links(flight),
        *_troubles(flight),
        *_notes(flight),
    ]
    once = {finding.text: finding for finding in reversed(found)}
    return sorted(
        once.values(), key=lambda f: (f.rank, f.is_last, -1.0 if f.at_s is None else f.at_s, f.text)
    )


def _judged(flight: Flight, watched: dict[int, list[Span]], is_good: bool | None) -> Iterator[Finding]:
    if flight.knows_animals and is_good is False:
        for reason in flight.verdict.reasons:
            since = re.search(r"from (\d+\.?\d*) s$", reason)
            yield Finding(GRAVE, _sentence(plain(reason)), float(since[1]) if since else None)
    if not flight.knows_animals:
        for one, other, span in shared_spans(watched):
            yield Finding(
                GRAVE,
                f"{drones([one, other])} both said that they watched animal {span.what}, from "
                f"{clock(span.from_s)} to {clock(span.to_s)}.",
                span.from_s,
            )


def _ends(flight: Flight) -> Iterator[Finding]:
    """Drones that did not come home."""
    aloft: dict[str, list[int]] = {}
    for drone in flight.summary["drones"]:
        drone_id, died_s = drone["id"], drone["died_s"]
        log = next(log for log in flight.run.drones if log.id == drone_id)
        if drone_id in flight.cut_short:
            doing = state_words(log.states[-1][1])
            yield Finding(
                GRAVE,
                f"Drone {drone_id}'s log ends at {clock(died_s)}, before the others'; its last word: it "
                f"{doing}. The drone or its recorder failed.",
                max(died_s - 1, 0),
            )
        elif died_s is not None:
            yield Finding(
                GRAVE, f"Drone {drone_id} failed at {clock(died_s)} and was not heard again.", died_s
            )
        elif drone["final_state"] is None:
            yield Finding(GRAVE, f"Drone {drone_id} left no log that can be read.")
        elif drone["final_state"] not in ("LANDED", "IDLE"):
            aloft.setdefault(drone["final_state"], []).append(drone_id)
    for state, ids in aloft.items():
        was = "was" if len(ids) == 1 else "were"
        yield Finding(
            WRONG,
            f"The record ends before {drones(ids).lower()} {was} back on the ground; last word: "
            f"{state_words(state)}.",
            flight.end_s,
        )


def _lost(flight: Flight, watched: dict[int, list[Span]]) -> Iterator[Finding]:
    for drone_id, gaps in lost_spans(flight, watched).items():
        total_s = sum(to_s - from_s for from_s, to_s in gaps)
        if len(gaps) == 1:
            from_s, to_s = gaps[0]
            when = f"from {clock(from_s)} to {clock(to_s)} ({lasting(total_s)})"
            yield Finding(WRONG, f"Drone {drone_id} had lost its animal {when}.", from_s)
        elif gaps:
            text = f"Drone {drone_id} lost its animal {len(gaps)} times, for {lasting(total_s)} in all."
            yield Finding(WRONG, text, gaps[0][0])
    for drone in flight.summary["drones"]:
        share = drone["in_image_share"]
        if share is not None and share < LOW_SHARE:
            text = f"Drone {drone['id']} had its animal in the picture for only {share:.0%} of its watch."
            yield Finding(WRONG, text)


def _setbacks(flight: Flight) -> Iterator[Finding]:
    """Steps back in a mission, each drone's of one kind told once."""
    for log in flight.run.drones:
        rows = flight.run.messages[log.id][channels.MISSION_STATE]
        steps = [(t_s, row.reason) for t_s, row in rows]
        began: dict[str, list[float]] = {}
        for reason, group in groupby(steps, key=lambda step: step[1]):
            first_s = next(group)[0]
            for words in [words for setback, words in SETBACKS.items() if reason.startswith(setback)][:1]:
                began.setdefault(words, []).append(first_s)
        for words, times_s in began.items():
            when = f"at {clock(times_s[0])}" if len(times_s) == 1 else f"{len(times_s)} times"
            yield Finding(WRONG, f"Drone {log.id} {words} ({when}).", times_s[0])


def _batteries(flight: Flight) -> Iterator[Finding]:
    for log in flight.run.drones:
        states = flight.run.messages[log.id][channels.VEHICLE_STATE]
        low = next(((t_s, s.battery) for t_s, s in states if 0 <= s.battery < LOW_BATTERY), None)
        if low is not None:
            least = min(state.battery for _, state in states if state.battery >= 0)
            yield Finding(WRONG, f"Drone {log.id}'s battery fell to {least:.0%}.", low[0])


def _links(flight: Flight) -> Iterator[Finding]:
    """Neighbours that lost each other while both were in the air, and links that lost much."""
    told = set()
    for log in flight.run.drones:
        for peer_id, spans in _silences(flight, log.id).items():
            pair = frozenset((log.id, peer_id))
            if spans and pair not in told:
                told.add(pair)
                total_s = sum(to_s - from_s for from_s, to_s in spans)
                text = f"{drones(sorted(pair))} did not hear each other by radio for {lasting(total_s)}."
                yield Finding(WRONG, text, spans[0][0])
    for link in flight.summary["links"]:
        if link["loss"] is not None and link["loss"] > POOR_LINK and link["to"] > 0:
            text = f"Drone {link['from']} missed {link['loss']:.0%} of what drone {link['to']} sent by radio."
            yield Finding(NOTE, text)


def _silences(flight: Flight, drone_id: int) -> dict[int, list[tuple[float, float]]]:
    """Peer -> when its link was down for SILENT_S or longer, between two times at which it was up."""
    heard: dict[int, list[float]] = {}
    for t_s, state in flight.run.messages[drone_id][channels.LINK_STATE]:
        for link in state.links:
            if link.up and link.peer_id > 0:
                heard.setdefault(link.peer_id, []).append(t_s)
    return {
        peer_id: [(before, after) for before, after in pairwise(times_s) if after - before >= SILENT_S]
        for peer_id, times_s in heard.items()
    }


def _troubles(flight: Flight) -> Iterator[Finding]:
    """Processes that said of themselves that something is wrong, for a while, in the air."""
    for log in flight.run.drones:
        flown = [s for s in state_spans(log.states) if s.what not in ("IDLE", "LANDED")]
        beats: dict[tuple[str, str], list[float]] = {}
        for t_s, beat in flight.run.messages[log.id][channels.HEARTBEAT]:
            if beat.status != beat.OK and any(span.from_s <= t_s <= span.to_s for span in flown):
                cause = re.split(r"[;:]", beat.detail)[0][:MOST_WORDS]
                beats.setdefault((beat.process, re.sub(r"[\d.]+", "#", cause)), []).append(t_s)
        worst: dict[str, list[float]] = {}
        for (process, _), times_s in beats.items():
            if times_s[-1] - times_s[0] >= TROUBLE_S:
                worst.setdefault(process, []).extend(times_s)
        for process, times_s in worst.items():
            what = PROCESS_WORDS.get(process, process[:MOST_WORDS])
            text = (
                f"Drone {log.id}: its {what} reported trouble between {clock(min(times_s))} and "
                f"{clock(max(times_s))}."
            )
            yield Finding(NOTE, text, min(times_s))


def _notes(flight: Flight) -> Iterator[Finding]:
    # That the log of a drone that died was never closed is no news.
    died = tuple(f"drone {drone_id}: " for drone_id in flight.run.truth.deaths)
    unread = [p for p in flight.run.problems if not (p.startswith(died) and "was not closed" in p)]
    if unread:
        n_parts = len(unread)
        places = f"{n_parts} place{'' if n_parts == 1 else 's'}"
        text = (
            f"Not everything could be read ({places}), so something may be missing here; see “What could not "
            "be read” below."
        )
        yield Finding(WRONG, text, None, is_last=True)
    if flight.summary["sensor"] == "boxes":
        text = "Simulated without pictures: what the cameras saw was drawn by lot, with measured errors."
        yield Finding(NOTE, text)


def _sentence(words: str) -> str:
    return words[:1].upper() + words[1:] + ("" if words.endswith(".") else ".")
