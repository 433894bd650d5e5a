"""The fleet key: 32 random bytes that every drone of a fleet holds, as hexadecimal text in a file of mode
0600.

The key never appears in a log, an exception or a repr: errors name the file and what is wrong with it,
nothing else.
"""

import os
import secrets
import stat
from pathlib import Path

__all__ = ["KEY_BYTES", "FleetKeyError", "make_key", "read_key"]

KEY_BYTES = 32


class FleetKeyError(Exception):
    """A key file that cannot be used; the message names the file, what is wrong and the remedy."""


def make_key(path: Path, force: bool = False) -> None:
    """Write a new random fleet key to `path`, readable by its owner alone.

    Raises FleetKeyError where the file exists and `force` is not given, or where it cannot be written.
    """
    if path.exists() and not force:
        raise FleetKeyError(
            f"{path} exists: a new key shuts out every drone that holds the old; force it, or name another"
        )
    fresh = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(secrets.token_hex(KEY_BYTES) + "\n")
        fresh.replace(path)  # in one step, so that no reader ever meets half a key
    except OSError as error:
        raise FleetKeyError(f"{path}: the fleet key cannot be written: {error.strerror}") from error


def read_key(path: Path) -> bytes:
    """The 32 bytes of the fleet key in `path`.

    Raises FleetKeyError: missing or unreadable file, a file that others may read, a wrong length, text
    that is not hex.
    """
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        text = path.read_bytes()
    except OSError as error:
        raise FleetKeyError(
            f"{path}: no fleet key can be read: {error.strerror}; copy the fleet's, or make one for all"
        ) from error
    if mode & 0o077:
        raise FleetKeyError(f"{path}: mode {mode:04o} lets others read the fleet key; run: chmod 600 {path}")
    try:
        key = bytes.fromhex(text.decode("ascii").strip())
    except ValueError:
        raise FleetKeyError(
            f"{path}: the fleet key is not hexadecimal text; copy the fleet's key file again"
        ) from None
    if len(key) != KEY_BYTES:
        raise FleetKeyError(
            f"{path}: the fleet key has {len(key)} bytes, not {KEY_BYTES}; copy the fleet's key file again"
        )
    return key
