"""Logger: keeps the whole bus of its drone in an MCAP file.

Hears every channel, raw; the channel table says which it keeps. Says LOG_STATE at 1 Hz. The file is flushed
every second, so that a killed logger loses at most its last second; a respawned one goes on in a new file
(name.1.mcap, name.2.mcap, ...) and overwrites nothing. Where the disk is full or a write fails it stops
writing, says so in LOG_STATE and in its heartbeat, and the drone flies on without a log.
"""

import shutil
from pathlib import Path

from lcmtypes import channels, make
from lcmtypes.podwatch import log_state_t
from logs.exceptions import LogError
from logs.sequence import GapCounter
from logs.writer import LogWriter, fresh_path
from procs.logger.selection import Selection, disk_is_full, disk_trouble
from procs.runtime import Runtime, RuntimeFailure

STATE_PERIOD_S = 1.0
# LOG_STATE says at most this much: what is more than enough says the same on every machine and in every run.
DISK_SHOWN_GB = 2.0


class Logger:
    """Between the bus and one log file."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._selection = Selection()
        self._gaps = GapCounter()
        self._n_written = 0
        self._n_bytes = 0
        self._problem = ""
        self._path = fresh_path(Path(runtime.settings.log_path))
        self._writer = self._open()

    def hear(self, channel: str, data: bytes, utime: int) -> None:
        """One message of the bus."""
        self._gaps.see(channel, data)
        if self._writer is None or not self._selection.keeps(channel):
            return
        try:
            self._writer.write(channel, data, utime)
            self._n_written += 1
        except LogError as error:
            self._runtime.degraded(str(error), cause="refused")
        except OSError as error:
            self._fail(error)

    def tick(self) -> None:
        """Look at the disk, flush what is due and say LOG_STATE."""
        free_gb = self._free_gb()
        if self._writer is not None:
            self._check_disk(free_gb)
        if self._writer is not None:
            try:
                self._writer.flush_due(self._runtime.utime)
                self._n_bytes = self._writer.n_bytes
            except OSError as error:
                self._fail(error)
        self._runtime.publish(channels.LOG_STATE, self._state(free_gb))

    def stop(self) -> None:
        """Close the file with its summary."""
        if self._writer is None:
            return
        try:
            self._writer.close()
        except OSError as error:
            self._fail(error)
        self._writer = None

    def _open(self) -> LogWriter | None:
        settings = self._runtime.settings
        metadata = {
            "process": self._runtime.process,
            "mission": settings.mission.model_dump_json(),
            "seed": str(settings.seed),
        }
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            return LogWriter(self._path, drone_id=self._runtime.drone_id, metadata=metadata)
        except (LogError, OSError) as error:
            self._problem = f"nothing is logged: {error}"
            self._runtime.degraded(self._problem, cause="log")
            return None

    def _check_disk(self, free_gb: float) -> None:
        trouble = disk_trouble(free_gb)
        if not trouble:
            self._runtime.ok(cause="log")
            return
        self._runtime.degraded(trouble, cause="log")
        if disk_is_full(free_gb):
            self.stop()
            self._problem = self._problem or trouble

    def _fail(self, error: OSError) -> None:
        """A write failed: what was flushed stays readable, nothing more is written."""
        self._writer = None
        self._problem = (
            f"{self._path}: writing failed ({error.strerror}); logging has stopped, restart the logger"
        )
        self._runtime.degraded(self._problem, cause="log")

    def _free_gb(self) -> float:
        try:
            return shutil.disk_usage(self._path.parent).free / 1e9
        except OSError:
            return 0.0

    def _state(self, free_gb: float) -> log_state_t:
        return make(
            log_state_t,
            path=self._path.name,
            n_messages=self._n_written,
            n_bytes=self._n_bytes,
            n_lost=self._gaps.n_lost,
            disk_free_gb=min(free_gb, DISK_SHOWN_GB),
            ok=self._writer is not None,
            problem=self._problem,
        )


def setup(runtime: Runtime) -> None:
    """Register the logger's handlers. Raises RuntimeFailure where the settings name no log."""
    if not runtime.settings.log_path:
        raise RuntimeFailure('logger: the settings give no log; set "log_path" to the .mcap file to write')
    logger = Logger(runtime)
    runtime.on_all(logger.hear)
    runtime.every(STATE_PERIOD_S, logger.tick)
    runtime.on_stop(logger.stop)
