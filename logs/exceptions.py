"""What can go wrong with a log.

Exception
 └── LogError      a log cannot be written or read; the message names the path, what is wrong and the remedy
UserWarning
 └── LogWarning    a log reads, but not all of it; with `strict=True` the reader raises LogError
"""

__all__ = ["LogError", "LogWarning"]


class LogError(Exception):
    """A log cannot be written or read; the message names the path, what is wrong and the remedy."""


class LogWarning(UserWarning):
    """A log reads, but not all of it."""
