"""Become supervisord, and end when the tool that started it ends: `python -m tools.supervised CONFIG`."""

import os
import sys

from procs.main import end_with_parent

if __name__ == "__main__":
    end_with_parent()
    os.execv(
        sys.executable,
        [sys.executable, "-W", "ignore", "-m", "supervisor.supervisord", "-n", "-c", sys.argv[1]],
    )
