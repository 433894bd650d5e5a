"""Simulated animals: where they begin, how they swim, and what a camera is shown of them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.sim.pod import DIVE_RATE_M_S, HIDDEN_DEPTH_M, Pod, PodSettings, place_animals

SETTINGS = PodSettings(
    n_animals=5,
    north_m=100.0,
    east_m=-20.0,
    radius_m=20.0,
    length_m=10.0,
    length_spread=0.15,
    speed_m_s=0.7,
    spacing_m=10.0,
    species="sperm",
)


def pod(seed: int = 1, **changes: object) -> Pod:
    return Pod(replace(SETTINGS, **changes), np.random.default_rng(seed))  # type: ignore[arg-type]


def gaps_m(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances between all pairs."""
    rows, columns = np.triu_indices(len(places), 1)
    return np.linalg.norm(places[rows] - places[columns], axis=1)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.integers(0, 8))
def test_animals_begin_within_the_pods_radius_and_apart(seed, n_animals):
    places = place_animals(replace(SETTINGS, n_animals=n_animals), np.random.default_rng(seed))
    assert places.shape == (n_animals, 2)
    assert np.all(np.linalg.norm(places - (100.0, -20.0), axis=1) <= 20.0)
    assert np.all(gaps_m(places) >= 10.0)


def test_a_pod_that_does_not_fit_is_refused_with_the_remedy():
    with pytest.raises(ValueError, match=r"20 animals 30.0 m apart do not fit within 20.0 m .*pod.radius_m"):
        pod(n_animals=20, spacing_m=30.0)


def test_the_same_seed_is_the_same_pod_and_another_is_not():
    def swum(seed: int) -> NDArray[np.float64]:
        one = pod(seed)
        for _ in range(500):
            one.step(0.02)
        return one.position_m

    np.testing.assert_array_equal(swum(3), swum(3))
    assert not np.allclose(swum(3), swum(4))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32))
def test_for_two_minutes_animals_keep_together_apart_and_slow(seed):
    one = pod(seed)
    for _ in range(600):
        before = one.position_m
        one.step(0.2)
        speed_m_s = np.linalg.norm(one.position_m - before, axis=1) / 0.2
        assert speed_m_s.max() < 4.0, "what a tracker is told that an animal may swim"
    assert gaps_m(one.position_m).min() > 2.0
    assert np.linalg.norm(one.position_m - one.position_m.mean(axis=0), axis=1).max() < 60.0


def test_a_dive_takes_the_whole_pod_down_and_its_end_brings_it_up():
    one = pod()
    one.diving = True
    one.step(1.0)
    np.testing.assert_allclose(one.depth_m, DIVE_RATE_M_S)
    for _ in range(10):
        one.step(1.0)
    np.testing.assert_allclose(one.depth_m, HIDDEN_DEPTH_M)
    one.diving = False
    for _ in range(10):
        one.step(1.0)
    np.testing.assert_allclose(one.depth_m, 0.0)


def test_posters_lie_still():
    one = pod(poster=True)
    before = (one.position_m.copy(), one.heading_rad.copy())
    for _ in range(50):
        one.step(0.2)
    np.testing.assert_array_equal(one.position_m, before[0])
    np.testing.assert_array_equal(one.heading_rad, before[1])
    assert not one.speed_m_s.any()


def test_a_camera_is_shown_each_animal_as_it_is():
    one = pod()
    one.step(0.2)
    views = one.views()
    assert [view.id for view in views] == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal([(view.n_m, view.e_m) for view in views], one.position_m)
    np.testing.assert_array_equal([view.length_m for view in views], one.length_m)
    assert np.all(np.abs(one.length_m - 10.0) <= 1.5)


def test_a_sea_without_animals_is_a_pod_of_none():
    one = pod(n_animals=0)
    one.step(0.2)
    assert one.views() == []
