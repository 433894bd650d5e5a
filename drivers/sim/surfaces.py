"""The simulated world's surface by its settings: a rendered sea or lawn, a photograph, a video, or boxes in
place of pixels.
"""

from pathlib import Path

from drivers.sim.camera import BoxPainter
from drivers.sim.render import SeaRenderer, Surface, open_surface

__all__ = ["open_scene"]


def open_scene(
    *,
    scene: str,
    seed: int,
    sensor: str,
    kind: str,
    sea_state: int,
    species: str,
    width_m: float,
    centre_ne: tuple[float, float],
) -> Surface:
    """The surface that every simulated camera of a run looks at.

    scene: "" for the rendered `kind` ("sea" or "grass"), else a picture's or video's path, `width_m` wide
    about `centre_ne`. Raises SurfaceError.
    """
    if sensor == "boxes":
        return BoxPainter()
    if scene:
        return open_surface(Path(scene), width_m, centre_ne)
    return SeaRenderer(
        seed, kind="grass" if kind == "grass" else "sea", species=(species,), sea_state=sea_state
    )
