"""Who of the roster lives, and who is next to whom on the ring (docs/relay.md, Members).

Every datagram carries its sender's table of last-heard ages, one byte a member, merged here by minimum.
Ages travel as ages and never as instants, since the drones' clocks differ; each is rounded up, so passing
one to and fro never makes it younger.

A member is lost when no path has brought newer evidence of it for `lost_after_s`. What counts is that the
evidence gets newer, not how old it is: in a ring of 50 the member opposite is always known seconds late,
and lives.
"""

import math
from dataclasses import dataclass

__all__ = ["AGE_STEP_US", "BOAT_ID", "UNKNOWN_AGE", "Members", "Neighbours", "age_byte"]

BOAT_ID = 0  # roster member 0: heard and counted, never a neighbour on the ring
AGE_STEP_US = 50_000
UNKNOWN_AGE = 255  # 12.75 s or more, or never heard
HOP_US = 250_000  # the longest that a relay keeps its table before it passes it on
# Evidence of life is newer only by more than what rounding and clock errors may pretend.
NEWER_US = 2 * AGE_STEP_US


@dataclass(frozen=True)
class Neighbours:
    """The living members beside a drone in ring order by id; both the same in a pair, 0 where it is alone."""

    left: int
    right: int

    @property
    def ids(self) -> tuple[int, ...]:
        """The one or two different neighbours, none when alone."""
        return tuple(dict.fromkeys(peer_id for peer_id in (self.left, self.right) if peer_id))


class Members:
    """One drone's knowledge of who lives. All times in us of its own clock."""

    def __init__(self, own_id: int, roster: tuple[int, ...], lost_after_s: float, now_us: int) -> None:
        """`roster`: drone ids in ring order. Everybody is taken to live at first, until word of them could
        have come round and `lost_after_s` more, so that a relay that restarts in flight stands at its
        place in the ring at once. Raises ValueError for a roster that does not hold `own_id`, or holds the
        boat.
        """
        if own_id not in (BOAT_ID, *roster) or BOAT_ID in roster:
            raise ValueError(f"roster {roster}: it must hold drone {own_id}, and never the boat")
        self.own_id = own_id
        self.roster = roster
        self.ids = (BOAT_ID, *roster)  # order of the age table
        self._lost_after_us = round(lost_after_s * 1e6)
        self._heard_us: dict[int, int] = {}  # newest evidence of each member
        # When that evidence last got newer. At first, word of a far member takes a while to come round.
        self._refreshed_us = dict.fromkeys(roster, now_us + len(roster) // 2 * HOP_US)
        self._marked_us: dict[int, int] = {}  # the evidence of that moment

    def hear(self, member: int, sent_us: int, now_us: int) -> None:
        """A datagram of the member itself, sent at `sent_us`, came."""
        self._heard_us[member] = max(sent_us, self._heard_us.get(member, sent_us))
        self._marked_us[member] = self._heard_us[member]
        self._refreshed_us[member] = now_us

    def merge(self, ages: bytes, sent_us: int, now_us: int) -> None:
        """Take in a peer's age table, sent at `sent_us`: for each member the newer evidence wins."""
        for member, age in zip(self.ids, ages, strict=True):
            if member == self.own_id or age == UNKNOWN_AGE:
                continue
            heard_us = sent_us - age * AGE_STEP_US
            if member in self._heard_us and heard_us <= self._heard_us[member]:
                continue
            self._heard_us[member] = heard_us
            if member not in self._marked_us or heard_us >= self._marked_us[member] + NEWER_US:
                self._marked_us[member] = heard_us
                self._refreshed_us[member] = now_us

    def ages(self, now_us: int) -> bytes:
        """This drone's age table, one byte for the boat and each of the roster."""
        return bytes(
            0
            if member == self.own_id
            else age_byte(now_us - self._heard_us[member])
            if member in self._heard_us
            else UNKNOWN_AGE
            for member in self.ids
        )

    def lives(self, member: int, now_us: int) -> bool:
        """Whether some path has refreshed the member within the limit; this drone itself always."""
        if member == self.own_id:
            return True
        return member in self._refreshed_us and now_us - self._refreshed_us[member] <= self._lost_after_us

    def age_us(self, member: int, now_us: int) -> int | None:
        """How long ago word of a member was refreshed; None where it never was."""
        return now_us - self._refreshed_us[member] if member in self._refreshed_us else None

    def living(self, now_us: int) -> tuple[int, ...]:
        """The living drones in ring order, this one among them; never the boat."""
        return tuple(member for member in self.roster if self.lives(member, now_us))

    def lost(self, now_us: int) -> tuple[int, ...]:
        """The drones of the roster that no path refreshes."""
        return tuple(member for member in self.roster if not self.lives(member, now_us))

    def bitmap(self, now_us: int) -> int:
        """Bit k is set where roster[k] lives."""
        return sum(1 << k for k, member in enumerate(self.roster) if self.lives(member, now_us))

    def neighbours(self, now_us: int) -> Neighbours:
        """The next living member on each side: the ring closes over the lost."""
        living = self.living(now_us)
        if self.own_id not in living or len(living) == 1:
            return Neighbours(0, 0)
        place = living.index(self.own_id)
        return Neighbours(living[place - 1], living[(place + 1) % len(living)])


def age_byte(age_us: int) -> int:
    """An age in steps of 50 ms, rounded up; 255 stands for 12.75 s and more."""
    return min(UNKNOWN_AGE, max(0, math.ceil(age_us / AGE_STEP_US)))
