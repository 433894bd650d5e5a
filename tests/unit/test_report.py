"""report.html is one file that opens without a network, says the worst first, and lets no log's words in as
code.
"""

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from lcmtypes import channels, make, podwatch
from logs.exceptions import LogError
from logs.writer import LogWriter, picture_path
from procs.navigator.states import Event, State
from tests.unit.fake_run import FakeRun
from tests.unit.report_runs import HOSTILE, MappedRun, Outline, logs_only, words_of
from tools.cli import app
from tools.evidence import Clock, load_run
from tools.report import make_report
from tools.report.findings import SETBACKS, find_findings, sentence
from tools.report.flights import find_flights, read_flight
from tools.report.page import make_section, render, write_report
from tools.report.stills import best_stills, camera_stills
from tools.report.watching import animal_stories, lost_spans, shared_spans, watched_spans
from tools.report.ways import find_ways
from tools.report.words import PROCESS_WORDS, STATE_WORDS, clock, lasting, plain


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return MappedRun().write(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return make_report(folder).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs without truth, of drones whose clocks are far apart."""
    clocks = {1: Clock(3e6), 2: Clock(900e6, 20.0), 3: Clock(1e6)}
    return logs_only(tmp_path_factory.mktemp("alone"), MappedRun(clocks=clocks))


def test_it_is_one_file_that_fetches_nothing_and_runs_only_its_own_script(page: str) -> None:
    outline = Outline(page)
    assert outline.open == []
    assert outline.fetched
    assert all(address.startswith("data:image/jpeg;base64,") for address in outline.fetched)
    assert outline.scripts == ["application/json", ""]
    assert outline.handlers == []
    text = page.replace("http://www.w3.org/2000/svg", "")  # a name, not an address
    assert not re.search(r"url\(|@import|https?://", text)
    assert re.search(
        r"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-", page
    )


def test_the_sentence_stands_first_then_what_went_wrong_then_the_map(page: str) -> None:
    words = words_of(page)
    places = [
        words.index(text)
        for text in (
            "Each drone kept an animal of its own in view",
            "What went wrong",
            "Nothing went wrong.",
            "Where they flew",
            "who watched whom",
            "The animals",
            "How drones and radio fared",
            "Figures of each drone",
        )
    ]
    assert places == sorted(places)


def test_the_first_screen_has_no_names_of_processes_or_states(tmp_path: Path) -> None:
    run = MappedRun(watch=lambda drone, t_s: 1 if drone == 3 and t_s > 20 else drone, deaths={2: 25.0})
    page = make_report(run.write(tmp_path / "bad")).read_text(encoding="utf-8")
    first = words_of(page).split("How drones and radio fared")[0]
    for word in (
        *PROCESS_WORDS,
        *(state.name for state in State),
        "identity",
        "consensus",
        "setpoint",
        "window",
    ):
        if word not in ("camera", "LAND"):
            assert word not in first, word


def test_a_failure_names_what_went_wrong_the_worst_first(tmp_path: Path) -> None:
    run = MappedRun(watch=lambda drone, t_s: 1 if drone == 3 and t_s > 20 else drone, deaths={2: 25.0})
    page = make_report(run.write(tmp_path / "bad")).read_text(encoding="utf-8")
    assert 'class="verdict bad"' in page
    words = words_of(page)
    shared = words.index("Drones 1 and 3 both watch animal 1 from 0:20.")
    death = words.index("Drone 2 failed at 0:25 and was not heard again.")
    assert max(shared, death) < words.index("Where they flew")


def test_a_drone_that_lost_its_animal_is_told_with_when_and_for_how_long(tmp_path: Path) -> None:
    run = MappedRun(aim_off_m=lambda drone, t_s: 60.0 if drone == 2 and 20 <= t_s < 28 else 0.0)
    flight = read_flight([run.write(tmp_path / "run")])
    watched = watched_spans(flight)
    [(from_s, to_s)] = lost_spans(flight, watched)[2]
    assert (from_s, to_s) == pytest.approx((20, 28), abs=1.2)
    is_good, _ = sentence(flight, watched)
    texts = [finding.text for finding in find_findings(flight, watched, is_good)]
    assert any(
        re.fullmatch(r"Drone 2 had lost its animal from 0:2\d to 0:2\d \(\d s\)\.", text) for text in texts
    )


def test_time_in_view_is_that_of_the_truth(folder: Path) -> None:
    flight = read_flight([folder])
    stories = {
        story.number: story
        for story in animal_stories(flight, watched_spans(flight), find_ways(flight).lengths_m)
    }
    assert sorted(stories) == [1, 2, 3, 4, 5]
    for number in (1, 2, 3):
        assert stories[number].watched_by == pytest.approx({number: 25.0}, abs=0.5)
        assert stories[number].watched_s == pytest.approx(25.0, abs=0.5)
        assert 25 < stories[number].in_view_s < 40
    assert stories[4].watched_by == {}


def test_two_that_watch_one_animal_count_its_time_once(tmp_path: Path) -> None:
    flight = read_flight([MappedRun(n_drones=2, watch=lambda drone, t_s: 1).write(tmp_path / "run")])
    watched = watched_spans(flight)
    [story] = [story for story in animal_stories(flight, watched, {}) if story.number == 1]
    assert sum(story.watched_by.values()) == pytest.approx(50, abs=1)
    assert story.watched_s == pytest.approx(25, abs=0.5)
    [(one, other, span)] = shared_spans(watched)
    assert (one, other, span.what) == (1, 2, 1)


def test_each_named_animal_has_a_best_picture_under_its_true_number(folder: Path) -> None:
    best = best_stills(read_flight([folder]))
    assert set(best) >= {1, 2, 3}
    for number, still in best.items():
        [mark] = still.marks
        assert mark.number == number
        assert 0 <= mark.x < mark.x + mark.width <= still.width
        assert 288 <= still.width <= 640
        assert still.width / still.height == pytest.approx(4 / 3, rel=0.02)
        image = cv2.imdecode(np.frombuffer(still.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image.shape == (still.height, still.width)
        inside = image[int(mark.y) + 4 : int(mark.y + mark.height) - 4, int(mark.x) + 4 :][
            :, : int(mark.width) - 8
        ]
        assert inside.mean() < image.mean() - 1, "the animal, darker than the sea, lies in its box"


def test_black_pictures_are_nobodys_best(tmp_path: Path) -> None:
    run = MappedRun(duration_s=16, monitor_s=(5, 14), picture=lambda *_: np.zeros((480, 640, 3), np.uint8))
    flight = read_flight([run.write(tmp_path / "run")])
    assert best_stills(flight) == {}
    assert "no picture in which it was named" in render([make_section("m0", flight)])


def test_the_cameras_pictures_are_few_and_spread_over_the_flight(folder: Path) -> None:
    stills = camera_stills(read_flight([folder]), 30)
    for drone in (1, 2, 3):
        times_s = [still.t_s for still in stills if still.drone_id == drone]
        assert len(times_s) == 10
        assert times_s == sorted(times_s)
        assert times_s[-1] - times_s[0] > 25


def test_the_map_holds_true_places_in_decimetres(page: str, folder: Path) -> None:
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])  # type: ignore[index]
    [mission] = data
    truth = load_run(folder).truth
    pose = truth.drone_at(2, np.array([20.0]))[0]
    drone = mission["drones"][1]
    assert mission["step"] == 1.0
    assert (drone["n"][20], drone["e"][20]) == pytest.approx((10 * pose[0], 10 * pose[1]), abs=1)
    assert drone["h"][20] == pytest.approx(300, abs=1)
    assert [animal["id"] for animal in mission["animals"]] == [1, 2, 3, 4, 5]


def test_a_death_ends_a_drones_way_on_the_map(tmp_path: Path) -> None:
    flight = read_flight([MappedRun(deaths={2: 20.0}).write(tmp_path / "run")])
    way = find_ways(flight).drones[2]
    assert np.isfinite(way[20]).all()
    assert np.isnan(way[21:]).all()


def test_a_run_in_which_a_drone_died_says_so_and_claims_no_more(tmp_path: Path) -> None:
    folder = MappedRun(deaths={2: 20.0}).write(tmp_path / "run")
    log = folder / "drone_2.mcap"
    log.write_bytes(log.read_bytes()[:-200])  # killed: its summary was never written
    flight = read_flight([folder])
    assert any("was not closed" in problem for problem in flight.run.problems)
    section = make_section("m0", flight)
    assert section.sentence.startswith("Each drone kept an animal of its own in view for as long as it flew")
    assert [finding.text for finding in section.wrong] == ["Drone 2 failed at 0:20 and was not heard again."]


def test_logs_alone_make_a_report_that_says_whose_word_it_is(alone: Path) -> None:
    flight = read_flight([alone])
    assert not flight.knows_drones
    words = words_of(render([make_section("m0", flight)]))
    assert "Three drones say that each watched an animal of its own, all at the same time for 25 s." in words
    assert "This page is made from the drones’ own logs." in words
    assert "Nothing went wrong that the logs tell of." in words
    assert "Distinct: not known." in words


@pytest.mark.parametrize(
    ("called_s", "told"),
    [
        (80.0, "for 10 s. A person called the fleet home at 1:20."),
        (65.0, "A person called the fleet home at 1:05, before it came to watch an animal."),
    ],
)
def test_a_fleet_that_a_person_calls_home_is_no_failure_also_by_logs_alone(
    tmp_path: Path, called_s: float, told: str
) -> None:
    run = MappedRun(
        duration_s=90.0,
        monitor_s=(70.0, 88.0),
        called=dict.fromkeys((1, 2, 3), (called_s, Event.ORDER_RETURN)),
    )
    flight = read_flight([logs_only(tmp_path, run)])
    is_good, words = sentence(flight, watched_spans(flight))
    assert is_good is None
    assert words.endswith(told)


def test_logs_of_far_clocks_lie_on_one_axis_of_time(alone: Path) -> None:
    flight = read_flight([alone])
    starts_s = {
        log.id: next(t_s for t_s, state in log.states if state == "MONITOR") for log in flight.run.drones
    }
    assert starts_s == pytest.approx(dict.fromkeys((1, 2, 3), 10.0), abs=0.3)
    assert flight.end_s == pytest.approx(40, abs=0.5)


def test_places_from_logs_alone_are_what_drones_and_the_fleets_map_said(alone: Path) -> None:
    run = MappedRun()
    ways = find_ways(read_flight([alone]))
    assert sorted(ways.animals) == [11, 12, 13, 14, 15]
    assert ways.animals[12][20, :2] == pytest.approx(run.animal(2, 20.0)[:2], abs=0.5)
    assert np.isnan(ways.animals[12][5]).all(axis=None) or np.isnan(ways.animals[12][5, :2]).all()
    pose = run.pose(2, 20.0)
    assert ways.drones[2][20, :3] == pytest.approx((pose.n_m, pose.e_m, pose.height_m), abs=0.7)
    assert ways.lengths_m[12] == pytest.approx(10.0)


def test_a_log_that_ends_in_the_air_is_a_drone_that_failed(tmp_path: Path) -> None:
    folder = logs_only(tmp_path / "run", MappedRun(deaths={2: 22.0}))
    section = make_section("m0", read_flight([folder]))
    assert section.flight.cut_short == (2,)
    assert section.findings[0].text.startswith(
        "Drone 2's log ends at 0:22, before the others'; its last word:"
    )


def test_two_drones_that_say_the_same_animal_are_told_from_logs_alone(tmp_path: Path) -> None:
    run = MappedRun(watch=lambda drone, t_s: 1 if drone == 3 and t_s > 20 else drone)
    section = make_section("m0", read_flight([logs_only(tmp_path / "run", run)]))
    assert section.is_good is False
    assert section.findings[0].text.startswith(
        "Drones 1 and 3 both said that they watched animal 11, from 0:2"
    )


def test_a_broken_log_still_gives_a_report_that_says_so(tmp_path: Path) -> None:
    folder = logs_only(tmp_path / "run", MappedRun(duration_s=20, monitor_s=(5, 15)))
    log = folder / "drone_2.mcap"
    log.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    (folder / "drone_3.mcap").write_bytes(b"")
    words = words_of(make_report(folder).read_text(encoding="utf-8"))
    assert words.index("Not everything could be read") < words.index("Where they flew")
    assert "drone_2.mcap: was not closed" in words
    assert "drone_3.mcap: is empty (0 bytes)" in words


def test_a_run_without_its_truth_is_told_from_its_logs(tmp_path: Path) -> None:
    folder = MappedRun(duration_s=20, monitor_s=(5, 15)).write(tmp_path / "run")
    (folder / "truth.mcap").unlink()
    words = words_of(make_report(folder).read_text(encoding="utf-8"))
    assert "truth.mcap" in words
    assert "This page is made from the drones’ own logs." in words


def test_a_drone_whose_clock_nobody_measured_is_shown_with_a_warning(tmp_path: Path) -> None:
    run = FakeRun(duration_s=20, monitor_s=(5, 15), clocks={2: Clock(500e6)})  # no offsets in its links
    words = words_of(make_report(logs_only(tmp_path / "run", run)).read_text(encoding="utf-8"))
    assert "drone 2: its clock was never compared with the others'" in words


def test_words_from_logs_and_missions_cannot_become_code(tmp_path: Path) -> None:
    class HostileRun(MappedRun):
        def _mission_state(self, drone: int, t_s: float) -> podwatch.mission_state_t:
            state = super()._mission_state(drone, t_s)
            state.reason = HOSTILE
            return state

        def _link_state(self, drone: int, t_s: float) -> podwatch.link_state_t:
            state = super()._link_state(drone, t_s)
            for link in state.links:
                link.kinds = [HOSTILE, "link"]
            return state

    folder = HostileRun(duration_s=20, monitor_s=(5, 15)).write(tmp_path / "<img src=x onerror=alert(3)>")
    (folder / "mission.json").write_text(json.dumps({"name": HOSTILE}))
    writer = LogWriter(folder / "drone_1.1.mcap", drone_id=1)
    for utime in (22_000_000, 26_000_000):
        beat = make(podwatch.heartbeat_t, utime=utime, process=HOSTILE, status=2, detail=HOSTILE)
        writer.write(channels.HEARTBEAT, beat.encode(), utime)
    writer.close()
    page = make_report(folder).read_text(encoding="utf-8")
    outline = Outline(page)
    assert outline.open == []
    assert outline.scripts == ["application/json", ""]
    assert outline.handlers == []
    assert all(address.startswith("data:image/jpeg;base64,") for address in outline.fetched)
    assert "alert(1)" in outline.words, "the words themselves are shown"
    assert "{{ 7 * 7 }}" in outline.words


def test_a_day_of_two_missions_begins_with_what_each_came_to(tmp_path: Path) -> None:
    good = MappedRun(duration_s=20, monitor_s=(5, 15)).write(tmp_path / "day" / "2026-05-01_09-30-00")
    MappedRun(duration_s=20, monitor_s=(50, 60)).write(tmp_path / "day" / "2026-05-01_14-05-00")
    flights = [read_flight(paths) for paths in find_flights([tmp_path / "day"], pytest.fail)]
    page = write_report(flights, tmp_path / "report.html").read_text(encoding="utf-8")
    words = words_of(page)
    assert "Two missions: one went well, one did not." in words
    overview, *rest = words.split("Animals are named anew in each mission")
    assert "1 May 2026, 09:30" in overview
    assert "1 May 2026, 14:05" in overview
    assert overview.index("Each drone kept an animal of its own") < overview.index(
        "The fleet never came to watch"
    )
    assert len(json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])) == 2  # type: ignore[index]
    assert rest[0].count("Where they flew") == 2
    assert Outline(page).open == []
    assert read_flight([good]).title == "made by hand"


def test_what_people_give_is_missions_in_their_order(tmp_path: Path, alone: Path, folder: Path) -> None:
    logs = [alone / "drone_1.mcap", alone / "drone_2.mcap"]
    assert find_flights([folder, *logs], pytest.fail) == [[folder], logs]
    assert [log.id for log in read_flight(logs).run.drones] == [1, 2]
    with pytest.raises(LogError, match=r"no drone_<id>\.mcap in this folder, nor in one of its folders"):
        find_flights([tmp_path], pytest.fail)
    with pytest.raises(LogError, match="no such file or folder"):
        find_flights([tmp_path / "gone.mcap"], pytest.fail)
    with pytest.raises(LogError, match="are both of drone 1"):
        read_flight([alone / "drone_1.mcap", folder / "drone_1.mcap"])


def test_two_boots_of_the_drones_in_one_folder_are_two_missions_of_a_day(tmp_path: Path) -> None:
    """As a service leaves them: its second boot goes on under the first one's names, on clocks of its own."""
    first = {1: Clock(3e6), 2: Clock(900e6)}
    second = {1: Clock(5e6), 2: Clock(70e6)}
    kept = logs_only(tmp_path / "kept", MappedRun(n_drones=2, duration_s=20, clocks=first))
    later = logs_only(tmp_path / "later", MappedRun(n_drones=2, duration_s=30, clocks=second))
    for drone in (1, 2):
        (later / f"drone_{drone}.mcap").rename(kept / f"drone_{drone}.1.mcap")
    found = find_flights([kept], pytest.fail)
    assert [[path.name for path in paths] for paths in found] == [
        ["drone_1.mcap", "drone_2.mcap"],
        ["drone_1.1.mcap", "drone_2.1.mcap"],
    ]
    flights = [read_flight(paths) for paths in found]
    assert [round(flight.end_s) for flight in flights] == [20, 30]
    assert [flight.run.problems for flight in flights] == [(), ()]
    result = CliRunner().invoke(app, ["report", str(kept)])
    assert result.exit_code == 0, result.output
    assert result.stdout.strip() == str(kept / "report.html")
    assert "Two missions:" in words_of((kept / "report.html").read_text(encoding="utf-8"))


def test_another_flights_log_in_a_runs_folder_is_left_out_and_told(tmp_path: Path, folder: Path) -> None:
    run = shutil.copytree(folder, tmp_path / "run")
    shutil.copy(run / "drone_1.mcap", run / "drone_1.1.mcap")
    [flight] = [read_flight(paths) for paths in find_flights([run], pytest.fail)]
    assert flight.run.problems == (
        "drone 1: drone_1.1.mcap is of another flight, on a clock of its own, and is left out",
    )
    assert len(flight.run.messages[1][channels.TRACK]) == len(load_run(folder).messages[1][channels.TRACK])


def test_the_command_writes_the_page_and_a_runs_summary(tmp_path: Path) -> None:
    folder = MappedRun(duration_s=16, monitor_s=(5, 12)).write(tmp_path / "run")
    result = CliRunner().invoke(app, ["report", str(folder)])
    assert (result.exit_code, result.stdout.strip()) == (0, str(folder / "report.html"))
    assert json.loads((folder / "summary.json").read_text())["distinct"] is True
    out = tmp_path / "mine.html"
    logs = [str(folder / f"drone_{k}.mcap") for k in (1, 2)]
    result = CliRunner().invoke(app, ["report", *logs, "--out", str(out)])
    assert (result.exit_code, result.stdout.strip()) == (0, str(out))
    result = CliRunner().invoke(app, ["report", str(tmp_path / "gone")])
    assert result.exit_code == 2
    assert "no such file or folder" in result.stderr


def test_a_day_leaves_out_a_mission_that_cannot_be_read_and_says_so(tmp_path: Path) -> None:
    MappedRun(duration_s=16, monitor_s=(5, 12)).write(tmp_path / "day" / "b")
    (tmp_path / "day" / "a").mkdir()
    (tmp_path / "day" / "a" / "drone_1.mcap").write_bytes(b"")
    result = CliRunner().invoke(app, ["report", str(tmp_path / "day"), "--out", str(tmp_path / "day.html")])
    assert result.exit_code == 0
    assert "left out: " in result.stderr
    assert "drone_1.mcap: is empty (0 bytes)" in result.stderr
    assert "Each drone kept an animal" in words_of((tmp_path / "day.html").read_text(encoding="utf-8"))
    result = CliRunner().invoke(app, ["report", str(tmp_path / "day" / "a")])
    assert (result.exit_code, result.stdout) == (2, "")


def test_a_scene_without_labels_shows_what_the_drones_say(tmp_path: Path) -> None:
    folder = MappedRun(is_labelled=False, duration_s=20, monitor_s=(5, 15)).write(tmp_path / "run")
    flight = read_flight([folder])
    assert [span.what for span in watched_spans(flight)[3]] == [13]
    words = words_of(render([make_section("m0", flight)]))
    assert "Nobody marked the animals of this scene" in words


def test_a_run_that_found_nothing_still_makes_a_report(tmp_path: Path) -> None:
    run = FakeRun(n_animals=0, duration_s=12, monitor_s=(50, 60), watch=lambda drone, t_s: 0)
    words = words_of(make_report(run.write(tmp_path / "run")).read_text(encoding="utf-8"))
    assert "The fleet never came to watch its animals together." in words
    assert "No animal was seen and named." in words


def test_a_drone_without_a_log_is_named(tmp_path: Path) -> None:
    folder = FakeRun(duration_s=12, monitor_s=(5, 10)).write(tmp_path / "run")
    (folder / "drone_2.mcap").unlink()
    assert "Drone 2 left no log that can be read." in words_of(
        make_report(folder).read_text(encoding="utf-8")
    )


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


def test_every_state_and_every_setback_has_words() -> None:
    assert set(STATE_WORDS) == {state.name for state in State}
    assert set(SETBACKS) <= {event.value for event in Event}


@pytest.mark.parametrize(
    ("reason", "words"),
    [
        ("drones 1 and 3 both watch animal 4 from 61.2 s", "drones 1 and 3 both watch animal 4 from 1:01"),
        (
            "all watched different animals for only 86% of the window, 90% is asked; worst is drone 3, over",
            "each drone had an animal of its own for only 86% of the time in which all were watching",
        ),
        (
            "drone 1 holds no consensus: its newest episode is 3 by drone 2",
            "drone 1 had not agreed with the others which animal is which",
        ),
        (
            "drone 2 watches no animal at the end of the window (95.0 s)",
            "drone 2 had lost its animal at the end (1:35)",
        ),
    ],
)
def test_the_judges_reasons_become_plain_words(reason: str, words: str) -> None:
    assert plain(reason) == words


def test_times_are_told_as_people_say_them() -> None:
    assert [clock(t_s) for t_s in (0, 94.4, 3725)] == ["0:00", "1:34", "1:02:05"]
    assert [lasting(t_s) for t_s in (8.2, 63, 120, 7500)] == ["8 s", "1 min 3 s", "2 min", "2 h 5 min"]


class OddRun(MappedRun):
    """Values that no drone should say, each of the right type."""

    def _identities(self, drone: int, t_s: float) -> podwatch.identities_t:
        named = super()._identities(drone, t_s)
        for box in named.boxes[:1]:
            box.left_px = float("nan")
        for seen in named.map[:1]:
            seen.size_m = float("nan")
        return named

    def _vehicle_state(self, drone: int, t_s: float) -> podwatch.vehicle_state_t:
        state = super()._vehicle_state(drone, t_s)
        state.utc_us = 2**62
        return state


def test_values_that_are_no_numbers_or_no_times_cost_the_page_nothing_else(tmp_path):
    flight = read_flight([logs_only(tmp_path / "run", OddRun())])
    page = write_report([flight], tmp_path / "page.html")
    assert page.exists()
