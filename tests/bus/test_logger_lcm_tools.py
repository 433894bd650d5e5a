"""Our logs and LCM's own tools: lcm-logplayer plays what to-lcm writes, from-lcm takes what lcm-logger
wrote.
"""

import signal
import socket
import subprocess
import time
from pathlib import Path

import lcm
import pytest

from lcmtypes import channels, make, podwatch
from logs.event_log import from_lcm, to_lcm
from logs.scan import Scan
from logs.writer import LogWriter

DEADLINE_S = 30.0
N_MESSAGES = 200
PERIOD_US = 5_000
LATE_S = 0.5  # what a busy machine may delay one message
PING = "PING"


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def url():
    return f"udpm://239.255.76.191:{free_port()}?ttl=0&recv_buf_size=4194304"


@pytest.fixture
def log(tmp_path):
    writer = LogWriter(tmp_path / "drone_1.mcap", drone_id=1)
    for seq in range(N_MESSAGES):
        utime = 7_000_000 + seq * PERIOD_US
        track = make(podwatch.track_t, utime=utime, seq=seq, drone_id=1)
        writer.write((channels.TRACK, channels.received(2, channels.TRACK))[seq % 2], track.encode(), utime)
    writer.close()
    return tmp_path / "drone_1.mcap"


def messages(path):
    return [(m.channel, m.log_time_ns // 1000, m.data) for m in Scan(path, lambda _: None).messages()]


def tool(name, *arguments):
    return subprocess.Popen(
        [str(Path(lcm.LCM_BIN_DIR) / name), *map(str, arguments)], stdout=subprocess.DEVNULL
    )


def test_lcm_logplayer_plays_our_log_and_lcm_logger_writes_one_for_us(tmp_path, url, log):
    to_lcm(log, tmp_path / "ours.lcmlog", lambda _: None)
    bus = lcm.LCM(url)
    heard = []
    bus.subscribe(".*", lambda channel, data: heard.append((channel, data))).set_queue_capacity(2000)
    recorded = tmp_path / "theirs.lcmlog"
    logger = tool("lcm-logger", "-q", "--flush-interval=20", f"--lcm-url={url}", recorded)
    try:
        wait(lambda: bus.publish(PING, b""), bus, lambda: recorded.exists() and recorded.stat().st_size > 0)
        player = tool("lcm-logplayer", f"--lcm-url={url}", tmp_path / "ours.lcmlog")
        wait(lambda: None, bus, lambda: player.poll() is not None)
        # lcm-logger flushes when it hears, so that it hears until its file holds the end.
        wait(lambda: bus.publish(PING, b"end"), bus, lambda: b"end" in recorded.read_bytes())
    finally:
        logger.send_signal(signal.SIGINT)
        logger.wait(timeout=DEADLINE_S)
    ours = messages(log)
    assert [one for one in heard if one[0].endswith(channels.TRACK)] == [
        (channel, data) for channel, _, data in ours
    ]

    from_lcm(recorded, tmp_path / "back.mcap")
    events = lcm.EventLog(str(recorded))
    theirs = [(event.channel, event.timestamp, event.data) for event in events]
    events.close()
    back = messages(tmp_path / "back.mcap")
    assert back == theirs
    played = [one for one in back if one[0].endswith(channels.TRACK)]
    assert [(channel, data) for channel, _, data in played] == [(channel, data) for channel, _, data in ours]
    for (_, at_us, _), (_, said_us, _) in zip(played, ours, strict=True):
        assert abs((at_us - played[0][1]) - (said_us - ours[0][1])) < LATE_S * 1e6


def wait(act, bus, is_done):
    """Hear the bus, and `act` between, until it is done."""
    deadline = time.monotonic() + DEADLINE_S
    while not is_done():
        assert time.monotonic() < deadline, f"not done within {DEADLINE_S} s"
        act()
        bus.handle_timeout(10)
    while bus.handle_timeout(0) > 0:
        pass
