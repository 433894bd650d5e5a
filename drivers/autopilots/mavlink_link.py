"""Links to an autopilot over sockets, UDP and TCP. None of them ever blocks."""

import select
import socket
import time

from drivers.autopilots.serial_link import MavlinkSerial

__all__ = ["AutopilotLink", "MavlinkTcp", "MavlinkUdp", "MavlinkUdpClient", "open_link"]

READ_BYTES = 65536
RECONNECT_S = 1.0  # between attempts of a TCP link


def _split(address: str) -> tuple[str, int]:
    """("host", port) of "host:port"; ValueError for anything else."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 <= int(port) <= 65535:
        raise ValueError(f"{address!r} is no address: write host:port, such as 127.0.0.1:14550")
    return host, int(port)


class MavlinkUdp:
    """Waits for the autopilot to send first, and answers to the address that it last sent from.

    system_id: the autopilot's MAVLink system id, 0 where it equals the drone's id.
    """

    def __init__(self, listen: str, system_id: int = 0) -> None:
        self.system_id = system_id
        address = _split(listen)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            raise OSError(
                f"cannot listen on udp {listen}: {error.strerror}; does another program use it?"
            ) from error
        self._peer: tuple[str, int] | None = None

    @property
    def port(self) -> int:
        """The local port: asked of the kernel where the address said 0."""
        return int(self._socket.getsockname()[1])

    def write(self, data: bytes) -> None:
        """Send one datagram; dropped while nobody was heard yet or the network refuses, as radio does."""
        if data and self._peer is not None:
            try:
                self._socket.sendto(data, self._peer)
            except OSError:
                return  # the link's age tells; the next write tries again

    def receive(self) -> bytes:
        """All datagrams that wait, joined."""
        data = bytearray()
        while True:
            try:
                piece, self._peer = self._socket.recvfrom(READ_BYTES)
            except BlockingIOError:
                return bytes(data)
            except ConnectionError:
                continue  # the peer's port was closed when we last wrote
            data += piece

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class MavlinkUdpClient(MavlinkUdp):
    """Sends first, to a known address."""

    def __init__(self, remote: str, system_id: int = 0) -> None:
        address = _split(remote)
        super().__init__("0.0.0.0:0", system_id)
        self._peer = address


class MavlinkTcp:
    """A TCP client that connects again by itself after the autopilot restarts.

    Prefer UDP: an autopilot's TCP port serves one client (docs/autopilot_facts.md, 13).
    """

    def __init__(self, address: str, system_id: int = 0) -> None:
        self.system_id = system_id
        self._address = _split(address)
        # Something to wait on while there is no connection: a select on an unconnected socket returns at
        # once.
        self._idle, self._idle_far = socket.socketpair()
        self._socket: socket.socket | None = None
        self._connecting: socket.socket | None = None
        self._next_attempt_s = 0.0
        self._connect()

    def write(self, data: bytes) -> None:
        """Send, or go on connecting; what cannot be sent now is dropped."""
        self._connect()
        if self._socket is None or not data:
            return
        try:
            self._socket.sendall(data)
        except BlockingIOError:
            self._drop()  # half a message may be out: begin afresh
        except OSError:
            self._drop()

    def receive(self) -> bytes:
        """All bytes that wait."""
        data = bytearray()
        while self._socket is not None:
            try:
                piece = self._socket.recv(READ_BYTES)
            except BlockingIOError:
                break
            except OSError:
                piece = b""
            if not piece:
                self._drop()
                break
            data += piece
        return bytes(data)

    def fileno(self) -> int:
        return (self._socket or self._idle).fileno()

    def close(self) -> None:
        self._drop()
        self._idle.close()
        self._idle_far.close()

    def _drop(self) -> None:
        for held in (self._socket, self._connecting):
            if held is not None:
                held.close()
        self._socket = self._connecting = None

    def _connect(self) -> None:
        """Begin to connect, or find out whether it has worked."""
        if self._socket is not None:
            return
        now_s = time.monotonic()
        if self._connecting is None:
            if now_s < self._next_attempt_s:
                return
            self._next_attempt_s = now_s + RECONNECT_S
            self._connecting = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            self._connecting.setblocking(False)
            self._connecting.connect_ex(self._address)
        _, writable, _ = select.select([], [self._connecting], [], 0)
        if writable and self._connecting.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0:
            self._connecting.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket, self._connecting = self._connecting, None
        elif writable:
            self._drop()


AutopilotLink = MavlinkUdp | MavlinkTcp | MavlinkSerial


def open_link(address: str, system_id: int = 0) -> AutopilotLink:
    """The link that an address names.

    "udp:HOST:PORT" listens, "udpout:HOST:PORT" sends first, "tcp:HOST:PORT" connects, "serial:DEVICE:BAUD".
    Raises ValueError for any other form, with what to write instead.
    """
    kind, _, rest = address.partition(":")
    if kind == "udp":
        return MavlinkUdp(rest, system_id)
    if kind == "udpout":
        return MavlinkUdpClient(rest, system_id)
    if kind == "tcp":
        return MavlinkTcp(rest, system_id)
    if kind == "serial":
        device, _, baud = rest.rpartition(":")
        if not device or not baud.isdigit():
            raise ValueError(f"{address!r}: write serial:DEVICE:BAUD, such as serial:/dev/ttyAMA0:921600")
        return MavlinkSerial(device, int(baud), system_id)
    raise ValueError(
        f"{address!r}: write udp:HOST:PORT (listen), udpout:HOST:PORT (send first), tcp:HOST:PORT or "
        "serial:DEVICE:BAUD"
    )
