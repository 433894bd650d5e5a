"""The fleet key's file."""

import stat
from pathlib import Path

import pytest

from procs.relay.keys import FleetKeyError, make_key, read_key


def test_a_made_key_is_private_random_and_readable(tmp_path: Path) -> None:
    first, second = tmp_path / "a.key", tmp_path / "b.key"
    make_key(first)
    make_key(second)
    assert stat.S_IMODE(first.stat().st_mode) == 0o600
    assert len(read_key(first)) == 32
    assert read_key(first) != read_key(second)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.key", "b.key"]


def test_a_key_is_not_overwritten_unless_forced(tmp_path: Path) -> None:
    path = tmp_path / "fleet.key"
    make_key(path)
    key = read_key(path)
    with pytest.raises(FleetKeyError, match=r"exists.*force"):
        make_key(path)
    assert read_key(path) == key
    make_key(path, force=True)
    assert read_key(path) != key


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o660, 0o644])
def test_a_key_that_others_can_reach_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "fleet.key"
    make_key(path)
    key = read_key(path)
    path.chmod(mode)
    with pytest.raises(FleetKeyError, match=rf"{mode:04o}.*chmod 600") as caught:
        read_key(path)
    assert key.hex() not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"ab" * 31, "31 bytes, not 32"),
        (b"ab" * 33, "33 bytes, not 32"),
        (b"", "0 bytes, not 32"),
        (b"secret phrase, not hexadecimal", "not hexadecimal"),
        (b"\xff\xfe" * 32, "not hexadecimal"),
    ],
)
def test_a_damaged_key_is_refused_without_being_shown(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "fleet.key"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(FleetKeyError, match=message) as caught:
        read_key(path)
    assert "secret" not in str(caught.value)
    assert caught.value.__cause__ is None


def test_a_missing_key_is_named(tmp_path: Path) -> None:
    with pytest.raises(FleetKeyError, match=r"nowhere\.key.*make one"):
        read_key(tmp_path / "nowhere.key")
    with pytest.raises(FleetKeyError, match="cannot be written"):
        make_key(tmp_path / "no folder" / "fleet.key")
