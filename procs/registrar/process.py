"""The registrar: agrees with the ring which animal is which, and names the boxes of the newest detected
frame.

Hears DETECTIONS, VEHICLE_STATE, MISSION_STATE (does the navigator want an episode), FLEET_STATE (members,
fleet time) and the neighbours' RING_EPISODE and RING_MAP. Says IDENTITIES for every detected frame, and
RING_EPISODE and RING_MAP at 5 Hz while an episode runs; between episodes the map's upkeep at 1 Hz. Without
detections it says nothing new; without the fleet it registers alone.
"""

import numpy as np

from lcmtypes import channels, make
from lcmtypes.podwatch import (
    detections_t,
    episode_t,
    fleet_state_t,
    identities_t,
    map_animal_t,
    mission_state_t,
    ring_map_t,
    vehicle_state_t,
)
from procs.history import PoseHistory, camera_of
from procs.navigator.states import State
from procs.registrar.episodes import from_bitmap, to_bitmap
from procs.registrar.registrar import UPKEEP, Registrar, RingPacket
from procs.registrar.upkeep import UpkeepError
from procs.runtime import Runtime

STEP_S = 0.2
UPKEEP_S = 1.0
# A drone in one of these is on the ground, near it or on its way home: it has no view of the pod, and one
# without a view keeps everybody else from consensus.
AWAY = (State.IDLE, State.TAKEOFF, State.RETURN, State.LAND, State.LANDED)


def able_members(state: fleet_state_t, roster: tuple[int, ...], own_id: int) -> tuple[int, ...]:
    """Whom this drone asks to an episode: itself, and the living that are neither on the ground nor on their
    way home.
    """
    away = [row.id for row in state.rows if row.state in AWAY and row.id != own_id]
    return tuple(member for member in from_bitmap(state.members, roster) if member not in away)


class RegistrarShell:
    """Between the bus and the core."""

    def __init__(self, runtime: Runtime) -> None:
        mission = runtime.settings.mission
        self._runtime = runtime
        self._roster = mission.roster
        self._registrar = Registrar(
            runtime.drone_id,
            mission.roster,
            camera_of(mission.camera),
            mission.watch.animal_length_m,
            mission.watch.episode_limit_s,
            runtime.utime,
        )
        self._poses = PoseHistory()
        self._fleet_offset_us = 0
        self._fleet_time_ok = True  # a drone without a relay is a fleet of one
        self._living: tuple[int, ...] = (runtime.drone_id,)
        self._able: tuple[int, ...] = self._living  # those of them that may see the pod
        self._wants_episode = False
        self._last_said: RingPacket | None = None

    @property
    def _fleet_utime(self) -> int:
        return self._runtime.utime + self._fleet_offset_us

    def on_vehicle(self, state: vehicle_state_t) -> None:
        self._poses.add(state)

    def on_mission(self, state: mission_state_t) -> None:
        self._wants_episode = state.wants_episode

    def on_fleet(self, state: fleet_state_t) -> None:
        """Members and fleet time; a member that is lost leaves the running episode."""
        self._fleet_offset_us = state.fleet_offset_us
        self._fleet_time_ok = state.fleet_time_ok
        living = from_bitmap(state.members, self._roster)
        for lost in [member for member in self._living if member not in living]:
            self._registrar.drop_member(lost)
        self._living = living
        self._registrar.left = tuple(state.left)
        self._able = able_members(state, self._roster, self._runtime.drone_id)

    def on_detections(self, message: detections_t) -> None:
        """Follow the boxes and say who they are."""
        boxes = np.array(
            [[box.left_px, box.top_px, box.right_px, box.bottom_px] for box in message.boxes], dtype=float
        ).reshape(-1, 4)
        if not np.isfinite(boxes).all():
            self._runtime.degraded(
                "DETECTIONS holds a box that is not a number; the frame is left out", cause="nan"
            )
            return
        self._runtime.ok("nan")
        pose = self._poses.at(message.utime)
        taken = self._registrar.detected(message.utime, boxes, pose, message.utime + self._fleet_offset_us)
        if taken is None or pose is None:
            return
        sighting, residual = taken
        finished = self._registrar.finished
        ids = sighting.ids
        animals = [
            make(
                map_animal_t,
                id=entry.animal,
                n_m=float(position[0]),
                e_m=float(position[1]),
                size_m=entry.size_m,
                axis_rad=entry.axis_rad,
                hits=entry.hits,
                misses=entry.misses,
                age_ms=max(0, (message.utime + self._fleet_offset_us - entry.seen_fleet_utime) // 1000),
                mine=entry.animal in ids,
                residual_m=residual.get(entry.animal, 0.0),
            )
            for entry, position in self._registrar.entries_in_own_frame(pose)
        ]
        self._runtime.publish(
            channels.IDENTITIES,
            make(
                identities_t,
                utime=message.utime,
                episode=finished.number if finished else 0,
                episode_proposer=finished.proposer if finished else 0,
                episode_members=to_bitmap(finished.members, self._roster) if finished else 0,
                episode_running=self._registrar.running is not None,
                episode_complete=bool(finished and finished.complete),
                consensus=bool(finished and finished.consensus),
                confidence=finished.confidence if finished else 0.0,
                width=message.width,
                height=message.height,
                n_boxes=message.n_boxes,
                boxes=message.boxes,
                ids=ids,
                n_map=len(animals),
                map=animals,
            ),
        )

    def on_neighbour_episode(self, message: episode_t) -> None:
        self._registrar.book.heard(message)

    def on_neighbour_map(self, message: ring_map_t) -> None:
        """A packet of the episode, or of the map's upkeep."""
        if message.instant != UPKEEP:
            self._registrar.receive(
                RingPacket(message.episode, message.proposer, message.instant, bytes(message.packet))
            )
            # At once: a lap of n hops would take n steps of the timer. Only news: two that answer each other
            # with what both know would fill the link.
            self._go_on(only_news=True)
            return
        finished = self._registrar.finished
        if finished and (message.episode, message.proposer) == (finished.number, finished.proposer):
            try:
                self._registrar.map.merge(bytes(message.packet), self._fleet_utime)
            except UpkeepError as error:
                self._runtime.degraded(str(error), cause="upkeep")

    def step(self) -> None:
        """Propose, go on with the episode, repeat what is known."""
        runtime, registrar = self._runtime, self._registrar
        if self._wants_episode and self._fleet_time_ok:  # an instant in another time would suit nobody
            registrar.propose(self._able, runtime.utime, self._fleet_utime)
        said = registrar.book.saying(self._fleet_utime)
        if said is not None:
            runtime.publish(channels.RING_EPISODE, said)
        self._go_on()

    def _go_on(self, *, only_news: bool = False) -> None:
        for packet in self._registrar.step(self._runtime.utime, self._fleet_utime, self._poses.at):
            if not (only_news and packet == self._last_said):
                self._last_said = packet
                self._say(packet)

    def keep_up(self) -> None:
        """Say what is known of the map between episodes."""
        finished = self._registrar.finished
        if finished is not None and self._registrar.running is None and self._registrar.map.entries:
            data = self._registrar.map.encode(self._fleet_utime)
            self._say(RingPacket(finished.number, finished.proposer, UPKEEP, data))

    def _say(self, packet: RingPacket) -> None:
        self._runtime.publish(
            channels.RING_MAP,
            make(
                ring_map_t,
                episode=packet.number,
                proposer=packet.proposer,
                instant=packet.instant,
                n_bytes=len(packet.data),
                packet=packet.data,
            ),
        )


def setup(runtime: Runtime) -> None:
    shell = RegistrarShell(runtime)
    runtime.on(channels.DETECTIONS, shell.on_detections)
    runtime.on(channels.VEHICLE_STATE, shell.on_vehicle)
    runtime.on(channels.MISSION_STATE, shell.on_mission, newest=True)
    runtime.on(channels.FLEET_STATE, shell.on_fleet, newest=True)
    for member in runtime.settings.mission.roster:
        if member != runtime.drone_id:
            runtime.on(channels.received(member, channels.RING_EPISODE), shell.on_neighbour_episode)
            runtime.on(channels.received(member, channels.RING_MAP), shell.on_neighbour_map)
    runtime.every(STEP_S, shell.step)
    runtime.every(UPKEEP_S, shell.keep_up)
