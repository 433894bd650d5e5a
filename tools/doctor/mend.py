"""Commands that people are given to mend something."""

import json
import os
import shlex
import sys
from importlib import metadata
from pathlib import Path

import models

__all__ = ["SHIPPED", "as_root", "restored_model", "until_boot"]

SHIPPED = "detector.onnx"


def as_root(command: str) -> str:
    """The command as this user must give it."""
    return command if os.geteuid() == 0 else f"sudo {command}"


def until_boot(command: str, for_good: str) -> str:
    """A command whose work the next boot undoes, and what does it at every boot."""
    return f"{command}  # until the next boot; for good: {for_good}"


def restored_model(root: Path | None = None) -> str:
    """What brings the model that ships back. root: the folder of our packages.

    podwatch is in no registry: a checkout has its own history, anything else is installed again from where it
    came.
    """
    root = root or Path(models.__file__).parents[1]
    if (root / ".git").exists():
        command = f"git -C {shlex.quote(str(root))} checkout models/{SHIPPED}"
    else:
        source = _installed_from()
        place = shlex.quote(source) if source else "PATH  # of podwatch's folder or wheel"
        command = f"{shlex.quote(sys.executable)} -m pip install --force-reinstall --no-deps {place}"
    return command if os.access(root, os.W_OK) else as_root(command)


def _installed_from() -> str:
    """What pip installed podwatch from (PEP 610); "" where that was not written down."""
    try:
        told = metadata.distribution("podwatch").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return ""
    return str(json.loads(told)["url"]) if told else ""
