"""A photograph or a video as the world: scale, placement, what lies outside, what cannot be read."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.cameras.pinhole import Pinhole, Pose
from drivers.sim.render import PictureSurface, SurfaceError, VideoSurface, open_surface

CAMERA = Pinhole((200, 150), np.radians(60))


def spotted(seed: int = 0) -> np.ndarray:
    """300 x 200 px of blue with many spots, one of them pure red, 20 px wide, its middle at (150, 60)."""
    rng = np.random.default_rng(seed)
    image = np.full((200, 300, 3), (120, 80, 30), np.uint8)
    for _ in range(120):
        centre = tuple(int(value) for value in rng.integers(0, (300, 200)))
        colour = tuple(int(value) for value in rng.integers(60, 200, 3))
        cv2.circle(image, centre, int(rng.integers(2, 6)), colour, -1)
    cv2.rectangle(image, (140, 50), (159, 69), (0, 0, 255), -1)
    return image


def red_middle(view: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero((view[..., 2] > 230) & (view[..., 0] < 40))
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


def test_the_picture_lies_where_its_scale_says() -> None:
    # 60 m over 300 px: 0.2 m a px. The red mark is 40 px above the middle, so 8 m north of the centre.
    surface = PictureSurface(spotted(), 60.0, centre_ne=(100.0, -50.0))
    view = surface.render(CAMERA, Pose(108.0, -50.0, -20.0), 0.0)
    np.testing.assert_allclose(red_middle(view), (100, 75), atol=1)
    turned = surface.render(CAMERA, Pose(100.0, -50.0, -20.0, yaw_rad=np.pi / 2), 0.0)
    # Facing east, north is to the left: 8 m at 20 m height.
    expected = 100 - 8 / CAMERA.metres_per_px(20.0)
    np.testing.assert_allclose(red_middle(turned), (expected, 75), atol=1)


def test_outside_lies_flat_sea_of_the_median_colour_and_no_second_mark() -> None:
    surface = PictureSurface(spotted(), 60.0)
    far = surface.render(CAMERA, Pose(200.0, 0.0, -20.0), 0.0)
    assert (far == np.median(spotted().reshape(-1, 3), axis=0).astype(np.uint8)).all()
    wide = surface.render(CAMERA, Pose(0.0, 0.0, -150.0), 0.0)
    count, _, _, _ = cv2.connectedComponentsWithStats(
        ((wide[..., 2] > 215) & (wide[..., 0] < 40)).astype(np.uint8)
    )
    assert count == 2  # the background and one mark: nothing is mirrored or repeated


def test_out_is_written_in_place() -> None:
    out = np.zeros((150, 200, 3), np.uint8)
    assert PictureSurface(spotted(), 60.0).render(CAMERA, Pose(0, 0, -20.0), 0.0, (), out) is out
    assert out.any()


@pytest.mark.parametrize("width_m", [0.0, -5.0, float("nan")])
def test_a_width_that_is_none_is_refused(width_m: float) -> None:
    with pytest.raises(ValueError, match="width_m"):
        PictureSurface(spotted(), width_m)


def test_a_grey_picture_is_refused() -> None:
    with pytest.raises(ValueError, match=r"uint8 \(200, 300\)"):
        PictureSurface(spotted()[..., 0], 60.0)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames at 10 Hz; the camera drifts 3 px right a frame, and a white mark moves down the scene."""
    path = tmp_path_factory.mktemp("video") / "drift.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (300, 200))
    for index in range(6):
        frame = spotted()
        cv2.rectangle(frame, (220, 20 + 20 * index), (235, 35 + 20 * index), (255, 255, 255), -1)
        writer.write(np.roll(frame, -3 * index, axis=1))
    writer.release()
    return path


def test_a_video_is_held_still_played_once_and_frozen(video: Path) -> None:
    surface = open_surface(video, 60.0)
    assert isinstance(surface, VideoSurface)
    pose = Pose(0.0, 0.0, -35.0)
    first = surface.render(CAMERA, pose, 0.0)
    later = surface.render(CAMERA, pose, 0.45)
    np.testing.assert_allclose(red_middle(later), red_middle(first), atol=1.0)  # 12 px of drift are taken out

    def white_row(view: np.ndarray) -> float:
        return float(np.nonzero(view.min(axis=2) > 225)[0].mean())

    assert white_row(later) > white_row(first) + 10
    frozen = surface.render(CAMERA, pose, 60.0)
    np.testing.assert_array_equal(frozen, surface.render(CAMERA, pose, 120.0))
    assert white_row(frozen) > white_row(later)


def test_missing_and_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(SurfaceError, match=r"gone\.jpg: no such file"):
        open_surface(tmp_path / "gone.jpg", 60.0)
    for name in ("text.jpg", "text.mp4"):
        (tmp_path / name).write_text("no picture")
        with pytest.raises(SurfaceError, match=name.replace(".", r"\.")):
            open_surface(tmp_path / name, 60.0)


def test_open_surface_reads_a_picture(tmp_path: Path) -> None:
    path = tmp_path / "scene.png"
    cv2.imwrite(str(path), spotted())
    surface = open_surface(str(path), 60.0)
    assert type(surface) is PictureSurface
    np.testing.assert_allclose(
        red_middle(surface.render(CAMERA, Pose(8.0, 0.0, -20.0), 0.0)), (100, 75), atol=1
    )
