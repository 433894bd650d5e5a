"""What a relay passes on for others: packets of an episode in which its own drone has no part.

The ring is the living, and an episode's members are those of them that may see the pod. What one member
says to the next crosses the drones between them, on the ground or on their way home; their registrars and
assigners have no say in it, so their relays hand it on, as it came.
"""

from typing import Any

from lcmtypes import channels, podwatch

__all__ = ["PASSED_ON", "EpisodeRoll"]

# Channels on which a member answers its neighbour. RING_EPISODE every registrar repeats, member or not.
PASSED_ON = (channels.RING_MAP, channels.RING_ASSIGN)
KEPT = 4  # episodes: the newest, and those that it may yet give way to


class EpisodeRoll:
    """The members of the newest episodes, as RING_EPISODE tells them."""

    def __init__(self, place: int | None) -> None:
        """`place`: the drone's own in the roster; None for the boat, which is never a member."""
        self._bit = 0 if place is None else 1 << place
        self._members: dict[tuple[int, int], int] = {}  # (number, proposer) -> bitmap by roster index

    def hear(self, message: podwatch.episode_t) -> None:
        """A proposal, from the own bus or a neighbour; one without members is none."""
        if not message.members:
            return
        self._members[message.number, message.proposer] = message.members
        while len(self._members) > KEPT:
            del self._members[min(self._members)]

    def is_bystander(self, message: Any) -> bool:
        """Whether the drone is known to have no part in the episode of a RING_MAP or RING_ASSIGN."""
        members = self._members.get((message.episode, message.proposer))
        return members is not None and not members & self._bit
