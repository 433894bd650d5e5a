"""Runs one process's shell over a recorded log in virtual time, and keeps what it says.

The process hears every message of the log at its logged time but its own, starts when its first heartbeat
says that it started, and again at each restart. What it says is heard on the virtual bus, by itself too.
"""

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from drivers.cameras.replay import decode_picture
from drivers.frames import MemoryFrames
from lcmtypes import channels
from lcmtypes.podwatch import frame_t, heartbeat_t, preview_t
from logs.exceptions import LogError
from logs.fleet import DroneLog
from logs.scan import RawMessage
from logs.sequence import read_head
from procs import processes
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.runtime import HEARTBEAT_PERIOD_S
from procs.settings import DroneSettings, Mission

__all__ = ["SAYS", "LoggedFrames", "Replayed", "Said", "replay", "settings_of"]

# What each process that can be replayed says, besides HEARTBEAT.
SAYS = {
    "camera": (channels.FRAME, channels.PREVIEW),
    "detector": (channels.DETECTIONS,),
    "registrar": (channels.IDENTITIES, channels.RING_EPISODE, channels.RING_MAP),
    "assigner": (channels.ASSIGNMENT, channels.RING_ASSIGN),
    "tracker": (channels.TRACK,),
    "navigator": (channels.SETPOINT, channels.MISSION_STATE),
}
UNLOGGED = {
    "autopilot": "what its autopilot said over MAVLink",
    "relay": "what came over its radio",
    "logger": "the disk that it wrote to",
}
SEES = ("camera", "detector", "tracker")  # need the pixels
KEPT_FRAMES = 64  # more than the ring of the flight had


class Said(NamedTuple):
    """One message that the process said."""

    at_us: int  # arrival at the logger, drone clock
    channel: str
    data: bytes


@dataclass(frozen=True)
class Replayed:
    """recorded and replayed: what the process said then and now. is_virtual: the log was made in virtual
    time, so that both must agree to the bit. n_starts: starts of the process within the log.
    """

    recorded: list[Said]
    replayed: list[Said]
    is_virtual: bool
    n_starts: int


def replay(
    process: str,
    log: DroneLog,
    drivers: dict[str, Callable[[], Any]],
    clock: ClockError | None = None,
) -> Replayed:
    """Run `process` over `log`. drivers: name -> maker of what the shell opens beside frames and camera.
    clock: how the drone's clock ran beside virtual time, where a simulated run's folder says so.

    Raises LogError: a process whose edge is not in a log, a log without what the process needs.
    """
    if process in UNLOGGED:
        raise LogError(
            f"{process} cannot be replayed: {UNLOGGED[process]} is in no log; there are {', '.join(SAYS)}"
        )
    if process not in SAYS:
        raise LogError(f"there is no process {process!r}; there are {', '.join(SAYS)}")
    beats = [beat for beat in _beats(log) if beat.process == process]
    if not beats:
        raise LogError(f"{log.path}: holds no heartbeat of {process}, so nothing says when it started")
    return _Replay(process, log, drivers, beats, clock or ClockError()).run()


class LoggedFrames:
    """The frame ring as the log kept it: `read` gives a frame's pixels, as they were."""

    def __init__(self, log: DroneLog) -> None:
        self._images = _images(log)
        self._held: dict[tuple[int, int], preview_t] = {}  # (utime, seq of the frame) -> its picture
        self._newest_utime = -1
        self.n_gone = 0

    def read(self, frame: frame_t) -> Any:
        """(H, W, 3) uint8 BGR, None for a frame that the log does not hold."""
        while self._newest_utime < frame.utime and (image := next(self._images, None)) is not None:
            self._held[image.utime, image.frame_seq] = image
            self._newest_utime = image.utime
            if len(self._held) > KEPT_FRAMES:
                del self._held[min(self._held)]
        held = self._held.get((frame.utime, frame.seq))
        pixels = decode_picture(held) if held is not None else None
        self.n_gone += pixels is None
        return pixels

    def close(self) -> None:
        """Nothing to give back."""


class _LoggedCamera:
    """Each whole image of the log, one a call: the camera process captures one a frame."""

    def __init__(self, log: DroneLog) -> None:
        self._images = _images(log)

    def capture(self) -> Any:
        image = next(self._images, None)
        return None if image is None else decode_picture(image)


class _Replay:
    def __init__(
        self,
        process: str,
        log: DroneLog,
        drivers: dict[str, Callable[[], Any]],
        beats: list[heartbeat_t],
        clock: ClockError,
    ) -> None:
        self._process, self._log, self._clock = process, log, clock
        self._settings = settings_of(log)
        self._drivers = {name: _opener(make) for name, make in drivers.items()} | self._edges()
        self._starts = _starts(beats)
        self._is_virtual = all(beat.pid == 0 for beat in beats)
        self._queue = EventQueue()
        self._bus = VirtualBus(self._queue)
        self._bus.observers.append(self._heard)
        self._feeding = self._is_fed = False
        self._next_us = 0
        self._runtime: QueueRuntime | None = None
        self._recorded: list[Said] = []
        self._replayed: list[Said] = []

    def run(self) -> Replayed:
        messages = self._log.messages()
        first = next(messages)
        begin_us = first.log_time_ns // 1000
        self._queue.now_us = self._clock.true_us(min(begin_us, self._starts[0]))
        for start_us in self._starts:
            self._queue.schedule(self._clock.true_us(start_us), self._start)
        self._feed_from(first, messages)
        # What came before the log began, or after the process ended, has no counterpart; it beat to its end.
        end_us = self._recorded[-1].at_us
        if not self._is_virtual:
            begin_us = self._recorded[0].at_us
        replayed = [said for said in self._replayed if begin_us <= said.at_us <= end_us]
        return Replayed(self._recorded, replayed, self._is_virtual, len(self._starts))

    def _edges(self) -> dict[str, Callable[[str], Any]]:
        if self._process not in SEES:
            return {}
        if next(_images(self._log), None) is None:
            raise LogError(
                f"{self._log.path}: holds no whole frames, which {self._process} needs; record one with "
                "podwatch sim --log-frames"
            )
        if self._process == "camera":
            return {"camera": lambda _: _LoggedCamera(self._log), "frames": lambda _: MemoryFrames()}
        return {"frames": lambda _: LoggedFrames(self._log)}

    def _start(self) -> None:
        """The process starts, now; one that ran before has died."""
        if self._runtime is not None:
            self._runtime.kill()
        runtime = QueueRuntime(self._process, self._settings, self._bus, self._clock, self._drivers)
        importlib.import_module(processes.BY_NAME[self._process].module).setup(runtime)
        runtime.start()
        self._runtime = runtime

    def _feed_from(self, first: RawMessage, rest: Iterator[RawMessage]) -> None:
        """Deliver every message at its time: each one's delivery schedules the next."""

        def feed(raw: RawMessage) -> None:
            self._deliver(raw)
            following = next(rest, None)
            if following is None:
                self._is_fed = True
            else:
                schedule(following)

        def schedule(raw: RawMessage) -> None:
            self._next_us = max(self._clock.true_us(raw.log_time_ns // 1000), self._queue.now_us)
            self._queue.schedule(self._next_us, lambda: feed(raw))

        schedule(first)
        while not self._is_fed:
            self._queue.run_until(self._next_us)

    def _deliver(self, raw: RawMessage) -> None:
        if raw.channel == channels.IMAGE:
            return
        if self._is_own(raw.channel, raw.data):
            self._recorded.append(Said(raw.log_time_ns // 1000, raw.channel, raw.data))
            return
        self._feeding = True
        self._bus.deliver(raw.channel, raw.data)
        self._feeding = False

    def _heard(self, channel: str, data: bytes) -> None:
        if not self._feeding:
            self._replayed.append(Said(self._clock.utime(self._queue.now_us), channel, data))

    def _is_own(self, channel: str, data: bytes) -> bool:
        if channel == channels.HEARTBEAT and read_head(channel, data):
            return bool(heartbeat_t.decode(data).process == self._process)
        return channel in SAYS[self._process]


def _opener(make: Callable[[], Any]) -> Callable[[str], Any]:
    return lambda _process: make()


def settings_of(log: DroneLog) -> DroneSettings:
    """What the drone was told, from the log. Raises LogError where it does not say."""
    try:
        mission = Mission.model_validate_json(log.metadata["mission"])
        return DroneSettings(drone_id=log.drone_id, mission=mission, seed=int(log.metadata["seed"]))
    except (KeyError, ValueError) as error:
        raise LogError(
            f"{log.path}: does not say with which mission and seed it was flown ({error}); only a "
            "drone's own log, or one made of it, can be replayed"
        ) from error


def _beats(log: DroneLog) -> Iterator[heartbeat_t]:
    for raw in log.messages():
        if raw.channel == channels.HEARTBEAT and read_head(raw.channel, raw.data):
            yield heartbeat_t.decode(raw.data)


def _starts(beats: list[heartbeat_t]) -> list[int]:
    """When the process started, drone clock us: its first beat, and each that counts from 0 again."""
    first = beats[0]
    starts = [first.utime - round(first.seq * HEARTBEAT_PERIOD_S * 1e6)]
    return starts + [beat.utime for beat in beats[1:] if beat.seq == 0]


def _images(log: DroneLog) -> Iterator[preview_t]:
    for raw in log.messages():
        if raw.channel == channels.IMAGE and read_head(raw.channel, raw.data):
            yield preview_t.decode(raw.data)
