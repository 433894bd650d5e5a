"""A link in memory, for virtual time: two ends, real MAVLink bytes, arrival when the scheduler says."""

from collections.abc import Callable

__all__ = ["MemoryLink", "link_pair"]

Deliver = Callable[[Callable[[], None]], None]


class MemoryLink:
    """One end of a link in memory; `link_pair` makes both."""

    def __init__(self, deliver: Deliver, system_id: int = 0) -> None:
        self.system_id = system_id
        self._deliver = deliver
        self._arrived = bytearray()
        self._handler: Callable[[], None] | None = None
        self._far: MemoryLink | None = None

    def write(self, data: bytes) -> None:
        """Send to the other end; empty data and a closed far end are nothing to do."""
        far = self._far
        if data and far is not None:
            self._deliver(lambda: far._arrive(data))

    def receive(self) -> bytes:
        """All that has arrived since the last call."""
        data = bytes(self._arrived)
        self._arrived.clear()
        return data

    def on_arrival(self, handler: Callable[[], None]) -> None:
        """Call `handler` whenever something arrives."""
        self._handler = handler

    def fileno(self) -> int:
        """No file stands behind a link in memory."""
        return -1

    def close(self) -> None:
        """Neither hear nor say any more."""
        if self._far is not None:
            self._far._far = None
            self._far = None
        self._handler = None

    def _arrive(self, data: bytes) -> None:
        self._arrived += data
        if self._handler is not None:
            self._handler()


def link_pair(deliver: Deliver, system_id: int = 0) -> tuple[MemoryLink, MemoryLink]:
    """(the bridge's end, the autopilot's end).

    `deliver(action)` runs each arrival, at once or after the link's delay.
    """
    bridge_end, autopilot_end = MemoryLink(deliver, system_id), MemoryLink(deliver, system_id)
    bridge_end._far, autopilot_end._far = autopilot_end, bridge_end
    return bridge_end, autopilot_end
