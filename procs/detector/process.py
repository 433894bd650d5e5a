"""The detector: finds the animals in the newest frame.

Hears FRAME. Says DETECTIONS at most at camera.detect_hz, with the frame's instant of capture; a frame without
animals gives a message without boxes. A frame that is gone from the ring is skipped and counted. When FRAME
dies it falls silent: presence fades and nobody acts on old boxes. A model that is missing or broken ends the
process with exit code 3 and the remedy.
"""

from typing import Any

import numpy as np

from lcmtypes import channels, make
from lcmtypes.podwatch import box_t, detections_t, frame_t
from procs.detector.yolo import ModelError
from procs.runtime import Runtime, RuntimeFailure


class DetectorShell:
    """Chooses frames, runs the detector and says what it found."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._frames = runtime.open("frames")
        try:
            self._detector = runtime.open("detector")
        except ModelError as error:
            raise RuntimeFailure(str(error)) from error
        camera = runtime.settings.mission.camera
        # Half a frame early is in time, so that 5 Hz of a 20 Hz camera is each fourth frame.
        self._least_gap_us = 1e6 / camera.detect_hz - 0.5e6 / camera.rate_hz
        self._last_utime = 0

    def on_frame(self, frame: frame_t) -> None:
        """Search one frame, if it is time for one."""
        since_us = frame.utime - self._last_utime
        if 0 <= since_us < self._least_gap_us:
            return
        image = self._frames.read(frame)
        if image is None:
            return
        self._last_utime = frame.utime
        try:
            found = self._detector.detect(image)
        except (ValueError, ModelError) as error:
            self._runtime.degraded(str(error), cause="detect")
            return
        self._runtime.ok("detect")
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
