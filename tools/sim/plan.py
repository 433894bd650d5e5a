"""What a run is made of, alike in both modes: folder, settings of each drone, clocks, key, world."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.cameras.pinhole import Pinhole
from drivers.sim.world import WorldSettings
from lcmtypes.podwatch import world_animal_t
from procs.history import camera_of
from procs.queue_executor import ClockError
from procs.settings import Mission
from tools.sim.settings import SimMission
from tools.sim.truth import labelled_animals

__all__ = ["MODES", "RunPlan"]

MODES = ("processes", "lockstep")


@dataclass(frozen=True)
class RunPlan:
    """One simulated run before it flies. `scene` is a picture's or video's path, None for the rendered
    surface.
    """

    mission: SimMission
    folder: Path
    sensor: str = "pixels"
    scene: Path | None = None
    autopilots: tuple[str, ...] = ()  # addresses of real autopilots, by rank; empty for simulated ones

    @property
    def camera(self) -> Pinhole:
        return camera_of(self.mission.camera)

    @property
    def plain_mission(self) -> Mission:
        """What the drones are told: the mission without the world, its faults and expectations."""
        return Mission.model_validate(self.mission.model_dump(include=set(Mission.model_fields)))

    @property
    def centre_ne(self) -> tuple[float, float]:
        """Where the pod, or the picture's middle, lies."""
        return self.mission.pod.north_m, self.mission.pod.east_m

    def clock(self, drone_id: int) -> ClockError:
        """This drone's clock error, drawn from the run's seed."""
        random = np.random.default_rng([self.mission.seed, 4, drone_id])
        world = self.mission.world
        # Never below zero, as a drone has booted before the run: the offset is counted from 100 s.
        offset_s = 100.0 + float(random.uniform(-1, 1)) * world.clock_offset_s
        drift_ppm = float(random.uniform(-1, 1)) * world.clock_drift_ppm
        return ClockError(round(offset_s * 1e6), drift_ppm)

    def world_settings(self) -> WorldSettings:
        """The world of this run; a picture has its animals in its pixels, so the world then has none."""
        mission = self.mission
        pod = mission.pod if self.scene is None else mission.pod.model_copy(update={"animals": 0})
        origin = mission.origin
        return WorldSettings(
            seed=mission.seed,
            homes={drone.id: (drone.home_n_m, drone.home_e_m) for drone in mission.drones},
            origin=(origin.latitude_deg, origin.longitude_deg, origin.altitude_m),
            pod=pod.settings(),
            gps_noise_m=mission.world.gps_noise_m,
            compass_error_deg=mission.world.compass_error_deg,
            wind_m_s=mission.world.wind_m_s,
        )

    def surface_options(self) -> dict[str, object]:
        """Arguments of `drivers.sim.surfaces.open_scene`."""
        world = self.mission.world
        return {
            "scene": str(self.scene) if self.scene else "",
            "seed": self.mission.seed,
            "sensor": self.sensor,
            "kind": world.surface,
            "sea_state": world.sea_state,
            "species": self.mission.pod.species,
            "width_m": world.scene_width_m,
            "centre_ne": self.centre_ne,
        }

    def scene_truth(self) -> list[world_animal_t] | None:
        """Labelled animals of the picture, None where it has no labels or none is flown over."""
        if self.scene is None:
            return None
        return labelled_animals(self.scene, self.mission.world.scene_width_m, self.centre_ne)

    def log_path(self, drone_id: int) -> Path:
        """The drone's MCAP log."""
        return self.folder / f"drone_{drone_id}.mcap"
