"""supervisord for one drone or a whole simulated fleet: its configuration from the process table, and talking
to it.
"""

import configparser
import contextlib
import os
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from http.client import HTTPException
from pathlib import Path
from typing import Any
from xmlrpc.client import Fault, ServerProxy

from procs import processes
from procs.main import EXIT_CANNOT_START
from procs.processes import Restart

__all__ = ["CannotStartError", "Supervisor", "SupervisorError", "configuration", "program"]

STOP_WAIT_S = 6
START_TRIES = 5
ONE_THREAD = "OMP_NUM_THREADS=1,OPENBLAS_NUM_THREADS=1,MKL_NUM_THREADS=1"


class SupervisorError(Exception):
    """The process tree cannot start or fell; the message says which process, why, and where it wrote."""


class CannotStartError(SupervisorError):
    """A process says that it cannot start: what it was given, or this machine, is not enough."""


def program(drone_id: int, process: str) -> str:
    """supervisord's name of one process of one drone."""
    return f"{process}_{drone_id}"


Leading = Mapping[str, tuple[str | Path, ...]]  # name -> what this Python is to run


def configuration(
    folder: Path, socket: Path, drone_ids: tuple[int, ...], leading: Leading | None = None
) -> configparser.RawConfigParser:
    """The whole tree: for each drone a program for each row of the process table.

    leading: programs that start before all drones and stop after them, and without which nothing can go on.
    """
    config = configparser.RawConfigParser()
    config["unix_http_server"] = {"file": str(socket), "chmod": "0700"}
    config["supervisord"] = {
        "nodaemon": "true",
        "logfile": _plain(folder / "output" / "supervisord.log"),
        "pidfile": _plain(folder / "output" / "supervisord.pid"),
        "childlogdir": _plain(folder / "output"),
        "environment": ONE_THREAD,
    }
    factory = "supervisor.rpcinterface:make_main_rpcinterface"
    config["rpcinterface:supervisor"] = {"supervisor.rpcinterface_factory": factory}
    config["supervisorctl"] = {"serverurl": f"unix://{socket}"}
    for name, words in (leading or {}).items():
        config[f"program:{name}"] = {
            "command": _command(*words),
            "priority": "1",
            **_common(folder, name),
            "autorestart": "false",
        }
    groups: dict[int, list[str]] = {}
    for drone_id in drone_ids:
        for process in processes.PROCESSES:
            name = program(drone_id, process.name)
            groups.setdefault(process.stop_order, []).append(name)
            settings = folder / "output" / f"drone_{drone_id}.json"
            config[f"program:{name}"] = {
                "command": _command("-m", "procs.main", process.name, settings, "--end-with-parent"),
                **_common(folder, name),
                "autorestart": "unexpected" if process.restart_ground is Restart.ALWAYS else "false",
            }
    # supervisord stops group after group, the highest priority first, and waits for each.
    for stop_order, names in groups.items():
        priority = str(1000 - 100 * stop_order)
        config[f"group:{_group(stop_order)}"] = {"programs": ",".join(names), "priority": priority}
    return config


def _group(stop_order: int) -> str:
    """supervisord's name of all that stops together."""
    return f"stop_{stop_order}"


def _command(*words: str | Path) -> str:
    """A command of this Python for supervisord, whatever the folders are called."""
    return _plain(shlex.join([sys.executable, *map(str, words)]))


def _plain(text: str | Path) -> str:
    """Text in which supervisord, which expands %(name)s, expands nothing."""
    return str(text).replace("%", "%%")


def _common(folder: Path, name: str) -> dict[str, str]:
    return {
        "directory": _plain(folder),
        "startsecs": "1",
        "startretries": str(START_TRIES),
        "exitcodes": str(EXIT_CANNOT_START),
        "stopsignal": "TERM",
        "stopwaitsecs": str(STOP_WAIT_S),
        "redirect_stderr": "true",
        "stdout_logfile": _plain(_plain(folder / "output" / f"{name}.txt")),  # it expands this one twice
        "stdout_logfile_maxbytes": "1MB",
    }


class Supervisor:
    """One supervisord with its tree; ends with the process that made it."""

    def __init__(
        self, folder: Path, drone_ids: tuple[int, ...], lock: int, leading: Leading | None = None
    ) -> None:
        """`lock`: a file descriptor that supervisord holds open for as long as it runs."""
        self._leading = tuple(leading or ())
        self._output = folder / "output"
        self._output.mkdir(exist_ok=True)
        # A socket's path holds at most 107 bytes, and a run's folder may be deep.
        self._socket_folder = tempfile.TemporaryDirectory(prefix="podwatch-")
        socket = Path(self._socket_folder.name) / "supervisor.sock"
        path = self._output / "supervisord.conf"
        with path.open("w") as file:
            configuration(folder, socket, drone_ids, leading).write(file)
        with (self._output / "supervisord.err").open("w") as errors:
            self._popen = subprocess.Popen(
                [sys.executable, "-m", "tools.supervised", str(path)],
                stdout=subprocess.DEVNULL,
                stderr=errors,
                stdin=subprocess.DEVNULL,
                pass_fds=[lock],
                start_new_session=True,  # a Ctrl-C is for the tool, which then stops the tree in order
            )
        self._socket = socket

    @property
    def pid(self) -> int:
        """supervisord's own process id."""
        return self._popen.pid

    @property
    def is_alive(self) -> bool:
        return self._popen.poll() is None

    def states(self) -> dict[str, tuple[str, int]]:
        """Program -> (supervisord's word for its state, pid); empty while supervisord does not answer yet."""
        return {row["name"]: (row["statename"], row["pid"]) for row in self._rows()}

    def check(self, *, in_flight: bool = False) -> None:
        """Raise SupervisorError where supervisord has died, or a process cannot start.

        in_flight: every process has run; one that cannot start now (a port, a device not free again yet)
        is tried again and again, since a drone in the air is better off with it.
        """
        if not self.is_alive:
            raise SupervisorError(f"supervisord ended with code {self._popen.returncode}; see {self._output}")
        for row in self._rows():
            name, state = row["name"], row["statename"]
            # What was killed is EXITED too, for the moment until it is started again. What says that it
            # cannot start is not tried five times.
            cannot = state in ("EXITED", "BACKOFF", "FATAL") and row["exitstatus"] == EXIT_CANNOT_START
            if in_flight and name not in self._leading:
                if state == "FATAL" or (cannot and state == "EXITED"):
                    # Fault: it runs again.
                    with contextlib.suppress(Fault), _proxy(self._socket) as proxy:
                        proxy.supervisor.startProcess(f"{row['group']}:{name}", False)
                continue
            if cannot or state == "FATAL" or (state == "EXITED" and name in self._leading):
                output = (self._output / f"{name}.txt").read_text(errors="replace").strip()
                last = output.splitlines()[-1] if output else "it said nothing"
                kind = CannotStartError if cannot else SupervisorError
                raise kind(f"{name} cannot run: {last} (all it said: {self._output / name}.txt)")

    def _rows(self) -> list[dict[str, Any]]:
        """supervisord's account of each program; empty while it does not answer."""
        try:
            with _proxy(self._socket) as proxy:
                rows: Any = proxy.supervisor.getAllProcessInfo()
        except (OSError, HTTPException, Fault):
            return []
        return list(rows)

    def drop_drone(self, drone_id: int, pids: list[int]) -> None:
        """End a whole drone at once: freeze its processes, so that it says nothing more, then remove them."""
        for pid in pids:
            if pid:
                os.kill(pid, signal.SIGSTOP)
        for process in processes.PROCESSES:
            name = f"{_group(process.stop_order)}:{program(drone_id, process.name)}"
            with contextlib.suppress(Fault), _proxy(self._socket) as proxy:  # Fault: it was not running
                proxy.supervisor.stopProcess(name, False)

    def stop(self) -> None:
        """Stop the tree in its order and wait for it."""
        if self.is_alive:
            self._popen.terminate()
            try:
                self._popen.wait(timeout=STOP_WAIT_S * 5)
            except subprocess.TimeoutExpired:
                self._popen.kill()
                self._popen.wait()
        self._socket_folder.cleanup()


def _proxy(socket: Path) -> Any:
    """A new connection for each call: supervisor's transport cannot go on after one that failed."""
    from supervisor.xmlrpc import SupervisorTransport  # slow to import

    return ServerProxy("http://127.0.0.1", transport=SupervisorTransport(None, None, f"unix://{socket}"))
