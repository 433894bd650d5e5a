"""The ring as each drone tells it: who lives, and how its links fare. Times are arguments."""

from dataclasses import dataclass, field

from lcmtypes.podwatch import fleet_state_t, link_state_t, link_t
from procs.relay.link import NEVER_MS

__all__ = ["NEVER_S", "Belief", "LinkRow", "Ring"]

SILENT_US = 3_000_000  # LINK_STATE comes once a second, FLEET_STATE four times
NEVER_S = NEVER_MS / 1000


@dataclass(frozen=True)
class LinkRow:
    """One link as one end tells it."""

    drone_id: int
    peer_id: int
    is_up: bool
    age_s: float  # NEVER_S: not heard since the relay started
    loss: float
    round_trip_ms: float
    bytes_s: dict[str, int]  # by kind, sent
    cap_bytes_s: int
    n_rejected: int
    n_dropped: int

    @property
    def total_bytes_s(self) -> int:
        """Bytes sent in the last second, headers and seal counted."""
        return sum(self.bytes_s.values())


@dataclass(frozen=True)
class Belief:
    """Whom one drone takes for living. `ages_s`: how old its word of each of them is."""

    drone_id: int
    left_id: int
    right_id: int
    is_line: bool
    n_living: int
    ages_s: dict[int, float] = field(default_factory=dict)
    time_ok: bool = False

    @property
    def n_unplaced(self) -> int:
        """Living members of which it has no row yet: their autopilots have known no position."""
        return max(self.n_living - len(self.ages_s), 0)


class Ring:
    """Takes LINK_STATE and FLEET_STATE of any drone's bus; what is older than 3 s is no longer told."""

    def __init__(self) -> None:
        self._links: dict[int, tuple[int, link_state_t]] = {}
        self._fleets: dict[int, tuple[int, fleet_state_t]] = {}

    def hear_links(self, message: link_state_t, heard_us: int) -> None:
        """One drone's own account of its links."""
        self._links[message.drone_id] = heard_us, message

    def hear_fleet(self, message: fleet_state_t, heard_us: int) -> None:
        """The fleet as one drone knows it."""
        self._fleets[message.drone_id] = heard_us, message

    def known_ids(self) -> list[int]:
        """Every drone that was named, the boat left out."""
        ids = {*self._links, *self._fleets}
        ids.update(link.peer_id for _, state in self._links.values() for link in state.links)
        ids.update(row.id for _, state in self._fleets.values() for row in state.rows)
        return sorted(ids - {0})

    def silent(self, now_us: int) -> dict[int, float]:
        """Drones that were heard and are silent -> for how long, s."""
        last: dict[int, int] = {}
        for drone_id, (heard_us, _) in (*self._links.items(), *self._fleets.items()):
            last[drone_id] = max(heard_us, last.get(drone_id, 0))
        return {
            drone_id: (now_us - heard_us) / 1e6
            for drone_id, heard_us in sorted(last.items())
            if now_us - heard_us > SILENT_US
        }

    def links(self, now_us: int) -> list[LinkRow]:
        """Every link that its drone still tells of."""
        return [
            _link_row(drone_id, link)
            for drone_id, (heard_us, state) in sorted(self._links.items())
            if now_us - heard_us <= SILENT_US
            for link in state.links
        ]

    def beliefs(self, now_us: int) -> list[Belief]:
        """Every drone's view of the members; None of those that are silent."""
        return [
            Belief(
                drone_id,
                state.left_id,
                state.right_id,
                bool(state.is_line),
                int(state.members).bit_count(),
                {row.id: row.age_ms / 1000 for row in state.rows if row.alive},
                bool(state.fleet_time_ok),
            )
            for drone_id, (heard_us, state) in sorted(self._fleets.items())
            if now_us - heard_us <= SILENT_US
        ]


def _link_row(drone_id: int, link: link_t) -> LinkRow:
    kinds = dict(zip(link.kinds, link.bytes_out, strict=False))
    return LinkRow(
        drone_id,
        link.peer_id,
        bool(link.up),
        link.age_ms / 1000,
        float(link.loss),
        link.round_trip_us / 1000,
        {kind: int(n_bytes) for kind, n_bytes in kinds.items()},
        link.cap_bytes_s,
        link.n_rejected,
        link.n_dropped,
    )
