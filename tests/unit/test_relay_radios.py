"""The radio drivers: UDP sockets and the ether in memory."""

import select
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from drivers.radios.memory import MAX_WAITING, MemoryEther
from drivers.radios.udp import MAX_BATCH, UdpRadio


@pytest.fixture
def radios() -> Iterator[tuple[UdpRadio, UdpRadio]]:
    two = UdpRadio("127.0.0.1:0", {1: "127.0.0.1:1"})
    one = UdpRadio("127.0.0.1:0", {"2": f"127.0.0.1:{two.port}"})  # as read from JSON
    yield one, two
    one.close()
    two.close()


def wait(radio: UdpRadio) -> None:
    assert select.select([radio], [], [], 5)[0]


def test_datagrams_cross_and_receiving_never_blocks(radios: tuple[UdpRadio, UdpRadio]) -> None:
    one, two = radios
    assert two.receive() == []
    assert one.send(2, b"first")
    assert one.send(2, b"second")
    wait(two)
    assert two.receive() == [b"first", b"second"]
    assert two.receive() == []
    assert (one.peers, two.peers) == ((2,), (1,))


def test_a_flood_is_taken_in_parts(radios: tuple[UdpRadio, UdpRadio]) -> None:
    one, two = radios
    for _ in range(MAX_BATCH + 5):
        one.send(2, b"-")
    wait(two)
    assert len(two.receive()) == MAX_BATCH
    assert len(two.receive()) == 5


def test_what_the_network_does_not_take_is_said(radios: tuple[UdpRadio, UdpRadio]) -> None:
    one, two = radios
    assert not one.send(2, bytes(70_000))
    with pytest.raises(KeyError):
        one.send(3, b"to nobody")
    for _ in range(3):  # to a closed port: the socket stays usable
        two.send(1, b"-")
    one.send(2, b"still heard")
    wait(two)
    assert two.receive() == [b"still heard"]


def test_sessions_are_not_repeated(radios: tuple[UdpRadio, UdpRadio]) -> None:
    numbers = [radios[0].session_id() for _ in range(100)]
    assert len(dict.fromkeys(numbers)) == 100
    assert all(0 <= number < 2**63 for number in numbers)


@pytest.mark.parametrize("wrong", ["127.0.0.1", ":7000", "127.0.0.1:", "host:port", "127.0.0.1:70000", ""])
def test_an_address_that_is_none_is_refused(wrong: str) -> None:
    with pytest.raises(ValueError, match="host:port"):
        UdpRadio(wrong, {})
    with pytest.raises(ValueError, match="host:port"):
        UdpRadio("127.0.0.1:0", {1: wrong})


def test_an_address_in_use_is_named(radios: tuple[UdpRadio, UdpRadio]) -> None:
    with pytest.raises(OSError, match=rf"cannot bind 127\.0\.0\.1:{radios[0].port}.*another relay"):
        UdpRadio(f"127.0.0.1:{radios[0].port}", {})


class Queue:
    """Actions that wait, by their time."""

    def __init__(self) -> None:
        self.waiting: list[tuple[float, Callable[[], None]]] = []

    def deliver(self, delay_s: float, action: Callable[[], None]) -> None:
        self.waiting.append((delay_s, action))

    def run(self) -> list[float]:
        waiting, self.waiting = self.waiting, []
        for _, action in waiting:
            action()
        return [delay_s for delay_s, _ in waiting]


def test_the_ether_delays_loses_and_cuts() -> None:
    queue = Queue()
    ether = MemoryEther(np.random.default_rng(1), queue.deliver, latency_s=0.01, jitter_s=0.02, loss=0.25)
    one, two = ether.radio(1, (1, 2)), ether.radio(2, (1, 2))
    arrivals: list[str] = []
    two.on_arrival(lambda: arrivals.append("two"))
    for k in range(400):
        assert one.send(2, bytes([k % 256]))
    delays_s = queue.run()
    assert 0.2 < 1 - len(delays_s) / 400 < 0.3
    assert 0.01 <= min(delays_s) < 0.012 < 0.028 < max(delays_s) <= 0.03
    assert len(arrivals) == len(two.receive()) == len(delays_s)
    assert two.receive() == []
    ether.loss = 0.0
    ether.blocked = lambda sender, receiver: (sender, receiver) == (1, 2)
    one.send(2, b"cut")
    two.send(1, b"open")
    queue.run()
    assert (one.receive(), two.receive()) == ([b"open"], [])
    with pytest.raises(KeyError):
        one.send(3, b"to nobody")


def test_a_radio_that_was_replaced_or_closed_hears_nothing() -> None:
    queue = Queue()
    ether = MemoryEther(np.random.default_rng(1), queue.deliver)
    one, old = ether.radio(1, (2,)), ether.radio(2, (1,))
    new = ether.radio(2, (1,))
    one.send(2, b"-")
    queue.run()
    assert (old.receive(), new.receive()) == ([], [b"-"])
    for _ in range(MAX_WAITING + 1):
        new.arrive(b"-")
    assert len(new.receive()) == MAX_WAITING
    new.close()
    one.send(2, b"-")
    queue.run()
    assert new.receive() == []


@pytest.mark.parametrize("wrong", [{"loss": 1.1}, {"loss": -0.1}, {"latency_s": -1.0}, {"jitter_s": -1.0}])
def test_an_impossible_ether_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must lie in 0-1"):
        MemoryEther(np.random.default_rng(1), Queue().deliver, **wrong)
