"""Keeps the mask of one animal from frame to frame, without a neural network.

It is the paper's execution step: a mask from the centre of the assigned box, propagated at 20 Hz or more.

Each frame is looked at in a window round the predicted place, at reduced resolution where the animal is
large:
1. two colour models, animal and water, say for each pixel how surely it is the animal's;
2. an ellipse of the animal's size slides over that evidence and settles where it stands out most from its
ring;
3. evidence and ellipse give the mask; pixels nearer to another animal's ellipse are that animal's;
4. how far the mask stands out, its area and its likeness to the first look give the score.

docs/tracking.md explains the choices.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from procs.tracker._body import Body, body_of_box
from procs.tracker._camera_motion import CameraMotion
from procs.tracker._checks import (
    check_boxes,
    check_companions,
    check_dt,
    check_image,
    check_model,
    check_motion,
    check_point,
)
from procs.tracker._first_look import Companion, FirstLook, first_look, in_frame
from procs.tracker._look import Look, Reference, find_again, look_for_companion, take_look
from procs.tracker._motion import Motion
from procs.tracker._pod import refreshed
from procs.tracker._sight import Sight, outline_of
from procs.tracker._window import Window

__all__ = ["MaskTracker", "Track"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

LOST_AFTER_S = 2.0  # unseen for this long, the prediction is worth nothing
KEEP_SCORE = 0.3  # a tracked animal is seen at this score or above ...
REGAIN_SCORE = 0.45  # ... one that went unseen needs more ...
CONFIRM_FRAMES = 3  # ... and a lost one must be found so many times running
SEARCH_SHARE = 0.4  # of the body's length: an animal moves this far in a frame at most ...
SEARCH_LEAST_PX = 24.0  # ... and a gust moves the picture by this much
SEARCH_GROWTH = 0.6  # body lengths a second that the search widens while unseen
SIZE_RATE = 0.05  # share of the seen size taken over a frame
SIZE_STEP = 0.012  # a body grows or shrinks by this share a frame at most; a flood grows faster
TURN_RATE = 0.5  # share of the seen direction taken over a frame
LEARN_SCORE = 0.6  # the models learn only from looks this good
LEARN_EVERY = 3  # frames
LEARN_RATE = 0.03
COMPANION_EVERY = 3  # frames: a third of the rate holds the others, which only have to be told apart
WATER_RATE = 0.2  # the water's colour follows the camera's exposure within a second
LEAST_OVERLAP = 0.35  # of box and body: below this the detection contradicts the mask
STRIKES = 2  # detections running that contradict the mask before they are believed
OUTLINE_MOST = 64  # corners, what track_t carries


@dataclass(frozen=True)
class Track:
    """The animal in one frame.

    `mask` (height, width) bool, empty unless `state` is "tracking"; `centre` (2,) px (u, v), the mask's
    centre or the predicted one, which may lie outside the image; `box` (4,) px left, top, right, bottom;
    `state` "tracking", "predicted" (unseen for under 2 s) or "lost"; `score` 0-1; `outline` (<= 64, 2) int
    px; `unseen_s` since it was last really seen.
    """

    mask: NDArray[np.bool_]
    centre: Array
    box: Array
    state: str
    score: float
    outline: NDArray[np.int_]
    unseen_s: float


class MaskTracker:
    """Tracks one animal: `start` on its box, then `update` with each frame."""

    def __init__(self, model_path: str | Path | None = None) -> None:
        """`model_path` must be None: ValueError for a path that does not exist, or for a model, which is not
        supported.
        """
        check_model(model_path)
        self.reset()

    def reset(self) -> None:
        """Forget the animal."""
        self._shape: tuple[int, int] | None = None
        self._reference: Reference | None = None

    def start(
        self, image_bgr: Image, point: ArrayLike, box: ArrayLike | None = None, companions: ArrayLike = ()
    ) -> Track:
        """Begin on the animal at `point` (2,) px, the centre of its box (paper, Execution).

        `image_bgr` (height, width, 3) uint8; `box` (4,) px if known; `companions` (K, 4) boxes or (K, 2)
        points of the other animals in view, whose pixels are not this one's. The state is "predicted" where
        nothing stands out from the water at the point. Raises ValueError on a bad image, point or box.
        """
        image = check_image(image_bgr, None)
        shape = (image.shape[0], image.shape[1])
        at = check_point(point, shape)
        own_box = None if box is None else check_boxes(np.asarray(box, dtype=np.float64)[None], "box")[0]
        others = check_companions(companions)
        self._shape, self._reference = shape, None
        self._state, self._score, self._unseen_s = "predicted", 0.0, 0.0
        self._frames = self._strikes = self._found_running = 0
        guess = own_box
        if guess is None:
            guess = np.concatenate([at, at]) + 0.1 * shape[0] * np.array([-1, -1, 1, 1])
        self._body = replace(body_of_box(guess), centre=at)
        self._motion = Motion(at)
        self._camera = CameraMotion()
        self._camera.between(image)
        companions_there = self._as_companions(others, 0.0)
        self._companions = [other.body for other in companions_there]
        first = first_look(image, at, own_box, companions_there)
        if first is None:
            return self._unseen_track()
        return self._adopt(first)

    def update(
        self,
        image_bgr: Image,
        dt_s: float = 0.05,
        *,
        boxes: ArrayLike | None = None,
        boxes_age_s: float = 0.0,
        companions: ArrayLike | None = None,
        image_motion: ArrayLike | None = None,
    ) -> Track:
        """Follow the animal into the next frame.

        `dt_s` since the frame before; `boxes` (K, 4) px, the detector's fresh boxes of this very animal, seen
        `boxes_age_s` before this frame; `companions` (K, 4) or (K, 2), fresh places of the others, of the
        same age (None: carry the known ones on); `image_motion` (3, 3) homography, pixels of the last frame
        to pixels of this one, from the vehicle's own motion. Raises ValueError on bad input, RuntimeError
        before `start`.
        """
        if self._shape is None:
            raise RuntimeError("update() before start(): give the tracker its animal first")
        image = check_image(image_bgr, self._shape)
        dt = check_dt(dt_s)
        camera = check_motion(image_motion, self._shape)
        heard = check_boxes(boxes)
        others = None if companions is None else check_companions(companions)
        if camera is None:
            camera = self._camera.between(image)
        else:
            self._camera.forget()
        self._predict(dt, camera)
        fresh = None if others is None else self._as_companions(others, boxes_age_s)
        if fresh is not None:
            self._companions = refreshed(self._companions, [other.body for other in fresh])
        retaken = self._hear(image, heard, boxes_age_s, fresh) if len(heard) else None
        track = retaken if retaken is not None else self._see(image, dt)
        self._motion.remember()
        return track

    def _predict(self, dt_s: float, camera: Array) -> None:
        self._frames += 1
        self._motion.predict(dt_s, camera, self._state == "tracking")
        self._body = replace(self._body.through(camera), centre=self._motion.centre)
        self._companions = [other.through(camera) for other in self._companions]

    def _as_companions(self, places: Array, age_s: float) -> list[Companion]:
        """Boxes (K, 4) or points (K, 2) of other animals with first ellipses; a point gets this animal's
        size.
        """
        if places.shape[1] == 4:
            carried = [self._motion.carried(box, age_s) for box in places]
            return [Companion(body_of_box(box), box) for box in carried]
        side = float(np.sqrt(self._body.length_px * self._body.width_px))
        return [Companion(Body(point, side, side, 0.0), None) for point in places]

    def _hear(self, image: Image, boxes: Array, age_s: float, fresh: list[Companion] | None) -> Track | None:
        """Weigh the detector's boxes against the mask; the new track where they win, else None."""
        carried = np.array([self._motion.carried(box, age_s) for box in boxes])
        centres = (carried[:, :2] + carried[:, 2:]) / 2
        nearest = int(np.argmin(np.hypot(*(centres - self._body.centre).T)))
        box, centre = carried[nearest], centres[nearest]
        agrees = _overlap(box, self._body.box) > LEAST_OVERLAP
        if agrees and self._state == "tracking":
            self._strikes = 0
            # Boxes are loose: only a size that is far off is drawn towards theirs.
            factor = float(
                np.sqrt(np.prod(box[2:] - box[:2]) / np.prod(self._body.box[2:] - self._body.box[:2]))
            )
            if not 0.75 < factor < 1.45:
                self._body = self._body.scaled(factor**0.2)
            return None
        self._strikes += 1
        if self._state == "tracking" and self._strikes < STRIKES:
            return None
        height, width = image.shape[:2]
        inside = np.clip(centre, 0, [width - 1, height - 1])
        others = fresh if fresh is not None else [Companion(other, None) for other in self._companions]
        first = first_look(image, inside, box, others)
        if first is not None:
            return self._adopt(first)
        if self._state != "tracking":
            self._motion.jump(centre)
            self._body = replace(self._body, centre=centre)
        return None

    def _adopt(self, first: FirstLook) -> Track:
        """Take a first look for what is really there."""
        if self._reference is None or self._state == "lost" or not self._near(first.body):
            self._motion.jump(first.body.centre)
        else:
            self._motion.centre = first.body.centre
        self._body, self._companions = first.body, first.companions
        self._reference = Reference.of(first)
        self._state, self._score, self._unseen_s = "tracking", 1.0, 0.0
        self._strikes = self._found_running = 0
        return self._seen_track(first.window, first.sight)

    def _near(self, body: Body) -> bool:
        return bool(np.hypot(*(body.centre - self._motion.centre)) < self._body.length_px)

    def _see(self, image: Image, dt_s: float) -> Track:
        """Look, judge, and move the state on."""
        look = self._find(image)
        least = KEEP_SCORE if self._state == "tracking" else REGAIN_SCORE
        self._follow_companion(image)
        if look is None or look.sight is None or look.score < least:
            self._found_running = 0
            self._score = 0.0 if look is None else look.score
            self._unseen_s += dt_s
            if self._unseen_s >= LOST_AFTER_S:
                self._state = "lost"
            elif self._state == "tracking":
                self._state = "predicted"
            return self._unseen_track()
        self._score = look.score
        self._take_in(look, look.sight, dt_s)
        if self._state == "lost":
            self._unseen_s += dt_s
            self._found_running += 1
            if self._found_running < CONFIRM_FRAMES:
                return self._unseen_track()
        self._state, self._unseen_s, self._found_running = "tracking", 0.0, 0
        return self._seen_track(look.window, look.sight)

    def _find(self, image: Image) -> Look | None:
        """Look round the prediction; a lost animal, in the whole frame."""
        reference = self._reference
        if reference is None:
            return None
        search = max(SEARCH_LEAST_PX, SEARCH_SHARE * self._body.length_px)
        if self._state == "lost" and not self._found_running:
            found = find_again(image, reference, self._body, self._companions)
            if found is None:
                return None
            self._motion.jump(found.centre)
            self._body = found
        elif self._state != "lost":
            search += SEARCH_GROWTH * self._unseen_s * self._body.length_px
        is_guess = self._state != "tracking"
        return take_look(image, reference, self._body, self._companions, search, is_guess=is_guess)

    def _follow_companion(self, image: Image) -> None:
        """Look for one of the others, each in its turn and none more often than every third frame."""
        turn = self._frames % max(COMPANION_EVERY, len(self._companions))
        if self._reference is None or turn >= len(self._companions):
            return
        rivals = [self._body, *self._companions[:turn], *self._companions[turn + 1 :]]
        moved = look_for_companion(image, self._reference, self._companions[turn], rivals)
        if moved is not None:
            self._companions[turn] = moved

    def _take_in(self, look: Look, sight: Sight, dt_s: float) -> None:
        """Place, size, direction and models after a look that counts."""
        seen = in_frame(sight.body, look.window)
        if sight.cut_by_edge:
            self._motion.correct(in_frame(look.located, look.window).centre, dt_s)
        else:
            self._motion.correct(seen.centre, dt_s)
            self._body = _eased(self._body, seen)
        self._body = replace(self._body, centre=self._motion.centre)
        if self._reference is not None and not self._frames % LEARN_EVERY and self._score >= LEARN_SCORE:
            _learn(self._reference, look, sight)

    def _seen_track(self, window: Window, sight: Sight) -> Track:
        assert self._shape is not None
        columns = np.flatnonzero(sight.mask.any(axis=0))
        rows = np.flatnonzero(sight.mask.any(axis=1))
        corners = np.array([[columns[0], rows[0]], [columns[-1] + 1, rows[-1] + 1]], dtype=np.float64)
        centre = in_frame(sight.body, window).centre if sight.cut_by_edge else self._motion.centre
        return Track(
            window.paste(sight.mask, self._shape),
            centre.copy(),
            window.to_frame(corners).ravel(),
            self._state,
            self._score,
            np.round(window.to_frame(outline_of(sight.mask, OUTLINE_MOST) + 0.5)).astype(np.int_),
            self._unseen_s,
        )

    def _unseen_track(self) -> Track:
        assert self._shape is not None
        return Track(
            np.zeros(self._shape, dtype=np.bool_),
            self._body.centre.copy(),
            self._body.box,
            self._state,
            self._score,
            np.zeros((0, 2), dtype=np.int_),
            self._unseen_s,
        )


def _eased(body: Body, seen: Body) -> Body:
    """The body with a little of the seen size and more of the seen direction."""

    def towards(old: float, new: float) -> float:
        return old * float(np.clip((new / old) ** SIZE_RATE, 1 - SIZE_STEP, 1 + SIZE_STEP))

    turn = TURN_RATE * (seen.angle_rad - body.angle_rad) if seen.length_px > 1.2 * seen.width_px else 0.0
    return Body(
        body.centre,
        towards(body.length_px, seen.length_px),
        towards(body.width_px, seen.width_px),
        body.angle_rad + turn,
    )


def _learn(reference: Reference, look: Look, sight: Sight) -> None:
    """Move the colour models, the template and the expectations a little towards a good look."""
    radius = sight.body.radius(look.window.size)
    outside = (radius > 1.5) & ~sight.mask
    for other in look.others:
        outside &= other.radius(look.window.size) > 1.4
    if int(outside.sum()) < 64:
        return
    inside = sight.mask & (radius < 1.1)
    reference.appearance.follow_water(look.lab, outside, WATER_RATE)
    reference.appearance.adapt(look.lab, inside, outside, LEARN_RATE)
    if look.patch is not None:
        reference.template += np.float32(LEARN_RATE) * (look.patch - reference.template)
    reference.separation += LEARN_RATE * (sight.separation - reference.separation)
    reference.area_ratio += LEARN_RATE * (sight.area_ratio - reference.area_ratio)


def _overlap(a: Array, b: Array) -> float:
    """Intersection over union of two (4,) boxes."""
    common = float(np.prod(np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0)))
    both = float(np.prod(a[2:] - a[:2])) + float(np.prod(b[2:] - b[:2])) - common
    return common / both
