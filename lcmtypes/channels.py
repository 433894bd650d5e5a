"""The channel table: every channel of a drone's bus, once. All else that knows a channel derives from here.

Publishers, the relay's allow-list, the logger, health checks, the spy and the docs read `CHANNELS`; code
names a channel by the constants (`channels.FRAME`), never by a string.
"""

from dataclasses import dataclass
from typing import Any

from lcmtypes import podwatch

__all__ = ["BY_NAME", "CHANNELS", "CROSSING", "Channel", "kind_of", "received", "split_received"]


@dataclass(frozen=True)
class Channel:
    """One channel: what it carries, how often, what the logger keeps, and whether the relay may send it."""

    name: str
    kind: type[Any]
    rate_hz: float  # expected while a mission runs; 0 where it speaks only on events
    log_every: int = 1  # 1 keeps all, n each n-th, 0 none
    crosses: bool = False  # may leave the drone, to ring neighbours only
    priority: int = 9  # on the radio, 0 goes first
    max_age_s: float = 1.0  # older than this it is not sent, nor believed


FRAME = "FRAME"
PREVIEW = "PREVIEW"
DETECTIONS = "DETECTIONS"
IDENTITIES = "IDENTITIES"
RING_EPISODE = "RING_EPISODE"
RING_MAP = "RING_MAP"
RING_ASSIGN = "RING_ASSIGN"
ASSIGNMENT = "ASSIGNMENT"
TRACK = "TRACK"
SETPOINT = "SETPOINT"
VEHICLE_STATE = "VEHICLE_STATE"
MISSION_STATE = "MISSION_STATE"
FLEET_STATE = "FLEET_STATE"
LINK_STATE = "LINK_STATE"
LOG_STATE = "LOG_STATE"
HEARTBEAT = "HEARTBEAT"

CHANNELS = (
    Channel(FRAME, podwatch.frame_t, rate_hz=20, max_age_s=0.5),
    Channel(PREVIEW, podwatch.preview_t, rate_hz=2, max_age_s=2),
    Channel(DETECTIONS, podwatch.detections_t, rate_hz=5),
    Channel(IDENTITIES, podwatch.identities_t, rate_hz=5),
    Channel(RING_EPISODE, podwatch.episode_t, rate_hz=0, crosses=True, priority=1, max_age_s=1),
    Channel(RING_MAP, podwatch.ring_map_t, rate_hz=0, crosses=True, priority=2, max_age_s=1),
    Channel(RING_ASSIGN, podwatch.ring_assign_t, rate_hz=0, crosses=True, priority=2, max_age_s=1),
    Channel(ASSIGNMENT, podwatch.assignment_t, rate_hz=2, max_age_s=2),
    Channel(TRACK, podwatch.track_t, rate_hz=20, max_age_s=0.5),
    Channel(SETPOINT, podwatch.setpoint_t, rate_hz=10, max_age_s=0.5),
    Channel(VEHICLE_STATE, podwatch.vehicle_state_t, rate_hz=20, max_age_s=1),
    Channel(MISSION_STATE, podwatch.mission_state_t, rate_hz=10, max_age_s=2),
    Channel(FLEET_STATE, podwatch.fleet_state_t, rate_hz=4, max_age_s=2),
    Channel(LINK_STATE, podwatch.link_state_t, rate_hz=1, max_age_s=3),
    Channel(LOG_STATE, podwatch.log_state_t, rate_hz=1, max_age_s=3),
    Channel(HEARTBEAT, podwatch.heartbeat_t, rate_hz=9, max_age_s=3),
)
# What the simulator says on the world's own group and in truth.mcap; it is on no drone's bus.
WORLD_STATE = "WORLD_STATE"
WORLD_COMMAND = "WORLD_COMMAND"  # JSON, from the run's own tool: begin, faults
WORLD_CHANNELS = (Channel(WORLD_STATE, podwatch.world_state_t, rate_hz=50),)
# What only a log holds: the pixels of a FRAME, whole, kept by the logger with `--log-frames`; on no bus.
IMAGE = "IMAGE"
LOG_CHANNELS = (Channel(IMAGE, podwatch.preview_t, rate_hz=20),)
BY_NAME = {channel.name: channel for channel in (*CHANNELS, *WORLD_CHANNELS, *LOG_CHANNELS)}
CROSSING = tuple(channel for channel in CHANNELS if channel.crosses)


def received(drone_id: int, channel: str) -> str:
    """The channel of the local copy of what neighbour `drone_id` said on `channel`."""
    return f"RX_{drone_id}_{channel}"


def split_received(name: str) -> tuple[int, str] | None:
    """(neighbour's id, its channel) of a copy's channel name, None for any other name."""
    parts = name.split("_", 2)
    if len(parts) == 3 and parts[0] == "RX" and parts[1].isdigit() and parts[2] in BY_NAME:
        return int(parts[1]), parts[2]
    return None


def kind_of(name: str) -> type[Any] | None:
    """The message type of a channel or of a neighbour's copy of it, None for a channel not in the table."""
    copy = split_received(name)
    channel = BY_NAME.get(copy[1] if copy else name)
    return channel.kind if channel else None
