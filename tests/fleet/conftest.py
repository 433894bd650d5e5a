"""What the tests of whole fleets share: a short mission, and the run's folder."""

from pathlib import Path

import pytest

from procs.settings import load_mission
from tools.sim.plan import RunPlan
from tools.sim.settings import SimMission


@pytest.fixture(scope="session")
def near() -> SimMission:
    """Three drones, a pod 25 m away, 20 s of watching."""
    return load_mission(Path(__file__).parent / "near.toml", SimMission)


def new_plan(mission: SimMission, folder: Path) -> RunPlan:
    """A plan with boxes in place of pixels in a fresh folder."""
    folder.mkdir()
    return RunPlan(mission, folder, sensor="boxes")
