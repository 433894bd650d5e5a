"""A fleet that never flew: truth and logs of drones over animals, made by hand for the judge, the summary and
the report.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from lcmtypes import channels, make, podwatch
from logs.writer import LogWriter
from procs.navigator.states import Event, State
from tools.evidence import Clock, DroneLog, Truth, drone_log

CAMERA = Pinhole((640, 480), float(np.radians(60)))
WATCH_HEIGHT_M = 30.0
LENGTH_M = 10.0
BEFORE_MONITOR = (  # share of the time before MONITOR, state
    (0.0, State.TAKEOFF),
    (0.1, State.SCOUT),
    (0.6, State.RENDEZVOUS),
    (0.85, State.REGISTER),
    (0.95, State.ASSIGN),
)

Array = NDArray[np.float64]


@dataclass
class FakeRun:
    """Drones 1..n over animals 1..m that swim slow circles; drone i watches animal i under the name i + 10.

    watch(drone, t_s) and name(drone, animal, t_s) change who is watched and how animals are called;
    `aim_off_m(drone, t_s)` shifts what the tracker believes; `claims` are the drones whose newest episode
    claims consensus (None for all).
    """

    n_drones: int = 3
    n_animals: int = 5
    duration_s: float = 40.0
    monitor_s: tuple[float, float] = (10.0, 35.0)
    track_hz: float = 5.0
    truth_hz: float = 10.0
    watch: Callable[[int, float], int] = lambda drone, t_s: drone
    name: Callable[[int, int, float], int] = lambda drone, animal, t_s: animal + 10
    aim_off_m: Callable[[int, float], float] = lambda drone, t_s: 0.0
    dive: Callable[[int, float], float] = lambda animal, t_s: 0.0
    claims: tuple[int, ...] | None = None
    standby: tuple[int, ...] = ()
    deaths: dict[int, float] = field(default_factory=dict)
    called: dict[int, tuple[float, Event]] = field(default_factory=dict)  # home or down, by a person
    clocks: dict[int, Clock] = field(default_factory=dict)
    is_labelled: bool = True
    seed: int = 0
    picture: Callable[[int, float, Pose], NDArray[np.uint8]] | None = (
        None  # what a camera sees, (480, 640, 3)
    )

    @property
    def drone_ids(self) -> range:
        return range(1, self.n_drones + 1)

    @property
    def animal_ids(self) -> range:
        return range(1, self.n_animals + 1)

    def clock(self, drone: int) -> Clock:
        return self.clocks.get(drone, Clock(offset_us=3e6))

    def animal(self, animal: int, t_s: float) -> tuple[float, float, float]:
        """(n, e, heading) of an animal: 15 m apart round the pod's middle, each on a circle of 3 m."""
        place = 2 * np.pi * animal / max(self.n_animals, 1)
        reach = 0.0 if self.n_animals < 2 else 7.5 / np.sin(np.pi / self.n_animals)
        turn = 0.1 * t_s + animal
        return (
            100 + reach * np.cos(place) + 3 * np.sin(turn),
            reach * np.sin(place) + 3 * np.cos(turn),
            float(np.arctan2(-np.sin(turn), np.cos(turn))),
        )

    def state(self, drone: int, t_s: float) -> State:
        if t_s >= self.called_s(drone):
            return State.RETURN
        if drone in self.standby and t_s >= self.monitor_s[0]:
            return State.STANDBY if t_s < self.monitor_s[1] else State.RETURN
        if t_s >= self.monitor_s[0]:
            landing_s = (self.monitor_s[1] + self.duration_s) / 2
            return (
                State.MONITOR
                if t_s < self.monitor_s[1]
                else State.RETURN
                if t_s < landing_s
                else State.LANDED
            )
        state = max(entry for entry in BEFORE_MONITOR if entry[0] <= t_s / self.monitor_s[0])[1]
        return State.STANDBY if state == State.SCOUT and drone > 1 else state

    def called_s(self, drone: int) -> float:
        return self.called[drone][0] if drone in self.called else np.inf

    def pose(self, drone: int, t_s: float) -> Pose:
        """On its way to its animal from home, over it with a little sway in MONITOR, then home again."""
        t_s = min(t_s, self.deaths.get(drone, np.inf))
        home = np.array([0.0, 6.0 * (drone - 1), -0.1])
        over_n, over_e, _ = self.animal(self.watch(drone, t_s), t_s)
        over = np.array([over_n + np.sin(t_s), over_e + np.cos(0.7 * t_s), -WATCH_HEIGHT_M])
        out = np.clip(t_s / (0.8 * self.monitor_s[0]), 0, 1)
        back = np.clip((t_s - self.monitor_s[1]) / (0.4 * (self.duration_s - self.monitor_s[1])), 0, 1)
        n_m, e_m, d_m = home + (over - home) * min(out, 1 - back)
        sway = 0.03 * np.sin(1.3 * t_s + drone)
        return Pose(n_m, e_m, min(d_m, -0.1), sway, -sway, 0.8 * drone + 0.05 * t_s)

    def truth(self) -> Truth:
        t_s = np.arange(0, self.duration_s, 1 / self.truth_hz)
        return Truth(
            CAMERA,
            t_s,
            {d: np.array([_row(self.pose(d, t)) for t in t_s]) for d in self.drone_ids},
            {
                a: np.array([(*self.animal(a, t)[:2], LENGTH_M, self.dive(a, t)) for t in t_s])
                for a in self.animal_ids
            },
            self.deaths,
            self.is_labelled,
        )

    def pixel(self, drone: int, t_s: float, n_m: float, e_m: float) -> tuple[float, float]:
        u_px, v_px = apply_homography(CAMERA.ground_to_image(self.pose(drone, t_s)), np.array([[n_m, e_m]]))[
            0
        ]
        return float(u_px), float(v_px)

    def box(
        self, drone: int, animal: int, t_s: float, to_image: Array | None = None
    ) -> podwatch.box_t | None:
        """The box round an animal's body in a drone's image, None where its middle is not in it."""
        n_m, e_m, heading = self.animal(animal, t_s)
        along = LENGTH_M / 2 * np.array([np.cos(heading), np.sin(heading)])
        across = LENGTH_M / 9 * np.array([-np.sin(heading), np.cos(heading)])
        outline = np.array([n_m, e_m]) + np.array(
            [along + across, along - across, -along + across, -along - across]
        )
        if to_image is None:
            to_image = CAMERA.ground_to_image(self.pose(drone, t_s))
        points = apply_homography(to_image, outline)
        u_px, v_px = points.mean(axis=0)
        if not (0 <= u_px <= 640 and 0 <= v_px <= 480):
            return None
        left, top = np.maximum(points.min(axis=0), 0)
        right, bottom = np.minimum(points.max(axis=0), (640, 480))
        return make(
            podwatch.box_t, left_px=left, top_px=top, right_px=right, bottom_px=bottom, score=0.9, class_id=0
        )

    def messages(self, drone: int, names: tuple[str, ...]) -> Iterator[tuple[str, float, Any]]:
        """(channel, simulation time, message) of one drone's log for those channels, each channel in order of
        time.
        """
        makers = {
            channels.MISSION_STATE: (5.0, self._mission_state),
            channels.TRACK: (self.track_hz, self._track),
            channels.IDENTITIES: (2.5, self._identities),
            channels.ASSIGNMENT: (2.0, self._assignment),
            channels.SETPOINT: (5.0, self._setpoint),
            channels.VEHICLE_STATE: (5.0, self._vehicle_state),
            channels.LINK_STATE: (1.0, self._link_state),
            channels.PREVIEW: (1.0, self._preview),
        }
        end_s = min(self.duration_s, self.deaths.get(drone, np.inf))
        for channel in names:
            rate_hz, maker = makers[channel]
            for seq, t_s in enumerate(np.arange(0.1, end_s, 1 / rate_hz)):
                message = maker(drone, float(t_s))
                if message is not None:
                    message.utime, message.seq, message.drone_id = self.utime(drone, float(t_s)), seq, drone
                    yield channel, float(t_s), message

    def utime(self, drone: int, t_s: float) -> int:
        clock = self.clock(drone)
        return round(clock.offset_us + t_s * 1e6 * (1 + clock.drift_ppm * 1e-6))

    def log(self, drone: int) -> DroneLog:
        """The drone's log as the judge gets it, without a file."""
        names = (channels.MISSION_STATE, channels.TRACK, channels.IDENTITIES, channels.ASSIGNMENT)
        samples: dict[str, list[tuple[float, Any]]] = {name: [] for name in names}
        for channel, t_s, message in self.messages(drone, names):
            samples[channel].append((t_s, message))
        return drone_log(drone, samples, CAMERA)

    def logs(self) -> list[DroneLog]:
        return [self.log(drone) for drone in self.drone_ids]

    def write(self, folder: Path) -> Path:
        """The run's folder as the simulator leaves it."""
        folder.mkdir(parents=True, exist_ok=True)
        for drone in self.drone_ids:
            writer = LogWriter(folder / f"drone_{drone}.mcap", drone_id=drone)
            names = tuple(name for name in channels.BY_NAME if name in LOGGED)
            for channel, _, message in sorted(self.messages(drone, names), key=lambda entry: entry[1]):
                writer.write(channel, message.encode(), message.utime)
            writer.close()
        self._write_truth(folder)
        return folder

    def _write_truth(self, folder: Path) -> None:
        writer = LogWriter(folder / "truth.mcap", drone_id=0)
        for seq, t_s in enumerate(np.arange(0, self.duration_s, 1 / self.truth_hz)):
            writer.write(channels.WORLD_STATE, self._world(seq, float(t_s)).encode(), round(t_s * 1e6))
        writer.close()
        about = {
            "seed": self.seed,
            "clocks": {str(d): vars(self.clock(d)) for d in self.drone_ids},
            "camera": {"width_px": 640, "height_px": 480, "vfov_deg": 60.0},
            "mode": "lockstep",
            "fallback_reason": None,
            "sensor": "pixels",
            "scene": "sea",
            "realtime_factor": 1.9,
            "wall_s": self.duration_s / 1.9,
            "deaths": {str(d): at_s for d, at_s in self.deaths.items()},
            "scene_truth": self.is_labelled,
        }
        (folder / "truth.json").write_text(json.dumps(about))
        (folder / "mission.json").write_text(json.dumps({"name": "made by hand"}))

    def _world(self, seq: int, t_s: float) -> podwatch.world_state_t:
        drones = []
        for drone in self.drone_ids:
            pose = self.pose(drone, t_s)
            alive = t_s < self.deaths.get(drone, np.inf)
            drones.append(make(podwatch.world_drone_t, id=drone, alive=alive, **vars(pose)))
        animals = []
        for animal in self.animal_ids:
            n_m, e_m, heading_rad = self.animal(animal, t_s)
            animals.append(
                make(
                    podwatch.world_animal_t,
                    id=animal,
                    n_m=n_m,
                    e_m=e_m,
                    heading_rad=heading_rad,
                    length_m=LENGTH_M,
                    depth_m=self.dive(animal, t_s),
                    species="sperm",
                )
            )
        return make(
            podwatch.world_state_t,
            utime=round(t_s * 1e6),
            seq=seq,
            n_drones=len(drones),
            drones=drones,
            n_animals=len(animals),
            animals=animals,
        )

    def _identity(self, drone: int, t_s: float) -> int:
        if self.state(drone, t_s) != State.MONITOR:
            return -1
        return self.name(drone, self.watch(drone, t_s), t_s)

    def _mission_state(self, drone: int, t_s: float) -> podwatch.mission_state_t:
        return make(
            podwatch.mission_state_t,
            state=int(self.state(drone, t_s)),
            reason=self.called[drone][1].value if t_s >= self.called_s(drone) else "by hand",
            animal=self._identity(drone, t_s),
        )

    def _track(self, drone: int, t_s: float) -> podwatch.track_t | None:
        if self.state(drone, t_s) != State.MONITOR:
            return make(podwatch.track_t, state=podwatch.track_t.IDLE, animal=-1, width=640, height=480)
        n_m, e_m, _ = self.animal(self.watch(drone, t_s), t_s)
        u_px, v_px = self.pixel(drone, t_s, n_m + self.aim_off_m(drone, t_s), e_m)
        return make(
            podwatch.track_t,
            state=podwatch.track_t.TRACKING,
            animal=self._identity(drone, t_s),
            u_px=u_px,
            v_px=v_px,
            left_px=u_px - 60,
            top_px=v_px - 30,
            right_px=u_px + 60,
            bottom_px=v_px + 30,
            score=0.8,
            width=640,
            height=480,
        )

    def _identities(self, drone: int, t_s: float) -> podwatch.identities_t:
        agreed = t_s >= self.monitor_s[0] - 0.5
        boxes, ids = [], []
        pose = self.pose(drone, t_s)
        to_image = CAMERA.ground_to_image(pose)
        for animal in self.animal_ids:
            box = self.box(drone, animal, t_s, to_image)
            if box is not None and self.dive(animal, t_s) < 2 and pose.height_m > 5:
                boxes.append(box)
                ids.append(self.name(drone, animal, t_s) if agreed else -1)
        return make(
            podwatch.identities_t,
            episode=1 if agreed else 0,
            episode_proposer=1 if agreed else 0,
            episode_complete=agreed,
            consensus=agreed and (self.claims is None or drone in self.claims),
            confidence=0.97,
            width=640,
            height=480,
            n_boxes=len(boxes),
            boxes=boxes,
            ids=ids,
        )

    def _assignment(self, drone: int, t_s: float) -> podwatch.assignment_t | None:
        if t_s < self.monitor_s[0] - 0.5:
            return None
        surplus = drone in self.standby
        animal = -1 if surplus else self.name(drone, self.watch(drone, t_s), t_s)
        return make(
            podwatch.assignment_t, episode=1, proposer=1, animal=animal, certified=True, surplus=surplus
        )

    def _setpoint(self, drone: int, t_s: float) -> podwatch.setpoint_t:
        cause = self.utime(drone, t_s - 0.06) if self.state(drone, t_s) == State.MONITOR else 0
        return make(podwatch.setpoint_t, cause_utime=cause, expiry_utime=self.utime(drone, t_s + 0.5))

    def _vehicle_state(self, drone: int, t_s: float) -> podwatch.vehicle_state_t:
        pose = self.pose(drone, t_s)
        return make(
            podwatch.vehicle_state_t,
            n_m=pose.n_m,
            e_m=pose.e_m,
            d_m=pose.d_m,
            yaw_rad=pose.yaw_rad,
            battery=1 - t_s / 600,
            setpoint_utime=self.utime(drone, t_s - 0.02),
            setpoint_age_us=20_000,
        )

    def _link_state(self, drone: int, t_s: float) -> podwatch.link_state_t:
        peers = sorted({(drone - 2) % self.n_drones + 1, drone % self.n_drones + 1} - {drone})
        links = [
            make(
                podwatch.link_t,
                peer_id=peer,
                up=True,
                n_kinds=2,
                kinds=["RING_MAP", "link"],
                bytes_out=[240, 80],
                max_payload=[180, 60],
                max_encoded=[230, 0],
                max_datagram=[290, 110],
                round_trip_us=4000,
                loss=0.01,
            )
            for peer in peers
        ]
        return make(podwatch.link_state_t, n_links=len(links), links=links)

    def _preview(self, drone: int, t_s: float) -> podwatch.preview_t:
        if self.picture is not None:
            image = self.picture(drone, t_s, self.pose(drone, t_s))
        else:
            image = np.full((480, 640, 3), (128, 82, 22), np.uint8)
            for animal in self.animal_ids:
                box = self.box(drone, animal, t_s)
                if box is not None and self.pose(drone, t_s).height_m > 5:
                    corners = [
                        (round(box.left_px), round(box.top_px)),
                        (round(box.right_px), round(box.bottom_px)),
                    ]
                    cv2.rectangle(image, *corners, (60, 60, 60), -1)
        done, data = cv2.imencode(".jpg", cv2.resize(image, (320, 240)), [cv2.IMWRITE_JPEG_QUALITY, 70])
        assert done
        return make(
            podwatch.preview_t,
            width=320,
            height=240,
            scale=0.5,
            format="jpeg",
            n_bytes=len(data),
            data=data.tobytes(),
        )


LOGGED = (
    channels.MISSION_STATE,
    channels.TRACK,
    channels.IDENTITIES,
    channels.ASSIGNMENT,
    channels.SETPOINT,
    channels.VEHICLE_STATE,
    channels.LINK_STATE,
    channels.PREVIEW,
)


def _row(pose: Pose) -> tuple[float, ...]:
    return pose.n_m, pose.e_m, pose.d_m, pose.roll_rad, pose.pitch_rad, pose.yaw_rad
