"""Animals that swim: a pod on a slow course, each animal about its own place in it, kept apart from the
others.

A simulator's model, not a claim about whales: speeds and distances are those of resting and slowly travelling
groups.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.sim.render.scene import AnimalView

__all__ = ["Pod", "PodSettings", "place_animals"]

Array = NDArray[np.float64]

HIDDEN_DEPTH_M = 8.0
DIVE_RATE_M_S = 2.0
TAIL_BEAT_HZ = 0.35
TURN_RATE_RAD_S = 0.15
PLACE_GAIN_PER_S = 0.05  # how strongly an animal swims back to its place in the pod
KEEP_APART_LENGTHS = 0.9


@dataclass(frozen=True)
class PodSettings:
    """What a mission file says of the animals."""

    n_animals: int
    north_m: float
    east_m: float
    radius_m: float
    length_m: float
    length_spread: float
    speed_m_s: float
    spacing_m: float
    species: str
    poster: bool = False


def place_animals(settings: PodSettings, random: np.random.Generator) -> Array:
    """(N, 2) places (n, e) within the pod's radius, `spacing_m` apart; ValueError where they do not fit."""
    places = np.zeros((0, 2))
    for _ in range(20_000):
        if len(places) == settings.n_animals:
            break
        radius = settings.radius_m * np.sqrt(random.random())
        angle = random.uniform(0, 2 * np.pi)
        place = radius * np.array([np.cos(angle), np.sin(angle)])
        if np.all(np.linalg.norm(places - place, axis=1) >= settings.spacing_m):
            places = np.vstack([places, place])
    if len(places) < settings.n_animals:
        raise ValueError(
            f"{settings.n_animals} animals {settings.spacing_m} m apart do not fit within "
            f"{settings.radius_m} m (found room for {len(places)}); widen pod.radius_m or lower pod.spacing_m"
        )
    return places + (settings.north_m, settings.east_m)


class Pod:
    """All animals' true state. `step` advances it; posters lie still."""

    def __init__(self, settings: PodSettings, random: np.random.Generator) -> None:
        self._random = random
        n = settings.n_animals
        self.settings = settings
        self.position_m = place_animals(settings, random)
        self.length_m = settings.length_m * (1 + settings.length_spread * random.uniform(-1, 1, n))
        self.heading_rad = random.uniform(-np.pi, np.pi, n)
        self.phase_rad = random.uniform(0, 2 * np.pi, n)
        self.depth_m = np.zeros(n)
        self._course_rad = float(random.uniform(-np.pi, np.pi))
        self._places = self.position_m - (settings.north_m, settings.east_m)
        self._centre = np.array([settings.north_m, settings.east_m])
        self.speed_m_s = np.zeros(n) if settings.poster else settings.speed_m_s * random.uniform(0.6, 1.2, n)
        self.diving = False

    def step(self, dt_s: float) -> None:
        """Advance by `dt_s` seconds."""
        target = HIDDEN_DEPTH_M if self.diving else 0.0
        self.depth_m += np.clip(target - self.depth_m, -DIVE_RATE_M_S * dt_s, DIVE_RATE_M_S * dt_s)
        if self.settings.poster or not len(self.position_m):
            return
        self.phase_rad = (self.phase_rad + 2 * np.pi * TAIL_BEAT_HZ * dt_s) % (2 * np.pi)
        self._course_rad += float(self._random.normal(0, 0.02)) * np.sqrt(dt_s)
        drift = 0.5 * self.settings.speed_m_s * np.array([np.cos(self._course_rad), np.sin(self._course_rad)])
        self._centre = self._centre + drift * dt_s
        wish = drift + PLACE_GAIN_PER_S * (self._centre + self._places - self.position_m) + self._push_apart()
        wander = self._random.normal(0, 0.25, len(self.heading_rad)) * np.sqrt(dt_s)
        wanted = np.arctan2(wish[:, 1], wish[:, 0])
        turn = np.angle(np.exp(1j * (wanted - self.heading_rad)))
        self.heading_rad = self.heading_rad + np.clip(
            turn * dt_s * 0.3, -TURN_RATE_RAD_S * dt_s, TURN_RATE_RAD_S * dt_s
        )
        self.heading_rad = np.angle(np.exp(1j * (self.heading_rad + wander * 0.3)))
        ahead = np.column_stack([np.cos(self.heading_rad), np.sin(self.heading_rad)])
        self.position_m = self.position_m + (ahead * self.speed_m_s[:, None] + self._push_apart()) * dt_s

    def _push_apart(self) -> Array:
        """(N, 2) m/s: animals closer than a share of their length slide apart."""
        away = self.position_m[:, None] - self.position_m[None]
        distance = np.linalg.norm(away, axis=2) + np.eye(len(away)) * 1e9
        reach = KEEP_APART_LENGTHS * self.length_m
        strength = np.clip(1 - distance / reach[:, None], 0, 1)
        return np.asarray((away / distance[..., None] * strength[..., None]).sum(axis=1) * 2.0)

    def views(self) -> list[AnimalView]:
        """What a camera needs of each animal, ids from 1."""
        return [
            AnimalView(
                id=index + 1,
                n_m=float(self.position_m[index, 0]),
                e_m=float(self.position_m[index, 1]),
                heading_rad=float(self.heading_rad[index]),
                length_m=float(self.length_m[index]),
                species=self.settings.species,
                depth_m=float(self.depth_m[index]),
                phase_rad=float(self.phase_rad[index]),
                poster=self.settings.poster,
            )
            for index in range(len(self.position_m))
        ]
