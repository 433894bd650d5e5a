"""The tracker: a mask of the assigned animal in every frame.

Hears FRAME, IDENTITIES, ASSIGNMENT and VEHICLE_STATE. Says TRACK for every frame while it has an animal, and
at 2 Hz that it has none. It starts on the very frame in which the registrar named the animal (still in the
frame ring) and catches up; the animal's later boxes hold it against drift and take it up again when it was
lost. Without IDENTITIES it goes on by itself; without FRAME it falls silent and the navigator predicts.
"""

from collections import deque
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lcmtypes import channels, make
from lcmtypes.podwatch import assignment_t, frame_t, identities_t, track_t, vehicle_state_t
from procs.history import PoseHistory, camera_of
from procs.runtime import Runtime, RuntimeFailure

IDLE_EVERY_US = 500_000
KEEP_FRAMES = 14  # a little less than the ring has slots
START_WITHIN_US = 600_000  # an older box says too little of where the animal is now
STATES = {"tracking": track_t.TRACKING, "predicted": track_t.PREDICTED, "lost": track_t.LOST}


class TrackerShell:
    """Chooses the animal, feeds the tracker and says what it sees."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._frames = runtime.open("frames")
        try:
            self._tracker = runtime.open("tracker")
        except (ValueError, OSError) as error:
            raise RuntimeFailure(f"the tracker cannot start: {error}") from error
        self._camera = camera_of(runtime.settings.mission.camera)
        self._poses = PoseHistory()
        self._recent: deque[frame_t] = deque(maxlen=KEEP_FRAMES)
        self._animal = -1
        self._state = track_t.IDLE
        self._identities: identities_t | None = None
        self._used_utime = 0
        self._frame: frame_t | None = None
        self._seen_utime = 0
        self._idle_utime = 0

    def on_vehicle(self, state: vehicle_state_t) -> None:
        self._poses.add(state)

    def on_assignment(self, message: assignment_t) -> None:
        """Another animal: forget the last one."""
        animal = message.animal if not message.surplus else -1
        if animal != self._animal:
            self._animal = animal
            self._drop()

    def on_identities(self, message: identities_t) -> None:
        self._identities = message

    def on_frame(self, frame: frame_t) -> None:
        """Follow the animal into this frame, or look for it."""
        self._recent.append(frame)
        if self._animal < 0:
            self._say_idle(frame)
            return
        if self._state in (track_t.IDLE, track_t.LOST) and not self._start(frame):
            self._say_idle(frame)
            return
        if self._frame is None or frame.utime <= self._frame.utime:
            return
        image = self._frames.read(frame)
        if image is None:
            return
        self._follow(frame, image)

    def _start(self, newest: frame_t) -> bool:
        """Begin on the frame in which the animal was named; False where there is no such frame."""
        named = self._named(newest.utime, START_WITHIN_US)
        if named is None:
            return False
        identities, box, others = named
        frame = next((one for one in self._recent if one.utime == identities.utime), None)
        image = self._frames.read(frame) if frame is not None else None
        if frame is None or image is None:
            return False
        point = (box[:2] + box[2:]) / 2
        inside = (0 <= point[0] < frame.width) and (0 <= point[1] < frame.height)
        if not inside:
            return False
        self._used_utime = identities.utime
        try:
            track = self._tracker.start(image, point, box=box, companions=others)
        except ValueError as error:
            self._runtime.degraded(str(error), cause="track")
            return False
        self._frame = frame
        self._seen_utime = frame.utime
        self._state = STATES[track.state]
        return self._state != track_t.LOST

    def _follow(self, frame: frame_t, image: NDArray[np.uint8]) -> None:
        assert self._frame is not None
        options: dict[str, Any] = {"image_motion": self._image_motion(self._frame.utime, frame.utime)}
        named = self._named(frame.utime, START_WITHIN_US)
        if named is not None and named[0].utime > self._used_utime:
            self._used_utime = named[0].utime
            options["boxes"] = named[1][None]
            options["boxes_age_s"] = (frame.utime - named[0].utime) / 1e6
            options["companions"] = named[2]
        try:
            track = self._tracker.update(image, (frame.utime - self._frame.utime) / 1e6, **options)
        except ValueError as error:
            self._runtime.degraded(str(error), cause="track")
            return
        self._runtime.ok("track")
        self._frame = frame
        self._state = STATES[track.state]
        if self._state == track_t.TRACKING:
            self._seen_utime = frame.utime
        self._say(frame, track)
        if self._state == track_t.LOST:
            self._drop()
            self._state = track_t.LOST

    def _named(
        self, utime: int, within_us: int
    ) -> tuple[identities_t, NDArray[np.float64], NDArray[np.float64]] | None:
        """The newest identities that name the animal, its box (4,) and the others' boxes (K, 4)."""
        identities = self._identities
        if identities is None or utime - identities.utime > within_us:
            return None
        boxes = np.array(
            [[b.left_px, b.top_px, b.right_px, b.bottom_px] for b in identities.boxes], dtype=float
        )
        own = [row for row, animal in enumerate(identities.ids) if animal == self._animal]
        if len(own) != 1:
            return None
        return identities, boxes[own[0]], np.delete(boxes, own[0], axis=0)

    def _image_motion(self, early_utime: int, late_utime: int) -> NDArray[np.float64] | None:
        """(3, 3) homography from the last frame's pixels to this one's, from the vehicle's motion over a flat
        surface.
        """
        early, late = self._poses.at(early_utime), self._poses.at(late_utime)
        if early is None or late is None or min(early.height_m, late.height_m) < 1.0:
            return None
        return self._camera.ground_to_image(late) @ self._camera.image_to_ground(early)

    def _drop(self) -> None:
        self._tracker.reset()
        self._frame = None
        self._state = track_t.IDLE

    def _say_idle(self, frame: frame_t) -> None:
        """That there is no animal in sight, at 2 Hz."""
        if frame.utime - self._idle_utime < IDLE_EVERY_US:
            return
        self._idle_utime = frame.utime
        self._runtime.publish(
            channels.TRACK,
            make(
                track_t,
                utime=frame.utime,
                frame_seq=frame.seq,
                animal=self._animal,
                state=track_t.LOST if self._animal >= 0 else track_t.IDLE,
                width=frame.width,
                height=frame.height,
                age_ms=(frame.utime - self._seen_utime) // 1000 if self._seen_utime else 0,
            ),
        )

    def _say(self, frame: frame_t, track: Any) -> None:
        left, top, right, bottom = (float(edge) for edge in track.box)
        outline = [[int(u), int(v)] for u, v in track.outline]
        self._runtime.publish(
            channels.TRACK,
            make(
                track_t,
                utime=frame.utime,
                frame_seq=frame.seq,
                animal=self._animal,
                state=self._state,
                u_px=float(track.centre[0]),
                v_px=float(track.centre[1]),
                left_px=left,
                top_px=top,
                right_px=right,
                bottom_px=bottom,
                score=float(track.score),
                age_ms=(frame.utime - self._seen_utime) // 1000,
                compute_us=self._runtime.elapsed_us,
                width=frame.width,
                height=frame.height,
                mask_px=int(np.count_nonzero(track.mask)),
                n_outline=len(outline),
                outline=outline,
            ),
        )


def setup(runtime: Runtime) -> None:
    cv2.setNumThreads(1)
    shell = TrackerShell(runtime)
    runtime.on(channels.FRAME, shell.on_frame, newest=True)
    runtime.on(channels.IDENTITIES, shell.on_identities, newest=True)
    runtime.on(channels.ASSIGNMENT, shell.on_assignment, newest=True)
    runtime.on(channels.VEHICLE_STATE, shell.on_vehicle)
