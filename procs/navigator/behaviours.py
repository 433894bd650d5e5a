"""What a drone does in each state: one function a state, from the moment's situation to a step.

A behaviour may change the memory that is its own (waypoint, station, animal) but never the state: it returns
an event, and the table decides.
"""

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole
from lcmtypes import podwatch
from procs.navigator import surplus
from procs.navigator.flight import approach, inside_fence
from procs.navigator.formation import circle_radius, gather_height, slot
from procs.navigator.situation import WAITS, Find, Memory, Situation, Step, episode_key
from procs.navigator.spiral import spacing_for, spiral
from procs.navigator.states import Event, State

__all__ = ["fly_to", "hold", "idle", "land", "landed", "return_home", "scout", "standby", "takeoff"]
__all__ += ["assign", "found", "register", "rendezvous", "station"]

Array = NDArray[np.float64]

LISTEN_S = 3.0  # a drone that starts listens first: the fleet may be in the air already
TAKEOFF_LIMIT_S = 60.0
SLOW_M_S = 1.5  # the scout's speed while it makes sure of what it sees
CENTRED_M = 4.0
CENTRING_LIMIT_S = 20.0
FIND_LOST_S = 25.0  # longer than a dive of 20 s
STATION_M = 2.0
STATION_TILT_RAD = float(np.radians(5.0))
STATION_SPEED_M_S = 0.7
PATIENCE_S = 20.0  # on station alone for so long: register with those who are there
ASK_AFTER_S = 6.0  # the lowest on station asks first, the others when it does not
ASSIGN_LIMIT_S = 15.0  # or this, the longer: a ring of 63 that loses 20 % took 19 s
ASSIGN_LIMIT_A_DRONE_S = 0.4
GATHER_LIMIT_S = 300.0
HOLD_LIMIT_S = 15.0
LEVEL_AT_M = 15.0
BATTERY_UNKNOWN = "battery unknown"


def idle(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """On the ground: starts on its own, or on the boat's order, as the mission file says."""
    step = Step(kind=podwatch.setpoint_t.IDLE)
    vehicle = now.inputs.vehicle
    if memory.reason in (WAITS, BATTERY_UNKNOWN) and now.told:
        memory.reason = BATTERY_UNKNOWN if now.battery is None else WAITS
    fleet = now.inputs.fleet
    order_us = fleet.order.utime if fleet is not None else 0
    # Not by an order of before it landed, which may still be in force: people stand beside it by now.
    is_new = order_us > memory.start_order_us and order_us - now.fleet_offset_us > memory.landed_us
    ordered = now.command == podwatch.operator_t.START and is_new
    wanted = ordered or (now.mission.search.start == "auto" and memory.state == State.IDLE)
    blocked = (podwatch.operator_t.HOLD, podwatch.operator_t.RETURN, podwatch.operator_t.LAND)
    if not wanted or now.command in blocked or now.in_state_s < LISTEN_S or vehicle is None:
        return step
    charged = now.battery is None or now.battery > now.mission.limits.battery_return
    if now.vehicle_ok and vehicle.landed and charged:
        memory.start_order_us = max(order_us, memory.start_order_us)
        step.event = Event.START
    return step


landed = idle


def takeoff(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Climbs over its home to its own layer; a setpoint of another kind would end the climb
    (docs/autopilot_facts.md, 7).
    """
    goal = now.home
    goal[:2] = now.position[:2]
    step = Step(goal=goal, kind=podwatch.setpoint_t.TAKEOFF)
    vehicle = now.inputs.vehicle
    on_ground = vehicle is None or vehicle.landed
    if not on_ground and now.position[2] <= goal[2] + 1.0:
        step.event = Event.AT_HEIGHT
    elif on_ground and (now.in_state_s > TAKEOFF_LIMIT_S or not now.vehicle_ok):
        step.event = Event.NOT_CLIMBING
    return step


def standby(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Waits over its home, or as a surplus drone at the pod's edge; takes the scout's place when it is the
    lowest left.
    """
    assignment = now.inputs.assignment
    if memory.surplus and memory.find is not None:
        step = fly_to(now, surplus_place(now, memory.find, camera), now.mission.watch.speed_m_s)
        step.on_station = True  # it takes part from here: who gathers again does not wait for it
        step.wants_episode = surplus.asks(now, memory)
        is_new = assignment is not None and episode_key(assignment) > memory.assigned_key
        if assignment is not None and is_new and assignment.certified and assignment.animal >= 0:
            memory.animal, memory.assigned_key = assignment.animal, episode_key(assignment)
            step.event = Event.CERTIFIED
        return step
    step = fly_to(now, now.home, now.mission.search.speed_m_s)
    if memory.find is not None:
        step.event = Event.POD_KNOWN
    elif _lowest_scout(now) == now.drone_id:
        searched = memory.waypoint >= len(spiral_of(now, camera)) - 1
        step.event = Event.SEARCHED if searched else Event.ELECTED
    return step


def _lowest_scout(now: Situation) -> int:
    """The drone that shall scout: who scouts already, else the lowest living in the air with charge."""
    able = (State.TAKEOFF, State.SCOUT, State.STANDBY, State.FOUND)
    least = now.mission.limits.battery_return
    # A row cannot say "unknown": it says 0, and a drone whose battery is really empty lands.
    rows = [r for r in now.others if r.state in able and (r.battery > least or r.battery <= 0)]
    scouting = [row.id for row in rows if row.state in (State.SCOUT, State.FOUND)]
    return min(scouting) if scouting else min([now.drone_id, *(row.id for row in rows)])


def spiral_of(now: Situation, camera: Pinhole) -> Array:
    """(K, 2) the mission's spiral: the same on every drone, so that a waypoint's number says where it is."""
    search = now.mission.search
    centre = np.array([search.north_m, search.east_m])
    return spiral(centre, spacing_for(search.height_m, camera.vfov_rad), search.radius_m)


def scout(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Flies the spiral from the last waypoint that any scout reached; slows down where it may have seen
    something.
    """
    search = now.mission.search
    path = spiral_of(now, camera)
    if memory.target_waypoint is None:
        memory.target_waypoint = min(memory.waypoint, len(path) - 1)
    goal = np.append(path[memory.target_waypoint], -search.height_m)
    step = fly_to(now, goal, SLOW_M_S if memory.gate.share > 0.3 else search.speed_m_s)
    away_m = float(np.linalg.norm(goal[:2] - now.position[:2]))
    if away_m < 4.0 and abs(now.position[2] - goal[2]) < 4.0:
        memory.waypoint = max(memory.waypoint, memory.target_waypoint)
        if memory.target_waypoint == len(path) - 1:
            step.event = Event.SEARCHED
        memory.target_waypoint = min(memory.target_waypoint + 1, len(path) - 1)
    if any(row.state in (State.SCOUT, State.FOUND) and row.id < now.drone_id for row in now.others):
        step.event = Event.OTHER_SCOUTS
    elif memory.find is not None:
        step.event = Event.POD_KNOWN
    elif memory.gate.present and memory.barycentre.centre_ne is not None:
        step.event = Event.PRESENCE
    return step


def found(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Centres over the filtered barycentre of all boxes; its place is the fleet's find."""
    if memory.find is None:
        return Step(goal=now.position, velocity=np.zeros(3), event=Event.PRESENCE_LOST)
    goal = np.append(memory.find.ne, -now.mission.search.height_m)
    step = fly_to(now, goal, now.mission.watch.speed_m_s, feed_ne=memory.find.drift_ne)
    step.cause_utime = now.inputs.detections.utime if now.inputs.detections is not None else 0
    centred = float(np.linalg.norm(goal[:2] - now.position[:2])) < CENTRED_M and now.in_state_s > 3.0
    if not memory.gate.present and now.in_state_s > FIND_LOST_S:
        memory.find = None
        memory.barycentre.reset()
        step.event = Event.PRESENCE_LOST
    elif memory.gate.present and (centred or now.in_state_s > CENTRING_LIMIT_S):
        step.event = Event.CENTRED
    return step


def station(now: Situation, find: Find, camera: Pinhole) -> Array:
    """(3,) this drone's place on the gathering circle over the find.

    After an episode that did not agree the whole circle stands a little turned and higher: other views,
    other boxes. The turn follows from the episode's number, which all drones know, so that the places stay
    apart.
    """
    watch, limits = now.mission.watch, now.mission.limits
    n = len(now.circle)
    n_failed = now.inputs.identities.episode if now.inputs.identities is not None else 0
    height_m = gather_height(
        find.radius_m,
        circle_radius(watch.separation_m, n),
        camera.vfov_rad,
        limits.min_height_m,
        min(watch.max_height_m, limits.max_height_m) / (1 + 0.04 * (n_failed % 3)),
    ) * (1 + 0.04 * (n_failed % 3))
    rank = now.circle.index(now.drone_id)
    return slot(rank, n, find.ne, watch.separation_m, height_m, rotation_rad=0.35 * (n_failed % 5))


def surplus_place(now: Situation, find: Find, camera: Pinhole) -> Array:
    """(3,) a place at the pod's edge, on the side of this drone's slot: near enough to take over, out of the
    others' way.
    """
    place = station(now, find, camera)
    angle = 2 * np.pi * now.circle.index(now.drone_id) / len(now.circle)
    reach_m = find.radius_m + now.mission.watch.separation_m
    place[:2] = find.ne + reach_m * np.array([np.cos(angle), np.sin(angle)])
    return place


def _keep_station(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Fly to the place on the circle or hold it; says whether this drone is on station (level, slow and
    near).
    """
    stuck = Event.STUCK if now.seconds_since(memory.gather_since_us) > GATHER_LIMIT_S else None
    if memory.find is None:
        return Step(goal=now.position, velocity=np.zeros(3), event=stuck)
    goal = inside_fence(station(now, memory.find, camera), now.mission.limits)
    step = fly_to(now, goal, now.mission.watch.speed_m_s, feed_ne=memory.find.drift_ne)
    error_m = float(np.linalg.norm(goal - now.position))
    memory.station_error_m += 0.15 * (error_m - memory.station_error_m)
    # A steady wind may tilt a drone more than 5 degrees for good: after the patience twice as much must do.
    waited = now.seconds_since(memory.gather_since_us) > PATIENCE_S
    drift = np.append(memory.find.drift_ne, 0.0)
    tilt_limit = STATION_TILT_RAD * (2 if waited else 1)
    slow = float(np.linalg.norm(now.velocity - drift)) < STATION_SPEED_M_S * (2 if waited else 1)
    near_m = STATION_M * (1.5 if memory.station_since_us else 1.0)
    step.on_station = memory.station_error_m < near_m and now.tilt_rad < tilt_limit and slow
    if memory.station_error_m >= near_m:
        memory.station_since_us = 0
    elif step.on_station and memory.station_since_us == 0:
        memory.station_since_us = now.utime
    # Once on station a gust may tilt it for a moment: it stays on station while it is near.
    step.on_station = memory.station_since_us > 0
    step.event = stuck
    return step


def _agreement(now: Situation, memory: Memory) -> bool | None:
    """Whether an episode newer than this gathering ended with consensus; None where none ended."""
    identities = now.inputs.identities
    if identities is None or episode_key(identities) <= memory.gather_key or identities.episode_running:
        return None
    return bool(identities.consensus)


def _seen_again(now: Situation, memory: Memory) -> bool:
    """The animal that this drone gave up is in the map again, fresh, and nobody else watches it.

    Not by the word of an episode that began since: that one assigns everybody anew.
    """
    identities = now.inputs.identities
    if identities is None or identities.episode_running or episode_key(identities) > memory.gather_key:
        return False
    taken = any(row.animal == memory.lost_animal for row in now.others)
    return memory.lost_animal >= 0 and not taken and now.map_position(memory.lost_animal, 2.0) is not None


def rendezvous(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """To its place on the circle; then waits until everybody stands, but not for ever."""
    step = _keep_station(now, memory, camera)
    agreed = _agreement(now, memory)
    if _seen_again(now, memory):
        memory.animal, memory.lost_animal = memory.lost_animal, -1
        step.event = Event.SEEN_AGAIN
    elif agreed:
        memory.agreed_key = episode_key(now.inputs.identities)
        step.event = Event.AGREED
    elif agreed is False:
        memory.gather_key = episode_key(now.inputs.identities)
    elif step.on_station and step.event is None:
        settled = (State.REGISTER, State.ASSIGN, State.MONITOR)
        gathering = [row for row in now.others if row.id in now.circle]
        ready = all(row.on_station or row.state in settled for row in gathering)
        if ready or now.seconds_since(memory.station_since_us) > PATIENCE_S:
            step.event = Event.ON_STATION
    return step


def register(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Holds its place and asks for an episode; consensus leads on, anything else to another try."""
    step = _keep_station(now, memory, camera)
    running = now.inputs.identities is not None and now.inputs.identities.episode_running
    agreed = _agreement(now, memory)
    if _seen_again(now, memory):
        memory.animal, memory.lost_animal = memory.lost_animal, -1
        step.event = Event.SEEN_AGAIN
    elif agreed is not None:
        memory.agreed_key = episode_key(now.inputs.identities) if agreed else memory.agreed_key
        step.event = Event.AGREED if agreed else Event.NOT_AGREED
    elif memory.station_error_m > 3 * STATION_M and not running:
        step.event = Event.OFF_STATION
    elif not running:
        lower = [row for row in now.others if row.id < now.drone_id and row.state == State.REGISTER]
        step.wants_episode = not lower or now.in_state_s > ASK_AFTER_S
    return step


def assign(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Holds its place until the certificate says who takes which animal."""
    step = _keep_station(now, memory, camera)
    assignment = now.inputs.assignment
    if assignment is not None and assignment.certified and episode_key(assignment) >= memory.agreed_key:
        memory.assigned_key = episode_key(assignment)
        if assignment.animal >= 0:
            memory.animal = assignment.animal
            step.event = Event.CERTIFIED
        elif assignment.surplus:
            step.event = Event.SURPLUS
    limit_s = max(ASSIGN_LIMIT_S, ASSIGN_LIMIT_A_DRONE_S * len(now.mission.roster))
    if step.event is None and now.in_state_s > limit_s:
        step.event = Event.NOT_CERTIFIED
    return step


def return_home(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Home at its own layer; high up on the way, so that it leaves the pod in the layer in which it
    watched.
    """
    goal = now.home
    away_m = float(np.linalg.norm(goal[:2] - now.position[:2]))
    if away_m > 20.0:
        goal[2] = min(goal[2], now.position[2])
    step = fly_to(now, goal, now.mission.watch.speed_m_s, levels_first=False)
    if away_m < STATION_M and abs(goal[2] - now.position[2]) < STATION_M:
        step.event = Event.HOME
    return step


def land(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Down where it is."""
    goal = np.array([now.position[0], now.position[1], 0.0])
    return Step(goal=goal, kind=podwatch.setpoint_t.LAND)


def hold(now: Situation, memory: Memory, camera: Pinhole) -> Step:
    """Stays where it was when the doubt came; on again when it is over, home when it lasts and the position
    is good.
    """
    vehicle = now.inputs.vehicle
    if vehicle is not None and not vehicle.guided and now.told:
        memory.held_us = memory.pilot_us = now.utime
        memory.hold_ned = None
        return Step(goal=now.position, kind=podwatch.setpoint_t.IDLE)
    if not now.vehicle_ok:
        memory.hold_ned = None
        memory.held_us = now.utime
        return Step(goal=now.position, kind=podwatch.setpoint_t.HOLD)
    if memory.hold_ned is None:
        memory.hold_ned = now.position.copy()
    step = fly_to(now, memory.hold_ned, now.mission.watch.speed_m_s)
    ordered = now.command == podwatch.operator_t.HOLD
    # Two seconds without doubt: a state that comes and goes must not throw the drone about.
    if not ordered and now.seconds_since(memory.held_us) > 2.0:
        step.event = memory.resume
    elif not ordered and now.seconds_since(max(memory.since_us, memory.pilot_us)) > HOLD_LIMIT_S:
        step.event = Event.HELD_TOO_LONG
    return step


def fly_to(
    now: Situation, goal: Array, speed_m_s: float, levels_first: bool = True, feed_ne: Array | None = None
) -> Step:
    """A step towards `goal` (3,), moved inside the fence, that itself moves with `feed_ne` (2,) m/s.

    On the way to a far goal it changes its height, and comes nearer than LEVEL_AT_M only in its own layer.
    """
    goal = inside_fence(goal, now.mission.limits)
    waypoint = goal.copy()
    away = now.position[:2] - goal[:2]
    away_m = float(np.linalg.norm(away))
    if levels_first and away_m > LEVEL_AT_M and abs(goal[2] - now.position[2]) > 4.0:
        waypoint[:2] += away * LEVEL_AT_M / away_m
    feed = None if feed_ne is None else np.append(feed_ne, 0.0)
    return Step(goal=goal, velocity=approach(now.position, waypoint, speed_m_s, feed))
