"""The same seed gives the same bytes, whatever the interpreter's hash seed, the folder and the day."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tools.sim.settings import SimMission

FLY = """
import sys
from pathlib import Path
from tools.sim.plan import RunPlan
from tools.sim.run import fly_lockstep
from tools.sim.settings import SimMission

mission = SimMission.model_validate_json(Path(sys.argv[1]).read_text())
folder = Path(sys.argv[2])
folder.mkdir()
fly_lockstep(RunPlan(mission, folder, sensor=sys.argv[3]), None)
"""


def flown_bytes(mission: SimMission, folder: Path, sensor: str, hash_seed: int) -> dict[str, str]:
    """Fly in a fresh interpreter -> digest of each drone's log and of the truth, by file name."""
    settings = folder.with_suffix(".json")
    settings.write_text(mission.model_dump_json())
    environment = {**os.environ, "PYTHONHASHSEED": str(hash_seed), "OMP_NUM_THREADS": "1"}
    subprocess.run(
        [sys.executable, "-c", FLY, str(settings), str(folder), sensor], check=True, env=environment
    )
    files = sorted([*folder.glob("drone_*.mcap"), folder / "truth.mcap", folder / "truth.csv"])
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("sensor", "seconds"),
    [("boxes", 60.0), ("pixels", 20.0)],
    ids=["boxes to MONITOR", "pixels over the pod"],
)
def test_two_runs_of_one_seed_leave_the_same_bytes(sensor, seconds, near, tmp_path):
    # Pixels from near the start: the pod comes into view within the 20 s.
    near_pod = near.search.model_copy(update={"north_m": 5.0})
    changes = {"duration_s": seconds} | ({"search": near_pod} if sensor == "pixels" else {})
    mission = near.model_copy(update=changes)
    first = flown_bytes(mission, tmp_path / "one", sensor, hash_seed=0)
    second = flown_bytes(mission, tmp_path / "another, with a longer name", sensor, hash_seed=4242)
    assert len(first) == len(mission.roster) + 2
    assert first == second


@pytest.mark.timeout(600)
def test_another_seed_leaves_other_bytes(near, tmp_path):
    short = near.model_copy(update={"duration_s": 5.0})
    one = flown_bytes(short, tmp_path / "one", "boxes", hash_seed=0)
    other = flown_bytes(short.model_copy(update={"seed": 2}), tmp_path / "other", "boxes", hash_seed=0)
    assert not set(one.values()) & set(other.values())
