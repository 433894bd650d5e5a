"""Which processes of a drone hang: they live, so supervisord sees nothing wrong, and say nothing.

A dead process is supervisord's to start again. One that hangs is known by its missing heartbeats alone; where
systemd runs a drone, the watchdog of its unit does what this does here.
"""

import contextlib
import os
import signal
from dataclasses import dataclass

from procs import processes
from procs.navigator.states import State
from procs.processes import Restart

__all__ = ["HeartbeatGuard", "Hung", "end_hung"]

# A healthy process may be late on a busy machine: it must be silent for its limit of simulation time, and
# for so many times the limit of real time.
PATIENCE = 3.0
LONGEST_LOOK_S = 0.5  # a watcher that was itself held up counts no more of a silence than this


@dataclass(frozen=True)
class Hung:
    """A process that has said no heartbeat for too long."""

    drone_id: int
    process: str
    pid: int
    silent_s: float  # of real time


@dataclass
class _Beat:
    """The last heartbeat of one process, by the guard's own two clocks."""

    pid: int
    listened_s: float
    sim_s: float


class HeartbeatGuard:
    """Takes every heartbeat; `look` says who hangs. It judges a process only after its first heartbeat."""

    def __init__(self) -> None:
        self._beats: dict[tuple[int, str], _Beat] = {}
        self._listened_s = 0.0  # real time in which it listened and the simulation clock ran
        self._looked_s: float | None = None
        self._sim_s = 0.0

    def beat(self, drone_id: int, process: str, pid: int) -> None:
        """A heartbeat came."""
        self._beats[drone_id, process] = _Beat(pid, self._listened_s, self._sim_s)

    def forget(self, drone_id: int) -> None:
        """A whole drone is gone: nobody waits for its processes."""
        self._beats = {key: beat for key, beat in self._beats.items() if key[0] != drone_id}

    def look(self, real_s: float, sim_s: float) -> list[Hung]:
        """Who hangs at `real_s` of the machine's clock and `sim_s` of the simulation's; each is said once.

        Take in first all heartbeats that wait.
        """
        if self._looked_s is not None and sim_s > self._sim_s:
            self._listened_s += min(real_s - self._looked_s, LONGEST_LOOK_S)
        self._looked_s, self._sim_s = real_s, sim_s
        hung = []
        for (drone_id, process), beat in self._beats.items():
            limit_s = processes.BY_NAME[process].heartbeat_limit_s
            silent_s = self._listened_s - beat.listened_s
            if silent_s > PATIENCE * limit_s and sim_s - beat.sim_s > limit_s:
                hung.append(Hung(drone_id, process, beat.pid, silent_s))
        for one in hung:
            del self._beats[one.drone_id, one.process]
        return hung


def end_hung(hung: Hung, pid: int, state: State) -> str:
    """Kill a process that hangs, so that its supervisor starts it again -> what people are told.

    pid: what the supervisor says of it now. Nothing is done, and "" said, where it runs anew already, and
    where the table says that it is never started again while its drone is in `state`.
    """
    row = processes.BY_NAME[hung.process]
    on_ground = state in (State.IDLE, State.LANDED)
    if (row.restart_ground if on_ground else row.restart_air) is not Restart.ALWAYS:
        return ""
    if pid != hung.pid:  # it has ended meanwhile, and its number may be another's
        return ""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    return (
        f"{hung.process} of drone {hung.drone_id} hangs (no heartbeat for {hung.silent_s:.0f} s): killed, to "
        "be started again"
    )
