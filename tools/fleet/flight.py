"""One real drone's process tree: what it is told, what it says, and what is done about what hangs."""

import secrets
import select
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import lcm

from lcmtypes import channels
from procs import processes
from procs.bus_executor import ROUTE_COMMAND
from procs.navigator.states import State
from procs.runtime import RuntimeFailure
from procs.settings import Mission
from tools.buses import Slot, bus_url
from tools.doctor.mend import as_root
from tools.fleet.machine import drone_settings
from tools.heartbeats import HeartbeatGuard, end_hung
from tools.live import SHOWN, LiveView
from tools.supervision import Supervisor, SupervisorError, program

__all__ = ["DroneFlight", "open_bus"]

START_LIMIT_S = 90.0
CHECK_EVERY_S = 2.0
LOOK_S = 0.2


def open_bus(url: str) -> Any:
    """The bus at `url`. Raises RuntimeFailure where there is no route."""
    try:
        return lcm.LCM(url)
    except RuntimeError as error:
        raise RuntimeFailure(
            f"no bus at {url} ({error}); is there a multicast route? Try: {as_root(ROUTE_COMMAND)}"
        ) from error


class DroneFlight:
    """One drone's process tree under supervisord, and what its bus says; use as a context manager."""

    def __init__(self, mission: Mission, drone_id: int, folder: Path, screen: LiveView) -> None:
        """mission: of `tools.fleet.machine.read_fleet`. Raises MissionError, RuntimeFailure."""

        self.drone_id, self._folder, self._screen = drone_id, folder, screen
        self._slot = Slot()
        self.bus_url = bus_url(drone_id, self._slot.number)
        settings = drone_settings(
            mission,
            drone_id,
            bus_url=self.bus_url,
            run=f"s{self._slot.number}x{secrets.token_hex(4)}",
            run_dir=folder,
            log_path=folder / f"drone_{drone_id}.mcap",
        )
        output = folder / "output"
        output.mkdir()
        (output / f"drone_{drone_id}.json").write_text(settings.model_dump_json(indent=1))
        (folder / "mission.json").write_text(mission.model_dump_json(indent=2) + "\n")
        self.beaten: set[str] = set()
        self.state = State.IDLE
        self._guard = HeartbeatGuard()
        self._bus = open_bus(self.bus_url)
        self._bus.subscribe(".*", self._hear).set_queue_capacity(2000)
        self.supervisor = Supervisor(folder, (drone_id,), self._slot.fileno())
        self._began_s = time.monotonic()
        self._next_check_s = 0.0
        self._is_ready = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.supervisor.stop()
        self._slot.close()

    def wait_until_ready(self, check_interrupt: Callable[[], None]) -> None:
        """Until every process has beaten once. Raises SupervisorError, and what `check_interrupt` raises."""

        wanted = {process.name for process in processes.PROCESSES}
        while wanted - self.beaten:
            check_interrupt()
            if time.monotonic() - self._began_s > START_LIMIT_S:
                raise SupervisorError(
                    f"{', '.join(sorted(wanted - self.beaten))}: not ready within {START_LIMIT_S:.0f} s; "
                    f"what they said is in {self._folder / 'output'}"
                )
            self.look()
        self._is_ready = True

    def look(self) -> None:
        """Hear what waits; end what hangs; now and then see whether the tree still stands.

        Raises SupervisorError.
        """

        if select.select([self._bus], [], [], LOOK_S)[0]:
            while self._bus.handle_timeout(0) > 0:
                pass
        now_s = time.monotonic()
        for hung in self._guard.look(now_s, now_s):
            _, pid = self.supervisor.states().get(program(self.drone_id, hung.process), ("", 0))
            if told := end_hung(hung, pid, self.state):
                self._screen.note(now_s - self._began_s, told)
        if now_s >= self._next_check_s:
            self._next_check_s = now_s + CHECK_EVERY_S
            self.supervisor.check(in_flight=self._is_ready)
        self._screen.tick(now_s - self._began_s, 1.0)

    def _hear(self, channel: str, data: bytes) -> None:

        kind = channels.kind_of(channel) if channel in SHOWN else None
        if kind is None:
            return
        message = kind.decode(data)
        if channel == channels.HEARTBEAT:
            self.beaten.add(message.process)
            self._guard.beat(self.drone_id, message.process, message.pid)
        elif channel == channels.MISSION_STATE:
            self.state = State(message.state)
        self._screen.hear(self.drone_id, channel, message, time.monotonic() - self._began_s)
