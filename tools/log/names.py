"""What the numbers of a message are called, by its .lcm file: for `podwatch log cat` and `podwatch spy`."""

import re
from functools import cache
from importlib import resources
from typing import Any

from lcmtypes.podwatch import operator_t
from procs.navigator.states import State

__all__ = ["ENUM", "meanings", "value_name"]

ENUM = "enum below"  # how a .lcm file says that a member's values are its constants
COMMAND = "operator_t command"  # ... or those of an operator's order
STATE = "procs.navigator.states.State"  # ... or the navigator's states
MEMBER = re.compile(r"^\s*\S+\s+(\w+)(?:\[.*\])*;\s*//\s*(.*)$")


def value_name(message: Any, name: str) -> str:
    """The name of the value of member `name`, "" where its type has none for it."""
    meaning, value = meanings(type(message).__name__).get(name, ""), getattr(message, name)
    if meaning.startswith((ENUM, COMMAND)):
        constants = vars(type(message) if meaning.startswith(ENUM) else operator_t).items()
        return " or ".join(word for word, number in constants if word.isupper() and number == value)
    if meaning.startswith(STATE):
        return State(value).name if value in State.__members__.values() else ""
    return ""


@cache
def meanings(type_name: str) -> dict[str, str]:
    """Member -> its comment in the .lcm file: unit and meaning."""
    source = resources.files("lcmtypes").joinpath(f"{type_name}.lcm")
    if not source.is_file():
        return {}
    found = (MEMBER.match(line) for line in source.read_text(encoding="utf-8").splitlines())
    return {match[1]: match[2] for match in found if match}
