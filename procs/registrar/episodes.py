"""Who registers with whom, and when: proposals of episodes (docs/registration.md).

Any drone may propose one; the larger (number, proposer) wins everywhere, so that all end with the same.
Proposals are said again and again as whole state; a member list never changes within a number.
"""

from dataclasses import dataclass

from lcmtypes import make
from lcmtypes.podwatch import episode_t

__all__ = ["EpisodeBook", "Proposal"]

LEAD_US = 1_000_000  # from the proposal to the instant t: time to reach everybody
LISTEN_FIRST_US = 2_000_000  # a restarted drone hears before it proposes
REPEAT_AFTER_T_US = 6_000_000  # how long after t a proposal is still said


@dataclass(frozen=True)
class Proposal:
    """One episode: number, proposer, members in ring order, the instant t in fleet time."""

    number: int
    proposer: int
    members: tuple[int, ...]
    t_utime: int
    fresh: bool = False

    @property
    def key(self) -> tuple[int, int]:
        """The larger wins."""
        return self.number, self.proposer


def to_bitmap(members: tuple[int, ...], roster: tuple[int, ...]) -> int:
    """Members as a bitmap by roster index."""
    return sum(1 << roster.index(member) for member in members)


def from_bitmap(bitmap: int, roster: tuple[int, ...]) -> tuple[int, ...]:
    """Members in ring order."""
    return tuple(member for index, member in enumerate(roster) if bitmap >> index & 1)


class EpisodeBook:
    """The newest proposal that one drone knows."""

    def __init__(self, drone_id: int, roster: tuple[int, ...], began_utime: int) -> None:
        self._drone_id = drone_id
        self._roster = roster
        self._began_utime = began_utime
        self.newest: Proposal | None = None
        self._was_contradicted = False

    def propose(
        self, members: tuple[int, ...], utime: int, fleet_utime: int, *, fresh: bool = False
    ) -> Proposal | None:
        """A new episode among `members`, or None while one should run, or while this drone still listens."""
        if utime - self._began_utime < LISTEN_FIRST_US or self._drone_id not in members:
            return None
        number = self.newest.number + 1 if self.newest else 1
        self.newest = Proposal(number, self._drone_id, tuple(sorted(members)), fleet_utime + LEAD_US, fresh)
        return self.newest

    def heard(self, message: episode_t) -> bool:
        """Take over a neighbour's proposal where it wins; True if it did. Unknown members are refused."""
        members = from_bitmap(message.members, self._roster)
        if not members or message.members >> len(self._roster) or message.proposer not in members:
            return False
        proposal = Proposal(message.number, message.proposer, members, message.t_utime, message.fresh)
        if self.newest is not None and proposal.key <= self.newest.key:
            # Who says an older one was away when the newest was said: it is told at the next chance.
            self._was_contradicted = self._was_contradicted or proposal.key < self.newest.key
            return False
        self.newest = proposal
        return True

    def saying(self, fleet_utime: int) -> episode_t | None:
        """What to say now; None once the newest is long over and nobody says an older one."""
        proposal = self.newest
        is_asked, self._was_contradicted = self._was_contradicted, False
        if proposal is None or (fleet_utime > proposal.t_utime + REPEAT_AFTER_T_US and not is_asked):
            return None
        return make(
            episode_t,
            number=proposal.number,
            proposer=proposal.proposer,
            members=to_bitmap(proposal.members, self._roster),
            t_utime=proposal.t_utime,
            fresh=proposal.fresh,
        )
