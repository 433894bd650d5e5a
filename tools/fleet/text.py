"""A mission as the text of a fleet file."""

import json
from typing import Any

from procs.settings import Mission

__all__ = ["mission_text"]


def mission_text(mission: Mission) -> str:
    """TOML that reads as the same mission."""
    return "\n".join(_tables(mission.model_dump(mode="json", exclude_none=True), "")) + "\n"


def _tables(data: dict[str, Any], prefix: str) -> list[str]:
    """The lines of a table: its own values first, then the tables within."""
    lines = [f"{key} = {_value(value)}" for key, value in data.items() if not _is_table(value)]
    for key, value in data.items():
        if isinstance(value, dict) and _is_table(value):
            lines += [f"[{prefix}{key}]", *_tables(value, f"{prefix}{key}.")]
        elif _is_table(value):
            for one in value:
                lines += [f"[[{prefix}{key}]]", *_tables(one, f"{prefix}{key}.")]
    return lines


def _is_table(value: Any) -> bool:
    is_options = isinstance(value, dict) and not any(isinstance(one, dict) for one in value.values())
    return (isinstance(value, dict) and not is_options) or (
        isinstance(value, list) and bool(value) and isinstance(value[0], dict)
    )


def _value(value: Any) -> str:
    """JSON's strings, numbers, booleans and lists are TOML's too; a table in one line is not."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_value(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return json.dumps(value)
