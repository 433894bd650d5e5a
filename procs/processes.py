"""The process table: every process of a drone, once. The supervisor's configuration is generated from it."""

from dataclasses import dataclass
from enum import Enum

__all__ = ["BY_NAME", "PROCESSES", "Process", "Restart"]


class Restart(Enum):
    """What the supervisor does when a process ends or hangs."""

    ALWAYS = "always"
    NEVER = "never"


@dataclass(frozen=True)
class Process:
    """One process of a drone.

    `compute_s` is the nominal time of one handler: it delays the process's outputs in virtual time.
    `heartbeat_limit_s`: one that is silent for longer hangs, and its supervisor ends it, to start it again (a
    simulated fleet's is three times as patient). `stop_order`: the lowest is stopped first, so that the
    bridge still hears the navigator and the logger hears everybody.
    """

    name: str
    module: str
    compute_s: float
    heartbeat_limit_s: float = 3.0
    restart_ground: Restart = Restart.ALWAYS
    restart_air: Restart = Restart.ALWAYS
    stop_order: int = 1


PROCESSES = (
    Process("camera", "procs.camera.process", compute_s=0.004),
    Process("detector", "procs.detector.process", compute_s=0.012),
    Process("registrar", "procs.registrar.process", compute_s=0.004),
    Process("assigner", "procs.assigner.process", compute_s=0.001),
    Process("tracker", "procs.tracker.process", compute_s=0.010),
    Process("navigator", "procs.navigator.process", compute_s=0.001, stop_order=2),
    Process("autopilot", "procs.autopilot.process", compute_s=0.001, stop_order=3),
    Process("relay", "procs.relay.process", compute_s=0.001, stop_order=3),
    Process("logger", "procs.logger.process", compute_s=0.0005, stop_order=4),
)
BY_NAME = {process.name: process for process in PROCESSES}
