"""The simulated camera: what a drone would see, drawn from the true state at the instant of capture."""

import struct
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from drivers.sim.render.scene import AnimalView, Surface
from lcmtypes.podwatch import world_drone_t, world_state_t

__all__ = ["BoxPainter", "SimCamera", "animal_views", "drone_pose"]

Image = NDArray[np.uint8]
MIN_HEIGHT_M = 0.3  # a camera on deck sees as much as one at this height


def drone_pose(drone: world_drone_t, ahead_s: float = 0.0) -> Pose:
    """The drone's true pose, carried on by its velocity for `ahead_s`."""
    return Pose(
        n_m=drone.n_m + drone.vn_m_s * ahead_s,
        e_m=drone.e_m + drone.ve_m_s * ahead_s,
        d_m=min(drone.d_m + drone.vd_m_s * ahead_s, -MIN_HEIGHT_M),
        roll_rad=drone.roll_rad,
        pitch_rad=drone.pitch_rad,
        yaw_rad=drone.yaw_rad,
    )


def animal_views(state: world_state_t, ahead_s: float = 0.0, *, poster: bool = False) -> list[AnimalView]:
    """Every animal as the renderer takes it, carried on for `ahead_s`."""
    return [
        AnimalView(
            id=animal.id,
            n_m=animal.n_m + animal.speed_m_s * ahead_s * float(np.cos(animal.heading_rad)),
            e_m=animal.e_m + animal.speed_m_s * ahead_s * float(np.sin(animal.heading_rad)),
            heading_rad=animal.heading_rad,
            length_m=animal.length_m,
            species=animal.species,
            depth_m=animal.depth_m,
            phase_rad=animal.phase_rad,
            poster=poster,
        )
        for animal in state.animals
    ]


class SimCamera:
    """Renders one drone's view. `look` gives (true state, seconds since it was true, simulation time in s) or
    None.
    """

    def __init__(
        self,
        drone_id: int,
        camera: Pinhole,
        surface: Surface,
        look: Callable[[], tuple[world_state_t, float, float] | None],
        *,
        poster: bool = False,
    ) -> None:
        self._drone_id = drone_id
        self._camera = camera
        self._surface = surface
        self._look = look
        self._poster = poster

    def capture(self) -> Image | None:
        """The view now, (H, W, 3) uint8 BGR; None while the world is silent or the drone is dead."""
        seen = self._look()
        if seen is None:
            return None
        state, ahead_s, t_s = seen
        for drone in state.drones:
            if drone.id == self._drone_id and drone.alive:
                animals = animal_views(state, ahead_s, poster=self._poster)
                return self._surface.render(self._camera, drone_pose(drone, ahead_s), t_s, animals)
        return None


class BoxPainter:
    """For `--sensor boxes`: in place of pixels, the true boxes written into the first bytes of a black image.

    `drivers.sim.boxes` reads them back; everything between camera and detector stays as it is.
    """

    ROW = struct.Struct("<hffff")
    MARK = b"BOX0"

    def render(
        self,
        camera: Pinhole,
        pose: Pose,
        t_s: float,
        animals: Sequence[AnimalView] = (),
        out: Image | None = None,
    ) -> Image:
        """(H, W, 3) uint8, black but for the table of boxes."""
        width, height = camera.image_size
        image = np.zeros((height, width, 3), np.uint8)
        rows = b"".join(
            self.ROW.pack(animal.id, *box)
            for animal in animals
            if animal.depth_m < 1.5 and (box := _box(camera, pose, animal)) is not None
        )
        table = self.MARK + struct.pack("<i", len(rows) // self.ROW.size) + rows
        image.reshape(-1)[: len(table)] = np.frombuffer(table, np.uint8)
        image[height // 2, width // 2] = 255  # so that a check for black frames finds light
        image[::16, ::16][-1, -1] = 255
        return image


def _box(camera: Pinhole, pose: Pose, animal: AnimalView) -> tuple[float, float, float, float] | None:
    """Box of an animal's body ellipse in the image, clipped; None where its centre is outside."""
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    along, across = animal.length_m / 2 * np.cos(angle), 0.11 * animal.length_m * np.sin(angle)
    ch, sh = np.cos(animal.heading_rad), np.sin(animal.heading_rad)
    outline = np.column_stack([animal.n_m + along * ch - across * sh, animal.e_m + along * sh + across * ch])
    to_image = camera.ground_to_image(pose)
    centre = apply_homography(to_image, np.array([[animal.n_m, animal.e_m]]))[0]
    width, height = camera.image_size
    if not (0 <= centre[0] < width and 0 <= centre[1] < height):
        return None
    points = apply_homography(to_image, outline)
    left, top = np.clip(points.min(axis=0), 0, (width, height))
    right, bottom = np.clip(points.max(axis=0), 0, (width, height))
    return float(left), float(top), float(right), float(bottom)
