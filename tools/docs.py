"""Pages of the docs made from the code: `python -m tools.docs` writes docs/processes.md, docs/channels.md and
docs/mission.md.

A test compares the files with what this module makes, so that the docs say what the tables say.
"""

import ast
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from lcmtypes.channels import CHANNELS
from procs.processes import PROCESSES
from tools.docs_mission import mission_page

__all__ = ["PAGES", "channels_page", "processes_page"]

MADE = "<!-- made by `python -m tools.docs`; do not edit -->"


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


PAGES: dict[str, Callable[[], str]] = {
    "processes.md": processes_page,
    "channels.md": channels_page,
    "mission.md": partial(mission_page, MADE),
}


def main() -> None:
    """Write every page."""
    folder = Path(__file__).parent.parent / "docs"
    for name, page in PAGES.items():
        (folder / name).write_text(page())


if __name__ == "__main__":
    main()
