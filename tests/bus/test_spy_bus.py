"""`podwatch spy` on real buses: what lcm says is what it hears, in the terminal and as text."""

import io
import os
import pty
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count

import lcm
import pytest
from rich.console import Console
from typer.testing import CliRunner

from lcmtypes import channels, make
from lcmtypes.podwatch import fleet_row_t, fleet_state_t, link_state_t, link_t, preview_t, track_t
from tests.talker import saying_again
from tools.bench.bus import spy_rows
from tools.cli import app
from tools.spy.command import render
from tools.spy.listener import Listener
from tools.spy.session import Session

GROUP = "239.255.76.196"
DEADLINE_S = 20.0


@pytest.fixture
def url() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return f"udpm://{GROUP}:{probe.getsockname()[1]}?ttl=0&recv_buf_size=4194304"


def track(seq: int) -> bytes:
    return make(track_t, utime=seq, seq=seq, drone_id=1, animal=4).encode()


@contextmanager
def saying(url: str) -> Iterator[None]:
    """A drone that says its tracks and what it knows of the ring, fifty times a second."""
    bus, seqs = lcm.LCM(url), count(1)
    rows = [make(fleet_row_t, id=member, alive=True, age_ms=100 * member) for member in (1, 2)]
    fleet = make(fleet_state_t, drone_id=1, members=3, n_rows=2, rows=rows, left_id=2, right_id=2)
    most = {"max_payload": [0], "max_encoded": [0], "max_datagram": [0]}
    link = make(
        link_t, peer_id=2, up=True, n_kinds=1, kinds=["link"], bytes_out=[600], cap_bytes_s=2400, **most
    )
    state = make(link_state_t, drone_id=1, n_links=1, links=[link])

    def say() -> None:
        bus.publish(channels.TRACK, track(next(seqs)))
        bus.publish(channels.FLEET_STATE, fleet.encode())
        bus.publish(channels.LINK_STATE, state.encode())
        bus.publish("OF_NO_TABLE", b"what is this")

    with saying_again(say, 0.02):
        yield


def spied(*arguments: object) -> str:
    result = CliRunner().invoke(app, ["spy", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_it_hears_all_that_lcm_says_with_its_gaps_and_its_newest(url):
    bus = lcm.LCM(url)
    image = bytes(range(256)) * 1200
    with Listener(url) as listener:
        for seq in range(1000):
            if seq not in (10, 500, 501):
                bus.publish(channels.TRACK, track(seq))
        preview = make(preview_t, seq=3, drone_id=1, format="jpeg", n_bytes=len(image), data=image).encode()
        bus.publish(channels.PREVIEW, preview)
        bus.publish("X", b"")
        listener.drain()
        heard = listener.statistics.channels
        assert heard[channels.TRACK].n_messages == 997
        assert heard[channels.TRACK].n_lost == 3
        assert listener.newest(channels.TRACK).seq == 999
        assert heard[channels.PREVIEW].data == preview, "a message of several datagrams"
        assert heard["X"].data == b""
        assert listener.n_dropped == 0
        assert set(heard) == {channels.TRACK, channels.PREVIEW, "X"}, "not lcm's own test of itself"
        assert abs(heard[channels.TRACK].last_us - time.time() * 1e6) < 60e6


def test_another_group_of_the_same_port_is_not_heard(url):
    other = lcm.LCM(url.replace(GROUP, "239.255.76.197"))
    with Listener(url) as listener, Listener(url.replace(GROUP, "239.255.76.197")) as neighbour:
        other.publish(channels.TRACK, track(1))
        listener.drain()
        neighbour.drain()
        assert listener.statistics.channels == {}
        assert neighbour.statistics.channels[channels.TRACK].n_messages == 1


def test_what_it_was_too_slow_for_is_told_apart_from_gaps_of_the_bus(url):
    bus, said = lcm.LCM(url), 30_000
    with Listener(url) as listener:
        for seq in range(said):
            bus.publish(channels.TRACK, track(seq))
        listener.drain()
        bus.publish(channels.TRACK, track(said))
        listener.drain()
        assert listener.n_dropped > 0
        assert listener.statistics.channels[channels.TRACK].n_messages + listener.n_dropped == said + 1


def test_text_for_scripts_has_a_line_a_channel_with_its_figures(url):
    with saying(url):
        lines = spied("--url", url, "--text", "--seconds", "1").splitlines()
        rows = {line.split()[0]: line.split() for line in lines[1:]}
        assert lines[0].split()[:4] == ["channel", "hz", "nominal_hz", "jitter_ms"]
        assert list(rows) == [channels.TRACK, channels.FLEET_STATE, channels.LINK_STATE, "OF_NO_TABLE"]
        assert 5 < float(rows[channels.TRACK][1]) < 60
        assert rows[channels.TRACK][2] == "20"
        assert rows[channels.TRACK][5] == "0"
        assert "animal=4" in rows[channels.TRACK]
        assert rows["OF_NO_TABLE"][5] == "-"
        detailed = spied("--url", url, "--text", "--seconds", "0.5", "-c", "TRA*")
        assert "  animal = 4\n" in detailed
        assert channels.LINK_STATE not in detailed


def test_the_ring_as_text(url):
    with saying(url):
        text = spied("--url", url, "--text", "--seconds", "0.5", "--page", "ring")
    assert ["1", "→", "2", "up", "0.0", "0%", "0.0", "600", "2400", "25%", "0", "0", "link", "600"] in [
        line.split() for line in text.splitlines()
    ]


def drawn(session: Session, page: str, selected: str = "", scrolled: int = 0) -> list[str]:
    """The lines of a screen of 80 columns and 24 lines."""
    console = Console(file=io.StringIO(), width=80, height=24, highlight=False)
    console.print(render(session, page, selected, console, scrolled))
    return console.file.getvalue().splitlines()


def test_a_small_screen_shows_what_it_can_and_says_what_it_leaves_out(url):
    bus = lcm.LCM(url)
    with Session(lambda _: url, 1, follows=False) as session:
        for channel in channels.CHANNELS:
            bus.publish(channel.name, channel.kind().encode())
        for drone_id in range(1, 9):
            links = [make(link_t, peer_id=peer) for peer in range(1, 9)]
            bus.publish(
                channels.LINK_STATE, make(link_state_t, drone_id=drone_id, n_links=8, links=links).encode()
            )
            session.drain()
            session.look_round()
        screen = drawn(session, "channels", channels.TRACK)
        assert len(screen) == 24
        assert any(line.startswith(f"›{channels.TRACK} ") for line in screen)
        assert any("more channels" in line for line in screen)
        assert any("more members: --text -c shows them" in line for line in screen)
        assert " state " in " ".join(screen)
        ring = drawn(session, "ring")
        assert len(ring) == 24
        assert "8 → 8" not in "".join(ring)
        assert "lines 1 to 22 of " in ring[-2]
        assert "8 → 8" in "".join(drawn(session, "ring", scrolled=1000))


@pytest.mark.parametrize(
    ("arguments", "code", "why"),
    [
        (("--text", "--seconds", "0.1"), 1, "nothing was heard on udpm"),
        (("-c", "trak"), 2, "no channel is called 'trak'; did you mean TRACK?"),
        (
            ("--text", "--seconds", "0.1", "-c", "TRAK*", "-c", "TRACK", "-c", "RX_2_RING_MAP"),
            1,
            "nothing was heard",
        ),
        (("--page", "birds"), 2, "there are: channels, ring"),
        (("--url", "memq://"), 2, "udpm://GROUP:PORT"),
    ],
)
def test_what_cannot_be_spied_is_told(url, arguments, code, why):
    result = CliRunner().invoke(app, ["spy", "--url", url, *arguments])
    assert result.exit_code == code
    assert why in " ".join(result.stderr.split()).replace("│ ", "")


def test_what_spying_costs_is_measured_beside_a_handler_of_lcm_that_does_nothing():
    """A benchmark in small; what it costs is for `podwatch bench bus` to say."""
    spy, handler, ratio = spy_rows(1.0)
    assert min(spy.n, handler.n) > 0
    assert float(ratio.figure or "nan") > 0


def test_the_screen_is_drawn_and_its_keys_work(url):
    """A terminal of its own: the channels, the newest message of a chosen one, the ring, the end."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-c", "from tools.cli import main; main()", "spy", "--url", url]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120", "LINES": "40"}
    with saying(url):
        spy = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment)
        os.close(theirs)
        for wanted, key in (("TRACK", b"j"), ("track_t, ", b"r"), ("members as each drone", b"q")):
            _read_until(ours, wanted)
            os.write(ours, key)
        while _read(ours):
            pass
        assert spy.wait(DEADLINE_S) == 0
    os.close(ours)


def _read_until(terminal: int, wanted: str) -> None:
    seen, ends_s = "", time.monotonic() + DEADLINE_S
    while wanted not in seen:
        assert time.monotonic() < ends_s, f"{wanted!r} was not drawn; what was: {seen[-2000:]!r}"
        seen += _read(terminal)


def _read(terminal: int) -> str:
    """What the terminal shows next; "" once its program has ended."""
    ready, _, _ = select.select([terminal], [], [], 1.0)
    try:
        return os.read(terminal, 65536).decode(errors="replace") if ready else " "
    except OSError:
        return ""
