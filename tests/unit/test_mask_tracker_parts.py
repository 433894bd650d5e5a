"""Hand-worked cases for the tracker's parts: ellipse, window, camera motion, filter, claims."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from procs.tracker._appearance import Appearance
from procs.tracker._body import Body, body_of_box, body_of_weights
from procs.tracker._camera_motion import CameraMotion
from procs.tracker._motion import Motion
from procs.tracker._pod import claimed_by, followed, refreshed, settle
from procs.tracker._sight import likeness, locate, outline_of, segment
from procs.tracker._window import window_round

CLOSED = (False, False, False, False)


def evidence_of(*bodies: Body, size: tuple[int, int] = (120, 100)) -> np.ndarray:
    """+0.8 in the bodies, -0.8 in the water."""
    inside = np.min([body.radius(size) for body in bodies], axis=0) < 1
    return np.where(inside, 0.8, -0.8).astype(np.float32)


def test_a_box_becomes_the_ellipse_that_it_holds() -> None:
    body = body_of_box(np.array([10.0, 20, 30, 80]))
    assert body.centre.tolist() == [20, 50]
    assert (body.length_px, body.width_px) == (60, 20)
    assert np.allclose(body.box, [10, 20, 30, 80])
    assert body.area_px == pytest.approx(np.pi * 10 * 30)


@given(
    angle=st.floats(-1.5, 1.5),
    length=st.floats(40, 80),
    flatness=st.floats(0.25, 0.7),
    u=st.floats(50, 70),
    v=st.floats(45, 55),
)
@settings(deadline=None, max_examples=30)
def test_moments_of_an_ellipse_give_the_ellipse_back(
    angle: float, length: float, flatness: float, u: float, v: float
) -> None:
    body = Body(np.array([u, v]), length, flatness * length, angle)
    seen = body_of_weights((body.radius((120, 100)) < 1).astype(np.float32), angle)
    assert seen is not None
    assert np.allclose(seen.centre, body.centre, atol=0.5)
    assert seen.length_px == pytest.approx(length, rel=0.06)
    assert seen.width_px == pytest.approx(flatness * length, rel=0.1)
    assert abs(seen.angle_rad - angle) < 0.1


def test_a_direction_is_known_modulo_pi_and_stays_near_the_last_one() -> None:
    upright = Body(np.array([60.0, 50]), 60, 15, np.pi / 2).radius((120, 100)) < 1
    for last in (1.4, -1.4, 4.5):
        seen = body_of_weights(upright.astype(np.float32), last)
        assert seen is not None
        assert abs(seen.angle_rad - last) < 0.4


def test_a_body_goes_through_a_turn_and_a_zoom() -> None:
    quarter = np.array([[0.0, -2, 100], [2, 0, 0], [0, 0, 1]])
    body = Body(np.array([10.0, 5]), 20, 8, 0.0).through(quarter)
    assert np.allclose(body.centre, [90, 20])
    assert (body.length_px, body.width_px) == (pytest.approx(40), pytest.approx(16))
    assert body.angle_rad == pytest.approx(np.pi / 2)


def test_a_window_is_clipped_and_maps_points_both_ways() -> None:
    window = window_round(np.array([10.0, 200]), 100.0, 0.5, (480, 640))
    assert window is not None
    assert (window.left, window.top, window.right) == (0, 100, 111)
    points = np.array([[3.0, 150], [90, 250]])
    assert np.allclose(window.to_frame(window.to_window(points)), points)
    assert window.open_edges((480, 640)) == (True, False, False, False)
    assert window_round(np.array([-300.0, 200]), 100.0, 0.5, (480, 640)) is None


def test_a_window_mask_lands_where_it_was_cut() -> None:
    window = window_round(np.array([300.0, 200]), 60.0, 0.5, (480, 640))
    assert window is not None
    part = np.zeros((window.size[1], window.size[0]), dtype=bool)
    part[20:40, 10:30] = True
    whole = window.paste(part, (480, 640))
    rows, columns = np.nonzero(whole)
    corners = window.to_frame(np.array([[10.0, 20], [30, 40]]))
    assert np.allclose([columns.min(), rows.min()], corners[0], atol=2)
    assert np.allclose([columns.max() + 1, rows.max() + 1], corners[1], atol=2)


def test_colours_tell_an_animal_from_water_that_is_hardly_lighter() -> None:
    rng = np.random.default_rng(3)
    body = Body(np.array([60.0, 50]), 60, 18, 0.4)
    inside = body.radius((120, 100)) < 1
    lab = rng.normal(60, 4, (100, 120, 3)) - 7 * inside[..., None]
    lab = lab.clip(0, 255).astype(np.uint8)
    prior = np.where(body.radius((120, 100)) < 1.5, 0.5, 0).astype(np.float32)
    evidence = Appearance(lab, prior, prior == 0).evidence(lab)
    assert evidence[inside].mean() > 0.4
    assert evidence[body.radius((120, 100)) > 1.3].mean() < -0.3


def test_a_change_of_exposure_is_followed() -> None:
    rng = np.random.default_rng(3)
    inside = Body(np.array([60.0, 50]), 60, 18, 0.4).radius((120, 100)) < 1
    lab = (rng.normal(120, 4, (100, 120, 3)) - 30 * inside[..., None]).astype(np.uint8)
    prior = np.where(inside, 0.7, 0).astype(np.float32)
    model = Appearance(lab, prior, ~inside)
    brighter = (lab + 25).astype(np.uint8)
    assert model.evidence(brighter)[inside].mean() < 0.2
    for _ in range(20):
        model.follow_water(brighter, ~inside, 0.2)
    assert model.evidence(brighter)[inside].mean() > 0.8


def test_the_ellipse_settles_on_the_evidence_not_beyond_its_search() -> None:
    true = Body(np.array([70.0, 55]), 50, 16, 0.5)
    guess = Body(np.array([62.0, 50]), 50, 16, 0.5)
    evidence = evidence_of(true)
    assert np.allclose(locate(evidence, guess, 20.0), true.centre, atol=2)
    assert np.hypot(*(locate(evidence, guess, 4.0) - guess.centre)) <= 4.0


def test_pixels_nearer_to_a_neighbour_are_the_neighbours() -> None:
    own, other = Body(np.array([60.0, 42]), 60, 16, 0.0), Body(np.array([60.0, 58]), 60, 16, 0.0)
    evidence = evidence_of(own, other)
    alone = segment(evidence, own, np.zeros(evidence.shape, dtype=bool), CLOSED)
    shared = segment(evidence, own, claimed_by([other], own.radius((120, 100)), outright=False), CLOSED)
    assert alone is not None
    assert shared is not None
    assert alone.mask[56].any()
    assert not shared.mask[52:].any()
    assert shared.area_ratio == pytest.approx(1.0, abs=0.1)


def test_claims_outright_leave_nothing_under_a_neighbour() -> None:
    own = Body(np.array([60.0, 50]), 60, 16, 0.0)
    claimed = claimed_by([own], own.radius((120, 100)), outright=True)
    assert segment(evidence_of(own), own, claimed, CLOSED) is None


def test_crossed_boxes_are_told_apart_by_their_slant() -> None:
    bodies = [Body(np.array([50.0, 50]), 60, 14, 0.8), Body(np.array([72.0, 50]), 60, 14, 0.8)]
    guesses = [body_of_box(body.box) for body in bodies]
    settled = settle(evidence_of(*bodies), guesses, [body.box for body in bodies])
    for body, seen in zip(bodies, settled, strict=True):
        assert np.allclose(seen.centre, body.centre, atol=3)
        assert abs(seen.angle_rad % np.pi - 0.8) < 0.15


def test_a_neighbour_is_followed_and_left_alone_where_it_dived() -> None:
    moved, guess = Body(np.array([64.0, 52]), 50, 16, 0.2), Body(np.array([58.0, 50]), 50, 16, 0.0)
    seen = followed(evidence_of(moved), guess, [])
    assert seen is not None
    assert np.hypot(*(seen.centre - moved.centre)) < 0.5 * np.hypot(*(guess.centre - moved.centre))
    assert followed(np.full((100, 120), -0.8, np.float32), guess, []) is None


def test_a_fresh_box_keeps_the_known_slant() -> None:
    known = Body(np.array([50.0, 50]), 60, 14, 0.8)
    fresh = body_of_box(known.box + 3)
    (kept,) = refreshed([known], [fresh])
    assert kept.angle_rad == 0.8
    assert np.allclose(kept.centre, [53, 53])


@pytest.mark.parametrize("angle", [0.0, 0.04, -0.06])
def test_camera_motion_is_measured_in_the_picture(angle: float) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    picture = np.asarray(cv2.GaussianBlur(noise, (0, 0), 5), dtype=np.uint8)
    c, s = np.cos(angle), np.sin(angle)
    true = np.array([[c, -s, 9.0], [s, c, -6.0], [0, 0, 1]])
    # Pixel i covers i..i+1, so the warp of the centres is moved by half a pixel.
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    moved = cv2.warpPerspective(
        picture, np.linalg.inv(half) @ true @ half, (640, 480), borderMode=cv2.BORDER_REFLECT
    )
    camera = CameraMotion()
    assert np.array_equal(camera.between(picture), np.eye(3))
    seen = camera.between(np.asarray(moved, dtype=np.uint8))
    points = np.array([[320.0, 240, 1], [100, 100, 1], [600, 50, 1]]).T
    assert np.abs((seen @ points - true @ points)[:2]).max() < 1.0
    assert np.array_equal(camera.between(np.zeros_like(picture)), np.eye(3))


def test_a_late_box_is_carried_with_camera_and_animal() -> None:
    motion = Motion(np.array([100.0, 100]))
    pan = np.array([[1.0, 0, 10], [0, 1, 0], [0, 0, 1]])
    for _ in range(3):
        motion.predict(0.05, pan, True)
        motion.correct(motion.centre + np.array([0, 2 / 0.7]), 0.05)
        motion.velocity_px_s = np.zeros(2)
        motion.remember()
    # Three frames ago at 100, 100; since then 30 px of camera and 6 px of its own.
    assert np.allclose(motion.centre, [130, 106])
    assert np.allclose(motion.carried(np.array([90.0, 90, 110, 110]), 0.15), [120, 96, 140, 116])
    assert np.allclose(motion.carried(np.array([90.0, 90, 110, 110]), 0.0), [90, 90, 110, 110])


def test_an_unseen_velocity_dies() -> None:
    motion = Motion(np.array([0.0, 0]))
    motion.velocity_px_s = np.array([100.0, 0])
    for _ in range(200):
        motion.predict(0.05, None, False)
    assert 60 < motion.centre[0] < 90


def test_likeness_knows_head_from_tail_only_when_asked() -> None:
    patch = np.linspace(0, 1, 60, dtype=np.float32).reshape(6, 10)
    assert likeness(patch, patch) == pytest.approx(1)
    assert likeness(patch[::-1, ::-1], patch) == pytest.approx(-1)
    assert likeness(patch[::-1, ::-1], patch, either_way=True) == pytest.approx(1)
    assert likeness(np.zeros_like(patch), patch) == 0


def test_an_outline_has_few_enough_corners() -> None:
    rng = np.random.default_rng(2)
    ragged = rng.random((100, 100)) > 0.35
    assert 3 <= len(outline_of(ragged, 64)) <= 64
    assert outline_of(np.zeros((5, 5), dtype=bool), 64).shape == (0, 2)
