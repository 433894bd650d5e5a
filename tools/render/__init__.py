"""`podwatch render`: labelled scenes for training, validation and benchmarks."""

from tools.render.dataset import command, render_dataset
from tools.render.outlines import measured_right_whales
from tools.render.pods import SPLITS
from tools.render.scenes import Conditions, Scene, scenes

__all__ = ["SPLITS", "Conditions", "Scene", "command", "measured_right_whales", "render_dataset", "scenes"]
