"""docs/mission.md: every key of a mission file, made from the models that read it and the comments beside
their fields.
"""

import ast
import io
import json
import textwrap
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from inspect import getsource
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from procs.settings import FENCE_KEPT_M, IN_WORDS, LEAST_HOME_SPACING_M, MAX_DRONES, Mission
from tools.sim.settings import SimMission

__all__ = ["EXAMPLE", "Table", "comments", "mission_page", "tables"]

# End of a key's name -> its unit; the first that fits.
UNITS = {
    "bytes_per_s": "bytes/s", "_m_s": "m/s", "_hz": "Hz", "_px": "px", "_deg": "degrees", "_ppm": "ppm",
    "_ms": "ms", "seconds_to_monitor": "s", "_gb": "GB", "_s": "s", "_m": "m",
}  # fmt: skip
SIMPLE = {bool: "true or false", int: "whole number", float: "number", str: "text"}
LISTS = ("drones", "faults")  # tables that are given again and again

EXAMPLE = """\
# my_mission.toml: two drones and four minke whales, which dive while they are watched.

name = "two drones, one dive"

[search]         # some 30 m from where the pod really is
north_m = 60.0
east_m = -20.0

[watch]
watch_s = 40.0
animal_length_m = 8.0

[pod]            # the simulated animals; no drone knows this table
animals = 4
north_m = 80.0
length_m = 8.0
species = "minke"

[[drones]]
id = 1

[[drones]]
id = 2
home_e_m = 10.0

[[faults]]
kind = "dive"
when = "monitor"
after_s = 10.0
for_s = 12.0

[expect]
distinct = true
consensus = true
drones_in_monitor = 2
all_landed = true
"""

HEAD = f"""\
One TOML file says all that a fleet is told. `podwatch sim my_mission.toml` flies it in simulation; real
drones read the same tables from their [fleet file](operate.md). What is left out is as given here, but for
the few keys that are needed; a wrong key is refused with the nearest right one. This file is whole, and
flies:

```toml
{EXAMPLE}```

Places are metres north and east of the fleet's origin, heights are above the surface, and a key's last
letters are its unit. `[drones.machine]` belongs to the `[[drones]]` above it. What must fit together:

- at most {MAX_DRONES} drones, no id twice, their homes {LEAST_HOME_SPACING_M:g} m apart or more;
- `search.height_m` and `watch.height_m` between `limits.min_height_m` and `limits.max_height_m`;
- every home and the whole spiral of the search {FENCE_KEPT_M:g} m or more inside `limits.fence_radius_m`;
- `limits.battery_land` below `limits.battery_return`;
- `pod.animals` that find room, `pod.spacing_m` apart, within `pod.radius_m`;
- `[[faults]]` that name drones of the roster.

Keys that belong to no table stand above the first one.
"""
SIMULATED = """\
## Only in simulation

No drone is told of these, and the file of a real fleet may not have them. Every run is [judged](judge.md); at
the end of one that flew the file as it is, `podwatch sim` says what fell short of its `[expect]`.
"""


@dataclass(frozen=True)
class Table:
    """One table of the file: where it stands, and the model that reads it."""

    place: str  # as "drones.machine"
    title: str  # as "[drones.machine]"
    model: type[BaseModel]
    words: str  # those of the key that holds it, and of the model


def mission_page(made: str) -> str:
    """The page; `made` is the line that says what makes it."""
    every = tables(SimMission)
    plain = [table for table in every if table.place.split(".")[0] in Mission.model_fields]
    own = {name: field for name, field in SimMission.model_fields.items() if name not in Mission.model_fields}
    lines = ["# The mission file", "", made, "", HEAD, "## Every fleet", ""]
    lines += _rows(Mission.model_fields, comments(Mission))
    for table in plain:
        lines += _section(table)
    lines += [SIMULATED, *_rows(own, comments(SimMission))]
    for table in every:
        lines += [] if table in plain else _section(table)
    return "\n".join(lines)


def tables(model: type[BaseModel], above: str = "") -> list[Table]:
    """Every table that `model` takes, in its order, each followed by those within it."""
    found, said = [], comments(model)
    for name, field in model.model_fields.items():
        inner = next(_models(field.annotation), None)
        if inner is None:
            continue
        is_named = get_origin(field.annotation) is dict
        place = f"{above}{name}" + (".NAME" if is_named else "")
        title = f"[[{place}]]" if name in LISTS else f"[{place}]"
        own = said[name][:1].upper() + said[name][1:]
        words = " ".join([f"{own}." if own else "", *(inner.__doc__ or "").split()]).strip()
        found += [Table(place=place, title=title, model=inner, words=words), *tables(inner, f"{place}.")]
    return found


def comments(model: type[BaseModel]) -> dict[str, str]:
    """What the comment beside each field of `model` says, or those in the lines above it, without gap."""
    said: dict[str, str] = {}
    for owner in reversed(model.__mro__):
        if issubclass(owner, BaseModel) and owner is not BaseModel:
            said |= _comments(textwrap.dedent(getsource(owner)))
    return said


def _comments(source: str) -> dict[str, str]:
    lines = source.splitlines()
    at = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    alone = {line for line in at if lines[line - 1].lstrip().startswith("#")}
    said = {}
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    for node in body.body:
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        above = node.lineno
        while above - 1 in alone:
            above -= 1
        words = [at[line] for line in range(above, node.lineno)] + [at.get(node.end_lineno or 0, "")]
        said[node.target.id] = " ".join(words).strip()
    return said


def _section(table: Table) -> list[str]:
    rows = _rows(table.model.model_fields, comments(table.model))
    return [f"### `{table.title}`", "", table.words, "", *rows]


def _rows(fields: Mapping[str, FieldInfo], said: Mapping[str, str]) -> list[str]:
    """A Markdown table of the fields that are no tables of their own; nothing where all are."""
    rows = [
        f"| `{name}` | {_value(name, field)} | {_default(field)} | {said[name]} |"
        for name, field in fields.items()
        if next(_models(field.annotation), None) is None
    ]
    return ["| key | value | where not given | what it is |", "|---|---|---|---|", *rows, ""] if rows else []


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models within a type, as Machine in `Machine | None` and `dict[str, Machine]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)


def _value(name: str, field: FieldInfo) -> str:
    """What may be written, with its bounds and unit."""
    parts = {type(part).__name__: part for part in field.metadata}
    pattern = next((part.pattern for part in field.metadata if getattr(part, "pattern", None)), None)
    if pattern is not None:
        return IN_WORDS[pattern].replace('"', "`")
    low = _number(parts["Ge"].ge) if "Ge" in parts else f"above {parts['Gt'].gt:g}," if "Gt" in parts else ""
    high = (
        f"to {_number(parts['Le'].le)}"
        if "Le" in parts
        else f"below {parts['Lt'].lt:g}"
        if "Lt" in parts
        else ""
    )
    span = f"{low} {high or 'or more'}" if low else ""
    unit = next((unit for end, unit in UNITS.items() if name.endswith(end)), "")
    return ", ".join(filter(None, [_kind(field.annotation), f"{span} {unit}".strip()]))


def _kind(annotation: Any) -> str:
    """A type in words."""
    if annotation in SIMPLE:
        return SIMPLE[annotation]
    inner = [part for part in get_args(annotation) if part not in (NoneType, Ellipsis)]
    if get_origin(annotation) is Literal:
        return " or ".join(f"`{json.dumps(choice)}`" for choice in inner)
    if get_origin(annotation) is dict:
        return "table"
    words = [_kind(part) for part in inner]
    if get_origin(annotation) is tuple:
        kinds = " or ".join(f"{kind}s" for kind in words[0].split(" or "))
        return f"list of {kinds}" if Ellipsis in get_args(annotation) else f"[{', '.join(words)}]"
    return " or ".join(words)


def _default(field: FieldInfo) -> str:
    """What holds where the key is not given."""
    if field.is_required():
        return "needed"
    default = field.get_default()
    if isinstance(default, float):
        return _number(default)
    if isinstance(default, bool | int) or default is None:
        return "" if default is None else json.dumps(default)
    return f"`{json.dumps(default)}`"


def _number(value: float) -> str:
    return f"{value:.0f}" if value == round(value) else f"{value:g}"
