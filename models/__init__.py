"""The ONNX files that ship, each with a model card."""

from importlib.resources import files
from pathlib import Path


def path(name: str) -> Path:
    """The file `name` of this package; FileNotFoundError names what there is."""
    found = Path(str(files(__name__))) / name
    if not found.exists():
        there = ", ".join(sorted(item.name for item in found.parent.glob("*.onnx")))
        raise FileNotFoundError(f"no model {name!r}; there are: {there}")
    return found
