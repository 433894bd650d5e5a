"""The frame ring: pixels come back whole or not at all."""

import secrets
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.frames import SHARED_FOLDER, MemoryFrames, SharedFrames
from lcmtypes import make
from lcmtypes.podwatch import frame_t

ROOT = Path(__file__).parents[2]
READ_IN_ANOTHER_PROCESS = """
import sys
from drivers.frames import SharedFrames
from lcmtypes.podwatch import frame_t
frames = SharedFrames(sys.argv[1], 7)
for line in sys.stdin:
    image = frames.read(frame_t.decode(bytes.fromhex(line)))
    print("gone" if image is None else f"{image.shape} {image.sum()}", flush=True)
"""


@pytest.fixture
def run() -> Iterator[str]:
    """A run's name that nobody else has; nothing of it is left behind."""
    name = f"test{secrets.token_hex(4)}"
    yield name
    for left in SHARED_FOLDER.glob(f"podwatch_{name}*"):
        left.unlink()


def picture(number: int, height: int = 6, width: int = 8) -> NDArray[np.uint8]:
    return np.random.default_rng(number).integers(0, 256, (height, width, 3), dtype=np.uint8)


def put(frames: SharedFrames | MemoryFrames, image: NDArray[np.uint8], number: int) -> frame_t:
    """Write one image and give its handle, as the camera says it."""
    ring, token, slot = frames.write(image, number)
    height, width = image.shape[:2]
    return make(frame_t, seq=number, ring=ring, token=token, slot=slot, width=width, height=height)


@pytest.mark.parametrize("kind", ["shared", "memory"])
def test_each_of_the_newest_frames_is_read_until_its_slot_is_written_again(kind, run):
    writer = SharedFrames(run, 7, slots=4) if kind == "shared" else MemoryFrames(slots=4)
    reader = SharedFrames(run, 7, slots=4) if isinstance(writer, SharedFrames) else writer
    handles = [put(writer, picture(number), number) for number in range(6)]
    for number, handle in enumerate(handles):
        image = reader.read(handle)
        if number < 2:
            assert image is None
        else:
            np.testing.assert_array_equal(image, picture(number))
    assert reader.n_gone == 2


@settings(max_examples=25, deadline=None)
@given(
    shapes=st.lists(st.tuples(st.integers(1, 40), st.integers(1, 40)), min_size=1, max_size=4),
    slots=st.integers(1, 5),
)
def test_any_size_comes_back_as_it_was_and_a_new_size_ends_the_old_ring(shapes, slots):
    writer, reader = SharedFrames("hypothesis", 7, slots), SharedFrames("hypothesis", 7, slots)
    older: list[tuple[tuple[int, int], frame_t]] = []
    try:
        for number, shape in enumerate(shapes):
            handle = put(writer, picture(number, *shape), number)
            np.testing.assert_array_equal(reader.read(handle), picture(number, *shape))
            for old_shape, old in older:
                if old_shape[0] * old_shape[1] != shape[0] * shape[1]:
                    assert SharedFrames("hypothesis", 7, slots).read(old) is None
            older.append((shape, handle))
        assert len(list(SHARED_FOLDER.glob("podwatch_hypothesis_7_*"))) == 1
    finally:
        writer.close()
    assert not list(SHARED_FOLDER.glob("podwatch_hypothesis_7_*"))


def test_another_process_reads_what_was_written_and_sees_what_is_gone(run):
    writer = SharedFrames(run, 7, slots=2)
    handles = [put(writer, picture(number, 48, 64), number) for number in range(3)]
    lines = "".join(handle.encode().hex() + "\n" for handle in handles)
    command = [sys.executable, "-c", READ_IN_ANOTHER_PROCESS, run]
    reader = subprocess.run(
        command, input=lines, capture_output=True, text=True, cwd=ROOT, timeout=60, check=True
    )
    expected = [f"(48, 64, 3) {picture(number, 48, 64).sum()}" for number in (1, 2)]
    assert reader.stdout.splitlines() == ["gone", *expected]


def test_a_wrong_token_is_gone_and_counted(run):
    writer, reader = SharedFrames(run, 7), SharedFrames(run, 7)
    handle = put(writer, picture(1), 1)
    handle.token += 1
    assert reader.read(handle) is None
    assert reader.n_gone == 1
    handle.token -= 1
    assert reader.read(handle) is not None


@pytest.mark.parametrize(
    "wrong",
    [
        {"slot": -1},
        {"slot": 16},
        {"slot": 2**31 - 1},
        {"width": 0},
        {"width": -8},
        {"width": 9},
        {"height": 0},
        {"height": 2**31 - 1, "width": 2**31 - 1},
        {"seq": 2},
        {"ring": ""},
        {"ring": "podwatch_nowhere"},
    ],
    ids=str,
)
def test_a_handle_that_does_not_fit_the_ring_is_gone(wrong, run):
    writer, reader = SharedFrames(run, 7), SharedFrames(run, 7)
    handle = put(writer, picture(1), 1)
    for member, value in wrong.items():
        setattr(handle, member, value)
    assert reader.read(handle) is None


def test_a_camera_that_starts_anew_removes_its_dead_predecessors_ring_and_readers_follow(run):
    dead = SharedFrames(run, 7)
    old = put(dead, picture(1), 1)
    reader = SharedFrames(run, 7)
    assert reader.read(old) is not None
    successor = SharedFrames(run, 7)  # the dead one never closed
    new = put(successor, picture(2), 1)
    assert [path.name for path in SHARED_FOLDER.glob(f"podwatch_{run}_7_*")] == [new.ring]
    np.testing.assert_array_equal(reader.read(new), picture(2))
    assert reader.read(old) is None
    assert new.token != old.token


def test_a_reader_never_maps_the_ring_of_another_run_or_drone(run):
    for other_run, drone_id in ((f"{run}x", 7), (run, 77), (run, 1)):
        other = SharedFrames(other_run, drone_id)
        handle = put(other, picture(1), 1)
        reader = SharedFrames(run, 7)
        assert reader.read(handle) is None
        assert SharedFrames(other_run, drone_id).read(handle) is not None
        other.close()


def test_a_ring_name_never_leads_out_of_the_folder(run, tmp_path):
    writer = SharedFrames(run, 7)
    handle = put(writer, picture(1), 1)
    copy = tmp_path / "ring"
    copy.write_bytes((SHARED_FOLDER / handle.ring).read_bytes())
    (SHARED_FOLDER / f"podwatch_{run}_7_d").mkdir()
    try:
        handle.ring = f"podwatch_{run}_7_d/../../..{copy}"
        assert (SHARED_FOLDER / handle.ring).exists()
        assert SharedFrames(run, 7).read(handle) is None
    finally:
        (SHARED_FOLDER / f"podwatch_{run}_7_d").rmdir()


def test_a_ring_that_is_made_but_not_yet_sized_is_gone_not_an_error(run):
    handle = put(SharedFrames(run, 7), picture(1), 1)
    handle.ring = f"podwatch_{run}_7_empty"
    (SHARED_FOLDER / handle.ring).touch()
    assert SharedFrames(run, 7).read(handle) is None


def test_a_frame_that_is_overwritten_while_it_is_copied_is_gone(run, monkeypatch):
    """The number is looked at before and after the copy: here the writer comes in between."""
    writer, reader = SharedFrames(run, 7, slots=2), SharedFrames(run, 7, slots=2)
    handle = put(writer, picture(1), 1)
    assert reader.read(handle) is not None
    real = np.frombuffer

    def overwritten(*arguments: object, **options: object) -> NDArray[np.uint8]:
        monkeypatch.setattr(np, "frombuffer", real)
        writer.write(picture(3), 3)  # the same slot
        return real(*arguments, **options)

    monkeypatch.setattr(np, "frombuffer", overwritten)
    assert reader.read(handle) is None


def test_closing_a_reader_leaves_the_ring_to_its_writer(run):
    writer, reader = SharedFrames(run, 7), SharedFrames(run, 7)
    handle = put(writer, picture(1), 1)
    reader.read(handle)
    reader.close()
    assert SharedFrames(run, 7).read(handle) is not None
    writer.close()
    assert SharedFrames(run, 7).read(handle) is None
