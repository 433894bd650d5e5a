"""Faults of a scenario: each begins some seconds after the fleet reaches a stage, and is done to the world,
never to a process's memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from procs.navigator.states import State
from tools.sim.settings import Fault

__all__ = ["FaultPlan", "Victim"]

STAGES = {
    "scout": State.SCOUT,
    "found": State.FOUND,
    "register": State.REGISTER,
    "monitor": State.MONITOR,
}


class Victim(Protocol):
    """What a run can be made to suffer."""

    def dive(self, on: bool) -> None: ...

    def kill(self, drone_id: int) -> None: ...

    def cut(self, first: int, second: int, on: bool) -> None: ...


@dataclass
class Planned:
    """One fault on its way."""

    fault: Fault
    from_s: float | None = None
    begun: bool = False
    ended: bool = False


@dataclass
class FaultPlan:
    """Begins and ends faults by simulation time and by the states that the drones say."""

    faults: Sequence[Fault]
    states: dict[int, State] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._planned = [Planned(fault) for fault in self.faults]

    def hear(self, drone_id: int, state: State) -> None:
        """A drone says its state."""
        self.states[drone_id] = state

    def step(self, now_s: float, victim: Victim) -> list[str]:
        """Do what is due -> what was done, in words."""
        done: list[str] = []
        for planned in self._planned:
            fault = planned.fault
            if planned.from_s is None and self._stage_reached(fault.when):
                planned.from_s = now_s + fault.after_s
            if planned.from_s is None:
                continue
            if not planned.begun and now_s >= planned.from_s:
                planned.begun = True
                done.append(self._begin(fault, victim))
            if planned.begun and not planned.ended and now_s >= planned.from_s + fault.for_s:
                planned.ended = True
                done += self._end(fault, victim)
        return done

    def _stage_reached(self, stage: str) -> bool:
        if stage == "start":
            return True
        wanted = STAGES[stage]
        if stage != "monitor":
            return wanted in self.states.values()
        flying = [state for state in self.states.values() if state != State.STANDBY]
        return bool(flying) and all(state == wanted for state in flying)

    def _begin(self, fault: Fault, victim: Victim) -> str:
        if fault.kind == "dive":
            victim.dive(True)
            return f"the pod dives for {fault.for_s:g} s"
        if fault.kind == "cut":
            victim.cut(*fault.between, True)
            return f"the link {fault.between[0]}-{fault.between[1]} is cut for {fault.for_s:g} s"
        drone = fault.drone or self._scout()
        victim.kill(drone)
        return f"drone {drone} dies"

    def _end(self, fault: Fault, victim: Victim) -> list[str]:
        if fault.kind == "dive":
            victim.dive(False)
            return ["the pod comes up"]
        if fault.kind == "cut":
            victim.cut(*fault.between, False)
            return [f"the link {fault.between[0]}-{fault.between[1]} is mended"]
        return []

    def _scout(self) -> int:
        return min(
            (drone for drone, state in self.states.items() if state == State.SCOUT), default=min(self.states)
        )
