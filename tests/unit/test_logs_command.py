"""`podwatch log info|cat`: what people see, and what bad input gets."""

import pytest
from typer.testing import CliRunner

from lcmtypes import channels, make, podwatch
from logs.writer import LogWriter
from tools import cli
from tools.log import app, describe


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Ten TRACKs 0.1 s apart from drone time 5.0 s on, and two operator-bearing fleet states."""
    path = tmp_path_factory.mktemp("command") / "drone3.mcap"
    writer = LogWriter(path, drone_id=3)
    for seq in range(10):
        utime = 5_000_000 + seq * 100_000
        track = make(podwatch.track_t, utime=utime, seq=seq, drone_id=3, u_px=320.25, score=0.5)
        writer.write(channels.TRACK, track.encode(), utime)
        if seq in (3, 6):
            fleet = make(podwatch.fleet_state_t, utime=utime, seq=seq, drone_id=3)
            writer.write(channels.FLEET_STATE, fleet.encode(), utime)
    writer.close()
    return path


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_info_tells_the_span_and_each_channel(log):
    result = run("info", log)
    assert result.exit_code == 0
    assert "drone 3, 12 messages in 0.900 s" in result.stdout
    assert "closed" in result.stdout
    [track] = [line for line in result.stdout.splitlines() if line.startswith("TRACK")]
    assert track.split() == ["TRACK", "track_t", "10", "10.00", "800", "B", "80", "B", "0"]


def test_info_cuts_no_name(tmp_path):
    path = tmp_path / "a.mcap"
    writer = LogWriter(path, drone_id=3)
    name = channels.received(99, channels.RING_EPISODE)
    writer.write(name, podwatch.episode_t().encode(), 0)
    writer.write("NOBODYS_[red]", bytes(1_234_567), 0)
    writer.close()
    lines = [line.split() for line in run("info", path).stdout.splitlines()]
    assert [name, "episode_t", "1", "0.00", "43", "B", "43", "B", "0"] in lines
    assert ["NOBODYS_[red]", "not", "known", "1", "0.00", "1.2", "MB", "1.2", "MB", "-"] in lines


def test_info_names_the_files_of_a_restarted_logger(log, tmp_path):
    first = tmp_path / "drone3.mcap"
    first.write_bytes(log.read_bytes())
    (tmp_path / "drone3.1.mcap").write_bytes(log.read_bytes())
    said = run("info", first).stdout
    assert (
        f"of another boot, on a clock of its own, and no part of this log: {tmp_path / 'drone3.1.mcap'}"
        in said
    )
    writer = LogWriter(tmp_path / "drone3.2.mcap", drone_id=3)
    writer.write(channels.TRACK, podwatch.track_t().encode(), 5_900_000)
    writer.close()
    (tmp_path / "drone3.1.mcap").unlink()
    assert f"the log goes on in {tmp_path / 'drone3.2.mcap'}" in run("info", first).stdout


def test_cat_prints_a_message_a_line_from_the_logs_start(log):
    result = run("cat", log)
    lines = result.stdout.splitlines()
    assert len(lines) == 12
    assert lines[0].startswith("    0.000000 TRACK utime=5000000 seq=0 drone_id=3 ")
    assert " u_px=320.25 " in lines[0]
    assert " score=0.5 " in lines[0]
    assert " order=(utime=0 command=0 " in lines[4]
    assert result.stderr == ""


@pytest.mark.parametrize(
    ("options", "times"),
    [
        (["-c", "FLEET_STATE"], [0.3, 0.6]),
        (["-c", "*_STATE"], [0.3, 0.6]),
        (["--channel", "FLEET_STATE", "--channel", "TRACK", "--limit", "5"], [0.0, 0.1, 0.2, 0.3, 0.3]),
        (["--start", "0.65", "--end", "0.85"], [0.7, 0.8]),
        (["-c", "FLEET_STATE", "--start", "0.6"], [0.6]),
        (["--start", "9"], []),
    ],
)
def test_cat_keeps_what_is_asked_for(log, options, times):
    result = run("cat", log, *options)
    assert result.exit_code == 0
    assert [float(line.split()[0]) for line in result.stdout.splitlines()] == times


def test_a_channel_that_the_log_lacks_is_told(log):
    result = run("cat", log, "-c", "TRACK", "-c", "RX_*")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith(f"{log}: has no channel RX_*; it has FLEET_STATE, TRACK; a pattern is")


def test_a_number_that_has_a_name_is_printed_with_it():
    assert "state=0 (IDLE) since_utime=0 " in describe(podwatch.mission_state_t())
    assert " command=1 (START)" in describe(make(podwatch.mission_state_t, command=1))
    assert " state=1 (TRACKING) " in describe(make(podwatch.track_t, state=podwatch.track_t.TRACKING))
    rows = [make(podwatch.fleet_row_t, id=2, state=99), make(podwatch.fleet_row_t, id=3, state=1)]
    told = describe(make(podwatch.fleet_state_t, n_rows=2, rows=rows))
    assert "state=99 animal" in told, "a state of another version"
    assert "state=1 (TAKEOFF) animal" in told


@pytest.mark.parametrize("command", ["info", "cat"])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file"),
        (b"", "is empty (0 bytes)"),
        (b"hello", "is no MCAP file (begins with b'hello')"),
        (b"\x89MCA", "is cut off within its first 8 bytes"),
    ],
)
def test_a_file_that_is_no_log_gets_one_line_and_exit_code_2(tmp_path, command, content, words):
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    result = run(command, path)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith(f"{path}: ")
    assert words in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("command", ["info", "cat"])
def test_a_damaged_log_is_shown_as_far_as_it_reads(log, tmp_path, command):
    path = tmp_path / "a.mcap"
    content = log.read_bytes()
    path.write_bytes(content[: content.rindex(b"\x0f\x04\0\0\0\0\0\0\0")])
    result = run(command, path)
    assert result.exit_code == 0
    assert "TRACK" in result.stdout
    assert result.stderr.startswith(f"warning: {path}: was not closed")
    assert ("NOT closed" in result.stdout) == (command == "info")


def test_an_end_before_the_start_is_refused(log):
    result = run("cat", log, "--start", "3", "--end", "1")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == "--end 1 lies before --start 3; give an end of at least the start\n"


def test_long_members_are_cut_and_counted():
    preview = make(podwatch.preview_t, n_bytes=3, data=b"abc", format="jpeg")
    assert describe(preview).endswith("format='jpeg' n_bytes=3 data=<3 bytes>")
    track = make(podwatch.track_t, n_outline=20, outline=[[i, i] for i in range(20)])
    assert describe(track).endswith("[6, 6], [7, 7], +12 more]")
    assert describe(b"\x01" * 20) == "20 bytes " + " ".join(["01"] * 16)


def test_the_help_tells_what_is_taken_where_nothing_is_given():
    told = " ".join(CliRunner().invoke(cli.app, ["replay", "--help"], env={"COLUMNS": "200"}).stdout.split())
    assert "ms between two times. [default: (0; 100 for a log of real time)]" in told
    assert "Share of a number. [default: (0; 0.01 for a log of real time)]" in told
