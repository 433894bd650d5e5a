"""What a run left behind, on one clock: the simulator's truth, and each drone's log in simulation time.

The judge needs no more than `Truth` and `DroneLog`; `load_run` makes them from a run's folder. Drones' clocks
are turned into simulation time by the offsets and drifts that the simulator drew, so that a sight can be
compared with the truth of its instant.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole
from lcmtypes import channels
from logs.boots import other_boots, pictures, segments
from logs.exceptions import LogError
from logs.reader import read
from procs.navigator.states import State

__all__ = [
    "Clock",
    "DroneLog",
    "EvidenceError",
    "Labels",
    "Run",
    "Truth",
    "drone_log",
    "load_run",
    "read_samples",
    "state_name",
]

Array = NDArray[np.float64]
Samples = dict[str, list[tuple[float, Any]]]

# All that judge, summary and report read of a drone's log.
READ_CHANNELS = (
    channels.MISSION_STATE,
    channels.ASSIGNMENT,
    channels.TRACK,
    channels.IDENTITIES,
    channels.SETPOINT,
    channels.VEHICLE_STATE,
    channels.LINK_STATE,
    channels.PREVIEW,
    channels.HEARTBEAT,
)


class EvidenceError(Exception):
    """A run's folder lacks what the judge needs; the message names the file and the remedy."""


@dataclass(frozen=True)
class Clock:
    """A drone's clock against the simulation's: utime = offset_us + simulated us * (1 + drift_ppm * 1e-6)."""

    offset_us: float = 0.0
    drift_ppm: float = 0.0

    def simulation_s(self, utime: float) -> float:
        """Seconds of simulation time at the drone's `utime` in us."""
        return (utime - self.offset_us) / (1 + self.drift_ppm * 1e-6) * 1e-6


@dataclass(frozen=True)
class Truth:
    """What really was, over (T,) instants `t_s` of simulation time.

    drones: id -> (T, 6) n, e, d in metres and roll, pitch, yaw in radians; animals: id -> (T, 4) n, e,
    length, depth in metres, NaN where the animal did not exist. deaths: id -> when that drone died.
    is_labelled: False where nobody knows where the animals are (a photograph without labels).
    """

    camera: Pinhole
    t_s: Array
    drones: dict[int, Array]
    animals: dict[int, Array]
    deaths: dict[int, float] = field(default_factory=dict)
    is_labelled: bool = True

    def drone_at(self, drone_id: int, t_s: Array) -> Array:
        """(N, 6) true pose of one drone at (N,) instants, angles interpolated the short way round."""
        rows = self.drones[drone_id].copy()
        rows[:, 3:] = np.unwrap(rows[:, 3:], axis=0)
        return np.stack([np.interp(t_s, self.t_s, column) for column in rows.T], axis=1)

    def animals_at(self, t_s: Array) -> Array:
        """(N, A, 4) all animals at (N,) instants, in the order of their ids."""
        if not self.animals:
            return np.empty((len(t_s), 0, 4))
        return np.stack(
            [
                np.stack([np.interp(t_s, self.t_s, column) for column in self.animals[animal_id].T], axis=1)
                for animal_id in self.animal_ids
            ],
            axis=1,
        )

    @property
    def animal_ids(self) -> tuple[int, ...]:
        return tuple(sorted(self.animals))


@dataclass(frozen=True)
class Labels:
    """One IDENTITIES message: the ids (K,) that a drone gave, and the centres (K, 2) px of the boxes that got
    one.
    """

    t_s: float
    episode: tuple[int, int]  # number and proposer of the newest finished one
    consensus: bool
    ids: NDArray[np.int64]
    centres_px: Array


@dataclass(frozen=True)
class DroneLog:
    """What one drone believed and did, in simulation time; centres in px of the truth's camera.

    states: (when said, state's name). assignments: (when said, identity or -1). tracks: (N,) instants of
    capture, (N, 2) centres, NaN where the tracker had none, and (N,) identities.
    """

    id: int
    states: tuple[tuple[float, str], ...]
    track_t_s: Array
    track_px: Array
    track_ids: NDArray[np.int64]
    labels: tuple[Labels, ...] = ()
    assignments: tuple[tuple[float, int], ...] = ()


@dataclass(frozen=True)
class Run:
    """A run's folder in memory: what the simulator wrote about itself, truth, and the messages that people
    ask about.
    """

    folder: Path
    about: dict[str, Any]  # truth.json
    mission: dict[str, Any]  # mission.json
    truth: Truth
    drones: tuple[DroneLog, ...]
    messages: dict[int, Samples]  # drone -> channel -> (simulation time of its utime, message)
    clocks: dict[int, Clock]
    problems: tuple[str, ...]  # what could not be read, in words


def load_run(folder: Path) -> Run:
    """Read truth.json, truth.mcap, mission.json and every drone's log segments.

    Raises EvidenceError where truth is missing or does not parse. A log that is missing or damaged is no
    error: what could be read stands, and `problems` names the rest.
    """
    about = _read_json(folder / "truth.json")
    mission = _read_json(folder / "mission.json")
    try:
        clocks = {
            int(drone_id): Clock(float(clock["offset_us"]), float(clock["drift_ppm"]))
            for drone_id, clock in about["clocks"].items()
        }
        camera = Pinhole(
            (int(about["camera"]["width_px"]), int(about["camera"]["height_px"])),
            float(np.radians(about["camera"]["vfov_deg"])),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise EvidenceError(
            f"{folder / 'truth.json'}: no usable {error}; it must give clocks and camera, fly again"
        ) from error
    truth, problems = _read_truth(folder / "truth.mcap", about, camera)
    logs, messages = [], {}
    for drone_id in sorted(clocks):
        log = folder / f"drone_{drone_id}.mcap"
        samples, complaints = read_samples([*segments(log), *pictures(log)], drone_id, clocks[drone_id])
        messages[drone_id] = samples
        problems += complaints
        problems += [
            f"drone {drone_id}: {', '.join(file.name for file in files)} is of another flight, on a clock "
            "of its own, and is left out"
            for files in other_boots(log)
        ]
        logs.append(drone_log(drone_id, samples, camera))
    return Run(folder, about, mission, truth, tuple(logs), messages, clocks, tuple(problems))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text())
    except OSError as error:
        raise EvidenceError(
            f"{path}: cannot be read ({error.strerror}); give the folder that `podwatch sim` wrote"
        ) from error
    except ValueError as error:
        raise EvidenceError(f"{path}: not valid JSON ({error}); fly again") from error
    if not isinstance(data, dict):
        raise EvidenceError(f"{path}: holds a {type(data).__name__}, expected an object; fly again")
    return data


def _read_truth(path: Path, about: dict[str, Any], camera: Pinhole) -> tuple[Truth, list[str]]:
    states, problems = _world_states(path)
    t_s = np.array([state.utime * 1e-6 for state in states])
    drones = _tracks(
        (
            (
                index,
                drone.id,
                (drone.n_m, drone.e_m, drone.d_m, drone.roll_rad, drone.pitch_rad, drone.yaw_rad),
            )
            for index, state in enumerate(states)
            for drone in state.drones
        ),
        (len(states), 6),
    )
    animals = _tracks(
        (
            (index, animal.id, (animal.n_m, animal.e_m, animal.length_m, animal.depth_m))
            for index, state in enumerate(states)
            for animal in state.animals
        ),
        (len(states), 4),
    )
    deaths = {int(drone_id): float(at_s) for drone_id, at_s in about.get("deaths", {}).items()}
    return Truth(camera, t_s, drones, animals, deaths, bool(about.get("scene_truth", True))), problems


def _world_states(path: Path) -> tuple[list[Any], list[str]]:
    """(every state of the world in truth.mcap, in order of time; what of it could not be read)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            messages = [message for _, _, message in read(path, channels=channels.WORLD_STATE)]
        except LogError as error:
            raise EvidenceError(
                f"the simulator's truth cannot be read, so nothing can be judged: {error}"
            ) from error
    states = [message for message in messages if not isinstance(message, bytes)]
    if not states:
        raise EvidenceError(f"{path}: holds no state of the world, so nothing can be judged; fly again")
    return sorted(states, key=lambda state: int(state.utime)), [
        f"truth: {warning.message}" for warning in caught
    ]


def _tracks(rows: Iterable[tuple[int, int, tuple[float, ...]]], shape: tuple[int, int]) -> dict[int, Array]:
    """(index of the instant, id, values) -> id -> (T, K), NaN where the thing did not exist."""
    tracks: dict[int, Array] = {}
    for index, thing_id, values in rows:
        tracks.setdefault(thing_id, np.full(shape, np.nan))[index] = values
    return dict(sorted(tracks.items()))


def read_samples(paths: Iterable[Path], drone_id: int, clock: Clock) -> tuple[Samples, list[str]]:
    """A drone's messages by channel, and what could not be read: a damaged log costs that drone the rest."""
    samples: Samples = {name: [] for name in READ_CHANNELS}
    problems: list[str] = []
    for path in paths:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                for channel, _, message in read(path, channels=READ_CHANNELS):
                    if not isinstance(message, bytes):
                        samples[channel].append((clock.simulation_s(message.utime), message))
            except LogError as error:
                problems.append(f"drone {drone_id}: {error}")
        problems += [f"drone {drone_id}: {warning.message}" for warning in caught]
    for rows in samples.values():
        rows.sort(key=lambda row: row[0])
    return samples, problems


def drone_log(drone_id: int, samples: Samples, camera: Pinhole) -> DroneLog:
    """What the judge needs of one drone's messages, `channel -> [(simulation time, message)]` in order."""
    tracks = samples[channels.TRACK]
    seen = [
        _scaled(message.u_px, message.v_px, message, camera) if _has_centre(message) else (np.nan, np.nan)
        for _, message in tracks
    ]
    return DroneLog(
        id=drone_id,
        states=tuple((t_s, state_name(message.state)) for t_s, message in samples[channels.MISSION_STATE]),
        track_t_s=np.array([t_s for t_s, _ in tracks], dtype=np.float64),
        track_px=np.array(seen, dtype=np.float64).reshape(-1, 2),
        track_ids=np.array([message.animal for _, message in tracks], dtype=np.int64),
        labels=tuple(_labels(t_s, message, camera) for t_s, message in samples[channels.IDENTITIES]),
        assignments=tuple((t_s, message.animal) for t_s, message in samples[channels.ASSIGNMENT]),
    )


def state_name(state: int) -> str:
    """The name of a MISSION_STATE's state, or its number where this version has no such state."""
    return State(state).name if state in State.__members__.values() else f"STATE_{state}"


def _has_centre(track: Any) -> bool:
    """A track that is idle or lost has no centre: nobody watches through it."""
    return bool(track.state in (track.TRACKING, track.PREDICTED) and track.width > 0 and track.height > 0)


def _labels(t_s: float, message: Any, camera: Pinhole) -> Labels:
    has_size = message.width > 0 and message.height > 0
    named = [(box, i) for box, i in zip(message.boxes, message.ids, strict=True) if i >= 0 and has_size]
    centres = [
        _scaled((box.left_px + box.right_px) / 2, (box.top_px + box.bottom_px) / 2, message, camera)
        for box, _ in named
    ]
    return Labels(
        t_s,
        (message.episode, message.episode_proposer),
        bool(message.consensus),
        np.array([i for _, i in named], dtype=np.int64),
        np.array(centres, dtype=np.float64).reshape(-1, 2),
    )


def _scaled(u_px: float, v_px: float, message: Any, camera: Pinhole) -> tuple[float, float]:
    """A point of the message's own frame size in px of the truth's camera."""
    return u_px * camera.image_size[0] / message.width, v_px * camera.image_size[1] / message.height
