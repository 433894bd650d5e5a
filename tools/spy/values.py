"""A decoded message for people: on one line, or one member a line with the unit that its .lcm file gives."""

import re
from functools import cache
from importlib import resources
from typing import Any

from tools.log.inspect import describe, describe_value

__all__ = ["brief", "member_lines"]

HEAD = ("utime", "seq", "drone_id")
MEMBER = re.compile(r"^\s*\S+\s+(\w+)(?:\[.*\])*;\s*//\s*(.*)$")


def brief(message: Any) -> str:
    """A message on one line without what every message begins with."""
    text = describe(message)
    if isinstance(message, bytes):
        return text
    names = [name for name in message.__slots__ if name in HEAD]
    return text.split(" ", len(names))[-1] if len(message.__slots__) > len(names) else text


def member_lines(message: Any) -> list[tuple[str, str, str]]:
    """(member, value, unit and meaning) of each member; bytes that did not decode are one line."""
    if isinstance(message, bytes):
        return [("bytes", describe(message), "")]
    meanings = _meanings(type(message).__name__)
    return [
        (name, describe_value(getattr(message, name)), meanings.get(name, "")) for name in message.__slots__
    ]


@cache
def _meanings(type_name: str) -> dict[str, str]:
    """Member -> its comment in the .lcm file."""
    source = resources.files("lcmtypes").joinpath(f"{type_name}.lcm")
    if not source.is_file():
        return {}
    found = (MEMBER.match(line) for line in source.read_text(encoding="utf-8").splitlines())
    return {match[1]: match[2] for match in found if match}
