"""The assigner: decides with the ring who watches which animal, and moves nobody before all are known to
differ.

Hears IDENTITIES (an episode that ended in consensus begins an exchange), VEHICLE_STATE, FLEET_STATE (members
that are lost, orders to leave an animal) and the neighbours' RING_ASSIGN. Says RING_ASSIGN at 5 Hz while an
exchange runs and slowly after it, and ASSIGNMENT at 2 Hz and at every change. Until the certificate holds,
the drone keeps the animal that it has.
"""

import numpy as np

from lcmtypes import channels, make
from lcmtypes.podwatch import (
    assignment_t,
    fleet_state_t,
    identities_t,
    operator_t,
    ring_assign_t,
    vehicle_state_t,
)
from procs.assigner.gossip import Agent
from procs.registrar.episodes import from_bitmap
from procs.runtime import Runtime

STEP_S = 0.2
SAY_EVERY_STEPS = 2
PREVIOUS_WITHIN_MS = 30_000  # an animal unseen for longer is not held any more


class AssignerShell:
    """Between the bus and the exchange of one episode."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._roster = runtime.settings.mission.roster
        self._vehicle: vehicle_state_t | None = None
        self._living: tuple[int, ...] = self._roster
        self._agent: Agent | None = None
        self._key = (0, 0)
        self._members: tuple[int, ...] = ()
        self._inbox: list[tuple[tuple[int, int], bytes]] = []
        self._animal = -1
        self._watched: dict[int, int] = {}  # living drone -> the animal that it says it watches
        self._left: list[int] = []
        self._n_steps = 0

    def on_vehicle(self, state: vehicle_state_t) -> None:
        if state.position_ok:
            self._vehicle = state

    def on_fleet(self, state: fleet_state_t) -> None:
        """Lost members are waited for no more; an order to leave an animal is kept."""
        self._living = from_bitmap(state.members, self._roster)
        self._watched = {row.id: row.animal for row in state.rows if row.alive and row.animal >= 0}
        if self._agent is None and self._animal < 0:
            # Started anew in flight: the fleet still knows what this drone watches.
            self._animal = self._watched.get(self._runtime.drone_id, -1)
        if state.order.command == operator_t.LEAVE and state.order.animal not in self._left:
            self._left.append(state.order.animal)
        if self._agent is not None:
            for index, member in enumerate(self._members):
                if member not in self._living and member != self._runtime.drone_id:
                    self._agent.drop_member(index)

    def on_identities(self, message: identities_t) -> None:
        """Begin the exchange of a newly ended episode."""
        key = (message.episode, message.episode_proposer)
        if key <= self._key or not message.consensus or self._vehicle is None:
            return
        members = from_bitmap(message.episode_members, self._roster)
        if self._runtime.drone_id not in members:
            return
        self._key, self._members = key, members
        here = np.array([self._vehicle.n_m, self._vehicle.e_m])
        # One that is only remembered, and that the views should have seen and did not, is nobody's to watch.
        there = [one for one in message.map if one.hits > 0 or one.misses == 0]
        animals = [one for one in there if one.id not in self._left]
        costs = [float(np.hypot(*(here - (one.n_m, one.e_m)))) for one in animals]
        held = {one.id for one in animals if one.age_ms <= PREVIOUS_WITHIN_MS}
        self._agent = Agent(
            members.index(self._runtime.drone_id),
            len(members),
            costs,
            [one.id for one in animals],
            previous=self._animal if self._animal in held else -1,
            forbidden=[animal for drone, animal in sorted(self._watched.items()) if drone not in members],
        )
        for index, member in enumerate(members):
            if member not in self._living and member != self._runtime.drone_id:
                self._agent.drop_member(index)
        self._say()

    def on_neighbour(self, message: ring_assign_t) -> None:
        """Keep what a neighbour says until the next step; it may know of an episode that we do not yet."""
        self._inbox.append(((message.episode, message.proposer), bytes(message.packet)))
        del self._inbox[:-100]

    def step(self) -> None:
        """Go on with the exchange."""
        self._n_steps += 1
        agent = self._agent
        if agent is not None:
            heard = [packet for key, packet in self._inbox if key == self._key]
            self._inbox = [(key, packet) for key, packet in self._inbox if key > self._key]
            for packet in agent.step(heard, self._runtime.utime / 1e6):
                self._runtime.publish(
                    channels.RING_ASSIGN,
                    make(
                        ring_assign_t,
                        episode=self._key[0],
                        proposer=self._key[1],
                        n_bytes=len(packet),
                        packet=packet,
                    ),
                )
            if agent.animal != self._animal:
                self._animal = agent.animal
                self._say()
        if self._n_steps % SAY_EVERY_STEPS == 0:
            self._say()

    def _say(self) -> None:
        agent = self._agent
        self._runtime.publish(
            channels.ASSIGNMENT,
            make(
                assignment_t,
                episode=self._key[0],
                proposer=self._key[1],
                animal=self._animal,
                certified=agent is not None and agent.certified,
                surplus=agent is not None and agent.certified and agent.surplus,
                running=agent is not None and not agent.certified,
                n_members=len(self._members),
                member_ids=list(self._members),
                choices=[int(choice) for choice in agent.choices] if agent is not None else [],
            ),
        )


def setup(runtime: Runtime) -> None:
    shell = AssignerShell(runtime)
    runtime.on(channels.IDENTITIES, shell.on_identities, newest=True)
    runtime.on(channels.VEHICLE_STATE, shell.on_vehicle, newest=True)
    runtime.on(channels.FLEET_STATE, shell.on_fleet, newest=True)
    for member in runtime.settings.mission.roster:
        if member != runtime.drone_id:
            runtime.on(channels.received(member, channels.RING_ASSIGN), shell.on_neighbour)
    runtime.every(STEP_S, shell.step)
