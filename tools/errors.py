"""Errors that a person meets at the command line: one line on stderr and an exit code, never a traceback.

1  what was asked for was tried and failed: a process tree fell, no animal was found
2  what was given cannot be used: a file, an option, a value
3  this machine lacks something: a route, a model, a key, room on the disk
130  stopped by Ctrl-C
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer

__all__ = [
    "FAILED",
    "INTERRUPTED",
    "MISSING",
    "UNUSABLE",
    "UnusableError",
    "exit_code_of",
    "plain_errors",
    "wanted_extra",
]

FAILED, UNUSABLE, MISSING = 1, 2, 3
INTERRUPTED = 130  # as shells say of SIGINT
# By name, so that a command imports no more than it needs: what was raised has been imported.
EXIT_CODES = {
    ("procs.settings", "MissionError"): UNUSABLE,
    ("logs.exceptions", "LogError"): UNUSABLE,
    ("drivers.sim.render.scene", "SurfaceError"): UNUSABLE,
    ("tools.boat.orders", "OrderError"): UNUSABLE,
    ("tools.boat.orders", "BoatError"): FAILED,
    ("tools.bench.faults", "FaultsError"): FAILED,
    ("tools.errors", "UnusableError"): UNUSABLE,
    ("tools.evidence", "EvidenceError"): UNUSABLE,
    ("tools.views", "ViewsError"): UNUSABLE,
    ("procs.detector.decode", "ModelError"): MISSING,
    ("procs.relay.keys", "FleetKeyError"): MISSING,
    ("procs.runtime", "RuntimeFailure"): MISSING,
    ("tools.supervision", "CannotStartError"): MISSING,
    ("tools.supervision", "SupervisorError"): FAILED,
}


class UnusableError(ValueError):
    """A file, an option or a value that was given is of no use; the message says why, and the remedy."""


@contextmanager
def plain_errors() -> Iterator[None]:
    """Turn the errors that a user can cause or mend into one line and an exit code.

    An OSError that nobody foresaw (a full disk, a file that vanished) is told with its file; what is left is
    a fault of ours and keeps its traceback.
    """
    try:
        yield
    except Exception as error:
        code = exit_code_of(error)
        if code is None:
            raise
        typer.echo(f"podwatch: {_told(error)}", err=True)
        raise typer.Exit(code) from None


@contextmanager
def wanted_extra(name: str) -> Iterator[None]:
    """Say which extra is missing where an import of its libraries fails."""
    try:
        yield
    except ImportError as error:
        typer.echo(
            f"podwatch: {error.name} is missing; install the extra: pip install 'podwatch[{name}]'", err=True
        )
        raise typer.Exit(MISSING) from None


def exit_code_of(error: Exception) -> int | None:
    """The exit code of an error that a user can cause or mend, None of any other."""
    for (module, name), code in EXIT_CODES.items():
        kind = getattr(sys.modules.get(module), name, None)
        if kind is not None and isinstance(error, kind):
            return code
    return MISSING if isinstance(error, OSError) else None


def _told(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}; check the path, its permissions and the room on the disk"
    return str(error)
