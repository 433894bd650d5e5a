"""The mission's states and the one table of the steps between them (docs/navigator.md).

The navigator can change state only through `next_state`, and docs/navigator.md draws `diagram()`: a test
compares the two.
"""

from dataclasses import dataclass
from enum import Enum, IntEnum

__all__ = ["FLYING", "GATHERED", "IN_CIRCLE", "RULES", "Event", "Rule", "State", "diagram", "next_state"]


class State(IntEnum):
    """What a drone is doing; the value travels in MISSION_STATE and in the fleet table."""

    IDLE = 0  # on the ground, not started
    TAKEOFF = 1
    SCOUT = 2  # flies the spiral
    STANDBY = 3  # waits in the air: for the scout's find, or as a surplus drone near the pod
    FOUND = 4  # has found a pod and centres over it
    RENDEZVOUS = 5  # flies to its place on the gathering circle
    REGISTER = 6  # holds its place while the ring agrees which animal is which
    ASSIGN = 7  # holds its place while the ring agrees who takes which animal
    MONITOR = 8  # keeps its animal in view
    RETURN = 9
    LANDED = 10
    HOLD = 11  # in doubt, or as ordered: stays where it is
    LAND = 12  # comes down where it is


class Event(Enum):
    """What makes a drone change its state; the value is the reason that people read."""

    START = "the mission begins"
    IN_AIR = "started in flight"
    LANDS_ON = "started while it came down"
    ALREADY_HOME = "landed before this start"
    AT_HEIGHT = "at height"
    NOT_CLIMBING = "take-off did not happen"
    ELECTED = "lowest living drone that may scout"
    OTHER_SCOUTS = "a lower drone scouts"
    PRESENCE = "animals in view"
    PRESENCE_LOST = "animals gone from view"
    CENTRED = "over the pod"
    POD_KNOWN = "the fleet knows a pod"
    SEARCHED = "searched all and found nothing"
    ON_STATION = "everybody on station"
    OFF_STATION = "pushed off station"
    NOT_AGREED = "the ring did not agree"
    AGREED = "the ring agreed on the animals"
    SEEN_AGAIN = "its animal is seen again"
    CERTIFIED = "an animal of its own"
    SURPLUS = "fewer animals than drones"
    NOT_CERTIFIED = "no certificate in time"
    ANIMAL_LOST = "animal not seen for too long"
    CONFLICT = "two drones over one animal"
    LEAVE = "ordered to leave this animal"
    WATCHED = "watched for as long as asked"
    FLEET_RETURNS = "the fleet returns"
    STUCK = "no agreement in the time that a fleet may hover"
    BLIND = "its camera or detector is silent"
    HOME = "over its home"
    AIRBORNE = "in the air after all"
    TOUCHED_DOWN = "on the ground, disarmed"
    DOUBT = "position or autopilot in doubt"
    PILOT = "the pilot has it"
    BATTERY_LOW = "battery low"
    BATTERY_EMPTY = "battery nearly empty"
    ORDER_HOLD = "ordered to hold"
    ORDER_RETURN = "ordered to return"
    ORDER_LAND = "ordered to land"
    BOAT_LOST = "the boat is silent"
    HELD_TOO_LONG = "held too long"
    TO_STANDBY = "holds no more: stands by"
    TO_SCOUT = "holds no more: scouts on"
    TO_RENDEZVOUS = "holds no more: gathers"
    TO_MONITOR = "holds no more: watches its animal again"
    TO_RETURN = "holds no more: returns on"
    TO_LAND = "holds no more: lands on"


S, E = State, Event

AT_WORK = (S.TAKEOFF, S.SCOUT, S.STANDBY, S.FOUND, S.RENDEZVOUS, S.REGISTER, S.ASSIGN, S.MONITOR)
FLYING = (*AT_WORK, S.RETURN)
# States whose drones have a place on the gathering circle: all that may soon fly over the pod.
IN_CIRCLE = (*AT_WORK, S.HOLD)
GATHERED = (S.RENDEZVOUS, S.REGISTER, S.ASSIGN)


@dataclass(frozen=True)
class Rule:
    """From each of `sources`, `event` leads to `target`."""

    sources: tuple[State, ...]
    event: Event
    target: State


RULES = (
    Rule((S.IDLE, S.LANDED), E.START, S.TAKEOFF),
    Rule((S.IDLE,), E.IN_AIR, S.HOLD),
    Rule((S.IDLE,), E.LANDS_ON, S.LAND),
    Rule((S.IDLE,), E.ALREADY_HOME, S.LANDED),
    Rule((S.TAKEOFF,), E.AT_HEIGHT, S.STANDBY),
    Rule((S.TAKEOFF,), E.NOT_CLIMBING, S.IDLE),
    Rule((S.STANDBY,), E.ELECTED, S.SCOUT),
    Rule((S.STANDBY,), E.SEARCHED, S.RETURN),
    Rule((S.SCOUT,), E.OTHER_SCOUTS, S.STANDBY),
    Rule((S.SCOUT,), E.PRESENCE, S.FOUND),
    Rule((S.SCOUT,), E.SEARCHED, S.RETURN),
    Rule((S.FOUND,), E.PRESENCE_LOST, S.SCOUT),
    Rule((S.FOUND,), E.CENTRED, S.RENDEZVOUS),
    Rule((S.STANDBY, S.SCOUT), E.POD_KNOWN, S.RENDEZVOUS),
    Rule((S.RENDEZVOUS,), E.ON_STATION, S.REGISTER),
    Rule((S.REGISTER,), E.OFF_STATION, S.RENDEZVOUS),
    Rule((S.REGISTER,), E.NOT_AGREED, S.RENDEZVOUS),
    Rule((S.RENDEZVOUS, S.REGISTER), E.AGREED, S.ASSIGN),
    Rule((S.RENDEZVOUS, S.REGISTER), E.SEEN_AGAIN, S.MONITOR),
    Rule((S.ASSIGN,), E.NOT_CERTIFIED, S.RENDEZVOUS),
    Rule((S.ASSIGN, S.STANDBY), E.CERTIFIED, S.MONITOR),
    Rule((S.ASSIGN, S.MONITOR), E.SURPLUS, S.STANDBY),
    Rule((S.MONITOR,), E.ANIMAL_LOST, S.RENDEZVOUS),
    Rule((S.MONITOR,), E.CONFLICT, S.RENDEZVOUS),
    Rule((S.MONITOR,), E.LEAVE, S.STANDBY),
    Rule((S.STANDBY, *GATHERED, S.MONITOR), E.WATCHED, S.RETURN),
    Rule((S.STANDBY, *GATHERED, S.MONITOR), E.FLEET_RETURNS, S.RETURN),
    Rule(GATHERED, E.STUCK, S.RETURN),
    Rule(GATHERED, E.BLIND, S.RETURN),
    Rule((S.RETURN,), E.HOME, S.LAND),
    Rule((S.LAND,), E.TOUCHED_DOWN, S.LANDED),
    Rule((S.RETURN, S.HOLD), E.TOUCHED_DOWN, S.LANDED),
    Rule((S.LANDED,), E.AIRBORNE, S.HOLD),
    Rule(FLYING, E.DOUBT, S.HOLD),
    Rule(FLYING, E.PILOT, S.HOLD),
    Rule(FLYING, E.ORDER_HOLD, S.HOLD),
    Rule(FLYING, E.ORDER_LAND, S.LAND),
    Rule(FLYING, E.BATTERY_EMPTY, S.LAND),
    Rule(AT_WORK, E.ORDER_RETURN, S.RETURN),
    Rule(AT_WORK, E.BOAT_LOST, S.RETURN),
    Rule(AT_WORK, E.BATTERY_LOW, S.RETURN),
    Rule((S.HOLD,), E.TO_STANDBY, S.STANDBY),
    Rule((S.HOLD,), E.TO_SCOUT, S.SCOUT),
    Rule((S.HOLD,), E.TO_RENDEZVOUS, S.RENDEZVOUS),
    Rule((S.HOLD,), E.TO_MONITOR, S.MONITOR),
    Rule((S.HOLD,), E.TO_RETURN, S.RETURN),
    Rule((S.HOLD,), E.TO_LAND, S.LAND),
    Rule((S.HOLD,), E.HELD_TOO_LONG, S.RETURN),
    Rule((S.HOLD,), E.ORDER_RETURN, S.RETURN),
    Rule((S.HOLD,), E.BOAT_LOST, S.RETURN),
    Rule((S.HOLD,), E.ORDER_LAND, S.LAND),
    Rule((S.HOLD,), E.BATTERY_LOW, S.RETURN),
    Rule((S.HOLD,), E.BATTERY_EMPTY, S.LAND),
)

_TABLE = {(source, rule.event): rule.target for rule in RULES for source in rule.sources}


def next_state(state: State, event: Event) -> State | None:
    """Where `event` leads from `state`; None where the table has no such step, and nothing happens."""
    return _TABLE.get((state, event))


def diagram() -> str:
    """The table as a Mermaid state diagram; a rule that holds in a whole group is drawn once, from the
    group.
    """
    groups = {FLYING: "FLYING", AT_WORK: "AT_WORK"}
    lines = ["stateDiagram-v2", "    [*] --> IDLE", "    state FLYING {", "        state AT_WORK {"]
    lines += [f"            {state.name}" for state in AT_WORK]
    lines += ["        }", "        RETURN", "    }"]
    for rule in RULES:
        sources = [groups[rule.sources]] if rule.sources in groups else [state.name for state in rule.sources]
        lines += [f"    {source} --> {rule.target.name}: {rule.event.value}" for source in sources]
    # Mermaid reads a second colon as the end of the text.
    return "\n".join(line.replace(": ", " : ", 1).replace("over: ", "over, ") for line in lines) + "\n"
