"""Where a run's buses lie: the lowest free slot, so that two runs on one machine never hear each other."""

import fcntl
import os
import socket
import tempfile
from pathlib import Path
from typing import IO, Self

__all__ = ["FIRST_PORT", "N_SLOTS", "Slot", "bus_url", "free_udp_ports", "has_multicast_route", "taken_slots"]

FIRST_PORT = 7667
N_SLOTS = 50


def bus_url(drone_id: int, slot: int) -> str:
    """A drone's own multicast group (docs/architecture.md)."""
    return f"udpm://239.255.76.{100 + drone_id}:{FIRST_PORT + slot}?ttl=0&recv_buf_size=4194304"


class Slot:
    """The lowest slot that nobody holds; free when it is closed here and in whoever inherited its lock."""

    def __init__(self) -> None:
        self.number, self._file = _lock_lowest()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def fileno(self) -> int:
        """The lock's file descriptor."""
        return self._file.fileno()

    def close(self) -> None:
        self._file.close()


def taken_slots() -> list[int]:
    """Slots that runs hold now."""
    taken = []
    for number in range(N_SLOTS):
        try:
            with _lock_path(number).open() as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # given back as the file closes
        except FileNotFoundError:
            continue
        except (BlockingIOError, PermissionError):
            taken.append(number)
    return taken


def _lock_path(number: int) -> Path:
    return Path(tempfile.gettempdir()) / f"podwatch-slot-{number}.lock"


def _lock_lowest() -> tuple[int, IO[str]]:
    for number in range(N_SLOTS):
        path = _lock_path(number)
        try:
            file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+")
        except PermissionError:  # another user's
            continue
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            continue
        return number, file
    raise OSError(f"all {N_SLOTS} slots are taken; end another simulated run first")


def free_udp_ports(count: int) -> list[int]:
    """`count` UDP ports on loopback that are free now."""
    sockets = []
    for _ in range(count):
        probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        probe.bind(("127.0.0.1", 0))
        sockets.append(probe)
    ports = [int(probe.getsockname()[1]) for probe in sockets]
    for probe in sockets:
        probe.close()
    return ports


def has_multicast_route() -> bool:
    """Whether a packet to a drone's group can leave: without a route there is no bus."""
    probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        probe.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        probe.sendto(b"", ("239.255.76.100", FIRST_PORT))
    except OSError:
        return False
    finally:
        probe.close()
    return True
