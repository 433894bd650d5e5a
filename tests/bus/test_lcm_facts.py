"""What podwatch is built round: ten facts about lcm 1.5.3 and shared memory, each measured again.

Where a fact is a trap, the test shows the trap and the way out that the runtime takes.
"""

import ast
import json
import socket
import struct
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lcm
import numpy as np
import pytest

from drivers.frames import SharedFrames
from lcmtypes import channels, make, podwatch
from lcmtypes.podwatch import frame_t, heartbeat_t, world_state_t
from procs import processes
from tools.buses import has_multicast_route

ROOT = Path(__file__).parents[2]
DEADLINE_S = 20.0
QUIET_MS = 500  # nothing for so long: nothing more comes
DEFAULT_CAPACITY = 30
WIDE_BUFFER = "&recv_buf_size=4194304"
HEAVY = ("cv2", "onnxruntime", "torch", "matplotlib")
LIGHT = ("navigator", "relay", "autopilot", "logger", "assigner")


def bus_url(options: str = WIDE_BUFFER) -> str:
    """A bus on a port that nobody else uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return f"udpm://239.255.76.192:{probe.getsockname()[1]}?ttl=0{options}"


def run_python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a snippet in a process of its own."""
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)


def handle_all(bus: lcm.LCM) -> None:
    """Until nothing more comes."""
    while bus.handle_timeout(QUIET_MS) > 0:
        pass


def await_read(url: str) -> None:
    """Until LCM's own threads have taken all from their sockets on the port of `url`."""
    port = f":{int(url.split(':')[2].split('?')[0]):04X}"
    deadline = time.monotonic() + DEADLINE_S
    waiting = True
    while waiting:
        assert time.monotonic() < deadline
        rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
        waiting = any(int(row[4].partition(":")[2], 16) for row in rows if row[1].endswith(port))


def test_the_facts_are_of_the_version_that_is_installed():
    assert version("lcm") == "1.5.3"


@pytest.mark.parametrize(("capacity", "n_kept"), [(None, DEFAULT_CAPACITY), (200, 90)])
def test_fact_1_a_full_queue_drops_the_newest_and_a_deep_one_drops_none(capacity, n_kept):
    url = bus_url()
    heard: list[int] = []
    hearer, speaker = lcm.LCM(url), lcm.LCM(url)
    subscription = hearer.subscribe("NUMBER", lambda _channel, data: heard.append(data[0]))
    if capacity is not None:
        subscription.set_queue_capacity(capacity)
    for number in range(90):
        speaker.publish("NUMBER", bytes([number]))
    await_read(url)
    handle_all(hearer)
    assert heard[:n_kept] == list(range(n_kept))
    assert len(heard) <= n_kept + 1  # one may have been on its way between the socket and the queue


@pytest.mark.parametrize("size", [150_000, 300_000])
def test_fact_2_large_messages_need_the_wide_buffer(size):
    def n_heard(options: str) -> int:
        url = bus_url(options)
        heard: list[int] = []
        hearer, speaker = lcm.LCM(url), lcm.LCM(url)
        handle = hearer.subscribe("IMAGE", lambda _channel, data: heard.append(len(data)))
        handle.set_queue_capacity(100)
        for _ in range(8):
            speaker.publish("IMAGE", bytes(size))
        handle_all(hearer)
        assert set(heard) <= {size}
        return len(heard)

    granted = int(Path("/proc/sys/net/core/rmem_max").read_text())
    # A reader that is scheduled in time may keep up with one burst; it does not with all of them.
    assert any(n_heard("") < 8 for _ in range(50))
    if granted >= 4194304:  # the kernel gives no more than this; `podwatch doctor` says so
        assert n_heard(WIDE_BUFFER) == 8


INTERRUPTED = """
import signal, sys, lcm
bus = lcm.LCM(sys.argv[1])
bus.subscribe("NOTHING", lambda *_: None)
signal.signal(signal.SIGALRM, lambda *_: None)
signal.setitimer(signal.ITIMER_REAL, 0.1)
try:
    bus.handle()
except OSError:
    print("OSError")
"""
SELECTED = """
import os, select, signal, sys, lcm
bus = lcm.LCM(sys.argv[1])
heard = []
bus.subscribe("WORD", lambda _channel, data: heard.append(data))
read, write = os.pipe()
os.set_blocking(write, False)
signal.set_wakeup_fd(write)
n_signals = []
def signalled(*_):
    n_signals.append(1)
    bus.publish("WORD", b"%d" % len(n_signals))
signal.signal(signal.SIGALRM, signalled)
signal.setitimer(signal.ITIMER_REAL, 0.01, 0.01)
while len(heard) < 20:
    ready, _, _ = select.select([bus, read], [], [])
    if read in ready:
        os.read(read, 100)
    while bus.handle_timeout(0) > 0:
        pass
print(len(heard))
"""
FORKED = """
import os, sys, lcm
bus = lcm.LCM(sys.argv[1])
heard = []
bus.subscribe("WORD", lambda _channel, data: heard.append(data))
if os.fork() == 0:
    lcm.LCM(sys.argv[1]).publish("WORD", b"x")
    try:
        bus.handle_timeout(500)
    except OSError:
        pass
    os._exit(len(heard))
print(os.waitstatus_to_exitcode(os.wait()[1]))
"""


def test_fact_3_a_signal_breaks_handle_but_not_select_and_a_fork_breaks_lcm():
    assert run_python(INTERRUPTED, bus_url()).stdout == "OSError\n"
    assert int(run_python(SELECTED, bus_url()).stdout) >= 20
    assert run_python(FORKED, bus_url()).stdout == "0\n", "the child heard its own word after all"


TWO_THREADS = """
import sys, threading, lcm
bus = lcm.LCM(sys.argv[1])
bus.subscribe("NOTHING", lambda *_: None)
errors = []
def handle():
    try:
        bus.handle_timeout(1000)
    except RuntimeError as error:
        errors.append(error)
threads = [threading.Thread(target=handle) for _ in range(2)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(len(errors))
"""


def test_fact_4_two_threads_cannot_handle_and_publish_takes_bytes():
    assert run_python(TWO_THREADS, bus_url()).stdout == "1\n"
    with pytest.raises(TypeError, match="bytearray"):
        lcm.LCM(bus_url()).publish("WORD", bytearray(3))


def test_fact_4_nothing_unsubscribes_and_no_thread_of_what_flies_knows_a_bus():
    """That unsubscribing from another thread crashes cannot be shown at will: it is never done.

    The one place that starts a thread is the executor's `aside`, for work that has no bus.
    """
    for package in ("procs", "drivers", "logs", "tools"):
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text())
            assert "unsubscribe" not in named_in(tree), path
            threads = named_in(tree).intersection({"Thread", "ThreadPoolExecutor"})
            if path == ROOT / "procs/bus_executor.py":
                [aside] = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == "aside"]
                assert threads == {"Thread"}
                assert path.read_text().count("Thread(") == 1
                assert "_lcm" not in named_in(aside), "work that is done aside must not touch the bus"
            elif package == "procs":
                assert not threads, path


def named_in(tree: ast.AST) -> set[str]:
    return {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}


def test_fact_5_structs_of_the_same_members_decode_as_each_other(tmp_path, monkeypatch):
    for name, member in (("first_t", "n_m"), ("second_t", "n_m"), ("third_t", "e_m")):
        (tmp_path / f"{name}.lcm").write_text(f"package same;\nstruct {name} {{ double {member}; }}\n")
    generator = Path(sys.executable).parent / "lcm-gen"
    types = [str(path) for path in sorted(tmp_path.glob("*.lcm"))]
    subprocess.run([generator, "--python", "--ppath", str(tmp_path), *types], check=True, timeout=30)
    monkeypatch.syspath_prepend(str(tmp_path))
    same = __import__("same")
    said = same.first_t()
    said.n_m = 4.0
    assert same.second_t.decode(said.encode()).n_m == 4.0
    with pytest.raises(ValueError):
        same.third_t.decode(said.encode())


def test_fact_6_integers_are_signed_but_byte():
    with pytest.raises(struct.error):
        make(heartbeat_t, pid=2**31).encode()
    with pytest.raises(struct.error):
        make(heartbeat_t, drone_id=128).encode()
    picture = make(podwatch.preview_t, n_bytes=2, data=bytes([0, 255]))
    assert bytes(podwatch.preview_t.decode(picture.encode()).data) == bytes([0, 255])


def test_fact_6_there_is_no_drop_counter_and_names_end_at_63_bytes():
    assert not [name for name in dir(lcm.LCM) if "drop" in name or "lost" in name]
    bus = lcm.LCM(bus_url())
    bus.publish("N" * 63, b"")
    with pytest.raises(OSError):
        bus.publish("N" * 64, b"")


NO_ROUTE = """
import ctypes, os, sys
CLONE_NEWUSER, CLONE_NEWNET = 0x10000000, 0x40000000
if ctypes.CDLL(None).unshare(CLONE_NEWUSER | CLONE_NEWNET) != 0:
    os.environ["PODWATCH_TEST_URL"] = "udpm://no.such.group:1"
import lcm
from tools.buses import has_multicast_route
route = "PODWATCH_TEST_URL" not in os.environ and has_multicast_route()
try:
    lcm.LCM(os.environ.get("PODWATCH_TEST_URL", sys.argv[1]))
except RuntimeError as error:
    print(route, error)
"""


def test_fact_7_no_multicast_route_is_no_bus_and_we_can_tell():
    """In a network of its own without any route; where that is not allowed, with a group that cannot be."""
    assert run_python(NO_ROUTE, bus_url()).stdout == "False Couldn't create LCM\n"
    assert has_multicast_route()


def test_fact_8_pixels_in_shared_memory_cost_less_than_pixels_on_the_bus(record_property):
    n_frames, n_readers = 20, 2
    image = np.random.default_rng(1).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    frames = SharedFrames("facts", 1)
    readers = [SharedFrames("facts", 1) for _ in range(n_readers)]
    handles = []

    def by_handle(bus: lcm.LCM, number: int) -> None:
        ring, token, slot = frames.write(image, number)
        members = {"ring": ring, "token": token, "slot": slot, "width": 640, "height": 480}
        bus.publish(channels.FRAME, make(frame_t, seq=number, **members).encode())

    def cost_s(publish: Any, take: Any) -> float:
        """Processor time a frame: LCM's own threads count."""
        url = bus_url()
        speaker, hearers = lcm.LCM(url), [lcm.LCM(url) for _ in range(n_readers)]
        sums: list[int] = []
        for index, hearer in enumerate(hearers):
            hearer.subscribe(
                channels.FRAME, lambda _channel, data, index=index: sums.append(take(index, data))
            )
        began = 0.0
        for number in range(2 * n_frames):
            if number == n_frames:  # by now every page of the ring has been touched
                began = time.process_time()
            publish(speaker, number)
            for hearer in hearers:
                assert hearer.handle_timeout(int(DEADLINE_S * 1000)) > 0
        assert sums == [int(image[0, 0, 0])] * (2 * n_frames * n_readers)
        return (time.process_time() - began) / n_frames

    def read(index: int, data: bytes) -> int:
        handles.append(frame_t.decode(data))
        pixels = readers[index].read(handles[-1])
        assert pixels is not None
        return int(pixels[0, 0, 0])

    try:
        shared_s = cost_s(by_handle, read)
        assert readers[0].read(handles[0]) is None, "overwritten by then: its number says so"
        pixels_s = cost_s(
            lambda bus, _number: bus.publish(channels.FRAME, image.tobytes()),
            lambda _index, data: int(np.frombuffer(data, np.uint8)[0]),
        )
    finally:
        frames.close()
    record_property("shared_ms", shared_s * 1000)
    record_property("bus_ms", pixels_s * 1000)
    assert shared_s < pixels_s


def test_fact_9_two_memq_do_not_hear_each_other_and_their_queues_have_no_capacity():
    one, other = lcm.LCM("memq://"), lcm.LCM("memq://")
    heard: list[bytes] = []
    one.subscribe("WORD", lambda _channel, data: heard.append(data)).set_queue_capacity(5)
    other.publish("WORD", b"other")
    assert one.handle_timeout(100) == 0
    for number in range(40):
        one.publish("WORD", bytes([number]))
    while one.handle_timeout(0) > 0:
        pass
    assert heard == [bytes([number]) for number in range(40)]


@pytest.mark.parametrize("process", LIGHT)
def test_fact_10_a_light_process_imports_nothing_heavy_that_it_does_not_use(process):
    code = (
        "import json, sys, procs.main, importlib; importlib.import_module(sys.argv[1]); "
        "print(json.dumps([*sys.modules]))"
    )
    loaded = json.loads(run_python(code, processes.BY_NAME[process].module).stdout)
    assert [name for name in HEAVY if name in loaded] == []
    if process != "assigner":  # its exact solution is scipy's
        assert "scipy" not in loaded
    if process in ("relay", "logger"):
        assert "numpy" not in loaded


def test_the_worlds_state_fits_one_message_without_the_wide_buffer():
    """20 drones and 20 animals: far below the size at which copies are lost."""
    drones = [podwatch.world_drone_t() for _ in range(20)]
    animals = [make(podwatch.world_animal_t, species="sperm") for _ in range(20)]
    state = make(world_state_t, n_drones=20, drones=drones, n_animals=20, animals=animals)
    assert len(state.encode()) < 10_000
