"""Somebody who says the same again and again while a test listens."""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pymavlink.dialects.v20 import common

__all__ = ["beat", "saying_again", "talking"]


@contextmanager
def saying_again(say: Callable[[], object], every_s: float) -> Iterator[None]:
    """`say` in a thread of its own, every `every_s` seconds until the end of the block."""
    done = threading.Event()

    def talk() -> None:
        while not done.wait(every_s):
            say()

    talker = threading.Thread(target=talk)
    talker.start()
    try:
        yield
    finally:
        done.set()
        talker.join()


@contextmanager
def talking(data: bytes, port: int) -> Iterator[None]:
    """Somebody who says `data` to a UDP port of this machine, again and again."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
        saying_again(lambda: out.sendto(data, ("127.0.0.1", port)), 0.01),
    ):
        yield


def beat(system_id: int, component_id: int = 1) -> bytes:
    """An ArduCopter's heartbeat; of another component than 1, that of something else on its bus."""
    dialect = common.MAVLink(None, system_id, component_id)
    return bytes(dialect.heartbeat_encode(2, 3, 0, 0, 3).pack(dialect))
