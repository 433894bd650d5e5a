"""report.html: one file that tells a run to people, without a network and without a script.

What went right or wrong stands first, in words; then the maps, who did what and watched whom when, what each
camera saw, and the figures of summary.json.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from tools.evidence import Run, load_run
from tools.judge import drone_list, judge
from tools.report.figures import animal_colour, draw_map, draw_timeline, drone_colour, pick_shots
from tools.summary import headline, summary_of

__all__ = ["STATE_WORDS", "make_report"]

# State -> what a drone in it does, for people; and its colour in the timeline.
STATE_WORDS = {
    "IDLE": ("on the ground", "#f2f2f0"),
    "TAKEOFF": ("takes off", "#dcdcd8"),
    "STANDBY": ("waits", "#e9e9e4"),
    "SCOUT": ("searches", "#b7d4ea"),
    "FOUND": ("has found a pod", "#7fb2d9"),
    "RENDEZVOUS": ("gathers", "#f5d9a8"),
    "REGISTER": ("agrees which is which", "#f2b661"),
    "ASSIGN": ("agrees who takes which", "#e0943a"),
    "MONITOR": ("watches its animal", "#5fb58a"),
    "RETURN": ("returns", "#d5cbe6"),
    "LAND": ("lands", "#b9a9d6"),
    "LANDED": ("landed", "#f2f2f0"),
    "HOLD": ("holds, in doubt", "#e58b88"),
}
UNKNOWN_STATE = ("in a state of another version", "#ffffff")
LOW_SHARE = 0.9  # an animal in the picture for less than this is worth a word


def make_report(folder: Path) -> Path:
    """Write report.html into a run's folder -> its path. Raises tools.evidence.EvidenceError where truth is
    missing.
    """
    run = load_run(folder)
    path = folder / "report.html"
    path.write_text(_render(run), encoding="utf-8")
    return path


def _render(run: Run) -> str:
    verdict = judge(run.truth, run.drones)
    summary = summary_of(run, verdict)
    is_good, sentence = headline(summary)
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(
        drone_colour=drone_colour,
        animal_colour=animal_colour,
        state_words=_state_words,
        state_colour=_state_colour,
    )
    template = environment.from_string(
        files("tools.report").joinpath("page.html.j2").read_text(encoding="utf-8")
    )
    return template.render(
        name=run.folder.name,
        summary=summary,
        is_good=is_good,
        headline=sentence,
        findings=_findings(summary, is_good),
        whole_map=draw_map(run.truth),
        watch_map=draw_map(run.truth, verdict.monitor_window_s) if verdict.monitor_window_s else None,
        timeline=draw_timeline(run, verdict),
        states=STATE_WORDS,
        strips={log.id: pick_shots(run, log) for log in run.drones},
        kinds=sorted({kind for link in summary["links"] for kind in link["bytes_per_s"]}),
    )


def _findings(summary: dict[str, Any], is_good: bool | None) -> list[str]:
    """What people should know beside the headline, the worst first."""
    findings = list(summary["reasons"]) if is_good is False else []
    aloft: dict[str, list[int]] = {}
    for drone in summary["drones"]:
        if drone["died_s"] is not None:
            findings.append(f"drone {drone['id']} died {drone['died_s']:.0f} s after the start")
        elif drone["final_state"] is None:
            findings.append(f"drone {drone['id']} left no log")
        elif drone["final_state"] != "LANDED":
            aloft.setdefault(drone["final_state"], []).append(drone["id"])
        if drone["in_image_share"] is not None and drone["in_image_share"] < LOW_SHARE:
            share = drone["in_image_share"]
            findings.append(
                f"drone {drone['id']} had its animal in the picture for only {share:.0%} of its watch"
            )
    findings += [
        f"the run ended before {drone_list(ids)} {'was' if len(ids) == 1 else 'were'} back on the ground; "
        f"last state {state}: {_state_words(state)}"
        for state, ids in aloft.items()
    ]
    findings += [f"not everything could be read: {problem}" for problem in summary["problems"]]
    if summary["fallback_reason"]:
        findings.append(f"flown in {summary['mode']} mode: {summary['fallback_reason']}")
    if summary["sensor"] == "boxes":
        findings.append("no pixels were looked at: detections and tracks were drawn with calibrated errors")
    return findings


def _state_words(state: str) -> str:
    return STATE_WORDS.get(state, UNKNOWN_STATE)[0]


def _state_colour(state: str) -> str:
    return STATE_WORDS.get(state, UNKNOWN_STATE)[1]
