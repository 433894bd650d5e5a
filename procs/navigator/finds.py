"""The find: seen with the own camera, or heard from the drone that sees it best; and the clock of the
fleet's watch.
"""

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole
from procs.navigator.servo import ground_points
from procs.navigator.situation import Find, Memory, Situation
from procs.navigator.states import GATHERED, IN_CIRCLE, State

__all__ = ["keep_clock", "sense", "share"]

Array = NDArray[np.float64]

NEAR_M = 40.0  # a drone so near to the pod sees it; a farther one only repeats what it heard
STRAY_LENGTHS = 3.0  # boxes further than this outside the pod, in body lengths, are not of the pod
FRESH_MAP_S = 10.0
INSET = 0.1  # share of the picture's sides near which an animal may be cut off
PERIOD_S = 0.5  # at which the drift of the find is estimated
LONGEST_STEP_US = 1_000_000  # of the watch's clock: an update that came late counts no more
UNSEEN_S = 1.0  # its animal unseen for longer: this is not watching
JOIN_S = 10.0  # the watch begins at the latest so long after the first drone's MONITOR
LOOKING = (State.SCOUT, State.FOUND, State.RENDEZVOUS, State.REGISTER)


def sense(now: Situation, memory: Memory, camera: Pinhole) -> None:
    """Feed the newest detections to the presence gate and to the barycentre."""
    detections = now.inputs.detections
    if detections is not None:
        memory.sight_us = max(memory.sight_us, detections.utime)
    if detections is None or memory.state not in LOOKING or detections.utime <= memory.detections_us:
        return
    memory.detections_us = detections.utime
    memory.gate.update(detections.n_boxes > 0)
    pose = memory.poses.at(detections.utime)
    if pose is None:
        return
    boxes = detections.boxes
    centres = np.array([[(b.left_px + b.right_px) / 2, (b.top_px + b.bottom_px) / 2] for b in boxes])
    points = ground_points(
        camera, pose, centres[np.isfinite(centres).all(axis=1)] if boxes else np.zeros((0, 2))
    )
    if memory.find is not None:
        away = np.linalg.norm(points - memory.find.ne, axis=1)
        stray_m = STRAY_LENGTHS * now.mission.watch.animal_length_m
        points = points[away < memory.find.radius_m + stray_m]
    elif memory.gate.share < 0.1:
        memory.barycentre.reset()
    memory.barycentre.update(
        detections.utime,
        points,
        ground_points(camera, pose, _well_inside(camera)),
        margin_m=now.mission.watch.animal_length_m / 2,
    )


def _well_inside(camera: Pinhole) -> Array:
    """(4, 2) px corners of the part of the picture in which an animal is seen whole."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64)
    return np.asarray((INSET + (1 - 2 * INSET) * corners) * camera.image_size)


def share(now: Situation, memory: Memory, camera: Pinhole) -> None:
    """Settle the fleet's find: the drone that is near it, the lowest of those, says where it is; the others
    follow.

    The find of a drone that is heard no more lives on in everybody who heard it.
    """
    memory.waypoint = max([memory.waypoint, *(row.waypoint for row in now.others)])
    if memory.state not in IN_CIRCLE or memory.state == State.TAKEOFF:
        return
    sources = [row for row in now.others if row.found and row.state in IN_CIRCLE]
    claims = [(_far(row.found_n_m - row.n_m, row.found_e_m - row.e_m), row.id) for row in sources]
    own = _own_sight(now, memory)
    if memory.find is not None or own is not None:
        ne = own[0] if own is not None else memory.find.ne if memory.find is not None else np.zeros(2)
        claims.append((_far(*(ne - now.position[:2])), now.drone_id))
    if not claims:
        return
    best = min(claims)[1]
    if best != now.drone_id:
        row = next(row for row in sources if row.id == best)
        place = np.array([row.found_n_m, row.found_e_m], dtype=np.float64)
        memory.barycentre.start_at(place, row.pod_radius_m)
        _follow(now, memory, place, row.pod_radius_m)
    elif own is not None:
        _follow(now, memory, *own)


def _far(north_m: float, east_m: float) -> bool:
    return float(np.hypot(north_m, east_m)) > NEAR_M


def _own_sight(now: Situation, memory: Memory) -> tuple[Array, float] | None:
    """Middle and radius of the pod as this drone knows them itself: its barycentre, or in MONITOR the
    fleet's map.
    """
    if memory.state in (State.ASSIGN, State.MONITOR) and now.inputs.identities is not None:
        entries = [e for e in now.inputs.identities.map if e.age_ms <= FRESH_MAP_S * 1e3]
        if not entries:
            return None
        points = np.array([[e.n_m, e.e_m] for e in entries], dtype=np.float64)
        middle = points.mean(axis=0)
        reach_m = float(np.linalg.norm(points - middle, axis=1).max()) + now.mission.watch.animal_length_m / 2
        return middle, reach_m
    saw = memory.state == State.FOUND or (memory.find is not None and memory.state in LOOKING)
    if not saw or memory.barycentre.centre_ne is None:
        return None
    return memory.barycentre.centre_ne, memory.barycentre.radius_m


def _follow(now: Situation, memory: Memory, ne: Array, radius_m: float) -> None:
    """Take the find's newest place; its drift is estimated twice a second."""
    if now.seconds_since(memory.find_filter.seen_us) >= PERIOD_S:
        memory.find_filter.update(now.utime, ne)
    memory.find = Find(ne, radius_m, memory.find_filter.velocity_ne)


def keep_clock(now: Situation, memory: Memory) -> None:
    """Count how long the fleet has watched: while somebody watches and nobody gathers, or from 10 s after the
    first began.

    It stands still while the fleet gathers anew, and while this drone watches and does not see its animal:
    what was watched before counts, what nobody saw does not.
    """
    passed_us = min(now.utime - memory.clock_us, LONGEST_STEP_US) if memory.clock_us else 0
    memory.clock_us = now.utime
    states = [State(row.state) for row in now.others] + [memory.state]
    if State.MONITOR not in states:
        memory.first_watch_us = 0
        return
    memory.watch_seen = True
    memory.first_watch_us = memory.first_watch_us or now.utime
    gathering = any(state in GATHERED for state in states)
    is_blind = memory.state == State.MONITOR and now.seconds_since(memory.seen_us) > UNSEEN_S
    if not is_blind and (not gathering or now.seconds_since(memory.first_watch_us) > JOIN_S):
        memory.watched_us += passed_us
