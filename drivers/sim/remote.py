"""The simulated camera of a drone in its own process: it hears the world's group and renders there."""

from pathlib import Path
from typing import Any

import lcm
import numpy as np

from drivers.cameras.pinhole import Pinhole
from drivers.sim.camera import Image, SimCamera
from drivers.sim.clock import ClockPage
from drivers.sim.surfaces import open_scene
from lcmtypes import channels
from lcmtypes.podwatch import world_state_t

__all__ = ["RemoteCamera", "world_url"]

STALE_S = 1.0  # a world silent for longer shows nothing


def world_url(slot: int) -> str:
    """The world's own multicast group, which no process of a drone joins."""
    return f"udpm://239.255.77.100:{7667 + slot}?ttl=0&recv_buf_size=4194304"


class RemoteCamera:
    """Renders from the newest state that the world has said, carried on to the instant of capture."""

    def __init__(
        self,
        drone_id: int,
        world_url: str,
        clock_page: str,
        image_size: tuple[int, int],
        vfov_deg: float,
        surface: dict[str, Any],
        poster: bool = False,
    ) -> None:
        self._clock = ClockPage(Path(clock_page))
        self._lcm = lcm.LCM(world_url)
        self._newest: bytes | None = None
        self._lcm.subscribe(channels.WORLD_STATE, self._hear).set_queue_capacity(200)
        camera = Pinhole((image_size[0], image_size[1]), float(np.radians(vfov_deg)))
        surface = {**surface, "centre_ne": tuple(surface["centre_ne"])}
        self._camera = SimCamera(drone_id, camera, open_scene(**surface), self._look, poster=poster)

    def capture(self) -> Image | None:
        """The view now; None while the world is silent."""
        return self._camera.capture()

    def _hear(self, _channel: str, data: bytes) -> None:
        self._newest = data

    def _look(self) -> tuple[world_state_t, float, float] | None:
        while self._lcm.handle_timeout(0) > 0:
            pass
        if self._newest is None:
            return None
        state = world_state_t.decode(self._newest)
        now_us, _ = self._clock.read()
        ahead_s = (now_us - state.utime) / 1e6
        return (state, max(ahead_s, 0.0), now_us / 1e6) if ahead_s < STALE_S else None
