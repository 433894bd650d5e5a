"""What a fleet's logs show, item by item on one clock: the one source of every export."""

import json
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import pymap3d

from drivers.cameras.replay import RAW_FORMAT, decode_picture
from lcmtypes import channels
from lcmtypes.podwatch import heartbeat_t, track_t, vehicle_state_t
from logs.exceptions import LogError
from logs.fleet import Fleet, FleetMessage, Report, find_logs
from logs.sequence import read_head
from procs.autopilot.telemetry import EARLIEST_UTC_US, LATEST_UTC_US
from procs.navigator.states import State

__all__ = ["AnimalSight", "DronePose", "Marks", "Note", "Outline", "Picture", "Recording", "colour_of"]

JPEG_QUALITY = 85
# Distinct to most eyes; an animal keeps its colour in every view.
COLOURS = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (204, 121, 167),
)
NOBODY = (160, 160, 160)  # a box without an identity
# Pictures are rarer than what is seen in them: marks of another instant would lie beside the animals.
BOXES_REACH_US = 100_000
MASK_REACH_US = 26_000  # half a frame: the very frame
RECENT_PICTURES = 8


@dataclass(frozen=True)
class Picture:
    """A camera picture. scale: its px a px of the frame."""

    at_us: int
    drone_id: int
    jpeg: bytes
    width: int
    height: int
    scale: float


@dataclass(frozen=True)
class Outline:
    """A closed line in a frame, px (u, v), and the animal that it is, -1 for none that is known."""

    points: tuple[tuple[float, float], ...]
    animal: int
    label: str


@dataclass(frozen=True)
class Marks:
    """What a drone sees in one picture, at that picture's time: boxes with identities, the mask it tracks.

    A later one of the same time knows more.
    """

    at_us: int
    drone_id: int
    boxes: tuple[Outline, ...]
    masks: tuple[Outline, ...]


@dataclass(frozen=True)
class DronePose:
    """Where a drone says it is: m in the fleet's NED frame, and on the globe. Its error is not logged."""

    at_us: int
    drone_id: int
    ned_m: tuple[float, float, float]
    yaw_rad: float
    latitude_deg: float
    longitude_deg: float
    height_m: float  # above the fleet's origin
    state: str
    animal: int


@dataclass(frozen=True)
class AnimalSight:
    """Where a drone, which sees the animal at this moment, holds it in the fleet's map.

    uncertainty_m: between the drone's own sight and the map.
    """

    at_us: int
    drone_id: int
    animal: int
    ned_m: tuple[float, float, float]
    size_m: float
    latitude_deg: float
    longitude_deg: float
    uncertainty_m: float


@dataclass(frozen=True)
class Note:
    """Something for people to read: a change of state, a trouble. level: "info", "warning" or "error"."""

    at_us: int
    drone_id: int
    level: str
    source: str
    text: str


@dataclass
class _Shown:
    """A picture that marks may still come for."""

    utime: int
    at_us: int
    boxes: tuple[Outline, ...] = ()
    boxes_miss_us: int = BOXES_REACH_US + 1
    masks: tuple[Outline, ...] = ()


Item = Picture | Marks | DronePose | AnimalSight | Note


class Recording:
    """The logs of one or more drones. Raises LogError as Fleet does, and where no log tells the origin."""

    def __init__(self, paths: list[Path], report: Report, began: datetime | None = None) -> None:
        """began: UTC of the logs' first message, in place of what the drones' GPS told. Where nobody knows it
        times count from 0.
        """
        self.fleet = Fleet(find_logs(paths), report)
        self.begin_us = next((entry.at_us for entry in self.fleet.messages()), 0)
        self.began = began or _began(self.fleet, self.begin_us)
        self._origin = _origin(self.fleet)

    def time_s(self, at_us: int) -> float:
        """Seconds since the logs' first message."""
        return (at_us - self.begin_us) / 1e6

    def time_ns(self, at_us: int) -> int:
        """Wall time, ns since 1970, or since the first message where the wall time is not known."""
        began_ns = round(self.began.timestamp() * 1e9) if self.began else 0
        return max(began_ns + (at_us - self.begin_us) * 1000, 0)

    def items(self) -> Iterator[Item]:
        """Everything that the logs show, about by time."""
        views = {drone_id: _View(drone_id, self) for drone_id in self.fleet.drone_ids}
        for entry in self.fleet.messages():
            if read_head(entry.raw.channel, entry.raw.data) is not None:
                yield from views[entry.drone_id].take(entry)

    def on_globe(self, n_m: float, e_m: float) -> tuple[float, float]:
        """(latitude, longitude) in degrees of a point at the surface."""
        latitude, longitude, _ = pymap3d.ned2geodetic(n_m, e_m, 0.0, *self._origin)
        return float(latitude), float(longitude)


class _View:
    """One drone's log: its messages, and what they show."""

    def __init__(self, drone_id: int, recording: Recording) -> None:
        self._drone_id = drone_id
        self._recording = recording
        self._line = recording.fleet.lines[drone_id]
        self._state, self._animal = "", -1
        self._newest_boxes: tuple[int, tuple[Outline, ...]] = (-BOXES_REACH_US, ())  # utime, boxes
        self._newest_masks: tuple[int, tuple[Outline, ...]] = (-BOXES_REACH_US, ())
        self._recent: deque[_Shown] = deque(maxlen=RECENT_PICTURES)
        self._trouble: dict[str, str] = {}
        self._has_whole = False
        self._takers = {
            channels.VEHICLE_STATE: self._vehicle,
            channels.IDENTITIES: self._identities,
            channels.TRACK: self._track,
            channels.PREVIEW: self._picture,
            channels.IMAGE: self._picture,
            channels.MISSION_STATE: self._mission,
            channels.HEARTBEAT: self._heartbeat,
            channels.LOG_STATE: self._log_state,
        }

    def take(self, entry: FleetMessage) -> Iterator[Item]:
        """What one message shows, of its own instant."""
        taker = self._takers.get(entry.raw.channel)
        kind = channels.kind_of(entry.raw.channel)
        if taker is None or kind is None:
            return
        message = kind.decode(entry.raw.data)
        if entry.raw.channel == channels.IMAGE:
            self._has_whole = True
        elif entry.raw.channel == channels.PREVIEW and self._has_whole:
            return
        yield from taker(message, round(self._line.at(message.utime)))

    def _vehicle(self, message: Any, at_us: int) -> Iterator[Item]:
        if message.position_ok:
            latitude, longitude = self._recording.on_globe(message.n_m, message.e_m)
            yield DronePose(
                at_us, self._drone_id, (message.n_m, message.e_m, message.d_m), message.yaw_rad, latitude,
                longitude, -message.d_m, self._state, self._animal,
            )  # fmt: skip

    def _identities(self, message: Any, at_us: int) -> Iterator[Item]:
        boxes = tuple(
            Outline(
                (
                    (box.left_px, box.top_px),
                    (box.right_px, box.top_px),
                    (box.right_px, box.bottom_px),
                    (box.left_px, box.bottom_px),
                ),
                animal,
                f"animal {animal}" if animal >= 0 else f"{box.score:.0%}",
            )
            for box, animal in zip(message.boxes, message.ids, strict=True)
        )
        self._newest_boxes = (message.utime, boxes)
        for shown in self._recent:
            if self._take_boxes(shown):
                yield self._marks(shown)
        for seen in message.map:
            if seen.mine:
                latitude, longitude = self._recording.on_globe(seen.n_m, seen.e_m)
                yield AnimalSight(
                    at_us, self._drone_id, seen.id, (seen.n_m, seen.e_m, 0.0), seen.size_m, latitude,
                    longitude, seen.residual_m,
                )  # fmt: skip

    def _take_boxes(self, shown: _Shown) -> bool:
        """Whether the newest boxes are nearer to a picture's instant than those that it has."""
        utime, boxes = self._newest_boxes
        miss_us = abs(utime - shown.utime)
        if miss_us >= shown.boxes_miss_us:
            return False
        shown.boxes, shown.boxes_miss_us = boxes, miss_us
        return True

    def _take_masks(self, shown: _Shown) -> bool:
        """Whether the newest mask is of a picture's very frame."""
        utime, masks = self._newest_masks
        if abs(utime - shown.utime) > MASK_REACH_US:
            return False
        shown.masks = masks
        return True

    def _marks(self, shown: _Shown) -> Marks:
        return Marks(shown.at_us, self._drone_id, shown.boxes, shown.masks)

    def _track(self, message: Any, at_us: int) -> Iterator[Item]:
        if message.state != track_t.TRACKING:
            return
        points = tuple((float(u), float(v)) for u, v in message.outline) or (
            (message.left_px, message.top_px),
            (message.right_px, message.top_px),
            (message.right_px, message.bottom_px),
            (message.left_px, message.bottom_px),
        )
        mask = Outline(points, message.animal, f"watching {message.animal}")
        self._newest_masks = (message.utime, (mask,))
        for shown in self._recent:
            if self._take_masks(shown):
                yield self._marks(shown)

    def _picture(self, message: Any, at_us: int) -> Iterator[Item]:
        jpeg = bytes(message.data)
        if message.format == RAW_FORMAT:
            image = decode_picture(message)
            if image is None:
                return
            _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            jpeg = encoded.tobytes()
        yield Picture(at_us, self._drone_id, jpeg, message.width, message.height, message.scale)
        shown = _Shown(message.utime, at_us)
        self._take_boxes(shown)
        self._take_masks(shown)
        self._recent.append(shown)
        yield self._marks(shown)

    def _mission(self, message: Any, at_us: int) -> Iterator[Item]:
        state = State(message.state).name if message.state in list(State) else str(message.state)
        self._animal = message.animal
        if state != self._state:
            self._state = state
            yield Note(at_us, self._drone_id, "info", "navigator", f"{state}: {message.reason}")

    def _heartbeat(self, message: Any, at_us: int) -> Iterator[Item]:
        detail = message.detail if message.status != heartbeat_t.OK else ""
        if detail != self._trouble.get(message.process, ""):
            self._trouble[message.process] = detail
            level = "warning" if detail else "info"
            yield Note(at_us, self._drone_id, level, message.process, detail or "works again")

    def _log_state(self, message: Any, at_us: int) -> Iterator[Item]:
        if message.problem and message.problem != self._trouble.get("log", ""):
            self._trouble["log"] = message.problem
            yield Note(at_us, self._drone_id, "error", "logger", message.problem)


def colour_of(animal: int) -> tuple[int, int, int]:
    """(red, green, blue), 0-255, of an animal; grey for none."""
    return NOBODY if animal < 0 else COLOURS[animal % len(COLOURS)]


def _began(fleet: Fleet, begin_us: float) -> datetime | None:
    """UTC of the first message, by the first drone whose GPS told the time."""
    for entry in fleet.messages():
        if entry.raw.channel == channels.VEHICLE_STATE:
            state = vehicle_state_t.decode(entry.raw.data)
            if EARLIEST_UTC_US <= state.utc_us < LATEST_UTC_US:
                after_us = fleet.lines[entry.drone_id].at(state.utime) - begin_us
                return datetime.fromtimestamp((state.utc_us - after_us) / 1e6, tz=UTC)
    return None


def _origin(fleet: Fleet) -> tuple[float, float, float]:
    """Latitude and longitude in degrees and altitude in m of the fleet's origin."""
    for log in fleet.logs:
        try:
            origin = json.loads(log.metadata["mission"])["origin"]
            return float(origin["latitude_deg"]), float(origin["longitude_deg"]), float(origin["altitude_m"])
        except (KeyError, ValueError, TypeError):
            continue
    raise LogError(
        f"{fleet.logs[0].path}: does not say where the fleet's origin lies; only a drone's own log can be "
        "exported"
    )
