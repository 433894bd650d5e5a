"""Single keys from a terminal, and none where there is no terminal."""

import os
import select
import sys
import termios
import tty
from types import TracebackType
from typing import Self

__all__ = ["Keys"]


class Keys:
    """Keys as they are pressed; use as a context manager, which gives the terminal back as it was."""

    def __init__(self, descriptor: int | None = None) -> None:
        """descriptor: of a terminal; None is this process's own input, where that is one."""
        if descriptor is None and sys.stdin is not None and sys.stdin.isatty():
            descriptor = sys.stdin.fileno()
        self._descriptor = descriptor
        self._kept: list[object] | None = None

    @property
    def is_terminal(self) -> bool:
        return self._descriptor is not None

    def __enter__(self) -> Self:
        if self._descriptor is not None:
            self._kept = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._descriptor is not None and self._kept is not None:
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._kept)  # type: ignore[arg-type]

    def wait(self, seconds: float) -> str:
        """The next key within `seconds`, "" where none is pressed.

        A terminal that was closed is the end of the program, as Ctrl-C: KeyboardInterrupt.
        """
        sources = [] if self._descriptor is None else [self._descriptor]
        ready, _, _ = select.select(sources, [], [], max(seconds, 0.0))
        if not ready or self._descriptor is None:
            return ""
        try:
            key = os.read(self._descriptor, 1).decode("latin-1")
        except OSError:
            key = ""
        if not key:
            self._kept = None  # there is nothing to give back
            raise KeyboardInterrupt
        return key
