"""Several drones' logs on one clock: the lines between clocks, and what has no common time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcmtypes import channels, make, podwatch
from logs.exceptions import LogError
from logs.fleet import DroneLog, Fleet, Line, find_logs, fit_line, measure_clocks
from logs.writer import LogWriter, picture_path

clocks = st.floats(-1e9, 1e12)
rates = st.floats(1 - 2e-4, 1 + 2e-4)


def ignore(_):
    pass


@settings(deadline=None, max_examples=100)
@given(clocks, clocks, rates, clocks)
def test_a_line_and_its_inverse_cancel(x_us, y_us, rate, utime):
    line = Line(x_us, y_us, rate)
    assert line.inverse().at(line.at(utime)) == pytest.approx(utime, abs=1.0)
    assert line.then(line.inverse()).at(utime) == pytest.approx(utime, abs=1.0)


@settings(deadline=None, max_examples=50)
@given(st.integers(-2_000_000, 2_000_000), st.floats(-60, 60), st.integers(0, 2**32 - 1))
def test_a_line_finds_offset_and_drift_among_late_datagrams(offset_us, drift_ppm, seed):
    random = np.random.default_rng(seed)
    utimes = np.arange(300) * 1_000_000 + 100_000_000
    true = offset_us + drift_ppm * 1e-6 * utimes
    noise = random.normal(0, 50, 300)
    noise[random.random(300) < 0.1] += 20_000  # one in ten took a long way
    line = fit_line(list(zip(utimes.tolist(), (true + noise).round().astype(int).tolist(), strict=True)))
    errors = [line.at(utime) - utime - offset for utime, offset in zip(utimes, true, strict=True)]
    assert np.abs(errors).max() < 60


def test_over_a_short_span_the_offset_is_the_median_and_no_drift_is_guessed():
    line = fit_line([(0, 10), (1_000_000, 10_000), (2_000_000, 12)])
    assert (line.rate, line.at(5_000_000)) == (1.0, 5_000_012)


def write_log(folder, drone_id, offset_us, links=(), fleet=None, n=3):
    """`n` TRACKs at common times 0, 1, 2 s; the drone's clock shows the common time plus `offset_us`.

    links: (peer, offset of its clock). fleet: (lowest living drone, fleet offset).
    """
    path = folder / f"drone_{drone_id}.mcap"
    writer = LogWriter(path, drone_id=drone_id)
    for k in range(n):
        utime = k * 1_000_000 + offset_us
        track = make(podwatch.track_t, utime=utime, seq=k, drone_id=drone_id)
        writer.write(channels.TRACK, track.encode(), utime)
        entries = [
            make(podwatch.link_t, peer_id=peer, up=True, offset_us=off, round_trip_us=900)
            for peer, off in links
        ]
        state = make(podwatch.link_state_t, utime=utime, n_links=len(entries), links=entries)
        writer.write(channels.LINK_STATE, state.encode(), utime + 1)
        if fleet is not None:
            rows = [make(podwatch.fleet_row_t, id=one, alive=True) for one in (drone_id, fleet[0])]
            told = make(
                podwatch.fleet_state_t, utime=utime, drone_id=drone_id, fleet_offset_us=fleet[1],
                fleet_time_ok=True, n_rows=2, rows=rows, order=podwatch.operator_t(),
            )  # fmt: skip
            writer.write(channels.FLEET_STATE, told.encode(), utime + 2)
    writer.close()
    return path


def tracks(paths):
    return [
        (entry.at_us, entry.drone_id)
        for entry in Fleet(paths, ignore).messages()
        if entry.raw.channel == channels.TRACK
    ]


def test_a_fleet_plays_on_the_clock_of_its_lowest_drone(tmp_path):
    second = write_log(tmp_path, 5, 2_300_000)
    first = write_log(tmp_path, 2, 7_000, links=[(5, 2_293_000)])
    assert tracks([second, first]) == [
        (7_000, 2), (7_000, 5), (1_007_000, 2), (1_007_000, 5), (2_007_000, 2), (2_007_000, 5),
    ]  # fmt: skip


def test_clocks_are_joined_over_a_third_drone(tmp_path):
    """1 and 3 never measured each other; both measured 2, one of them from the other side."""
    paths = [
        write_log(tmp_path, 1, 0, links=[(2, 500_000)]),
        write_log(tmp_path, 2, 500_000),
        write_log(tmp_path, 3, 800_000, links=[(2, -300_000)]),
    ]
    assert [at for at, _ in tracks(paths)] == [0, 0, 0, 1_000_000, 1_000_000, 1_000_000] + [2_000_000] * 3


def test_fleet_time_serves_where_no_link_was_measured(tmp_path):
    log = write_log(tmp_path, 4, 900_000, fleet=(1, -900_000))
    assert measure_clocks(DroneLog(log, ignore))[1].at(1_900_000) == 1_000_000
    assert tracks([write_log(tmp_path, 1, 0), log])[1] == (0, 4)


def test_drones_that_never_measured_each_other_are_refused(tmp_path):
    first, second = write_log(tmp_path, 1, 0), write_log(tmp_path, 2, 0)
    with pytest.raises(LogError, match="drone 2 and drone 1 never measured each other's clocks"):
        Fleet([first, second], ignore)


def test_two_logs_of_one_drone_are_refused(tmp_path):
    first = write_log(tmp_path, 1, 0)
    other = write_log(tmp_path / "other", 1, 0) if (tmp_path / "other").mkdir() is None else first
    with pytest.raises(LogError, match="are both of drone 1; give one, or join them"):
        Fleet([first, other], ignore)


def test_what_a_drones_logger_left_beside_its_log_belongs_to_it(tmp_path):
    """Files that go on behind it, and pictures, by time; the run's other files are none of its logs."""
    path = write_log(tmp_path, 1, 0, n=1)
    for other, utime in ((tmp_path / "drone_1.1.mcap", 5_000_000), (picture_path(path), 3_000_000)):
        writer = LogWriter(other, drone_id=1)
        writer.write(channels.PREVIEW, make(podwatch.preview_t, utime=utime).encode(), utime)
        writer.close()
    (tmp_path / "truth.mcap").write_bytes(path.read_bytes())
    assert find_logs([tmp_path]) == [path]
    assert [raw.log_time_ns // 1000 for raw in DroneLog(path, ignore).messages()] == [
        0,
        1,
        3_000_000,
        5_000_000,
    ]


def test_a_folder_without_logs_is_told(tmp_path):
    with pytest.raises(LogError, match=r"no drone_<id>\.mcap in this folder"):
        find_logs([tmp_path])


def test_a_log_whose_first_file_was_dropped_is_found(tmp_path):
    write_log(tmp_path, 1, 0).rename(tmp_path / "drone_1.3.mcap")
    write_log(tmp_path, 1, 0).rename(tmp_path / "drone_1.pictures.mcap")
    assert find_logs([tmp_path]) == [tmp_path / "drone_1.mcap"]
    log = DroneLog(tmp_path / "drone_1.mcap", ignore)
    assert [path.name for path in log.paths] == ["drone_1.3.mcap", "drone_1.pictures.mcap"]
