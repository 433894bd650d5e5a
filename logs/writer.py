"""Writes a drone's bus to an MCAP file: raw LCM bytes, and all that a reader needs to decode them."""

import glob
import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import IO, Any, cast

from mcap.writer import CompressionType, Writer

from lcmtypes import channels
from logs.exceptions import LogError
from logs.schemas import fingerprint, lcm_text, type_name
from logs.sequence import read_head

__all__ = ["BOOT", "ENCODING", "FLUSH_PERIOD_US", "METADATA", "LogWriter", "fresh_path", "picture_path"]

ENCODING = "lcm"  # of messages and of schemas
METADATA = "podwatch"  # name of the MCAP metadata record that tells whose log it is
BOOT = "boot"  # its key for the start of the drone's computer from which the log's times count
LIBRARY = "podwatch"  # no version: the same messages give the same bytes
FLUSH_PERIOD_US = 1_000_000  # a killed logger loses at most this much
CHUNK_BYTES = 4 * 1024 * 1024  # a chunk is closed by time long before
MAX_CHANNELS = 4096  # MCAP numbers channels with 16 bits; more than this is garbage on the bus, not a fleet
MAX_TIME_US = (2**63 - 1) // 1000


def fresh_path(path: Path) -> Path:
    """`path`, or where the log has files already the next of name.1.mcap, name.2.mcap, ...

    Nothing is overwritten, and a number that was dropped for room is not used again.
    """
    taken = [
        other.stem.removeprefix(f"{path.stem}.")
        for other in path.parent.glob(f"{glob.escape(path.stem)}.*{path.suffix}")
    ]
    last = max((int(number) for number in taken if number.isdigit()), default=0 if path.exists() else None)
    return path if last is None else path.with_name(f"{path.stem}.{last + 1}{path.suffix}")


def picture_path(path: Path) -> Path:
    """Where the pictures of the log at `path` are kept, if not in it: name.pictures.mcap."""
    return path.with_name(f"{path.stem}.pictures{path.suffix}")


class _AppendedFile:
    """The file as MCAP's writer sees it: what is written waits in memory until `flush` appends it.

    No handle stays open in between, so a logger may end at any time and leaves nothing but whole chunks.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._waiting = bytearray()
        self._n_flushed = 0
        with path.open("xb"):
            pass

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._n_flushed + len(self._waiting)

    def flush(self) -> None:
        with open(self._path, "ab", opener=_open_existing) as file:
            file.write(self._waiting)
        self._n_flushed += len(self._waiting)
        self._waiting.clear()


def _open_existing(path: str, flags: int) -> int:
    """A log that was taken away is not made anew without its head: that is an error for people to see."""
    return os.open(path, flags & ~os.O_CREAT)


class LogWriter:
    """An MCAP file that is readable up to its last second at any time.

    Each second of log time the chunk is closed and handed to the operating system. The same messages give the
    same bytes: the file holds no wall clock, no random number and no version of a library.

    Raises LogError: the file exists or cannot be made, a message has no place in MCAP; OSError while writing
    (disk full, disk gone), after which nothing more can be written.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, drone_id: int, metadata: Mapping[str, str] | None = None
    ):
        """Make the file. `metadata` (mission, seed ...) is kept in the file's `podwatch` metadata record."""
        self.path = Path(path)
        self._drone_id = drone_id
        self._chunk_start_us: int | None = None
        self._channel_ids: dict[tuple[str, tuple[str, bytes] | None], int] = {}
        self._schema_ids: dict[tuple[str, bytes], int] = {}
        try:
            self._file = _AppendedFile(self.path.absolute())
        except FileExistsError:
            raise LogError(
                f"{path}: exists already and is not overwritten; give a path that is free"
            ) from None
        except OSError as error:
            raise LogError(
                f"{path}: cannot be made ({error.strerror}); give a path in a folder that may be written"
            ) from error
        self._mcap: Any = Writer(
            cast("IO[bytes]", self._file), chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        self._mcap.start(profile="", library=LIBRARY)
        self._mcap.add_metadata(METADATA, {"drone_id": str(drone_id), **(metadata or {})})
        self._file.flush()

    @property
    def n_bytes(self) -> int:
        """Size of the file so far; the chunk in the making is not in it."""
        return self._file.tell()

    def write(self, channel: str, data: bytes, utime: int, foreign: tuple[str, bytes] | None = None) -> None:
        """Add one message as it came from the bus; `utime` (us, drone clock) is its log and publish time.

        foreign: name and .lcm text of a type that is none of this version's, as the log that it is copied
        from gave them.
        """
        if not 0 <= utime <= MAX_TIME_US:
            raise LogError(
                f"{self.path}: utime {utime} us of {channel} lies outside 0 to {MAX_TIME_US}, MCAP's range"
            )
        self.flush_due(utime)
        head = read_head(channel, data)
        self._mcap.add_message(
            channel_id=self._channel_id(channel, None if head is None else _own_schema(channel), foreign),
            log_time=utime * 1000,
            publish_time=utime * 1000,
            data=data,
            sequence=head.seq & 0xFFFFFFFF if head else 0,
        )
        if self._chunk_start_us is None:
            self._chunk_start_us = utime

    def flush_due(self, utime: int) -> None:
        """Flush where a second of log time has passed since the chunk's first message."""
        start_us = self._chunk_start_us
        if start_us is not None and abs(utime - start_us) >= FLUSH_PERIOD_US:
            self.flush()

    def flush(self) -> None:
        """Close the chunk and hand it to the operating system: what was written outlives this process."""
        self._mcap.flush()
        self._chunk_start_us = None

    def close(self) -> None:
        """Write the summary; nothing can be written afterwards."""
        self._mcap.finish()
        self._file.flush()

    def _channel_id(
        self, channel: str, own: tuple[str, bytes] | None, foreign: tuple[str, bytes] | None
    ) -> int:
        """The MCAP channel of a bus channel; bytes of another type on it go to a channel of that type, or to
        one without a schema.
        """
        schema = own or foreign
        key = (channel, schema)
        if key not in self._channel_ids:
            if len(self._channel_ids) >= MAX_CHANNELS:
                raise LogError(
                    f"{self.path}: {channel} is refused, {MAX_CHANNELS} channels are the limit of a log"
                )
            metadata = {"drone": str(self._drone_id)}
            kind = channels.kind_of(channel)
            if own is not None and kind is not None:
                metadata["fingerprint"] = fingerprint(kind).hex()
            self._channel_ids[key] = self._mcap.register_channel(
                topic=channel,
                message_encoding=ENCODING,
                schema_id=self._schema_id(*schema) if schema else 0,
                metadata=metadata,
            )
        return self._channel_ids[key]

    def _schema_id(self, name: str, text: bytes) -> int:
        if (name, text) not in self._schema_ids:
            self._schema_ids[name, text] = self._mcap.register_schema(name=name, encoding=ENCODING, data=text)
        return self._schema_ids[name, text]


@cache
def _own_schema(channel: str) -> tuple[str, bytes] | None:
    """(name, .lcm text) of the channel table's type of a channel, None for a channel that it lacks."""
    kind: type | None = channels.kind_of(channel)
    return (type_name(kind), lcm_text(kind).encode("utf-8")) if kind else None
