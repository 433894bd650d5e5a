"""A decoded message for people: on one line, or one member a line with the unit that its .lcm file gives."""

from typing import Any

from tools.log.inspect import describe, describe_value
from tools.log.names import ENUM, meanings, value_name

__all__ = ["brief", "head_line", "member_lines"]

HEAD = ("utime", "seq", "drone_id")


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
    known = meanings(type(message).__name__)
    lines = []
    for name in message.__slots__:
        value, meaning = getattr(message, name), known.get(name, "")
        meaning = value_name(message, name) or ("" if meaning.startswith(ENUM) else meaning)
        if isinstance(value, list | tuple) and value and hasattr(value[0], "__slots__"):
            lines += [(f"{name}[{k}]", describe(item), "") for k, item in enumerate(value)]
        else:
            lines.append((name, describe_value(value), meaning))
    return lines


def head_line(message: Any) -> str:
    """What every message begins with, in words; "" for bytes that did not decode."""
    parts = [f"{name} {getattr(message, name)}" for name in HEAD if hasattr(message, name)]
    return ", ".join(parts)
