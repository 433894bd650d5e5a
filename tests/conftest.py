"""For the whole suite: only missing hardware or data may skip a test, and the last line says what did."""

import re
from collections import Counter
from collections.abc import Generator
from typing import Any

import pytest

# A test may need what not every machine has; its reason names it. Anything else that skips fails the run.
MAY_LACK = re.compile(r"autopilot|GPU|serial port|\.\./shared|PODWATCH_REAL_DATA")


def skipped_reasons(config: pytest.Config) -> Counter[str]:
    """Reason -> how many tests it skipped."""
    reporter: Any = config.pluginmanager.get_plugin("terminalreporter")
    reports = reporter.stats.get("skipped", []) if reporter else []
    return Counter(reason_of(report) for report in reports)


def reason_of(report: pytest.TestReport) -> str:
    """Why a test was skipped, in its own words."""
    if isinstance(report.longrepr, tuple):
        return str(report.longrepr[2]).removeprefix("Skipped: ")
    return getattr(report, "wasxfail", "") or "no reason given"


def last_line(reasons: Counter[str]) -> str:
    """One line for people: what did not run here, and for want of what."""
    if not reasons:
        return "Nothing was skipped."
    parts = "; ".join(f"{count} for want of: {reason}" for reason, count in sorted(reasons.items()))
    return f"Skipped {sum(reasons.values())}: {parts}"


@pytest.hookimpl(wrapper=True)
def pytest_sessionfinish(session: pytest.Session) -> Generator[None]:
    yield
    if is_worker(session.config):
        return
    wrong = [reason for reason in skipped_reasons(session.config) if not MAY_LACK.search(reason)]
    if wrong and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_unconfigure(config: pytest.Config) -> None:
    """After pytest's own last line."""
    reporter: Any = config.pluginmanager.get_plugin("terminalreporter")
    if is_worker(config) or reporter is None or config.option.collectonly:
        return
    reasons = skipped_reasons(config)
    reporter.write_line(last_line(reasons))
    wrong = sorted(reason for reason in reasons if not MAY_LACK.search(reason))
    if wrong:
        reporter.write_line(f"These may not skip, and so the run has failed: {'; '.join(wrong)}", red=True)


def is_worker(config: pytest.Config) -> bool:
    """Whether this is one of several processes that run the tests for another, which reports."""
    return hasattr(config, "workerinput")
