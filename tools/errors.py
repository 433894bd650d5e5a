"""Errors that a person meets at the command line: one line on stderr and an exit code, never a traceback.

    1  the mission was flown and did not succeed, or a process tree fell
    2  what was given cannot be used: a file, an option, a value
    3  this machine lacks something: a route, a model, a key
"""

from collections.abc import Iterator
from contextlib import contextmanager

import typer

from drivers.sim.render.scene import SurfaceError
from logs.exceptions import LogError
from procs.detector.yolo import ModelError
from procs.relay.keys import FleetKeyError
from procs.runtime import RuntimeFailure
from procs.settings import MissionError

__all__ = ["FAILED", "MISSING", "UNUSABLE", "plain_errors"]

FAILED, UNUSABLE, MISSING = 1, 2, 3
EXIT_CODES: dict[type[Exception], int] = {
    MissionError: UNUSABLE,
    LogError: UNUSABLE,
    SurfaceError: UNUSABLE,
    ModelError: MISSING,
    FleetKeyError: MISSING,
    RuntimeFailure: MISSING,
}


@contextmanager
def plain_errors() -> Iterator[None]:
    """Turn the errors that a user can cause or mend into one line and an exit code."""
    try:
        yield
    except tuple(EXIT_CODES) as error:
        typer.echo(f"podwatch: {error}", err=True)
        raise typer.Exit(next(code for kind, code in EXIT_CODES.items() if isinstance(error, kind))) from None
