"""A decoded message for people: on one line, or one member a line with the unit that its .lcm file gives."""

import re
from functools import cache
from importlib import resources
from typing import Any

from tools.log.inspect import describe, describe_value

__all__ = ["brief", "head_line", "member_lines"]

HEAD = ("utime", "seq", "drone_id")
ENUM = "enum below"  # how a .lcm file says that a member's values are its constants
MEMBER = re.compile(r"^\s*\S+\s+(\w+)(?:\[.*\])*;\s*//\s*(.*)$")


def brief(message: Any) -> str:
    """A message on one line without what every message begins with."""
    text = describe(message)
    if isinstance(message, bytes):
        return text
    names = [name for name in message.__slots__ if name in HEAD]
    return text.split(" ", len(names))[-1] if len(message.__slots__) > len(names) else text


def member_lines(message: Any) -> list[tuple[str, str, str]]:
    """(member, value, unit and meaning) of each member; of a list of structs a line each.

    Bytes that did not decode are one line.
    """
    if isinstance(message, bytes):
        return [("bytes", describe(message), "")]
    meanings = _meanings(type(message).__name__)
    lines = []
    for name in message.__slots__:
        value, meaning = getattr(message, name), meanings.get(name, "")
        if meaning.startswith(ENUM):
            meaning = _enum_name(message, value)
        if isinstance(value, list | tuple) and value and hasattr(value[0], "__slots__"):
            lines += [(f"{name}[{k}]", describe(item), "") for k, item in enumerate(value)]
        else:
            lines.append((name, describe_value(value), meaning))
    return lines


def head_line(message: Any) -> str:
    """What every message begins with, in words; "" for bytes that did not decode."""
    parts = [f"{name} {getattr(message, name)}" for name in HEAD if hasattr(message, name)]
    return ", ".join(parts)


def _enum_name(message: Any, value: Any) -> str:
    """The constants of the type that have this value."""
    constants = vars(type(message)).items()
    return " or ".join(name for name, number in constants if name.isupper() and number == value)


@cache
def _meanings(type_name: str) -> dict[str, str]:
    """Member -> its comment in the .lcm file."""
    source = resources.files("lcmtypes").joinpath(f"{type_name}.lcm")
    if not source.is_file():
        return {}
    found = (MEMBER.match(line) for line in source.read_text(encoding="utf-8").splitlines())
    return {match[1]: match[2] for match in found if match}
