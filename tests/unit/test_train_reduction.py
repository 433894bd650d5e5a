"""Large pictures of one's own are kept no larger than training shows them."""

import cv2
import numpy as np
import pytest

from drivers.sim.render import Image
from tools.train.detector.photographs import photograph_sample
from tools.train.detector.reduction import MOST_PX, useful
from tools.train.detector.samples import Sample, with_halves


def sea(width: int, height: int) -> Image:
    """Noise of some coarseness: a half of it is no copy of another's."""
    small = np.random.default_rng(0).integers(0, 255, (height // 8, width // 8, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(small, (width, height)), np.uint8)


def picture(width: int, height: int, *boxes: tuple[int, int, int, int]) -> Sample:
    rows = [[*box, 1] for box in boxes]
    return with_halves(sea(width, height), np.array(rows, np.float32).reshape(-1, 5), "survey")


def bytes_of(sample: Sample) -> int:
    """With its halves, and with what its arrays are views of."""
    whole = sample.image if sample.image.base is None else sample.image.base
    return whole.nbytes + (bytes_of(sample.half) if sample.half is not None else 0)


@pytest.mark.parametrize("boxes", [[], [(100, 80, 900, 300)], [(20, 30, 660, 200), (700, 500, 900, 1180)]])
def test_leaving_out_what_is_never_asked_for_changes_nothing(boxes: list[tuple[int, int, int, int]]) -> None:
    whole, empty = picture(2000, 1600, *boxes), [picture(384, 384)]
    (kept,) = useful(whole, 320)
    assert kept.image.shape == (800, 1000, 3)
    for seed in range(40):
        one, other = (photograph_sample([p], empty, np.random.default_rng(seed), 320) for p in (whole, kept))
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.boxes, other.boxes)


def test_a_picture_of_ordinary_size_stays_as_it_is() -> None:
    ordinary = picture(1280, 720, (200, 200, 280, 240))
    assert useful(ordinary, 320) == [ordinary]


def test_a_survey_picture_is_kept_as_what_lies_round_its_animals_and_small() -> None:
    boxes = (300, 40, 420, 90), (380, 60, 500, 120), (4000, 2700, 4200, 2800)
    survey = picture(4800, 3200, *boxes)  # 15 Mpx
    parts = useful(survey, 320)
    assert [part.image.shape[:2] for part in parts] == [(1024, 1024), (1024, 1024), (1600, 2400)]
    assert [len(part.boxes) for part in parts] == [2, 1, 3], "neighbours are seen together"
    for part, corner in zip(parts, ((0, 0), (3588, 2176)), strict=False):
        x0, y0, x1, y1 = part.boxes[0, :4].astype(int)
        u, v = corner
        expected = survey.image[v + y0 : v + y1, u + x0 : u + x1]
        np.testing.assert_array_equal(part.image[y0:y1, x0:x1], expected)
    assert (parts[1].boxes[0, :4] + [3588, 2176, 3588, 2176]).tolist() == list(boxes[2])
    assert sum(map(bytes_of, parts)) < 0.45 * bytes_of(survey)


def test_animals_too_short_in_a_small_picture_are_not_shown_in_it() -> None:
    parts = useful(picture(4800, 3200, (300, 300, 330, 320)), 320)
    assert [part.image.shape[:2] for part in parts] == [(1024, 1024)]


def test_a_large_picture_without_animals_is_kept_small_and_a_crowded_one_whole() -> None:
    (empty,) = useful(picture(4800, 3200), 320)
    assert empty.image.shape[0] * empty.image.shape[1] <= MOST_PX
    spread = [(x, y, x + 100, y + 40) for x in range(200, 4700, 900) for y in range(200, 3100, 700)]
    crowded = picture(4800, 3200, *spread)
    assert useful(crowded, 320) == [crowded]
