"""Somebody who says the same again and again while a test listens."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["saying_again"]


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
