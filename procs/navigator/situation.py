"""What the navigator hears, what it says, what it remembers, and how one moment looks through the mission's
eyes.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lcmtypes import podwatch
from procs.history import PoseHistory
from procs.navigator.formation import layer_heights
from procs.navigator.presence import Barycentre, PresenceGate
from procs.navigator.servo import AnimalFilter
from procs.navigator.states import IN_CIRCLE, Event, State
from procs.settings import Mission

__all__ = ["Find", "Inputs", "Memory", "Outputs", "Situation", "Step", "episode_key"]

Array = NDArray[np.float64]
EpisodeKey = tuple[int, int]

WAITS = "waits for the mission to begin"
VEHICLE_LIMIT_S = 1.0  # an older vehicle state is doubt
LINK_LIMIT_S = 2.0  # the autopilot's own heartbeat comes at 1 Hz
# A drone that is heard no more may still be there, or fly on: kept clear of for so long after its last word.
OBSTACLE_S = 30.0
ABOVE_GROUND_M = 1.0


@dataclass(frozen=True)
class Inputs:
    """The newest of everything at `utime` (us, drone clock); None where nothing was heard yet.

    vehicle_heard_us: when `vehicle` was heard; its own utime is its position's, which may be lost while the
    rest of it is new. 0: taken for as old as its position.
    """

    utime: int
    vehicle: podwatch.vehicle_state_t | None = None
    detections: podwatch.detections_t | None = None
    identities: podwatch.identities_t | None = None
    assignment: podwatch.assignment_t | None = None
    track: podwatch.track_t | None = None
    fleet: podwatch.fleet_state_t | None = None
    vehicle_heard_us: int = 0


@dataclass(frozen=True)
class Outputs:
    """One setpoint, and the mission state; None while a restarted navigator still listens for its own last
    one.
    """

    setpoint: podwatch.setpoint_t
    mission: podwatch.mission_state_t | None


@dataclass(frozen=True)
class Find:
    """A pod: its middle on the ground (2,) north, east, its radius and its drift (2,) in m/s."""

    ne: Array
    radius_m: float
    drift_ne: Array = field(default_factory=lambda: np.zeros(2))


@dataclass
class Step:
    """What a behaviour wants: to fly `velocity` (3,) (None: hold by the autopilot) towards `goal` (3,), or
    an event.
    """

    velocity: Array | None = None
    goal: Array | None = None
    kind: int = podwatch.setpoint_t.VELOCITY
    event: Event | None = None
    on_station: bool = False
    wants_episode: bool = False
    cause_utime: int = 0


@dataclass
class Memory:
    """All that the navigator carries from one update to the next."""

    gate: PresenceGate
    barycentre: Barycentre
    animal_filter: AnimalFilter
    find_filter: AnimalFilter
    poses: PoseHistory = field(default_factory=PoseHistory)
    state: State = State.IDLE
    since_us: int = 0
    reason: str = WAITS
    yaw_rad: float | None = None  # the heading at the first word of the autopilot; kept through the flight
    waypoint: int = 0  # last reached by any scout
    target_waypoint: int | None = None
    find: Find | None = None
    animal: int = -1
    lost_animal: int = -1  # given up as lost; taken up again when the map sees it and nobody else has it
    surplus: bool = False
    gather_key: EpisodeKey = (0, 0)  # newest episode that had ended when this gathering began
    gather_since_us: int = 0
    station_since_us: int = 0  # 0 while off station
    station_error_m: float = 0.0  # low-pass: one noisy position must not push a drone off its station
    agreed_key: EpisodeKey = (0, 0)
    assigned_key: EpisodeKey = (0, 0)
    seen_us: int = 0  # capture time of the last sight of the own animal
    conflict_since_us: int = 0
    strangers_since_us: int = 0  # since when MONITOR sees animals without names only, 0 while it does not
    n_conflicts: int = 0
    sight_us: int = 0  # capture time of the newest detections heard in any state
    detections_us: int = 0  # capture time of the newest detections that were taken in
    first_watch_us: int = 0  # when the first drone was seen in MONITOR, 0 while none is
    watched_us: int = 0  # for how long the fleet has watched so far, in all
    clock_us: int = 0  # when that was last counted on
    free_since_us: int = 0  # since when a surplus drone sees animals that nobody watches, 0 while it does not
    free_animals: tuple[int, ...] = ()  # those
    free_key: EpisodeKey = (0, 0)  # newest episode that had ended when they were looked at last
    stranger_since_us: int = 0  # since when it sees, as surplus, an animal without a name; 0: not
    stranger_key: EpisodeKey = (0, 0)  # newest episode that had ended when it asked for that last
    n_for_strangers: int = 0  # episodes after which it did so
    n_asked: int = 0  # episodes that have ended and left them to nobody
    boat_us: int = 0  # when there was word of the boat last, 0 while there was none
    held_us: int = 0  # last instant of doubt
    pilot_us: int = 0  # last instant at which the pilot had it
    watch_seen: bool = False  # it has seen the fleet watch, at any time
    resumed: bool = False  # started in flight: it does not know since when the fleet watches
    hold_ned: Array | None = None
    resume: Event = Event.TO_STANDBY
    start_order_us: int = 0  # utime of the START order that was already obeyed
    landed_us: int = 0  # when it came to be LANDED, or was found so at its start; 0 before


def episode_key(message: podwatch.identities_t | podwatch.assignment_t | None) -> EpisodeKey:
    """(number, proposer) of the newest ended episode; the larger is the newer (docs/navigator.md)."""
    if message is None:
        return (0, 0)
    if isinstance(message, podwatch.identities_t):
        return (message.episode, message.episode_proposer)
    return (message.episode, message.proposer)


@dataclass(frozen=True)
class Situation:
    """One moment: the inputs with their ages judged, and the fleet as this drone sees it."""

    mission: Mission
    drone_id: int
    inputs: Inputs
    memory: Memory

    @property
    def utime(self) -> int:
        return self.inputs.utime

    def seconds_since(self, utime: int) -> float:
        return (self.inputs.utime - utime) * 1e-6

    @property
    def in_state_s(self) -> float:
        return self.seconds_since(self.memory.since_us)

    @property
    def vehicle_fresh(self) -> bool:
        vehicle = self.inputs.vehicle
        return vehicle is not None and self.seconds_since(vehicle.utime) <= VEHICLE_LIMIT_S

    @property
    def link_ok(self) -> bool:
        """The bridge hears the autopilot: else what it says of the vehicle is old, or defaults."""
        vehicle = self.inputs.vehicle
        return vehicle is not None and vehicle.link_age_ms <= LINK_LIMIT_S * 1e3

    @property
    def told(self) -> bool:
        """The autopilot tells of itself now: armed, landed, mode and battery hold, whether or not it has a
        position.
        """
        vehicle = self.inputs.vehicle
        heard_us = 0 if vehicle is None else self.inputs.vehicle_heard_us or vehicle.utime
        return vehicle is not None and self.link_ok and self.seconds_since(heard_us) <= VEHICLE_LIMIT_S

    @property
    def battery(self) -> float | None:
        """0-1, what remains; None where the autopilot does not know it (below 0, or no number)."""
        vehicle = self.inputs.vehicle
        return vehicle.battery if vehicle is not None and vehicle.battery >= 0 else None

    @property
    def vehicle_ok(self) -> bool:
        """The vehicle's state is fresh, its link alive and its position good: it may be flown on
        setpoints.
        """
        vehicle = self.inputs.vehicle
        return (
            vehicle is not None
            and self.vehicle_fresh
            and vehicle.position_ok
            and self.link_ok
            and bool(np.isfinite([vehicle.n_m, vehicle.e_m, vehicle.d_m]).all())
        )

    @cached_property
    def position(self) -> Array:
        """(3,) NED, carried forward by the age of the vehicle's state; zeros before the first."""
        vehicle = self.inputs.vehicle
        if vehicle is None:
            return np.zeros(3)
        age_s = min(max(self.seconds_since(vehicle.utime), 0.0), VEHICLE_LIMIT_S)
        return np.array([vehicle.n_m, vehicle.e_m, vehicle.d_m], dtype=np.float64) + self.velocity * age_s

    @cached_property
    def velocity(self) -> Array:
        vehicle = self.inputs.vehicle
        return (
            np.zeros(3)
            if vehicle is None
            else np.array([vehicle.vn_m_s, vehicle.ve_m_s, vehicle.vd_m_s], dtype=np.float64)
        )

    @property
    def tilt_rad(self) -> float:
        vehicle = self.inputs.vehicle
        return (
            0.0 if vehicle is None else float(np.arccos(np.cos(vehicle.roll_rad) * np.cos(vehicle.pitch_rad)))
        )

    @cached_property
    def others(self) -> list[podwatch.fleet_row_t]:
        """Living drones but this one, by id."""
        rows = self.inputs.fleet.rows if self.inputs.fleet is not None else []
        return sorted(
            (r for r in rows if r.alive and r.id >= 1 and r.id != self.drone_id), key=lambda r: r.id
        )

    @cached_property
    def obstacles(self) -> list[podwatch.fleet_row_t]:
        """Drones to keep clear of: all others in the air, the silent for OBSTACLE_S after their last word.

        By the age of what is known, not by `alive` alone: where this drone's own relay has died, the table
        itself grows old.
        """
        rows = self.inputs.fleet.rows if self.inputs.fleet is not None else []
        table_s = self.seconds_since(self.inputs.fleet.utime) if self.inputs.fleet is not None else 0.0
        return sorted(
            (
                row
                for row in rows
                if row.id >= 1
                and row.id != self.drone_id
                and row.d_m < -ABOVE_GROUND_M
                and (self.row_age_s(row) <= OBSTACLE_S or (row.alive and table_s <= OBSTACLE_S))
            ),
            key=lambda row: row.id,
        )

    @cached_property
    def own_row(self) -> podwatch.fleet_row_t | None:
        rows = self.inputs.fleet.rows if self.inputs.fleet is not None else []
        return next((row for row in rows if row.id == self.drone_id), None)

    @cached_property
    def boat(self) -> podwatch.fleet_row_t | None:
        rows = self.inputs.fleet.rows if self.inputs.fleet is not None else []
        return next((row for row in rows if row.id == 0 and row.alive), None)

    def row_age_s(self, row: podwatch.fleet_row_t) -> float:
        said = self.inputs.fleet.utime if self.inputs.fleet is not None else self.utime
        return row.age_ms * 1e-3 + max(self.seconds_since(said), 0.0)

    @cached_property
    def circle(self) -> list[int]:
        """Ids of the drones that have a place on the gathering circle, this one among them, in ring order."""
        return sorted([self.drone_id, *(row.id for row in self.others if row.state in IN_CIRCLE)])

    @property
    def home(self) -> Array:
        """(3,) over the home slot, at this drone's layer; round the boat where it is heard."""
        entry = self.mission.home(self.drone_id)
        height_m = self.layer(self.mission.limits.min_height_m + 2.0)
        base = (0.0, 0.0) if self.boat is None else (self.boat.n_m, self.boat.e_m)
        return np.array([base[0] + entry.home_n_m, base[1] + entry.home_e_m, -height_m])

    def layer(self, lowest_m: float, most: int = 4) -> float:
        """This drone's height in the roster's layers, `most` at most, from `lowest_m` up."""
        roster = self.mission.roster
        heights = layer_heights(len(roster), lowest_m, self.mission.limits.max_height_m - 1.0, most=most)
        return float(heights[roster.index(self.drone_id)])

    @property
    def fleet_offset_us(self) -> int:
        """Fleet time is the drone's clock plus this."""
        return int(self.inputs.fleet.fleet_offset_us) if self.inputs.fleet is not None else 0

    @property
    def command(self) -> int:
        """The operator's command that holds for this drone now (operator_t)."""
        order = self.inputs.fleet.order if self.inputs.fleet is not None else None
        if order is None or order.utime == 0 or order.target not in (0, self.drone_id):
            return int(podwatch.operator_t.NONE)
        return int(order.command)

    @property
    def left(self) -> tuple[int, ...]:
        """Animals that the boat ordered to leave."""
        return tuple(self.inputs.fleet.left) if self.inputs.fleet is not None else ()

    def map_position(self, animal: int, max_age_s: float = 60.0) -> Array | None:
        """(2,) of an animal in the fleet's map, None where the map does not hold it or held it too long
        ago.
        """
        entry = self.map_entry(animal)
        if entry is None or entry.age_ms * 1e-3 + self.seconds_since(self._identities_utime) > max_age_s:
            return None
        return np.array([entry.n_m, entry.e_m], dtype=np.float64)

    def map_entry(self, animal: int) -> podwatch.map_animal_t | None:
        identities = self.inputs.identities
        entries = identities.map if identities is not None else []
        return next((entry for entry in entries if entry.id == animal >= 0), None)

    @property
    def _identities_utime(self) -> int:
        return self.inputs.identities.utime if self.inputs.identities is not None else self.utime
