"""The detector beside a second one, written straight from the format's definition: 200 pictures, the same
boxes.

The second shrinks by sums of weighted pixels, keeps no buffer, and takes away doubles in plain Python.
"""

import math
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import onnxruntime
import pytest

import models
from drivers.cameras.pinhole import Pinhole, Pose
from drivers.sim.render import AnimalView, SeaRenderer
from procs.detector.yolo import Detector

CONFIDENCE, IOU = 0.25, 0.45
LEAST = 0.1  # of the boxes that are looked through for a match
UNSURE = 0.03  # a score or an overlap so near its threshold may fall on either side
PICTURES = 208  # 4 parts of 13 scenes, each four ways up
SIZES = ((640, 480), (641, 481), (960, 540), (480, 640), (800, 450))


class Box(NamedTuple):
    corners: tuple[float, float, float, float]
    score: float


def halving(n_from: int) -> np.ndarray:
    """(n_from / 2, n_from): means of two."""
    return np.kron(np.eye(n_from // 2), [0.5, 0.5])


def interpolating(n_from: int, n_to: int) -> np.ndarray:
    """(n_to, n_from): each new pixel's centre lies between two old ones."""
    places = np.clip((np.arange(n_to) + 0.5) * n_from / n_to - 0.5, 0, n_from - 1)
    return np.clip(1 - np.abs(places[:, None] - np.arange(n_from)[None]), 0, None)


@cache
def steps(n_from: int, n_to: int, n_halves: int, halves_first: bool) -> list[np.ndarray]:
    """One side's way from `n_from` to `n_to`: matrices, each row the weights of one new pixel."""
    sides = [n_from] if halves_first else [n_from, n_to * 2**n_halves]
    matrices = [interpolating(*pair) for pair in pairwise(sides)]
    for _ in range(n_halves):
        matrices.append(halving(sides[-1]))
        sides.append(sides[-1] // 2)
    return [*matrices, interpolating(sides[-1], n_to)]


def shrunk(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The picture at `size`; whole grey levels after each step, as pixels are."""
    ratios = [n_from / n_to for n_from, n_to in zip(picture.shape[1::-1], size, strict=True)]
    n_halves = int(math.log2(min(ratios)))
    halves_first = all(side % 2**n_halves == 0 for side in picture.shape[:2])
    ways = (steps(n, to, n_halves, halves_first) for n, to in zip(picture.shape[1::-1], size, strict=True))
    for across, down in zip(*ways, strict=True):
        picture = np.floor(np.einsum("yv,vuc,xu->yxc", down, picture, across, optimize=True) + 0.5)
    return picture


def reference(session: onnxruntime.InferenceSession, picture: np.ndarray, side: int) -> list[Box]:
    """The boxes of one picture, best first, before any is taken away."""
    height, width = picture.shape[:2]
    ratio = side / max(width, height)
    small_w, small_h = round(width * ratio), round(height * ratio)
    small = shrunk(picture, (small_w, small_h))
    left, top = (side - small_w) // 2, (side - small_h) // 2
    canvas = np.full((side, side, 3), 114.0)
    canvas[top : top + small_h, left : left + small_w] = small
    tensor = canvas[:, :, ::-1].transpose(2, 0, 1)[None] / 255
    (output,) = session.run(None, {session.get_inputs()[0].name: tensor.astype(np.float32)})
    found = []
    for x, y, w, h, score in output[0].T.tolist():
        if score >= LEAST:
            corners = (x - w / 2 - left, y - h / 2 - top, x + w / 2 - left, y + h / 2 - top)
            scales = (width / small_w, height / small_h) * 2
            found.append(Box(tuple(a * b for a, b in zip(corners, scales, strict=True)), score))  # type: ignore[arg-type]
    return sorted(found, key=lambda box: -box.score)


def overlap(one: Box, other: Box) -> float:
    shared_w = min(one.corners[2], other.corners[2]) - max(one.corners[0], other.corners[0])
    shared_h = min(one.corners[3], other.corners[3]) - max(one.corners[1], other.corners[1])
    if shared_w <= 0 or shared_h <= 0:
        return 0.0
    areas = [(box.corners[2] - box.corners[0]) * (box.corners[3] - box.corners[1]) for box in (one, other)]
    return shared_w * shared_h / (sum(areas) - shared_w * shared_h)


def certain(candidates: list[Box]) -> list[Box]:
    """Those that any decoder must report: no score and no overlap is near its threshold."""
    kept: list[Box] = []
    for box in candidates:
        if box.score >= CONFIDENCE and all(overlap(box, better) <= IOU for better in kept):
            kept.append(box)
    return [
        box
        for box in kept
        if box.score >= CONFIDENCE + UNSURE
        and not any(
            overlap(box, one) > IOU - UNSURE
            for one in candidates
            if one is not box and one.score > box.score - UNSURE
        )
    ]


def off_by(corners: np.ndarray, boxes: list[Box], size: tuple[int, int]) -> float:
    """px from one box to the nearest of others, the worst edge; infinite where there are none."""
    limit = np.array([*size, *size])
    return min(
        (float(np.abs(np.clip(box.corners, 0, limit) - corners).max()) for box in boxes), default=math.inf
    )


@cache
def rendered_sea() -> SeaRenderer:
    return SeaRenderer(20, water="atlantic")


def pictures(part: int) -> Iterator[np.ndarray]:
    """Rendered seas with whales, each four ways up."""
    random = np.random.default_rng(part)
    sea = rendered_sea()
    for number in range(PICTURES // 16):
        whales = [
            AnimalView(k + 1, *random.uniform(-15, 15, 2), random.uniform(0, 6), random.uniform(7, 14))
            for k in range(random.integers(1, 7))
        ]
        pose = Pose(0.0, 0.0, -random.uniform(20, 50), yaw_rad=random.uniform(0, 6))
        camera = Pinhole(SIZES[number % len(SIZES)], math.radians(60.0))
        picture = sea.render(camera, pose, float(number), whales)
        for flipped in (picture, picture[::-1], picture[:, ::-1], picture[::-1, ::-1]):
            yield np.ascontiguousarray(flipped)


@pytest.fixture(scope="module")
def session() -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(str(models.path("detector.onnx")), options)


@pytest.mark.parametrize("part", range(4))
def test_the_detector_and_the_reference_agree_to_a_pixel(
    part: int, session: onnxruntime.InferenceSession
) -> None:
    detector = Detector(confidence=CONFIDENCE, iou=IOU)
    n_pictures, n_boxes, worst_px = 0, 0, 0.0
    for picture in pictures(part):
        size = picture.shape[1], picture.shape[0]
        found = detector.detect(picture)
        candidates = reference(session, picture, detector.input_size[0])
        n_pictures += 1
        for corners in found.boxes:
            worst_px = max(worst_px, off_by(corners, candidates, size))
        mine = [
            Box(tuple(corners), score)
            for corners, score in zip(found.boxes.tolist(), found.scores, strict=True)
        ]
        for box in certain(candidates):
            n_boxes += 1
            worst_px = max(worst_px, off_by(np.clip(box.corners, 0, [*size, *size]), mine, size))
    print(f"{n_pictures} pictures, {n_boxes} boxes, worst {worst_px:.2f} px")
    assert n_boxes > n_pictures / 2
    assert worst_px <= 1.0
