"""The mask tracker on rendered seas: it keeps its animal, says when it cannot see it, and takes it up
again.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.cameras.pinhole import Pinhole, Pose
from drivers.sim.render import AnimalView, SeaRenderer
from procs.tracker.mask_tracker import MaskTracker, Track
from tools.bench.tracking import picture_moments, run

CAMERA = Pinhole((640, 480), np.deg2rad(45.0))
SEA = SeaRenderer(5, water="atlantic", sea_state=2.0)
DT_S = 0.05
DATA = Path(os.environ.get("PODWATCH_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))


class Scene:
    """A whale, and perhaps a neighbour 4 m beside it, that swim north at 1.2 m/s under a swaying, yawing
    drone.
    """

    def __init__(self, neighbour: bool = False, height_m: float = 45.0) -> None:
        self.neighbour, self.height_m = neighbour, height_m
        self.depth_m = 0.0
        self.offset_e_m = 0.0
        self.sway = 1.0

    def view(self, t_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Image, box (4,) of the whale as if it were at the surface, boxes (K, 4) of the others."""
        heading = 0.3 * np.sin(0.7 * t_s)
        at = (1.2 * t_s, self.offset_e_m)
        whales = [AnimalView(0, at[0], at[1], heading, 11.0, depth_m=self.depth_m, phase_rad=2 * t_s)]
        if self.neighbour:
            whales.append(AnimalView(1, at[0] + 1.0, at[1] + 3.2, heading, 10.0, phase_rad=1 + 2 * t_s))
        swing = self.sway * np.sin(1.7 * t_s)
        pose = Pose(1.1 * t_s + 2 * swing, 0.0, -self.height_m, 0.05 * swing, 0.06 * swing, 0.2 + 0.5 * swing)
        seen = [AnimalView(0, at[0], at[1], heading, 11.0, phase_rad=2 * t_s), *whales[1:]]
        labels = SEA.labels(CAMERA, pose, seen).boxes.astype(np.float64)
        return SEA.render(CAMERA, pose, t_s, whales), labels[0], labels[1:]

    def frames(self, first: int, last: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        for frame in range(first, last):
            yield self.view(frame * DT_S)


def middle(box: np.ndarray) -> np.ndarray:
    return (box[:2] + box[2:]) / 2


def started(scene: Scene) -> MaskTracker:
    image, box, others = scene.view(0.0)
    tracker = MaskTracker()
    assert tracker.start(image, middle(box), box, others).state == "tracking"
    return tracker


def is_inside(track: Track, box: np.ndarray) -> bool:
    return bool((track.centre >= box[:2]).all() and (track.centre <= box[2:]).all())


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    common = np.prod(np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0))
    return float(common / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - common))


@pytest.mark.parametrize("height_m", [30.0, 110.0])
def test_keeps_a_swimming_animal_under_a_moving_camera(height_m: float) -> None:
    scene = Scene(height_m=height_m)
    tracker = started(scene)
    overlaps = []
    for image, box, _ in scene.frames(1, 50):
        track = tracker.update(image, DT_S)
        assert track.state == "tracking"
        assert is_inside(track, box)
        overlaps.append(overlap(track.box, box))
    assert np.mean(overlaps) > 0.6


def test_a_point_alone_is_enough_to_start() -> None:
    image, box, _ = Scene().view(0.0)
    track = MaskTracker().start(image, middle(box))
    assert track.state == "tracking"
    assert overlap(track.box, box) > 0.5


def test_a_mask_does_not_run_over_a_neighbour_that_touches() -> None:
    scene = Scene(neighbour=True)
    tracker = started(scene)
    for image, box, others in scene.frames(1, 50):
        track = tracker.update(image, DT_S)
        assert is_inside(track, box)
        assert overlap(track.box, box) > overlap(track.box, others[0]) + 0.2


def test_a_diving_animal_is_predicted_then_taken_up_again() -> None:
    scene = Scene(neighbour=True)
    tracker = started(scene)
    for image, _, _ in scene.frames(1, 30):
        tracker.update(image, DT_S)
    scene.depth_m = 5.0
    for image, box, _ in scene.frames(30, 55):
        track = tracker.update(image, DT_S)
        assert track.state == "predicted"
        assert not track.mask.any()
        assert len(track.outline) == 0
        assert is_inside(track, box + np.array([-20, -20, 20, 20]))
    scene.depth_m = 0.0
    for image, box, _ in scene.frames(55, 75):
        track = tracker.update(image, DT_S)
        came_back_inside = is_inside(track, box)
    assert track.state == "tracking"
    assert track.unseen_s == 0.0
    assert came_back_inside


def test_unseen_for_two_seconds_is_lost_and_the_whole_frame_is_searched() -> None:
    scene = Scene()
    tracker = started(scene)
    scene.depth_m = 5.0
    states = [tracker.update(image, DT_S).state for image, _, _ in scene.frames(1, 45)]
    assert states[38] == "predicted"
    assert states[40] == "lost"
    scene.depth_m, scene.offset_e_m = 0.0, 12.0
    found = [tracker.update(image, DT_S) for image, _, _ in scene.frames(45, 60)]
    assert found[0].state == "lost"  # one frame proves nothing
    assert found[-1].state == "tracking"
    assert is_inside(found[-1], scene.view(59 * DT_S)[1])


def test_open_water_starts_no_mask() -> None:
    sea = SEA.render(CAMERA, Pose(0.0, 0.0, -45.0), 0.0)
    for image in (sea, np.full((480, 640, 3), 90, np.uint8)):
        tracker = MaskTracker()
        for box in ((250, 210, 390, 270), (60, 60, 120, 200)):
            track = tracker.start(image, ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2), box)
            assert (track.state, track.score, track.mask.any()) == ("predicted", 0.0, False)
        assert tracker.update(image).state == "predicted"


def test_detections_that_contradict_the_mask_win_the_second_time() -> None:
    scene = Scene(neighbour=True)
    image, box, others = scene.view(0.0)
    tracker = MaskTracker()
    tracker.start(image, middle(others[0]), others[0], [box])  # on the wrong animal
    image, box, others = scene.view(DT_S)
    assert not is_inside(tracker.update(image, DT_S, boxes=[box], companions=others), box)
    image, box, others = scene.view(2 * DT_S)
    assert is_inside(tracker.update(image, DT_S, boxes=[box], companions=others), box)


def test_a_lost_animal_is_taken_up_at_once_from_a_late_box() -> None:
    scene = Scene()
    tracker = started(scene)
    scene.depth_m = 5.0
    boxes = {}
    for frame, (image, box, _) in enumerate(scene.frames(1, 50), start=1):
        if frame == 48:
            scene.depth_m = 0.0
        boxes[frame] = box
        track = tracker.update(image, DT_S, image_motion=np.eye(3))
    assert track.state == "lost"
    image, box, _ = scene.view(50 * DT_S)
    track = tracker.update(image, DT_S, boxes=[boxes[48]], boxes_age_s=0.1)
    assert track.state == "tracking"
    assert is_inside(track, box)


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_frame_is_predicted_never_masked(level: int) -> None:
    scene = Scene()
    tracker = started(scene)
    for image, _, _ in scene.frames(1, 10):
        tracker.update(image, DT_S)
    for _ in range(5):
        track = tracker.update(np.full((480, 640, 3), level, np.uint8), DT_S)
        assert track.state == "predicted"
        assert not track.mask.any()
    image, box, _ = scene.view(15 * DT_S)
    assert is_inside(tracker.update(image, DT_S), box)


def test_the_vehicles_image_motion_carries_a_jump_of_the_picture() -> None:
    scene = Scene()
    scene.sway = 0.0
    tracker = started(scene)
    for image, _, _ in scene.frames(1, 10):
        tracker.update(image, DT_S)
    jump = np.array([[1.0, 0, 150], [0, 1, -70], [0, 0, 1]])
    image, box, _ = scene.view(10 * DT_S)
    moved = np.asarray(cv2.warpPerspective(image, jump, (640, 480), borderMode=cv2.BORDER_REFLECT), np.uint8)
    track = tracker.update(moved, DT_S, image_motion=jump)
    assert track.state == "tracking"
    assert np.allclose(track.centre, middle(box) + np.array([150, -70]), atol=12)


def test_a_track_has_the_promised_form() -> None:
    scene = Scene()
    tracker = started(scene)
    image, _, _ = scene.view(DT_S)
    track = tracker.update(image)
    assert track.mask.shape == (480, 640)
    assert track.mask.dtype == np.bool_
    assert 0 <= track.score <= 1
    rows, columns = np.nonzero(track.mask)
    assert np.allclose(track.box, [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], atol=4)
    assert 3 <= len(track.outline) <= 64
    assert track.outline.dtype.kind == "i"


def test_the_same_frames_give_the_same_track() -> None:
    scene = Scene(neighbour=True)
    first, second = started(scene), started(scene)
    for image, _, _ in scene.frames(1, 12):
        a, b = first.update(image, DT_S), second.update(image, DT_S)
        assert np.array_equal(a.mask, b.mask)
        assert np.array_equal(a.centre, b.centre)


def test_a_frame_costs_less_than_ten_milliseconds_of_one_thread() -> None:
    scene = Scene(neighbour=True, height_m=25.0)
    tracker = started(scene)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        times = []
        for image, _, _ in scene.frames(1, 20):
            begun = time.thread_time()
            tracker.update(image, DT_S)
            times.append(time.thread_time() - begun)
    finally:
        cv2.setNumThreads(threads)
    assert np.median(times) < 0.010


IMAGE = np.zeros((480, 640, 3), np.uint8)


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        ({"image_bgr": IMAGE[..., 0]}, "(480, 640) uint8"),
        ({"image_bgr": IMAGE.astype(np.float32)}, "float32"),
        ({"image_bgr": "frame.png"}, "str"),
        ({"image_bgr": IMAGE[:20]}, "640 x 20 px"),
        ({"point": (700, 10)}, "(700.0, 10.0)"),
        ({"point": (np.nan, 10)}, "nan"),
        ({"box": (10, 10, np.nan, 40)}, "nan"),
        ({"box": (40, 10, 10, 40)}, "right must exceed left"),
        ({"companions": [(1, 2, 3)]}, "(1, 3)"),
        ({"companions": [(np.inf, 2)]}, "inf"),
    ],
)
def test_start_refuses_bad_input_with_the_value(arguments: dict[str, object], names: str) -> None:
    given = {"image_bgr": IMAGE, "point": (100, 100)} | arguments
    with pytest.raises(ValueError) as refused:
        MaskTracker().start(**given)  # type: ignore[arg-type]
    assert names in str(refused.value)


@pytest.mark.parametrize(
    ("image", "arguments", "names"),
    [
        (IMAGE[:240], {}, "640 x 240 px but the track began on 640 x 480"),
        (IMAGE, {"dt_s": 0.0}, "0.0"),
        (IMAGE, {"dt_s": np.nan}, "nan"),
        (IMAGE, {"boxes": [[1, 2, np.nan, 4]]}, "nan"),
        (IMAGE, {"boxes": [1, 2, 3, 4]}, "(4,)"),
        (IMAGE, {"image_motion": np.eye(2)}, "(3, 3)"),
        (IMAGE, {"image_motion": np.full((3, 3), np.nan)}, "nan"),
        (IMAGE, {"image_motion": np.array([[1, 0, 0], [0, 1, 0], [0.01, 0, -1.0]])}, "folds"),
    ],
)
def test_update_refuses_bad_input_with_the_value(
    image: np.ndarray, arguments: dict[str, object], names: str
) -> None:
    tracker = started(Scene())
    with pytest.raises(ValueError) as refused:
        tracker.update(image, **arguments)  # type: ignore[arg-type]
    assert names in str(refused.value)


def test_update_before_start_or_after_reset_says_so() -> None:
    tracker = started(Scene())
    tracker.reset()
    with pytest.raises(RuntimeError, match="before start"):
        tracker.update(IMAGE)


def test_models_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such file"):
        MaskTracker(tmp_path / "none.onnx")
    (tmp_path / "some.onnx").write_bytes(b"")
    with pytest.raises(ValueError, match="not supported"):
        MaskTracker(tmp_path / "some.onnx")


@pytest.mark.parametrize("picture", ["w_1", "w_7", "w_41"])
def test_keeps_a_photographed_whale_under_a_virtual_camera(picture: str) -> None:
    path = DATA / "right_whales" / "images" / f"{picture}.jpg"
    if not path.is_file():
        pytest.skip(f"no photographs at {DATA}: set PODWATCH_REAL_DATA")
    result = run(picture, picture_moments(path, 1, 60), np.random.default_rng(1))
    assert result.clear > 40
    assert result.inside_share > 0.95
    assert result.overlap_sum / result.clear > 0.35
