"""MONITOR: over its own animal, by sight where it has it, else by prediction, else by the fleet's map."""

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole
from lcmtypes import podwatch
from procs.navigator import surplus
from procs.navigator.behaviours import fly_to
from procs.navigator.servo import ground_points, servo_velocity
from procs.navigator.situation import Memory, Situation, Step, episode_key
from procs.navigator.states import Event, State

__all__ = ["conflict", "follow_assignment", "look", "monitor"]

Array = NDArray[np.float64]

BLIND_S = 3.0  # unseen for so long: the map knows better than the prediction
GIVE_UP_S = 40.0  # twice a dive of 20 s
UNSURE_S = 10.0  # unseen for so long, an animal's place no longer says who it is
STRANGERS_S = 3.0
WIDEN_M_S = 0.7  # climb while the animal is not seen
WIDEN_MOST_M = 10.0
CONFLICT_S = 4.0
ON_ITS_WAY_M_S = 0.5  # towards its own animal: a drone that passes over another's is not over it
MAX_CONFLICTS = 3  # gathering again more often than that would cost more than it mends
LAYERS = 3


def follow_assignment(now: Situation, memory: Memory) -> Event | None:
    """Take the animal of a newer certificate; SURPLUS where it gives none."""
    assignment = now.inputs.assignment
    if assignment is None or not assignment.certified or episode_key(assignment) <= memory.assigned_key:
        return None
    memory.assigned_key = episode_key(assignment)
    if assignment.animal < 0:
        return Event.SURPLUS if assignment.surplus else None
    if assignment.animal != memory.animal:
        memory.animal = assignment.animal
        memory.animal_filter.reset()
        memory.seen_us = now.utime
    return None


def look(now: Situation, memory: Memory, camera: Pinhole) -> None:
    """Take the tracker's newest sight of the own animal into the filter."""
    track = now.inputs.track
    if track is None or track.animal != memory.animal or track.state != podwatch.track_t.TRACKING:
        return
    pose = memory.poses.at(track.utime)
    if track.utime <= memory.animal_filter.seen_us or pose is None:
        return
    points = ground_points(camera, pose, np.array([[track.u_px, track.v_px]]))
    if len(points):
        memory.animal_filter.update(track.utime, points[0])
        memory.seen_us = track.utime


def conflict(now: Situation, memory: Memory) -> bool:
    """Two drones over one animal, or the own animal away from its place in the map, for longer than 4 s."""
    length_m = now.mission.watch.animal_length_m
    own = memory.animal_filter.at(now.utime)
    is_seen = now.seconds_since(memory.seen_us) <= BLIND_S  # a prediction accuses nobody
    entry = now.map_entry(memory.animal)
    doubted = entry is not None and entry.mine and entry.residual_m > length_m
    for row in now.others:
        if row.state != State.MONITOR or row.animal < 0:
            continue
        if row.animal == memory.animal:
            # Of two that claim one animal the higher id gathers again; the lower keeps it in view.
            doubted = doubted or row.id < now.drone_id
            continue
        near = own is not None and is_seen and float(np.linalg.norm(own - [row.n_m, row.e_m])) < length_m / 2
        doubted = doubted or (near and now.row_age_s(row) < 2.0 and _is_astray(now, memory, row))
    if not doubted:
        memory.conflict_since_us = 0
    elif memory.conflict_since_us == 0:
        memory.conflict_since_us = now.utime
    lasted = memory.conflict_since_us > 0 and now.seconds_since(memory.conflict_since_us) > CONFLICT_S
    return lasted and memory.n_conflicts < MAX_CONFLICTS


def _is_astray(now: Situation, memory: Memory, row: podwatch.fleet_row_t) -> bool:
    """Whether a drone over this one's animal has no business there: its own is elsewhere, and it is not under
    way to it.
    """
    theirs, mine = now.map_position(row.animal), now.map_position(memory.animal)
    if theirs is None or mine is None:
        return True
    # Two animals that swim side by side are no conflict: the map says whether they do.
    if float(np.linalg.norm(theirs - mine)) <= now.mission.watch.animal_length_m:
        return False
    way = theirs - [row.n_m, row.e_m]
    return float(way @ [row.vn_m_s, row.ve_m_s]) <= ON_ITS_WAY_M_S * float(np.linalg.norm(way))


def monitor(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Servo over the own animal; not seen: predict, then the map, wider; only after 40 s back to the
    circle.
    """
    event = follow_assignment(now, memory)
    look(now, memory, camera)
    if memory.seen_us == 0:
        memory.seen_us = now.utime
    unseen_s = now.seconds_since(memory.seen_us)
    step = _over_animal(now, memory, unseen_s)
    step.wants_episode = surplus.asks_for_another(now, memory, is_unsure=unseen_s > UNSURE_S)
    if memory.animal in now.left:
        event = Event.LEAVE
    elif unseen_s > GIVE_UP_S or (unseen_s > UNSURE_S and _only_strangers(now, memory)):
        memory.lost_animal = memory.animal
        event = Event.ANIMAL_LOST
    elif conflict(now, memory):
        memory.n_conflicts += 1
        event = Event.CONFLICT
    step.event = event
    return step


def _only_strangers(now: Situation, memory: Memory) -> bool:
    """Animals are in view for a while and none of them has a name any more: only a new episode can tell them
    apart.
    """
    identities = now.inputs.identities
    if identities is None or identities.n_boxes == 0 or any(animal >= 0 for animal in identities.ids):
        memory.strangers_since_us = 0
    elif memory.strangers_since_us == 0:
        memory.strangers_since_us = now.utime
    return memory.strangers_since_us > 0 and now.seconds_since(memory.strangers_since_us) > STRANGERS_S


def _over_animal(now: Situation, memory: Memory, unseen_s: float) -> Step:
    watch = now.mission.watch
    wider_m = float(np.clip((unseen_s - BLIND_S) * WIDEN_M_S, 0, WIDEN_MOST_M))
    height_m = min(now.layer(watch.height_m, LAYERS) + wider_m, now.mission.limits.max_height_m)
    sight = memory.animal_filter.at(now.utime)
    if sight is not None and unseen_s <= BLIND_S:
        drift = memory.animal_filter.velocity_ne
        velocity = servo_velocity(now.position, sight, drift, height_m, watch.speed_m_s)
        goal = np.array([sight[0], sight[1], -height_m])
        return Step(velocity=velocity, goal=goal, cause_utime=memory.seen_us)
    place = now.map_position(memory.animal)
    if place is None:
        place = sight if sight is not None else now.position[:2]
    goal = np.array([place[0], place[1], -height_m])
    return fly_to(now, goal, watch.speed_m_s, levels_first=False)
