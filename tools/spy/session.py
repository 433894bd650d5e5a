"""The buses that a spy hears: one drone's, or, for the ring, every drone's that it learns of."""

import fnmatch
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Self

from lcmtypes import channels
from tools.spy.listener import Listener
from tools.spy.ring import Ring

__all__ = ["Session"]


class Session:
    """Listeners by drone. `url_of`: a drone's bus; `follows`: whether buses of other drones may be opened.

    Raises ValueError and BusError.
    """

    def __init__(
        self,
        url_of: Callable[[int], str],
        drone_id: int,
        *,
        follows: bool = True,
        patterns: Sequence[str] = (),
    ) -> None:
        self._url_of, self._follows, self._patterns = url_of, follows, tuple(patterns)
        self._stack = ExitStack()
        self._listeners: dict[int, Listener] = {}
        self.ring = Ring()
        self.drone_id = drone_id
        self._open(drone_id)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._stack.close()

    @property
    def listener(self) -> Listener:
        """The bus that is looked at."""
        return self._listeners[self.drone_id]

    @property
    def has_heard(self) -> bool:
        return any(listener.statistics.channels for listener in self._listeners.values())

    def drain(self) -> None:
        """Take in all that waits on every bus."""
        for listener in self._listeners.values():
            listener.drain()

    def look_round(self) -> None:
        """Take in what every drone says of the ring, and hear those that it names."""
        for listener in self._listeners.values():
            heard = listener.statistics.channels
            for name, take in (
                (channels.LINK_STATE, self.ring.hear_links),
                (channels.FLEET_STATE, self.ring.hear_fleet),
            ):
                message = listener.newest(name)
                if message is not None and not isinstance(message, bytes):
                    take(message, heard[name].last_us)
        if self._follows:
            for drone_id in self.ring.known_ids():
                if drone_id not in self._listeners:
                    self._open(drone_id)

    def step(self, by: int) -> None:
        """Look at the next drone's bus, or the one before."""
        self.look_round()
        ids = sorted(self._listeners)
        self.drone_id = ids[(ids.index(self.drone_id) + by) % len(ids)]

    def _open(self, drone_id: int) -> None:
        self._listeners[drone_id] = self._stack.enter_context(
            Listener(self._url_of(drone_id), self._is_wanted)
        )

    def _is_wanted(self, name: str) -> bool:
        return not self._patterns or any(fnmatch.fnmatchcase(name, pattern) for pattern in self._patterns)
