"""The ring's registration: a map of the animals goes round, each drone matches its boxes to it
(docs/registration.md).

Each node repeats the newest map that it knows, by (done, lap, rank); the node whose turn comes next after
that map acts on it, wherever the packet came from. So lost, repeated and late packets cost time and nothing
else, and a line works as a ring. Lap 1 makes the map. From lap 2 on each node matches its boxes again, now
against everybody's animals, and says what it saw and missed; a lap in which nobody's identities changed is
the last. A final packet, DONE, carries the verdict to all.

Closure alone proves nothing: consensus also asks of every edge a confidence of 0.9, and of every animal
that the views it should lie in confirm it. A ring of one has nobody to disagree with: its own ids,
consensus True.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from procs.registrar._chart import ViewGeometry, fits_map, mapped_point, new_animal, shifted
from procs.registrar._marks import check_boxes
from procs.registrar._sight import Observer, Register, Sight, with_sight, without_sight
from procs.registrar._verdict import CONSENSUS_CONFIDENCE, is_doubted, is_settled
from procs.registrar.box_icp import align_marks
from procs.registrar.map import (
    MAX_ANIMALS,
    MapAnimal,
    MapHeader,
    Memory,
    PacketError,
    decode_map,
    encode_map,
)

__all__ = ["NodeResult", "RingNode", "RingRegistration", "ViewGeometry", "register_ring"]

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

FUSE_CONFIDENCE = 0.5  # below this a node passes the first lap's map on unfused and tries again on the second
MAX_LAPS = 4

CLOSED, CHANGED, REPAIRED, CONSENSUS, DONE = 1, 2, 4, 8, 16


@dataclass(frozen=True)
class NodeResult:
    """What one drone knows when its episode ends.

    `identities` (N,) animal id of each own box, -1 where another view that should hold the animal did not
    confirm it; `confidence` 0-1, the least of the ring's edges; `map` the confirmed and the remembered
    animals, in fleet NED metres as the first drone believes them; `memory` what the next episode starts
    from; `transform` (3, 3) own px to map metres;
    `n_m`, `e_m`, `yaw_rad` where the map says that this drone's nadir and image top are (of its image
    centre, where the view's geometry is unknown); `has_pose` False where no box of this view is on the map,
    so that the pose is only what the drone believed.
    """

    identities: Ints
    consensus: bool
    confidence: float
    repaired: bool
    laps: int
    map: list[MapAnimal]
    memory: Memory
    transform: Array
    n_m: float
    e_m: float
    yaw_rad: float
    has_pose: bool


class RingNode:
    """One drone's part in one episode; `step` with what the neighbours said, and say what it returns to
    both.
    """

    def __init__(
        self,
        boxes: ArrayLike,
        drone_id: int,
        members: Sequence[int],
        episode: int = 1,
        proposer: int = 1,
        *,
        image_size: tuple[int, int] | None = None,
        view: ViewGeometry | None = None,
        memory: Memory | None = None,
        register: Register = align_marks,
        is_blind: bool = False,
        reserved: Collection[int] = (),
    ) -> None:
        """`boxes` (N, 4) px of the frame at the episode's instant; `members` are drone ids in ring order.

        is_blind: there was no frame at that instant. Such a drone hands the map on, and its edge has no
        confidence, so that nobody takes its silence for a confirmation. reserved: ids that no new animal
        may get, since something still holds for whoever bore them.

        Raises ValueError for a drone that is no member, a repeated member or a bad box (naming the row).
        """
        if drone_id not in members or len(dict.fromkeys(members)) != len(members):
            raise ValueError(
                f"drone {drone_id}, members {list(members)}: give each member once, this drone among them"
            )
        self.drone_id, self.members = drone_id, list(members)
        self.episode, self.proposer = episode, proposer
        self.boxes = check_boxes(boxes, "boxes")
        self.memory = memory or Memory()
        self._observer = Observer(self.boxes, image_size, view, self.memory, register)
        self.bytes_sent = 0
        self.packets_refused = 0
        self._is_blind = is_blind
        self._reserved = frozenset(reserved)
        self._lost: list[int] = []
        self._newest: tuple[MapHeader, list[MapAnimal], bytes] | None = None
        self._sight = Sight()
        self._fused = False
        self._result: NodeResult | None = None

    @property
    def finished(self) -> bool:
        return self._result is not None

    @property
    def result(self) -> NodeResult:
        """Raises RuntimeError before the episode has finished."""
        if self._result is None:
            raise RuntimeError(
                f"episode {self.episode} of drone {self.drone_id} still runs: ask when finished is True"
            )
        return self._result

    def drop_member(self, drone_id: int) -> None:
        """A member is lost: its turn is passed over from now on."""
        if drone_id in self.members and drone_id != self.drone_id and drone_id not in self._lost:
            self._lost.append(drone_id)

    def step(self, inbox: Sequence[bytes], now_s: float = 0.0) -> list[bytes]:
        """Take in the neighbours' packets, act if it is this drone's turn, and return what to say to both
        neighbours now. `now_s` only ages the memory.
        """
        for packet in inbox:
            self._hear(packet)
        while not self.finished and self._is_my_turn():
            self._act(now_s)
        if self._newest is None:
            return []
        header, animals, packet = self._newest
        if header.flags & DONE and not self.finished:
            self._finish(header, animals, now_s)
        self.bytes_sent += len(packet)
        return [packet]

    def _hear(self, packet: bytes) -> None:
        try:
            header, animals = decode_map(packet)
        except PacketError:
            self.packets_refused += 1
            return
        same = (header.episode, header.proposer) == (self.episode & 0xFFFF, self.proposer)
        if not same or header.rank >= len(self.members):
            self.packets_refused += 1
            return
        if self._newest is None or _age(header) > _age(self._newest[0]):
            self._newest = (header, animals, packet)

    def _living_ranks(self) -> list[int]:
        return [rank for rank, member in enumerate(self.members) if member not in self._lost]

    def _is_my_turn(self) -> bool:
        mine, living = self.members.index(self.drone_id), self._living_ranks()
        if self._newest is None:
            return mine == living[0]
        header = self._newest[0]
        if header.flags & DONE:
            return False
        later = [rank for rank in living if rank > header.rank]
        return mine == (later[0] if later else living[0])

    def _act(self, now_s: float) -> None:
        rank = self.members.index(self.drone_id)
        if self._newest is None:
            header, animals = self._first_map(now_s)
        else:
            header, animals, _ = self._newest
            opens_lap = header.rank >= rank
            if opens_lap and header.lap >= 2 and (not header.flags & CHANGED or header.lap >= MAX_LAPS):
                header = replace(
                    header, rank=rank, flags=header.flags | DONE | self._verdict(header, animals)
                )
            else:
                lap = header.lap + opens_lap
                flags = header.flags & REPAIRED if opens_lap else header.flags
                header = replace(header, lap=lap, rank=rank, flags=flags)
                header, animals = self._take_turn(header, animals, opens_lap, now_s)
        # What is kept is what the packet says, rounding included, so that every node holds the same map.
        packet = encode_map(header, animals)
        self._newest = (*decode_map(packet), packet)

    def _first_map(self, now_s: float) -> tuple[MapHeader, list[MapAnimal]]:
        """The map of this drone's boxes, with the ids of the remembered animals that they match."""
        view = self._observer.view
        # Whole metres: the packet holds them exactly, as far as 32 km from the fleet's origin.
        origin = (round(view.n_m), round(view.e_m)) if view else (0, 0)
        header = MapHeader(
            episode=self.episode & 0xFFFF,
            proposer=self.proposer,
            lap=1,
            rank=self.members.index(self.drone_id),
            flags=0,
            confidence=1.0,
            origin_n_m=origin[0],
            origin_e_m=origin[1],
            yaw_rad=view.yaw_rad % (2 * np.pi) if view else 0.0,
        )
        to_chart = self._observer.believed(header)
        animals = self._observer.remembered(header, to_chart, now_s)
        known = self._observer.match_memory(header, animals, to_chart)
        by_id = {one.id: one for one in animals}
        self._sight = Sight(dict(known), [], to_chart, confidence=1.0, has_pose=True)
        marks = self._observer.marks.through(to_chart)
        for row, number in known.items():
            by_id[number] = new_animal(marks, row, header.origin, number, is_first_view=True)
        self._add_new(header, by_id, self._sight, Sight(), now_s, is_first_view=True)
        self._fused = True
        return header, list(by_id.values())

    def _add_new(
        self,
        header: MapHeader,
        by_id: dict[int, MapAnimal],
        sight: Sight,
        before: Sight,
        now_s: float,
        is_first_view: bool,
    ) -> None:
        """Put the boxes that the map lacks on it; one that this drone added before keeps its id."""
        marks = self._observer.marks.through(sight.to_chart)
        for row in range(len(self.boxes)):
            if row in sight.ids or not fits_map(marks.centres[row], float(marks.sizes[row])):
                continue
            number = before.ids.get(row)
            if number is None or number in sight.ids.values() or by_id[number].hits:
                number = self._free_id(by_id, now_s)
            if number is not None:
                others_missed = by_id[number].misses if number in by_id else 0
                added = new_animal(marks, row, header.origin, number, is_first_view)
                by_id[number] = replace(added, misses=others_missed)
                sight.ids[row] = number

    def _free_id(self, by_id: dict[int, MapAnimal], now_s: float) -> int | None:
        if len(by_id) >= MAX_ANIMALS:
            return None
        kept = {one.id for one in self.memory.known_at(now_s).animals} | self._reserved
        return next((number for number in range(255) if number not in by_id and number not in kept), None)

    def _take_turn(
        self, header: MapHeader, animals: list[MapAnimal], opens_lap: bool, now_s: float
    ) -> tuple[MapHeader, list[MapAnimal]]:
        """Match own boxes to the map and put this drone's word on it in place of its earlier word."""
        view = self._observer.view
        if view is not None and not animals:
            # Those before saw nothing and may be far away: the map begins here, and reaches what is seen.
            header = replace(header, origin_n_m=round(view.n_m), origin_e_m=round(view.e_m))
        before, was_fused = self._sight, self._fused
        if not {*before.ids.values()} <= {one.id for one in animals}:
            before = Sight()  # taken for lost and passed over: this map does not hold the earlier word
        remembered = [one.id for one in self.memory.animals]
        said_by_all, animals = animals, without_sight(animals, before, len(self.members))
        # Only what others say: a drone that lay wrong once would find its own wrong animals again.
        others = [one for one in animals if one.hits or one.id in remembered]
        if before.ids and not others:
            sight, is_told = replace(before, ids={}, missed=[], confidence=1.0), True
        else:
            sight, is_told = self._observer.look(header, others)
        if header.lap == 1 and others and sight.confidence < FUSE_CONFIDENCE:
            return header, said_by_all
        by_id = with_sight(header, animals, self._observer.marks, sight, before)
        self._add_new(header, by_id, sight, before, now_s, is_first_view=False)
        taken_back = [number for number in before.ids.values() if not by_id[number].hits]
        animals = [one for one in by_id.values() if one.id not in taken_back or one.id in remembered]
        self._sight, self._fused = sight, True
        flags = header.flags
        if header.lap >= 2 and (not was_fused or sight.ids != before.ids):
            flags |= CHANGED | REPAIRED
        if opens_lap and was_fused and sight.ids == before.ids and is_told:
            flags |= CLOSED
        confidence = 0.0 if self._is_blind else sight.confidence
        least = confidence if opens_lap else min(header.confidence, confidence)
        return replace(header, flags=flags, confidence=least if header.lap >= 2 else 1.0), animals

    def _verdict(self, header: MapHeader, animals: list[MapAnimal]) -> int:
        """CONSENSUS or 0: closure, every edge's confidence and every animal's confirmation together."""
        if len(self._living_ranks()) == 1:
            return CONSENSUS
        is_proved = header.flags & CLOSED and header.confidence >= CONSENSUS_CONFIDENCE
        return CONSENSUS if is_proved and is_settled(animals, len(self._living_ranks())) else 0

    def _finish(self, header: MapHeader, animals: list[MapAnimal], now_s: float) -> None:
        by_id = {one.id: one for one in animals}
        identities = np.full(len(self.boxes), -1, dtype=np.intp)
        for row, number in self._sight.ids.items():
            if number in by_id and not is_doubted(by_id[number]):
                identities[row] = number
        to_map = shifted(header.origin_n_m, header.origin_e_m) @ self._sight.to_chart
        place = mapped_point(to_map, np.zeros(2))
        ahead = mapped_point(to_map, np.array([1.0, 0.0])) - place
        turn = float(np.arctan2(ahead[1], ahead[0]))
        agreed = [one for one in animals if not is_doubted(one)]
        view = self._observer.view
        self._result = NodeResult(
            identities=identities,
            consensus=bool(header.flags & CONSENSUS),
            confidence=header.confidence,
            repaired=bool(header.flags & REPAIRED),
            laps=header.lap,
            map=agreed,
            memory=self.memory.after(agreed, now_s),
            transform=to_map @ self._observer.pixel_to_local,
            n_m=float(place[0]),
            e_m=float(place[1]),
            yaw_rad=(turn + (view.yaw_rad if view else 0.0)) % (2 * np.pi),
            has_pose=self._sight.has_pose,
        )


def _age(header: MapHeader) -> tuple[bool, int, int]:
    """Orders the maps of one episode: the newest is the one to keep and to repeat."""
    return bool(header.flags & DONE), header.lap, header.rank


@dataclass(frozen=True)
class RingRegistration:
    """`identities` one (Ni,) int a view, -1 where unconfirmed; `bytes_sent` (n,) int, what each node's
    steps returned; `memory` for the next episode."""

    identities: list[Ints]
    consensus: bool
    repaired: bool
    laps: int
    bytes_sent: Ints
    memory: Memory
    confidence: float


def register_ring(
    views: Sequence[ArrayLike],
    *,
    image_size: tuple[int, int] | None = None,
    memory: Memory | None = None,
    geometry: Sequence[ViewGeometry] | None = None,
    now_s: float = 0.0,
    register: Register = align_marks,
) -> RingRegistration:
    """Run one episode over a ring of views, (Ni, 4) boxes px each in ring order, with in-memory links.

    `memory` is the last episode's, `now_s` this one's time by the same clock, `geometry` what each drone
    believes of its camera, if anything. Raises ValueError for no views, or a bad box (naming the view's
    row).
    """
    if not len(views):
        raise ValueError("views is empty: give the boxes of at least one view")
    members = list(range(1, len(views) + 1))
    nodes = [
        RingNode(
            *(boxes, number, members),
            image_size=image_size,
            view=geometry[number - 1] if geometry else None,
            memory=memory,
            register=register,
        )
        for number, boxes in zip(members, views, strict=True)
    ]
    inboxes: list[list[bytes]] = [[] for _ in nodes]
    while not all(node.finished for node in nodes):
        said = [node.step(inbox, now_s) for node, inbox in zip(nodes, inboxes, strict=True)]
        count = len(nodes)
        inboxes = [said[index - 1] + said[(index + 1) % count] if count > 1 else [] for index in range(count)]
    results = [node.result for node in nodes]
    return RingRegistration(
        identities=[one.identities for one in results],
        consensus=all(one.consensus for one in results),
        repaired=results[0].repaired,
        laps=results[0].laps,
        bytes_sent=np.array([node.bytes_sent for node in nodes]),
        memory=results[0].memory,
        confidence=results[0].confidence,
    )
