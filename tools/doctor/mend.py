"""Commands that people are given to mend something."""

import os

__all__ = ["as_root"]


def as_root(command: str) -> str:
    """The command as this user must give it."""
    return command if os.geteuid() == 0 else f"sudo {command}"
