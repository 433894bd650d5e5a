"""Pages of the docs made from the code: `python -m tools.docs` writes docs/processes.md, docs/channels.md and
docs/mission.md, and the table of states in docs/navigator.md.

A test compares the files with what this module makes, so that the docs say what the tables say.
"""

import ast
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from lcmtypes.channels import CHANNELS
from procs.navigator.states import State
from procs.processes import PROCESSES
from tools.docs_mission import mission_page
from tools.report.words import state_words

__all__ = ["PAGES", "channels_page", "processes_page"]

FOLDER = Path(__file__).parent.parent / "docs"
MADE = "<!-- made by `python -m tools.docs`; do not edit -->"
STATES_BEGIN = "<!-- states: made by `python -m tools.docs`; do not edit -->"
STATES_END = "<!-- end of states -->"
DOES = {
    State.IDLE: "stands, and waits for the mission, for an order, or for what it lacks",
    State.TAKEOFF: "climbs straight up over its home",
    State.SCOUT: "flies the spiral and looks for animals",
    State.STANDBY: "waits in the air: over its home, or beside a pod that has an animal too few",
    State.FOUND: "has animals in view, makes sure, and places itself over them",
    State.RENDEZVOUS: "flies to its place on the circle over the pod",
    State.REGISTER: "holds that place while the drones compare their views",
    State.ASSIGN: "holds that place while the drones share out the animals",
    State.MONITOR: "keeps its own animal in the middle of its picture",
    State.RETURN: "flies to over its home",
    State.LANDED: "is on the ground, its motors off",
    State.HOLD: "stays where it is: ordered to, in doubt about position or autopilot, or with its pilot",
    State.LAND: "comes down where it is",
}


def processes_page() -> str:
    """Every process of the table with its module's docstring."""
    lines = ["# The processes of a drone", "", MADE, ""]
    for process in PROCESSES:
        spec = find_spec(process.module)
        assert spec is not None
        assert spec.origin is not None
        docstring = ast.get_docstring(ast.parse(Path(spec.origin).read_text())) or ""
        lines += [
            f"## {process.name}",
            "",
            docstring,
            "",
            f"`{process.module}`; nominal time of a handler {1000 * process.compute_s:g} ms; missed after "
            f"{process.heartbeat_limit_s:g} s without HEARTBEAT; restart on the ground: "
            f"{process.restart_ground.value}, in the air: {process.restart_air.value}.",
            "",
        ]
    return "\n".join(lines)


def channels_page() -> str:
    """The channel table."""
    lines = [
        "# The channels of a drone's bus",
        "",
        MADE,
        "",
        "| channel | type | Hz | logged | crosses the ring | oldest believed |",
        "|---|---|---|---|---|---|",
    ]
    for channel in CHANNELS:
        logged = {0: "no", 1: "all"}.get(channel.log_every, f"each {channel.log_every}th")
        crosses = f"yes, priority {channel.priority}" if channel.crosses else "no"
        rate = f"{channel.rate_hz:g}" if channel.rate_hz else "on events"
        kind = channel.kind.__name__
        lines.append(
            f"| {channel.name} | [{kind}](../lcmtypes/{kind}.lcm) | {rate} | {logged} | {crosses} | "
            f"{channel.max_age_s:g} s |"
        )
    return "\n".join([*lines, ""])


def navigator_page() -> str:
    """docs/navigator.md with its table of states made anew: each with the report's word for it."""
    page = (FOLDER / "navigator.md").read_text()
    before, _, rest = page.partition(STATES_BEGIN)
    _, _, after = rest.partition(STATES_END)
    rows = [f"| {state.name} | {state_words(state.name)} | {DOES[state]} |" for state in State]
    table = "\n".join(["| state | in the report | what the drone does |", "|---|---|---|", *rows])
    return f"{before}{STATES_BEGIN}\n\n{table}\n\n{STATES_END}{after}"


PAGES: dict[str, Callable[[], str]] = {
    "processes.md": processes_page,
    "channels.md": channels_page,
    "mission.md": partial(mission_page, MADE),
    "navigator.md": navigator_page,
}


def main() -> None:
    """Write every page."""
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page())


if __name__ == "__main__":
    main()
