"""What a simulated mission's file may say beyond the mission itself: the world, its faults, and what is
expected.
"""

from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.sim.pod import PodSettings
from procs.settings import Mission, Section

__all__ = ["Expect", "Fault", "SimMission"]


class PodTable(Section):
    """The simulated animals."""

    animals: int = Field(5, ge=0, le=20)  # how many
    north_m: float = Field(100.0, ge=-5000, le=5000)  # middle of the pod at the start, north of the origin
    east_m: float = Field(0.0, ge=-5000, le=5000)  # east of the origin; below 0: west
    radius_m: float = Field(20.0, gt=0, le=500)  # of the circle in which they start
    spacing_m: float = Field(10.0, ge=0, le=100)  # between any two at the start, at least
    length_m: float = Field(10.0, gt=0.5, le=40)  # of an animal, on average
    length_spread: float = Field(0.15, ge=0, le=0.5)  # share by which an animal is longer or shorter at most
    speed_m_s: float = Field(0.7, ge=0, le=4)  # of an animal; the pod as a whole drifts half as fast
    # sperm, right, humpback, minke, fin, gray, sei, bowhead, orca, pilot, beluga or blue
    species: str = "sperm"
    poster: bool = False  # printed animals that lie still, as in the paper's field test

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

    surface: Literal["sea", "grass"] = "sea"  # what lies below
    sea_state: int = Field(2, ge=0, le=5)  # 0: glass, 5: whitecaps everywhere
    # standard deviation an axis; the error wanders over a minute
    gps_noise_m: float = Field(1.5, ge=0, le=20)
    # standard deviation; a drone's error stays for a flight
    compass_error_deg: float = Field(5.0, ge=0, le=90)
    # on average, from where the seed says; gusts of a fifth come on top
    wind_m_s: float = Field(4.0, ge=0, le=15)
    clock_offset_s: float = Field(2.0, ge=0, le=60)  # by which a drone's clock is wrong at most
    clock_drift_ppm: float = Field(30.0, ge=0, le=500)  # by which it goes wrong further at most
    radio_loss: float = Field(0.02, ge=0, le=0.9)  # share of the datagrams that are lost
    radio_latency_s: float = Field(0.008, ge=0, le=1)  # of every datagram
    scene_width_m: float = Field(60.0, gt=1, le=5000)  # ground width of a --scene picture


class Fault(Section):
    """One fault: `when` the fleet reaches a stage (or at once), `after_s` seconds later."""

    # dive: the pod goes under; kill: a drone falls from the sky; cut: two drones hear each other no more
    kind: Literal["dive", "kill", "cut"]
    # when the first drone comes so far; monitor: when all have that do not stand by
    when: Literal["start", "scout", "found", "register", "monitor"] = "monitor"
    after_s: float = Field(10.0, ge=0, le=3600)  # so much later
    for_s: float = Field(20.0, gt=0, le=3600)  # of a dive or a cut; a dead drone stays dead
    drone: int = Field(0, ge=0, le=99)  # kill: which; 0 for the one that scouts
    between: tuple[int, int] = (1, 2)  # cut: which two


class Expect(Section):
    """What the run is held to, at its end and by the scenario's test; what is not given is not checked."""

    distinct: bool | None = None  # each truly watched an animal of its own
    consensus: bool | None = None  # all truly agreed which animal is which
    drones_in_monitor: int | None = None  # how many that live came to watch an animal
    drones_standing_by: int | None = None  # how many that live were left without one
    all_landed: bool | None = None  # true: all that live have landed at the end
    min_monitor_s: float | None = None  # how long each watched its animal, at least
    # share of its watch in which a drone's animal was in its picture, at least
    min_in_image_share: float | None = None
    max_seconds_to_monitor: float | None = None  # from the start until all watched
    min_episodes: int | None = None  # comparisons of views, at least
    min_distance_m: float = 3.0  # between any two drones in the air, in truth


class SimMission(Mission):
    """A mission file for `podwatch sim`."""

    pod: PodTable = PodTable()
    world: WorldTable = WorldTable()
    faults: tuple[Fault, ...] = ()
    expect: Expect = Expect()
    seed: int = Field(1, ge=0)  # the same seed gives the same run
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
