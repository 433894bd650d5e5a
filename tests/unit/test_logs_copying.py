"""Logs made from logs: mended at any cut, cut into parts and joined again, turned into LCM's and back."""

import warnings

import lcm
import numpy as np
import pytest
from typer.testing import CliRunner

from lcmtypes import channels, make, podwatch
from logs.copying import merge, recover, split
from logs.event_log import from_lcm, to_lcm
from logs.exceptions import LogError
from logs.reader import info, read, segments
from logs.scan import Scan
from logs.schemas import fingerprint
from logs.writer import FLUSH_PERIOD_US, LogWriter
from tools.log import app

PERIOD_US = 50_000
N_CUTS = 200


def write(path, n_messages, *, drone_id=1, first=0, close=True):
    writer = LogWriter(path, drone_id=drone_id, metadata={"seed": "7"})
    for seq in range(first, first + n_messages):
        state = make(podwatch.vehicle_state_t, utime=seq * PERIOD_US, seq=seq, drone_id=drone_id)
        writer.write(channels.VEHICLE_STATE, state.encode(), seq * PERIOD_US)
        if seq % 2 == 0:
            copy = make(podwatch.ring_map_t, utime=seq * PERIOD_US + 1, seq=seq, drone_id=2)
            writer.write(channels.received(2, channels.RING_MAP), copy.encode(), seq * PERIOD_US + 1)
    if close:
        writer.close()
    return path


def raw(path):
    """(channel, log time ns, bytes) of every message."""
    return [(m.channel, m.log_time_ns, m.data) for m in Scan(path, lambda _: None).messages()]


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.parametrize("is_closed", [True, False], ids=["closed", "killed"])
def test_recover_mends_a_log_cut_at_any_byte(tmp_path, is_closed):
    whole = write(tmp_path / "whole.mcap", 95, close=is_closed)
    content = whole.read_bytes()
    expected = raw(whole)
    flushed_at = _flush_ends(content, whole)
    random = np.random.default_rng(12)
    for number, cut in enumerate(random.integers(8, len(content), N_CUTS)):
        damaged, mended = tmp_path / "cut.mcap", tmp_path / f"mended{number}.mcap"
        damaged.write_bytes(content[:cut])
        n_flushed = max((n for end, n in flushed_at if end <= cut), default=0)
        if n_flushed == 0:
            with pytest.raises(LogError, match="no whole message is left"):
                recover(damaged, mended, lambda _: None)
            continue
        copied = recover(damaged, mended, lambda _: None)
        assert raw(mended) == expected[:n_flushed]
        assert copied.n_messages == n_flushed
        log = info(mended)
        assert (log.closed, log.problems) == (True, ())
        assert (log.metadata["drone_id"], log.metadata["seed"]) == ("1", "7")
    # and what was flushed is all but the last second
    assert expected[-1][1] - expected[flushed_at[-1][1] - 1][1] <= FLUSH_PERIOD_US * 1000


def _flush_ends(content, path):
    """(byte at which a chunk ends, messages up to there) of each chunk."""
    ends, n_messages = [], 0
    scan = Scan(path, lambda _: None)
    with path.open("rb") as file:
        for record in scan._records(file, 8, len(content)):
            n_messages += sum(1 for _ in scan._record_messages(record))
            ends.append((record.offset + 9 + len(record.body), n_messages))
    return [end for end in ends if end[1]]


def test_recover_says_what_it_saved_and_overwrites_nothing(tmp_path):
    log = write(tmp_path / "drone_1.mcap", 50, close=False)
    result = run("recover", log)
    assert result.exit_code == 0
    assert result.stdout == f"{tmp_path / 'drone_1.recovered.mcap'}: 60 messages of 1.950 s\n"
    assert "was not closed" in result.stderr
    again = run("recover", log)
    assert again.exit_code == 2
    assert "exists already and is not overwritten" in again.stderr


def test_a_type_of_another_version_keeps_its_decoder(tmp_path):
    """A log of an older version: bytes of an unknown fingerprint, with the schema that decodes them."""
    writer = LogWriter(tmp_path / "old.mcap", drone_id=1)
    body = b"\1" * 8 + b"old"
    writer.write(channels.TRACK, body, 5, ("podwatch.track_t", b"package podwatch; struct track_t {}"))
    writer.close()
    recover(tmp_path / "old.mcap", tmp_path / "new.mcap", lambda _: None)
    [message] = Scan(tmp_path / "new.mcap", lambda _: None).messages()
    assert body[:8] != fingerprint(podwatch.track_t)
    assert message.data == body
    assert (message.type_name, message.schema_text[:7]) == ("podwatch.track_t", b"package")


def test_parts_read_as_one_drones_segments_and_join_to_the_whole(tmp_path):
    log = write(tmp_path / "drone_1.mcap", 95)
    parts = split(log, tmp_path / "parts", 2.0, lambda _: None)
    assert [part.n_messages for part in parts] == [60, 60, 23]
    assert [part.path for part in parts] == segments(tmp_path / "parts" / "drone_1.mcap")
    assert all(info(part.path).closed for part in parts)
    joined = merge([part.path for part in reversed(parts)], tmp_path / "joined.mcap", lambda _: None)
    assert raw(joined.path) == raw(log)
    assert joined.span_s == pytest.approx(4.7)


def test_a_silence_longer_than_a_part_leaves_no_hole_in_the_numbers(tmp_path):
    writer = LogWriter(tmp_path / "drone_1.mcap", drone_id=1)
    for utime in (0, 9_000_000):
        writer.write(channels.TRACK, make(podwatch.track_t, utime=utime).encode(), utime)
    writer.close()
    parts = split(tmp_path / "drone_1.mcap", tmp_path / "parts", 1.0, lambda _: None)
    assert [part.path.name for part in parts] == ["drone_1.mcap", "drone_1.1.mcap"]


def test_overlapping_logs_of_one_drone_are_merged_by_time(tmp_path):
    even, odd = LogWriter(tmp_path / "a.mcap", drone_id=1), LogWriter(tmp_path / "b.mcap", drone_id=1)
    for seq in range(40):
        data = make(podwatch.track_t, utime=seq, seq=seq, drone_id=1).encode()
        (odd if seq % 2 else even).write(channels.TRACK, data, seq)
    even.close()
    odd.close()
    merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "c.mcap", lambda _: None)
    assert [message.seq for _, _, message in read(tmp_path / "c.mcap")] == list(range(40))


def test_logs_of_several_drones_are_not_merged(tmp_path):
    first, second = write(tmp_path / "1.mcap", 3), write(tmp_path / "2.mcap", 3, drone_id=2)
    result = run("merge", first, second, "--out", tmp_path / "out.mcap")
    assert result.exit_code == 2
    assert f"drone 1 in {first}, drone 2 in {second}" in result.stderr.replace("\n", " ")
    assert "podwatch play" in result.stderr


def test_a_period_of_nothing_is_refused(tmp_path):
    log = write(tmp_path / "a.mcap", 3)
    result = run("split", log, "--every", "0")
    assert (result.exit_code, result.stderr) == (2, "--every 0: a part must be longer than 0 s\n")


def test_an_lcm_event_log_and_back_is_the_same_log(tmp_path):
    log = write(tmp_path / "drone_1.mcap", 45)
    to_lcm(log, tmp_path / "a.lcmlog", lambda _: None)
    events = lcm.EventLog(str(tmp_path / "a.lcmlog"))
    assert [(event.channel, event.timestamp * 1000, event.data) for event in events] == raw(log)
    events.close()
    from_lcm(tmp_path / "a.lcmlog", tmp_path / "back.mcap")
    assert raw(tmp_path / "back.mcap") == raw(log)
    assert info(tmp_path / "back.mcap").metadata["drone_id"] == "1"


def test_an_event_log_that_names_no_drone_needs_to_be_told(tmp_path):
    path = tmp_path / "a.lcmlog"
    events = lcm.EventLog(str(path), "w")
    copy = make(podwatch.ring_map_t, drone_id=5).encode()
    for channel, data in (("STRANGER", b"hello"), (channels.received(5, channels.RING_MAP), copy)):
        events.write_event(1_700_000_000_000_000, channel, data)
    events.close()
    refused = run("from-lcm", path)
    assert refused.exit_code == 2
    assert "say whose bus it was with --drone" in refused.stderr
    assert not (tmp_path / "a.lcmlog.mcap").exists()
    assert run("from-lcm", path, "--drone", "4").exit_code == 0
    assert info(tmp_path / "a.lcmlog.mcap").metadata["drone_id"] == "4"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert next(read(tmp_path / "a.lcmlog.mcap"))[1:] == (1_700_000_000_000_000_000, b"hello")


@pytest.mark.parametrize(
    ("command", "words"),
    [("from-lcm", "is no LCM event log"), ("to-lcm", "is no MCAP"), ("recover", "is no MCAP")],
)
def test_a_file_of_another_kind_is_told(tmp_path, command, words):
    (tmp_path / "a").write_bytes(b"something else")
    result = run(command, tmp_path / "a", "--out", tmp_path / "b")
    assert result.exit_code == 2
    assert words in result.stderr
    assert not (tmp_path / "b").exists()
