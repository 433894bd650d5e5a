"""`podwatch bench bus`: what it costs to spy on a busy bus, beside lcm's own handler that does nothing."""

import io
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import lcm
from rich.console import Console
from rich.live import Live

from lcmtypes import channels
from tools.bench.table import Row, bench_console, measured, print_table, write_table
from tools.spy.command import DRAIN_S, REDRAW_S, render
from tools.spy.session import Session

__all__ = ["command"]

RATE_HZ = 5000
SECONDS = 10.0
MOST_OF_A_CORE = 0.03
DEADLINE_S = 60.0
SEQ_AT = 16  # behind fingerprint and utime
WIDTH, HEIGHT = 120, 40
SPOKEN = (
    channels.VEHICLE_STATE,
    channels.MISSION_STATE,
    channels.TRACK,
    channels.SETPOINT,
    channels.FLEET_STATE,
)


def command(out: Path, seconds: float = SECONDS) -> None:
    """Measure, print the table, and write it as bench_bus.json into `out`."""
    console = bench_console()
    with console.status("spy"):
        rows = measured(spy_rows(seconds), "spy")
    print_table("podwatch bench bus", rows, console)
    write_table(out / "bench_bus.json", rows)


def spy_rows(seconds: float) -> Iterator[Row]:
    """Share of a core of the spy with its screen, and of an lcm handler that does nothing."""
    rates = {}
    shares = {}
    for name, listen in (("podwatch spy", _spy), ("lcm's own python handler, doing nothing", _handle)):
        shares[name], rates[name] = _share(listen, seconds)
    spy, handler = shares.values()
    why = (
        f"CPU time of the whole process, every thread; screen of {WIDTH}x{HEIGHT} drawn each {REDRAW_S:g} s; "
        f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )
    for name, share in shares.items():
        is_spy = name == "podwatch spy"
        yield Row(
            f"{name}, {RATE_HZ} messages/s",
            round(rates[name] * seconds),
            "-",
            f"{share:.1%} of a core",
            f"< {MOST_OF_A_CORE:.0%} of a core" if is_spy else "",
            "",
            share < MOST_OF_A_CORE if is_spy else None,
            why if is_spy else "",
        )
    yield Row("podwatch spy / lcm's handler", 1, "-", f"{spy / handler:.2f}")


def _share(listen: Callable[[str, float], tuple[float, int]], seconds: float) -> tuple[float, float]:
    """(share of a core, messages a second that were heard)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        url = f"udpm://239.255.76.193:{probe.getsockname()[1]}?ttl=0&recv_buf_size=4194304"
    words = [sys.executable, "-c", f"from tools.bench.bus import say; say({url!r})"]
    talker = subprocess.Popen(words, stdin=subprocess.PIPE)
    try:
        cpu_s, n_heard = listen(url, seconds)
    finally:
        talker.communicate()  # its input closes, and it ends
    return cpu_s / seconds, n_heard / seconds


def say(url: str) -> None:
    """Say RATE_HZ messages a second until the input closes, on five channels in turn."""
    bus, said, began_s = lcm.LCM(url), 0, time.monotonic()
    samples = [channels.BY_NAME[name].kind().encode() for name in SPOKEN]
    while not select.select([sys.stdin], [], [], 0.002)[0]:
        due = int((time.monotonic() - began_s) * RATE_HZ)
        for number in range(said, due):
            seq, place = divmod(number, len(SPOKEN))
            sample = samples[place]
            bus.publish(SPOKEN[place], sample[:SEQ_AT] + seq.to_bytes(4, "big") + sample[SEQ_AT + 4 :])
        said = due


def _spy(url: str, seconds: float) -> tuple[float, int]:
    """(CPU seconds, messages) of the spy's own loop, drawing into memory as into a terminal."""
    console = Console(file=io.StringIO(), force_terminal=True, width=WIDTH, height=HEIGHT, highlight=False)
    with (
        Session(lambda _: url, 1, follows=False) as session,
        Live(console=console, screen=True, auto_refresh=False) as live,
    ):
        statistics = session.listener.statistics

        def heard() -> int:
            return sum(channel.n_messages for channel in statistics.channels.values())

        def turn(draw: bool) -> None:
            time.sleep(DRAIN_S)
            session.drain()
            if draw:
                live.update(render(session, "channels", SPOKEN[0], console), refresh=True)

        _wait(lambda: turn(draw=False), lambda: heard() > 0)
        n_before, began_s, cpu_s, draw_at_s = heard(), time.monotonic(), time.process_time(), 0.0
        while (now_s := time.monotonic()) < began_s + seconds:
            turn(draw=now_s >= draw_at_s)
            draw_at_s = now_s + REDRAW_S if now_s >= draw_at_s else draw_at_s
        return time.process_time() - cpu_s, heard() - n_before


def _handle(url: str, seconds: float) -> tuple[float, int]:
    """(CPU seconds, messages) of `handle` with a handler that only counts."""
    bus, count = lcm.LCM(url), [0]

    def hear(_channel: str, _data: bytes) -> None:
        count[0] += 1

    bus.subscribe(".*", hear).set_queue_capacity(10_000)
    _wait(lambda: bus.handle_timeout(100), lambda: count[0] > 1)
    n_before, began_s, cpu_s = count[0], time.monotonic(), time.process_time()
    while time.monotonic() < began_s + seconds:
        bus.handle_timeout(100)
    return time.process_time() - cpu_s, count[0] - n_before


def _wait(turn: Callable[[], object], is_done: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not is_done():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"nothing was heard within {DEADLINE_S:.0f} s; is there a multicast route?")
        turn()
