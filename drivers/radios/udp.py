"""A radio link over UDP: on a real drone the mesh's network interface, in a simulated fleet the loopback."""

import secrets
import socket
from collections.abc import Mapping

__all__ = ["UdpRadio"]

MAX_DATAGRAM_BYTES = 2048
MAX_BATCH = 200  # datagrams taken at once, so that a flood leaves time for the rest of the relay


class UdpRadio:
    """One non-blocking UDP socket. What arrives is not looked at: whom to believe is the relay's business."""

    def __init__(self, bind: str, peers: Mapping[int | str, str]) -> None:
        """`bind` and the peers' addresses as "host:port". Raises ValueError for an address of another
        form, OSError where `bind` cannot be had."""
        self._addresses = {int(peer_id): _address(text) for peer_id, text in peers.items()}
        host, port = _address(bind)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise OSError(
                error.errno, f"radio: cannot bind {bind}: {error.strerror}; is another relay running?"
            ) from error

    @property
    def peers(self) -> tuple[int, ...]:
        """Ids that have an address."""
        return tuple(self._addresses)

    @property
    def port(self) -> int:
        """The port that the socket has, also where `bind` asked the kernel for any (port 0)."""
        return int(self._socket.getsockname()[1])

    def session_id(self) -> int:
        """A number for one start of the relay, 0 to 2^63 - 1, that nobody can foretell."""
        return secrets.randbits(63)

    def send(self, peer_id: int, data: bytes) -> bool:
        """Send one datagram; False where the network did not take it (no route, full buffer). KeyError:
        unknown peer."""
        try:
            self._socket.sendto(data, self._addresses[peer_id])
        except OSError:
            return False
        return True

    def receive(self) -> list[bytes]:
        """All datagrams that wait, at most 200; never blocks."""
        datagrams: list[bytes] = []
        for _ in range(MAX_BATCH):
            try:
                datagrams.append(self._socket.recv(MAX_DATAGRAM_BYTES))
            except BlockingIOError:
                break
            except ConnectionError:  # a send met a closed port; what waits behind that word is still there
                continue
        return datagrams

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


def _address(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon or not host or not port.isdigit() or int(port) > 65535:
        raise ValueError(f'radio address {text!r}: it must be "host:port" with a port of 0-65535')
    return host.strip("[]"), int(port)
