"""The navigator: flies the mission, one setpoint a tenth of a second.

Hears all that says where things are: VEHICLE_STATE, DETECTIONS, IDENTITIES, ASSIGNMENT, TRACK, FLEET_STATE.
Says SETPOINT (it dies of age by itself) and MISSION_STATE at 10 Hz. When an input dies the core holds,
predicts or goes home (docs/navigator.md); when this process dies its setpoints expire, the bridge holds the
drone, and the next start takes up the state that the fleet still carries.
"""

from typing import Any

from lcmtypes import channels
from procs.navigator.mission import Inputs, Navigator
from procs.runtime import Runtime

PERIOD_S = 0.1
NEWEST_OF = {
    "vehicle": channels.VEHICLE_STATE,
    "detections": channels.DETECTIONS,
    "identities": channels.IDENTITIES,
    "assignment": channels.ASSIGNMENT,
    "track": channels.TRACK,
    "fleet": channels.FLEET_STATE,
}


def setup(runtime: Runtime) -> None:
    navigator = Navigator(runtime.settings.mission, runtime.drone_id)
    newest: dict[str, Any] = {}

    def remember(name: str, message: Any) -> None:
        newest[name] = message
        if name == "vehicle":
            newest["vehicle_heard_us"] = runtime.utime
            navigator.hear_vehicle(message)

    def listen(name: str, channel: str) -> None:
        runtime.on(channel, lambda message: remember(name, message))

    def update() -> None:
        outputs = navigator.update(Inputs(utime=runtime.utime, **newest))
        runtime.publish(channels.SETPOINT, outputs.setpoint)
        if outputs.mission is not None:
            runtime.publish(channels.MISSION_STATE, outputs.mission)

    for name, channel in NEWEST_OF.items():
        listen(name, channel)
    runtime.every(PERIOD_S, update)
