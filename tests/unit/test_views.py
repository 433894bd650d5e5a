"""`podwatch views`: several pictures of one scene, from detection to one animal each, on rendered and on real
whales.
"""

import os
import re
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray
from typer.testing import CliRunner

from drivers.cameras.pinhole import Pinhole, Pose
from drivers.sim.render.renderer import SeaRenderer
from drivers.sim.render.scene import AnimalView
from tools.cli import app
from tools.views import Agreement, ViewsError, _told, agree, command, common_frame, draw, read_pictures

DATA = Path(os.environ.get("PODWATCH_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
CAMERA = Pinhole((640, 480), float(np.radians(60)))
POD = [  # n, e, heading of whales 10 m long
    (0.0, 0.0, 0.4),
    (14.0, 3.0, 1.9),
    (-10.0, 9.0, 2.6),
    (4.0, -15.0, 0.9),
    (-9.0, -9.0, 1.2),
]
POSES = [
    Pose(2.0, -1.0, -42.0, yaw_rad=0.2),
    Pose(-3.0, 3.0, -45.0, 0.04, 0.03, 2.1),
    Pose(1.0, 4.0, -40.0, -0.03, 0.02, 4.4),
]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


def rendered(folder: Path) -> list[Path]:
    """Three views of five rendered whales, 120 degrees apart in heading."""
    animals = [AnimalView(k + 1, n, e, heading, 10.0) for k, (n, e, heading) in enumerate(POD)]
    sea = SeaRenderer(4)
    paths = []
    for number, pose in enumerate(POSES):
        paths.append(folder / f"view_{number + 1}.png")
        assert cv2.imwrite(str(paths[-1]), sea.render(CAMERA, pose, 0.0, animals))
    return paths


def cut_whale(number: int) -> tuple[Image, NDArray[np.float32]]:
    """(crop of one photographed whale, its soft mask), the body about 150 px long."""
    image = cv2.imread(str(DATA / "right_whales" / "images" / f"w_{number}.jpg"))
    _, u, v, width, height = map(
        float, (DATA / "right_whales" / "labels" / f"w_{number}.txt").read_text().split()[:5]
    )
    h_px, w_px = image.shape[:2]
    left, right = round((u - 0.6 * width) * w_px), round((u + 0.6 * width) * w_px)
    top, bottom = round((v - 0.6 * height) * h_px), round((v + 0.6 * height) * h_px)
    crop = image[max(top, 0) : bottom, max(left, 0) : right]
    scale = 180 / max(crop.shape[:2])
    crop = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    mask = np.zeros(crop.shape[:2], np.float32)
    centre, axes = (
        (crop.shape[1] // 2, crop.shape[0] // 2),
        (crop.shape[1] * 43 // 100, crop.shape[0] * 43 // 100),
    )
    cv2.ellipse(mask, centre, axes, 0, 0, 360, 1.0, -1)
    return crop, cv2.GaussianBlur(mask, (0, 0), 6)[..., None]


def photographed(folder: Path, numbers: tuple[int, ...]) -> list[Path]:
    """Three views of a scene made of photographed whales: moved, turned, scaled and sheared, over an ocean of
    their own.
    """
    sea = cv2.imread(str(DATA / "right_whales" / "images" / f"w_{numbers[0]}.jpg"))
    water = np.median(sea[:120].reshape(-1, 3), axis=0)
    random = np.random.default_rng(5)
    ripples = cv2.GaussianBlur(random.normal(0, 14, (1100, 1400)).astype(np.float32), (0, 0), 2.5) * 3
    scene = np.clip(water + ripples[..., None], 0, 255)
    places = [(450, 330), (740, 290), (980, 420), (520, 640), (800, 720), (1020, 700)]
    for number, (u, v) in zip(numbers, places, strict=False):
        crop, mask = cut_whale(number)
        h_px, w_px = crop.shape[:2]
        top, left = v - h_px // 2, u - w_px // 2
        under = scene[top : top + h_px, left : left + w_px]
        toned = crop - np.median(crop[mask[..., 0] < 0.3], axis=0) + water
        scene[top : top + h_px, left : left + w_px] = under * (1 - mask) + np.clip(toned, 0, 255) * mask
    picture = scene.astype(np.uint8)
    paths = []
    for index, (turn, scale, shear) in enumerate([(0.0, 0.85, 0.0), (1.9, 0.95, 0.06), (-2.3, 0.8, -0.05)]):
        turned = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        turned = turned @ np.array([[1, shear], [0, 1]])
        shift = np.array([500, 375]) - turned @ np.array([740, 510])
        view = cv2.warpAffine(
            picture, np.column_stack([turned, shift]), (1000, 750), borderValue=water.tolist()
        )
        paths.append(folder / f"whales_{index + 1}.jpg")
        assert cv2.imwrite(str(paths[-1]), view)
    return paths


def test_views_of_a_rendered_pod_are_agreed_and_each_drone_takes_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "figures" / "views.png"
    command(rendered(tmp_path), out)
    said = capsys.readouterr().out
    assert "view_1.png: 5 animals" in said
    assert "3 views agree on 5 animals" in said
    taken = re.findall(r"takes animal (\d+)", said)
    assert len(taken) == len(set(taken)) == 3
    figure = cv2.imread(str(out))
    assert figure.shape[0] > figure.shape[1] > 900


def test_views_of_photographed_whales_are_agreed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if not (DATA / "right_whales").is_dir():
        pytest.skip(f"no photographs at {DATA}: set PODWATCH_REAL_DATA")
    command(photographed(tmp_path, (0, 1, 12, 13, 60)), tmp_path / "views.png")
    assert "3 views agree on 5 animals" in capsys.readouterr().out


def test_a_video_stands_for_a_drone_by_its_first_frame(tmp_path: Path) -> None:
    path = tmp_path / "film.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for shade in (200, 20):
        video.write(np.full((48, 64, 3), shade, np.uint8))
    video.release()
    still = tmp_path / "still.png"
    cv2.imwrite(str(still), np.zeros((48, 64, 3), np.uint8))
    first, second = read_pictures([path, still])
    assert first.shape == second.shape == (48, 64, 3)
    assert first.mean() == pytest.approx(200, abs=5)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"", r"no picture that can be read \(0 bytes\)"),
        (b"not a picture", "no picture"),
    ],
)
def test_a_picture_that_cannot_be_read_is_named(tmp_path: Path, content: bytes | None, message: str) -> None:
    good, bad = tmp_path / "good.png", tmp_path / "bad.png"
    cv2.imwrite(str(good), np.zeros((48, 64, 3), np.uint8))
    if content is not None:
        bad.write_bytes(content)
    with pytest.raises(ViewsError, match=rf"bad\.png: {message}|bad\.png: holds {message}"):
        read_pictures([good, bad])


def test_one_picture_alone_is_refused_with_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as ended:
        command([tmp_path / "a.png"], tmp_path / "out.png")
    assert ended.value.exit_code == 2
    assert "two or more views" in capsys.readouterr().err


def test_pictures_without_animals_are_exit_code_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    for path in paths:
        cv2.imwrite(str(path), np.full((240, 320, 3), (128, 82, 22), np.uint8))
    with pytest.raises(typer.Exit) as ended:
        command(paths, tmp_path / "out.png")
    assert ended.value.exit_code == 1
    assert "no animal found in any of 2 pictures" in capsys.readouterr().err
    assert not (tmp_path / "out.png").exists()


def test_the_remedies_that_are_named_are_options_of_the_command_line(tmp_path: Path) -> None:
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    for path in paths:
        cv2.imwrite(str(path), np.full((240, 320, 3), (128, 82, 22), np.uint8))
    given = ["views", *map(str, paths), "--out", str(tmp_path / "out.png")]
    said = CliRunner().invoke(app, [*given, "--confidence", "0.07"])
    assert said.exit_code == 1
    assert "no animal found in any of 2 pictures at confidence 0.07; try a lower --confidence" in said.stderr
    assert "--model" in said.stderr
    said = CliRunner().invoke(app, [*given, "--model", str(tmp_path / "mine.onnx")])
    assert said.exit_code == 3
    assert "mine.onnx" in said.stderr
    assert CliRunner().invoke(app, [*given, "--confidence", "7"]).exit_code == 2


def test_a_confidence_above_every_find_finds_nothing(tmp_path: Path) -> None:
    given = ["views", *map(str, rendered(tmp_path)), "--out", str(tmp_path / "out.png")]
    said = CliRunner().invoke(app, [*given, "--confidence", "1"])
    assert said.exit_code == 1
    assert "view_1.png: 0 animals" in said.stdout


def boxes_round(centres: Array) -> Array:
    half = np.array([[30.0, 12.0]])
    return np.concatenate([centres - half, centres + half], axis=1)


def test_costs_are_distances_in_the_frame_of_the_best_seen_view() -> None:
    """View 1 sees animals 0, 1, 2; view 2, turned by 90 degrees and twice as near, sees 1, 2 and 3."""
    first = np.array([[100.0, 100.0], [200.0, 100.0], [200.0, 200.0]])
    turn = 2 * np.array([[0.0, -1.0], [1.0, 0.0]])
    fourth = np.array([300.0, 200.0])
    second = np.array([first[1], first[2], fourth]) @ turn.T + np.array([700.0, -100.0])
    middle = turn @ np.array([200.0, 150.0]) + np.array([700.0, -100.0])
    costs = common_frame(
        [first, second],
        [np.array([0, 1, 2]), np.array([1, 2, 3])],
        [np.array([100.0, 150.0]), middle],
        [0, 1, 2, 3],
    )
    around = np.concatenate([first, fourth[None]])
    np.testing.assert_allclose(costs[0], np.linalg.norm(around - [100, 150], axis=1), atol=1e-6)
    np.testing.assert_allclose(costs[1], np.linalg.norm(around - [200, 150], axis=1), atol=1e-6)


def test_a_view_that_shares_no_animal_cannot_take_what_it_does_not_see() -> None:
    costs = common_frame(
        [np.array([[10.0, 0.0], [0.0, 20.0]]), np.array([[3.0, 4.0]])],
        [np.array([0, 1]), np.array([2])],
        [np.zeros(2), np.zeros(2)],
        [0, 1, 2],
    )
    np.testing.assert_allclose(costs, [[10, 20, np.inf], [np.inf, np.inf, 5]])


def test_more_views_than_animals_leave_a_drone_standing_by() -> None:
    centres = np.array([[200.0, 150.0], [420.0, 300.0]])
    views = [boxes_round(centres + shift) for shift in (0.0, 6.0, -9.0)]
    agreement = agree(views, [(640, 480)] * 3)
    assert sorted(agreement.takes)[0] == -1
    assert len({take for take in agreement.takes if take >= 0}) == 2


def test_views_of_other_sizes_are_brought_to_one() -> None:
    centres = np.array([[100.0, 100.0], [420.0, 130.0], [300.0, 380.0], [520.0, 330.0]])
    large = boxes_round(centres)
    agreement = agree([large, large / 2, large], [(640, 480), (320, 240), (640, 480)])
    assert agreement.consensus
    np.testing.assert_array_equal(agreement.identities[0], agreement.identities[1])


def test_the_figure_has_four_rows_with_own_numbers_and_agreed_names() -> None:
    images = [np.zeros((48, 64, 3), np.uint8)] * 2
    boxes = [np.array([[5.0, 5, 20, 15], [30, 20, 50, 40]])] * 2
    agreement = Agreement(boxes, [np.array([7, 3]), np.array([3, -1])], True, 0.97, [7, -1], False)
    figure = draw(images, agreement, ["a.jpg", "b.jpg"])
    texts = [[text.get_text() for text in axes.texts] for axes in figure.axes]
    assert len(figure.axes) == 8
    assert texts == [[], [], ["1", "2"], ["1", "2"], ["7", "3"], ["3", "?"], ["7", "3"], ["3", "?"]]
    red = [patch.get_edgecolor()[:3] for axes in figure.axes[6:] for patch in axes.patches]
    assert [colour[0] > 0.9 and colour[1] < 0.2 for colour in red] == [True, False, False, False]
    assert figure.axes[7].get_xlabel() == "stands by"


@pytest.mark.parametrize("n_views", [2, 5])
def test_no_title_and_no_label_of_the_figure_is_cut(n_views: int) -> None:
    images = [np.zeros((480, 640, 3), np.uint8)] * n_views
    boxes = [np.array([[30.0, 2, 90, 60]])] * n_views
    agreement = Agreement(boxes, [np.array([0])] * n_views, False, 0.5, [0, *[-1] * (n_views - 1)], False)
    figure = draw(
        images, agreement, ["a_picture_with_a_name_of_some_length_from_a_long_expedition.jpg"] * n_views
    )
    FigureCanvasAgg(figure).draw()
    whole = figure.bbox
    titles = [axes.title.get_window_extent() for axes in figure.axes[:n_views]]
    for text in (*[text.get_window_extent() for text in figure.texts], *titles):
        assert whole.x0 <= text.x0 < text.x1 <= whole.x1
        assert text.y1 <= whole.y1
    assert all(left.x1 < right.x0 for left, right in pairwise(titles))
    for axes in figure.axes:
        assert all(text.get_window_extent().y1 <= axes.bbox.y1 for text in axes.texts)


def test_one_box_a_view_is_said_to_prove_nothing() -> None:
    one = np.array([[10.0, 10.0, 60.0, 40.0]])
    told = _told(agree([one] * 3, [(640, 480)] * 3))
    assert "1 animal," in told
    assert "one box in each view fits whatever animal it is" in told
