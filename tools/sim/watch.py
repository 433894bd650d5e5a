"""Looks on while a fleet flies: who is in which state, what is due to fail, when the mission is over."""

from typing import Protocol

from lcmtypes import channels
from procs.navigator.states import State
from tools.live import SHOWN
from tools.sim.faults import FaultPlan, Victim
from tools.sim.settings import SimMission

__all__ = ["Screen", "Watch"]

OVER_AFTER_S = 2.0  # all on the ground for this long


class Screen(Protocol):
    """Where a run is shown."""

    def hear(self, drone_id: int, channel: str, message: object, now_s: float) -> None: ...

    def note(self, now_s: float, text: str) -> None: ...

    def tick(self, now_s: float, realtime_factor: float) -> None: ...


class Watch:
    """Hears every bus of a run from outside; moves no drone."""

    def __init__(self, mission: SimMission, screen: Screen | None) -> None:
        self._mission = mission
        self._screen = screen
        self._faults = FaultPlan(mission.faults)
        self._living = set(mission.roster)
        self._flown: set[int] = set()
        self._down_since_s: float | None = None
        self.deaths: dict[int, float] = {}
        self.now_s = 0.0

    @property
    def states(self) -> dict[int, State]:
        """Each drone's newest state."""
        return self._faults.states

    def hear(self, drone_id: int, channel: str, data: bytes) -> None:
        """One message of one drone's bus."""
        wanted = channel in SHOWN if self._screen is not None else channel == channels.MISSION_STATE
        kind = channels.kind_of(channel) if wanted else None
        if kind is None:
            return
        message = kind.decode(data)
        if channel == channels.MISSION_STATE:
            state = State(message.state)
            self._faults.hear(drone_id, state)
            if state not in (State.IDLE, State.LANDED):
                self._flown.add(drone_id)
        if self._screen is not None:
            self._screen.hear(drone_id, channel, message, self.now_s)

    def step(self, now_s: float, victim: Victim, realtime_factor: float) -> bool:
        """Do the faults that are due -> whether the mission is over."""
        self.now_s = now_s
        marked = _Marked(victim, self)
        for text in self._faults.step(now_s, marked):
            self.note(text)
        if self._screen is not None:
            self._screen.tick(now_s, realtime_factor)
        return self._is_over(now_s)

    def _is_over(self, now_s: float) -> bool:
        if now_s >= self._mission.duration_s:
            return True
        down = all(self.states.get(drone) == State.LANDED for drone in self._living)
        if not (down and self._flown >= self._living):
            self._down_since_s = None
            return False
        if self._down_since_s is None:
            self._down_since_s = now_s
        return now_s - self._down_since_s >= OVER_AFTER_S

    def note(self, text: str) -> None:
        """Something befell the run."""
        if self._screen is not None:
            self._screen.note(self.now_s, text)

    def died(self, drone_id: int) -> None:
        """A drone is dead: nobody waits for it."""
        self.deaths[drone_id] = self.now_s
        self._living.discard(drone_id)
        self.states.pop(drone_id, None)


class _Marked:
    """Passes faults on to the run and keeps note of deaths."""

    def __init__(self, victim: Victim, watch: Watch) -> None:
        self._victim = victim
        self._watch = watch
        self.dive = victim.dive
        self.cut = victim.cut

    def kill(self, drone_id: int) -> None:
        self._victim.kill(drone_id)
        self._watch.died(drone_id)
