"""The world's surface and its animals as a virtual camera sees them."""

from drivers.sim.render.labels import Labels
from drivers.sim.render.pictures import PictureSurface, VideoSurface, open_surface
from drivers.sim.render.renderer import MORE_WATERS, WATERS, SeaRenderer
from drivers.sim.render.scene import AnimalView, Image, Surface, SurfaceError
from drivers.sim.render.species import MORE_SPECIES, SPECIES, Species

__all__ = [
    "MORE_SPECIES",
    "MORE_WATERS",
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
