"""The autopilot bridge: setpoints to MAVLink, telemetry to VEHICLE_STATE.

Hears SETPOINT (the newest only) and the autopilot's link. Says VEHICLE_STATE at 20 Hz, once the autopilot has
told of itself, stamped with the arrival of the position it holds. A setpoint goes out the moment it is heard,
is repeated at 20 Hz while it lives, and never outlives its expiry: then the vehicle stands still, and a
second later brakes by itself. Without a link to the autopilot for 2 s the heartbeat says degraded, and
VEHICLE_STATE says that the position is not ok.
"""

from lcmtypes import channels, make
from lcmtypes.podwatch import setpoint_t, vehicle_state_t
from procs.autopilot.bridge import Bridge
from procs.runtime import Runtime

PERIOD_S = 0.05
CHECK_S = 1.0
SILENT_AFTER_S = 2.0


class Autopilot:
    """Moves bytes between the link and the bridge."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._link = runtime.open("autopilot")
        target_system = self._link.system_id or runtime.drone_id
        self._bridge = Bridge(runtime.settings.mission, runtime.drone_id, target_system=target_system)
        self._n_refused = 0
        runtime.attach(self._link, self.heard)

    def heard(self) -> None:
        """Bytes wait on the link."""
        self._bridge.receive(self._link.receive(), self._runtime.utime)

    def setpoint(self, message: setpoint_t) -> None:
        """Pass a setpoint on at once."""
        self._link.write(self._bridge.setpoint(message, self._runtime.utime))

    def step(self) -> None:
        """Write what is due and say where the vehicle is."""
        utime = self._runtime.utime
        self._link.write(self._bridge.step(utime))
        # A bridge that starts in flight must not say "landed, battery empty" before it has asked.
        if self._bridge.telemetry.is_known:
            self._runtime.publish(channels.VEHICLE_STATE, make(vehicle_state_t, **self._bridge.state(utime)))

    def check(self) -> None:
        """Name in the heartbeat what is wrong."""
        runtime = self._runtime
        problem = self._bridge.problem(runtime.utime)
        if problem:
            runtime.degraded(problem, cause="autopilot")
        else:
            runtime.ok("autopilot")
        n_refused = self._bridge.flyer.n_refused
        if n_refused > self._n_refused:
            runtime.degraded(
                f"{n_refused} setpoints refused: not finite, of unknown kind or for another drone",
                cause="refused",
            )
        else:
            runtime.ok("refused")
        self._n_refused = n_refused

    def close(self) -> None:
        """Stop the vehicle, then the link."""
        self._link.write(self._bridge.farewell(self._runtime.utime))
        self._link.close()


def setup(runtime: Runtime) -> None:
    autopilot = Autopilot(runtime)
    runtime.on(channels.SETPOINT, autopilot.setpoint, newest=True)
    runtime.every(PERIOD_S, autopilot.step)
    runtime.every(CHECK_S, autopilot.check)
    runtime.on_stop(autopilot.close)
