"""What a mission file may say, and what one drone's processes are told. Validated by pydantic; an unknown key
is refused.
"""

from __future__ import annotations

import difflib
import json
import tomllib
from itertools import combinations
from math import hypot
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

__all__ = [
    "AssignSettings",
    "BoatSettings",
    "CameraSettings",
    "DetectorSettings",
    "DriverSpec",
    "DroneSettings",
    "LimitSettings",
    "LogSettings",
    "MachineSettings",
    "Mission",
    "MissionError",
    "RadioSettings",
    "SearchSettings",
    "WatchSettings",
    "beside",
    "load_mission",
]


MAX_DRONES = 63  # members travel as a bitmap of 64 bits, signed
LEAST_HOME_SPACING_M = 3.0  # nearer homes let two drones land on each other
# A drone never flies nearer to its fence: what lies beyond is never reached (docs/autopilot_facts.md, 11).
FENCE_KEPT_M = 3.0
LEAST_TILE_PX = 32
# What a text must look like, and the same in words, which are what people are told.
CAMERA = r"^(v4l2|gstreamer|ffmpeg|pictures):.+$"
AUTOPILOT = r"^(udp|udpout|tcp|serial):.+:\d+$"
RADIO = r"^[^\s:]+:\d{1,5}$"
RADIO_OR_NONE = r"^([^\s:]+:\d{1,5})?$"
DRIVER = r"^[\w.]+:\w+$"
IN_WORDS = {
    CAMERA: 'v4l2:DEVICE, gstreamer:PIPELINE, ffmpeg:ADDRESS or pictures:FOLDER, as "v4l2:/dev/video0"',
    AUTOPILOT: "serial:DEVICE:BAUD, udp:HOST:PORT (listens), udpout:HOST:PORT or tcp:HOST:PORT, as "
    '"serial:/dev/ttyAMA0:921600"',
    RADIO: 'HOST:PORT, as "10.76.0.1:14600"',
    RADIO_OR_NONE: 'HOST:PORT, as "10.76.0.100:14600"',
    DRIVER: 'package.module:Class, as "my.camera:Camera"',
}


class MissionError(Exception):
    """A mission, fleet or settings file that cannot be flown; the message names the key, the value and the
    remedy.
    """


class Section(BaseModel):
    """A table of the mission file: unknown keys refused, values frozen once read."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class OriginSettings(Section):
    """The fleet's origin: n = e = 0 of every local frame, d = 0 the surface."""

    latitude_deg: float = Field(15.30, ge=-90, le=90)  # of the take-off place, as decimal degrees
    longitude_deg: float = Field(-61.50, ge=-180, le=180)  # of the take-off place; west is negative
    altitude_m: float = Field(0.0, ge=-500, le=9000)  # of the water above mean sea level


class CameraSettings(Section):
    """The downward camera, alike on every drone."""

    width_px: int = Field(640, ge=160, le=4096)  # of a picture
    height_px: int = Field(480, ge=120, le=4096)  # of a picture
    vfov_deg: float = Field(60.0, gt=10, lt=150)  # vertical field of view, as calibrated
    rate_hz: float = Field(20.0, ge=1, le=60)  # pictures a second
    preview_hz: float = Field(2.0, ge=0.2, le=5)  # small pictures a second for log and report
    detect_hz: float = Field(5.0, ge=0.5, le=30)  # pictures a second in which animals are looked for


class DetectorSettings(Section):
    """The model that finds animals, and how it is used."""

    model: str = ""  # an ONNX file, from the fleet file's folder; empty: the one that ships
    confidence: float = Field(0.25, ge=0.01, le=1)  # least score of a find
    iou: float = Field(0.45, ge=0, le=1)  # of two boxes that overlap by more the lesser goes
    classes: tuple[int | str, ...] = ()  # numbers or names of the model's classes; empty: all
    # auto: where animals are too small; a side in px, 32 to 8192: always
    tile: int | Literal["auto", "off"] = "auto"
    tile_limit_ms: float = Field(100.0, ge=1, le=5000)  # that a tiled frame may take where tile is auto
    # what runs the network; where it is not there, the cpu does
    provider: Literal["cpu", "cuda", "tensorrt", "openvino"] = "cpu"

    @model_validator(mode="after")
    def _known_tile(self) -> Self:
        if isinstance(self.tile, int) and not LEAST_TILE_PX <= self.tile <= 8192:
            raise ValueError(f'tile = {self.tile}: "auto", "off", or {LEAST_TILE_PX} to 8192 px')
        return self

    def options(self) -> dict[str, Any]:
        """Arguments of `procs.detector.yolo.Detector`."""
        return {
            "model_path": self.model or None,
            "confidence": self.confidence,
            "iou": self.iou,
            "classes": list(self.classes) or None,
            "tile": None if self.tile == "off" else self.tile,
            "tile_limit_ms": self.tile_limit_ms,
            "provider": self.provider,
        }


class SearchSettings(Section):
    """Where and how the scout looks."""

    # auto: each as soon as it is ready; operator: on the boat's order START
    start: Literal["auto", "operator"] = "auto"
    # middle of the spiral, north of the origin: where people think the pod may be
    north_m: float = Field(100.0, ge=-20000, le=20000)
    east_m: float = Field(0.0, ge=-20000, le=20000)  # east of the origin; below 0: west
    height_m: float = Field(40.0, ge=5, le=120)  # of the scout
    speed_m_s: float = Field(6.0, gt=0, le=15)  # of the scout, and of who waits over its home
    radius_m: float = Field(150.0, ge=5, le=5000)  # of the spiral; it must lie inside the fence
    # share of the recent pictures with animals in them that makes a find (paper, Scouting)
    presence_share: float = Field(0.8, gt=0, le=1)
    presence_frames: int = Field(15, ge=3, le=200)  # how many pictures are recent


class WatchSettings(Section):
    """Gathering over the pod and watching one animal each."""

    watch_s: float = Field(60.0, ge=1, le=7200)  # how long animals are watched before the fleet returns
    height_m: float = Field(30.0, ge=5, le=120)  # height over the own animal
    max_height_m: float = Field(
        60.0, ge=10, le=120
    )  # ceiling while gathering, though less of the pod be in view
    separation_m: float = Field(8.0, ge=3, le=50)  # between neighbours on the gathering circle
    animal_length_m: float = Field(10.0, gt=0.5, le=40)  # of a grown animal of this species
    speed_m_s: float = Field(8.0, gt=0, le=15)  # of all flight to the pod, over it and home
    max_animal_speed_m_s: float = Field(4.0, gt=0, le=15)  # an animal that is followed is taken for no faster
    episode_limit_s: float = Field(5.0, ge=2, le=20)  # so long may the drones compare their views


class AssignSettings(Section):
    """Who watches which animal."""

    method: Literal["auto", "exact", "gnn", "gnn+resolve"] = "auto"  # auto: what sends least
    gain_m: float = Field(5.0, ge=0, le=500)  # only for so much saved does a drone change its animal
    # so much farther counts an animal a minute that anybody has watched it: the others have their turn
    minute_watched_m: float = Field(1.0, ge=0, le=100)


class LimitSettings(Section):
    """What no setpoint may exceed; the bridge clamps to it at the last hop."""

    speed_m_s: float = Field(10.0, gt=0, le=20)  # over the ground, at most
    climb_m_s: float = Field(3.0, gt=0, le=6)  # upwards, at most
    descent_m_s: float = Field(2.0, gt=0, le=4)  # downwards, at most
    min_height_m: float = Field(10.0, ge=2, le=100)  # lowest flight, but for take-off and landing
    max_height_m: float = Field(80.0, ge=5, le=120)  # highest flight
    fence_radius_m: float = Field(600.0, ge=20, le=20000)  # of the circle round the origin that nobody leaves
    battery_return: float = Field(0.25, ge=0.05, le=0.9)  # share of the charge: below it a drone goes home
    battery_land: float = Field(0.10, ge=0.02, le=0.5)  # share of the charge: below it a drone lands at once
    setpoint_life_s: float = Field(0.5, ge=0.1, le=2.0)  # after which a setpoint is obeyed no more

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_height_m >= self.max_height_m:
            raise ValueError(
                f"min_height_m {self.min_height_m} must be below max_height_m {self.max_height_m}"
            )
        if self.battery_land >= self.battery_return:
            raise ValueError(
                f"battery_land {self.battery_land} must be below battery_return {self.battery_return}"
            )
        return self


class RadioSettings(Section):
    """The ring's links."""

    bytes_per_s: int = Field(6000, ge=1500, le=1_000_000)  # cap for each link, headers and seal counted
    lost_after_s: float = Field(3.0, ge=1, le=30)  # unheard for so long, a drone is lost to the others
    # beside the fleet file; `podwatch fleet keys` makes it, a simulation its own
    key_file: str = "fleet.key"


class LogSettings(Section):
    """What each drone's logger keeps."""

    segment_s: float = Field(600.0, ge=0, le=86400)  # length of one file of the log; 0: one file a start
    quota_gb: float = Field(0.0, ge=0, le=100_000)  # above it the oldest pictures go first; 0: none
    frames: bool = False  # whole frames too, to replay what looks at pixels: about 1 MB each


class DriverSpec(Section):
    """A driver by name, `package.module:Class`, and its options: how a process gets its edge without knowing
    which.
    """

    driver: str = Field(pattern=DRIVER)  # where Python finds it
    options: dict[str, Any] = {}  # its arguments by name


class MachineSettings(Section):
    """What one drone's own computer is wired to: for `podwatch fly`, of no weight in a simulated fleet."""

    camera: str = Field("v4l2:/dev/video0", pattern=CAMERA)  # where pictures come from
    autopilot: str = Field("serial:/dev/ttyAMA0:921600", pattern=AUTOPILOT)  # the link to the autopilot
    radio: str = Field(pattern=RADIO)  # where the others reach its relay
    # in place of those that follow from the above: camera, frames, detector, tracker, autopilot, radio, clock
    drivers: dict[str, DriverSpec] = {}


class BoatSettings(Section):
    """The boat, roster member 0."""

    radio: str = Field("", pattern=RADIO_OR_NONE)  # where the drones reach it; empty: there is none
    lost_return_s: float = Field(
        0.0, ge=0, le=3600
    )  # silent for so long, it is lost and all go home; 0: never
    drivers: dict[str, DriverSpec] = {}  # its clock, where that is not the machine's


class DroneEntry(Section):
    """One drone of the roster; a file that names none has three, 10 m apart."""

    id: int = Field(ge=1, le=99)  # its place in the ring, and its autopilot's system id
    # where it stands before take-off, north of the origin; 3 m or more from the others
    home_n_m: float = Field(0.0, ge=-1000, le=1000)
    home_e_m: float = Field(0.0, ge=-1000, le=1000)  # east of the origin; below 0: west
    machine: MachineSettings | None = None


class Mission(Section):
    """A mission file: everything that every drone of a fleet is told."""

    name: str = "mission"  # what people read on screens and in reports
    origin: OriginSettings = OriginSettings()
    drones: tuple[DroneEntry, ...] = tuple(DroneEntry(id=i, home_e_m=10.0 * (i - 1)) for i in (1, 2, 3))
    camera: CameraSettings = CameraSettings()
    detector: DetectorSettings = DetectorSettings()
    search: SearchSettings = SearchSettings()
    watch: WatchSettings = WatchSettings()
    assign: AssignSettings = AssignSettings()
    limits: LimitSettings = LimitSettings()
    radio: RadioSettings = RadioSettings()
    log: LogSettings = LogSettings()
    boat: BoatSettings = BoatSettings()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        ids = [drone.id for drone in self.drones]
        if len(ids) > MAX_DRONES:
            raise ValueError(f"drones: {len(ids)} entries; a fleet holds at most {MAX_DRONES}")
        if not ids:
            raise ValueError("drones: at least one [[drones]] entry is needed")
        for drone_id in ids:
            if ids.count(drone_id) > 1:
                raise ValueError(
                    f"drones: id {drone_id} is given to {ids.count(drone_id)} drones; each needs its own"
                )
        for name, height_m in (
            ("search.height_m", self.search.height_m),
            ("watch.height_m", self.watch.height_m),
        ):
            if not self.limits.min_height_m <= height_m <= self.limits.max_height_m:
                low, high = self.limits.min_height_m, self.limits.max_height_m
                raise ValueError(
                    f"{name} = {height_m} lies outside limits.min_height_m to max_height_m, {low} to {high}"
                )
        return self

    @model_validator(mode="after")
    def _homes_and_search_fit(self) -> Self:
        for one, other in combinations(self.drones, 2):
            apart_m = hypot(one.home_n_m - other.home_n_m, one.home_e_m - other.home_e_m)
            if apart_m < LEAST_HOME_SPACING_M:
                raise ValueError(
                    f"drones: the homes of drones {one.id} and {other.id} are {apart_m:g} m apart; give each "
                    f"its own home_n_m and home_e_m, at least {LEAST_HOME_SPACING_M:g} m from the others"
                )
        reach_m = self.limits.fence_radius_m - FENCE_KEPT_M
        search = self.search
        far_m = hypot(search.north_m, search.east_m) + search.radius_m
        if far_m > reach_m:
            raise ValueError(
                f"search: its spiral goes {far_m:g} m from the origin, and limits.fence_radius_m = "
                f"{self.limits.fence_radius_m:g} lets drones go {reach_m:g} m; lessen search.radius_m, or "
                "widen the fence"
            )
        for drone in self.drones:
            if hypot(drone.home_n_m, drone.home_e_m) > reach_m:
                raise ValueError(
                    f"drones: the home of drone {drone.id} lies outside limits.fence_radius_m = "
                    f"{self.limits.fence_radius_m:g}; bring it nearer, or widen the fence"
                )
        return self

    @property
    def roster(self) -> tuple[int, ...]:
        """Drone ids in ring order."""
        return tuple(sorted(drone.id for drone in self.drones))

    def home(self, drone_id: int) -> DroneEntry:
        """The roster's entry of one drone; KeyError where it has none."""
        for drone in self.drones:
            if drone.id == drone_id:
                return drone
        raise KeyError(f"drone {drone_id} is not in the roster {self.roster}")


class DroneSettings(Section):
    """All that one drone's processes are told; `podwatch sim` and `podwatch fly` write it as JSON."""

    drone_id: int = Field(ge=1, le=99)
    mission: Mission
    seed: int = 0
    bus_url: str = ""
    run_dir: str = "."
    log_path: str = ""
    drivers: dict[str, DriverSpec] = {}  # clock, camera, frames, detector, tracker, autopilot, radio

    @classmethod
    def read(cls, path: Path) -> DroneSettings:
        """From a JSON file; MissionError says what is wrong with it."""
        try:
            settings = cls.model_validate(json.loads(path.read_text()))
        except (OSError, ValueError) as error:
            raise MissionError(f"{path}: {error}") from error
        if settings.drone_id not in settings.mission.roster:
            roster = list(settings.mission.roster)
            raise MissionError(
                f"{path}: drone {settings.drone_id} is not in the roster {roster}; add its [[drones]] entry"
            )
        return settings


S = TypeVar("S", bound=Mission)


def load_mission(path: Path, model: type[S]) -> S:
    """Read and validate a TOML mission file as `model` (Mission or a subclass).

    Raises MissionError: unreadable file, TOML syntax, unknown key (with the nearest valid one), value out of
    range.
    """
    try:
        data = tomllib.loads(path.read_text())
    except OSError as error:
        raise MissionError(
            f"{path}: cannot be read ({error.strerror}); give the path of a mission file"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise MissionError(f"{path}: not valid TOML: {error}") from error
    return validate(data, model, str(path))


def beside(path: Path, mission: S) -> S:
    """`mission` with the place of its model made absolute: from the folder of its file `path`."""
    if not mission.detector.model:
        return mission
    model = str(path.resolve().parent / mission.detector.model)
    return mission.model_copy(update={"detector": mission.detector.model_copy(update={"model": model})})


def validate(data: dict[str, Any], model: type[S], source: str) -> S:
    """`data` as `model`, or MissionError naming each wrong key of `source` with its value and the remedy."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise MissionError(
            f"{source}: " + "; ".join(_explain(item, model, data) for item in error.errors())
        ) from None


def _explain(item: Any, model: type[BaseModel], data: dict[str, Any]) -> str:
    owner, keys = _place(item["loc"], data)
    where = ".".join(str(key) for key in keys)
    if item["type"] == "extra_forbidden":
        valid = _valid_keys(model, item["loc"][:-1])
        near = difflib.get_close_matches(str(item["loc"][-1]), valid, n=1, cutoff=0.0)
        return (
            f"{owner}unknown key {where!r}"
            + (f"; did you mean {near[0]!r}?" if near else "")
            + f" Valid: {', '.join(valid)}"
        )
    message = item["msg"].removeprefix("Value error, ")
    if item["type"] == "string_pattern_mismatch" and item["ctx"]["pattern"] in IN_WORDS:
        message = f"write {IN_WORDS[item['ctx']['pattern']]}"
    value = item.get("input")
    shown = "" if isinstance(value, dict | BaseModel) else f" (given: {value!r})"
    return owner + (f"{where}: {message}{shown}" if where else message)


def _place(path: tuple[Any, ...], data: dict[str, Any]) -> tuple[str, tuple[Any, ...]]:
    """(whose the key at `path` is, the key from there): a drone goes by its id, which people know."""
    if len(path) < 2 or not isinstance(path[1], int):
        return "", path
    entry = data[path[0]][path[1]]
    if path[0] == "drones" and isinstance(entry, dict) and "id" in entry:
        return f"drone {entry['id']}: ", path[2:]
    return f"[[{path[0]}]] entry {path[1] + 1}: ", path[2:]


def _valid_keys(model: type[BaseModel], path: tuple[Any, ...]) -> list[str]:
    """Keys that the table at `path` of the model takes."""
    for part in path:
        if part not in model.model_fields:  # a place in a list, or a name that the file chose
            continue
        annotation = model.model_fields[part].annotation
        inner = [a for a in (annotation, *getattr(annotation, "__args__", ())) if isinstance(a, type)]
        model = next(a for a in inner if issubclass(a, BaseModel))
    return sorted(model.model_fields)
