"""Radio links in memory: datagrams cross an ether with latency, losses and cuts, on whatever clock its
owner keeps."""

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

__all__ = ["MemoryEther", "MemoryRadio"]

MAX_WAITING = 1000  # datagrams; a socket's buffer is not endless either

Deliver = Callable[[float, Callable[[], None]], None]


class MemoryEther:
    """What lies between the radios of one fleet. Deterministic for one generator and one order of sends."""

    def __init__(
        self,
        random: "np.random.Generator",
        deliver: Deliver,
        latency_s: float = 0.005,
        jitter_s: float = 0.0,
        loss: float = 0.0,
    ) -> None:
        """`deliver(delay_s, action)` runs `action` after a delay on the owner's clock. Each datagram takes
        latency_s and up to jitter_s more, and is lost with probability `loss`. Raises ValueError for a
        loss outside 0-1 or a negative time."""
        if not 0.0 <= loss <= 1.0 or latency_s < 0 or jitter_s < 0:
            raise ValueError(
                f"loss {loss} must lie in 0-1, latency_s {latency_s} and jitter_s {jitter_s} be 0 or more"
            )
        self.loss = loss
        self.latency_s = latency_s
        self.jitter_s = jitter_s
        self.blocked: Callable[[int, int], bool] = lambda sender, receiver: False  # a cut: asked at each send
        self._random = random
        self._deliver = deliver
        self._radios: dict[int, MemoryRadio] = {}

    def radio(self, drone_id: int, peers: tuple[int, ...]) -> "MemoryRadio":
        """A radio for one drone. A new one for the same drone takes the place of the old, as after a
        restart."""
        radio = MemoryRadio(self, drone_id, peers)
        self._radios[drone_id] = radio
        return radio

    def carry(self, sender: int, receiver: int, data: bytes) -> None:
        """Take one datagram; it arrives later, or never."""
        # Drawn each time, so that a cut does not shift the later draws.
        is_lost = self._random.random() < self.loss
        delay_s = self.latency_s + self.jitter_s * self._random.random()
        if not is_lost and not self.blocked(sender, receiver):
            self._deliver(delay_s, lambda: self._arrive(receiver, data))

    def session_id(self) -> int:
        """A session number from the ether's own generator: the same seed, the same sessions."""
        return int(self._random.integers(0, 2**63 - 1))

    def _arrive(self, receiver: int, data: bytes) -> None:
        radio = self._radios.get(receiver)
        if radio is not None:
            radio.arrive(data)


class MemoryRadio:
    """One end of the ether, with the interface of UdpRadio; `on_arrival` stands in for select."""

    def __init__(self, ether: MemoryEther, drone_id: int, peers: tuple[int, ...]) -> None:
        self.peers = peers
        self._ether = ether
        self._drone_id = drone_id
        self._waiting: list[bytes] = []
        self._callback: Callable[[], None] = lambda: None
        self._is_open = True

    def session_id(self) -> int:
        """A number for one start of the relay, 0 to 2^63 - 1, from the ether's seed."""
        return self._ether.session_id()

    def send(self, peer_id: int, data: bytes) -> bool:
        """Send one datagram. KeyError: unknown peer."""
        if peer_id not in self.peers:
            raise KeyError(peer_id)
        self._ether.carry(self._drone_id, peer_id, data)
        return True

    def receive(self) -> list[bytes]:
        """All datagrams that wait."""
        waiting, self._waiting = self._waiting, []
        return waiting

    def on_arrival(self, callback: Callable[[], None]) -> None:
        """Call `callback` at each arrival."""
        self._callback = callback

    def arrive(self, data: bytes) -> None:
        """The ether brings a datagram."""
        if self._is_open and len(self._waiting) < MAX_WAITING:
            self._waiting.append(data)
            self._callback()

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self._is_open = False
