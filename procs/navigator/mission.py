"""The navigator's core: one update a tenth of a second, from the newest of everything to one setpoint and
the mission state.

Sense (is a pod in view, where), share (the fleet's find, the watch's clock), decide (states.py), behave
(behaviours.py, monitor.py), keep clear of the others (formation.py) and inside the limits (flight.py). Time
is an argument throughout.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import Pinhole
from lcmtypes import make, podwatch
from procs.history import camera_of
from procs.navigator import behaviours, finds, resume
from procs.navigator.decisions import overriding_events
from procs.navigator.flight import limited
from procs.navigator.formation import separate
from procs.navigator.monitor import monitor
from procs.navigator.presence import Barycentre, PresenceGate
from procs.navigator.servo import AnimalFilter
from procs.navigator.situation import Inputs, Memory, Outputs, Situation, Step, episode_key
from procs.navigator.states import AT_WORK, Event, State, next_state
from procs.settings import Mission

__all__ = ["Inputs", "Navigator", "Outputs"]

Array = NDArray[np.float64]
Behaviour = Callable[[Situation, Memory, Pinhole], Step]

# What is left of the circle's separation before drones push each other apart; never so little that the noise
# of two positions could use it up.
CLEARANCE_SHARE = 0.6
LEAST_CLEARANCE_M = 5.5

BEHAVIOURS: dict[State, Behaviour] = {
    State.IDLE: behaviours.idle,
    State.TAKEOFF: behaviours.takeoff,
    State.SCOUT: behaviours.scout,
    State.STANDBY: behaviours.standby,
    State.FOUND: behaviours.found,
    State.RENDEZVOUS: behaviours.rendezvous,
    State.REGISTER: behaviours.register,
    State.ASSIGN: behaviours.assign,
    State.MONITOR: monitor,
    State.RETURN: behaviours.return_home,
    State.LANDED: behaviours.landed,
    State.HOLD: behaviours.hold,
    State.LAND: behaviours.land,
}


class Navigator:
    """One drone's mission. `update` at about 10 Hz; nothing is heard or said but through it."""

    def __init__(self, mission: Mission, drone_id: int) -> None:
        mission.home(drone_id)  # KeyError names a drone that the roster lacks
        self.mission = mission
        self.drone_id = drone_id
        self.camera = camera_of(mission.camera)
        self.memory = Memory(
            gate=PresenceGate(mission.search.presence_frames, mission.search.presence_share),
            barycentre=Barycentre(reach_m=0.6 * mission.watch.animal_length_m),
            animal_filter=AnimalFilter(mission.watch.max_animal_speed_m_s),
            find_filter=AnimalFilter(mission.watch.max_animal_speed_m_s, alpha=0.2, beta=0.01),
        )
        self._velocity: Array | None = (
            None  # last asked for; None where the last setpoint was of another kind
        )
        self._updated_us = 0
        self._begun_us = 0  # first update; 0 before
        self._listening = True  # for its own last state, before it says anything itself

    @property
    def state(self) -> State:
        return self.memory.state

    def hear_vehicle(self, vehicle: podwatch.vehicle_state_t) -> None:
        """Keep a pose for the frames to come; a shell may call it for every VEHICLE_STATE, `update` does for
        the newest.
        """
        self.memory.poses.add(vehicle)
        if self.memory.yaw_rad is None:
            self.memory.yaw_rad = vehicle.yaw_rad

    def update(self, inputs: Inputs) -> Outputs:
        """One decision on the newest of everything; the setpoint expires setpoint_life_s after
        inputs.utime.
        """
        now = Situation(self.mission, self.drone_id, inputs, self.memory)
        if self._begun_us == 0:
            self._begun_us = self.memory.since_us = inputs.utime
        if inputs.vehicle is not None:
            self.hear_vehicle(inputs.vehicle)
        if self._listening and not self._begin(now):
            return Outputs(self._setpoint(now, Step(kind=podwatch.setpoint_t.IDLE)), None)
        finds.sense(now, self.memory, self.camera)
        finds.share(now, self.memory, self.camera)
        finds.keep_clock(now, self.memory)
        self._decide(now)
        step = BEHAVIOURS[self.memory.state](now, self.memory, self.camera)
        setpoint = self._setpoint(now, step)
        if step.event is not None:
            self._step_to(step.event, inputs)
        return Outputs(setpoint, self._mission_state(now, step))

    def _begin(self, now: Situation) -> bool:
        """Find out whether the drone is in flight already; False while that is not known."""
        if not now.told:
            return False
        waited_s = now.seconds_since(self._begun_us)
        if now.own_row is None and waited_s < resume.LISTEN_S:
            return False
        self._listening = False
        self.memory.since_us = now.utime
        event = resume.take_up(now, self.memory)
        if event is not None:
            self._step_to(event, now.inputs)
        return True

    def _decide(self, now: Situation) -> None:
        for event in overriding_events(now, self.memory):
            if next_state(self.memory.state, event) is not None:
                self._step_to(event, now.inputs)
                return

    def _step_to(self, event: Event, inputs: Inputs) -> None:
        memory = self.memory
        target = next_state(memory.state, event)
        if target is None:
            return
        if target == State.HOLD:
            memory.hold_ned = None
            memory.held_us = inputs.utime
            if event is not Event.IN_AIR:
                memory.resume = resume.after(memory)
        elif target == State.SCOUT:
            memory.gate.reset()
            memory.target_waypoint = None
        elif target == State.RENDEZVOUS:
            if memory.state not in (State.REGISTER, State.ASSIGN):
                memory.gather_since_us = inputs.utime
            if memory.state == State.MONITOR and memory.find is not None:
                memory.barycentre.reset()  # what it saw of the pod was before the watch
                memory.barycentre.start_at(memory.find.ne, memory.find.radius_m)
            memory.gather_key = max(memory.gather_key, episode_key(inputs.identities))
            memory.station_since_us, memory.station_error_m = 0, 100.0
            memory.animal, memory.surplus, memory.conflict_since_us = -1, False, 0
        elif target == State.MONITOR:
            memory.animal_filter.reset()
            memory.seen_us = inputs.utime
            memory.surplus = False
        elif target == State.STANDBY:
            memory.surplus = event in (Event.SURPLUS, Event.LEAVE) or memory.surplus
            memory.animal = -1
        elif target == State.ASSIGN:
            memory.lost_animal = -1
        elif target in (State.RETURN, State.LAND, State.LANDED):
            memory.find, memory.animal, memory.surplus = None, -1, False
        if target == State.LANDED:
            memory.landed_us = inputs.utime
        memory.state, memory.since_us, memory.reason = target, inputs.utime, event.value

    def _clear(self, now: Situation, velocity: Array) -> Array:
        """`velocity` bent so that the drone keeps clear of every other one in the air, heard or silent."""
        rows = now.obstacles
        if not rows:
            return velocity
        return separate(
            velocity,
            now.position,
            np.array([[row.n_m, row.e_m, row.d_m] for row in rows], dtype=np.float64),
            np.array([[row.vn_m_s, row.ve_m_s, row.vd_m_s] for row in rows], dtype=np.float64),
            np.array([now.row_age_s(row) for row in rows]),
            max(CLEARANCE_SHARE * self.mission.watch.separation_m, LEAST_CLEARANCE_M),
        )

    def _setpoint(self, now: Situation, step: Step) -> podwatch.setpoint_t:
        dt_s = float(np.clip((now.utime - self._updated_us) * 1e-6, 0.02, 0.5))
        self._updated_us = now.utime
        velocity = np.zeros(3)
        if step.kind == podwatch.setpoint_t.VELOCITY and step.velocity is not None:
            previous = now.velocity if self._velocity is None else self._velocity
            wanted = self._clear(now, step.velocity)
            velocity = limited(wanted, previous, now.position, dt_s, self.mission.limits)
            self._velocity = velocity
        else:
            self._velocity = None
        goal = now.position if step.goal is None else step.goal
        setpoint = make(
            podwatch.setpoint_t,
            utime=now.utime,
            drone_id=self.drone_id,
            expiry_utime=now.utime + round(self.mission.limits.setpoint_life_s * 1e6),
            cause_utime=step.cause_utime,
            n_m=float(goal[0]),
            e_m=float(goal[1]),
            d_m=float(goal[2]),
            vn_m_s=float(velocity[0]),
            ve_m_s=float(velocity[1]),
            vd_m_s=float(velocity[2]),
            yaw_rad=float(self.memory.yaw_rad or 0.0),
        )
        setpoint.kind = step.kind
        return setpoint

    def _mission_state(self, now: Situation, step: Step) -> podwatch.mission_state_t:
        memory = self.memory
        goal = now.position if step.goal is None else step.goal
        find = memory.find if memory.state in (*AT_WORK, State.HOLD) else None
        return make(
            podwatch.mission_state_t,
            utime=now.utime,
            drone_id=self.drone_id,
            state=int(memory.state),
            since_utime=memory.since_us,
            reason=memory.reason,
            animal=memory.animal,
            waypoint=memory.waypoint,
            found=find is not None,
            found_n_m=0.0 if find is None else float(find.ne[0]),
            found_e_m=0.0 if find is None else float(find.ne[1]),
            pod_radius_m=0.0 if find is None else find.radius_m,
            target_n_m=float(goal[0]),
            target_e_m=float(goal[1]),
            target_d_m=float(goal[2]),
            wants_episode=step.wants_episode,
            on_station=step.on_station,
            command=now.command,
        )
