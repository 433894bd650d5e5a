"""The navigator's geometry: spiral, presence gate, gathering circle, separation, limits and the visual
servo.
"""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from procs.navigator.flight import approach, inside_fence, limited
from procs.navigator.formation import circle_radius, gather_height, layer_heights, separate, slot
from procs.navigator.presence import Barycentre, PresenceGate
from procs.navigator.servo import AnimalFilter, ground_points, servo_velocity
from procs.navigator.spiral import spacing_for, spiral
from procs.settings import LimitSettings

CAMERA = Pinhole((640, 480), float(np.radians(60)))
LIMITS = LimitSettings()
metres = st.floats(-200, 200)
vectors = st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(-20, 20))
quick = settings(deadline=None, max_examples=60)


def test_the_spiral_starts_at_its_centre_and_ends_at_its_radius() -> None:
    path = spiral(np.array([100.0, -20.0]), 30.0, 150.0)
    np.testing.assert_allclose(path[0], [100, -20])
    assert np.linalg.norm(path[-1] - path[0]) == pytest.approx(150.0)


@quick
@given(st.floats(2, 60), st.floats(1.1, 8))
def test_no_place_inside_the_spiral_lies_further_than_a_turn_from_it(spacing_m: float, turns: float) -> None:
    radius_m = spacing_m * turns
    path = spiral(np.zeros(2), spacing_m, radius_m)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= spacing_m
    legs = itertools.pairwise(path)
    dense = np.concatenate([a + np.linspace(0, 1, 12)[:, None] * (b - a) for a, b in legs])
    angles = np.linspace(0, 2 * np.pi, 25)
    for reach_m in np.linspace(0, max(radius_m - spacing_m, 0), 6):
        ring = reach_m * np.column_stack([np.cos(angles), np.sin(angles)])
        nearest = np.linalg.norm(ring[:, None] - dense, axis=2).min(axis=1)
        assert nearest.max() <= 0.62 * spacing_m  # half a turn, and what the straight legs cut off


def test_spacing_leaves_the_overlap() -> None:
    assert spacing_for(40.0, np.radians(90), overlap=0.25) == pytest.approx(60.0)
    with pytest.raises(ValueError, match="overlap 1 must be"):
        spacing_for(40.0, 1.0, overlap=1)
    with pytest.raises(ValueError, match="spacing 0 m"):
        spiral(np.zeros(2), 0, 10)


def test_presence_opens_at_its_share_of_a_full_buffer_and_closes_well_below() -> None:
    gate = PresenceGate(frames=10, share=0.8)
    assert not any(gate.update(True) for _ in range(7))  # 7 of 10
    assert gate.update(True)
    assert all(gate.update(False) for _ in range(2 + 3))  # down to 5 of 10
    assert not gate.update(False)
    assert not gate.update(True)  # half full is not enough to open again
    gate.reset()
    assert not gate.present
    with pytest.raises(ValueError, match="share 0 in"):
        PresenceGate(10, 0)


def test_single_false_detections_never_open_the_gate() -> None:
    gate = PresenceGate(15, 0.8)
    assert not any(gate.update(k % 2 == 0) for k in range(200))


POD = np.array([[0.0, 0.0], [20.0, 0.0]])
AROUND = np.array([[-30.0, -30.0], [50.0, -30.0], [50.0, 30.0], [-30.0, 30.0]])
FRAME_US = 200_000


def watched(frames: list[np.ndarray], view_ne: np.ndarray, first_us: int = 0) -> Barycentre:
    """A barycentre that has taken the whole pod for four seconds, and then `frames`."""
    barycentre = Barycentre()
    for number, points in enumerate([POD] * 20 + frames):
        view = AROUND if number < 20 else view_ne
        barycentre.update(first_us + number * FRAME_US, points, view, margin_m=5.0)
    return barycentre


def test_the_barycentre_is_the_pods_middle_and_its_radius_reaches_half_a_body_further() -> None:
    barycentre = Barycentre()
    barycentre.update(0, np.zeros((0, 2)))
    assert barycentre.centre_ne is None
    barycentre = watched([], AROUND)
    np.testing.assert_allclose(barycentre.centre_ne, [10, 0], atol=1e-6)
    assert barycentre.radius_m == pytest.approx(15.0, abs=1e-6)


def test_an_animal_that_slips_out_of_the_picture_still_counts_for_20_s() -> None:
    half = np.array([[-30.0, -30.0], [10.0, -30.0], [10.0, 30.0], [-30.0, 30.0]])
    barycentre = watched([POD[:1]] * 90, half)  # 18 s
    np.testing.assert_allclose(barycentre.centre_ne, [10, 0], atol=1e-6)
    barycentre = watched([POD[:1]] * 200, half)
    np.testing.assert_allclose(barycentre.centre_ne, [0, 0], atol=1e-3)


def test_an_animal_that_is_not_where_it_should_be_seen_is_soon_forgotten() -> None:
    barycentre = watched([POD[:1]] * 40, AROUND)
    np.testing.assert_allclose(barycentre.centre_ne, [0, 0], atol=0.1)
    assert 5.0 <= barycentre.radius_m < 12.0, "the radius follows more slowly"


def test_a_false_alarm_moves_neither_the_middle_nor_the_radius() -> None:
    barycentre = watched([np.vstack([POD, [10.0, 25.0]])] + [POD] * 3, AROUND)
    np.testing.assert_allclose(barycentre.centre_ne, [10, 0], atol=1e-6)
    assert barycentre.radius_m == pytest.approx(15.0, abs=1e-6)


@pytest.mark.parametrize("n", [2, 3, 5, 12])
def test_neighbours_on_the_circle_stand_at_their_separation(n: int) -> None:
    places = np.array([slot(k, n, np.array([50.0, 20.0]), 8.0, 40.0) for k in range(n)])
    gaps = np.linalg.norm(places[:, None, :2] - places[None, :, :2], axis=2) + 1e9 * np.eye(n)
    assert gaps.min() == pytest.approx(8.0)
    assert -places[:, 2].min() <= 40.0 * 1.15 + 1e-9
    assert len(np.unique(places[:, 2].round(6))) == min(n, 3)


def test_a_circle_worked_by_hand() -> None:
    assert circle_radius(8.0, 1) == 0.0
    assert circle_radius(8.0, 2) == pytest.approx(4.0)
    np.testing.assert_allclose(slot(1, 4, np.zeros(2), 8.0, 40.0)[:2], [0, 8 / np.sqrt(2)], atol=1e-9)
    # Half the field of view is 30 degrees, 5 are kept for tilt.
    height_m = gather_height(12.0, 4.0, np.radians(60), 10.0, 200.0)
    assert height_m == pytest.approx(16.0 / np.tan(np.radians(25)))
    assert gather_height(1.0, 0.0, np.radians(60), 10.0, 60.0) == 10.0
    assert gather_height(90.0, 4.0, np.radians(60), 10.0, 60.0) * 1.15 == pytest.approx(60.0)
    with pytest.raises(ValueError, match="field of view"):
        gather_height(1.0, 0.0, np.radians(9), 10.0, 60.0)


@pytest.mark.parametrize("n", range(2, 11))
def test_neighbours_on_the_circle_stand_in_different_layers(n: int) -> None:
    heights = [float(slot(rank, n, np.zeros(2), 8.0, 40.0)[2]) for rank in range(n)]
    assert all(abs(heights[rank] - heights[rank - 1]) > 2.9 for rank in range(n))


def test_every_drone_of_the_circle_sees_the_whole_pod_at_five_degrees_of_tilt() -> None:
    n, pod_m = 5, 15.0
    height_m = gather_height(pod_m, circle_radius(8.0, n), CAMERA.vfov_rad, 10.0, 200.0)
    angles = np.linspace(0, 2 * np.pi, 60)
    pod = pod_m * np.column_stack([np.cos(angles), np.sin(angles)])
    for k in range(n):
        n_m, e_m, d_m = slot(k, n, np.zeros(2), 8.0, height_m)
        pose = Pose(n_m, e_m, d_m, pitch_rad=float(np.radians(5)), yaw_rad=1.3 * k)
        pixels = apply_homography(CAMERA.ground_to_image(pose), pod)
        assert ((pixels >= 0) & (pixels <= CAMERA.image_size)).all()


def test_layers_use_the_room_that_there_is() -> None:
    np.testing.assert_allclose(layer_heights(5, 12.0, 80.0), [12, 18, 24, 30, 12])
    np.testing.assert_allclose(layer_heights(3, 12.0, 18.0), [12, 15, 18])
    np.testing.assert_allclose(layer_heights(1, 12.0, 80.0), [12])
    np.testing.assert_allclose(layer_heights(2, 30.0, 20.0), [20, 20])


def fly_apart(
    starts: np.ndarray, goals: np.ndarray, seconds: float = 60.0, age_s: float = 0.4
) -> tuple[float, float]:
    """Fly point masses to their goals with `separate` -> (closest approach, largest distance left)."""
    places, moves, closest = starts.astype(float), np.zeros_like(starts, dtype=float), np.inf
    heard = [(places.copy(), moves.copy())] * round(age_s / 0.1)
    for _ in range(round(seconds / 0.1)):
        heard = [*heard[1:], (places.copy(), moves.copy())]
        old_places, old_moves = heard[0]
        for k in range(len(places)):
            others = [j for j in range(len(places)) if j != k]
            wanted = separate(
                approach(places[k], goals[k], 6.0),
                places[k],
                old_places[others],
                old_moves[others],
                np.full(len(others), age_s),
                5.0,
            )
            moves[k] = limited(wanted, moves[k], places[k], 0.1, LIMITS)
        places = places + 0.1 * moves
        gaps = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e9 * np.eye(len(places))
        closest = min(closest, gaps.min())
    return float(closest), float(np.linalg.norm(places - goals, axis=1).max())


def test_two_drones_that_meet_head_on_pass_each_other() -> None:
    starts = np.array([[0.0, 0, -40], [60, 0, -40]])
    closest_m, left_m = fly_apart(starts, starts[::-1])
    assert closest_m > 4.0
    assert left_m < 1.0


@pytest.mark.parametrize("seed", range(4))
def test_five_drones_with_crossing_ways_keep_clear(seed: int) -> None:
    random = np.random.default_rng(seed)
    angles = np.arange(5) * 2 * np.pi / 5
    ring = np.column_stack([30 * np.cos(angles), 30 * np.sin(angles), np.full(5, -40.0)])
    closest_m, left_m = fly_apart(ring, ring[random.permutation(5)], seconds=90)
    assert closest_m > 3.5
    assert left_m < 2.0


def test_a_drone_far_away_changes_nothing() -> None:
    velocity = np.array([5.0, 0, 0])
    kept = separate(velocity, np.zeros(3), np.array([[80.0, 0, 0]]), np.zeros((1, 3)), np.zeros(1), 5.0)
    np.testing.assert_array_equal(kept, velocity)


def test_an_older_report_of_a_moving_drone_keeps_a_larger_distance() -> None:
    other, move = np.array([[12.0, 0, 0]]), np.array([[0.0, 3.0, 0]])
    fresh = separate(np.array([4.0, 0, 0]), np.zeros(3), other, move, np.zeros(1), 5.0)
    stale = separate(np.array([4.0, 0, 0]), np.zeros(3), other - move * 1.0, move, np.ones(1), 5.0)
    assert stale[0] < fresh[0]


@quick
@given(vectors, vectors, st.tuples(metres, metres, st.floats(-90, -1)))
def test_no_velocity_leaves_the_limits(wanted: tuple, previous: tuple, own: tuple) -> None:
    velocity = limited(np.array(wanted), np.array(previous), np.array(own), 0.1, LIMITS)
    assert np.hypot(velocity[0], velocity[1]) <= LIMITS.speed_m_s + 1e-9
    assert -LIMITS.climb_m_s - 1e-9 <= velocity[2] <= LIMITS.descent_m_s + 1e-9
    if -own[2] > LIMITS.max_height_m:
        assert velocity[2] >= 0
    if -own[2] < LIMITS.min_height_m:
        assert velocity[2] <= 0


@quick
@given(vectors, st.floats(0, 2 * np.pi), st.floats(98, 140))
def test_no_velocity_leads_out_of_the_fence(wanted: tuple, bearing: float, reach_m: float) -> None:
    limits = LimitSettings(fence_radius_m=100.0)
    outward = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    place = reach_m * outward + [0, 0, -30]
    velocity = limited(np.array(wanted), np.array(wanted), place, 0.1, limits)
    assert velocity @ outward <= 1e-5


@quick
@given(metres, metres, st.floats(-200, 50))
def test_goals_are_moved_inside_the_fence(n_m: float, e_m: float, d_m: float) -> None:
    limits = LimitSettings(fence_radius_m=100.0)
    goal = inside_fence(np.array([n_m, e_m, d_m]), limits)
    assert np.hypot(goal[0], goal[1]) <= 97.0 + 1e-9
    assert limits.min_height_m <= -goal[2] <= limits.max_height_m


@quick
@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-3, 3), st.floats(-12, 12), st.floats(-12, 12))
def test_a_pixel_comes_back_to_its_place_on_the_ground(
    roll: float, pitch: float, yaw: float, n_m: float, e_m: float
) -> None:
    pose = Pose(40.0, -7.0, -30.0, roll, pitch, yaw)
    place = np.array([[40.0 + n_m, -7.0 + e_m]])
    pixel = apply_homography(CAMERA.ground_to_image(pose), place)
    np.testing.assert_allclose(ground_points(CAMERA, pose, pixel), place, atol=1e-6)


def test_pixels_over_the_horizon_show_no_ground() -> None:
    level = Pose(0.0, 0.0, -30.0)
    assert len(ground_points(CAMERA, level, np.array([[320.0, 240.0], [0.0, 0.0]]))) == 2
    tipped = Pose(0.0, 0.0, -30.0, pitch_rad=float(np.radians(85)))
    assert len(ground_points(CAMERA, tipped, np.array([[320.0, 0.0]]))) == 0
    assert len(ground_points(CAMERA, Pose(0.0, 0.0, 1.0), np.array([[320.0, 240.0]]))) == 0


def test_the_filter_learns_an_animals_velocity_and_carries_it_over_a_gap() -> None:
    animal = AnimalFilter(max_speed_m_s=4.0)
    random = np.random.default_rng(0)
    velocity = np.array([1.5, -0.5])
    for k in range(200):
        animal.update(1 + k * 50_000, velocity * k * 0.05 + random.normal(0, 0.3, 2))
    np.testing.assert_allclose(animal.velocity_ne, velocity, atol=0.5)
    later = animal.at(1 + 199 * 50_000 + 2_000_000)
    np.testing.assert_allclose(later, velocity * (199 * 0.05 + 2.0), atol=1.3)
    long_after = animal.at(1 + 199 * 50_000 + 60_000_000)
    assert np.linalg.norm(long_after - velocity * 199 * 0.05) < 10


def test_a_jump_of_the_track_does_not_become_a_speed_beyond_the_animals() -> None:
    animal = AnimalFilter(max_speed_m_s=4.0)
    for k in range(100):
        animal.update(1 + k * 50_000, np.array([0.0 if k < 50 else 40.0, 0.0]))
        assert np.linalg.norm(animal.velocity_ne) <= 4.0 + 1e-9


def test_the_servo_stays_over_a_swimming_animal() -> None:
    place, move = np.array([0.0, 0, -40]), np.zeros(3)
    animal, swim = np.array([8.0, 5.0]), np.array([2.0, 0.0])
    for _ in range(200):
        move = limited(servo_velocity(place, animal, swim, 30.0, 8.0), move, place, 0.1, LIMITS)
        place, animal = place + 0.1 * move, animal + 0.1 * swim
    assert np.linalg.norm(place[:2] - animal) < 0.5
    assert place[2] == pytest.approx(-30.0, abs=0.2)
