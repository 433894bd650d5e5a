"""The registrar's core: episodes of the ring, identities carried to the newest frame, the map kept up between
episodes.

Plain objects with time as an argument. The bus shell (process.py) feeds it detections, poses and the
neighbours' packets and says what it returns.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole, Pose, apply_homography
from procs.registrar._verdict import CONSENSUS_CONFIDENCE
from procs.registrar.box_icp import BoxAlignment
from procs.registrar.carry import BoxCarrier, Sighting
from procs.registrar.episodes import EpisodeBook, Proposal
from procs.registrar.map import Memory
from procs.registrar.monitor import name_by_map
from procs.registrar.ring import NodeResult, RingNode, ViewGeometry
from procs.registrar.steady import steady
from procs.registrar.upkeep import Correction, MapBook, MapEntry

__all__ = ["UPKEEP", "Finished", "Registrar", "RingPacket"]

Array = NDArray[np.float64]

# A frame further from the instant t is no view of it. At 5 Hz t may lie 100 ms from both frames beside it: a
# limit of just that (docs/registration.md) made a drone blind by a hair, and in every episode again.
NEAREST_FRAME_US = 200_000
DETECTED_AFTER_US = 450_000  # by then the detector has said what it found at t
SECOND_LOOK_US = 1_200_000  # a pair's second instant, at least 1 s after the first
SAID_AFTER_END_US = 1_500_000  # a finished drone repeats its packets, so that the others end too
SEEN_NOW_US = 1_000_000
EDGE_PX = 3.0  # a box this near to the edge is cut by it
# How far the corrected pose and the swimming of a few seconds put a box from where the map has its animal,
# and how many sights running must give an unnamed box the same name.
TAKE_UP_STD_LENGTHS = 0.15
TAKE_UP_SIGHTS = 4
TAKE_UP_WITHIN_US = 8_000_000  # an animal that nobody saw for longer may be another's length away
CORRECTION_GAIN = 0.05
FAR_AHEAD_US = 10_000_000  # an instant further ahead was told by a clock that is not the fleet's
UPKEEP = -1  # ring_map_t.instant of a packet of the map's upkeep


@dataclass(frozen=True)
class RingPacket:
    """A packet of one look of one episode; `instant` as in ring_map_t."""

    number: int
    proposer: int
    instant: int
    data: bytes


@dataclass
class Look:
    """One instant of an episode on this drone."""

    t_utime: int
    node: RingNode | None = None
    sighting: Sighting | None = None
    inbox: list[bytes] = field(default_factory=list)


@dataclass
class Running:
    """The episode that is under way."""

    proposal: Proposal
    looks: list[Look]
    lost: list[int] = field(default_factory=list)
    ended_utime: int | None = None


@dataclass(frozen=True)
class Finished:
    """The newest episode that has ended on this drone."""

    number: int
    proposer: int
    members: tuple[int, ...]
    complete: bool
    consensus: bool
    confidence: float


class Registrar:
    """One drone's part in agreeing which animal is which."""

    def __init__(
        self,
        drone_id: int,
        roster: tuple[int, ...],
        camera: Pinhole,
        animal_length_m: float,
        episode_limit_s: float,
        began_utime: int,
        register: Callable[..., BoxAlignment] | None = None,
    ) -> None:
        self._drone_id = drone_id
        self._camera = camera
        self._length_m = animal_length_m
        self._limit_us = round(episode_limit_s * 1e6)
        self._register = register
        self.book = EpisodeBook(drone_id, roster, began_utime)
        self.carrier = BoxCarrier(animal_length_m)
        self.map = MapBook()
        self.correction = Correction()
        self.memory: Memory | None = None
        self.left: tuple[int, ...] = ()  # animals that the boat ordered to leave: no other gets their ids
        self.running: Running | None = None
        self.finished: Finished | None = None
        self._handled: tuple[int, int] = (0, 0)

    def detected(
        self, utime: int, boxes: Array, pose: Pose | None, fleet_utime: int
    ) -> tuple[Sighting, dict[int, float]] | None:
        """Take one detected frame -> (its sighting, residual in metres to the map by animal id); None without
        a pose.
        """
        if pose is None or pose.height_m <= 1.0:
            return None
        to_ground = self._camera.image_to_ground(pose)
        ground = apply_homography(to_ground, (boxes[:, :2] + boxes[:, 2:]) / 2)
        corners = apply_homography(to_ground, boxes[:, :2]), apply_homography(to_ground, boxes[:, 2:])
        sizes_m = np.linalg.norm(corners[1] - corners[0], axis=1)
        sighting = self.carrier.update(utime, boxes, ground, self._whole(boxes), sizes_m)
        if self.finished is not None and self.running is None:
            self._take_up(sighting, pose, fleet_utime)
        return sighting, self._note_sights(sighting, pose, fleet_utime)

    def _whole(self, boxes: Array) -> NDArray[np.bool_]:
        """(N,) whether a box lies clear of the picture's edges."""
        width, height = self._camera.image_size
        low, high = boxes[:, :2] > EDGE_PX, boxes[:, 2:] < (width - EDGE_PX, height - EDGE_PX)
        return np.asarray((low & high).all(axis=1))

    def propose(self, members: tuple[int, ...], utime: int, fleet_utime: int) -> None:
        """Begin a new episode unless one is under way or about to be."""
        newest = self.book.newest
        if newest is not None and fleet_utime < newest.t_utime + self._limit_us:
            if self.running is not None or newest.key > self._handled:
                return
        self.book.propose(members, utime, fleet_utime)

    def step(self, utime: int, fleet_utime: int, pose_at: Callable[[int], Pose | None]) -> list[RingPacket]:
        """Go on with the episode -> packets to say to both neighbours now. Call at 5 Hz."""
        self._adopt(utime, fleet_utime)
        running = self.running
        if running is None:
            return []
        packets: list[RingPacket] = []
        key = running.proposal.key
        for instant, look in enumerate(running.looks):
            if look.node is None and fleet_utime >= look.t_utime + DETECTED_AFTER_US:
                self._open(running, instant, utime - fleet_utime, pose_at)
            if look.node is not None:
                inbox, look.inbox = look.inbox, []
                packets += [
                    RingPacket(*key, instant, data) for data in look.node.step(inbox, fleet_utime / 1e6)
                ]
        self._end(running, fleet_utime, pose_at, utime)
        return packets

    def receive(self, packet: RingPacket) -> None:
        """A neighbour's packet of an episode."""
        running = self.running
        if running is not None and running.proposal.key == (packet.number, packet.proposer):
            if 0 <= packet.instant < len(running.looks):
                running.looks[packet.instant].inbox.append(packet.data)

    def drop_member(self, drone_id: int) -> None:
        """A member is lost: its turn is skipped."""
        if self.running is not None and drone_id in self.running.proposal.members:
            self.running.lost.append(drone_id)
            for look in self.running.looks:
                if look.node is not None:
                    look.node.drop_member(drone_id)

    def entries_in_own_frame(self, own: Pose) -> list[tuple[MapEntry, Array]]:
        """Every animal of the map with its position (2,) in this drone's own frame."""
        return [(entry, self.correction.to_own(entry.position_m, own)) for entry in self.map.entries.values()]

    def _adopt(self, utime: int, fleet_utime: int) -> None:
        """Begin the newest proposal where it is not begun or over; it ends an older one."""
        proposal = self.book.newest
        if proposal is None or proposal.key <= self._handled:
            return
        if self.running is not None and self.running.proposal.key >= proposal.key:
            return
        is_over = fleet_utime > proposal.t_utime + self._limit_us
        is_senseless = proposal.t_utime > fleet_utime + FAR_AHEAD_US
        if is_over or is_senseless or self._drone_id not in proposal.members:
            self._handled = proposal.key
            self.running = None
            return
        looks = [Look(proposal.t_utime)]
        if len(proposal.members) == 2:
            looks.append(Look(proposal.t_utime + SECOND_LOOK_US))
        self.running = Running(proposal, looks)

    def _open(
        self, running: Running, instant: int, clock_us: int, pose_at: Callable[[int], Pose | None]
    ) -> None:
        """Make this drone's node for one instant from the frame nearest to it; no frame is an empty view."""
        look = running.looks[instant]
        t_utime = look.t_utime + clock_us
        seen = self.carrier.nearest(t_utime, NEAREST_FRAME_US)
        if seen is not None:
            look.sighting = steady(self.carrier.sightings, seen, self._whole(seen.boxes))
        boxes = look.sighting.boxes if look.sighting else np.zeros((0, 4))
        pose = pose_at(look.sighting.utime if look.sighting else t_utime)
        view = None
        if (
            pose is not None and pose.height_m > 0
        ):  # on the ground a barometer says less than nothing at times
            view = self._view(pose)
        options = {} if self._register is None else {"register": self._register}
        memory = None if running.proposal.fresh else self._remembered()
        first = running.looks[0].node
        if instant > 0 and first is not None and first.finished:
            memory = first.result.memory  # the second look confirms the ids of the first
        look.node = RingNode(
            boxes,
            self._drone_id,
            running.proposal.members,
            running.proposal.number,
            running.proposal.proposer,
            image_size=self._camera.image_size,
            view=view,
            memory=memory,
            is_blind=look.sighting is None,
            reserved=self.left,
            **options,
        )
        for lost in running.lost:
            look.node.drop_member(lost)

    def _remembered(self) -> Memory | None:
        """The animals of earlier episodes where somebody last saw them, by the map's upkeep."""
        if self.memory is None:
            return None
        return self.memory.refreshed(
            (entry.unturned(), entry.seen_fleet_utime / 1e6) for entry in self.map.entries.values()
        )

    def _end(
        self, running: Running, fleet_utime: int, pose_at: Callable[[int], Pose | None], utime: int
    ) -> None:
        """Conclude where every look has finished or time is up, once; stop repeating a little later."""
        done = all(look.node is not None and look.node.finished for look in running.looks)
        late = fleet_utime > running.looks[-1].t_utime + self._limit_us
        if running.ended_utime is None and (done or late):
            running.ended_utime = fleet_utime
            self._conclude(running, pose_at, fleet_utime)
        if running.ended_utime is not None and fleet_utime > running.ended_utime + SAID_AFTER_END_US:
            self._handled = running.proposal.key
            self.running = None

    def _conclude(self, running: Running, pose_at: Callable[[int], Pose | None], fleet_utime: int) -> None:
        looks = [look for look in running.looks if look.node is not None and look.node.finished]
        complete = len(looks) == len(running.looks)
        proposal = running.proposal
        last = looks[-1] if looks else None
        result = last.node.result if last is not None and last.node is not None else None
        consensus = complete and all(look.node is not None and look.node.result.consensus for look in looks)
        if complete and len(looks) == 2:
            consensus = consensus and self._same_matching(looks[0], looks[1])
        # A pod that nobody saw, as when it has dived, is nothing to agree on: all would stand by for ever.
        consensus = consensus and result is not None and any(one.hits for one in result.map)
        self.finished = Finished(
            proposal.number,
            proposal.proposer,
            proposal.members,
            complete,
            consensus,
            result.confidence if result is not None else 0.0,
        )
        # What was not agreed changes nothing: boxes keep the names, and the map the animals, of the last
        # agreement, which the drones that watch go by.
        if consensus and result is not None and last is not None:
            self._take_over(last, result, pose_at, fleet_utime)

    def _same_matching(self, first: Look, second: Look) -> bool:
        """A pair's proof: both looks give every animal that this camera followed between them the same id."""
        if first.sighting is None or second.sighting is None or first.node is None or second.node is None:
            return False
        early = dict(
            zip(map(id, first.sighting.followed), first.node.result.identities.tolist(), strict=True)
        )
        late = dict(
            zip(map(id, second.sighting.followed), second.node.result.identities.tolist(), strict=True)
        )
        both = [key for key in early if key in late and early[key] >= 0 and late[key] >= 0]
        return bool(both) and all(early[key] == late[key] for key in both)

    def _take_over(
        self, look: Look, result: NodeResult, pose_at: Callable[[int], Pose | None], fleet_utime: int
    ) -> None:
        """The agreed result becomes what this drone believes."""
        if look.sighting is not None:
            self.carrier.name(look.sighting, [int(one) for one in result.identities])
            pose = pose_at(look.sighting.utime)
            if pose is not None and result.has_pose:
                turn = float(np.angle(np.exp(1j * (result.yaw_rad - pose.yaw_rad))))
                self.correction = Correction(result.n_m - pose.n_m, result.e_m - pose.e_m, turn)
        else:
            # Without a view of this episode all names are of an older one, whose ids may have been others.
            self.carrier.name(Sighting(look.t_utime, np.zeros((0, 4)), np.zeros((0, 2)), ()), [])
        self.memory = result.memory
        mine = set(result.identities.tolist())
        self.map.replace(
            [
                MapEntry(
                    animal=one.id,
                    position_m=np.array([one.n_m, one.e_m]),
                    # Remembered but not seen this time: its age goes on.
                    seen_fleet_utime=look.t_utime if one.hits else self._seen_before(one.id),
                    mine=one.id in mine,
                    size_m=one.size_m,
                    axis_rad=one.axis_rad,
                    hits=one.hits,
                    misses=one.misses,
                )
                for one in result.map
            ]
        )

    def _seen_before(self, animal: int) -> int:
        """Fleet time at which an animal was last seen, 0 where this drone never knew it."""
        entry = self.map.entries.get(animal)
        return entry.seen_fleet_utime if entry is not None else 0

    def _take_up(self, sighting: Sighting, pose: Pose, fleet_utime: int) -> None:
        """Name boxes that have no name by the map, with this drone's pose as prior (docs/registration.md,
        MONITOR); only what several sights running agree on.
        """
        fresh = [
            entry
            for entry in self.map.entries.values()
            if fleet_utime - entry.seen_fleet_utime <= TAKE_UP_WITHIN_US
        ]
        held = self.carrier.held_ids(sighting.utime, SEEN_NOW_US)
        if all(one.animal >= 0 for one in sighting.followed) or all(one.animal in held for one in fresh):
            return
        # A box that the picture's edge cuts has neither its animal's place nor its size: one such made a
        # whole picture doubtful, and an animal that lay free in its middle went without a name.
        whole = self._whole(sighting.boxes)
        names = name_by_map(
            sighting.boxes[whole],
            [entry.unturned() for entry in fresh],
            self._view(self.correction.pose(pose)),
            image_size=self._camera.image_size,
            position_std_m=TAKE_UP_STD_LENGTHS * self._length_m,
        )
        offers = np.full(len(whole), -1, dtype=np.intp)
        offers[whole] = names.identities
        is_sure = names.confidence >= CONSENSUS_CONFIDENCE and all(
            one.animal < 0 or offer in (-1, one.animal)
            for one, offer in zip(sighting.followed, offers.tolist(), strict=True)
        )
        for one, offer in zip(sighting.followed, offers.tolist(), strict=True):
            if one.animal < 0:
                taken = offer if is_sure and offer not in held else -1
                if one.offered(taken) >= TAKE_UP_SIGHTS and taken >= 0:
                    self.carrier.name_one(one, taken)

    def _view(self, pose: Pose) -> ViewGeometry:
        return ViewGeometry(
            height_m=pose.height_m,
            yaw_rad=pose.yaw_rad,
            n_m=pose.n_m,
            e_m=pose.e_m,
            roll_rad=pose.roll_rad,
            pitch_rad=pose.pitch_rad,
            focal_px=self._camera.focal_px,
        )

    def _note_sights(self, sighting: Sighting, pose: Pose, fleet_utime: int) -> dict[int, float]:
        """Write our own sights into the map; lean our correction towards what the neighbours see."""
        residual: dict[int, float] = {}
        drift = []
        for entry in self.map.entries.values():
            entry.mine = False
        for animal, position in zip(sighting.followed, sighting.ground_m, strict=True):
            if animal.animal < 0 or animal.animal not in self.map.entries:
                continue
            here = self.correction.to_map(position, pose)
            residual[animal.animal] = self.map.saw(animal.animal, here, fleet_utime)
            theirs = self.map.entries[animal.animal].theirs_m
            if residual[animal.animal] and theirs is not None:
                drift.append(theirs - here)
        if drift:
            n_m, e_m = CORRECTION_GAIN * np.median(np.array(drift), axis=0)
            old = self.correction
            self.correction = Correction(old.n_m + float(n_m), old.e_m + float(e_m), old.yaw_rad)
        return residual
