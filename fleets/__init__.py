"""Example fleet and mission files (TOML)."""

from importlib.resources import files
from pathlib import Path


def path(name: str) -> Path:
    """The file `name` of this package, with or without `.toml`; FileNotFoundError names what there is."""
    folder = Path(str(files(__name__)))
    found = folder / (name if name.endswith(".toml") else f"{name}.toml")
    if not found.exists():
        there = ", ".join(sorted(item.stem for item in folder.glob("*.toml")))
        raise FileNotFoundError(f"no mission {name!r}; there are: {there}")
    return found
