"""The ring's registration: a map of the animals goes round, each drone matches its boxes to it (DESIGN
section 4).

Each node repeats the newest map that it knows, by (done, lap, rank); the node whose turn comes next after
that map acts on it, wherever the packet came from. So lost, repeated and late packets cost time and nothing
else, and a line works as a ring. Lap 1 makes the map. From lap 2 on each node matches its boxes again, now
against everybody's animals, and says what it saw and missed; a lap in which nobody's identities changed is
the last. A final packet, DONE, carries the verdict to all.

Closure alone proves nothing: consensus also asks of every edge a confidence of 0.9, and of every animal
that the views it should lie in confirm it. A ring of one has nobody to disagree with: its own ids,
consensus True.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from procs.registrar._chart import (
    ViewGeometry,
    fits_map,
    local_view,
    map_marks,
    mapped_point,
    merge_sight,
    new_animal,
    shifted,
)
from procs.registrar._marks import Marks, check_boxes
from procs.registrar.box_icp import HEADING_PRIOR_STD_RAD, BoxAlignment, Prior, align_marks
from procs.registrar.map import (
    COUNTER_LIMIT,
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
Register = Callable[..., BoxAlignment]

CONSENSUS_CONFIDENCE = 0.9
FUSE_CONFIDENCE = 0.5  # below this a node passes the first lap's map on unfused and tries again on the second
MAX_LAPS = 4
MAX_RESIDUAL_SIZES = 0.6  # root mean square, in body sizes: more is no match, whatever the registration says
LEAST_COVERAGE = 0.5  # of the animals that the map and the view both should hold
SCALE_STD = 0.12  # of ln(own height over the first drone's): barometers drift by metres
MEMORY_STD_M = 15.0  # how far a pod may have moved, as a whole, since the last episode
MISS_DEPTH_SIZES = 0.5  # an animal nearer to the image's border than this is not missed
MOST_DOUBTED = 0.2  # share of the map's animals that may be one view's false alarms

CLOSED, CHANGED, REPAIRED, CONSENSUS, DONE = 1, 2, 4, 8, 16


@dataclass(frozen=True)
class NodeResult:
    """What one drone knows when its episode ends.

    `identities` (N,) animal id of each own box, -1 where another view that should hold the animal did not
    confirm it; `confidence` 0-1, the least of the ring's edges; `map` the confirmed and the remembered
    animals, in fleet NED metres as the first drone believes them; `transform` (3, 3) own px to map metres;
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
    transform: Array
    n_m: float
    e_m: float
    yaw_rad: float
    has_pose: bool


@dataclass
class _Sight:
    """One drone's latest word on the map: what it saw (box row -> id), what it missed, and how sure it is."""

    ids: dict[int, int] = field(default_factory=dict)
    missed: list[int] = field(default_factory=list)
    to_chart: Array = field(default_factory=lambda: np.eye(3))
    confidence: float = 0.0
    has_pose: bool = False


class RingNode:
    """One drone's part in one episode; `step` with what the neighbours said, and say what it returns to
    both.
    """

    def __init__(
        self,
        drone_id: int,
        members: Sequence[int],
        episode: int,
        proposer: int,
        boxes: ArrayLike,
        *,
        image_size: tuple[int, int] | None = None,
        view: ViewGeometry | None = None,
        memory: Memory | None = None,
        register: Register = align_marks,
    ) -> None:
        """`members` are drone ids in ring order, `boxes` (N, 4) px of the frame at the episode's instant.

        Raises ValueError for a drone that is no member, a repeated member or a bad box (naming the row).
        """
        if drone_id not in members or len(dict.fromkeys(members)) != len(members):
            raise ValueError(
                f"drone {drone_id}, members {list(members)}: give each member once, this drone among them"
            )
        self.drone_id, self.members = drone_id, list(members)
        self.episode, self.proposer = episode, proposer
        self.boxes = check_boxes(boxes, "boxes")
        self.view, self.memory = view, memory or Memory()
        self.register = register
        self.marks, self.pixel_to_local = local_view(self.boxes, image_size, view)
        self.bytes_sent = 0
        self.packets_refused = 0
        self._lost: list[int] = []
        self._newest: tuple[MapHeader, list[MapAnimal], bytes] | None = None
        self._sight = _Sight()
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

    def step(self, inbox: Sequence[bytes], now_s: float) -> list[bytes]:
        """Take in the neighbours' packets, act if it is this drone's turn, and return what to say to both
        neighbours now.
        """
        for packet in inbox:
            self._hear(packet)
        while not self.finished and self._is_my_turn():
            self._act(now_s)
        if self._newest is None:
            return []
        header, animals, packet = self._newest
        if header.flags & DONE and not self.finished:
            self._finish(header, animals)
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
                header = replace(header, rank=rank, flags=header.flags | DONE | _verdict(header, animals))
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
        view = self.view
        origin = (round(view.n_m, 1), round(view.e_m, 1)) if view else (0.0, 0.0)
        yaw = view.yaw_rad % (2 * np.pi) if view else 0.0
        header = MapHeader(
            *(
                self.episode & 0xFFFF,
                self.proposer,
                1,
                self.members.index(self.drone_id),
                0,
                1.0,
                *origin,
                yaw,
            )
        )
        to_chart = shifted(view.n_m - origin[0], view.e_m - origin[1]) if view else np.eye(3)
        animals = self._remembered(header, to_chart, now_s)
        self._sight = _Sight(to_chart=to_chart, confidence=1.0, has_pose=True)
        remembered = self._match_memory(header, animals, to_chart)
        chart_marks = self.marks.through(to_chart)
        by_id = {one.id: one for one in animals}
        for row in range(len(self.boxes)):
            number = remembered.get(row)
            if number is None:
                number = self._free_id(by_id, now_s)
            if number is None or not fits_map(chart_marks.centres[row], float(chart_marks.sizes[row])):
                continue
            by_id[number] = new_animal(chart_marks, row, _origin(header), number, is_first_view=True)
            self._sight.ids[row] = number
        self._fused = True
        return header, list(by_id.values())

    def _remembered(self, header: MapHeader, to_chart: Array, now_s: float) -> list[MapAnimal]:
        """The remembered animals in this episode's map frame, no view counted yet."""
        known = list(self.memory.known_at(now_s).forgotten_counts())[:MAX_ANIMALS]
        if known and self.view is None and len(self.boxes):
            # Pictures without geometry have no common ground: the remembered frame is found by the boxes
            # alone.
            old = map_marks(known, np.zeros(2), 0.0)
            found = self.register(self.marks.through(to_chart), old, prior=Prior())
            if len(found.matches) >= 2:
                back = old.through(np.linalg.inv(found.transform))
                known = [
                    replace(
                        one,
                        n_m=float(place[0]),
                        e_m=float(place[1]),
                        size_m=float(size),
                        axis_rad=float(axis % np.pi),
                    )
                    for one, place, size, axis in zip(
                        known, back.centres, back.sizes, _axes(back), strict=True
                    )
                ]
        origin = _origin(header)
        return [one for one in known if fits_map(np.array([one.n_m, one.e_m]) - origin, one.size_m)]

    def _match_memory(self, header: MapHeader, animals: list[MapAnimal], to_chart: Array) -> dict[int, int]:
        """Own box row -> remembered id."""
        if not animals or not len(self.boxes):
            return {}
        target = map_marks(animals, _origin(header), header.yaw_rad)
        prior = Prior()
        if self.view is not None:
            prior = Prior(
                (0.0, HEADING_PRIOR_STD_RAD), (0.0, SCALE_STD), (np.zeros(2), MEMORY_STD_M), np.zeros(2)
            )
        found = self.register(self.marks.through(to_chart), target, prior=prior)
        return {int(row): animals[column].id for row, column in found.matches}

    def _free_id(self, by_id: dict[int, MapAnimal], now_s: float) -> int | None:
        if len(by_id) >= MAX_ANIMALS:
            return None
        kept = {one.id for one in self.memory.known_at(now_s).animals}
        return next((number for number in range(255) if number not in by_id and number not in kept), None)

    def _take_turn(
        self, header: MapHeader, animals: list[MapAnimal], opens_lap: bool, now_s: float
    ) -> tuple[MapHeader, list[MapAnimal]]:
        """Match own boxes to the map and put this drone's word on it in place of its earlier word."""
        before, was_fused = self._sight, self._fused
        sight, found = self._look(header, animals)
        if header.lap == 1 and len(animals) and sight.confidence < FUSE_CONFIDENCE:
            return replace(header, confidence=1.0), animals
        animals = self._withdrawn(animals, before)
        animals = self._entered(header, animals, sight, before, now_s)
        self._sight, self._fused = sight, True
        flags = header.flags
        if header.lap >= 2 and (not was_fused or sight.ids != before.ids):
            flags |= CHANGED | REPAIRED
        if opens_lap and was_fused and sight.ids == before.ids and found:
            flags |= CLOSED
        least = sight.confidence if opens_lap else min(header.confidence, sight.confidence)
        return replace(header, flags=flags, confidence=least if header.lap >= 2 else 1.0), animals

    def _look(self, header: MapHeader, animals: list[MapAnimal]) -> tuple[_Sight, bool]:
        """Register own boxes against the map; False where there is nothing that registration could tell."""
        believed = self._believed(header)
        if not len(self.boxes) or not animals:
            return _Sight(to_chart=believed, confidence=1.0), not len(self.boxes)
        target = map_marks(animals, _origin(header), header.yaw_rad)
        prior = Prior()
        if self.view is not None:
            prior = Prior((0.0, HEADING_PRIOR_STD_RAD), (0.0, SCALE_STD))
        found = self.register(self.marks, target, prior=prior)
        if not len(found.matches):
            return _Sight(to_chart=believed), False
        confidence = found.confidence if self._is_plausible(found, target) else 0.0
        ids = {int(row): animals[column].id for row, column in found.matches}
        sight = _Sight(ids, [], found.transform, confidence, has_pose=True)
        sight.missed = self._missed(sight, animals, target)
        return sight, True

    def _believed(self, header: MapHeader) -> Array:
        if self.view is None:
            return np.eye(3)
        return shifted(self.view.n_m - header.origin_n_m, self.view.e_m - header.origin_e_m)

    def _is_plausible(self, found: BoxAlignment, target: Marks) -> bool:
        """Residual and coverage, checked here so that no registration, however sure, is taken at its word."""
        sizes = float(np.median(target.sizes[found.matches[:, 1]]))
        mapped = self.marks.through(found.transform).centres
        low, high = target.centres.min(axis=0) - sizes, target.centres.max(axis=0) + sizes
        expected = int(((mapped > low) & (mapped < high)).all(axis=1).sum())
        apart = mapped[found.matches[:, 0]] - target.centres[found.matches[:, 1]]
        residual = float(np.sqrt((apart**2).sum(axis=1).mean()))
        return residual <= MAX_RESIDUAL_SIZES * sizes and len(found.matches) >= LEAST_COVERAGE * expected

    def _missed(self, sight: _Sight, animals: list[MapAnimal], target: Marks) -> list[int]:
        """Ids of the animals that lie well inside this view and that no box of it matched."""
        if self.marks.window is None:
            return [one.id for one in animals if one.id not in sight.ids.values()]
        back = target.through(np.linalg.inv(sight.to_chart))
        depth = _depth_inside(back.centres, self.marks.window) / np.maximum(back.sizes, 1e-9)
        inside = depth > MISS_DEPTH_SIZES
        return [
            one.id
            for one, is_inside in zip(animals, inside, strict=True)
            if is_inside and one.id not in sight.ids.values()
        ]

    def _withdrawn(self, animals: list[MapAnimal], sight: _Sight) -> list[MapAnimal]:
        """The map without this drone's earlier counts."""
        saturates = len(self.members) > COUNTER_LIMIT
        result = []
        for one in animals:
            hit, miss = one.id in sight.ids.values(), one.id in sight.missed
            hits = one.hits - (hit and not (saturates and one.hits == COUNTER_LIMIT))
            misses = one.misses - (miss and not (saturates and one.misses == COUNTER_LIMIT))
            result.append(replace(one, hits=max(hits, 0), misses=max(misses, 0)))
        return result

    def _entered(
        self, header: MapHeader, animals: list[MapAnimal], sight: _Sight, before: _Sight, now_s: float
    ) -> list[MapAnimal]:
        """The map with this drone's hits, misses and new animals; animals that nobody sees any more are
        taken out.
        """
        origin, chart_marks = _origin(header), self.marks.through(sight.to_chart)
        by_id = {one.id: one for one in animals}
        for row, number in sight.ids.items():
            one = by_id[number]
            if before.ids.get(row) == number:
                by_id[number] = replace(one, hits=min(one.hits + 1, COUNTER_LIMIT))
            else:
                by_id[number] = merge_sight(one, chart_marks, row, origin, header.yaw_rad)
        for number in sight.missed:
            one = by_id[number]
            by_id[number] = replace(one, misses=min(one.misses + 1, COUNTER_LIMIT))
        remembered = {one.id for one in self.memory.animals}
        own = {number for number in before.ids.values()}
        by_id = {
            number: one
            for number, one in by_id.items()
            if one.hits or number in remembered or number not in own
        }
        for row in range(len(self.boxes)):
            if row in sight.ids or not fits_map(chart_marks.centres[row], float(chart_marks.sizes[row])):
                continue
            new = self._free_id(by_id, now_s)
            if new is not None:
                by_id[new] = new_animal(chart_marks, row, origin, new, is_first_view=False)
                sight.ids[row] = new
        return list(by_id.values())

    def _finish(self, header: MapHeader, animals: list[MapAnimal]) -> None:
        by_id = {one.id: one for one in animals}
        identities = np.full(len(self.boxes), -1, dtype=np.intp)
        for row, number in self._sight.ids.items():
            if number in by_id and not is_doubted(by_id[number]):
                identities[row] = number
        to_map = shifted(header.origin_n_m, header.origin_e_m) @ self._sight.to_chart
        place = mapped_point(to_map, np.zeros(2))
        ahead = mapped_point(to_map, np.array([1.0, 0.0])) - place
        turn = float(np.arctan2(ahead[1], ahead[0]))
        self._result = NodeResult(
            identities=identities,
            consensus=bool(header.flags & CONSENSUS),
            confidence=header.confidence,
            repaired=bool(header.flags & REPAIRED),
            laps=header.lap,
            map=[one for one in animals if not is_doubted(one)],
            transform=to_map @ self.pixel_to_local,
            n_m=float(place[0]),
            e_m=float(place[1]),
            yaw_rad=(turn + (self.view.yaw_rad if self.view else 0.0)) % (2 * np.pi),
            has_pose=self._sight.has_pose,
        )


def is_doubted(animal: MapAnimal) -> bool:
    """One view says it is there, and at least one that should see it does not."""
    return animal.hits == 1 and animal.misses > 0


def _age(header: MapHeader) -> tuple[bool, int, int]:
    return bool(header.flags & DONE), header.lap, header.rank


def _origin(header: MapHeader) -> Array:
    return np.array([header.origin_n_m, header.origin_e_m])


def _axes(marks: Marks) -> Array:
    shapes = marks.shapes[:, 0]
    return np.asarray(np.arctan2(2 * shapes[:, 0, 1], shapes[:, 0, 0] - shapes[:, 1, 1]) / 2)


def _depth_inside(points: Array, polygon: Array) -> Array:
    """(N, 2) points -> (N,) signed distance to a convex polygon's nearest edge, positive inside."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    normals = np.column_stack([-edges[:, 1], edges[:, 0]]) / np.linalg.norm(edges, axis=1, keepdims=True)
    depth = points @ normals.T - (polygon * normals).sum(axis=1)
    middle = polygon.mean(axis=0) @ normals.T - (polygon * normals).sum(axis=1)
    return np.asarray((depth * np.sign(middle)).min(axis=1))


def _verdict(header: MapHeader, animals: Sequence[MapAnimal]) -> int:
    """CONSENSUS or 0: closure, every edge's confidence, and every animal's confirmation together."""
    if not header.flags & CLOSED or header.confidence < CONSENSUS_CONFIDENCE:
        return 0
    counted = [one for one in animals if one.hits > 0]
    doubted = [one for one in counted if is_doubted(one)]
    # One view against one is a draw; one against several is a false alarm, which some detectors have.
    if any(one.misses < 2 for one in doubted) or len(doubted) > MOST_DOUBTED * len(counted):
        return 0
    settled = all(one.misses <= max(1, 0.34 * (one.hits + one.misses)) for one in counted if one.hits > 1)
    return CONSENSUS if settled else 0


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
            *(number, members, 1, 1, boxes),
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
        memory=(memory or Memory()).after(results[0].map, now_s),
        confidence=results[0].confidence,
    )
