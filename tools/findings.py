"""What a check of a machine or of a fleet file found, and the command or the line that mends it."""

from dataclasses import dataclass

__all__ = ["Finding"]


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at; `lacks` and `mend` are empty where it is well."""

    what: str
    found: str = ""
    lacks: str = ""
    mend: str = ""
