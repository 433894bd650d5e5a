"""On again after a restart in flight or after a HOLD (docs/navigator.md: on start in the air the navigator
holds first).
"""

import numpy as np

from procs.navigator.decisions import in_air, pilot_has_it
from procs.navigator.situation import Find, Memory, Situation
from procs.navigator.states import Event, State

__all__ = ["LISTEN_S", "after", "take_up"]

LISTEN_S = 2.0  # how long a restarted navigator waits for the fleet table before it goes on without

_EVENT = {
    State.SCOUT: Event.TO_SCOUT,
    State.FOUND: Event.TO_SCOUT,
    State.RENDEZVOUS: Event.TO_RENDEZVOUS,
    State.REGISTER: Event.TO_RENDEZVOUS,
    State.ASSIGN: Event.TO_RENDEZVOUS,
    State.MONITOR: Event.TO_MONITOR,
    State.RETURN: Event.TO_RETURN,
    State.LAND: Event.TO_LAND,
    State.LANDED: Event.TO_LAND,
}


def after(memory: Memory) -> Event:
    """The event that leads back to what the drone is doing now, once a HOLD is over."""
    if memory.state == State.MONITOR and memory.animal < 0:
        return Event.TO_RENDEZVOUS
    return _EVENT.get(memory.state, Event.TO_STANDBY)


def take_up(now: Situation, memory: Memory) -> Event | None:
    """Take up the drone's own last state from its row in the fleet table; the event with which the mission
    begins.

    None on the ground before the mission: IDLE. The animal is kept when the tracker, the map or the
    certificate knows it.
    """
    row = now.own_row
    last = State.IDLE if row is None else State(row.state)
    if row is not None:
        memory.waypoint = max(row.waypoint, 0)
    if not in_air(now):
        home = (State.RETURN, State.LAND, State.LANDED)
        return Event.ALREADY_HOME if last in home else None
    memory.resumed = True
    if last == State.LAND and not pilot_has_it(now):
        return Event.LANDS_ON  # a HOLD would climb it back to the lowest height that it may fly at
    memory.resume = _EVENT.get(last, Event.TO_STANDBY)
    if row is not None and row.found and last not in (State.RETURN, State.LAND, State.LANDED):
        memory.find = Find(np.array([row.found_n_m, row.found_e_m], dtype=np.float64), row.pod_radius_m)
        memory.barycentre.start_at(memory.find.ne, memory.find.radius_m)
    watching = any(other.state == State.MONITOR for other in now.others)
    if last == State.MONITOR:
        memory.animal = _animal(now)
        memory.resume = Event.TO_MONITOR if memory.animal >= 0 else Event.TO_RENDEZVOUS
    elif last == State.STANDBY and memory.find is not None and watching:
        memory.surplus = True
    return Event.IN_AIR


def _animal(now: Situation) -> int:
    """The animal that it watched, when anything still vouches for it; -1 else."""
    row, track, assignment = now.own_row, now.inputs.track, now.inputs.assignment
    animal = -1 if row is None else row.animal
    tracked = track is not None and track.animal == animal and now.seconds_since(track.utime) < 2.0
    certified = assignment is not None and assignment.certified and assignment.animal == animal
    known = tracked or certified or now.map_position(animal) is not None
    return animal if known else -1
