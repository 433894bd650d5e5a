"""The one rule by which the mission decides how the ring assigns: from fleet size, animals, bytes and
measured loss.
"""

__all__ = ["rows_listed"]

from procs.assigner.packets import MOST_LISTED, row_room

LEAST_LISTED = 12  # nearest animals: costs 1 to 2 % of the optimum at 50 drones on 50 animals, nothing at 75
WORST_LOSS = 0.5  # beyond it shorter rows help no more


def rows_listed(n_members: int, n_animals: int, loss: float) -> int:
    """Animals that a drone's row lists: all of them where the rows of all members pass a link in about as
    many packets as they need hops, floor(n/2) + 1; else as many of the nearest as let them, but at least
    LEAST_LISTED.

    A packet that is lost is one more, and a neighbour that did not say what it holds is sent it twice: the
    packets grow by (1 - loss)**-2. Drones may differ in what they list; the table that all solve says it.
    """
    room = row_room(n_members)
    packets = (n_members // 2 + 1) * (1 - min(max(loss, 0.0), WORST_LOSS)) ** 2
    rows_a_packet = max(1.0, (n_members - 1) / packets)
    fits = int((room / rows_a_packet - 3) // 3)
    longest = min(MOST_LISTED, (room - 3) // 3)
    return min(n_animals, longest, max(fits, LEAST_LISTED))
