"""`podwatch play` on a real bus: what is heard is what was logged, in its order."""

import socket

import lcm
import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.cameras.replay import RAW_FORMAT
from drivers.frames import SHARED_FOLDER
from lcmtypes import channels, make, podwatch
from logs.writer import LogWriter
from tools.cli import app

N_MESSAGES = 60
PERIOD_US = 10_000


@pytest.fixture
def url():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return f"udpm://239.255.76.192:{probe.getsockname()[1]}?ttl=0&recv_buf_size=4194304"


def write(path, drone_id, offset_us=0, links=()):
    writer = LogWriter(path, drone_id=drone_id)
    entries = [make(podwatch.link_t, peer_id=peer, up=True, offset_us=us) for peer, us in links]
    state = make(podwatch.link_state_t, utime=offset_us, n_links=len(entries), links=entries)
    writer.write(channels.LINK_STATE, state.encode(), offset_us)
    pixels = bytes(64 * 48 * 3)
    for seq in range(N_MESSAGES):
        utime = seq * PERIOD_US + offset_us + drone_id * 1000
        track = make(podwatch.track_t, utime=utime, seq=seq, drone_id=drone_id)
        writer.write(channels.TRACK, track.encode(), utime)
        frame = make(podwatch.frame_t, utime=utime, seq=seq, drone_id=drone_id, ring="gone")
        writer.write(channels.FRAME, frame.encode(), utime)
        if seq % 20 == 0:
            image = make(
                podwatch.preview_t, utime=utime, frame_seq=seq, width=64, height=48, scale=1.0,
                format=RAW_FORMAT, n_bytes=len(pixels), data=pixels,
            )  # fmt: skip
            writer.write(channels.IMAGE, image.encode(), utime)
    writer.close()
    return path


def hear(url, *arguments):
    """(channel, message) of what a run of the command says at `url`."""
    bus = lcm.LCM(url)
    heard = []
    bus.subscribe(
        "(OLD_)?(TRACK|FRAME|LINK_STATE|IMAGE)", lambda channel, data: heard.append((channel, data))
    ).set_queue_capacity(5000)
    result = CliRunner().invoke(app, ["play", "--bus", url, *map(str, arguments)])
    assert result.exit_code == 0, result.output
    while bus.handle_timeout(100) > 0:
        pass
    return heard, result.stdout


def test_two_drones_are_one_fleet_on_the_bus(tmp_path, url):
    logs = [
        write(tmp_path / "drone_1.mcap", 1),
        write(tmp_path / "drone_2.mcap", 2, 3_000_000, links=[(1, -3_000_000)]),
    ]
    heard, told = hear(url, *logs, "--speed", "20", "--rename", f"{channels.TRACK}=OLD_{channels.TRACK}")
    tracks = [podwatch.track_t.decode(data) for channel, data in heard if channel == "OLD_TRACK"]
    assert [(track.seq, track.drone_id) for track in tracks] == [
        (seq, drone_id) for seq in range(N_MESSAGES) for drone_id in (1, 2)
    ]
    assert {channel for channel, _ in heard} == {"OLD_TRACK", "LINK_STATE"}
    assert f"{2 * N_MESSAGES + 2} messages and 0 frames played" in told


def test_logged_images_are_frames_again_and_the_old_handles_stay_away(tmp_path, url):
    before = sorted(SHARED_FOLDER.iterdir())
    log = write(tmp_path / "drone_1.mcap", 1)
    heard, _ = hear(url, log, "--speed", "50", "--frames", "-c", channels.FRAME)
    frames = [podwatch.frame_t.decode(data) for _, data in heard]
    assert [(frame.seq, frame.utime) for frame in frames] == [
        (k, 20 * k * PERIOD_US + 1000) for k in range(3)
    ]
    assert all(frame.ring.startswith("podwatch_play") for frame in frames)
    assert np.unique([frame.token for frame in frames]).size == 1
    assert sorted(SHARED_FOLDER.iterdir()) == before


def test_logs_that_cannot_be_played_are_told(tmp_path):
    logs = [write(tmp_path / "drone_1.mcap", 1), write(tmp_path / "drone_2.mcap", 2)]
    result = CliRunner().invoke(app, ["play", *map(str, logs)])
    assert result.exit_code == 2
    assert "never measured each other's clocks" in result.stderr
    assert CliRunner().invoke(app, ["play", str(tmp_path / "none.mcap")]).exit_code == 2
    assert CliRunner().invoke(app, ["play", str(logs[0]), "--speed", "0"]).exit_code == 2
    result = CliRunner().invoke(app, ["play", str(logs[0]), "-c", "NOPE"])
    assert (result.exit_code, channels.TRACK in result.stderr) == (2, True), result.stderr
