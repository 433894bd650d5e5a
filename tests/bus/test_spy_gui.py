"""lcm-spy with our message types: its window shows every one of them decoded, or we say what is missing.

Where this machine has a JDK and Xvfb, the real window is opened on a real bus. Elsewhere the same command is
held to naming what is missing.
"""

import os
import shutil
import socket
import subprocess
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lcm
import pytest
from typer.testing import CliRunner

from lcmtypes import jar, podwatch
from lcmtypes.jar import JAVA_FOLDER, JarError, build_jar
from tests.talker import saying_again
from tools.cli import app
from tools.doctor.mend import as_root
from tools.spy import gui

TYPES = sorted(path.stem for path in jar.FOLDER.glob("*.lcm"))
LIMIT_S = 120
NUMBERS = {"float": 1.5, "double": 1.5, "boolean": True, "string": "whale"}


def example(type_name: str) -> Any:
    """A message of which every member has a value, and every list two."""
    kind = getattr(podwatch, type_name)
    message = kind()
    counts = {name for sizes in kind.__dimensions__ for name in sizes or () if isinstance(name, str)}
    for name, member, sizes in zip(kind.__slots__, kind.__typenames__, kind.__dimensions__, strict=True):
        value = _list_of(member, list(sizes)) if sizes else _value(member)
        setattr(message, name, 2 if name in counts else value)
    return message


def _value(member: str) -> Any:
    return example(member.rpartition(".")[2]) if "." in member else NUMBERS.get(member, 3)


def _list_of(member: str, sizes: list[Any]) -> Any:
    n_values = sizes[0] if isinstance(sizes[0], int) else 2
    if member == "byte":
        return bytes(n_values)
    return [_list_of(member, sizes[1:]) if sizes[1:] else _value(member) for _ in range(n_values)]


@contextmanager
def screen() -> Iterator[str]:
    """The DISPLAY of a screen of our own in memory."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1280x1024x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        with os.fdopen(read) as said:
            yield f":{said.readline().strip()}"
    finally:
        server.terminate()
        server.wait()


@contextmanager
def saying_every_type(url: str) -> Iterator[None]:
    bus = lcm.LCM(url)
    messages = {name.upper(): example(name).encode() for name in TYPES}
    with saying_again(lambda: [bus.publish(*message) for message in messages.items()], 0.1):
        yield


def class_path(*files: Path) -> str:
    return os.pathsep.join(str(path) for path in (*sorted(JAVA_FOLDER.glob("*.jar")), *files))


@pytest.fixture(scope="module")
def types(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Our jar, where it can be built."""
    path = tmp_path_factory.mktemp("jar") / "types.jar"
    return build_jar(jar=path) if shutil.which("javac") else path


@pytest.mark.timeout(2 * LIMIT_S)
def test_the_window_shows_every_type_decoded_or_we_say_what_is_missing(types, tmp_path, monkeypatch):
    if not all(map(shutil.which, ("java", "javac", "Xvfb"))):
        monkeypatch.delenv("DISPLAY", raising=False)
        result = CliRunner().invoke(app, ["spy", "--gui"])
        assert result.exit_code == 3
        assert "lcm-spy cannot start" in result.stderr
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        url = f"udpm://239.255.76.198:{probe.getsockname()[1]}?ttl=0"
    with screen() as display, saying_every_type(url):
        done = subprocess.run(
            ["java", "-Djava.net.preferIPv4Stack=true", "-Xmx128m", "-cp", class_path(types),
             str(Path(__file__).with_name("SpyWindow.java")), url, str(len(TYPES)), str(tmp_path)],
            env={**os.environ, "DISPLAY": display}, capture_output=True, text=True, timeout=LIMIT_S,
            check=False,
        )  # fmt: skip
    shown = [line.split("\t") for line in done.stdout.splitlines() if line.count("\t") == 2]
    told = done.stdout[-2000:] + done.stderr[-2000:]
    assert [row[:2] for row in shown] == [[name.upper(), name] for name in TYPES], told
    # On a starved machine a first message may come before its class is loaded.
    assert sum(int(n_undecoded) for _, _, n_undecoded in shown) <= 1, told
    assert f"{len(TYPES) + 1} windows show text" in done.stdout, "a viewer of each, and the table"
    painted = sorted(path.stem for path in tmp_path.glob("*.png"))
    assert painted == sorted(["LCM Spy", *(name.upper() for name in TYPES)])


def test_the_jar_holds_one_class_a_struct_and_is_the_same_each_time(types, tmp_path, monkeypatch):
    if shutil.which("javac"):
        assert zipfile.ZipFile(types).namelist() == [f"podwatch/{name}.class" for name in TYPES]
        assert build_jar(jar=tmp_path / "again.jar").read_bytes() == types.read_bytes()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(JarError, match="apt-get install default-jdk-headless"):
        build_jar(jar=tmp_path / "c.jar")


@pytest.mark.parametrize(
    ("present", "inputs", "mend"),
    [
        ((), {}, as_root("apt-get install default-jre")),
        (("java",), {"library": "gone"}, "install --force-reinstall lcm=="),
        (("java",), {"jar": "gone"}, as_root("apt-get install default-jdk-headless")),
        (("java", "javac"), {"jar": "gone"}, "-m lcmtypes.jar"),
        (("java",), {}, "ssh -X"),
    ],
)
def test_each_thing_that_lcm_spy_lacks_is_told_with_its_command(tmp_path, present, inputs, mend):
    (tmp_path / "there").touch()
    paths = {name: tmp_path / inputs.get(name, "there") for name in ("library", "jar")}
    missing = gui.what_is_missing({}, lambda name: name if name in present else None, **paths)
    assert missing is not None
    assert mend in missing[1]
    assert gui.what_is_missing({"DISPLAY": ":0"}, str, tmp_path / "there", tmp_path / "there") is None


def test_lcm_spy_is_started_on_the_drones_bus_with_our_classes_first(tmp_path, monkeypatch):
    (tmp_path / "bin").mkdir()
    stand_in = tmp_path / "bin" / "lcm-spy"
    stand_in.write_text(f'#!/bin/sh\necho "$1 $CLASSPATH" > {tmp_path}/told\nexit 7\n')
    stand_in.chmod(0o755)
    monkeypatch.setattr(gui, "PREFIX", tmp_path)
    monkeypatch.setattr(gui, "what_is_missing", lambda: None)
    monkeypatch.setenv("CLASSPATH", "/their/own.jar")
    result = CliRunner().invoke(app, ["spy", "--gui", "--drone", "3", "--slot", "7"])
    assert result.exit_code == 7
    url, classes = (tmp_path / "told").read_text().split()
    assert url.startswith("--lcm-url=udpm://239.255.76.103:7674")
    assert classes == f"{jar.JAR}:/their/own.jar"
