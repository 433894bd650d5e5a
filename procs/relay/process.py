"""relay: carries what may cross between drones, and knows who lives, what time the fleet has and what all
are doing.

In: every channel that the table lets cross (RING_EPISODE, RING_MAP, RING_ASSIGN), MISSION_STATE and
VEHICLE_STATE for this drone's row, datagrams from the radio. Out: the two ring neighbours' messages as
RX_<id>_<CHANNEL>, byte for byte, so that their `utime` is the sender's clock; FLEET_STATE at 4 Hz;
LINK_STATE at 1 Hz; datagrams to the radio.

When an input dies: without MISSION_STATE or VEHICLE_STATE the row stays as it was and grows old; with the
radio silent for 3 s this drone is a fleet of one and calls the others at 1 Hz; a datagram that is not
believed is counted, and the heartbeat says which and why. Without a usable fleet key the relay does not
start.
"""

from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

from lcmtypes import channels
from lcmtypes.podwatch import mission_state_t, vehicle_state_t
from procs.relay.keys import FleetKeyError, read_key
from procs.relay.relay import TICK_S, Relay
from procs.relay.seal import Refusal
from procs.runtime import Runtime, RuntimeFailure

__all__ = ["RelayShell", "key_path", "setup"]

FLEET_STATE_PERIOD_S = 0.25
LINK_STATE_PERIOD_S = 1.0
HANDSHAKE_DATAGRAMS = 4  # a second, unproven: more than that, or for longer, is no meeting of two
PUMP_PERIOD_S = 0.1  # how soon a message that waited for room under the cap is tried again


def key_path(run_dir: str, key_file: str) -> Path:
    """Where the fleet key lies: `key_file`, in the run's folder unless it is absolute."""
    return Path(run_dir) / key_file


class RelayShell:
    """The core on one drone's bus."""

    def __init__(self, runtime: Runtime, radio: Any, core: Relay) -> None:
        self._runtime = runtime
        self._radio = radio
        self._core = core
        self._mission: mission_state_t | None = None
        self._vehicle: vehicle_state_t | None = None
        self._refused: dict[Refusal, int] = {}
        self._was_unproven = False  # in the second before

    def mission_said(self, message: mission_state_t) -> None:
        """Keep the navigator's last word for this drone's row."""
        self._mission = message

    def vehicle_said(self, message: vehicle_state_t) -> None:
        """Keep the autopilot's last word that has a position."""
        numbers = (message.n_m, message.e_m, message.d_m, message.vn_m_s, message.ve_m_s, message.vd_m_s)
        if message.position_ok and all(isfinite(number) for number in numbers):
            self._vehicle = message

    def crossing_said(self, channel: channels.Channel, message: Any) -> None:
        """Send one message of the own bus to the neighbours."""
        try:
            payload_bytes = len(getattr(message, "packet", b""))
            self._core.say(channel, message.encode(), message.utime, payload_bytes, self._runtime.utime)
            self._runtime.ok(f"size {channel.name}")
        except ValueError as error:
            self._runtime.degraded(str(error), f"size {channel.name}")

    def radio_ready(self) -> None:
        """Take in all that waits on the radio."""
        for datagram in self._radio.receive():
            copy = self._core.receive(datagram, self._runtime.utime)
            if copy is not None:
                self._runtime.publish_raw(channels.received(copy.sender, copy.channel.name), copy.data)

    def tick(self) -> None:
        """Renew this drone's row, send the relay's own datagrams and say FLEET_STATE."""
        now_us = self._runtime.utime
        if self._mission is not None and self._vehicle is not None:
            try:
                self._core.describe(self._mission, self._vehicle, now_us)
                self._runtime.ok("row")
            except ValueError as error:
                self._runtime.degraded(str(error), "row")
        self._core.tick(now_us)
        self._runtime.publish(channels.FLEET_STATE, self._core.fleet_state(now_us))

    def pump(self) -> None:
        """Send what waited for room."""
        self._core.pump(self._runtime.utime)

    def report(self) -> None:
        """Say LINK_STATE, and in the heartbeat what was refused in the last second and which side is
        silent."""
        now_us = self._runtime.utime
        self._runtime.publish(channels.LINK_STATE, self._core.link_state(now_us))
        refused = dict(self._core.refused)
        n_unproven = self._refused.get(Refusal.UNPROVEN, 0)
        news = {reason: n - self._refused.get(reason, 0) for reason, n in refused.items()}
        self._refused = refused
        if news.get(Refusal.UNPROVEN, 0) <= HANDSHAKE_DATAGRAMS and not self._was_unproven:
            news.pop(Refusal.UNPROVEN, None)  # two that meet need a second to prove themselves
        self._was_unproven = refused.get(Refusal.UNPROVEN, 0) > n_unproven
        self._tell(
            "refused",
            ", ".join(f"{n} {reason.value}" for reason, n in news.items() if n),
            "refused datagrams",
            "; if a drone is missing, does it hold this fleet's key and this version?",
        )
        self._tell(
            "silent",
            " and ".join(self._core.silent_sides(now_us)),
            "link to a living neighbour is silent",
        )
        lost = self._core.members.lost(now_us)
        self._tell("lost", ", ".join(str(member) for member in lost), "lost drones")

    def _tell(self, cause: str, what: str, intro: str, remedy: str = "") -> None:
        if what:
            self._runtime.degraded(f"{intro}: {what}{remedy}", cause)
        else:
            self._runtime.ok(cause)


def setup(runtime: Runtime) -> None:
    """Start the relay. Raises RuntimeFailure: no usable fleet key, no radio, a drone that the radio has no
    address for."""
    mission = runtime.settings.mission
    try:
        fleet_key = read_key(key_path(runtime.settings.run_dir, mission.radio.key_file))
    except FleetKeyError as error:
        raise RuntimeFailure(str(error)) from error
    try:
        radio = runtime.open("radio")
        core = Relay.on_radio(radio, mission, runtime.drone_id, fleet_key, runtime.utime)
    except (ValueError, OSError) as error:
        raise RuntimeFailure(str(error)) from error
    shell = RelayShell(runtime, radio, core)
    for channel in channels.CROSSING:
        runtime.on(channel.name, partial(shell.crossing_said, channel))
    runtime.on(channels.MISSION_STATE, shell.mission_said, newest=True)
    runtime.on(channels.VEHICLE_STATE, shell.vehicle_said, newest=True)
    runtime.attach(radio, shell.radio_ready)
    runtime.every(TICK_S, shell.tick)
    runtime.every(PUMP_PERIOD_S, shell.pump)
    runtime.every(LINK_STATE_PERIOD_S, shell.report)
    runtime.on_stop(radio.close)
