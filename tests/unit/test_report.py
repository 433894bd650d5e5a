"""report.html is one file that opens without a network and says the worst first."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from lcmtypes import channels
from logs.writer import LogWriter, picture_path
from procs.navigator.states import State
from tests.unit.fake_run import FakeRun
from tools.evidence import EvidenceError, load_run
from tools.judge import judge
from tools.report.figures import draw_map, draw_timeline, pick_shots
from tools.report.page import STATE_WORDS, make_report

VOID = {"meta", "image", "path", "br", "link", "rect", "circle", "polyline"}


class Outline(HTMLParser):
    """Checks that every element is closed, and collects what a browser would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.fetched: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.fetched += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open, f"</{tag}> closes nothing"
            if self.open[-1] in ("p", "li") and tag != self.open[-1]:  # may be left open
                self.open.pop()
            assert self.open.pop() == tag


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return FakeRun().write(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return make_report(folder).read_text(encoding="utf-8")


def test_it_is_one_file_without_network_and_script(page: str) -> None:
    outline = Outline()
    outline.feed(page)
    assert outline.open == []
    assert outline.fetched
    assert all(address.startswith("data:image/jpeg;base64,") for address in outline.fetched)
    assert "<script" not in page
    assert not re.search(r"url\(|@import|https?://", page)


def test_the_headline_stands_before_everything_else(page: str) -> None:
    words = re.sub(r"<style>.*?</style>", "", page, flags=re.S)
    assert words.index("Each drone kept an animal of its own in view") < words.index("Where they flew")
    assert "drone 2 over animal 2" in words


def test_a_failure_names_what_went_wrong_first(tmp_path: Path) -> None:
    run = FakeRun(watch=lambda drone, t_s: 1 if drone == 3 and t_s > 20 else drone, deaths={2: 25.0})
    page = make_report(run.write(tmp_path / "bad")).read_text(encoding="utf-8")
    assert 'class="verdict bad"' in page
    reason, death = page.index("drones 1 and 3 both watch animal 1"), page.index("drone 2 died 25 s after")
    assert reason < death < page.index('class="tiles"')


def test_each_drone_has_a_strip_with_the_boxes_and_names_of_its_pictures(folder: Path) -> None:
    run = load_run(folder)
    shots = pick_shots(run, run.drones[1])
    assert 8 <= len(shots) <= 12
    assert [shot.t_s for shot in shots] == sorted(shot.t_s for shot in shots)
    watching = [shot for shot in shots if shot.state == "MONITOR"]
    assert len(watching) == 6
    for shot in watching:
        own = [mark for mark in shot.marks if mark.is_own]
        assert [mark.label for mark in own] == ["12"]
        assert 0 <= own[0].x < own[0].x + own[0].width <= shot.width == 320
        # The picture is half the frame's size: a body of 10 m at 30 m height is 14 to 140 px there.
        assert 10 < max(own[0].width, own[0].height) < 150


def test_the_map_has_north_up_and_a_true_scale(folder: Path) -> None:
    truth = load_run(folder).truth
    drawn = draw_map(truth)
    scale = drawn.bar / drawn.bar_m
    at_home = {line.id: line for line in drawn.drones}
    assert at_home[2].start[0] - at_home[1].start[0] == pytest.approx(6 * scale, rel=0.02)
    pod_v = sum(line.end[1] for line in drawn.animals) / len(drawn.animals)
    assert at_home[1].start[1] - pod_v == pytest.approx(100 * scale, rel=0.1)  # the pod lies 100 m north: up
    for line in (*drawn.drones, *drawn.animals):
        assert 0 <= line.end[0] <= drawn.width
        assert 0 <= line.end[1] <= drawn.height


def test_the_timeline_shows_states_and_who_was_watched(folder: Path) -> None:
    run = load_run(folder)
    timeline = draw_timeline(run, judge(run.truth, run.drones))
    watching = next(bar for bar in timeline.states[1] if bar.what == "MONITOR")
    assert (watching.left, watching.width) == pytest.approx((25, 62.5), abs=1)
    assert [bar.what for bar in timeline.watched[3]] == [3]


def test_a_scene_without_labels_shows_what_the_drones_say(tmp_path: Path) -> None:
    folder = FakeRun(is_labelled=False).write(tmp_path / "run")
    run = load_run(folder)
    timeline = draw_timeline(run, judge(run.truth, run.drones))
    assert not timeline.is_true
    assert [bar.what for bar in timeline.watched[3]] == [13]
    assert "cannot be judged" in make_report(folder).read_text(encoding="utf-8")


def test_words_from_outside_cannot_become_markup(tmp_path: Path) -> None:
    folder = FakeRun(duration_s=12, monitor_s=(5, 10)).write(tmp_path / "run")
    (folder / "mission.json").write_text(json.dumps({"name": "<img src=x onerror=alert(1)>"}))
    page = make_report(folder).read_text(encoding="utf-8")
    assert "<img" not in page
    assert "&lt;img" in page


def test_a_run_that_found_nothing_still_makes_a_report(tmp_path: Path) -> None:
    folder = FakeRun(n_animals=0, duration_s=12, monitor_s=(50, 60), watch=lambda drone, t_s: 0).write(
        tmp_path / "run"
    )
    page = make_report(folder).read_text(encoding="utf-8")
    assert "The fleet never came to watch its animals together." in page


def test_a_drone_without_a_log_has_no_strip_and_is_named(tmp_path: Path) -> None:
    folder = FakeRun(duration_s=12, monitor_s=(5, 10)).write(tmp_path / "run")
    (folder / "drone_2.mcap").unlink()
    page = make_report(folder).read_text(encoding="utf-8")
    assert "drone 2 left no log" in page
    assert "No pictures in its log." in page


def test_every_state_has_words_and_a_colour() -> None:
    assert set(STATE_WORDS) == {state.name for state in State}


def test_previews_that_a_quota_keeps_apart_are_shown_too(folder: Path) -> None:
    log = folder / "drone_1.mcap"
    before = load_run(folder).messages[1][channels.PREVIEW]
    writer = LogWriter(picture_path(log), drone_id=1)
    writer.write(channels.PREVIEW, before[-1][1].encode(), before[-1][1].utime)
    writer.close()
    try:
        assert len(load_run(folder).messages[1][channels.PREVIEW]) == len(before) + 1
    finally:
        picture_path(log).unlink()


def test_a_folder_that_is_no_run_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match=r"truth\.json"):
        make_report(tmp_path)


def test_pictures_come_from_the_logged_previews(folder: Path) -> None:
    run = load_run(folder)
    assert len(run.messages[1][channels.PREVIEW]) >= 30
