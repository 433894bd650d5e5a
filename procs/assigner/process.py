"""The assigner: decides with the ring who watches which animal, and moves nobody before all are known to
differ.

Hears IDENTITIES (an episode that ended in consensus begins an exchange), VEHICLE_STATE, FLEET_STATE
(members that are lost or on their way home, who watches what, orders to leave an animal), LINK_STATE (how
much is lost) and the neighbours' RING_ASSIGN. Says RING_ASSIGN at 5 Hz while an exchange runs and slowly
after it, and ASSIGNMENT at 2 Hz and at every change. Until the certificate holds, the drone keeps the
animal that it has; on its way home it has none.
"""

import numpy as np

from lcmtypes import channels, make
from lcmtypes.podwatch import (
    assignment_t,
    fleet_state_t,
    identities_t,
    link_state_t,
    map_animal_t,
    ring_assign_t,
    vehicle_state_t,
)
from procs.assigner.gossip import Agent
from procs.assigner.rule import plan
from procs.assigner.watched import WatchBook
from procs.navigator.states import State
from procs.registrar.episodes import from_bitmap
from procs.runtime import Runtime

STEP_S = 0.2
SAY_EVERY_STEPS = 2
PREVIOUS_WITHIN_MS = 30_000  # an animal unseen for longer is not held any more
GOING_HOME = (State.RETURN, State.LAND, State.LANDED)  # they have given up their animal


class AssignerShell:
    """Between the bus and the exchange of one episode."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._roster = runtime.settings.mission.roster
        self._settings = runtime.settings.mission.assign
        self._vehicle: vehicle_state_t | None = None
        self._living: tuple[int, ...] = self._roster
        self._agent: Agent | None = None
        self._key = (0, 0)
        self._members: tuple[int, ...] = ()
        self._inbox: list[tuple[tuple[int, int], bytes]] = []
        self._animal = -1
        self._watched: dict[int, int] = {}  # living drone -> the animal that it says it watches
        self._book = WatchBook()
        self._loss = 0.0
        self._goes_home = False
        self._n_steps = 0

    def on_vehicle(self, state: vehicle_state_t) -> None:
        if state.position_ok:
            self._vehicle = state

    def on_links(self, state: link_state_t) -> None:
        """The loss that the exchange must reckon with: that of the worse of the ring's links."""
        self._loss = max((link.loss for link in state.links if link.up), default=0.0)

    def on_fleet(self, state: fleet_state_t) -> None:
        """Members that are lost or go home are waited for no more; an order to leave an animal is kept."""
        own_id = self._runtime.drone_id
        going = [row.id for row in state.rows if row.state in GOING_HOME]
        living = from_bitmap(state.members, self._roster)
        self._living = tuple(member for member in living if member not in going)
        self._watched = {row.id: row.animal for row in state.rows if row.alive and row.animal >= 0}
        self._book.hear(state)
        self._goes_home = own_id in going
        if self._goes_home:
            self._give_up()
        elif self._agent is None and self._animal < 0:
            # Started anew in flight: the fleet still knows what this drone watches.
            self._animal = self._watched.get(own_id, -1)
        self._drop_lost()

    def _give_up(self) -> None:
        """On its way home: it has no animal, and takes part in no exchange until the next episode."""
        if self._agent is not None or self._animal >= 0:
            self._agent, self._animal, self._members = None, -1, ()
            self._say()

    def _drop_lost(self) -> None:
        for index, member in enumerate(self._members):
            if self._agent is not None and member not in self._living and member != self._runtime.drone_id:
                self._agent.drop_member(index)

    def on_identities(self, message: identities_t) -> None:
        """Begin the exchange of a newly ended episode."""
        key = (message.episode, message.episode_proposer)
        if key <= self._key or not message.consensus or self._vehicle is None or self._goes_home:
            return
        members = from_bitmap(message.episode_members, self._roster)
        if self._runtime.drone_id not in members:
            return
        self._key, self._members = key, members
        self._agent = self._new_agent(message, members, self._vehicle)
        self._drop_lost()
        self._say()

    def _new_agent(self, message: identities_t, members: tuple[int, ...], vehicle: vehicle_state_t) -> Agent:
        self._book.forget_all_but(message.map)
        # One that is only remembered, and that the views should have seen and did not, is nobody's to watch.
        there = [one for one in message.map if one.hits > 0 or one.misses == 0]
        animals = [one for one in there if self._book.may_take(one.id)]
        costs = [self._cost_m(one, vehicle) for one in animals]
        held = [one.id for one in animals if one.age_ms <= PREVIOUS_WITHIN_MS]
        chosen = plan(len(members), len(animals), self._loss, self._settings.method)
        return Agent(
            members.index(self._runtime.drone_id),
            len(members),
            costs,
            [one.id for one in animals],
            previous=self._animal if self._animal in held else -1,
            forbidden=[animal for drone, animal in sorted(self._watched.items()) if drone not in members],
            threshold_m=self._settings.gain_m,
            listed=chosen.listed,
            method=chosen.method,
        )

    def _cost_m(self, animal: map_animal_t, vehicle: vehicle_state_t) -> float:
        """Metres over the ground to the animal, and what it was watched already."""
        away_m = float(np.hypot(vehicle.n_m - animal.n_m, vehicle.e_m - animal.e_m))
        return away_m + self._settings.minute_watched_m * self._book.minutes(animal.id)

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
    runtime.on(channels.LINK_STATE, shell.on_links, newest=True)
    for member in runtime.settings.mission.roster:
        if member != runtime.drone_id:
            runtime.on(channels.received(member, channels.RING_ASSIGN), shell.on_neighbour)
    runtime.every(STEP_S, shell.step)
