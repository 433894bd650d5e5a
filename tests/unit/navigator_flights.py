"""A tiny fleet in virtual time for the navigator's tests: point masses, a pod, and stand-ins for the other
processes.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from lcmtypes import make, podwatch
from procs.assigner.costs import cost_codes, solve_table
from procs.navigator.mission import Inputs, Navigator
from procs.navigator.states import State
from procs.settings import Mission

Array = NDArray[np.float64]
SETPOINT = podwatch.setpoint_t
STEP_S = 0.1
EPISODE_S = 3.0


def mission(n: int, **tables: dict[str, Any]) -> Mission:
    """A mission of n drones; `tables` are changes to its sections."""
    drones = tuple({"id": k, "home_e_m": 6.0 * (k - 1)} for k in range(1, n + 1))
    return Mission.model_validate({"drones": drones, "watch": {"watch_s": 20.0}} | tables)


@dataclass
class Drone:
    """One drone: a point mass that obeys setpoints, and its navigator."""

    navigator: Navigator
    ned: Array
    yaw_rad: float
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    armed: bool = False
    landed: bool = True
    guided: bool = True
    position_ok: bool = True
    battery: float = 0.9
    alive: bool = True
    heard_us: int = 0  # when it was last heard
    said: podwatch.mission_state_t | None = None
    setpoint: podwatch.setpoint_t | None = None
    animal: int = -1
    assigned: podwatch.assignment_t | None = None
    states: list[State] = field(default_factory=list)

    @property
    def id(self) -> int:
        return self.navigator.drone_id

    @property
    def pose(self) -> Pose:
        return Pose(self.ned[0], self.ned[1], self.ned[2], yaw_rad=self.yaw_rad)

    def fly(self) -> None:
        """A tenth of a second on: what an autopilot makes of the setpoint."""
        kind = SETPOINT.IDLE if self.setpoint is None else self.setpoint.kind
        wanted = np.zeros(3)
        if kind == SETPOINT.TAKEOFF and self.setpoint is not None:
            self.armed, self.landed = True, False
            wanted[2] = np.clip(self.setpoint.d_m - self.ned[2], -2.5, 1.0)
        elif kind == SETPOINT.VELOCITY and self.setpoint is not None and self.armed:
            wanted = np.array([self.setpoint.vn_m_s, self.setpoint.ve_m_s, self.setpoint.vd_m_s])
        elif kind == SETPOINT.LAND and self.armed:
            wanted[2] = 1.5
        change = wanted - self.velocity
        size = float(np.linalg.norm(change))
        self.velocity = self.velocity + change * min(1.0, 4.0 * STEP_S / size if size > 0 else 1.0)
        self.ned = self.ned + self.velocity * STEP_S
        if self.ned[2] >= 0 and kind == SETPOINT.LAND:
            self.ned[2], self.velocity, self.armed, self.landed = 0.0, np.zeros(3), False, True


class Fleet:
    """Drones, a pod, a fleet table that is a moment old, and an honest registrar and assigner without a
    radio.
    """

    def __init__(
        self, settings: Mission, animals_ne: Array, drift_ne: Array | None = None, seed: int = 0
    ) -> None:
        self.mission = settings
        self.random = np.random.default_rng(seed)
        self.camera = Pinhole(
            (settings.camera.width_px, settings.camera.height_px), np.radians(settings.camera.vfov_deg)
        )
        self.utime = 1_000_000
        self.animals = np.array(animals_ne, dtype=np.float64)
        self.drift = np.zeros(2) if drift_ne is None else drift_ne
        self.visible = True
        self.agrees = True  # what the stand-in registrar answers
        self.command = 0
        self.left: tuple[int, ...] = ()
        self.boat_age_ms = -1
        self.drones = [self._drone(entry) for entry in settings.drones]
        self.rows: list[podwatch.fleet_row_t] = []
        self.rows_utime = 0
        self.episode = 0
        self.episode_from_us = 0
        self.consensus = False
        self.closest_m = np.inf
        self.tick = 0

    def _drone(self, entry: Any) -> Drone:
        navigator = Navigator(self.mission, entry.id)
        ned = np.array([entry.home_n_m, entry.home_e_m, 0.0])
        return Drone(navigator, ned, yaw_rad=float(self.random.uniform(-np.pi, np.pi)))

    def drone(self, drone_id: int) -> Drone:
        return next(drone for drone in self.drones if drone.id == drone_id)

    def restart(self, drone_id: int) -> None:
        """The navigator dies and is started again."""
        self.drone(drone_id).navigator = Navigator(self.mission, drone_id)

    def run(self, limit_s: float, until: Any = None) -> float:
        """Fly on until `until()` or for `limit_s`; seconds that it took."""
        start_us = self.utime
        while (self.utime - start_us) * 1e-6 < limit_s and not (until is not None and until()):
            self._step()
        return (self.utime - start_us) * 1e-6

    def all_in(self, *states: State) -> bool:
        return all(drone.navigator.state in states for drone in self.drones if drone.alive)

    def _step(self) -> None:
        self.utime += round(STEP_S * 1e6)
        self.tick += 1
        self.animals = self.animals + self.drift * STEP_S
        self._registrar()
        if self.tick % 3 == 0:
            self._share()
        for drone in self.drones:
            if not drone.alive:
                continue
            outputs = drone.navigator.update(self._inputs(drone))
            drone.setpoint = outputs.setpoint
            if outputs.mission is not None:
                drone.said = outputs.mission
            if not drone.states or drone.states[-1] != drone.navigator.state:
                drone.states.append(drone.navigator.state)
            drone.fly()
        flying = [drone.ned for drone in self.drones if drone.alive and drone.ned[2] < -3]
        for k, one in enumerate(flying):
            for other in flying[k + 1 :]:
                self.closest_m = min(self.closest_m, float(np.linalg.norm(one - other)))

    def _share(self) -> None:
        """The table of a moment ago: what each drone says, at the place where it was."""
        self.rows, self.rows_utime = (
            [self._row(drone) for drone in self.drones if drone.said is not None],
            self.utime,
        )

    def _row(self, drone: Drone) -> podwatch.fleet_row_t:
        said = drone.said
        assert said is not None
        drone.heard_us = self.utime if drone.alive else drone.heard_us
        shared = ("state", "animal", "found", "found_n_m", "found_e_m", "pod_radius_m", "waypoint")
        flags = {name: getattr(said, name) for name in (*shared, "on_station", "wants_episode")}
        return make(
            podwatch.fleet_row_t,
            id=drone.id,
            alive=drone.alive,
            age_ms=200 + (self.utime - drone.heard_us) // 1000,
            battery=drone.battery,
            n_m=drone.ned[0] - 0.2 * drone.velocity[0],
            e_m=drone.ned[1] - 0.2 * drone.velocity[1],
            d_m=drone.ned[2] - 0.2 * drone.velocity[2],
            vn_m_s=drone.velocity[0],
            ve_m_s=drone.velocity[1],
            vd_m_s=drone.velocity[2],
            **flags,
        )

    def _registrar(self) -> None:
        asked = any(d.alive and d.said is not None and d.said.wants_episode for d in self.drones)
        if self.episode_from_us == 0 and asked:
            self.episode_from_us = self.utime
        elif self.episode_from_us and (self.utime - self.episode_from_us) * 1e-6 > EPISODE_S:
            self.episode_from_us = 0
            self.episode += 1
            self.consensus = self.agrees and self.visible
            if self.consensus:
                self._assign()

    def _assign(self) -> None:
        members = [d for d in self.drones if d.alive and not d.landed]
        costs = np.array([np.linalg.norm(self.animals - d.ned[:2], axis=1) for d in members])
        choice = solve_table(cost_codes(costs))
        for k, drone in enumerate(members):
            drone.assigned = make(
                podwatch.assignment_t,
                episode=self.episode,
                proposer=1,
                animal=int(choice[k]),
                certified=True,
                surplus=bool(choice[k] < 0),
            )

    def _inputs(self, drone: Drone) -> Inputs:
        if drone.assigned is not None:
            drone.assigned.utime = self.utime
        fleet = None
        if self.rows_utime:
            fleet = make(podwatch.fleet_state_t, utime=self.rows_utime, n_rows=len(self.rows), rows=self.rows)
            fleet.order = make(podwatch.operator_t, utime=self.utime, command=self.command)
            fleet.n_left, fleet.left = len(self.left), self.left
            fleet.boat_age_ms = self.boat_age_ms
        return Inputs(
            self.utime,
            self._vehicle(drone),
            self._detections(drone) if self.tick % 2 == 0 else None,
            self._identities(),
            drone.assigned,
            self._track(drone),
            fleet,
        )

    def _vehicle(self, drone: Drone) -> podwatch.vehicle_state_t:
        n_m, e_m, d_m = drone.ned
        vn_m_s, ve_m_s, vd_m_s = drone.velocity
        return make(
            podwatch.vehicle_state_t,
            utime=self.utime,
            n_m=n_m,
            e_m=e_m,
            d_m=d_m,
            vn_m_s=vn_m_s,
            ve_m_s=ve_m_s,
            vd_m_s=vd_m_s,
            yaw_rad=drone.yaw_rad,
            battery=drone.battery,
            position_ok=drone.position_ok,
            armed=drone.armed,
            landed=drone.landed,
            guided=drone.guided,
            link_age_ms=100,
        )

    def pixels(self, drone: Drone) -> tuple[Array, NDArray[np.bool_]]:
        """(N, 2) where the animals stand in the drone's image, (N,) whether they are inside and to be
        seen.
        """
        if drone.ned[2] > -2 or not self.visible:
            return np.zeros((len(self.animals), 2)), np.zeros(len(self.animals), dtype=bool)
        points = apply_homography(self.camera.ground_to_image(drone.pose), self.animals)
        return points, np.asarray(((points > 0) & (points < self.camera.image_size)).all(axis=1))

    def _detections(self, drone: Drone) -> podwatch.detections_t:
        points, inside = self.pixels(drone)
        boxes = [
            make(podwatch.box_t, left_px=u - 10, right_px=u + 10, top_px=v - 10, bottom_px=v + 10, score=0.9)
            for u, v in points[inside]
        ]
        return make(podwatch.detections_t, utime=self.utime, n_boxes=len(boxes), boxes=boxes)

    def _identities(self) -> podwatch.identities_t:
        entries = [
            make(podwatch.map_animal_t, id=k, n_m=n_m, e_m=e_m, age_ms=0 if self.visible else 5000)
            for k, (n_m, e_m) in enumerate(self.animals)
        ]
        return make(
            podwatch.identities_t,
            utime=self.utime,
            episode=self.episode,
            episode_proposer=1 if self.episode else 0,
            episode_running=self.episode_from_us > 0,
            consensus=self.consensus,
            n_map=len(entries) if self.episode else 0,
            map=entries if self.episode else [],
        )

    def _track(self, drone: Drone) -> podwatch.track_t | None:
        if drone.assigned is None or drone.assigned.animal < 0:
            return None
        animal = drone.assigned.animal
        points, inside = self.pixels(drone)
        state = podwatch.track_t.TRACKING if inside[animal] else podwatch.track_t.LOST
        u_px, v_px = points[animal]
        return make(podwatch.track_t, utime=self.utime, animal=animal, state=state, u_px=u_px, v_px=v_px)
