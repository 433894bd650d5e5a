"""Messages a second that the log writer takes, beside lcm's own event log: `python -m tools.bench.logs`."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import lcm

from lcmtypes import channels, make
from lcmtypes.podwatch import track_t
from logs.writer import LogWriter

N_MESSAGES = 50_000
MESSAGE_BYTES = 300
RATE_HZ = 100  # of log time: sets how many messages a chunk holds
REPEATS = 3


def sample(seq: int) -> bytes:
    """An encoded TRACK of about MESSAGE_BYTES, each one different."""
    empty = make(track_t, utime=seq * 10_000, seq=seq, drone_id=1)
    corners = max(MESSAGE_BYTES - len(empty.encode()), 0) // 4
    outline = [[(seq * 7 + corner * 13) % 640, (seq * 3 + corner * 11) % 480] for corner in range(corners)]
    empty.n_outline, empty.outline = corners, outline
    return empty.encode()


def write_mcap(folder: Path, messages: list[bytes]) -> int:
    """Size of the MCAP file, bytes."""
    path = folder / "bench.mcap"
    writer = LogWriter(path, drone_id=1)
    for index, data in enumerate(messages):
        writer.write(channels.TRACK, data, index * 1_000_000 // RATE_HZ)
    writer.close()
    return path.stat().st_size


def write_event_log(folder: Path, messages: list[bytes]) -> int:
    """Size of the LCM event log, bytes."""
    path = folder / "bench.lcmlog"
    log = lcm.EventLog(str(path), "w", overwrite=True)
    for index, data in enumerate(messages):
        log.write_event(index * 1_000_000 // RATE_HZ, channels.TRACK, data)
    log.close()
    return path.stat().st_size


def best_rate(write: Callable[[Path, list[bytes]], int], messages: list[bytes]) -> tuple[float, int]:
    """(messages a second of the best of REPEATS runs, bytes of the file)."""
    best_s, size = float("inf"), 0
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            size = write(Path(folder), messages)
            best_s = min(best_s, time.perf_counter() - began)
    return len(messages) / best_s, size


def main() -> None:
    messages = [sample(seq) for seq in range(N_MESSAGES)]
    print(f"{N_MESSAGES} messages of {len(messages[0])} bytes, {RATE_HZ} Hz, best of {REPEATS}")
    for name, write in (("logs.writer (MCAP, zstd)", write_mcap), ("lcm.EventLog", write_event_log)):
        rate, size = best_rate(write, messages)
        print(f"{name:26} {rate:10.0f} messages/s  {size / len(messages):6.1f} bytes a message on disk")


if __name__ == "__main__":
    main()
