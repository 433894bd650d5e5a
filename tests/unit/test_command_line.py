"""`podwatch` at the prompt: what people mistype, what they stop, and what they are told."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from procs.detector.yolo import ModelError
from procs.settings import MissionError
from tools import errors
from tools.cli import app
from tools.sim import flight, run
from tools.sim.watch import Watch
from tools.supervision import CannotStartError, SupervisorError

QUICK = ("--lockstep", "--headless", "--sensor", "boxes", "--duration", "2")


def podwatch(*arguments: object) -> Any:
    """Run it here; whatever is not a clean exit is a traceback for the user."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    return result


def refused(folder: Path, *arguments: object) -> str:
    """What is said of something that cannot be used; no run's folder is made."""
    runs = folder / "runs"
    given = [] if "--out" in arguments else ["--out", runs]
    result = podwatch("sim", *arguments, *given)
    assert result.exit_code == errors.UNUSABLE, result.output
    assert result.stderr.startswith("podwatch: ")
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""
    assert not runs.exists()
    return str(result.stderr)


def test_an_unknown_mission_is_told_with_the_nearest_and_all_there_are(tmp_path):
    said = refused(tmp_path, "five_drone")
    assert "did you mean 'five_drones'?" in said
    assert "there are: cut_link, death_in_monitor, default," in said
    assert "or give the path of a mission file" in said
    assert "did you mean" not in refused(tmp_path, "xxxxxxxx")


def test_a_mission_file_that_is_not_there_or_is_a_folder_or_no_toml(tmp_path):
    assert "nothing.toml: cannot be read (No such file" in refused(tmp_path, tmp_path / "nothing.toml")
    (tmp_path / "folder.toml").mkdir()
    assert "folder.toml: cannot be read (Is a directory)" in refused(tmp_path, tmp_path / "folder.toml")
    path = tmp_path / "mission.toml"
    path.write_text("[watch\n")
    assert "not valid TOML" in refused(tmp_path, path)


def test_a_folder_of_a_missions_name_does_not_hide_the_mission(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "default").mkdir()
    assert flight.read_mission("default").name == "default"


def test_an_out_that_cannot_be_written_is_told_before_anything_flies(tmp_path):
    (tmp_path / "taken").write_text("")
    said = refused(tmp_path, "--out", tmp_path / "taken", *QUICK)
    assert "taken: no folder can be made there (Not a directory); give one that you may write to" in said


def test_a_scene_that_is_no_picture_is_told_before_anything_flies(tmp_path):
    text = tmp_path / "a.jpg"
    text.write_text("no picture")
    assert "a.jpg: not a picture that OpenCV reads; give JPEG, PNG" in refused(tmp_path, "--scene", text)
    video = tmp_path / "a.mp4"
    video.write_text("no video")
    assert "a.mp4: no frame could be read" in refused(tmp_path, "--scene", video)
    assert "no such file" in refused(tmp_path, "--scene", tmp_path / "b.jpg")


def test_a_scene_with_labels_that_are_no_yolo_text(tmp_path):
    picture = tmp_path / "a.png"
    cv2.imwrite(str(picture), np.full((48, 64, 3), 80, np.uint8))
    (tmp_path / "a.txt").write_text("whale 0.5 0.5 big\n")
    said = refused(tmp_path, "--scene", picture)
    assert "each line is: class u v width height" in said


def test_boxes_in_place_of_pixels_cannot_look_at_a_picture(tmp_path):
    assert "--sensor boxes looks at no pixels" in refused(tmp_path, "--scene", "a.png", "--sensor", "boxes")
    assert "--sensor radar: there are pixels and boxes" in refused(tmp_path, "--sensor", "radar")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--autopilot", "127.0.0.1:14550"], "names 1 address for 3 drones; give one each"),
        (["--autopilot", "a:1,b:2,c"], "'c': write 'sim', HOST:PORT"),
        (["--drones", "1", "--autopilot", "udp:14550"], "'14550': write 'sim', HOST:PORT"),
        (["--drones", "1", "--autopilot", "tcp:127.0.0.1:5760", "--lockstep"], "drop it, or --lockstep"),
    ],
)
def test_addresses_of_autopilots_that_cannot_be(tmp_path, monkeypatch, options, words):
    monkeypatch.setattr(flight, "has_multicast_route", lambda: True)
    assert words in refused(tmp_path, *options)


@pytest.fixture
def waiting(tmp_path: Path) -> Path:
    """A mission that waits for an order."""
    path = tmp_path / "waiting.toml"
    path.write_text('duration_s = 90\n[search]\nstart = "operator"\n')
    return path


def test_a_fleet_that_waits_for_an_order_is_not_flown_where_nobody_can_give_one(
    tmp_path, waiting, monkeypatch
):
    assert "no boat can join a flight in lockstep; fly without" in refused(tmp_path, waiting, "--lockstep")
    monkeypatch.setattr(flight, "has_multicast_route", lambda: False)
    result = podwatch("sim", waiting, "--out", tmp_path / "runs")
    assert result.exit_code == errors.MISSING
    assert "no boat can join" in result.stderr
    assert "ip route replace" in result.stderr


class ReadyFleet:
    """Processes that are there at once, and a flight that is over."""

    now_s = 2.0

    def __init__(self, *_: object) -> None: ...

    def __enter__(self) -> "ReadyFleet":
        return self

    def __exit__(self, *_: object) -> None: ...

    def wait_until_ready(self, check_interrupt: object, tell: Callable[[str], None]) -> None:
        tell("All run")

    def look(self) -> None: ...


@pytest.mark.parametrize("options", [(), ("--headless",)])
def test_a_fleet_that_waits_for_an_order_says_how_to_give_it(tmp_path, waiting, monkeypatch, options):
    monkeypatch.setattr(flight, "has_multicast_route", lambda: True)
    monkeypatch.setattr(run, "ProcessFleet", ReadyFleet)
    monkeypatch.setattr(Watch, "step", lambda *_: True)
    for name in ("finish", "print_summary", "_print_expected"):  # nothing flew
        monkeypatch.setattr(flight, name, lambda *_: None)
    runs = ("--out", tmp_path / "runs")
    said = [podwatch("sim", mission, *runs, *options).stdout for mission in (waiting, "default")]
    [order, *_] = [line for line in said[0].splitlines() if "podwatch boat" in line]
    assert order.strip().endswith("/boat.toml")
    assert "Starting 27 processes, 9 for each drone" in said[0]
    assert said[0].index("Starting") < said[0].index("All run") < said[0].index(order)
    assert "and type there: start. Without it the run ends after 90 s." in said[0]
    assert "The fleet waits on the ground for an order" in said[0]
    assert "podwatch boat" not in said[1]


def test_addresses_are_taken_in_every_form(monkeypatch):
    mission = flight.with_overrides(flight.read_mission("default"), drones=4)
    text = "127.0.0.1:14550, udpout:10.0.0.2:1,tcp:sitl:5760,serial:/dev/ttyAMA0:57600"
    assert flight._addresses(text, mission, lockstep=False, fallback="") == (
        "udp:127.0.0.1:14550",
        "udpout:10.0.0.2:1",
        "tcp:sitl:5760",
        "serial:/dev/ttyAMA0:57600",
    )


def test_a_value_out_of_range_is_refused_as_an_option(tmp_path):
    for option, value in (("--drones", 0), ("--drones", "three"), ("--seed", -1), ("--duration", 0)):
        result = podwatch("sim", option, value)
        assert (result.exit_code, result.stdout) == (2, "")
        assert option in result.stderr


def test_one_drone_flies_and_is_counted_as_one(tmp_path):
    result = podwatch("sim", "--drones", 1, "--animals", 1, "--out", tmp_path, *QUICK)
    assert result.exit_code == 0
    assert ": 1 drone, 1 animal, seed 1 -> " in result.stdout.replace("\n", "")
    [summary] = tmp_path.glob("*/summary.json")
    assert len(json.loads(summary.read_text())["drones"]) == 1


def test_ctrl_c_ends_a_run_that_is_then_judged_by_what_it_logged(tmp_path, monkeypatch):
    def step(watch: Watch, now_s: float, *_: object) -> bool:
        if now_s >= 2.0:
            raise KeyboardInterrupt
        return False

    monkeypatch.setattr(Watch, "step", step)
    result = podwatch("sim", "--drones", 1, "--out", tmp_path, *QUICK, "--duration", 60)
    assert result.exit_code == errors.INTERRUPTED
    assert "Stopped before its end; what was logged is judged." in result.stdout
    [folder] = tmp_path.iterdir()
    assert json.loads((folder / "truth.json").read_text())["flown_s"] == pytest.approx(2.0)
    assert (folder / "summary.json").exists()
    assert (folder / "report.html").exists()


def test_ctrl_c_before_anything_flew_leaves_nothing_to_judge(tmp_path, monkeypatch):
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(flight, "fly_lockstep", stopped)
    result = podwatch("sim", "--drones", 1, "--out", tmp_path, *QUICK)
    assert result.exit_code == errors.INTERRUPTED
    assert "Stopped before anything flew" in result.stderr


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (MissionError("a"), 2),
        (ModelError("a"), 3),
        (SupervisorError("a"), 1),
        (CannotStartError("a"), 3),
        (PermissionError(13, "Permission denied", "a"), 3),
        (OSError("all 50 slots are taken"), 3),
        (FileExistsError("a"), 3),
    ],
)
def test_each_error_that_a_user_can_mend_has_its_exit_code(error, code, capsys):
    with pytest.raises(typer.Exit) as ended, errors.plain_errors():
        raise error
    assert ended.value.exit_code == code
    assert capsys.readouterr().err.startswith("podwatch: a")


def test_a_fault_of_ours_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError), errors.plain_errors():
        1 / 0  # noqa: B018


def test_a_key_that_the_mission_names_is_used_and_never_replaced(tmp_path):
    mission = flight.read_mission("one_drone")
    key = tmp_path / "fleet.key"
    plan: Any = type("Plan", (), {"mission": mission, "folder": tmp_path})
    run.prepare(plan)
    made = key.read_text()
    run.prepare(plan)
    assert key.read_text() == made


def test_a_report_of_no_run_and_views_of_no_picture(tmp_path):
    result = podwatch("report", tmp_path)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "no drone_<id>.mcap in this folder" in result.stderr
    (tmp_path / "a.jpg").write_text("no picture")
    result = podwatch("views", tmp_path / "a.jpg", tmp_path / "a.jpg")
    assert result.exit_code == 2
    assert "a.jpg: holds no picture that can be read (10 bytes)" in result.stderr


def test_the_errors_import_nothing_heavy():
    script = (
        "import sys, tools.errors; print([m for m in ('cv2', 'numpy', 'onnxruntime') if m in sys.modules])"
    )
    printed = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True, text=True)
    assert printed.stdout.strip() == "[]"
