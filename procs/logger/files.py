"""The files of one drone's log: a new one now and then, pictures apart where they may have to go first.

name.mcap, name.1.mcap, ... hold the bus; name.pictures.mcap, name.pictures.1.mcap, ... the pictures, where
the settings keep them apart. A quota drops the oldest closed pictures first and the oldest closed logs last;
what is being written stays.
"""

from collections.abc import Mapping
from pathlib import Path

from logs.boots import numbered
from logs.writer import LogWriter, fresh_path, picture_path
from procs.settings import LogSettings

__all__ = ["LogFiles", "SegmentedLog"]

BYTES_A_GB = 1e9


class SegmentedLog:
    """A log that begins a new file every `segment_s` of log time (0: never).

    The file is made at the first message. Raises what LogWriter raises.
    """

    def __init__(self, path: Path, drone_id: int, metadata: Mapping[str, str], segment_s: float) -> None:
        self._base = path
        self._drone_id, self._metadata = drone_id, metadata
        self._segment_us = segment_s * 1e6
        self._writer: LogWriter | None = None
        self._start_us: int | None = None

    @property
    def path(self) -> Path:
        """The file that is written, or the first where none is yet."""
        return self._writer.path if self._writer else self._base

    @property
    def n_bytes(self) -> int:
        """Size of the file that is written."""
        return self._writer.n_bytes if self._writer else 0

    def open(self) -> LogWriter:
        """The file that is written, made where there is none."""
        if self._writer is None:
            self._writer = LogWriter(fresh_path(self._base), drone_id=self._drone_id, metadata=self._metadata)
        return self._writer

    def write(self, channel: str, data: bytes, utime: int) -> None:
        """Add one message; where a segment's time is over, in a new file."""
        if self._start_us is not None and 0 < self._segment_us <= utime - self._start_us:
            self.close()
        self.open().write(channel, data, utime)
        if self._start_us is None:
            self._start_us = utime

    def flush_due(self, utime: int) -> None:
        """Flush where a second has passed since the last flush."""
        if self._writer is not None:
            self._writer.flush_due(utime)

    def close(self) -> None:
        """Close the file with its summary; the next message begins another."""
        if self._writer is not None:
            self._writer.close()
        self._writer, self._start_us = None, None

    def closed_files(self) -> list[Path]:
        """Every file of this log but the one that is written, oldest first."""
        current = self._writer.path if self._writer else None
        return [path for path in numbered(self._base) if path != current and path.exists()]


class LogFiles:
    """The bus's log and the pictures'. Raises LogError and OSError as LogWriter does."""

    def __init__(self, path: Path, drone_id: int, metadata: Mapping[str, str], settings: LogSettings) -> None:
        self._quota_bytes = settings.quota_gb * BYTES_A_GB
        self._log = SegmentedLog(path, drone_id, metadata, settings.segment_s)
        self._pictures = SegmentedLog(picture_path(path), drone_id, metadata, settings.segment_s)
        self._log.open()

    @property
    def path(self) -> Path:
        """The log that is written."""
        return self._log.path

    @property
    def n_bytes(self) -> int:
        """Size of the log that is written; the chunk in the making is not in it."""
        return self._log.n_bytes

    def write(self, channel: str, data: bytes, utime: int) -> None:
        """Add one message of the bus."""
        self._log.write(channel, data, utime)

    def write_picture(self, channel: str, data: bytes, utime: int) -> None:
        """Add one message that may have to go first."""
        self._pictures.write(channel, data, utime)

    def flush_due(self, utime: int) -> None:
        """Flush where a second has passed since the last flush."""
        self._log.flush_due(utime)
        self._pictures.flush_due(utime)

    def close(self) -> None:
        """Close both with their summaries."""
        self._log.close()
        self._pictures.close()

    def keep_quota(self) -> list[Path]:
        """Drop what is too much, the oldest pictures first -> the files that were dropped.

        Where nothing closed is left to drop, the file that takes the room is closed, to go the next time.
        """
        if not self._quota_bytes:
            return []
        pictures, logs = self._pictures.closed_files(), self._log.closed_files()
        sizes = {path: _size(path) for path in (*pictures, *logs)}
        n_bytes = sum(sizes.values()) + self._log.n_bytes + self._pictures.n_bytes
        dropped = []
        for path in (*pictures, *logs):
            if n_bytes <= self._quota_bytes or (path in logs and self._pictures.n_bytes):
                break
            path.unlink(missing_ok=True)
            n_bytes -= sizes[path]
            dropped.append(path)
        if n_bytes > self._quota_bytes:
            (self._pictures if self._pictures.n_bytes else self._log).close()
        return dropped


def _size(path: Path) -> int:
    """Bytes of a file; 0 where somebody took it away meanwhile."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0
