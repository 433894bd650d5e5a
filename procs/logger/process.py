"""Logger: keeps the whole bus of its drone in an MCAP file.

Hears every channel, raw; the channel table says which it keeps. Says LOG_STATE at 1 Hz. The file is flushed
every second, so that a killed logger loses at most its last second; a respawned one, and one whose segment's
time is over, goes on in a new file (name.1.mcap, name.2.mcap, ...) and overwrites nothing. With a quota the
oldest pictures are dropped first. Where the disk is full or a write fails it stops writing, says so in
LOG_STATE and in its heartbeat, and the drone flies on without a log.
"""

import shutil
from pathlib import Path

from lcmtypes import channels, make
from lcmtypes.podwatch import frame_t, log_state_t, preview_t
from logs.exceptions import LogError
from logs.sequence import GapCounter, read_head
from logs.writer import BOOT
from procs.logger.files import LogFiles
from procs.logger.selection import Selection, disk_is_full, disk_trouble
from procs.runtime import Runtime, RuntimeFailure

STATE_PERIOD_S = 1.0
# LOG_STATE says at most this much: what is more than enough says the same on every machine and in every run.
DISK_SHOWN_GB = 2.0


class FrameKeeper:
    """Turns a frame's handle into the whole image that the log keeps."""

    def __init__(self, runtime: Runtime) -> None:
        from drivers.cameras.replay import RAW_FORMAT  # a logger without it needs no pixels

        self._format = RAW_FORMAT
        self._runtime = runtime
        self._frames = runtime.open("frames")
        self._n_kept = self._n_gone = 0

    def image(self, data: bytes) -> bytes | None:
        """The encoded IMAGE of an encoded FRAME; None where its pixels are gone, which is told."""
        if read_head(channels.FRAME, data) is None:
            return None
        frame = frame_t.decode(data)
        pixels = self._frames.read(frame)
        if pixels is None:
            self._n_gone += 1
            self._runtime.degraded(f"{self._n_gone} frames were gone before they were logged", cause="gone")
            return None
        self._n_kept += 1
        return make(
            preview_t,
            utime=frame.utime,
            seq=self._n_kept - 1,
            drone_id=frame.drone_id,
            frame_seq=frame.seq,
            width=frame.width,
            height=frame.height,
            scale=1.0,
            format=self._format,
            n_bytes=pixels.nbytes,
            data=pixels.tobytes(),
        ).encode()


class Logger:
    """Between the bus and one log file."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._selection = Selection()
        self._gaps = GapCounter()
        self._n_written = 0
        self._n_bytes = 0
        self._problem = ""
        self._path = Path(runtime.settings.log_path)
        settings = runtime.settings.mission.log
        self._keeper = FrameKeeper(runtime) if settings.frames else None
        # What a quota drops first must lie in files of its own.
        self._apart = (channels.PREVIEW,) if settings.quota_gb else ()
        self._files = self._open()

    def hear(self, channel: str, data: bytes, utime: int) -> None:
        """One message of the bus."""
        self._gaps.see(channel, data)
        if self._files is None or not self._selection.keeps(channel):
            return
        try:
            if channel in self._apart:
                self._files.write_picture(channel, data, utime)
            else:
                self._files.write(channel, data, utime)
            self._n_written += 1
            if self._keeper is not None and channel == channels.FRAME:
                self._keep_frame(self._keeper, data, utime)
        except LogError as error:
            self._runtime.degraded(str(error), cause="refused")
        except OSError as error:
            self._fail(error)

    def tick(self) -> None:
        """Look at the disk, flush what is due and say LOG_STATE."""
        free_gb = self._free_gb()
        if self._files is not None:
            self._check_disk(free_gb)
        if self._files is not None:
            try:
                self._files.flush_due(self._runtime.utime)
                self._n_bytes = self._files.n_bytes
                self._path = self._files.path
                self._files.keep_quota()
            except OSError as error:
                self._fail(error)
        self._runtime.publish(channels.LOG_STATE, self._state(free_gb))

    def stop(self) -> None:
        """Close the file with its summary."""
        if self._files is None:
            return
        try:
            self._files.close()
        except OSError as error:
            self._fail(error)
        self._files = None

    def _keep_frame(self, keeper: FrameKeeper, data: bytes, utime: int) -> None:
        assert self._files is not None
        image = keeper.image(data)
        if image is not None:
            self._files.write_picture(channels.IMAGE, image, utime)
            self._n_written += 1

    def _open(self) -> LogFiles | None:
        settings = self._runtime.settings
        metadata = {
            "process": self._runtime.process,
            "mission": settings.mission.model_dump_json(),
            "seed": str(settings.seed),
        }
        if self._runtime.boot:
            metadata[BOOT] = self._runtime.boot
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            files = LogFiles(self._path, self._runtime.drone_id, metadata, settings.mission.log)
            self._path = files.path
            return files
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
        self._files = None
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
            ok=self._files is not None,
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
