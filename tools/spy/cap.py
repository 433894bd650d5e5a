"""How many bytes a second each link may send: no message says it, so it is read where the drone was told."""

from collections.abc import Callable, Iterable
from pathlib import Path

from lcmtypes.podwatch import heartbeat_t
from procs.settings import DroneSettings, MissionError, RadioSettings

__all__ = ["radio_cap"]

PROC = Path("/proc")
DEFAULT_SOURCE = "the default; --mission FILE says otherwise"


def radio_cap(
    beats: Iterable[heartbeat_t], read_command: Callable[[int], list[str]] | None = None
) -> tuple[int, str]:
    """(bytes/s that each link may send, where that is said).

    No message carries the cap. The processes of a drone were started with their settings' file on the command
    line, and a heartbeat gives the process's number: on the same machine that leads to the file.
    """
    read_command = read_command or _command_of
    for beat in beats:
        for word in read_command(beat.pid):
            if word.endswith(".json"):
                try:
                    return DroneSettings.read(Path(word)).mission.radio.bytes_per_s, "by its mission"
                except MissionError:
                    continue
    return RadioSettings().bytes_per_s, DEFAULT_SOURCE


def _command_of(pid: int) -> list[str]:
    """The words that started a process; none where it is on another machine, or has ended."""
    try:
        words = (PROC / str(pid) / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return []
    return [word.decode(errors="replace") for word in words]
