"""How long the fleet has watched each animal, and which of them it was told to leave.

An animal grows dearer with every minute that any drone has watched it. A survey wants effort spread over
the individuals of a pod, and a drone overhead is a disturbance whose length permits limit: of two animals
as near, the one watched less is taken. Everybody counts from the same fleet table, so holder and newcomer
pay the same: the price chooses *which* animals are watched where there are more of them than drones, it
makes nobody swap two that are watched anyway, and what it gains must still exceed the threshold before
anybody changes.
"""

from collections.abc import Iterable

from lcmtypes.podwatch import fleet_state_t, map_animal_t
from procs.navigator.states import State

__all__ = ["WatchBook"]

LONGEST_GAP_US = 3_000_000  # a fleet table that was silent for longer says nothing of the time between


class WatchBook:
    """Seconds watched and animals left, by animal id; kept through episodes."""

    def __init__(self) -> None:
        self._watched_s: dict[int, float] = {}
        self._left: tuple[int, ...] = ()
        self._heard_us = 0

    def hear(self, state: fleet_state_t) -> None:
        """Count the time since the last fleet table for every animal over which a living drone says it
        stands; take over which are to be left.
        """
        self._left = tuple(state.left)
        gap_us = state.utime - self._heard_us
        self._heard_us = state.utime
        if not 0 < gap_us <= LONGEST_GAP_US:
            return
        over = [row.animal for row in state.rows if row.alive and row.state == State.MONITOR]
        for animal in sorted({animal for animal in over if animal >= 0}):
            self._watched_s[animal] = self._watched_s.get(animal, 0.0) + gap_us * 1e-6

    def may_take(self, animal: int) -> bool:
        """Whether nobody was told to leave the animal."""
        return animal not in self._left

    def minutes(self, animal: int) -> float:
        """Minutes for which at least one drone watched the animal."""
        return self._watched_s.get(animal, 0.0) / 60.0

    def forget_all_but(self, known: Iterable[map_animal_t]) -> None:
        """An id that the fleet's map has dropped may mean another animal when it comes back."""
        ids = [one.id for one in known]
        self._watched_s = {animal: time_s for animal, time_s in self._watched_s.items() if animal in ids}
