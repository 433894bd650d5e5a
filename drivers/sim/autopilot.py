"""The twin of an ArduCopter: real MAVLink bytes in and out, flown in the simulator.

It imitates what was measured of the real one (docs/autopilot_facts.md): streams only on request, silence to
unknown parameters, setpoints without acknowledgement, its own local origin. The rules of flight are in
drivers.sim.autopilot_flight, the errors of its sensors in drivers.sim.autopilot_estimate, the physics in
drivers.sim.vehicle.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymap3d

from drivers.autopilots.ardupilot import AUTOPILOT_COMPONENT, Codec, mavlink
from drivers.sim.autopilot_estimate import Estimate
from drivers.sim.autopilot_flight import Flight, Setpoint
from drivers.sim.vehicle import Vehicle

__all__ = ["SimAutopilot"]

STEP_S = 0.02
READY_S = 3.0  # a real one takes 41 s after boot (fact 15): too long to watch
HEARTBEAT_S = 1.0
FORCE_DISARM = 21196
# Bits of a type mask that say "ignore this".
IGNORES_POSITION = 0x007
IGNORES_VELOCITY = 0x038
IGNORES_YAW = 0x400
ONLY_GROUND_STATION = 1  # MAV_OPTIONS bit 0 (fact 4)


@dataclass
class _Stream:
    """One message that was asked for."""

    interval_s: float
    due_s: float


class SimAutopilot:
    """One simulated autopilot with its vehicle.

    origin: (latitude deg, longitude deg, altitude m) of the fleet's frame in which the vehicle flies.
    gps_noise_m: standard deviation of the slowly wandering position error a horizontal axis.
    compass_error_deg: standard deviation of the heading error of a flight.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        system_id: int,
        random: np.random.Generator,
        *,
        origin: tuple[float, float, float],
        gps_noise_m: float = 1.5,
        compass_error_deg: float = 5.0,
        ready_s: float = READY_S,
        start_s: float = 0.0,
        utc_us: int = 0,
    ) -> None:
        self.vehicle = vehicle
        self._codec = Codec(system_id, AUTOPILOT_COMPONENT)
        self._estimate = Estimate(vehicle, random, gps_noise_m, compass_error_deg)
        self._origin = origin
        self._ready_s = ready_s
        self.flight = Flight(vehicle, self._estimate, start_s + ready_s)
        self.flight.parameters["MAV_SYSID"] = float(system_id)
        self._t_s = start_s
        self._utc_us = utc_us
        self._boot(start_s)

    def restart(self, t_s: float) -> None:
        """Boot anew: streams, mode and arming are forgotten, parameters are kept."""
        self._boot(t_s)
        self.flight.boot(t_s + self._ready_s)

    def pilot_mode(self, mode: int) -> None:
        """The pilot turns the mode switch on the transmitter."""
        self.flight.set_mode(mode)

    def receive(self, data: bytes, t_s: float) -> None:
        """Hear bytes from the link; the answers go out with the next step."""
        for message in self._codec.parse(data):
            handler = self._handlers.get(message.get_type())
            if handler is not None and self._is_for_us(message):
                handler(message, t_s)

    def step(self, t_s: float) -> bytes:
        """Fly on to `t_s` and return what the autopilot says; ValueError where time runs backwards."""
        if t_s < self._t_s:
            raise ValueError(f"step to {t_s} s after {self._t_s} s: time does not run backwards")
        n_steps = math.ceil((t_s - self._t_s) / STEP_S - 1e-6)
        dt_s = (t_s - self._t_s) / max(n_steps, 1)
        for _ in range(n_steps):
            self._t_s += dt_s
            self._estimate.step(dt_s)
            self.flight.step(self._t_s)
            self.vehicle.step(dt_s)
        self._t_s = t_s
        self._speak(t_s)
        return self._codec.take()

    def _boot(self, t_s: float) -> None:
        self._boot_s = t_s
        self._streams: dict[int, _Stream] = {mavlink.MAVLINK_MSG_ID_HEARTBEAT: _Stream(HEARTBEAT_S, t_s)}
        self._origin_is_set = False
        self._handlers = {
            "HEARTBEAT": self._on_heartbeat,
            "COMMAND_LONG": self._on_command,
            "SET_POSITION_TARGET_LOCAL_NED": self._on_setpoint,
            "PARAM_SET": self._on_param_set,
            "PARAM_REQUEST_READ": self._on_param_read,
        }
        self._speakers = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._say_heartbeat,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._say_position,
            mavlink.MAVLINK_MSG_ID_ATTITUDE: self._say_attitude,
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: self._say_status,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._say_landed,
            mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._say_origin,
            mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: self._say_time,
        }

    def _is_for_us(self, message: Any) -> bool:
        target = getattr(message, "target_system", 0)
        if target not in (0, self._codec.send.srcSystem):
            return False
        if int(self.flight.parameters["MAV_OPTIONS"]) & ONLY_GROUND_STATION:
            return bool(message.get_srcSystem() == int(self.flight.parameters["MAV_GCS_SYSID"]))
        return True

    def _speak(self, t_s: float) -> None:
        """Send every stream that is due."""
        if not self._origin_is_set and self.flight.is_ready(t_s):
            self._origin_is_set = True
            self._estimate.set_origin()
        self._reading = self._estimate.reading()
        for message_id, stream in self._streams.items():
            if stream.due_s <= t_s + 1e-6:
                stream.due_s = max(stream.due_s + stream.interval_s, t_s - stream.interval_s)
                self._speakers[message_id](t_s)

    def _on_heartbeat(self, message: Any, t_s: float) -> None:
        if message.get_srcSystem() == int(self.flight.parameters["MAV_GCS_SYSID"]):
            self.flight.heard_ground(t_s)

    def _on_setpoint(self, message: Any, t_s: float) -> None:
        mask = message.type_mask
        has_position = mask & IGNORES_POSITION != IGNORES_POSITION
        has_velocity = mask & IGNORES_VELOCITY != IGNORES_VELOCITY
        if message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED or not (has_position or has_velocity):
            return
        self.flight.accept(
            Setpoint(
                (message.x, message.y, message.z) if has_position else None,
                (message.vx, message.vy, message.vz) if has_velocity else None,
                None if mask & IGNORES_YAW else message.yaw,
                t_s,
            )
        )

    def _on_command(self, message: Any, t_s: float) -> None:
        accepted = mavlink.MAV_RESULT_ACCEPTED
        refused = mavlink.MAV_RESULT_FAILED
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._set_interval(int(message.param1), message.param2, t_s)
        elif message.command == mavlink.MAV_CMD_DO_SET_MODE:
            result = accepted if self.flight.set_mode(int(message.param2)) else refused
        elif message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            result = accepted if self._arm_or_disarm(message, t_s) else refused
        elif message.command == mavlink.MAV_CMD_NAV_TAKEOFF:
            result = accepted if self.flight.take_off(message.param7, t_s) else refused
        else:
            result = mavlink.MAV_RESULT_UNSUPPORTED
        self._codec.send.command_ack_send(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )

    def _arm_or_disarm(self, message: Any, t_s: float) -> bool:
        if not message.param1:
            return self.flight.disarm(force=int(message.param2) == FORCE_DISARM)
        if self.flight.arm(t_s):
            return True
        reason = "mode not armable" if self.flight.is_ready(t_s) else "Need Position Estimate"
        self._codec.send.statustext_send(mavlink.MAV_SEVERITY_CRITICAL, f"PreArm: {reason}".encode())
        return False

    def _set_interval(self, message_id: int, interval_us: float, t_s: float) -> int:
        if message_id not in self._speakers:
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        if interval_us < 0:
            self._streams.pop(message_id, None)
        else:
            interval_s = interval_us / 1e6 if interval_us > 0 else HEARTBEAT_S
            self._streams[message_id] = _Stream(interval_s, t_s)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _on_param_set(self, message: Any, _t_s: float) -> None:
        name = _parameter_name(message)
        if name in self.flight.parameters:
            self.flight.parameters[name] = message.param_value
            self._say_parameter(name)

    def _on_param_read(self, message: Any, _t_s: float) -> None:
        name = _parameter_name(message)
        if name in self.flight.parameters:  # fact 14: an unknown name gets no answer at all
            self._say_parameter(name)

    def _say_parameter(self, name: str) -> None:
        parameters = self.flight.parameters
        self._codec.send.param_value_send(
            name.encode(),
            parameters[name],
            mavlink.MAV_PARAM_TYPE_REAL32,
            len(parameters),
            list(parameters).index(name),
        )

    def _say_heartbeat(self, _t_s: float) -> None:
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.flight.armed else 0
        self._codec.send.heartbeat_send(
            mavlink.MAV_TYPE_QUADROTOR,
            mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed,
            self.flight.mode,
            mavlink.MAV_STATE_STANDBY if self.flight.landed else mavlink.MAV_STATE_ACTIVE,
        )

    def _boot_ms(self, t_s: float) -> int:
        return round((t_s - self._boot_s) * 1000)

    def _say_position(self, t_s: float) -> None:
        if self._origin_is_set:
            position, velocity, _ = self._reading
            self._codec.send.local_position_ned_send(self._boot_ms(t_s), *position, *velocity)

    def _say_attitude(self, t_s: float) -> None:
        _, _, angles = self._reading
        self._codec.send.attitude_send(self._boot_ms(t_s), *angles, 0.0, 0.0, 0.0)

    def _say_status(self, _t_s: float) -> None:
        left = self.vehicle.battery
        self._codec.send.sys_status_send(
            0, 0, 0, 0, round(10500 + 2100 * left), -1, round(100 * left), 0, 0, 0, 0, 0, 0
        )

    def _say_time(self, t_s: float) -> None:
        """UTC only with a fix, as GPS brings it."""
        utc_us = self._utc_us + round(t_s * 1e6) if self._utc_us and self._origin_is_set else 0
        self._codec.send.system_time_send(utc_us, self._boot_ms(t_s))

    def _say_landed(self, _t_s: float) -> None:
        flight = self.flight
        if flight.landed:
            state = mavlink.MAV_LANDED_STATE_ON_GROUND
        elif flight.climbing:
            state = mavlink.MAV_LANDED_STATE_TAKEOFF
        else:
            state = mavlink.MAV_LANDED_STATE_IN_AIR
        self._codec.send.extended_sys_state_send(mavlink.MAV_VTOL_STATE_UNDEFINED, state)

    def _say_origin(self, _t_s: float) -> None:
        if self._origin_is_set:
            latitude_deg, longitude_deg, altitude_m = pymap3d.ned2geodetic(
                *self._estimate.origin_ned, *self._origin
            )
            self._codec.send.gps_global_origin_send(
                round(float(latitude_deg) * 1e7),
                round(float(longitude_deg) * 1e7),
                round(float(altitude_m) * 1e3),
            )


def _parameter_name(message: Any) -> str:
    name = message.param_id
    return name if isinstance(name, str) else name.decode(errors="replace")
