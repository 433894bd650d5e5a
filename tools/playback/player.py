"""Plays the messages of a fleet's logs, each on its drone's bus at its time."""

import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from drivers.cameras.replay import decode_picture
from drivers.frames import SharedFrames
from lcmtypes import channels, make
from lcmtypes.podwatch import frame_t, preview_t
from logs.exceptions import LogError
from logs.fleet import FleetMessage
from logs.sequence import read_head
from tools.playback.playhead import Playhead
from tools.playback.selection import NEVER_PLAYED, Selection

__all__ = ["Played", "Player"]

LOOK_S = 0.2  # between two looks at the keys and two lines of the display
PAUSE, STEP, QUIT = " ", "s", "q"


class Bus(Protocol):
    def publish(self, channel: str, data: bytes) -> None: ...


class KeySource(Protocol):
    def wait(self, seconds: float) -> str: ...


@dataclass
class Played:
    """What was played so far. late_s: of every message, how long after its time it was said. passed_by: the
    channels of messages in the span that were not wanted.
    """

    n_messages: int = 0
    n_frames: int = 0
    late_s: "array[float]" = field(default_factory=lambda: array("f"))
    passed_by: set[str] = field(default_factory=set)

    def late_ms(self, share: float) -> float:
        """The lateness that `share` of the messages keep, ms."""
        ordered = sorted(self.late_s)
        return ordered[min(int(share * len(ordered)), len(ordered) - 1)] * 1e3 if ordered else 0.0


class Player:
    """buses: drone id -> its bus. rings: drone id -> a fresh frame ring, for those whose pictures become
    frames again; image_size is theirs, (width, height) px.
    """

    def __init__(
        self,
        buses: Mapping[int, Bus],
        selection: Selection,
        speed: float = 1.0,
        rings: dict[int, SharedFrames] | None = None,
        image_size: tuple[int, int] | None = None,
        show: Callable[["Player", float], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.head = Playhead(speed)
        self.played = Played()
        self.begin_us: int | None = None
        self._buses = buses
        self._selection = selection
        self._rings = rings or {}
        self._image_size = image_size
        self._show = show
        self._clock = clock
        self._whole: set[int] = set()  # drones whose log has whole frames: their previews become none
        self._n_written: dict[int, int] = {}
        self._shown_s = 0.0

    def play(self, messages: Iterable[FleetMessage], keys: KeySource) -> bool:
        """Play everything; False where a key ended it. Raises LogError where nothing of it was wanted."""
        for entry in self._selection.cut(messages):
            if self.begin_us is None:
                self.begin_us = entry.at_us
            said = list(self._said(entry))
            if not said:
                self.played.passed_by.add(entry.raw.channel)
            if said and not self._await(entry.at_us, keys):
                return False
            for channel, data in said:
                self._buses[entry.drone_id].publish(channel, data)
        if self.played.passed_by and not self.played.n_messages:
            raise LogError(
                "nothing to play: no message of this time is on a channel that was asked for (--channel, "
                f"--without); there are {', '.join(sorted(self.played.passed_by))}"
            )
        return True

    def again(self) -> None:
        """The next message is the logs' first again."""
        if self.begin_us is not None:
            self.head.jump(self.begin_us, self._clock())

    def _await(self, at_us: int, keys: KeySource) -> bool:
        """Wait until `at_us` is due, or stepped to; False on the key that quits."""
        while True:
            now_s = self._clock()
            self._tell(now_s)
            wait_s = LOOK_S if self.head.is_paused else self.head.due_s(at_us, now_s) - now_s
            if wait_s <= 0:
                self._count(-wait_s)
                return True
            key = keys.wait(min(wait_s, LOOK_S))
            now_s = self._clock()
            if key == QUIT:
                return False
            if key == PAUSE:
                self.head.toggle(self._position(at_us, now_s), now_s)
            if key == STEP:
                if not self.head.is_paused:
                    self.head.toggle(at_us, now_s)
                self.head.jump(at_us, now_s)
                self._count(0.0)
                return True

    def _position(self, at_us: int, now_s: float) -> int:
        position = self.head.position_us(now_s)
        return at_us if position is None else min(position, at_us)

    def _count(self, late_s: float) -> None:
        self.played.n_messages += 1
        self.played.late_s.append(late_s)

    def _tell(self, now_s: float) -> None:
        if self._show is not None and now_s - self._shown_s >= LOOK_S:
            self._shown_s = now_s
            position = self.head.position_us(now_s)
            begin_us = self.begin_us or 0
            at_s = 0.0 if position is None else (position - begin_us) / 1e6
            self._show(self, self._selection.start_s + at_s)

    def _said(self, entry: FleetMessage) -> Iterator[tuple[str, bytes]]:
        """(channel, bytes) of what one logged message says on the bus: itself, a frame, both or nothing."""
        raw = entry.raw
        if raw.channel not in NEVER_PLAYED and self._selection.takes(raw.channel):
            yield self._selection.name(raw.channel), raw.data
        if entry.drone_id in self._rings and raw.channel in (channels.IMAGE, channels.PREVIEW):
            if raw.channel == channels.IMAGE:
                self._whole.add(entry.drone_id)
            elif entry.drone_id in self._whole:
                return
            frame = self._frame(entry)
            if frame is not None and self._selection.takes(channels.FRAME):
                yield self._selection.name(channels.FRAME), frame.encode()

    def _frame(self, entry: FleetMessage) -> frame_t | None:
        """The handle of a logged picture in the drone's fresh ring; None for bytes that are no picture."""
        if read_head(entry.raw.channel, entry.raw.data) is None:
            return None
        picture = preview_t.decode(entry.raw.data)
        image = decode_picture(picture, self._image_size)
        if image is None:
            return None
        number = self._n_written.get(entry.drone_id, 0)
        self._n_written[entry.drone_id] = number + 1
        ring, token, slot = self._rings[entry.drone_id].write(image, number)
        self.played.n_frames += 1
        return make(
            frame_t,
            utime=picture.utime,
            seq=number,
            drone_id=entry.drone_id,
            ring=ring,
            token=token,
            slot=slot,
            width=image.shape[1],
            height=image.shape[0],
        )
