"""`podwatch sim --scene` on real pixels: a rendered picture, a photograph of a right whale, a video."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from drivers.cameras.pinhole import Pinhole, Pose
from drivers.sim.render import AnimalView, SeaRenderer
from tools.cli import app
from tools.train.detector.samples import real_data

RIGHT_WHALES = real_data() / "right_whales"
HELD_OUT = "w_10"  # every fifth picture is kept from training
NORTH_M = 20.0
SCENE_WIDTH_M = 75.0
CAMERA = Pinhole((1600, 1200), np.radians(60.0))
HEIGHT_M = SCENE_WIDTH_M / 1600 / CAMERA.metres_per_px(1.0)
WHALES = tuple(
    AnimalView(id=k + 1, n_m=n_m, e_m=e_m, heading_rad=heading_rad, length_m=11.0)
    for k, (n_m, e_m, heading_rad) in enumerate([(9.0, -11.0, 0.4), (3.0, 10.0, 2.2), (-11.0, -4.0, 1.4)])
)

MISSION = """
name = "over a picture"

[camera]
rate_hz = 10.0

[search]
north_m = {north_m}
radius_m = 40.0

[watch]
watch_s = 8.0

[pod]
north_m = {north_m}

[world]
scene_width_m = {width_m}
"""


def fly(folder: Path, scene: Path, *, drones: int, seconds: float, width_m: float) -> dict[str, Any]:
    """`podwatch sim` over a scene -> the run's summary."""
    folder.mkdir()
    mission = folder / "mission.toml"
    mission.write_text(MISSION.format(north_m=NORTH_M, width_m=width_m))
    words = ["sim", mission, "--scene", scene, "--drones", drones, "--duration", seconds, "--out", folder]
    result = CliRunner().invoke(app, [*map(str, words), "--lockstep", "--headless"])
    assert result.exit_code == 0, result.output
    [path] = folder.glob("*/summary.json")
    summary: dict[str, Any] = json.loads(path.read_text())
    assert summary["scene"] == scene.name
    assert summary["problems"] == []
    return summary


def seen_from(e_m: float = 0.0) -> NDArray[np.uint8]:
    """The sea and its whales from high up, `e_m` east of their middle."""
    pose = Pose(0.0, e_m, -HEIGHT_M)
    return SeaRenderer(5, sea_state=1.0).render(CAMERA, pose, 3.0, WHALES)


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sperm whales, with YOLO labels beside them."""
    path = tmp_path_factory.mktemp("picture") / "pod.png"
    cv2.imwrite(str(path), seen_from())
    boxes = SeaRenderer(5, sea_state=1.0).labels(CAMERA, Pose(0.0, 0.0, -HEIGHT_M), WHALES).boxes
    assert len(boxes) == len(WHALES)
    corners = boxes.reshape(-1, 2, 2) / CAMERA.image_size
    rows = np.hstack([corners.mean(axis=1), corners[:, 1] - corners[:, 0]])
    path.with_suffix(".txt").write_text("".join(f"0 {u} {v} {w} {h}\n" for u, v, w, h in rows))
    return path


@pytest.mark.timeout(300)
def test_two_drones_over_a_labelled_picture_watch_two_whales_and_agree(picture: Path, tmp_path: Path) -> None:
    summary = fly(tmp_path / "runs", picture, drones=2, seconds=60.0, width_m=SCENE_WIDTH_M)
    assert summary["n_animals"] == len(WHALES)
    assert summary["distinct"] is True, summary["reasons"]
    assert summary["consensus"] is True, summary["reasons"]
    watched = [drone["animal"] for drone in summary["drones"]]
    assert len({*watched} & {1, 2, 3}) == 2


@pytest.mark.parametrize("is_labelled", [True, False], ids=["with labels", "without labels"])
def test_without_labels_nobody_can_judge_who_watched_whom(
    is_labelled: bool, picture: Path, tmp_path: Path
) -> None:
    """In two seconds nobody watches anything: a judge who knows the animals says so."""
    scene = tmp_path / picture.name
    scene.write_bytes(picture.read_bytes())
    if is_labelled:
        labels = picture.with_suffix(".txt")
        scene.with_suffix(".txt").write_text(labels.read_text())
    summary = fly(tmp_path / "runs", scene, drones=1, seconds=2.0, width_m=SCENE_WIDTH_M)
    told = False if is_labelled else None
    assert (summary["distinct"], summary["consensus"]) == (told, told)
    assert summary["n_animals"] == (len(WHALES) if is_labelled else None)


@pytest.mark.skipif(not RIGHT_WHALES.is_dir(), reason="needs ../shared/data")
@pytest.mark.timeout(300)
def test_one_drone_keeps_a_right_whale_of_a_photograph_in_its_image(tmp_path: Path) -> None:
    scene = RIGHT_WHALES / "images" / f"{HELD_OUT}.jpg"
    summary = fly(tmp_path / "runs", scene, drones=1, seconds=58.0, width_m=40.0)
    assert summary["n_animals"] == 1
    [drone] = summary["drones"]
    assert drone["monitor_s"] > 5.0, summary["reasons"]
    assert drone["animal"] == 1
    assert drone["in_image_share"] > 0.9


@pytest.mark.timeout(300)
def test_a_video_can_be_flown_over(tmp_path: Path) -> None:
    path = tmp_path / "drift.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 2.0, CAMERA.image_size)
    for index in range(4):  # the camera that took it drifts east
        writer.write(seen_from(0.3 * index))
    writer.release()
    summary = fly(tmp_path / "runs", path, drones=1, seconds=25.0, width_m=SCENE_WIDTH_M)
    assert summary["simulated_s"] == pytest.approx(25.0, abs=0.5)
    assert summary["distinct"] is None
    assert summary["drones"][0]["final_state"] not in (None, "IDLE", "LANDED", "DEAD")
