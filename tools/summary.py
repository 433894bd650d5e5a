"""summary.json: a run in figures, and the same for people at the end of `podwatch sim`.

`summarise(folder)` reads truth and logs, asks the judge and counts; nothing in it rests on what the simulator
hoped for. Times are simulation time, rates per second of it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from lcmtypes import channels
from procs.navigator.states import State
from tools.called import Order, call_words, fleet_order, order_of
from tools.evidence import DroneLog, Run, load_run
from tools.judge import DroneVerdict, Verdict, judge
from tools.sights import inside, monitor_spans

__all__ = ["headline", "print_summary", "summarise", "summary_of", "write_summary"]

Summary = dict[str, Any]


def summarise(folder: Path) -> Summary:
    """The figures of a run's folder, ready for JSON. Raises tools.evidence.EvidenceError where truth is
    missing.
    """
    run = load_run(folder)
    return summary_of(run, judge(run.truth, run.drones))


def write_summary(folder: Path) -> Summary:
    """`summarise`, and write it as summary.json into the folder."""
    summary = summarise(folder)
    (folder / "summary.json").write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n")
    return summary


def summary_of(run: Run, verdict: Verdict) -> Summary:
    """The figures of a run that is read and judged: every name of issue and docs/judge.md, None where
    unknown.
    """
    window = verdict.monitor_window_s
    latencies_ms = _latencies_ms(run)
    states = {drone_id: messages[channels.MISSION_STATE] for drone_id, messages in run.messages.items()}
    return {
        "mission": run.mission.get("name"),
        "mode": run.about.get("mode"),
        "fallback_reason": run.about.get("fallback_reason"),
        "sensor": run.about.get("sensor"),
        "scene": run.about.get("scene"),
        "seed": run.about.get("seed"),
        "distinct": verdict.distinct,
        "consensus": verdict.consensus,
        "reasons": list(verdict.reasons),
        "ordered": _order(fleet_order(states)),
        "episodes": verdict.episodes,
        "seconds_to_monitor": _rounded(verdict.seconds_to_monitor, 2),
        "monitor_window_s": [_rounded(t_s, 2) for t_s in window] if window else None,
        "distinct_share": _rounded(verdict.distinct_share, 4),
        "realtime_factor": _rounded(run.about.get("realtime_factor"), 3),
        "wall_s": _rounded(run.about.get("wall_s"), 1),
        "simulated_s": _rounded(float(run.truth.t_s[-1]), 2),
        "n_animals": len(run.truth.animals) if run.truth.is_labelled else None,
        "camera_to_setpoint_ms": {
            "p50": _percentile(latencies_ms, 50),
            "p99": _percentile(latencies_ms, 99),
            "n": len(latencies_ms),
        },
        "drones": [_drone(run, log, about) for log, about in zip(run.drones, verdict.drones, strict=True)],
        "links": [link for log in run.drones for link in _links(run, log.id)],
        "problems": list(run.problems),
    }


def headline(summary: Summary) -> tuple[bool | None, str]:
    """(whether it went well, None where that cannot be told; one sentence for a biologist).

    Of a flight that a person ended early it is told what was reached until then.
    """
    is_good, words = _went(summary)
    call = call_words(summary)
    if not call:
        return is_good, words
    if summary["ordered"] and summary["monitor_window_s"] is None:
        reached = "its animals together" if len(summary["drones"]) > 1 else "an animal"
        return None, f"{call}, before it watched {reached}."
    if summary["ordered"] and is_good:
        return True, f"{words[:-1]}, until {call[:1].lower()}{call[1:]}."
    return is_good, f"{words} {call}."


def _went(summary: Summary) -> tuple[bool | None, str]:
    watching = [drone for drone in summary["drones"] if drone["monitor_s"]]
    if summary["distinct"] is None:
        return None, (
            f"{_count(len(watching), 'drone')} watched animals; nobody marked the animals of this scene, "
            "so who watched whom cannot be judged."
        )
    if all(drone["final_state"] == State.IDLE.name for drone in summary["drones"]):
        return False, "No drone took off."
    if summary["monitor_window_s"] is None:
        return False, "The fleet never came to watch its animals together."
    if not summary["distinct"]:
        return False, "The drones did not each keep an animal of their own in view."
    if not summary["consensus"]:
        return False, "Each drone watched an animal of its own, but they did not agree which animal is which."
    if len(watching) == 1:
        return True, "The drone kept its animal in view."
    return True, "Each drone kept an animal of its own in view, and all agreed which animal is which."


def print_summary(summary: Summary, console: Console) -> None:
    """Say how a run went: the sentence that matters first, what went wrong, then the figures."""
    is_good, sentence = headline(summary)
    mark, style = {True: ("✓", "bold green"), False: ("✗", "bold red"), None: ("?", "bold yellow")}[is_good]
    console.print(f"\n{mark} {sentence}", style=style, highlight=False)
    reasons = summary["reasons"] if is_good is False else []
    points = Table.grid(padding=(0, 1))
    for point in [*reasons, *(f"not everything could be read: {problem}" for problem in summary["problems"])]:
        points.add_row(" -", Text(point))
    if points.row_count:
        console.print(points)
    window = summary["monitor_window_s"]
    if window:
        console.print(
            f"  All were watching {summary['seconds_to_monitor']:.0f} s after the start; "
            f"watched together for {window[1] - window[0]:.0f} s.",
            highlight=False,
        )
    console.print(_drone_table(summary))
    console.print(
        "  its animal: as the fleet calls it; truly: that animal's number in truth.csv\n",
        highlight=False,
        style="dim",
    )
    if summary["links"]:
        console.print(_link_table(summary))
    console.print(_footer(summary), highlight=False, markup=False, style="dim")


def _drone(run: Run, log: DroneLog, about: DroneVerdict) -> Summary:
    ages_ms = _setpoint_ages_ms(run.messages[log.id][channels.VEHICLE_STATE])
    seen = inside(log.track_t_s, monitor_spans(log)) & np.isfinite(log.track_px).all(axis=1)
    death_s = run.truth.deaths.get(log.id)
    return {
        "id": log.id,
        "animal": about.animal if run.truth.is_labelled else None,
        "identity": about.identity,
        "assigned": about.is_assigned,
        "final_state": "DEAD" if death_s is not None else log.states[-1][1] if log.states else None,
        "died_s": _rounded(death_s, 2),
        "ordered": _order(order_of(run.messages[log.id][channels.MISSION_STATE])),
        "monitor_s": _rounded(about.monitor_s, 2),
        "in_image_share": _rounded(about.in_image_share, 4),
        "watch_share": _rounded(about.watch_share, 4),
        "tracker_hz": _rounded(float(seen.sum()) / about.monitor_s, 2) if about.monitor_s else None,
        "setpoint_age_p99_ms": _percentile(ages_ms, 99),
    }


def _order(order: Order | None) -> Summary | None:
    return None if order is None else {"order": order.word, "at_s": _rounded(order.at_s, 2)}


def _setpoint_ages_ms(states: Sequence[tuple[float, Any]]) -> list[float]:
    """Age of each setpoint when it was passed on to the autopilot, each once."""
    ages = {state.setpoint_utime: state.setpoint_age_us / 1000 for _, state in states if state.setpoint_utime}
    return list(ages.values())


def _latencies_ms(run: Run) -> list[float]:
    """From a frame's capture to the first setpoint that rests on it, over all drones."""
    latencies = []
    for drone_id in sorted(run.messages):
        first: dict[int, int] = {}
        for _, setpoint in run.messages[drone_id][channels.SETPOINT]:
            if setpoint.cause_utime:
                first.setdefault(setpoint.cause_utime, setpoint.utime)
        latencies += [(said - cause) / 1000 for cause, said in first.items()]
    return latencies


def _links(run: Run, drone_id: int) -> list[Summary]:
    """One row a link, as the sender's relay counted it: mean bytes a second by kind since the link was first
    up.
    """
    rows: dict[int, list[Any]] = {}
    for _, state in run.messages[drone_id][channels.LINK_STATE]:
        for link in state.links:
            if link.up or link.peer_id in rows:
                rows.setdefault(link.peer_id, []).append(link)
    return [_link(drone_id, peer_id, links) for peer_id, links in sorted(rows.items())]


def _link(drone_id: int, peer_id: int, links: list[Any]) -> Summary:
    total: dict[str, int] = {}
    largest: dict[str, dict[str, int]] = {}
    for link in links:
        for i, kind in enumerate(link.kinds):
            total[kind] = total.get(kind, 0) + link.bytes_out[i]
            sizes = largest.setdefault(kind, {"payload": 0, "encoded": 0, "datagram": 0})
            sizes["payload"] = max(sizes["payload"], link.max_payload[i])
            sizes["encoded"] = max(sizes["encoded"], link.max_encoded[i])
            sizes["datagram"] = max(sizes["datagram"], link.max_datagram[i])
    up = [link for link in links if link.up]
    return {
        "from": drone_id,
        "to": peer_id,
        "bytes_per_s": {kind: round(n_bytes / len(links), 1) for kind, n_bytes in sorted(total.items())},
        "bytes_per_s_total": round(sum(total.values()) / len(links), 1),
        "largest_payload_bytes": _largest(largest, "payload"),
        "largest_encoded_bytes": _largest(largest, "encoded"),
        "largest_datagram_bytes": _largest(largest, "datagram"),
        "largest_by_kind": dict(sorted(largest.items())),
        "up_share": round(len(up) / len(links), 4),
        "loss": _rounded(float(np.mean([link.loss for link in up])) if up else None, 4),
        "round_trip_ms": _rounded(min((link.round_trip_us for link in up), default=0) / 1000, 2)
        if up
        else None,
    }


def _largest(sizes: dict[str, dict[str, int]], what: str) -> int:
    return max((size[what] for size in sizes.values()), default=0)


def _drone_table(summary: Summary) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    titles = (
        "drone",
        "its animal",
        "truly",
        "watched",
        "in picture",
        "ended in",
        "tracker",
        "command age p99",
    )
    for title in titles:
        table.add_column(title, justify="left" if title in ("drone", "ended in") else "right")
    for drone in summary["drones"]:
        animal = drone["animal"]
        table.add_row(
            str(drone["id"]),
            "-" if drone["identity"] is None or drone["identity"] < 0 else str(drone["identity"]),
            "-" if animal is None else str(animal),
            f"{drone['monitor_s']:.0f} s" if drone["monitor_s"] else "-",
            _shown(drone["in_image_share"], "{:.1%}"),
            _ended(drone),
            _shown(drone["tracker_hz"], "{:.1f} Hz"),
            _shown(drone["setpoint_age_p99_ms"], "{:.0f} ms"),
        )
    return table


def _link_table(summary: Summary) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for title in ("link", "bytes/s", "largest payload", "encoded", "datagram", "lost", "up"):
        table.add_column(title, justify="left" if title == "link" else "right")
    for link in summary["links"]:
        table.add_row(
            f"{link['from']} → {link['to'] or 'boat'}",
            f"{link['bytes_per_s_total']:.0f}",
            f"{link['largest_payload_bytes']} B",
            f"{link['largest_encoded_bytes']} B",
            f"{link['largest_datagram_bytes']} B",
            _shown(link["loss"], "{:.1%}"),
            _shown(link["up_share"], "{:.0%}"),
        )
    return table


def _footer(summary: Summary) -> str:
    latency = summary["camera_to_setpoint_ms"]
    parts = [
        f"mode {summary['mode']}",
        f"seed {summary['seed']}",
        f"{_count(summary['episodes'], 'episode')}",
    ]
    if summary["fallback_reason"]:
        parts[0] += f" ({summary['fallback_reason']})"
    if summary["realtime_factor"] is not None:
        parts.append(f"{summary['realtime_factor']:.2f} x real time")
    if latency["p50"] is not None:
        parts.append(f"camera to command {latency['p50']:.0f} ms (p99 {latency['p99']:.0f} ms)")
    if summary["sensor"] == "boxes":
        parts.append("detections and tracks were drawn with calibrated errors, no pixels were looked at")
    return "  " + ", ".join(parts)


def _ended(drone: Summary) -> str:
    return (
        f"died at {drone['died_s']:.0f} s"
        if drone["died_s"] is not None
        else drone["final_state"] or "no log"
    )


def _shown(value: float | None, pattern: str) -> str:
    return "-" if value is None else pattern.format(value)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _percentile(values: Iterable[float], share: float) -> float | None:
    listed = list(values)
    return _rounded(float(np.percentile(listed, share)), 2) if listed else None


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), digits)
