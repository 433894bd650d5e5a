"""Datagrams of a bus as the kernel holds them: taken in batches, each with the kernel's own time of arrival.

lcm's handler costs 8 to 14 us a message, most of it in being woken twice for each. What is only looked at can
wait: here the socket keeps what comes, and one system call (recvmmsg, Linux) takes hundreds. The kernel's
stamps make jitter that of the bus, however late this process looks.
"""

import ctypes
import socket
import struct
from collections.abc import Iterator
from typing import NamedTuple, Self
from urllib.parse import urlsplit

import numpy as np

__all__ = ["STRIDE", "Batch", "BusError", "Datagrams", "parse_url"]

N_BATCH = 256
STRIDE = 65536  # bytes kept for each datagram of a batch: more than UDP carries
N_CONTROL = 64  # bytes of ancillary data: the time stamp 32, the count of what the socket dropped 24
SO_TIMESTAMPNS, SO_RXQ_OVFL = 35, 40  # asm-generic/socket.h; the socket module names neither
RECEIVE_BYTES = 4 << 20

# struct mmsghdr of recvmmsg(2); where C pads an int to eight bytes, so does this.
HEADER_MEMBERS = (
    "name",
    "name_bytes",
    "vectors",
    "n_vectors",
    "control",
    "control_bytes",
    "flags",
    "n_bytes",
)
HEADER = np.dtype([(name, np.uint64) for name in HEADER_MEMBERS])

_libc = ctypes.CDLL(None, use_errno=True)


class BusError(OSError):
    """No bus can be heard at an address; the message says why and what to do."""


class Batch(NamedTuple):
    """What one call took: datagram k lies at `data[k * STRIDE:][:sizes[k]]` until the next batch is taken."""

    data: memoryview
    sizes: list[int]  # bytes
    times_us: list[int]  # arrival by the kernel's real-time clock
    senders: memoryview  # 16 bytes each: family, port, address


def parse_url(url: str) -> tuple[str, int]:
    """(multicast group, port) of "udpm://GROUP:PORT?..."; ValueError for any other form."""
    try:
        parts = urlsplit(url)
        group, port = parts.hostname or "", parts.port or 0
        is_group = group.count(".") == 3 and 224 <= socket.inet_aton(group)[0] < 240
    except (ValueError, OSError):
        is_group = False
    if not is_group or parts.scheme != "udpm" or not port:
        raise ValueError(f"{url!r} is no bus; write udpm://GROUP:PORT, such as udpm://239.255.76.101:7667")
    return group, port


class Datagrams:
    """The socket of one bus. Raises ValueError for an address of another form, BusError where there is no
    route or another program has the port for itself.
    """

    def __init__(self, url: str) -> None:
        group, port = parse_url(url)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
            self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            # Bound to the group itself: other drones' groups share the port, and would be heard too.
            self._socket.bind((group, port))
            membership = socket.inet_aton(group) + socket.inet_aton("0.0.0.0")
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except OSError as error:
            self._socket.close()
            raise BusError(
                f"no bus at {url} ({error.strerror}); `podwatch doctor` says what to do"
            ) from error
        self._socket.setblocking(False)
        self.n_dropped = 0  # by the kernel, since this socket was full: not gaps of the bus
        self._data = np.zeros((N_BATCH, STRIDE), np.uint8)
        self._senders = np.zeros((N_BATCH, 16), np.uint8)
        self._control = np.zeros((N_BATCH, N_CONTROL), np.uint8)
        self._stamps = self._control.view(np.int64)  # (N_BATCH, 8): seconds at 2, nanoseconds at 3
        self._vectors = np.zeros((N_BATCH, 2), np.uint64)
        self._rows = np.zeros(N_BATCH, HEADER)
        self._point()
        self._headers = ctypes.c_void_p(self._rows.ctypes.data)
        self._flat, self._flat_senders = self._data.reshape(-1).data, self._senders.reshape(-1).data

    def _point(self) -> None:
        """Tell each header where its datagram, sender and ancillary data go."""
        rank = np.arange(N_BATCH, dtype=np.uint64)
        self._vectors[:, 0] = self._data.ctypes.data + rank * STRIDE
        self._vectors[:, 1] = STRIDE
        self._rows["name"] = self._senders.ctypes.data + rank * 16
        self._rows["vectors"] = self._vectors.ctypes.data + rank * 16
        self._rows["n_vectors"] = 1
        self._rows["control"] = self._control.ctypes.data + rank * N_CONTROL

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()

    def take(self, limit: int = 100) -> Iterator[Batch]:
        """All that waits, at most `limit` batches: a flood must not keep the screen waiting."""
        for _ in range(limit):
            self._rows["name_bytes"] = 16
            self._rows["control_bytes"] = N_CONTROL
            n_taken = _libc.recvmmsg(self.fileno(), self._headers, N_BATCH, socket.MSG_DONTWAIT, None)
            if n_taken <= 0:
                return
            stamps = self._stamps[:n_taken]
            times_us = (stamps[:, 2] * 1_000_000 + stamps[:, 3] // 1000).tolist()
            self._see_dropped(n_taken)
            yield Batch(self._flat, self._rows["n_bytes"][:n_taken].tolist(), times_us, self._flat_senders)
            if n_taken < N_BATCH:
                return

    def _see_dropped(self, n_taken: int) -> None:
        """The socket's own count of drops rides on a datagram once there were any."""
        last = n_taken - 1
        if int(self._rows["control_bytes"][last]) > 32:
            level_and_kind = struct.unpack_from("=ii", self._control[last], 40)
            if level_and_kind == (socket.SOL_SOCKET, SO_RXQ_OVFL):
                (self.n_dropped,) = struct.unpack_from("=I", self._control[last], 48)
