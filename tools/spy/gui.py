"""lcm-spy, LCM's own window, with our message types."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from lcmtypes.jar import JAR, JAVA_FOLDER, PREFIX
from tools.doctor.mend import as_root

__all__ = ["GuiError", "start", "what_is_missing"]

NO_DISPLAY = ("there is no screen (DISPLAY is not set)", "ssh -X to this machine, or leave --gui out")


class GuiError(OSError):
    """lcm-spy cannot start here; the message says what is missing and the command that mends it."""


def what_is_missing(
    environment: Mapping[str, str] = os.environ,
    which: Callable[[str], str | None] = shutil.which,
    jar: Path = JAR,
    library: Path = JAVA_FOLDER / "lcm.jar",
    *,
    needs_screen: bool = True,
) -> tuple[str, str] | None:
    """(what lcm-spy lacks here, the command that mends it), None where it lacks nothing."""
    if which("java") is None:
        return "there is no Java", as_root("apt-get install default-jre")
    if not library.is_file():
        return f"{library} is not there", f"{sys.executable} -m pip install --force-reinstall lcm==1.5.3"
    if not jar.is_file():
        command = f"{sys.executable} -m lcmtypes.jar"
        if which("javac") is None:
            command = f"{as_root('apt-get install default-jdk-headless')} && {command}"
        return f"{jar} is not there: podwatch was installed where there was no Java compiler", command
    if needs_screen and not environment.get("DISPLAY"):
        return NO_DISPLAY
    return None


def start(url: str) -> int:
    """Run lcm-spy on a bus until its window is closed; its exit code. Raises GuiError."""
    missing = what_is_missing()
    if missing is not None:
        what, mend = missing
        raise GuiError(f"lcm-spy cannot start: {what}. Run: {mend}")
    classes = os.pathsep.join(filter(None, (str(JAR), os.environ.get("CLASSPATH", ""))))
    command = [str(PREFIX / "bin" / "lcm-spy"), f"--lcm-url={url}"]
    try:
        return subprocess.call(command, env={**os.environ, "CLASSPATH": classes})
    except KeyboardInterrupt:
        return 0
