"""Which boxes count as right, and average precision by hand."""

import numpy as np
import pytest

from procs.detector.yolo import Detections
from tools.train.detector.scores import average_precision, match, match_animals


def found(*rows: tuple[float, ...]) -> Detections:
    table = np.array(rows, np.float32).reshape(-1, 5)
    return Detections(table[:, :4], table[:, 4], np.zeros(len(table), np.int64), {0: "whale"})


def test_each_animal_is_found_once_and_faint_ones_are_left_out() -> None:
    known = np.array([[0, 0, 10, 10, 1], [50, 50, 60, 60, 0]], np.float32)
    seen = found((0, 0, 10, 9, 0.9), (0, 0, 10, 10, 0.8), (50, 50, 58, 60, 0.7), (80, 80, 90, 90, 0.6))
    assert [right for _, right in match(seen, known)] == [True, False, False]
    assert [right for _, right in match(seen, known, extras_allowed=True)] == [True]


def test_average_precision_by_hand() -> None:
    # Right, wrong, right of two animals: precision 1 up to recall 1/2, then 2/3 up to 1.
    assert average_precision([(0.9, True), (0.8, False), (0.7, True)], 2) == pytest.approx(0.5 + 0.5 * 2 / 3)
    assert average_precision([(0.9, True)], 2) == pytest.approx(0.5)
    assert average_precision([], 3) == 0.0


def test_an_animal_has_the_score_of_the_box_that_found_it_and_none_where_it_was_missed() -> None:
    known = np.array([[0, 0, 10, 10, 1], [20, 20, 30, 30, 1], [50, 50, 60, 60, 0]], np.float32)
    seen = found((0, 0, 10, 9, 0.9), (50, 50, 58, 60, 0.7), (80, 80, 90, 90, 0.6))
    results, scores = match_animals(seen, known)
    assert scores.tolist() == pytest.approx([0.9, 0.0])
    assert results == [(pytest.approx(0.9), True), (pytest.approx(0.6), False)]
