"""Telling systemd that a process is up and lives: its notify protocol (sd_notify(3)), one datagram a word.

A unit with `WatchdogSec` ends and restarts a process that has not said so for that long. Without
NOTIFY_SOCKET in the environment nothing is said.
"""

import contextlib
import os
import socket

__all__ = ["Notifier"]

STATUS_LIMIT = 200


class Notifier:
    """What a process says to the systemd that started it."""

    def __init__(self) -> None:
        address = os.environ.pop("NOTIFY_SOCKET", "")  # not for what this process starts itself
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        if self._socket is not None:
            self._socket.setblocking(False)

    def beat(self, status: str) -> None:
        """It is up and lives; `status` is what `systemctl status` shows."""
        self._say(f"READY=1\nWATCHDOG=1\nSTATUS={' '.join(status.split())[:STATUS_LIMIT]}")

    def stopping(self) -> None:
        """It was asked to end, and does: its last word."""
        self._say("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _say(self, text: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):  # a supervisor that does not listen hears the next one
                self._socket.sendto(text.encode(), self._address)
