"""One pass over an MCAP file that may be damaged: every whole message, and a line for each thing wrong.

The mcap library's own readers stop at the first damage, and take a short read for a whole one. Here every
length is checked against the file before it is believed, every chunk's checksum is held, and behind a damaged
record the pass goes on at the next chunk (https://mcap.dev/spec).
"""

import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Metadata, Schema, Statistics
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from logs.exceptions import LogError

__all__ = ["RawMessage", "Scan"]

RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of the body
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel id, sequence, log time ns, publish time ns
DATA_END_BYTES = 4  # of its body
FOOTER_BYTES = RECORD_HEAD.size + 20
LCM_EVENT_MAGIC = bytes.fromhex("eda1da01")
CHUNK_MARK = b"\x04\x00\x00\x00zstd"  # a chunk's compression, in every chunk that LogWriter closes
CHUNK_MARK_OFFSET = RECORD_HEAD.size + 28  # behind its start and end time, its size and its checksum
MAX_CHUNK_BYTES = 1 << 30  # uncompressed; a damaged size must not take the machine's memory
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
WANTED = (*DEFINITIONS, Opcode.MESSAGE, Opcode.CHUNK, Opcode.METADATA)
DAMAGE = (McapError, ValueError, RuntimeError, MemoryError, OverflowError, struct.error, zstandard.ZstdError)

R = TypeVar("R")


class RawMessage(NamedTuple):
    """One message as the log holds it."""

    channel: str
    type_name: str  # the schema's name, "" where the log has none
    log_time_ns: int
    data: bytes
    schema_text: bytes = b""  # the schema's .lcm text


class _Record(NamedTuple):
    offset: int
    opcode: int
    body: bytes


class Scan:
    """The messages of one log in the order in which they were written.

    `report` is called with a line for people at each damaged or missing part. Raises LogError at once where
    the file is missing, unreadable, empty or no MCAP file.
    """

    def __init__(self, path: Path, report: Callable[[str], None]):
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}  # name of the record -> its pairs
        self.channel_types: dict[str, str] = {}  # channel -> name of its type, in the order of the log
        self.end_ns: int | None = None  # latest log time seen
        self._report = report
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._n_undefined = 0
        self._n_seen = 0
        self._n_promised: int | None = None  # by the summary
        with _open(path) as file:
            self.n_bytes = file.seek(0, 2)
            _check_magic(path, file, self.n_bytes)
            self.closed = self._read_summary(file)

    def messages(self) -> Iterator[RawMessage]:
        """Every whole message."""
        with _open(self.path) as file:
            for record in self._records(file, len(MCAP0_MAGIC), self.n_bytes):
                yield from self._record_messages(record)
        self._report_end()

    def _read_summary(self, file: BinaryIO) -> bool:
        """Take what a closed log says at its end: its number of messages, and each definition once more."""
        end = self.n_bytes - FOOTER_BYTES - len(MCAP0_MAGIC)
        file.seek(max(end, 0))
        tail = file.read()
        if end < 0 or not tail.endswith(MCAP0_MAGIC) or tail[0] != Opcode.FOOTER:
            return False
        start = _parse(Footer.read, tail[RECORD_HEAD.size : FOOTER_BYTES]).summary_start
        file.seek(start if start < end else end)
        try:
            for opcode, body in _split(file.read(max(end - start, 0))):
                if opcode in DEFINITIONS:
                    self._define(opcode, body)
                elif opcode == Opcode.STATISTICS:
                    self._n_promised = _parse(Statistics.read, body).message_count
        except DAMAGE:
            self._report(f"{self.path}: its summary at byte {start} is damaged; the messages do not need it")
        return True

    def _records(self, file: BinaryIO, offset: int, size: int) -> Iterator[_Record]:
        """Records of the data section that matter, from `offset`; behind damage, from the next chunk.

        A record but a chunk has no checksum, so a damaged length is found out late, where no record
        begins: everything behind the newest chunk is then searched again.
        """
        searched_to = offset
        self._unread_from = size
        while offset < size:
            file.seek(offset)
            head = file.read(RECORD_HEAD.size)
            opcode, length = RECORD_HEAD.unpack(head) if len(head) == RECORD_HEAD.size else (0, 0)
            if opcode == Opcode.DATA_END and length == DATA_END_BYTES:
                return
            if _is_opcode(opcode) and length <= size - offset - RECORD_HEAD.size:
                if opcode in WANTED:
                    yield _Record(offset, opcode, file.read(length))
                if opcode == Opcode.CHUNK:
                    searched_to = offset + 1
                offset += RECORD_HEAD.size + length
                continue
            following = _next_chunk(file, searched_to)
            if following is None:
                self._unread_from = offset
                return
            self._report(
                f"{self.path}: a record at or before byte {offset} is damaged; what it held is lost, "
                f"reading goes on with the chunk at byte {following}"
            )
            offset = following

    def _record_messages(self, record: _Record) -> Iterator[RawMessage]:
        try:
            parts = _chunk_parts(record.body) if record.opcode == Opcode.CHUNK else [record[1:]]
            messages = [message for opcode, body in parts for message in self._take(opcode, body)]
        except DAMAGE as error:
            self._report(
                f"{self.path}: the {Opcode(record.opcode).name.lower()} at byte {record.offset} "
                f"({len(record.body)} bytes) is damaged ({error}); what it held is lost"
            )
            return
        yield from messages

    def _take(self, opcode: int, body: bytes) -> Iterator[RawMessage]:
        if opcode in DEFINITIONS:
            self._define(opcode, body)
        elif opcode == Opcode.METADATA:
            metadata = _parse(Metadata.read, body)
            self.metadata[metadata.name] = metadata.metadata
        elif opcode == Opcode.MESSAGE:
            channel_id, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(body)
            self._n_seen += 1
            self.end_ns = log_time_ns if self.end_ns is None else max(self.end_ns, log_time_ns)
            channel = self._channels.get(channel_id)
            if channel is None:
                self._n_undefined += 1
                return
            schema = self._schemas.get(channel.schema_id)
            name, text = (schema.name, schema.data) if schema else ("", b"")
            self.channel_types.setdefault(channel.topic, name)
            yield RawMessage(channel.topic, name, log_time_ns, body[MESSAGE_HEAD.size :], text)

    def _define(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = _parse(Schema.read, body)
            self._schemas[schema.id] = schema
        else:
            channel = _parse(Channel.read, body)
            self._channels[channel.id] = channel

    def _report_end(self) -> None:
        if self._n_undefined:
            self._report(
                f"{self.path}: {self._n_undefined} messages are left out: a damaged chunk held the "
                f"definition of their channels"
            )
        if self.closed:
            self._report_missing()
            return
        reach = "no message" if self.end_ns is None else f"log time {self.end_ns / 1e9:.6f} s"
        unread = self.n_bytes - self._unread_from
        rest = f"; its last {unread} bytes are an unfinished record" if unread else ""
        self._report(
            f"{self.path}: was not closed (its logger was killed, or the copy is cut short); "
            f"it reads up to {reach}{rest}"
        )

    def _report_missing(self) -> None:
        """Say what a closed log lacks: a damaged record can look like one that holds no message."""
        if self._n_promised is not None and self._n_seen != self._n_promised:
            self._report(
                f"{self.path}: {self._n_seen} messages can be read, its summary counts {self._n_promised}"
            )


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except FileNotFoundError:
        raise LogError(f"{path}: no such file; give the path of a .mcap log, as in runs/<time>/") from None
    except IsADirectoryError:
        raise LogError(f"{path}: is a folder; give the path of one .mcap log in it") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); check that it may be read") from error


def _check_magic(path: Path, file: BinaryIO, n_bytes: int) -> None:
    file.seek(0)
    magic = file.read(len(MCAP0_MAGIC))
    if magic == MCAP0_MAGIC:
        return
    if n_bytes == 0:
        raise LogError(
            f"{path}: is empty (0 bytes), so nothing was logged; look for another segment beside it"
        )
    if magic.startswith(LCM_EVENT_MAGIC):
        raise LogError(f"{path}: is an LCM event log, not MCAP; turn it into one with podwatch log from-lcm")
    if MCAP0_MAGIC.startswith(magic):
        raise LogError(
            f"{path}: is cut off within its first {len(MCAP0_MAGIC)} bytes ({n_bytes} bytes); nothing is left"
        )
    raise LogError(f"{path}: is no MCAP file (begins with {magic!r}); give the path of a .mcap log")


def _next_chunk(file: BinaryIO, offset: int) -> int | None:
    """Where the first whole chunk at or behind `offset` begins, None where there is none."""
    file.seek(offset)
    rest = file.read()
    found = rest.find(CHUNK_MARK)
    while found >= 0:
        start = found - CHUNK_MARK_OFFSET
        if start >= 0:
            opcode, length = RECORD_HEAD.unpack_from(rest, start)
            if opcode == Opcode.CHUNK and length <= len(rest) - start - RECORD_HEAD.size:
                return offset + start
        found = rest.find(CHUNK_MARK, found + 1)
    return None


def _chunk_parts(body: bytes) -> list[tuple[int, bytes]]:
    """(opcode, body) of each record in a chunk; one of DAMAGE where its bytes are not what was written."""
    chunk = _parse(Chunk.read, body)
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise ValueError(f"it claims {chunk.uncompressed_size} bytes, {MAX_CHUNK_BYTES} is the limit")
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    return list(_split(stream.read(size)))


def _split(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(opcode, body) of each record in `data`; ValueError where the last one is cut off."""
    offset = 0
    while offset < len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, offset)
        offset += RECORD_HEAD.size
        if length > len(data) - offset:
            raise ValueError(f"a record of {length} bytes where {len(data) - offset} are left")
        yield opcode, data[offset : offset + length]
        offset += length


def _parse(read: Callable[[ReadDataStream], R], body: bytes) -> R:
    return read(ReadDataStream(BytesIO(body)))


def _is_opcode(opcode: int) -> bool:
    """Records of the specification, and those that it leaves to users."""
    return Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= 0x80
