"""Tracks of drones and animals, one point every so often, from what the logs show."""

from collections.abc import Iterable
from dataclasses import dataclass

from tools.export.scenes import AnimalSight, DronePose, Recording

__all__ = ["Point", "Track", "make_tracks"]


@dataclass(frozen=True)
class Point:
    """One place at one time. uncertainty_m: None where no log says it. note: a drone's state."""

    time_s: float  # since the logs' first message
    time_ns: int  # since 1970, or as time_s where the wall time is not known
    latitude_deg: float
    longitude_deg: float
    height_m: float  # above the fleet's origin: the surface
    n_m: float
    e_m: float
    uncertainty_m: float | None
    note: str


@dataclass(frozen=True)
class Track:
    """Where one drone or one animal was, by time."""

    kind: str  # "drone" or "animal"
    number: int
    points: tuple[Point, ...]

    @property
    def name(self) -> str:
        return f"{self.kind} {self.number}"


def make_tracks(recording: Recording, every_s: float = 1.0) -> list[Track]:
    """The tracks of all drones, then of all animals, by number.

    A drone's point is its newest position in each `every_s` seconds; an animal's the sight with the least
    uncertainty of all drones'. Raises ValueError where every_s is not above 0.
    """
    if not every_s > 0:
        raise ValueError(f"--every {every_s:g}: it must be above 0 s")
    drones: dict[int, dict[int, DronePose]] = {}
    animals: dict[int, dict[int, AnimalSight]] = {}
    for item in recording.items():
        if isinstance(item, DronePose):
            slot = int(recording.time_s(item.at_us) // every_s)
            drones.setdefault(item.drone_id, {})[slot] = item
        elif isinstance(item, AnimalSight):
            slot = int(recording.time_s(item.at_us) // every_s)
            best = animals.setdefault(item.animal, {}).get(slot)
            if best is None or item.uncertainty_m < best.uncertainty_m:
                animals[item.animal][slot] = item
    return [
        *(Track("drone", number, _points(recording, drones[number].values())) for number in sorted(drones)),
        *(
            Track("animal", number, _points(recording, animals[number].values()))
            for number in sorted(animals)
        ),
    ]


def _points(recording: Recording, items: Iterable[DronePose | AnimalSight]) -> tuple[Point, ...]:
    return tuple(_point(recording, item) for item in sorted(items, key=lambda item: item.at_us))


def _point(recording: Recording, item: DronePose | AnimalSight) -> Point:
    is_drone = isinstance(item, DronePose)
    watching = f", watching animal {item.animal}" if is_drone and item.animal >= 0 else ""
    return Point(
        time_s=recording.time_s(item.at_us),
        time_ns=recording.time_ns(item.at_us),
        latitude_deg=item.latitude_deg,
        longitude_deg=item.longitude_deg,
        height_m=item.height_m if isinstance(item, DronePose) else 0.0,
        n_m=item.ned_m[0],
        e_m=item.ned_m[1],
        uncertainty_m=None if isinstance(item, DronePose) else item.uncertainty_m,
        note=f"{item.state}{watching}" if isinstance(item, DronePose) else f"seen by drone {item.drone_id}",
    )
