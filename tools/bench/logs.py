"""`podwatch bench logs`: what the logger keeps of a flood, beside lcm-logger in the same run; how fast the
writer is; and how late playing says each message.
"""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import lcm
import numpy as np

from lcmtypes import channels, make
from lcmtypes.podwatch import link_state_t, link_t, log_state_t, preview_t, track_t
from logs.fleet import Fleet
from logs.scan import Scan
from logs.writer import LogWriter
from procs.settings import DroneSettings, Mission
from tools.bench.table import Row, bench_console, measured, print_table, write_table
from tools.playback.player import Player
from tools.playback.selection import Selection

__all__ = ["command", "flood_sample"]

MESSAGE_BYTES = 300
FLOOD_HZ = 20_000
FLOOD_S = 10.0
IMAGE_HZ = 20
IMAGE_BYTES = 150_000  # a 640x480 JPEG of good quality
N_WRITTEN = 50_000
WRITTEN_HZ = 100  # of log time: sets how many messages a chunk holds
REPEATS = 3
PLAYED_DRONES, PLAYED_HZ, PLAYED_S = 3, 300, 10.0
LATEST_MS = 5.0
DEADLINE_S = 30.0
PING = "PING"


def command(out: Path, seconds: float = FLOOD_S, *, real_time: bool = False) -> None:
    """Measure all, print the table, and write it as bench_logs.json into `out`.

    real_time: what is measured goes before all else that the machine does, as if it had nothing else to do.
    Raises PermissionError where this user may not ask for that.
    """
    console = bench_console()
    if real_time:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    groups: list[tuple[str, Callable[[], Iterator[Row]]]] = [
        ("logger", lambda: logger_rows(seconds)),
        ("writer", writer_rows),
        ("playing", lambda: playing_rows(min(seconds, PLAYED_S))),
    ]
    rows: list[Row] = []
    for name, measure in groups:
        with console.status(name):
            rows += measured(measure(), name)
    print_table("podwatch bench logs", rows, console)
    write_table(out / "bench_logs.json", rows)


# The logger process on a real bus.


def logger_rows(seconds: float) -> Iterator[Row]:
    """What the logger and lcm-logger each miss of the same flood, without and with images."""
    for with_images in (False, True):
        name = f"{FLOOD_HZ} messages/s of {MESSAGE_BYTES} bytes"
        if with_images:
            name += f" and {IMAGE_HZ} images/s of {IMAGE_BYTES // 1000} kB"
        with tempfile.TemporaryDirectory() as folder:
            said, ours, theirs, rate = flood(Path(folder), seconds, with_images=with_images)
        why = f"said at {rate:.0f} messages/s; {_machine()}"
        for who, heard, floor in (("podwatch logger", ours, "0 lost"), ("lcm-logger", theirs, "")):
            lost = sum(said.values()) - sum(heard.values())
            figure = f"{lost} lost ({lost / sum(said.values()):.3%})"
            passed = lost == 0 if floor else None
            yield Row(f"{who}, {name}", sum(said.values()), "-", figure, floor, "", passed, why)
            why = ""


def flood(
    folder: Path, seconds: float, *, with_images: bool
) -> tuple[Counter[str], Counter[str], Counter[str], float]:
    """(said, kept by our logger, kept by lcm-logger) by channel, and the rate at which it was said, 1/s."""
    url = f"udpm://239.255.76.193:{_free_port()}?ttl=0&recv_buf_size=4194304"
    log, event_log = folder / "drone_1.mcap", folder / "flood.lcmlog"
    bus = lcm.LCM(url)
    states: list[log_state_t] = []
    bus.subscribe(channels.LOG_STATE, lambda _, data: states.append(log_state_t.decode(data)))
    loggers = _start_loggers(folder, url, log, event_log)
    try:
        _wait(bus, lambda: bool(states) and event_log.exists() and event_log.stat().st_size > 0)
        said, rate = _say(bus, seconds, with_images=with_images)
        n_before = len(states)
        _wait(bus, lambda: len(states) > n_before + 1)
    finally:
        for logger in loggers:
            logger.send_signal(signal.SIGINT)
            logger.wait(timeout=DEADLINE_S)
    ours = Counter(raw.channel for raw in Scan(log, lambda _: None).messages())
    events = lcm.EventLog(str(event_log))
    theirs = Counter(event.channel for event in events)
    events.close()
    keep = (channels.TRACK, channels.IMAGE)
    return said, _only(ours, keep), _only(theirs, keep), rate


def _only(counts: Counter[str], names: tuple[str, ...]) -> Counter[str]:
    return Counter({name: counts[name] for name in names})


def _start_loggers(folder: Path, url: str, log: Path, event_log: Path) -> list[subprocess.Popen[bytes]]:
    settings = DroneSettings(drone_id=1, mission=Mission(), bus_url=url, log_path=str(log))
    path = folder / "drone_1.json"
    path.write_text(settings.model_dump_json())
    theirs = str(Path(lcm.LCM_BIN_DIR) / "lcm-logger")
    return [
        subprocess.Popen([sys.executable, "-m", "procs.main", "logger", str(path)]),
        subprocess.Popen([theirs, "-q", f"--lcm-url={url}", str(event_log)], stderr=subprocess.DEVNULL),
    ]


def _say(bus: lcm.LCM, seconds: float, *, with_images: bool) -> tuple[Counter[str], float]:
    """Say the flood, evenly: every millisecond what is due by then."""
    head, tail = _around_seq(flood_sample(0))
    image = make(
        preview_t, format="jpeg", n_bytes=IMAGE_BYTES, data=np.random.default_rng(1).bytes(IMAGE_BYTES)
    ).encode()
    said: Counter[str] = Counter()
    n_all = round(seconds * FLOOD_HZ)
    began = time.monotonic()
    while said[channels.TRACK] < n_all:
        elapsed_s = time.monotonic() - began
        for seq in range(said[channels.TRACK], min(round(elapsed_s * FLOOD_HZ), n_all)):
            bus.publish(channels.TRACK, head + seq.to_bytes(4, "big") + tail)
            said[channels.TRACK] += 1
        if with_images and said[channels.IMAGE] < elapsed_s * IMAGE_HZ:
            bus.publish(channels.IMAGE, image)
            said[channels.IMAGE] += 1
        bus.handle_timeout(1)
    return said, n_all / (time.monotonic() - began)


def flood_sample(seq: int) -> bytes:
    """An encoded TRACK of about MESSAGE_BYTES, each one different."""
    empty = make(track_t, utime=seq * 10_000, seq=seq, drone_id=1)
    corners = max(MESSAGE_BYTES - len(empty.encode()), 0) // 4
    outline = [[(seq * 7 + corner * 13) % 640, (seq * 3 + corner * 11) % 480] for corner in range(corners)]
    empty.n_outline, empty.outline = corners, outline
    return empty.encode()


def _around_seq(data: bytes) -> tuple[bytes, bytes]:
    """What stands before and behind `seq`, an int32 behind fingerprint and utime."""
    return data[:16], data[20:]


def _wait(bus: lcm.LCM, is_done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not is_done():
        if time.monotonic() > deadline:
            raise TimeoutError(
                f"the loggers were not ready within {DEADLINE_S:.0f} s; is the machine too busy?"
            )
        bus.publish(PING, b"")
        bus.handle_timeout(20)


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def _machine() -> str:
    rmem_max = Path("/proc/sys/net/core/rmem_max").read_text().strip()
    first = "real-time, " if os.sched_getscheduler(0) == os.SCHED_RR else ""
    return (
        f"{first}load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores, net.core.rmem_max {rmem_max} bytes"
    )


# The writer alone.


def writer_rows() -> Iterator[Row]:
    """Messages a second into a file, beside lcm's own event log."""
    messages = [flood_sample(seq) for seq in range(N_WRITTEN)]
    for name, write in (("logs.writer (MCAP, zstd)", _write_mcap), ("lcm.EventLog", _write_event_log)):
        rate, size = _best_rate(write, messages)
        figure = f"{rate:.0f}/s, {size / len(messages):.0f} bytes a message on disk"
        floor = f">= {FLOOD_HZ}/s" if write is _write_mcap else ""
        passed = rate >= FLOOD_HZ if floor else None
        yield Row(f"{name}, best of {REPEATS}", N_WRITTEN, "-", figure, floor, "", passed)


def _write_mcap(folder: Path, messages: list[bytes]) -> int:
    path = folder / "bench.mcap"
    writer = LogWriter(path, drone_id=1)
    for index, data in enumerate(messages):
        writer.write(channels.TRACK, data, index * 1_000_000 // WRITTEN_HZ)
    writer.close()
    return path.stat().st_size


def _write_event_log(folder: Path, messages: list[bytes]) -> int:
    path = folder / "bench.lcmlog"
    log = lcm.EventLog(str(path), "w", overwrite=True)
    for index, data in enumerate(messages):
        log.write_event(index * 1_000_000 // WRITTEN_HZ, channels.TRACK, data)
    log.close()
    return path.stat().st_size


def _best_rate(write: Callable[[Path, list[bytes]], int], messages: list[bytes]) -> tuple[float, int]:
    """(messages a second of the best of REPEATS runs, bytes of the file)."""
    best_s, size = float("inf"), 0
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            size = write(Path(folder), messages)
            best_s = min(best_s, time.perf_counter() - began)
    return len(messages) / best_s, size


# Playing.


def playing_rows(seconds: float) -> Iterator[Row]:
    """How late each message of a fleet is said on real buses at speed 1."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [_played_log(Path(folder), drone_id, seconds) for drone_id in range(1, PLAYED_DRONES + 1)]
        fleet = Fleet(paths, lambda _: None)
        buses = {
            drone_id: lcm.LCM(f"udpm://239.255.76.193:{_free_port()}?ttl=0") for drone_id in fleet.drone_ids
        }
        player = Player(buses, Selection())
        player.play(fleet.messages(), _NoKeys())
    late = player.played
    figure = f"{late.late_ms(0.5):.2f} ms median, {late.late_ms(0.99):.2f} ms p99"
    yield Row(
        f"playing {PLAYED_DRONES} drones of {PLAYED_HZ} messages/s at speed 1",
        late.n_messages,
        "1",
        figure,
        f"p99 <= {LATEST_MS:g} ms",
        "",
        late.late_ms(0.99) <= LATEST_MS,
        _machine(),
    )


class _NoKeys:
    """Nobody presses a key."""

    def wait(self, seconds: float) -> str:
        time.sleep(seconds)
        return ""


def _played_log(folder: Path, drone_id: int, seconds: float) -> Path:
    """A log of a drone at uneven times, its clock ahead of the first drone's by its number in seconds."""
    random = np.random.default_rng([1, drone_id])
    n_messages = round(seconds * PLAYED_HZ)
    times = np.sort(random.integers(0, round(seconds * 1e6), n_messages)) + drone_id * 1_000_000
    writer = LogWriter(folder / f"drone_{drone_id}.mcap", drone_id=drone_id)
    link = make(link_t, peer_id=1, up=True, offset_us=(1 - drone_id) * 1_000_000)
    links = [link] if drone_id > 1 else []
    first = make(link_state_t, utime=int(times[0]), n_links=len(links), links=links)
    writer.write(channels.LINK_STATE, first.encode(), int(times[0]))
    for seq, utime in enumerate(times.tolist()):
        writer.write(channels.TRACK, flood_sample(seq), utime)
    writer.close()
    return writer.path
