"""Logs that are whole: what is written is what is read, for us, for lcm-gen, and for any MCAP reader."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import lcm
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from lcmtypes import channels, make, podwatch
from logs.exceptions import LogError, LogWarning
from logs.reader import info, read, segments
from logs.schemas import fingerprint, lcm_text
from logs.sequence import GapCounter
from logs.writer import LogWriter, fresh_path

LCM_GEN = Path(lcm.__file__).parent.parent / "bin" / "lcm-gen"
SECOND_US = 1_000_000
KINDS = sorted({channel.kind for channel in channels.BY_NAME.values()}, key=lambda kind: kind.__name__)


def state(seq: int, utime: int | None = None) -> podwatch.vehicle_state_t:
    return make(podwatch.vehicle_state_t, utime=seq * 50_000 if utime is None else utime, seq=seq, drone_id=2)


def filled_fleet_state() -> podwatch.fleet_state_t:
    rows = [make(podwatch.fleet_row_t, id=i, age_ms=10 * i, battery=0.5) for i in (2, 1, 3)]
    order = make(podwatch.operator_t, utime=7, command=podwatch.operator_t.HOLD, animal=-1)
    return make(podwatch.fleet_state_t, utime=5, seq=9, drone_id=2, n_rows=3, rows=rows, order=order)


def write(path: Path, messages: list[tuple[str, bytes, int]]) -> Path:
    writer = LogWriter(path, drone_id=2)
    for channel, data, utime in messages:
        writer.write(channel, data, utime)
    writer.close()
    return path


@settings(deadline=None, max_examples=30)
@given(
    st.lists(
        st.tuples(st.sampled_from([c.name for c in channels.CHANNELS]), st.integers(0, 3 * SECOND_US)),
        max_size=60,
    )
)
def test_what_is_written_is_read_in_its_order(tmp_path_factory, entries):
    path = tmp_path_factory.mktemp("log") / "drone.mcap"
    messages = []
    for seq, (channel, utime) in enumerate(entries):
        message = make(channels.kind_of(channel), utime=utime, seq=seq, drone_id=1)
        messages.append((channel, message.encode(), utime))
    write(path, messages)
    back = [(name, log_time_ns, message.encode()) for name, log_time_ns, message in read(path, strict=True)]
    assert back == [(name, utime * 1000, data) for name, data, utime in messages]


def test_members_of_nested_structs_come_back(tmp_path):
    path = write(tmp_path / "a.mcap", [(channels.FLEET_STATE, filled_fleet_state().encode(), 5)])
    [(name, log_time_ns, message)] = read(path, strict=True)
    assert (name, log_time_ns) == (channels.FLEET_STATE, 5000)
    assert [row.age_ms for row in message.rows] == [20, 10, 30]
    assert message.order.command == podwatch.operator_t.HOLD


def test_a_neighbours_copy_is_of_its_channels_type_and_filtered_by_its_own_name(tmp_path):
    copy = channels.received(3, channels.RING_MAP)
    data = make(podwatch.ring_map_t, utime=1, seq=4, drone_id=3, n_bytes=2, packet=b"ab").encode()
    path = write(tmp_path / "a.mcap", [(copy, data, 1), (channels.VEHICLE_STATE, state(0).encode(), 2)])
    [(name, _, message)] = read(path, channels=[copy], strict=True)
    assert (name, message.packet) == (copy, b"ab")
    assert [entry[0] for entry in read(path, channels=channels.VEHICLE_STATE)] == [channels.VEHICLE_STATE]


def test_a_channel_that_nobody_knows_is_named_with_those_that_the_log_has(tmp_path):
    path = write(tmp_path / "a.mcap", [(channels.VEHICLE_STATE, state(0).encode(), 0)])
    with pytest.warns(LogWarning, match="no channel VEHICEL_STATE; it has VEHICLE_STATE"):
        assert list(read(path, channels=["VEHICEL_STATE"])) == []
    assert list(read(path, channels=[channels.TRACK], strict=True)) == []  # known, only silent


def test_an_mcap_reader_finds_schema_fingerprint_drone_and_seq(tmp_path):
    path = write(tmp_path / "a.mcap", [(channels.VEHICLE_STATE, state(41, 7).encode(), 7)])
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        [(schema, channel, message)] = reader.iter_messages()
        [metadata] = reader.iter_metadata()
    assert (schema.name, schema.encoding) == ("podwatch.vehicle_state_t", "lcm")
    assert channel.message_encoding == "lcm"
    assert channel.metadata == {"drone": "2", "fingerprint": fingerprint(podwatch.vehicle_state_t).hex()}
    assert (message.log_time, message.publish_time, message.sequence) == (7000, 7000, 41)
    assert (metadata.name, metadata.metadata) == ("podwatch", {"drone_id": "2"})


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_lcm_gen_rebuilds_each_decoder_from_the_logs_schema_alone(tmp_path, monkeypatch, kind):
    name = next(channel.name for channel in channels.BY_NAME.values() if channel.kind is kind)
    message = filled_fleet_state() if kind is podwatch.fleet_state_t else make(kind, utime=5, seq=9)
    path = write(tmp_path / "a.mcap", [(name, message.encode(), 5)])
    with path.open("rb") as file:
        [(schema, _, logged)] = make_reader(file).iter_messages()
    (tmp_path / "only.lcm").write_bytes(schema.data)
    subprocess.run(
        [LCM_GEN, "--python", "--package-prefix", "rebuilt", "--ppath", tmp_path, tmp_path / "only.lcm"],
        check=True,
    )
    monkeypatch.syspath_prepend(tmp_path)
    for module in [key for key in sys.modules if key.split(".")[0] == "rebuilt"]:
        monkeypatch.delitem(sys.modules, module)
    importlib.invalidate_caches()
    struct_name = schema.name.removeprefix("podwatch.")
    rebuilt = importlib.import_module(f"rebuilt.podwatch.{struct_name}")
    decoded = getattr(rebuilt, struct_name).decode(logged.data)
    assert decoded.encode() == message.encode()
    assert (decoded.utime, decoded.seq) == (5, 9)


def test_a_schema_says_its_package_once_and_nested_structs_first():
    text = lcm_text(podwatch.fleet_state_t)
    assert text.count("package podwatch;") == 1
    assert text.index("struct fleet_row_t") < text.index("struct fleet_state_t")
    assert text.index("struct operator_t") < text.index("struct fleet_state_t")


def test_every_channels_type_begins_with_the_head_that_gaps_are_read_from():
    for kind in KINDS:
        assert kind.__slots__[:2] == ["utime", "seq"], kind
        assert kind.__typenames__[:2] == ["int64_t", "int32_t"], kind
    assert podwatch.heartbeat_t.__slots__[2:4] == ["drone_id", "process"]
    assert podwatch.heartbeat_t.__typenames__[2:4] == ["int8_t", "string"]


WRITE_A_LOG = """
import sys
from pathlib import Path
from lcmtypes import channels, make
from logs.writer import LogWriter
writer = LogWriter(sys.argv[1], drone_id=1, metadata={"seed": "3", "mission": "default"})
for step in range(300):
    channel = channels.CHANNELS[step % len(channels.CHANNELS)]
    message = make(channel.kind, utime=step * 20_000, seq=step, drone_id=1)
    writer.write(channel.name, message.encode(), step * 20_000)
writer.close()
"""


def test_two_interpreters_write_the_same_bytes(tmp_path):
    for hash_seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
        command = [sys.executable, "-c", WRITE_A_LOG, tmp_path / f"{hash_seed}.mcap"]
        subprocess.run(command, check=True, env=environment, cwd=Path(__file__).parents[2])
    assert (tmp_path / "1.mcap").read_bytes() == (tmp_path / "2.mcap").read_bytes()


def test_a_log_is_never_overwritten(tmp_path):
    first = tmp_path / "drone1.mcap"
    LogWriter(first, drone_id=1).close()
    with pytest.raises(LogError, match=r"drone1\.mcap: exists already.*a path that is free"):
        LogWriter(first, drone_id=1)
    LogWriter(fresh_path(first), drone_id=1).close()
    assert fresh_path(first) == tmp_path / "drone1.2.mcap"
    assert segments(first) == [first, tmp_path / "drone1.1.mcap"]


def test_a_path_that_cannot_be_made_is_named(tmp_path):
    with pytest.raises(LogError, match=r"nowhere.*cannot be made \(No such file"):
        LogWriter(tmp_path / "nowhere" / "a.mcap", drone_id=1)


@pytest.mark.parametrize("utime", [-1, 2**63 // 1000 + 1])
def test_a_time_that_mcap_cannot_hold_is_refused_with_its_value(tmp_path, utime):
    writer = LogWriter(tmp_path / "a.mcap", drone_id=1)
    with pytest.raises(LogError, match=rf"utime {utime} us of TRACK"):
        writer.write(channels.TRACK, b"", utime)
    writer.close()


def test_info_counts_by_hand(tmp_path):
    # 5 Hz for one second with seq 3 missing; one heartbeat each of two processes, with counters of their own
    messages = [(channels.VEHICLE_STATE, state(seq).encode(), seq * 200_000) for seq in (0, 1, 2, 4, 5)]
    for process, seq in (("camera", 7), ("tracker", 90), ("camera", 8), ("tracker", 91)):
        beat = make(podwatch.heartbeat_t, utime=SECOND_US, seq=seq, drone_id=2, process=process)
        messages.append((channels.HEARTBEAT, beat.encode(), 2 * SECOND_US))
    messages.append(("STRANGER", b"12345", 2 * SECOND_US))
    log = info(write(tmp_path / "a.mcap", messages))
    assert (log.n_messages, log.span_s, log.closed, log.problems) == (10, 2.0, True, ())
    assert log.metadata == {"drone_id": "2"}
    beats, stranger, states = log.channels
    assert (states.name, states.type_name, states.n_messages) == (
        "VEHICLE_STATE",
        "podwatch.vehicle_state_t",
        5,
    )
    assert states.n_bytes == 5 * len(state(0).encode())
    assert (states.rate_hz, states.n_lost) == (pytest.approx(4.0), 1)
    assert (beats.n_messages, beats.n_lost, beats.rate_hz) == (4, 0, 0.0)
    assert (stranger.type_name, stranger.n_bytes, stranger.n_lost) == ("", 5, None)


def test_a_log_without_a_message_is_a_log(tmp_path):
    path = write(tmp_path / "a.mcap", [])
    assert list(read(path, strict=True)) == []
    assert (info(path).n_messages, info(path).span_s) == (0, 0.0)


@pytest.mark.parametrize(
    ("arrivals", "lost"),
    [
        ([(1, 10), (2, 11), (3, 12)], 0),
        ([(1, 10), (2, 14)], 3),
        ([(1, 10), (2, 0), (3, 1)], 0),  # the publisher started anew
        ([(1, 10), (2, 0), (3, 2)], 1),  # and lost one then
        ([(1, 10), (1, 10), (2, 11)], 0),  # said twice
        ([(1, 10), (3, 12), (2, 11), (4, 13)], 1),  # overtaken: it was counted when 12 came
    ],
)
def test_gaps_in_seq(arrivals, lost):
    gaps = GapCounter()
    for utime, seq in arrivals:
        gaps.see(channels.VEHICLE_STATE, state(seq, utime).encode())
    assert gaps.n_lost == lost
    assert gaps.lost.get(channels.VEHICLE_STATE, 0) == lost


@given(st.binary(max_size=40), st.sampled_from([channels.TRACK, channels.HEARTBEAT, "STRANGER"]))
def test_gaps_are_never_seen_in_bytes_of_another_type(data, channel):
    gaps = GapCounter()
    gaps.see(channel, data)
    gaps.see(channel, fingerprint(podwatch.track_t) + data)
    gaps.see(channel, fingerprint(podwatch.heartbeat_t) + data)
    assert gaps.n_lost == 0
