"""Recordings as cameras: every frame once, in order, and a clear word where there is none."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.cameras.capture import CameraError, OpenCvCamera, PictureCamera

LEVELS = (40, 120, 200)


def flat(level: int) -> np.ndarray:
    return np.full((48, 64, 3), level, np.uint8)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "flight.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20, (64, 48))
    for level in LEVELS:
        writer.write(flat(level))
    writer.release()
    return path


def levels(images: list[np.ndarray | None]) -> list[int | None]:
    return [None if image is None else round(float(image.mean()), -1) for image in images]


def test_a_video_gives_its_frames_in_order_and_then_none(video: Path) -> None:
    camera = OpenCvCamera(str(video))
    assert levels([camera.capture() for _ in range(4)]) == [*LEVELS, None]


def test_a_looped_video_begins_anew(video: Path) -> None:
    camera = OpenCvCamera(str(video), loop=True)
    assert levels([camera.capture() for _ in range(5)]) == [*LEVELS, *LEVELS[:2]]


def test_a_folder_gives_its_pictures_by_name_again_and_again(tmp_path: Path) -> None:
    for name, level in zip("cab", LEVELS, strict=True):
        cv2.imwrite(str(tmp_path / f"{name}.png"), flat(level))
    (tmp_path / "notes.txt").write_text("no picture")
    camera = PictureCamera(str(tmp_path))
    assert levels([camera.capture() for _ in range(4)]) == [120, 200, 40, 120]


def test_a_broken_picture_is_no_image(tmp_path: Path) -> None:
    (tmp_path / "broken.jpg").write_bytes(b"not a picture")
    assert PictureCamera(str(tmp_path)).capture() is None


@pytest.mark.parametrize("kind", [OpenCvCamera, PictureCamera])
def test_what_is_not_there_is_named(kind: type, tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="nowhere"):
        kind(str(tmp_path / "nowhere.avi"))
