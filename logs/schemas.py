"""The .lcm text of a message type, complete enough for `lcm-gen` to rebuild its decoder from it."""

from functools import cache
from importlib import resources
from typing import Any

from lcmtypes import podwatch

__all__ = ["PACKAGE", "fingerprint", "lcm_text", "type_name"]

PACKAGE = "podwatch"


def fingerprint(kind: type[Any]) -> bytes:
    """The 8 bytes that begin every encoded message of `kind`."""
    packed: bytes = kind._get_packed_fingerprint()
    return packed


def type_name(kind: type[Any]) -> str:
    """Package and struct, as MCAP names the schema: `podwatch.track_t`."""
    return f"{PACKAGE}.{kind.__name__}"


@cache
def lcm_text(kind: type[Any]) -> str:
    """Source of `kind` with every struct that it nests before it, under one `package` line."""
    structs: dict[str, str] = {}
    _collect(kind, structs)
    return f"package {PACKAGE};\n\n" + "\n".join(structs.values())


def _collect(kind: type[Any], structs: dict[str, str]) -> None:
    """Add the struct of `kind` to `structs` (name -> text), those that it nests first."""
    if kind.__name__ in structs:
        return
    for member_type in kind.__typenames__:
        if "." in member_type:  # only nested structs carry a package
            _collect(getattr(podwatch, member_type.rsplit(".", 1)[-1]), structs)
    source = resources.files("lcmtypes").joinpath(f"{kind.__name__}.lcm").read_text(encoding="utf-8")
    lines = [line for line in source.splitlines() if line.strip() != f"package {PACKAGE};"]
    structs[kind.__name__] = "\n".join(lines).strip() + "\n"
