"""The one rule by which the mission decides how the ring assigns: from fleet size, animals, bytes and
measured loss.

A drone moves only when all choices are distinct (the certificate), so a method that is distinct in a share
D of cases is paid for 1 / D times on average: the rule takes the method with the least bytes / D. In flight
every message is repeated until it is heard. Loss therefore lengthens all methods alike, and what it decides
is how many animals a row lists. `podwatch bench assignment` prints both sides, and says where the shares
below are not those it measures.
"""

from dataclasses import dataclass
from typing import Literal

from procs.assigner.packets import MOST_LISTED, row_room
from procs.assigner.rounds import learned_bytes
from procs.assigner.solve import Method

__all__ = ["DISTINCT", "RATIOS", "Plan", "plan", "rows_listed"]

LEAST_LISTED = 12  # nearest animals: costs 1 to 2 % of the optimum at 50 drones on 50 animals, nothing at 75
WORST_LOSS = 0.5  # beyond it shorter rows help no more
ROUNDS, LEARNED_ROUNDS = 5, 3  # of the learned method, and of those of them that gnn+resolve learns
LIST_BYTES = 10  # what gnn+resolve floods of an agent

# Share of distinct answers after five rounds at 1, 1.5 and 2 goals an agent: of five agents the worst of the
# three training seeds, of more the network that flies.
RATIOS = (1.0, 1.5, 2.0)
DISTINCT: dict[Method, dict[int, tuple[float, float, float]]] = {
    "gnn": {5: (0.917, 0.973, 0.98), 10: (0.207, 0.753, 0.827), 20: (0.0, 0.225, 0.35), 50: (0.0, 0.0, 0.0)},
    "gnn+resolve": {5: (1.0, 1.0, 1.0), 10: (0.133, 0.633, 0.813), 20: (0.0, 0.1, 0.4), 50: (0.0, 0.0, 0.0)},
}


@dataclass(frozen=True)
class Plan:
    """What an episode's members do."""

    method: Method
    listed: int  # animals that a drone's row lists; only the exact method has rows
    bytes_needed: dict[Method, float]  # what one drone sends, on average, until all choices are distinct


def plan(
    n_members: int, n_animals: int, loss: float = 0.0, wanted: Literal["auto"] | Method = "auto"
) -> Plan:
    """What n_members drones do about n_animals animals; this drone's links lose `loss` of their messages.

    wanted: the mission's own choice; a learned method whose messages no packet can hold gives way to the
    exact.
    """
    learned = 2 * (2 + 6 * n_animals)  # a round, to both sides
    # Without rows the certificate still needs to know who holds what: 3 bytes a member.
    holders = 3 * (n_members - 1)
    sent: dict[Method, float] = {
        "exact": float((n_members - 1) * (3 + 3 * rows_listed(n_members, n_animals, 0.0))),
        "gnn": (ROUNDS * learned + holders) / _distinct("gnn", n_members, n_animals),
        "gnn+resolve": (LEARNED_ROUNDS * learned + 4 * LIST_BYTES + holders)
        / _distinct("gnn+resolve", n_members, n_animals),
    }
    method: Method = min(sent, key=lambda name: sent[name]) if wanted == "auto" else wanted
    if learned_bytes(n_animals) > row_room(n_members):
        method = "exact"
    return Plan(method, rows_listed(n_members, n_animals, loss), sent)


def _distinct(method: Method, n_members: int, n_animals: int) -> float:
    """The measured share of the nearest size that is no harder: no more drones, no fewer animals a drone.
    Never 0.
    """
    sizes = DISTINCT[method]
    n = max((size for size in sizes if size <= n_members), default=min(sizes))
    column = next((k for k, ratio in enumerate(RATIOS) if n_animals <= ratio * n_members), len(RATIOS) - 1)
    return max(sizes[n][column], 1e-3)


def rows_listed(n_members: int, n_animals: int, loss: float) -> int:
    """Animals that a drone's row lists: all of them where the rows of all members pass a link in half as
    many packets as they need hops, floor(n/2) + 1; else as many of the nearest as let them, but at least
    LEAST_LISTED.

    A packet that is lost is one more, and a neighbour that could not say what it holds is sent it twice:
    there are (1 - loss)**-2 as many. Drones may differ in what they list; the table that all solve says it.
    """
    room = row_room(n_members)
    packets = (n_members // 2 + 1) / 2 * (1 - min(max(loss, 0.0), WORST_LOSS)) ** 2
    rows_a_packet = max(1.0, (n_members - 1) / packets)
    fits = int((room / rows_a_packet - 3) // 3)
    longest = min(MOST_LISTED, (room - 3) // 3)
    return min(n_animals, longest, max(fits, LEAST_LISTED))
