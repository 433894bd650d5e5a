"""Registrars of a whole ring, in memory: from a wish for an episode to the names of the newest boxes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from lcmtypes import make
from lcmtypes.podwatch import fleet_row_t, fleet_state_t
from procs.navigator.states import State
from procs.registrar.box_icp import BoxAlignment
from procs.registrar.process import able_members
from procs.registrar.registrar import Finished, Registrar, RingPacket

Array = NDArray[np.float64]
S = 1_000_000
CAMERA = Pinhole((640, 480), float(np.radians(60.0)))
LENGTH_M = 10.0
HEIGHT_M = 45.0
LIMIT_S = 5.0
STEP_US = 200_000
POD = np.array([[0.0, 0.0], [13.0, 4.0], [-5.0, 12.0], [-12.0, -7.0], [6.0, -14.0]])
SIZES = np.array([9.0, 10.5, 8.5, 11.0, 10.0])
AXES = np.radians([10.0, 60.0, 110.0, 150.0, 35.0])


def box_of(points: Array) -> Array:
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


class Fleet:
    """Registrars over one pod; each camera stands on the ring's circle and has a clock of its own."""

    def __init__(self, n: int, register: Callable[..., BoxAlignment] | None = None) -> None:
        self.ids = tuple(range(1, n + 1))
        self.fleet_utime = 100 * S
        self.offsets = {k: -7 * S * k for k in self.ids}  # own clock = fleet time + this
        self.animals = POD.copy()
        self.poses = {
            k: Pose(
                4 * np.cos(2 * np.pi * k / n), 4 * np.sin(2 * np.pi * k / n), -HEIGHT_M - k, yaw_rad=1.3 * k
            )
            for k in self.ids
        }
        self.registrars = {k: self._registrar(k, register) for k in self.ids}
        self.rows: dict[int, list[int]] = {}  # which animal each box of the newest frame is
        self.packets: list[tuple[int, RingPacket]] = []
        self.silent: set[int] = set()

    def _registrar(self, drone_id: int, register: Callable[..., BoxAlignment] | None) -> Registrar:
        began = self.own(drone_id) - 10 * S
        return Registrar(drone_id, self.ids, CAMERA, LENGTH_M, LIMIT_S, began, register)

    def own(self, drone_id: int) -> int:
        return self.fleet_utime + self.offsets[drone_id]

    def boxes(self, drone_id: int) -> Array:
        """(N, 4) px: each animal's body as an ellipse's outline, seen from this drone."""
        turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        to_image = CAMERA.ground_to_image(self.poses[drone_id])
        boxes = []
        for place, size, axis in zip(self.animals, SIZES, AXES, strict=True):
            along, across = size / 2 * np.cos(turn), size / 8 * np.sin(turn)
            outline = np.column_stack(
                [along * np.cos(axis) - across * np.sin(axis), along * np.sin(axis) + across * np.cos(axis)]
            )
            boxes.append(box_of(apply_homography(to_image, place + outline)))
        return np.array(boxes)

    def step(self) -> None:
        """A fifth of a second: everybody sees a frame, tells its proposal, and goes on with its episode."""
        self.fleet_utime += STEP_US
        living = [k for k in self.ids if k not in self.silent]
        for k in living:
            order = np.random.default_rng([k, self.fleet_utime]).permutation(len(self.animals))
            self.rows[k] = order.tolist()
            self.registrars[k].detected(self.own(k), self.boxes(k)[order], self.poses[k], self.fleet_utime)
        said, self.packets = self.packets, []
        for sender, packet in said:
            for k in self.neighbours(sender):
                if k in living:
                    self.registrars[k].receive(packet)
        for k in living:
            proposal = self.registrars[k].book.saying(self.fleet_utime)
            for other in self.neighbours(k):
                if proposal is not None and other in living:
                    self.registrars[other].book.heard(proposal)
            pose = self.poses[k]
            packets = self.registrars[k].step(self.own(k), self.fleet_utime, lambda _utime, pose=pose: pose)
            self.packets += [(k, packet) for packet in packets]

    def neighbours(self, drone_id: int) -> list[int]:
        place = self.ids.index(drone_id)
        return sorted({self.ids[place - 1], self.ids[(place + 1) % len(self.ids)]} - {drone_id})

    def propose(self, drone_id: int, members: tuple[int, ...] | None = None) -> None:
        self.registrars[drone_id].propose(members or self.ids, self.own(drone_id), self.fleet_utime)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.step()

    def finished(self, drone_id: int) -> Finished:
        finished = self.registrars[drone_id].finished
        assert finished is not None, f"drone {drone_id} has finished no episode"
        return finished

    def names(self, drone_id: int) -> dict[int, int]:
        """Animal -> the id of its box in this drone's newest frame."""
        ids = self.registrars[drone_id].carrier.sightings[-1].ids
        return dict(zip(self.rows[drone_id], ids, strict=True))


def flown(n: int) -> Fleet:
    fleet = Fleet(n)
    fleet.run(2.0)
    fleet.propose(1)
    fleet.run(7.0)
    return fleet


@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_ring_names_every_animal_of_the_newest_frame_the_same_on_every_drone(n):
    fleet = flown(n)
    for k in fleet.ids:
        finished = fleet.finished(k)
        assert (finished.number, finished.proposer, finished.members) == (1, 1, fleet.ids)
        assert finished.complete
        assert finished.consensus
        assert fleet.registrars[k].running is None
    names = [fleet.names(k) for k in fleet.ids]
    assert all(one == names[0] for one in names)
    assert sorted(names[0]) == list(range(len(POD)))
    assert len(set(names[0].values())) == len(POD)
    assert -1 not in names[0].values()


def test_names_follow_the_animals_that_swim_while_the_ring_agrees():
    """They are given to the boxes of the instant t and shown on the boxes of now, 3 s later."""
    fleet = Fleet(3)
    fleet.run(2.0)
    fleet.propose(2)
    for _ in range(35):
        fleet.animals = fleet.animals + np.array([1.0, -0.6]) * STEP_US / 1e6
        fleet.step()
    names = [fleet.names(k) for k in fleet.ids]
    assert names[0] == names[1] == names[2]
    assert len(set(names[0].values()) - {-1}) == len(POD)


def identity(source: Array, target: Array, *, prior: object = None) -> BoxAlignment:
    count = min(len(source), len(target))
    rows = np.arange(count)
    return BoxAlignment(
        transform=np.eye(3),
        matches=np.column_stack([rows, rows]),
        unmatched_source=np.arange(count, len(source)),
        unmatched_target=np.arange(count, len(target)),
        residual_px=0.0,
        confidence=1.0,
        is_ambiguous=False,
        iterations=1,
    )


def test_identity_in_place_of_registration_is_no_consensus():
    """The ablation: closure must come from matching, not from the code round it."""
    fleet = Fleet(3, register=identity)
    fleet.run(2.0)
    fleet.propose(1)
    fleet.run(9.0)
    assert not any(fleet.finished(k).consensus for k in fleet.ids)


def test_an_episode_that_does_not_agree_takes_no_name_and_no_animal_away():
    """Those that watch go by the names and the map of the last agreement: the failed one's may be others."""
    fleet = flown(3)
    names = {k: fleet.names(k) for k in fleet.ids}
    places = {
        k: {animal: entry.position_m.copy() for animal, entry in fleet.registrars[k].map.entries.items()}
        for k in fleet.ids
    }
    pulls = {k: fleet.registrars[k].correction for k in fleet.ids}
    for registrar in fleet.registrars.values():
        registrar._register = identity
    fleet.propose(2)
    fleet.run(9.0)
    for k in fleet.ids:
        finished = fleet.finished(k)
        assert (finished.number, finished.consensus) == (2, False)
        assert fleet.names(k) == names[k]
        assert fleet.registrars[k].map.entries.keys() == places[k].keys()
        for animal, entry in fleet.registrars[k].map.entries.items():
            assert np.linalg.norm(entry.position_m - places[k][animal]) < 1.0
        assert abs(fleet.registrars[k].correction.yaw_rad - pulls[k].yaw_rad) < 1e-9


def test_two_proposals_at_once_end_as_one_episode():
    fleet = Fleet(3)
    fleet.run(2.0)
    fleet.propose(1)
    fleet.propose(3)
    fleet.run(8.0)
    assert {(fleet.finished(k).number, fleet.finished(k).proposer) for k in fleet.ids} == {(1, 3)}
    assert all(fleet.finished(k).consensus for k in fleet.ids)


def test_the_next_episode_keeps_the_ids_and_begins_only_when_the_last_is_over():
    fleet = flown(3)
    before = fleet.names(2)
    fleet.propose(3)
    fleet.propose(3)
    fleet.run(0.4)
    fleet.propose(2)  # under way: no other one
    fleet.run(7.0)
    assert {fleet.finished(k).number for k in fleet.ids} == {2}
    assert fleet.names(1) == fleet.names(2) == before


def test_a_pod_watched_while_its_animals_changed_places_keeps_their_ids():
    """The last episode remembers another constellation, 60 m away."""
    fleet = flown(3)
    before = fleet.names(2)
    goals = np.roll(POD, 1, axis=0) * (1.0, 1.3) + (60.0, 20.0)
    starts, poses = fleet.animals, fleet.poses
    for share in np.linspace(0.0, 1.0, 300):
        fleet.animals = starts + share * (goals - starts)
        fleet.poses = {
            k: replace(one, n_m=one.n_m + share * 60.0, e_m=one.e_m + share * 20.0)
            for k, one in poses.items()
        }
        fleet.step()
    fleet.propose(3)
    fleet.run(7.0)
    assert all(fleet.finished(k).number == 2 and fleet.finished(k).consensus for k in fleet.ids)
    assert fleet.names(1) == fleet.names(2) == before


def test_a_new_animal_gets_no_number_that_the_boat_ordered_to_leave():
    fleet = Fleet(3)
    for registrar in fleet.registrars.values():
        registrar.left = (0, 3)
    fleet.run(2.0)
    fleet.propose(1)
    fleet.run(7.0)
    assert sorted(fleet.names(1).values()) == [1, 2, 4, 5, 6]


def test_a_drone_that_never_answers_makes_the_episode_incomplete_but_does_not_hang_it():
    fleet = Fleet(3)
    fleet.run(2.0)
    fleet.silent.add(2)
    fleet.propose(1)
    fleet.run(9.0)
    for k in (1, 3):
        assert fleet.registrars[k].running is None
        assert not fleet.finished(k).complete
        assert not fleet.finished(k).consensus


@pytest.mark.parametrize("lost_after_s", [0.4, 2.0])
def test_a_member_that_is_lost_before_or_after_the_instant_is_passed_over(lost_after_s):
    fleet = Fleet(3)
    fleet.run(2.0)
    fleet.propose(1)
    fleet.run(0.4)
    fleet.silent.add(2)
    fleet.run(lost_after_s - 0.4)
    for k in (1, 3):
        fleet.registrars[k].drop_member(2)
    fleet.run(6.0)
    assert all(fleet.finished(k).complete for k in (1, 3))
    assert fleet.names(1) == fleet.names(3)


def test_a_restarted_drone_that_counts_from_one_again_is_told_and_then_takes_part():
    fleet = flown(3)
    fleet.propose(1)
    fleet.run(20.0)
    fleet.registrars[2] = Registrar(2, fleet.ids, CAMERA, LENGTH_M, LIMIT_S, fleet.own(2))
    fleet.propose(2)
    assert fleet.registrars[2].book.newest is None, "it listens first"
    fleet.run(2.2)
    fleet.propose(2)
    fleet.run(1.0)
    fleet.propose(2)
    fleet.run(8.0)
    assert {fleet.finished(k).number for k in fleet.ids} == {3}
    assert all(fleet.finished(k).consensus for k in fleet.ids)
    assert fleet.names(1) == fleet.names(2) == fleet.names(3)


def test_a_proposal_for_an_instant_of_another_clock_blocks_nobody():
    fleet = Fleet(3)
    fleet.run(2.0)
    fleet.registrars[3].book.propose(fleet.ids, fleet.own(3), fleet.fleet_utime + 3600 * S)
    fleet.run(1.0)
    assert all(fleet.registrars[k].running is None for k in fleet.ids)
    fleet.propose(1)
    fleet.run(8.0)
    assert all(fleet.finished(k).consensus for k in fleet.ids)
    assert {fleet.finished(k).number for k in fleet.ids} == {2}


def test_of_a_pair_the_one_without_a_frame_near_the_instant_claims_no_consensus():
    fleet = Fleet(2)
    fleet.run(2.0)
    fleet.propose(1)
    seen = fleet.registrars[2].carrier.nearest
    fleet.registrars[2].carrier.nearest = lambda _utime, _within: None
    fleet.run(9.0)
    fleet.registrars[2].carrier.nearest = seen
    assert not fleet.finished(2).consensus


def test_packets_of_another_episode_or_look_are_let_pass():
    fleet = Fleet(3)
    fleet.registrars[1].receive(RingPacket(9, 9, 0, b"x"))
    fleet.run(2.0)
    fleet.propose(1)
    fleet.run(0.4)
    for instant in (-1, 1, 7):
        fleet.registrars[1].receive(RingPacket(1, 1, instant, b"x"))
    running = fleet.registrars[1].running
    assert running is not None
    assert [look.inbox for look in running.looks] == [[]]


def test_without_a_pose_or_on_the_ground_a_frame_is_left_out():
    registrar = Fleet(1).registrars[1]
    boxes = np.array([[10.0, 10, 40, 40]])
    assert registrar.detected(S, boxes, None, S) is None
    assert registrar.detected(S, boxes, Pose(0, 0, -0.5), S) is None
    assert not registrar.carrier.sightings


def test_a_member_whose_barometer_puts_it_below_the_ground_takes_part_without_a_view():
    fleet = Fleet(3)
    fleet.poses[3] = Pose(0.0, 0.0, 0.3)
    fleet.run(1.0)
    fleet.propose(1)
    fleet.run(9.0)
    assert all(fleet.finished(k).complete and not fleet.finished(k).consensus for k in fleet.ids)


def test_nobody_on_the_ground_or_on_the_way_home_is_asked_to_an_episode():
    states = {1: State.LANDED, 2: State.REGISTER, 3: State.MONITOR, 4: State.TAKEOFF, 5: State.REGISTER}
    states |= {7: State.RETURN, 8: State.HOLD}
    rows = [make(fleet_row_t, id=drone_id, alive=True, state=state) for drone_id, state in states.items()]
    state = make(
        fleet_state_t, members=0b11101111, n_rows=len(rows), rows=rows
    )  # 5 is lost, 6 has no row yet
    roster = tuple(range(1, 9))
    assert able_members(state, roster, own_id=2) == (2, 3, 6, 8)
    assert able_members(state, roster, own_id=1) == (1, 2, 3, 6, 8)


@pytest.mark.parametrize("n", [1, 3])
def test_an_episode_over_a_pod_that_has_dived_agrees_on_nothing(n):
    fleet = Fleet(n)
    fleet.animals = np.zeros((0, 2))
    fleet.boxes = lambda _drone_id: np.zeros((0, 4))
    fleet.run(1.0)
    fleet.propose(1)
    fleet.run(7.0)
    assert all(fleet.finished(k).complete and not fleet.finished(k).consensus for k in fleet.ids)


def test_a_drone_far_from_the_pod_that_begins_the_map_keeps_nobody_from_agreeing():
    fleet = Fleet(3)
    fleet.poses[1] = Pose(-400.0, 0.0, -HEIGHT_M)  # farther than a map reaches
    registrar = fleet.registrars[1]
    see = registrar.detected
    registrar.detected = lambda utime, boxes, *rest: see(utime, np.zeros((0, 4)), *rest)
    fleet.run(1.0)
    fleet.propose(2)
    fleet.run(9.0)
    assert all(fleet.finished(k).consensus for k in fleet.ids)
    assert len(fleet.registrars[1].map.entries) == len(POD)
