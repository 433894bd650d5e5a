"""Logs that are damaged: killed loggers, cut copies, flipped bytes, foreign files, other versions."""

import signal
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from lcmtypes import channels, make, podwatch
from logs.exceptions import LogError, LogWarning
from logs.reader import info, read
from logs.scan import CHUNK_MARK, CHUNK_MARK_OFFSET
from logs.schemas import fingerprint
from logs.writer import LogWriter

PERIOD_US = 50_000  # 20 messages a second
ROOT = Path(__file__).parents[2]


def state(seq: int) -> bytes:
    return make(podwatch.vehicle_state_t, utime=seq * PERIOD_US, seq=seq, drone_id=1).encode()


def write(path: Path, n_messages: int, *, close: bool = True) -> LogWriter:
    writer = LogWriter(path, drone_id=1)
    for seq in range(n_messages):
        writer.write(channels.VEHICLE_STATE, state(seq), seq * PERIOD_US)
    if close:
        writer.close()
    return writer


def read_with_warnings(path: Path) -> tuple[list[int], list[str]]:
    """(seq of each message, text of each warning)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        seqs = [message.seq for _, _, message in read(path)]
    assert all(warning.category is LogWarning for warning in caught)
    return seqs, [str(warning.message) for warning in caught]


@pytest.fixture(scope="module")
def closed_log(tmp_path_factory) -> bytes:
    """Five seconds: five chunks of 20 messages."""
    path = tmp_path_factory.mktemp("logs") / "closed.mcap"
    write(path, 100)
    return path.read_bytes()


@pytest.fixture(scope="module")
def killed_log(tmp_path_factory) -> bytes:
    """What is on the disk of a logger that was killed in its fifth second: four chunks."""
    path = tmp_path_factory.mktemp("logs") / "killed.mcap"
    write(path, 95, close=False)
    return path.read_bytes()


def chunk_offsets(log: bytes) -> list[int]:
    found, at = [], log.find(CHUNK_MARK)
    while at >= 0:
        found.append(at - CHUNK_MARK_OFFSET)
        at = log.find(CHUNK_MARK, at + 1)
    return found


@pytest.mark.parametrize("n_messages", [1, 20, 21, 39, 40, 95])
def test_at_any_time_all_but_the_last_second_is_on_the_disk(tmp_path, n_messages):
    write(tmp_path / "a.mcap", n_messages, close=False)
    seqs, [warning] = read_with_warnings(tmp_path / "a.mcap")
    assert seqs == list(range(len(seqs)))
    assert n_messages - len(seqs) <= 20
    assert "was not closed" in warning


def test_a_log_that_was_taken_away_is_not_made_anew(tmp_path):
    writer = write(tmp_path / "a.mcap", 1, close=False)
    (tmp_path / "a.mcap").unlink()
    with pytest.raises(FileNotFoundError):
        writer.flush()
    assert not (tmp_path / "a.mcap").exists()


def test_a_quiet_bus_is_flushed_too(tmp_path):
    writer = write(tmp_path / "a.mcap", 1, close=False)
    writer.flush_due(999_999)
    assert read_with_warnings(tmp_path / "a.mcap")[0] == []
    writer.flush_due(1_000_000)
    assert read_with_warnings(tmp_path / "a.mcap")[0] == [0]


KILLED_WRITER = """
import sys
from lcmtypes import channels, make, podwatch
from logs.writer import LogWriter
writer = LogWriter(sys.argv[1], drone_id=1)
seq = 0
while True:
    data = make(podwatch.vehicle_state_t, utime=seq * 50_000, seq=seq, drone_id=1).encode()
    writer.write(channels.VEHICLE_STATE, data, seq * 50_000)
    if seq % 1000 == 0:
        print(seq, flush=True)
    seq += 1
"""


def test_a_log_whose_writer_was_killed_reads_up_to_its_last_second(tmp_path):
    path = tmp_path / "a.mcap"
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED_WRITER, path], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    told = 0
    while told < 5000:
        told = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    rest = process.stdout.read().split()
    process.wait()
    process.stdout.close()
    seqs, [warning] = read_with_warnings(path)
    assert seqs == list(range(len(seqs)))
    assert len(seqs) >= int((rest or [told])[-1]) - 20
    assert f"reads up to log time {seqs[-1] * PERIOD_US / 1e6:.6f} s" in warning


def test_a_killed_log_says_up_to_when_it_reads(tmp_path, killed_log):
    path = tmp_path / "a.mcap"
    path.write_bytes(killed_log)
    seqs, texts = read_with_warnings(path)
    assert seqs == list(range(80))
    assert texts == [
        f"{path}: was not closed (its logger was killed, or the copy is cut short); "
        "it reads up to log time 3.950000 s"
    ]
    assert (info(path).closed, info(path).problems) == (False, tuple(texts))
    messages = read(path, strict=True)
    assert len([next(messages) for _ in range(80)]) == 80
    with pytest.raises(LogError, match="was not closed"):
        next(messages)


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_a_cut_log_reads_up_to_its_last_whole_chunk(tmp_path_factory, killed_log, data):
    cut = data.draw(st.integers(8, len(killed_log) - 1))
    path = tmp_path_factory.getbasetemp() / "cut.mcap"
    path.write_bytes(killed_log[:cut])
    seqs, texts = read_with_warnings(path)
    assert len(texts) == 1
    assert "was not closed" in texts[0]
    lengths = [int.from_bytes(killed_log[at + 1 : at + 9], "little") for at in chunk_offsets(killed_log)]
    whole = sum(at + 9 + size <= cut for at, size in zip(chunk_offsets(killed_log), lengths, strict=True))
    assert seqs == list(range(20 * whole))


@settings(deadline=None, max_examples=150)
@given(data=st.data())
def test_a_flipped_byte_never_invents_a_message_nor_hides_a_loss(tmp_path_factory, closed_log, data):
    at = data.draw(st.integers(8, len(closed_log) - 1))
    flipped = data.draw(st.integers(1, 255))
    path = tmp_path_factory.getbasetemp() / "flipped.mcap"
    path.write_bytes(closed_log[:at] + bytes([closed_log[at] ^ flipped]) + closed_log[at + 1 :])
    seqs, texts = read_with_warnings(path)
    assert set(seqs) <= set(range(100))
    assert seqs == sorted(seqs)
    assert len(seqs) >= 80  # one chunk at most
    assert len(seqs) == 100 or texts


@pytest.mark.parametrize("number", range(5))
def test_a_chunk_with_a_wrong_checksum_is_named_by_its_offset_and_left_out(tmp_path, closed_log, number):
    offset = chunk_offsets(closed_log)[number]
    path = tmp_path / "a.mcap"
    crc_at = offset + CHUNK_MARK_OFFSET - 4
    path.write_bytes(closed_log[:crc_at] + b"\0\0\0\1" + closed_log[crc_at + 4 :])
    seqs, texts = read_with_warnings(path)
    lost = range(20 * number, 20 * number + 20)
    assert seqs == [seq for seq in range(100) if seq not in lost]
    assert f"the chunk at byte {offset} (" in texts[0]
    assert "crc validation failed" in texts[0]
    assert texts[1:] == [f"{path}: 80 messages can be read, its summary counts 100"]
    with pytest.raises(LogError, match=f"the chunk at byte {offset}"):
        list(read(path, strict=True))


def test_a_chunk_that_claims_more_than_memory_can_hold_is_damage(tmp_path, closed_log):
    top_of_length = chunk_offsets(closed_log)[1] + CHUNK_MARK_OFFSET + len(CHUNK_MARK) + 7
    path = tmp_path / "a.mcap"
    path.write_bytes(closed_log[:top_of_length] + b"\x80" + closed_log[top_of_length + 1 :])
    seqs, texts = read_with_warnings(path)
    assert seqs == [*range(20), *range(40, 100)]
    assert f"the chunk at byte {chunk_offsets(closed_log)[1]}" in texts[0]


def test_reading_goes_on_behind_a_damaged_length(tmp_path, killed_log):
    offset, following = chunk_offsets(killed_log)[1:3]
    path = tmp_path / "a.mcap"
    path.write_bytes(killed_log[: offset + 1] + b"\xff" * 8 + killed_log[offset + 9 :])
    seqs, texts = read_with_warnings(path)
    assert seqs == [*range(20), *range(40, 80)]
    assert f"a record at or before byte {offset} is damaged" in texts[0]
    assert f"reading goes on with the chunk at byte {following}" in texts[0]


def test_channels_defined_in_a_damaged_chunk_are_counted_where_no_summary_repeats_them(tmp_path, killed_log):
    crc_at = chunk_offsets(killed_log)[0] + CHUNK_MARK_OFFSET - 4
    path = tmp_path / "a.mcap"
    path.write_bytes(killed_log[:crc_at] + b"\0\0\0\1" + killed_log[crc_at + 4 :])
    seqs, texts = read_with_warnings(path)
    assert seqs == []
    assert "60 messages are left out" in texts[1]


def test_zeros_behind_the_last_chunk_are_left_unread(tmp_path, killed_log):
    path = tmp_path / "a.mcap"
    path.write_bytes(killed_log + bytes(4096))
    seqs, [text] = read_with_warnings(path)
    assert seqs == list(range(80))
    assert text.endswith("its last 4096 bytes are an unfinished record")


FOREIGN = {
    "empty": (b"", "is empty (0 bytes), so nothing was logged; look for another segment beside it"),
    "text": (b"t_s,kind,id", "is no MCAP file (begins with b't_s,kind'); give the path of a .mcap log"),
    "event log": (
        bytes.fromhex("eda1da010000000000"),
        "is an LCM event log, not MCAP; turn it into one with podwatch log from-lcm",
    ),
    "cut magic": (b"\x89MCAP", "is cut off within its first 8 bytes (5 bytes); nothing is left"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_file_that_is_no_log_is_refused_at_the_call_with_the_remedy(tmp_path, name):
    content, message = FOREIGN[name]
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    for function in (read, info):
        with pytest.raises(LogError) as caught:
            function(path)
        assert str(caught.value) == f"{path}: {message}"


def test_a_missing_file_and_a_folder_are_refused_at_the_call(tmp_path):
    with pytest.raises(LogError, match=r"gone\.mcap: no such file; give the path"):
        read(tmp_path / "gone.mcap")
    with pytest.raises(LogError, match="is a folder; give the path of one"):
        info(tmp_path)


def test_only_the_magic_is_a_log_without_messages(tmp_path, closed_log):
    path = tmp_path / "a.mcap"
    path.write_bytes(closed_log[:8])
    seqs, [text] = read_with_warnings(path)
    assert seqs == []
    assert text.endswith("it reads up to no message")


def log_of(path: Path, channel: str, messages: list[bytes]) -> Path:
    writer = LogWriter(path, drone_id=1)
    for number, data in enumerate(messages):
        writer.write(channel, data, number)
    writer.close()
    return path


def test_an_unknown_fingerprint_yields_raw_bytes_and_one_warning(tmp_path):
    other = bytes.fromhex("0123456789abcdef") + b"body"
    path = log_of(tmp_path / "a.mcap", channels.TRACK, [other, other, make(podwatch.track_t).encode()])
    with pytest.warns(LogWarning) as caught:
        messages = [message for _, _, message in read(path)]
    assert messages[:2] == [other, other]
    assert isinstance(messages[2], podwatch.track_t)
    [text] = [str(warning.message) for warning in caught]
    assert "TRACK carries fingerprint 0123456789abcdef" in text
    assert fingerprint(podwatch.track_t).hex() in text
    with pytest.raises(LogError, match="carries fingerprint 0123456789abcdef"):
        list(read(path, strict=True))


def test_no_schema_is_claimed_for_bytes_of_another_type(tmp_path):
    other = bytes.fromhex("0123456789abcdef") + bytes(40)
    path = log_of(tmp_path / "a.mcap", channels.TRACK, [make(podwatch.track_t).encode(), other])
    with path.open("rb") as file:
        found = [(schema and schema.name, dict(channel.metadata)) for schema, channel, _ in reader_of(file)]
    assert found[0][0] == "podwatch.track_t"
    assert found[1] == (None, {"drone": "1"})


def reader_of(file):
    return make_reader(file, validate_crcs=True).iter_messages()


def test_a_channel_that_the_table_lacks_is_kept_raw_with_an_empty_schema(tmp_path):
    path = log_of(tmp_path / "a.mcap", "STRANGER", [b"", b"abc"])
    with pytest.warns(LogWarning, match="of no known type"):
        assert [message for _, _, message in read(path)] == [b"", b"abc"]
    with path.open("rb") as file:
        assert {schema for schema, _, _ in make_reader(file).iter_messages()} == {None}


def test_a_type_of_another_version_that_the_log_names_comes_raw_with_the_way_to_decode_it(
    tmp_path, monkeypatch
):
    path = log_of(tmp_path / "a.mcap", channels.TRACK, [make(podwatch.track_t, seq=4).encode()])
    monkeypatch.setattr(podwatch.track_t, "_packed_fingerprint", b"next one")
    with pytest.warns(LogWarning, match=r"podwatch\.track_t of another version; lcm-gen on the log's schema"):
        [(_, _, message)] = read(path)
    assert isinstance(message, bytes)


def test_a_message_that_does_not_decode_is_raw_and_told_once(tmp_path):
    whole = make(podwatch.track_t, seq=4).encode()
    path = log_of(tmp_path / "a.mcap", channels.TRACK, [whole[:40], whole[:50], whole])
    with pytest.warns(LogWarning) as caught:
        messages = [message for _, _, message in read(path)]
    assert [len(message) for message in messages[:2]] == [40, 50]
    assert messages[2].seq == 4
    [text] = [str(warning.message) for warning in caught]
    assert "TRACK at log time 0.000000 s does not decode as track_t" in text
    with pytest.raises(LogError, match="does not decode"):
        list(read(path, strict=True))


def test_a_message_too_short_for_its_head_is_told_by_its_type(tmp_path):
    stump = fingerprint(podwatch.track_t) + b"12"
    with pytest.warns(LogWarning, match=r"does not decode as track_t \(.*, 10 bytes\)"):
        assert [entry[2] for entry in read(log_of(tmp_path / "a.mcap", channels.TRACK, [stump]))] == [stump]


@settings(deadline=None, max_examples=60)
@given(st.binary(max_size=200), st.sampled_from([channel.name for channel in channels.CHANNELS]))
def test_no_bytes_on_the_bus_break_writer_or_reader(tmp_path_factory, body, channel):
    path = tmp_path_factory.getbasetemp() / "any.mcap"
    path.unlink(missing_ok=True)
    data = fingerprint(channels.BY_NAME[channel].kind) + body
    log_of(path, channel, [body, data])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LogWarning)
        assert len(list(read(path))) == 2
