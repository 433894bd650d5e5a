"""A drone's computer that was started anew: which files are one log, and which logs flew together."""

import pytest
from typer.testing import CliRunner

from drivers.clocks.monotonic import BOOT_ID, MonotonicClock
from lcmtypes import channels, make, podwatch
from logs.boots import boots, numbered, other_boots, pictures, segments
from logs.copying import merge
from logs.exceptions import LogError
from logs.fleet import DroneLog, Fleet, find_logs, list_logs
from logs.missions import missions
from logs.writer import BOOT, LogWriter
from tools.cli import app

SECOND_US = 1_000_000


def write(path, boot, seconds, links=(), drone_id=1):
    """TRACK and LINK_STATE at each of `seconds` of the drone's clock. links: peer, offset, first, last."""
    writer = LogWriter(path, drone_id=drone_id, metadata={BOOT: boot} if boot else {})
    for second in seconds:
        utime = second * SECOND_US
        track = make(podwatch.track_t, utime=utime, seq=second, drone_id=drone_id)
        writer.write(channels.TRACK, track.encode(), utime)
        heard = [
            make(podwatch.link_t, peer_id=peer, up=True, offset_us=offset_s * SECOND_US, round_trip_us=900)
            for peer, offset_s, first, last in links
            if first <= second <= last
        ]
        state = make(podwatch.link_state_t, utime=utime, drone_id=drone_id, n_links=len(heard), links=heard)
        writer.write(channels.LINK_STATE, state.encode(), utime)
    writer.close()
    return path


def names(paths):
    return [path.name for path in paths]


def seconds_of(path):
    messages = DroneLog(path, lambda _: None).messages()
    return [raw.log_time_ns // 10**9 for raw in messages if raw.channel == channels.TRACK]


def ignore(_):
    pass


def test_a_real_drones_clock_says_of_which_boot_it_counts():
    assert MonotonicClock().boot == BOOT_ID.read_text().strip() != ""


def test_files_of_one_boot_are_one_log_and_another_boots_are_another(tmp_path):
    """The second boot begins at a later time of its own clock than the first ended at: only its id tells."""
    first = write(tmp_path / "drone_1.mcap", "a", range(10, 13))
    write(tmp_path / "drone_1.1.mcap", "a", range(13, 16))
    second = write(tmp_path / "drone_1.2.mcap", "b", range(20, 23))
    third = write(tmp_path / "drone_1.3.mcap", "b", range(23, 26))
    assert [names(files) for files in boots(first)] == [
        ["drone_1.mcap", "drone_1.1.mcap"],
        ["drone_1.2.mcap", "drone_1.3.mcap"],
    ]
    assert seconds_of(first) == [*range(10, 16)]
    assert seconds_of(second) == [*range(20, 26)]
    assert segments(third) == [third], "a file that only goes on stands for itself"
    assert [names(files) for files in other_boots(second)] == [["drone_1.mcap", "drone_1.1.mcap"]]
    assert len(numbered(first)) == 4


def test_a_clock_that_ran_backwards_tells_boots_apart_where_no_file_says_its_boot(tmp_path):
    first = write(tmp_path / "drone_1.mcap", "", range(10, 13))
    write(tmp_path / "drone_1.1.mcap", "", range(12, 16))  # goes on in the second in which the first ended
    second = write(tmp_path / "drone_1.2.mcap", "", range(11, 14))
    assert [names(files) for files in boots(first)] == [
        ["drone_1.mcap", "drone_1.1.mcap"],
        ["drone_1.2.mcap"],
    ]
    assert seconds_of(second) == [11, 12, 13]


def test_a_file_without_a_message_or_with_damage_stays_with_what_it_goes_on_from(tmp_path):
    first = write(tmp_path / "drone_1.mcap", "", range(10, 13))
    (tmp_path / "drone_1.1.mcap").write_bytes(b"")
    write(tmp_path / "drone_1.2.mcap", "", ())
    write(tmp_path / "drone_1.3.mcap", "a", range(13, 16))  # the first one of a version that says its boot
    write(tmp_path / "drone_1.4.mcap", "a", range(16, 18))
    assert len(segments(first)) == 5


def test_the_other_boots_beside_a_log_are_told(tmp_path):
    first = write(tmp_path / "drone_1.mcap", "a", range(10, 13))
    second = write(tmp_path / "drone_1.1.mcap", "b", range(20, 23))
    told = []
    DroneLog(first, told.append)
    [line] = told
    assert "drone_1.1.mcap beside it is of another boot of drone 1" in line
    DroneLog(second, pytest.fail)


def test_pictures_belong_to_their_own_boot(tmp_path):
    first = write(tmp_path / "drone_1.mcap", "a", range(10, 13))
    second = write(tmp_path / "drone_1.1.mcap", "b", range(20, 23))
    write(tmp_path / "drone_1.pictures.mcap", "a", (11,))
    write(tmp_path / "drone_1.pictures.1.mcap", "b", (21,))
    write(tmp_path / "drone_1.pictures.2.mcap", "", (22,))
    assert names(pictures(first)) == ["drone_1.pictures.mcap"]
    assert names(pictures(second)) == ["drone_1.pictures.1.mcap"]
    told = []
    missions([first, second], told.append)
    assert len(told) == 1
    assert "drone_1.pictures.2.mcap beside it may be of another boot" in told[0]


def two_boots(folder):
    """Drones 1 and 2, two boots each; drone 2 was away in the first, and counts from another time in each."""
    return [
        write(folder / "drone_1.mcap", "a", range(10, 40), [(3, 500, 10, 40)], 1),
        write(folder / "drone_1.1.mcap", "b", range(8, 40), [(2, -7, 10, 40)], 1),
        write(folder / "drone_2.mcap", "c", range(2, 30), [(1, 7, 2, 30)], 2),
        write(folder / "drone_3.mcap", "d", range(510, 540), [(1, -500, 510, 540)], 3),
    ]


def test_logs_of_several_boots_are_as_many_missions_of_those_that_were_in_contact(tmp_path):
    two_boots(tmp_path)
    found = missions(list_logs([tmp_path]), pytest.fail)
    assert [names(logs) for logs in found] == [
        ["drone_1.mcap", "drone_3.mcap"],
        ["drone_1.1.mcap", "drone_2.mcap"],
    ]


def test_what_wants_one_mission_refuses_two_and_names_them(tmp_path):
    two_boots(tmp_path)
    with pytest.raises(LogError, match=r"2 missions.*: \S+drone_1\.mcap \S+drone_3\.mcap; or: \S+drone_1\.1"):
        find_logs([tmp_path])
    out = tmp_path / "tracks.csv"
    result = CliRunner().invoke(app, ["log", "export", str(tmp_path), "--csv", str(out)])
    assert (result.exit_code, out.exists()) == (2, False)
    given = [tmp_path / "drone_1.1.mcap", tmp_path / "drone_2.mcap"]
    assert find_logs(given) == given
    with pytest.raises(LogError, match="2 missions"):
        find_logs([tmp_path / "drone_1.mcap", tmp_path / "drone_2.mcap"])


def test_all_files_of_one_boot_by_name_are_one_log(tmp_path):
    write(tmp_path / "drone_1.mcap", "a", range(10, 13))
    write(tmp_path / "drone_1.1.mcap", "a", range(13, 16))
    write(tmp_path / "drone_1.pictures.mcap", "a", (11,))
    assert find_logs(sorted(tmp_path.iterdir())) == [tmp_path / "drone_1.mcap"]


def test_a_drone_that_began_anew_while_another_went_on_is_told_and_bends_no_clock(tmp_path):
    long = write(tmp_path / "drone_1.mcap", "a", range(10, 70), [(2, 100, 10, 45), (2, -44, 46, 70)], 1)
    early = write(tmp_path / "drone_2.mcap", "b", range(110, 146), [(1, -100, 110, 145)], 2)
    late = write(tmp_path / "drone_2.1.mcap", "c", range(2, 26), [(1, 44, 2, 26)], 2)
    told = []
    assert missions([long, early, late], told.append) == [[long, early], [late]]
    assert len(told) == 1
    assert "were in contact, but are of two missions here" in told[0]
    assert Fleet([long, early], ignore).lines[2].at(120 * SECOND_US) == pytest.approx(20 * SECOND_US, abs=1)


def test_logs_of_several_boots_are_not_merged(tmp_path):
    paths = [write(tmp_path / f"{boot}.mcap", boot, range(3)) for boot in "ab"]
    with pytest.raises(LogError, match="several boots of a drone"):
        merge(paths, tmp_path / "out.mcap", ignore)
    assert not (tmp_path / "out.mcap").exists()
