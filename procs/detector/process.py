"""The detector: finds the animals in the newest frame.

Hears FRAME, and VEHICLE_STATE to know how large an animal should look. Says DETECTIONS at most at
camera.detect_hz, with the frame's instant of capture; a frame without animals gives a message without boxes.
A frame that is gone from the ring is skipped and counted. When FRAME dies, or in the air its pictures stay
the same to the last bit for a second, it falls silent: presence fades and nobody acts on old boxes. A drone
whose VEHICLE_STATE it never heard stands: a bench without autopilot may show one picture for ever. A model
that is missing or broken ends the process with exit code 3 and the remedy. On SIGHUP it reads its settings
and the model again, while the old one works on; a new model that cannot be used leaves the old one at work,
and the heartbeat says so.
"""

from concurrent.futures import Future
from functools import partial
from typing import Any

import numpy as np

from drivers.cameras.pinhole import Pinhole
from lcmtypes import channels, make
from lcmtypes.podwatch import box_t, detections_t, frame_t, vehicle_state_t
from procs.detector.yolo import ModelError
from procs.runtime import Runtime, RuntimeFailure

FROZEN_AFTER_S = 1.0
HEIGHT_LIFE_S = 2.0  # an older height says nothing of the next frame
LEAST_HEIGHT_M = 2.0  # below it the drone stands or lands


class DetectorShell:
    """Chooses frames, runs the detector and says what it found."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._frames = runtime.open("frames")
        try:
            self._take(runtime.open("detector"))
        except ModelError as error:
            raise RuntimeFailure(str(error)) from error
        self._n_reloads = 0
        self._last_utime = 0
        self._changed_utime = 0  # capture of the newest frame that was unlike the one before it
        self._is_landed = True  # until the autopilot says otherwise
        self._height_m = 0.0
        self._height_utime = 0

    def on_frame(self, frame: frame_t) -> None:
        """Search one frame, if it is time for one."""
        camera = self._runtime.settings.mission.camera
        # Half a frame early is in time, so that 5 Hz of a 20 Hz camera is each fourth frame.
        least_gap_us = 1e6 / camera.detect_hz - 0.5e6 / camera.rate_hz
        if 0 <= frame.utime - self._last_utime < least_gap_us:
            return
        image = self._frames.read(frame)
        if image is None:
            return
        self._last_utime = frame.utime
        self._detector.animal_px = self._animal_px(frame)
        try:
            found = self._detector.detect(image)
        except (ValueError, ModelError) as error:
            self._runtime.degraded(str(error), cause="detect")
            return
        self._runtime.ok("detect")
        if not self._is_alive(frame, found):
            return
        boxes = self._sound(found)
        self._runtime.publish(
            channels.DETECTIONS,
            make(
                detections_t,
                utime=frame.utime,
                frame_seq=frame.seq,
                width=frame.width,
                height=frame.height,
                compute_us=self._runtime.elapsed_us,
                n_boxes=len(boxes),
                boxes=boxes,
            ),
        )

    def on_vehicle_state(self, state: vehicle_state_t) -> None:
        """How high the camera is, and whether it moves at all."""
        self._is_landed = state.landed
        if state.position_ok:
            self._height_m, self._height_utime = -state.d_m, state.utime

    def reload(self) -> None:
        """Begin to load the model that the settings name now; until it is there, the old one works on."""
        self._n_reloads += 1
        self._runtime.aside(partial(self._runtime.open, "detector"), partial(self._loaded, self._n_reloads))

    def _loaded(self, reload: int, loaded: "Future[Any]") -> None:
        """Take a model and its thresholds, or keep what there is; an older order's come too late."""
        if reload != self._n_reloads:
            return
        try:
            detector = loaded.result()
        except (ModelError, RuntimeFailure) as error:
            self._runtime.degraded(f"the new model is not used, the old one stays: {error}", cause="reload")
            return
        self._runtime.ok("reload")
        self._take(detector)

    def _take(self, detector: Any) -> None:
        """Use a detector from now on."""
        self._detector = detector
        warning = getattr(detector, "warning", "")
        if warning:
            self._runtime.degraded(warning, cause="provider")
        else:
            self._runtime.ok("provider")

    def _animal_px(self, frame: frame_t) -> float | None:
        """How long the mission's animal is in a frame's middle, px; None where the height is not known."""
        mission = self._runtime.settings.mission
        age_s = abs(frame.utime - self._height_utime) / 1e6
        if age_s > HEIGHT_LIFE_S or not self._height_m >= LEAST_HEIGHT_M:
            return None
        camera = Pinhole((frame.width, frame.height), float(np.radians(mission.camera.vfov_deg)))
        return mission.watch.animal_length_m / camera.metres_per_px(self._height_m)

    def _is_alive(self, frame: frame_t, found: Any) -> bool:
        """Whether the camera shows what is there now; what is wrong with its pictures goes to the
        heartbeat.
        """
        trouble = getattr(found, "trouble", "")
        if trouble:
            self._runtime.degraded(trouble, cause="picture")
        else:
            self._runtime.ok("picture")
        # On the ground a view may lie still, and nothing follows what is seen there.
        is_same = getattr(found, "n_repeats", 0) > 0 and not self._is_landed
        if not is_same or frame.utime < self._changed_utime:
            self._changed_utime = frame.utime
        frozen_s = (frame.utime - self._changed_utime) / 1e6
        if frozen_s < FROZEN_AFTER_S:
            self._runtime.ok("frozen")
            return True
        self._runtime.degraded(
            f"the camera gives the same picture for {frozen_s:.1f} s; nothing is detected in it; does the "
            "camera hang?",
            cause="frozen",
        )
        return False

    def _sound(self, found: Any) -> list[box_t]:
        """The boxes that are numbers; others are left out and told."""
        sound = np.isfinite(found.boxes).all(axis=1) & np.isfinite(found.scores)
        if sound.all():
            self._runtime.ok("nan")
        else:
            self._runtime.degraded(
                f"the detector gave {int((~sound).sum())} boxes that are no numbers, such as "
                f"{found.boxes[~sound][0].tolist()}; they are left out; export the model again",
                cause="nan",
            )
        rows = zip(
            found.boxes[sound].tolist(),
            found.scores[sound].tolist(),
            np.asarray(found.classes)[sound].tolist(),
            strict=True,
        )
        return [
            make(
                box_t, left_px=left, top_px=top, right_px=right, bottom_px=bottom, score=score, class_id=kind
            )
            for (left, top, right, bottom), score, kind in rows
        ]


def setup(runtime: Runtime) -> None:
    shell = DetectorShell(runtime)
    runtime.on(channels.FRAME, shell.on_frame, newest=True)
    runtime.on(channels.VEHICLE_STATE, shell.on_vehicle_state, newest=True)
    runtime.on_reload(shell.reload)
