"""Playing: what is said when, through pauses and steps, and which channels under which names."""

import os

import cv2
import numpy as np
import pytest

from drivers.cameras.capture import CameraError
from drivers.cameras.replay import RAW_FORMAT, ReplayCamera, decode_picture
from drivers.frames import MemoryFrames
from lcmtypes import channels, make, podwatch
from logs.exceptions import LogError
from logs.fleet import FleetMessage
from logs.scan import RawMessage
from logs.writer import LogWriter
from tools.playback.keys import Keys
from tools.playback.player import Player
from tools.playback.playhead import Playhead
from tools.playback.selection import Selection, parse_renames


class Time:
    """A clock that moves only while somebody waits for a key, and the keys, each at its time."""

    def __init__(self, keys=()):
        self.now_s = 50.0
        self._keys = [(50.0 + at_s, key) for at_s, key in keys]

    def __call__(self):
        return self.now_s

    def wait(self, seconds):
        if self._keys and self._keys[0][0] <= self.now_s + seconds:
            self.now_s = max(self.now_s, self._keys[0][0])
            return self._keys.pop(0)[1]
        self.now_s += seconds
        return ""


class Bus:
    def __init__(self, time):
        self._time = time
        self.said = []

    def publish(self, channel, data):
        self.said.append((round(self._time.now_s - 50.0, 6), channel, data))

    @property
    def times(self):
        return [at_s for at_s, _, _ in self.said]


def messages(times_s, channel=channels.TRACK, drone_id=1):
    return [
        FleetMessage(
            round(7e6 + at_s * 1e6), drone_id, RawMessage(channel, "", round(at_s * 1e9), str(at_s).encode())
        )
        for at_s in times_s
    ]


def play(entries, *, keys=(), selection=None, **options):
    time = Time(keys)
    bus = Bus(time)
    player = Player({1: bus, 2: bus}, selection or Selection(), clock=time, **options)
    return player, bus, player.play(entries, time)


@pytest.mark.parametrize(("speed", "times"), [(1.0, [0, 0.5, 2.0]), (4.0, [0, 0.125, 0.5])])
def test_each_message_is_said_at_its_time(speed, times):
    player, bus, ended = play(messages([0, 0.5, 2.0]), speed=speed)
    assert ended
    assert bus.times == times
    assert (player.played.n_messages, player.played.late_ms(0.99)) == (3, 0.0)


def test_a_pause_moves_what_follows_by_its_length():
    _, bus, _ = play(messages([0, 1, 2]), keys=[(0.4, " "), (5.4, " ")])
    assert bus.times == [0, 6.0, 7.0]


def test_a_step_says_one_message_and_pauses():
    _, bus, _ = play(messages([0, 1, 2, 3]), keys=[(0.3, "s"), (4.0, "s"), (9.0, " ")])
    assert bus.times == [0, 0.3, 4.0, 10.0]


def test_q_ends_it():
    _, bus, ended = play(messages([0, 1, 2]), keys=[(1.5, "q")])
    assert (ended, bus.times) == (False, [0, 1])


def test_lateness_is_what_the_messages_waited_too_long():
    class Slow(Bus):
        def publish(self, channel, data):
            super().publish(channel, data)
            self._time.now_s += 0.010

    time = Time()
    player = Player({1: Slow(time)}, Selection(), clock=time)
    player.play(messages([0, 0.004, 0.008, 5.0]), time)
    assert [round(1e3 * late_s) for late_s in player.played.late_s] == [0, 6, 12, 0]
    assert player.played.late_ms(0.5) == pytest.approx(6)


def test_again_begins_at_the_logs_beginning():
    time = Time()
    bus = Bus(time)
    player = Player({1: bus}, Selection(start_s=1.0), clock=time)
    for _ in range(2):
        player.play(messages([0, 1, 2]), time)
        player.again()
    assert bus.times == [0, 1, 1, 2]


def test_span_filter_and_new_names():
    entries = sorted(
        messages([0, 1, 2, 3]) + messages([1.5], channels.PREVIEW) + messages([2.5], "RX_2_RING_MAP")
    )
    selection = Selection(
        start_s=1.0, end_s=2.6, without=(channels.PREVIEW,), renames=parse_renames(["TRACK=OLD"])
    )
    _, bus, _ = play(entries, selection=selection)
    assert [(channel, data) for _, channel, data in bus.said] == [
        ("OLD", b"1"), ("OLD", b"2"), ("RX_2_RING_MAP", b"2.5"),
    ]  # fmt: skip
    _, bus, _ = play(entries, selection=Selection(only=("RX_*",)))
    assert [channel for _, channel, _ in bus.said] == ["RX_2_RING_MAP"]


@pytest.mark.parametrize("channel", [channels.FRAME, channels.IMAGE])
def test_handles_and_whole_images_are_never_said(channel):
    _, bus, _ = play([*messages([0, 1], channel), *messages([2])])
    assert [said for _, said, _ in bus.said] == [channels.TRACK]


@pytest.mark.parametrize("pair", ["TRACK", "=NEW", "TRACK=", "TRACK=" + "X" * 64])
def test_what_is_no_rename_is_refused(pair):
    with pytest.raises(LogError, match="write OLD=NEW"):
        parse_renames([pair])


@pytest.mark.parametrize(("start_s", "end_s"), [(-1.0, None), (2.0, 1.0)])
def test_an_impossible_span_is_refused(start_s, end_s):
    with pytest.raises(LogError, match=r"--start|--end"):
        Selection(start_s=start_s, end_s=end_s)


def test_a_span_that_begins_where_the_logs_have_ended_is_told_with_their_end():
    with pytest.raises(LogError, match=r"--start 9: .* end 2\.5 s after"):
        play(messages([0.0, 2.5]), selection=Selection(start_s=9.0))
    assert play([], selection=Selection(start_s=9.0))[1].said == []
    assert play(messages([0.0, 2.5]), selection=Selection(start_s=1.0, end_s=2.0))[1].said == []


def test_a_speed_of_nothing_is_refused():
    with pytest.raises(ValueError, match="must be above 0"):
        Playhead(0.0)


def test_keys_come_from_a_terminal_and_leave_it_as_it_was():
    master, slave = os.openpty()
    before = os.ttyname(slave)
    with Keys(slave) as keys:
        assert keys.wait(0.0) == ""
        os.write(master, b" ")
        assert keys.wait(5.0) == " "
    assert os.ttyname(slave) == before
    os.close(master)
    os.close(slave)


def test_a_terminal_that_is_closed_ends_what_reads_its_keys():
    master, slave = os.openpty()
    with Keys(slave) as keys:
        os.close(master)
        with pytest.raises(KeyboardInterrupt):
            keys.wait(5.0)
    os.close(slave)


# Pictures.


def picture(utime, shade, *, is_whole=False):
    image = np.full((48, 64, 3) if is_whole else (24, 32, 3), shade, np.uint8)
    data = image.tobytes() if is_whole else cv2.imencode(".jpg", image)[1].tobytes()
    return make(
        podwatch.preview_t, utime=utime, width=image.shape[1], height=image.shape[0], scale=1.0,
        format=RAW_FORMAT if is_whole else "jpeg", n_bytes=len(data), data=data,
    )  # fmt: skip


def picture_log(path, channel, times_s, *, is_whole=False):
    writer = LogWriter(path, drone_id=1)
    for k, at_s in enumerate(times_s):
        utime = round(9e6 + at_s * 1e6)
        writer.write(channel, picture(utime, 40 * k + 20, is_whole=is_whole).encode(), utime)
    writer.close()
    return str(path)


def shade(image):
    return None if image is None else round(float(image.mean()) / 20) * 20


def test_the_replay_camera_shows_each_preview_at_its_time(tmp_path):
    log = picture_log(tmp_path / "a.mcap", channels.PREVIEW, [0, 0.5, 1.0])
    camera = ReplayCamera(log, (64, 48), rate_hz=4)
    images = [camera.capture() for _ in range(6)]
    assert [shade(image) for image in images] == [20, None, 60, None, 100, None]
    assert images[0].shape == (48, 64, 3)


def test_whole_frames_are_preferred_and_exact(tmp_path):
    path = tmp_path / "a.mcap"
    writer = LogWriter(path, drone_id=1)
    writer.write(channels.PREVIEW, picture(0, 200).encode(), 0)
    writer.write(channels.IMAGE, picture(0, 33, is_whole=True).encode(), 0)
    writer.close()
    image = ReplayCamera(str(path), (64, 48)).capture()
    assert (image == 33).all()


def test_a_camera_slower_than_the_log_gives_the_newest_and_begins_anew_on_request(tmp_path):
    log = picture_log(tmp_path / "a.mcap", channels.IMAGE, [0, 0.1, 0.2, 0.3], is_whole=True)
    camera = ReplayCamera(log, (64, 48), rate_hz=5, loop=True)
    assert [shade(camera.capture()) for _ in range(5)] == [20, 100, 140, 20, 100]


def test_a_log_without_pictures_and_no_log_are_told(tmp_path):
    LogWriter(tmp_path / "a.mcap", drone_id=1).close()
    with pytest.raises(CameraError, match="holds no picture; give a log with previews"):
        ReplayCamera(str(tmp_path / "a.mcap"), (64, 48))
    with pytest.raises(CameraError, match="No such file"):
        ReplayCamera(str(tmp_path / "b.mcap"), (64, 48))
    (tmp_path / "c.mcap").write_bytes(b"no log at all")
    with pytest.raises(CameraError, match="mend it with podwatch log recover"):
        ReplayCamera(str(tmp_path / "c.mcap"), (64, 48))


@pytest.mark.parametrize("data", [b"", b"no picture"])
@pytest.mark.parametrize("format", [RAW_FORMAT, "jpeg"])
def test_bytes_that_are_no_picture_give_none(data, format):
    bad = make(podwatch.preview_t, width=4, height=4, format=format, n_bytes=len(data), data=data)
    assert decode_picture(bad) is None


def test_pictures_become_frames_of_a_fresh_ring():
    ring = MemoryFrames()
    entries = [
        FleetMessage(0, 1, RawMessage(channels.PREVIEW, "", 0, picture(5, 80).encode())),
        FleetMessage(1, 1, RawMessage(channels.PREVIEW, "", 0, b"another version's")),
        FleetMessage(2, 2, RawMessage(channels.PREVIEW, "", 0, picture(5, 80).encode())),
    ]
    player, bus, _ = play(
        entries, rings={1: ring}, image_size=(64, 48), selection=Selection(without=(channels.PREVIEW,))
    )
    [(_, channel, data)] = bus.said
    frame = podwatch.frame_t.decode(data)
    assert (channel, frame.utime, frame.drone_id, frame.width) == (channels.FRAME, 5, 1, 64)
    assert shade(ring.read(frame)) == 80
    assert player.played.n_frames == 1


def test_where_whole_frames_were_logged_previews_become_no_frames():
    entries = [
        FleetMessage(0, 1, RawMessage(channels.IMAGE, "", 0, picture(5, 80, is_whole=True).encode())),
        FleetMessage(1, 1, RawMessage(channels.PREVIEW, "", 0, picture(5, 80).encode())),
    ]
    _, bus, _ = play(entries, rings={1: MemoryFrames()})
    assert [channel for _, channel, _ in bus.said] == [channels.FRAME, channels.PREVIEW]
