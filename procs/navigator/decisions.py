"""What overrides every behaviour: the pilot, the boat's orders, the battery, doubt, and the end of the
watch.
"""

from lcmtypes import podwatch
from procs.navigator.situation import Memory, Situation
from procs.navigator.states import GATHERED, Event, State

__all__ = ["overriding_events", "pilot_has_it"]

# So that every drone's watch covers what was asked, though their clocks start a second apart.
WATCH_MARGIN_S = 2.0
BLIND_LIMIT_S = 10.0  # longer than the detector takes to start again
_GOING_HOME = (State.RETURN, State.LAND, State.LANDED)


def in_air(now: Situation) -> bool:
    """The autopilot says now that it is armed and not on the ground."""
    vehicle = now.inputs.vehicle
    return vehicle is not None and now.told and vehicle.armed and not vehicle.landed


def pilot_has_it(now: Situation) -> bool:
    """In the air and not guided: the pilot, a ground station or a failsafe of the autopilot flies."""
    vehicle = now.inputs.vehicle
    return vehicle is not None and now.told and not vehicle.guided and not vehicle.landed


def overriding_events(now: Situation, memory: Memory) -> list[Event]:
    """Events that hold now, the weightiest first; the table says which of them lead anywhere from the
    present state.
    """
    operator = podwatch.operator_t
    vehicle, limits = now.inputs.vehicle, now.mission.limits
    down = vehicle is not None and now.told and vehicle.landed and not vehicle.armed
    if down and memory.state in (State.RETURN, State.LAND, State.HOLD):
        return [Event.TOUCHED_DOWN]
    if memory.state == State.LANDED and in_air(now):
        return [Event.AIRBORNE]  # who flies it and on what charge is then HOLD's to judge
    if pilot_has_it(now):
        return [Event.PILOT]  # the pilot's stick always wins: no order, no battery moves the drone
    events = []
    if now.battery is not None and now.told and now.battery < limits.battery_land:
        events.append(Event.BATTERY_EMPTY)
    if now.command == operator.LAND:
        events.append(Event.ORDER_LAND)
    on_ground = vehicle is not None and vehicle.landed and memory.state == State.TAKEOFF
    if on_ground:
        return events
    if not now.vehicle_ok or down:
        return [*events, Event.DOUBT]
    if now.battery is not None and now.battery < limits.battery_return:
        return [*events, Event.BATTERY_LOW]
    boat_is_lost = _boat_is_lost(now, memory)
    if boat_is_lost:
        events.append(Event.BOAT_LOST)
    if now.command == operator.RETURN:
        events.append(Event.ORDER_RETURN)
    if now.command == operator.HOLD and not boat_is_lost:
        events.append(Event.ORDER_HOLD)
    if _is_blind(now, memory):
        events.append(Event.BLIND)
    if memory.watched_us * 1e-6 > now.mission.watch.watch_s + WATCH_MARGIN_S:
        events.append(Event.WATCHED)
    if _fleet_returns(now, memory):
        events.append(Event.FLEET_RETURNS)
    return events


def _boat_is_lost(now: Situation, memory: Memory) -> bool:
    """The mission asks to come home without the boat, and there was word of it but is none any more."""
    fleet, limit_s = now.inputs.fleet, now.mission.boat.lost_return_s
    if fleet is not None and fleet.boat_age_ms >= 0:  # a relay that starts anew has never heard it
        memory.boat_us = max(memory.boat_us, fleet.utime - fleet.boat_age_ms * 1000)
    return limit_s > 0 and memory.boat_us > 0 and now.seconds_since(memory.boat_us) > limit_s


def _is_blind(now: Situation, memory: Memory) -> bool:
    """Gathered, and for long not one frame was searched: a member without sight costs every episode its
    consensus.

    In MONITOR the tracker may go on without the detector; a camera that is silent loses it the animal, and so
    brings it here.
    """
    if memory.state not in GATHERED:
        return False
    return now.seconds_since(max(memory.sight_us, memory.gather_since_us)) > BLIND_LIMIT_S


def _fleet_returns(now: Situation, memory: Memory) -> bool:
    """All others go home, and not for want of charge: the watch is over, though this drone may not know
    since when. While nobody has watched yet, they go for a reason of their own: blind, or ordered.
    """
    if not (memory.watch_seen or memory.resumed):
        return False
    if memory.find is None or not now.others or (memory.state == State.MONITOR and not memory.resumed):
        return False
    charged = [row for row in now.others if row.battery > now.mission.limits.battery_return + 0.02]
    return bool(charged) and all(row.state in _GOING_HOME for row in now.others)
