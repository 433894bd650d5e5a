"""The algorithm as the paper prints it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from procs.registrar._literal import corner_costs, corners_of
from procs.registrar.box_icp import box_icp
from tools.bench.registration import PAIRS, draw_views, pair_success


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 4))
def test_the_table_of_permutations_is_the_inner_assignment(seed, n_source, n_target):
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(n_source, 4, 2)), rng.normal(size=(n_target, 4, 2))
    costs, _ = corner_costs(source, target)
    for i in range(n_source):
        for j in range(n_target):
            distances = np.linalg.norm(source[i][:, None] - target[j][None], axis=2)
            rows, columns = linear_sum_assignment(distances)
            assert costs[i, j] == pytest.approx(distances[rows, columns].sum())


def test_corners_go_round_the_box():
    assert corners_of(np.array([[1.0, 2.0, 3.0, 5.0]]))[0].tolist() == [[1, 2], [3, 2], [3, 5], [1, 5]]


def test_a_shifted_and_scaled_view_is_recovered_exactly():
    source = np.array([[0.0, 0, 40, 20], [200, 10, 230, 60], [90, 150, 160, 170]])
    target = source * 1.1 + np.array([12, -8, 12, -8])
    alignment = box_icp(source, target, mode="literal")
    assert alignment.matches.tolist() == [[0, 0], [1, 1], [2, 2]]
    np.testing.assert_allclose(alignment.transform, [[1.1, 0, 12], [0, 1.1, -8], [0, 0, 1]], atol=1e-6)
    assert alignment.residual_px == pytest.approx(0.0, abs=1e-6)


def test_corners_are_carried_and_never_boxed_again():
    """A square against the box round its eighth of a turn: the four corners stay a diamond, off by the
    same bit each."""
    half = 10 * np.sqrt(2)
    source = np.array([[-10.0, -10, 10, 10]])
    target = np.array([[-half, -half, half, half]])
    alignment = box_icp(source, target, mode="literal")
    np.testing.assert_allclose(alignment.transform[:2, :2], np.eye(2) * np.sqrt(2), atol=1e-6)


def test_the_order_of_the_boxes_orders_the_answer():
    near = next(cell for cell in PAIRS if cell.literal)
    rng = np.random.default_rng(4)
    source, target = draw_views(near, rng)
    order = rng.permutation(len(source.boxes))
    plain = box_icp(source.boxes, target.boxes, mode="literal")
    mixed = box_icp(source.boxes[order], target.boxes, mode="literal")
    assert sorted((int(order[a]), int(b)) for a, b in mixed.matches) == sorted(
        map(tuple, plain.matches.tolist())
    )


def test_far_headings_defeat_it_and_near_ones_do_not():
    # The paper's views are pictures moved, turned and sheared; a tilt in both would cost one in a hundred.
    near = replace(next(cell for cell in PAIRS if cell.literal), tilt_rad=0.0)
    assert pair_success(near, 30, seed=2)["right"] == 1.0
    half_turn = np.array([[0.0, 0, 40, 20], [200, 10, 230, 60], [90, 150, 160, 170]])
    turned = -half_turn[:, [2, 3, 0, 1]] + 250
    assert box_icp(half_turn, turned, mode="literal").matches.tolist() != [[0, 0], [1, 1], [2, 2]]
