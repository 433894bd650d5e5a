"""The air between simulated drones' radios: a UDP forwarder on loopback that delays, loses and cuts.

Each drone sends to a port of the ether in place of its neighbour's own. Datagrams pass unread.
"""

import heapq
import socket
from collections.abc import Mapping

import numpy as np

__all__ = ["UdpEther"]

MAX_DATAGRAM_BYTES = 2048


class UdpEther:
    """Forwards what arrives for a drone to that drone's radio."""

    def __init__(
        self,
        radio_ports: Mapping[int, int],
        random: np.random.Generator,
        latency_s: float,
        loss: float,
        ether_ports: Mapping[int, int],
    ) -> None:
        """`radio_ports`: where each drone's radio listens. `ether_ports`: where the others send what is meant
        for it.
        """
        self._radio_ports = dict(radio_ports)
        self._sender_of = {port: drone_id for drone_id, port in radio_ports.items()}
        self._random = random
        self._latency_s = latency_s
        self._loss = loss
        self._cuts: set[tuple[int, int]] = set()
        self._waiting: list[tuple[float, int, int, bytes]] = []
        self._n_taken = 0
        self.sockets: dict[int, socket.socket] = {}
        for drone_id in radio_ports:
            forwarder = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            forwarder.bind(("127.0.0.1", ether_ports[drone_id]))
            forwarder.setblocking(False)
            self.sockets[drone_id] = forwarder

    def cut(self, first: int, second: int, on: bool) -> None:
        """Cut or mend a link, both ways."""
        for pair in ((first, second), (second, first)):
            if on:
                self._cuts.add(pair)
            else:
                self._cuts.discard(pair)

    def take(self, now_s: float) -> None:
        """Take in all that waits, drawing its fate."""
        for receiver, forwarder in self.sockets.items():
            while True:
                try:
                    data, source = forwarder.recvfrom(MAX_DATAGRAM_BYTES)
                except BlockingIOError:
                    break
                except OSError:  # an earlier send met a radio that had just ended
                    continue
                sender = self._sender_of.get(source[1])
                lost = self._random.random() < self._loss
                if sender is None or lost or (sender, receiver) in self._cuts:
                    continue
                self._n_taken += 1
                heapq.heappush(self._waiting, (now_s + self._latency_s, self._n_taken, receiver, data))

    def forward(self, now_s: float) -> None:
        """Pass on what has been under way for long enough."""
        while self._waiting and self._waiting[0][0] <= now_s:
            _, _, receiver, data = heapq.heappop(self._waiting)
            try:
                self.sockets[receiver].sendto(data, ("127.0.0.1", self._radio_ports[receiver]))
            except OSError:
                continue

    def close(self) -> None:
        for forwarder in self.sockets.values():
            forwarder.close()
