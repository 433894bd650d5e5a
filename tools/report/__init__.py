"""report.html: one file that tells a mission, or a day of them, to people (docs/report.md)."""

from pathlib import Path

__all__ = ["make_report"]


def make_report(folder: Path) -> Path:
    """Write report.html into a run's folder -> its path.

    Raises logs.exceptions.LogError where the folder holds no drone's log.
    """
    from tools.report.page import make_report as make

    return make(folder)
