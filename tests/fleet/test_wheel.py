"""What a user gets: the wheel, built from a clean copy, in a fresh environment, flown from an empty folder.

The wheel is built and its dependencies are installed from the package index, so these tests need the network,
as the set-up of the project itself does.
"""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("lcmtypes", "procs", "drivers", "logs", "tools", "models", "fleets")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
LIMIT_S = 300


def call(*words: str | Path, cwd: Path) -> str:
    """Run a command with nothing of this environment in its way -> what it said."""
    environment = {
        name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")
    }
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    assert done.returncode == 0, f"{words}: {done.stdout[-3000:]}{done.stderr[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy: the build writes message classes, which other tests are reading in the original."""
    copy = tmp_path_factory.mktemp("source")
    for folder in PACKAGES:
        ignored = shutil.ignore_patterns("__pycache__", "podwatch" if folder == "lcmtypes" else "")
        shutil.copytree(ROOT / folder, copy / folder, ignore=ignored)
    shutil.copytree(ROOT / "tests", copy / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", ".gitignore"):
        shutil.copy(ROOT / name, copy / name)
    out = tmp_path_factory.mktemp("wheel")
    call(*PIP, "wheel", copy, "--no-deps", "--wheel-dir", out, cwd=out)
    [built] = out.glob("podwatch-*.whl")
    return built


@pytest.mark.timeout(LIMIT_S)
def test_the_wheel_holds_all_that_runs_and_no_tests(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    wanted = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix in (".py", ".lcm", ".toml", ".onnx", ".j2", ".md")
    }
    assert wanted - held == set()
    kinds = {Path(name).suffix for name in wanted}
    assert {".py", ".lcm", ".toml", ".onnx", ".j2"} <= kinds
    assert {"lcmtypes/podwatch/__init__.py", "lcmtypes/podwatch/frame_t.py"} <= held
    assert "tools/report/page.html.j2" in held
    tops = {name.split("/")[0] for name in held}
    assert {top for top in tops if not top.endswith(".dist-info")} == set(PACKAGES)


@pytest.mark.timeout(2 * LIMIT_S)
def test_installed_from_the_wheel_it_flies_from_an_empty_folder(wheel, tmp_path):
    fresh = tmp_path / "fresh"
    call(sys.executable, "-m", "venv", "--without-pip", fresh, cwd=tmp_path)
    python = fresh / "bin" / "python"
    call(*PIP, "--python", python, "install", "--no-compile", wheel, cwd=tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    where = call(python, "-c", "import tools.cli; print(tools.cli.__file__)", cwd=empty)
    assert Path(where.strip()).is_relative_to(fresh)
    options = ("--lockstep", "--duration", "30", "--headless", "--sensor", "boxes")
    call(fresh / "bin" / "podwatch", "sim", *options, cwd=empty)
    [summary] = empty.glob("runs/*/summary.json")
    about = json.loads(summary.read_text())
    assert (about["mode"], about["fallback_reason"], len(about["drones"])) == ("lockstep", None, 3)
    assert (summary.parent / "report.html").stat().st_size > 1000
