"""Start one process of a drone on its bus: `python -m procs.main PROCESS SETTINGS.json`."""

import argparse
import ctypes
import importlib
import os
import signal
import sys
from pathlib import Path

from procs import processes
from procs.bus_executor import BusRuntime
from procs.runtime import RuntimeFailure
from procs.settings import DroneSettings, MissionError

EXIT_CANNOT_START = 3
PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """Ask the kernel for SIGTERM when the supervisor dies, so that a killed one leaves nothing running."""
    supervisor = os.getppid()
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != supervisor:  # it died before we asked
        sys.exit(0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("process", choices=[process.name for process in processes.PROCESSES])
    parser.add_argument("settings", type=Path, help="DroneSettings as JSON")
    parser.add_argument("--end-with-parent", action="store_true", help="end when the parent process dies")
    arguments = parser.parse_args()
    if arguments.end_with_parent:
        end_with_parent()
    try:
        runtime = BusRuntime(
            arguments.process, DroneSettings.read(arguments.settings), arguments.settings.absolute()
        )
        importlib.import_module(processes.BY_NAME[arguments.process].module).setup(runtime)
    except (RuntimeFailure, MissionError, OSError) as error:
        sys.stderr.write(f"{arguments.process}: {error}\n")
        sys.exit(EXIT_CANNOT_START)
    runtime.run()


if __name__ == "__main__":
    main()
