"""What a simulated mission's file may say beyond the mission itself: the world, its faults, and what is
expected.
"""

from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.sim.pod import PodSettings
from procs.settings import Mission, Section

__all__ = ["Expect", "Fault", "SimMission"]


class PodTable(Section):
    """The animals; north_m and east_m from the fleet's origin."""

    animals: int = Field(5, ge=0, le=20)
    north_m: float = Field(100.0, ge=-5000, le=5000)
    east_m: float = Field(0.0, ge=-5000, le=5000)
    radius_m: float = Field(20.0, gt=0, le=500)
    spacing_m: float = Field(10.0, ge=0, le=100)
    length_m: float = Field(10.0, gt=0.5, le=40)
    length_spread: float = Field(0.15, ge=0, le=0.5)
    speed_m_s: float = Field(0.7, ge=0, le=4)
    species: str = "sperm"
    poster: bool = False

    def settings(self) -> PodSettings:
        """The same for the pod's model."""
        return PodSettings(
            n_animals=self.animals,
            north_m=self.north_m,
            east_m=self.east_m,
            radius_m=self.radius_m,
            length_m=self.length_m,
            length_spread=self.length_spread,
            speed_m_s=self.speed_m_s,
            spacing_m=self.spacing_m,
            species=self.species,
            poster=self.poster,
        )


class WorldTable(Section):
    """What is unkind: errors of the instruments, wind, clocks, the radio."""

    surface: Literal["sea", "grass"] = "sea"
    sea_state: int = Field(2, ge=0, le=5)
    gps_noise_m: float = Field(1.5, ge=0, le=20)
    compass_error_deg: float = Field(5.0, ge=0, le=90)
    wind_m_s: float = Field(4.0, ge=0, le=15)
    clock_offset_s: float = Field(2.0, ge=0, le=60)
    clock_drift_ppm: float = Field(30.0, ge=0, le=500)
    radio_loss: float = Field(0.02, ge=0, le=0.9)
    radio_latency_s: float = Field(0.008, ge=0, le=1)
    scene_width_m: float = Field(60.0, gt=1, le=5000)  # ground width of a --scene picture
    compass_uniform: bool = True  # gathered headings are uniform over 360 degrees


class Fault(Section):
    """One fault: `when` the fleet reaches a stage (or at once), `after_s` seconds later."""

    kind: Literal["dive", "kill", "cut"]
    when: Literal["start", "scout", "found", "register", "monitor"] = "monitor"
    after_s: float = Field(10.0, ge=0, le=3600)
    for_s: float = Field(20.0, gt=0, le=3600)
    drone: int = Field(0, ge=0, le=99)  # kill: which; 0 for the one that scouts
    between: tuple[int, int] = (1, 2)  # cut: the link, both ways


class Expect(Section):
    """What a scenario's test holds the run to; None is not checked."""

    distinct: bool | None = None
    consensus: bool | None = None
    drones_in_monitor: int | None = None
    drones_standing_by: int | None = None
    all_landed: bool | None = None
    min_monitor_s: float | None = None
    min_in_image_share: float | None = None
    max_seconds_to_monitor: float | None = None
    min_episodes: int | None = None
    min_distance_m: float = 3.0  # in truth, between any two living drones in the air


class SimMission(Mission):
    """A mission file for `podwatch sim`."""

    pod: PodTable = PodTable()
    world: WorldTable = WorldTable()
    faults: tuple[Fault, ...] = ()
    expect: Expect = Expect()
    seed: int = Field(1, ge=0)
    duration_s: float = Field(420.0, ge=1, le=36000)  # simulated time after which a run is ended

    @model_validator(mode="after")
    def _faults_fit(self) -> Self:
        for fault in self.faults:
            if fault.kind == "kill" and fault.drone and fault.drone not in self.roster:
                raise ValueError(f"faults: drone {fault.drone} is not in the roster {list(self.roster)}")
            if fault.kind == "cut" and not set(fault.between) <= set(self.roster):
                raise ValueError(
                    f"faults: the link {fault.between} is not between members of {list(self.roster)}"
                )
        return self
