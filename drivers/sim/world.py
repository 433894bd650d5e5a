"""The world: animals, vehicles with their simulated autopilots, faults and the true state of everything."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers.cameras.pinhole import Pose
from drivers.sim.autopilot import SimAutopilot
from drivers.sim.pod import Pod, PodSettings
from drivers.sim.routed_autopilot import RoutedAutopilot
from drivers.sim.vehicle import Vehicle, Wind
from lcmtypes import make
from lcmtypes.podwatch import world_animal_t, world_drone_t, world_state_t

__all__ = ["Autopilot", "AutopilotLink", "Body", "World", "WorldSettings"]

STEP_US = 20_000
GUST_SHARE = 0.2  # standard deviation of gusts, of the mean wind


class AutopilotLink(Protocol):
    """The autopilot's end of its link to the bridge."""

    def write(self, data: bytes) -> None: ...

    def receive(self) -> bytes: ...


class Autopilot(Protocol):
    """What flies a drone: bytes of MAVLink in and out."""

    def receive(self, data: bytes, t_s: float) -> None: ...

    def step(self, t_s: float) -> bytes: ...


class Body(Protocol):
    """What is seen of a drone from outside."""

    @property
    def pose(self) -> Pose: ...

    @property
    def velocity_ned(self) -> tuple[float, float, float]: ...


@dataclass(frozen=True)
class WorldSettings:
    """All that the world is made from."""

    seed: int
    homes: Mapping[int, tuple[float, float]]  # drone id -> (n, e) m
    origin: tuple[float, float, float]  # latitude and longitude in degrees, altitude in metres
    pod: PodSettings
    gps_noise_m: float
    compass_error_deg: float
    wind_m_s: float
    utc_us: int = 0  # since 1970 at the world's time 0; 0: its GPS tells no time


class World:
    """Steps everything that exists by simulation time; knows nothing of who looks at it."""

    def __init__(
        self,
        settings: WorldSettings,
        links: Mapping[int, AutopilotLink],
        routed: Mapping[int, RoutedAutopilot] | None = None,
    ) -> None:
        """`routed`: the drones that real autopilots fly; all others get simulated ones."""
        self.now_us = 0
        self._seq = 0
        self._links = dict(links)
        self.pod = Pod(settings.pod, np.random.default_rng([settings.seed, 1]))
        self.vehicles: dict[int, Body] = {}
        self.autopilots: dict[int, Autopilot] = {}
        self.dead: dict[int, float] = {}
        towards_rad = float(np.random.default_rng([settings.seed, 2]).uniform(-np.pi, np.pi))
        mean = (
            settings.wind_m_s * float(np.cos(towards_rad)),
            settings.wind_m_s * float(np.sin(towards_rad)),
        )
        for drone_id, home in settings.homes.items():
            if routed and drone_id in routed:
                self.vehicles[drone_id] = self.autopilots[drone_id] = routed[drone_id]
                continue
            random = np.random.default_rng([settings.seed, 3, drone_id])
            vehicle = Vehicle(
                home,
                random,
                wind=Wind(mean_ne_m_s=mean, gust_m_s=GUST_SHARE * settings.wind_m_s),
                yaw_rad=float(random.uniform(-np.pi, np.pi)),
            )
            self.vehicles[drone_id] = vehicle
            self.autopilots[drone_id] = SimAutopilot(
                vehicle,
                drone_id,
                random,
                origin=settings.origin,
                gps_noise_m=settings.gps_noise_m,
                compass_error_deg=settings.compass_error_deg,
                utc_us=settings.utc_us,
            )

    def step_to(self, now_us: int) -> None:
        """Advance to `now_us` in steps of STEP_US: animals swim, autopilots hear, fly and say."""
        while self.now_us + STEP_US <= now_us:
            self.now_us += STEP_US
            self.pod.step(STEP_US / 1e6)
            for drone_id, autopilot in self.autopilots.items():
                if drone_id in self.dead:
                    self._links[drone_id].receive()
                    continue
                heard = self._links[drone_id].receive()
                if heard:
                    autopilot.receive(heard, self.now_us / 1e6)
                said = autopilot.step(self.now_us / 1e6)
                if said:
                    self._links[drone_id].write(said)

    def kill(self, drone_id: int) -> None:
        """A drone falls out of the sky: its autopilot is silent from now on."""
        self.dead.setdefault(drone_id, self.now_us / 1e6)

    def state(self) -> world_state_t:
        """The truth now."""
        drones = []
        for drone_id, vehicle in self.vehicles.items():
            pose, velocity = vehicle.pose, vehicle.velocity_ned
            drones.append(
                make(
                    world_drone_t,
                    id=drone_id,
                    alive=drone_id not in self.dead,
                    n_m=pose.n_m,
                    e_m=pose.e_m,
                    d_m=pose.d_m,
                    vn_m_s=float(velocity[0]),
                    ve_m_s=float(velocity[1]),
                    vd_m_s=float(velocity[2]),
                    roll_rad=pose.roll_rad,
                    pitch_rad=pose.pitch_rad,
                    yaw_rad=pose.yaw_rad,
                )
            )
        animals = [
            make(
                world_animal_t,
                id=view.id,
                n_m=view.n_m,
                e_m=view.e_m,
                heading_rad=view.heading_rad,
                speed_m_s=float(self.pod.speed_m_s[index]),
                length_m=view.length_m,
                depth_m=view.depth_m,
                phase_rad=view.phase_rad,
                species=view.species,
            )
            for index, view in enumerate(self.pod.views())
        ]
        self._seq += 1
        return make(
            world_state_t,
            utime=self.now_us,
            seq=self._seq - 1,
            n_drones=len(drones),
            drones=drones,
            n_animals=len(animals),
            animals=animals,
        )
