"""Measures the mask tracker: frames a second of one thread's CPU time, how often its centre is on the animal.

    python -m tools.bench.tracking [--seeds 10] [--pictures 24] [--detector] [--vehicle] [--overlays FOLDER]

Rendered sequences: three whales within a few lengths of each other, swimming and turning, under a drone that
follows late, yaws and tilts; the watched one dives in every third. Photographs: the odd-numbered ones of
right_whales (the tracker was tuned on even-numbered ones and on seeds from 100) under a moving virtual
camera. `--detector` adds a noisy box 0.15 s late at 2 Hz, `--vehicle` the picture's motion from a noisy
attitude. Truth is used for judging only.
"""

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from drivers.sim.render import SPECIES, AnimalView, PictureSurface, SeaRenderer
from procs.tracker.mask_tracker import MaskTracker, Track

__all__ = ["Moment", "Result", "picture_moments", "rendered_moments", "run"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

RATE_HZ = 20.0
CAMERA = Pinhole((640, 480), np.deg2rad(45.0))
DETECTOR_EVERY = 10  # frames: 2 Hz
DETECTOR_LATE = 3  # frames: 0.15 s
CLEARLY_VISIBLE = 0.4  # share of the body in view times its opacity: below this no verdict on the frame


@dataclass(frozen=True)
class Moment:
    """One frame and the truth about it.

    `box` (4,) px of the watched animal, None while it cannot be seen; `others` (K, 4) px.
    """

    image: Image
    pose: Pose
    box: Array | None
    others: Array
    is_clear: bool


@dataclass
class Result:
    """Counts over the clear frames of one sequence after the first."""

    name: str
    clear: int = 0
    inside: int = 0
    on_other: int = 0
    tracking: int = 0
    overlap_sum: float = 0.0
    false_masks: int = (
        0  # frames with a mask that touches no part of the animal's box, or while nothing shows
    )
    times_s: tuple[float, ...] = ()

    @property
    def inside_share(self) -> float:
        return self.inside / max(self.clear, 1)


def _wobble(rng: np.random.Generator, amplitude: float, slow_s: float, quick_s: float) -> Array:
    """Amplitude, angular rate and phase of one slow and one quick swing."""
    periods = rng.uniform([slow_s, quick_s], [2 * slow_s, 2 * quick_s])
    return np.array([[0.7 * amplitude, 0.3 * amplitude], 2 * np.pi / periods, rng.uniform(0, 2 * np.pi, 2)])


def _at(wobble: Array, t_s: float) -> float:
    return float((wobble[0] * np.sin(wobble[1] * t_s + wobble[2])).sum())


def rendered_moments(seed: int, frames: int) -> Iterator[Moment]:
    """A pod of three under a following drone."""
    rng = np.random.default_rng([seed, 7])
    species = sorted(SPECIES)[seed % len(SPECIES)]
    sea = SeaRenderer(
        seed, species=(species,), sea_state=float(rng.uniform(0.5, 3.5)), glint=float(rng.uniform(0, 0.8))
    )
    length_m = rng.uniform(9, 13, 3)
    height_m = float(rng.uniform(25, 100))
    course = float(rng.uniform(0, 2 * np.pi))
    ahead, beside = _directions(np.array([course, course + np.pi / 2]))
    # One swims alongside, flippers touching at times; the other a length or two off.
    at = np.array([[0.0, 0.0], rng.uniform([-0.6, 0.26], [0.6, 0.5]), rng.uniform([-1, -1.4], [1, -0.6])])
    at = length_m[0] * at @ np.stack([ahead, beside])
    heading = course + rng.normal(0, 0.06, 3)
    turn, own_turns = _wobble(rng, 0.25, 6, 3), [_wobble(rng, 0.04, 4, 2) for _ in range(3)]
    speed = rng.uniform(0.8, 2.0) + rng.normal(0, 0.15, 3)
    roll, pitch, yaw = (_wobble(rng, a, 4, 1.2) for a in (0.08, 0.08, 0.9))
    climb = _wobble(rng, 0.15 * height_m, 8, 5)
    camera_ne = at[0] + rng.normal(0, 2, 2)
    dives = seed % 3 == 2
    for frame in range(frames):
        t_s = frame / RATE_HZ
        heading = heading + np.array([_at(turn, t_s) + _at(own, t_s) for own in own_turns]) / RATE_HZ
        at = at + speed[:, None] * _directions(heading) / RATE_HZ
        camera_ne = camera_ne + (at[0] - camera_ne) * 0.03
        depth = np.array([_dive_depth(t_s) if dives else 0.0, 0.3, 0.0])
        animals = [
            AnimalView(i, at[i, 0], at[i, 1], heading[i], length_m[i], species, depth[i], 2 * t_s + i)
            for i in range(3)
        ]
        pose = Pose(
            camera_ne[0],
            camera_ne[1],
            -height_m - _at(climb, t_s),
            _at(roll, t_s),
            _at(pitch, t_s),
            _at(yaw, t_s),
        )
        labels = sea.labels(CAMERA, pose, animals)
        watched = labels.ids == 0
        boxes = labels.boxes.astype(np.float64)
        visible = float(labels.visible[watched][0]) if watched.any() else 0.0
        yield Moment(
            sea.render(CAMERA, pose, t_s, animals),
            pose,
            boxes[watched][0] if watched.any() else None,
            boxes[~watched],
            visible > CLEARLY_VISIBLE,
        )


def _directions(angles_rad: Array) -> Array:
    return np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)


def _dive_depth(t_s: float) -> float:
    """Down from 4 s, away at 5 s, up again between 6.2 and 7.2 s."""
    return float(5 * np.clip(min(t_s - 4, 7.2 - t_s), 0, 1))


def picture_moments(picture: Path, seed: int, frames: int) -> Iterator[Moment]:
    """A photograph under a moving virtual camera; its label is the truth."""
    rng = np.random.default_rng([seed, 8])
    image = np.asarray(cv2.imread(str(picture)), dtype=np.uint8)
    rows = np.loadtxt(picture.parents[1] / "labels" / f"{picture.stem}.txt", ndmin=2)
    size = np.array([image.shape[1], image.shape[0]])
    box = np.concatenate([(rows[0, 1:3] - rows[0, 3:] / 2) * size, (rows[0, 1:3] + rows[0, 3:] / 2) * size])
    surface = PictureSurface(image, width_m=40.0)
    to_ground = surface.picture_to_ground()
    corners = apply_homography(to_ground, box[[[0, 1], [2, 1], [2, 3], [0, 3]]])
    swings = [_wobble(rng, a, 4, 1.2) for a in (0.05, 0.05, 0.35)]
    drift = [_wobble(rng, 3.0, 4, 2) for _ in range(2)]
    climb = _wobble(rng, 5.0, 6, 4)
    # The camera keeps to the picture: outside it lies a flat colour, whose edge is no part of any sea.
    aim = 0.6 * corners.mean(axis=0)
    for frame in range(frames):
        t_s = frame / RATE_HZ
        pose = Pose(
            aim[0] + _at(drift[0], t_s),
            aim[1] + _at(drift[1], t_s),
            -27.0 - _at(climb, t_s),
            *(_at(swing, t_s) for swing in swings),
        )
        seen = apply_homography(CAMERA.ground_to_image(pose), corners)
        whole = np.concatenate([seen.min(axis=0), seen.max(axis=0)])
        limit = np.array(CAMERA.image_size, dtype=np.float64)
        clipped = np.concatenate([np.clip(whole[:2], 0, limit), np.clip(whole[2:], 0, limit)])
        share = float(np.prod(clipped[2:] - clipped[:2]) / np.prod(whole[2:] - whole[:2]))
        yield Moment(
            surface.render(CAMERA, pose, t_s),
            pose,
            clipped if share > 0.05 else None,
            np.zeros((0, 4)),
            share > CLEARLY_VISIBLE,
        )


def run(
    name: str,
    moments: Iterator[Moment],
    rng: np.random.Generator,
    *,
    detector: bool = False,
    vehicle: bool = False,
    overlays: Path | None = None,
) -> Result:
    """Track one sequence and judge it."""
    result = Result(name)
    past: list[Moment] = []
    times: list[float] = []
    tracker = MaskTracker()
    track: Track | None = None
    for frame, moment in enumerate(moments):
        if track is None:
            if moment.box is None:
                break
            track = tracker.start(
                moment.image, (moment.box[:2] + moment.box[2:]) / 2, moment.box, moment.others
            )
            past.append(moment)
            continue
        given: dict[str, object] = {}
        if detector and frame % DETECTOR_EVERY == 0 and frame >= DETECTOR_LATE:
            given = _detected(past[-DETECTOR_LATE], rng)
        if vehicle:
            given["image_motion"] = _felt_motion(past[-1].pose, moment.pose, rng)
        begun = time.thread_time()
        track = tracker.update(moment.image, 1 / RATE_HZ, **given)  # type: ignore[arg-type]
        times.append(time.thread_time() - begun)
        _judge(result, moment, track)
        if overlays is not None and frame % 20 == 0:
            _draw(overlays / f"{name}_{frame:03d}.png", moment, track)
        past.append(moment)
    result.times_s = tuple(times)
    return result


def _detected(moment: Moment, rng: np.random.Generator) -> dict[str, object]:
    """What a detector of modest quality would have said of a frame that is 0.15 s old."""
    if not moment.is_clear or moment.box is None or rng.random() < 0.2:
        return {}
    size = np.tile(moment.box[2:] - moment.box[:2], 2)
    boxes = moment.box + rng.normal(0, 0.05, 4) * size
    others = moment.others + rng.normal(0, 2.0, moment.others.shape)
    others = others[((others[:, 2:] - others[:, :2]) > 4).all(axis=1)]
    return {"boxes": boxes[None], "companions": others, "boxes_age_s": DETECTOR_LATE / RATE_HZ}


def _felt_motion(before: Pose, now: Pose, rng: np.random.Generator) -> Array:
    """The picture's motion from poses whose attitude errs by 0.1 degrees from frame to frame."""
    error = rng.normal(0, np.deg2rad(0.1), 3)
    felt = Pose(
        now.n_m,
        now.e_m,
        now.d_m,
        now.roll_rad + error[0],
        now.pitch_rad + error[1],
        now.yaw_rad + error[2],
    )
    return CAMERA.ground_to_image(felt) @ CAMERA.image_to_ground(before)


def _judge(result: Result, moment: Moment, track: Track) -> None:
    has_mask = bool(track.mask.any())
    if moment.box is None:
        result.false_masks += has_mask
        return
    left, top, right, bottom = np.round(moment.box).astype(int)
    result.false_masks += has_mask and not track.mask[top:bottom, left:right].any()
    if not moment.is_clear:
        return
    result.clear += 1
    result.tracking += track.state == "tracking"
    inside = _holds(moment.box, track.centre)
    result.inside += inside
    result.on_other += not inside and any(_holds(other, track.centre) for other in moment.others)
    result.overlap_sum += _overlap(moment.box, track.box) if has_mask else 0.0


def _holds(box: Array, point: Array) -> bool:
    return bool((point >= box[:2]).all() and (point <= box[2:]).all())


def _overlap(a: Array, b: Array) -> float:
    common = float(np.prod(np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0)))
    return common / (float(np.prod(a[2:] - a[:2])) + float(np.prod(b[2:] - b[:2])) - common)


def _draw(path: Path, moment: Moment, track: Track) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = moment.image.copy()
    if moment.box is not None:
        _rectangle(picture, moment.box, (0, 0, 255))
    for other in moment.others:
        _rectangle(picture, other, (160, 160, 160))
    if len(track.outline):
        cv2.polylines(picture, [track.outline.astype(np.int32).reshape(-1, 1, 2)], True, (0, 255, 255), 1)
    _rectangle(picture, track.box, (0, 255, 0) if track.state == "tracking" else (255, 0, 255))
    cv2.circle(picture, tuple(np.round(track.centre).astype(int).tolist()), 3, (0, 255, 0), -1)
    text = f"{path.stem} {track.state} {track.score:.2f}"
    cv2.putText(picture, text, (5, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1)
    cv2.imwrite(str(path), picture)


def _rectangle(picture: Image, box: Array, colour: tuple[int, int, int]) -> None:
    left, top, right, bottom = np.round(box).astype(int).tolist()
    cv2.rectangle(picture, (left, top), (right, bottom), colour, 1)


def _print(title: str, results: list[Result]) -> None:
    if not results:
        print(f"{title:<12} MISSING")
        return
    times = np.concatenate([result.times_s for result in results])
    clear = sum(result.clear for result in results)
    whole = sum(result.inside_share > 0.95 for result in results)
    print(
        f"{title:<12} n {len(results):3d} sequences, {clear} clear frames | centre inside the true box "
        f"{sum(r.inside for r in results) / max(clear, 1):.3f} (over 0.95 in {whole}) | tracking "
        f"{sum(r.tracking for r in results) / max(clear, 1):.3f} | box IoU "
        f"{sum(r.overlap_sum for r in results) / max(clear, 1):.3f} | on another animal "
        f"{sum(r.on_other for r in results) / max(clear, 1):.3f} | false masks "
        f"{sum(r.false_masks for r in results)} | {1 / times.mean():.0f} frames/s, p99 "
        f"{1e3 * np.quantile(times, 0.99):.1f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=10, help="rendered sequences")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--pictures", type=int, default=24, help="photographs, if ../shared/data is there")
    parser.add_argument("--even", action="store_true", help="the photographs that it was tuned on")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--detector", action="store_true", help="late noisy boxes at 2 Hz")
    parser.add_argument("--vehicle", action="store_true", help="the picture's motion from noisy attitude")
    parser.add_argument("--each", action="store_true", help="a line for every sequence")
    parser.add_argument("--overlays", type=Path, help="folder for pictures, every 20th frame")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    data = Path(os.environ.get("PODWATCH_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
    pictures = sorted((data / "right_whales" / "images").glob("*.jpg"), key=lambda p: int(p.stem[2:]))
    pictures = [p for p in pictures if int(p.stem[2:]) % 2 == (0 if given.even else 1)][: given.pictures]
    sequences: list[tuple[str, list[tuple[str, int, Path | None]]]] = [
        (
            "rendered",
            [(f"sea_{s}", s, None) for s in range(given.first_seed, given.first_seed + given.seeds)],
        ),
        ("photographs", [(p.stem, i, p) for i, p in enumerate(pictures)]),
    ]
    for title, rows in sequences:
        results: list[Result] = []
        for name, seed, picture in rows:
            moments = (
                rendered_moments(seed, given.frames)
                if picture is None
                else picture_moments(picture, seed, given.frames)
            )
            result = run(
                name,
                moments,
                np.random.default_rng([seed, 9]),
                detector=given.detector,
                vehicle=given.vehicle,
                overlays=given.overlays,
            )
            results.append(result)
            if given.each:
                _print(name, [result])
        _print(title, results)


if __name__ == "__main__":
    main()
