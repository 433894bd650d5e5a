"""What a renderer draws and what every surface offers: the words shared by the simulator and the trainer."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose

__all__ = ["AnimalView", "Image", "Surface", "SurfaceError"]

Image = NDArray[np.uint8]


class SurfaceError(Exception):
    """A picture or video cannot serve as the world's surface; the message names the file and the remedy."""


@dataclass(frozen=True)
class AnimalView:
    """One animal at one instant, as a camera needs it: local NED metres, radians, 0 rad heading north.

    `n_m`, `e_m` are the middle of the body; `depth_m` above 0 is under the surface, where the animal fades
    and is invisible from about 4 m; `phase_rad` drives the tail; `poster` makes it a picture printed on a
    rectangular sheet.
    """

    id: int
    n_m: float
    e_m: float
    heading_rad: float
    length_m: float
    species: str = "sperm"
    depth_m: float = 0.0
    phase_rad: float = 0.0
    poster: bool = False


class Surface(Protocol):
    """Anything that a virtual downward camera can look at."""

    def render(
        self,
        camera: Pinhole,
        pose: Pose,
        t_s: float,
        animals: Sequence[AnimalView] = (),
        out: Image | None = None,
    ) -> Image:
        """The view at time `t_s`, (H, W, 3) uint8 BGR; written into `out` where given."""
        ...
