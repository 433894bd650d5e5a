"""What the commands of `podwatch log` share: the command's table, its arguments, how errors are told."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from logs.exceptions import LogError, LogWarning

__all__ = ["LogPath", "app", "clear_errors", "size_text", "warn"]

EXIT_BAD_INPUT = 2

app = typer.Typer(help="Look into a drone's MCAP log, mend it, convert it.", no_args_is_help=True)

LogPath = Annotated[Path, typer.Argument(help="A drone's .mcap log, as in runs/<time>/.", show_default=False)]


def size_text(n_bytes: int) -> str:
    """A size for people: "1.2 MB"."""
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if n_bytes >= scale:
            return f"{n_bytes / scale:.1f} {unit}"
    return f"{n_bytes} B"


def warn(text: str) -> None:
    """A line on stderr of something that is wrong with a log and does not stop the command."""
    sys.stderr.write(f"warning: {text}\n")


@contextmanager
def clear_errors() -> Iterator[None]:
    """A LogError becomes a line on stderr and exit code 2, a LogWarning a line on stderr."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", LogWarning)
        warnings.showwarning = _show_warning
        try:
            yield
        except LogError as error:
            sys.stderr.write(f"{error}\n")
            raise typer.Exit(EXIT_BAD_INPUT) from None


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    warn(str(message))
