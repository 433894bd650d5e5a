"""The tracker's shell on a virtual bus: which animal it follows, and what TRACK says of it."""

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.frames import MemoryFrames
from lcmtypes import channels, make, podwatch
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.settings import CameraSettings, DroneSettings, Mission
from procs.tracker import process
from procs.tracker.mask_tracker import MaskTracker

WIDTH, HEIGHT = 320, 240
PERIOD_US = 50_000
OWN, OTHER = 4, 9
SPEED_PX = 1.5  # a frame, to the right


def centre_of(animal: int, number: int) -> NDArray[np.float64]:
    """(u, v) px of an animal in a frame: far from each other and from the picture's diagonal."""
    start = {OWN: (200.0, 60.0), OTHER: (90.0, 190.0)}[animal]
    return np.array([start[0] + SPEED_PX * number, start[1]])


class Flight:
    """A tracker, the camera whose frames it sees and the registrar that names two bright animals."""

    def __init__(self) -> None:
        mission = Mission(camera=CameraSettings(width_px=WIDTH, height_px=HEIGHT))
        settings = DroneSettings(drone_id=1, mission=mission, seed=1)
        self.queue, self.frames = EventQueue(), MemoryFrames()
        bus = VirtualBus(self.queue)
        drivers: dict[str, Any] = {"frames": lambda _: self.frames, "tracker": lambda _: MaskTracker()}
        self._tracker = QueueRuntime("tracker", settings, bus, ClockError(), drivers)
        process.setup(self._tracker)
        self._others = QueueRuntime("registrar", settings, bus, ClockError(), {})
        self._random = np.random.default_rng(8)
        self._n_frames = 0
        self.tracks: list[podwatch.track_t] = []
        self._others.on(channels.TRACK, self.tracks.append)
        for runtime in (self._tracker, self._others):
            runtime.start()
        self._others.every(PERIOD_US / 1e6, self._frame)

    def assign(self, animal: int, surplus: bool = False) -> None:
        """The ring has decided."""
        message = make(podwatch.assignment_t, animal=animal, certified=True, surplus=surplus)
        self._others.publish(channels.ASSIGNMENT, message)

    def run(self, seconds: float) -> list[podwatch.track_t]:
        """Fly on -> what the tracker said meanwhile."""
        n_before = len(self.tracks)
        self.queue.run_until(self.queue.now_us + round(seconds * 1e6))
        return self.tracks[n_before:]

    def _frame(self) -> None:
        number, self._n_frames = self._n_frames, self._n_frames + 1
        image = self._random.integers(30, 50, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        boxes = []
        for animal in (OWN, OTHER):
            u, v = centre_of(animal, number)
            cv2.ellipse(image, (round(u), round(v)), (28, 9), 0, 0, 360, (205, 200, 190), -1)
            edges = {"left_px": u - 28, "top_px": v - 9, "right_px": u + 29, "bottom_px": v + 10}
            boxes.append(make(podwatch.box_t, **edges, score=0.9))
        ring, token, slot = self.frames.write(image, number)
        handle = make(podwatch.frame_t, ring=ring, token=token, slot=slot, width=WIDTH, height=HEIGHT)
        self._others.publish(channels.FRAME, handle)
        names = make(
            podwatch.identities_t,
            utime=self._others.utime,
            width=WIDTH,
            height=HEIGHT,
            n_boxes=2,
            boxes=boxes,
            ids=[OWN, OTHER],
        )
        self._others.publish(channels.IDENTITIES, names)


@pytest.mark.parametrize("animal", [OWN, OTHER])
def test_the_track_lies_on_the_assigned_animal(animal: int) -> None:
    flight = Flight()
    flight.assign(animal)
    said = flight.run(2.0)
    seen = [track for track in said if track.state == podwatch.track_t.TRACKING]
    assert len(seen) > 20
    for track in seen:
        u, v = centre_of(animal, track.frame_seq)
        assert [track.u_px, track.v_px] == pytest.approx([u, v], abs=4)
        edges = [track.left_px, track.top_px, track.right_px, track.bottom_px]
        assert edges == pytest.approx([u - 28, v - 9, u + 29, v + 10], abs=6)
        assert track.animal == animal
        assert track.age_ms == 0
        assert track.mask_px == pytest.approx(np.pi * 28 * 9, rel=0.25)
        corners = np.array(track.outline)
        assert corners[:, 0].min() == pytest.approx(track.left_px, abs=2)
        assert corners[:, 1].max() == pytest.approx(track.bottom_px, abs=2)


def test_another_animal_is_taken_up_and_the_last_one_forgotten() -> None:
    flight = Flight()
    flight.assign(OWN)
    flight.run(1.0)
    flight.assign(OTHER)
    newest = flight.run(1.0)[-1]
    assert (newest.animal, newest.state) == (OTHER, podwatch.track_t.TRACKING)
    assert newest.v_px == pytest.approx(centre_of(OTHER, 0)[1], abs=4)


def test_without_an_animal_it_says_so_twice_a_second() -> None:
    flight = Flight()
    assert {(track.state, track.animal) for track in flight.run(2.0)} == {(podwatch.track_t.IDLE, -1)}
    flight.assign(OWN, surplus=True)
    said = flight.run(2.0)
    assert {(track.state, track.animal) for track in said} == {(podwatch.track_t.IDLE, -1)}
    assert 3 <= len(said) <= 5
