"""The world's surface and its animals as a virtual camera sees them."""

from drivers.sim.render.labels import Labels
from drivers.sim.render.pictures import PictureSurface, VideoSurface, open_surface
from drivers.sim.render.renderer import WATERS, SeaRenderer
from drivers.sim.render.scene import AnimalView, Image, Surface, SurfaceError
from drivers.sim.render.species import SPECIES, Species

__all__ = [
    "SPECIES",
    "WATERS",
    "AnimalView",
    "Image",
    "Labels",
    "PictureSurface",
    "SeaRenderer",
    "Species",
    "Surface",
    "SurfaceError",
    "VideoSurface",
    "open_surface",
]
