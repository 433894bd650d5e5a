"""A pytest plugin for runs in a copy of the checkout: it notes what failed, and code that is not the copy's.

`tools.bench.faults` loads it by its path, so that it works in any copy; it imports nothing of podwatch.
"""

import json
import os
import sys
from pathlib import Path

import pytest

NOTES = "PODWATCH_FAULT_NOTES"  # where to write them


class Notes:
    """Of one run."""

    def __init__(self) -> None:
        self.n_passed = 0
        self.failures: list[tuple[str, str]] = []  # test, first line of why

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """One phase of one test is over."""
        if report.failed:
            self.failures.append((report.nodeid, _first_line(report)))
        elif report.when == "call" and report.passed:
            self.n_passed += 1

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write everything down."""
        notes = {"n_passed": self.n_passed, "failures": self.failures, "foreign": foreign_modules(Path.cwd())}
        Path(os.environ[NOTES]).write_text(json.dumps(notes))


def foreign_modules(copy: Path) -> list[str]:
    """Files that were imported in place of those of the same packages in the copy."""
    own = [path.name for path in copy.iterdir() if path.is_dir()]
    files = [
        getattr(module, "__file__", None)  # a folder without __init__.py has none
        for name, module in sorted(sys.modules.items())
        if name.partition(".")[0] in own
    ]
    return [file for file in files if file and not Path(file).resolve().is_relative_to(copy.resolve())]


def _first_line(report: pytest.TestReport) -> str:
    crash = getattr(report.longrepr, "reprcrash", None)
    text = str(crash.message if crash is not None else report.longrepr)
    first, *rest = [line.strip() for line in text.splitlines() if line.strip()] or [""]
    return " ".join([first, *rest[:1]]) if first.endswith(":") else first  # numpy says what only in the next


def pytest_configure(config: pytest.Config) -> None:
    """Of the process that reports; xdist's workers only run tests."""
    if NOTES in os.environ:
        config.pluginmanager.register(Notes(), "fault notes")
