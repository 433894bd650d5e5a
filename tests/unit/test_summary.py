"""summary.json has every figure that it promises, and people read the sentence that matters first."""

import json
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from lcmtypes import make, podwatch
from procs.navigator.states import Event, State
from tests.unit.fake_run import FakeRun
from tools.called import Order, fleet_order
from tools.sim import flight
from tools.sim.expect import Safety
from tools.sim.settings import Expect, SimMission
from tools.summary import headline, print_summary, summarise, write_summary

# As `podwatch sim` promises them.
TOP = {
    "mode",
    "fallback_reason",
    "seed",
    "distinct",
    "consensus",
    "episodes",
    "seconds_to_monitor",
    "monitor_window_s",
    "realtime_factor",
    "drones",
    "links",
}
DRONE = {"id", "animal", "final_state", "monitor_s", "in_image_share", "tracker_hz", "setpoint_age_p99_ms"}
LINK = {
    "from",
    "to",
    "bytes_per_s",
    "largest_payload_bytes",
    "largest_encoded_bytes",
    "largest_datagram_bytes",
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return write_summary(FakeRun().write(tmp_path_factory.mktemp("good")))


def printed(summary: dict[str, Any]) -> str:
    out = StringIO()
    print_summary(summary, Console(file=out, width=100))
    return out.getvalue()


def test_every_promised_name_is_there_and_the_file_is_json(good: dict[str, Any]) -> None:
    assert set(good) >= TOP
    assert all(set(drone) >= DRONE for drone in good["drones"])
    assert all(set(link) >= LINK for link in good["links"])
    assert json.loads(json.dumps(good, allow_nan=False)) == good


def test_figures_are_those_of_the_log(good: dict[str, Any]) -> None:
    drone = good["drones"][1]
    assert (drone["id"], drone["animal"], drone["identity"], drone["final_state"]) == (2, 2, 12, "LANDED")
    assert drone["monitor_s"] == pytest.approx(25, abs=0.3)
    assert drone["tracker_hz"] == pytest.approx(5, abs=0.1)
    assert drone["setpoint_age_p99_ms"] == pytest.approx(20)
    assert good["camera_to_setpoint_ms"]["p50"] == pytest.approx(60, abs=0.1)
    assert good["simulated_s"] == pytest.approx(40, abs=0.2)


def test_links_are_counted_by_kind_from_the_senders_relay(good: dict[str, Any]) -> None:
    assert [(link["from"], link["to"]) for link in good["links"]] == [
        (1, 2),
        (1, 3),
        (2, 1),
        (2, 3),
        (3, 1),
        (3, 2),
    ]
    link = good["links"][0]
    assert link["bytes_per_s"] == {"RING_MAP": 240.0, "link": 80.0}
    assert (link["largest_payload_bytes"], link["largest_encoded_bytes"]) == (180, 230)
    assert link["largest_datagram_bytes"] == 290


def test_a_link_to_the_boat_names_it(good: dict[str, Any]) -> None:
    text = printed(good | {"links": [link | {"to": 0} for link in good["links"][:1]]})
    assert "1 → boat" in text
    assert "1 → 0" not in text


def test_success_is_said_in_one_sentence(good: dict[str, Any]) -> None:
    assert headline(good) == (
        True,
        "Each drone kept an animal of its own in view, and all agreed which animal is which.",
    )
    text = printed(good)
    assert text.strip().startswith("✓ Each drone")
    assert "All were watching 10 s after the start" in text
    assert "camera to command 60 ms" in text


def test_a_fleet_that_stayed_on_the_ground_is_told_so(good: dict[str, Any]) -> None:
    waited = [drone | {"final_state": "IDLE", "monitor_s": 0} for drone in good["drones"]]
    summary = good | {"monitor_window_s": None, "distinct": False, "drones": waited}
    assert headline(summary) == (False, "No drone took off.")
    waited[1]["final_state"] = "LANDED"
    assert headline(summary)[1].startswith("The fleet never came to watch")


def test_failure_names_its_reasons_first(tmp_path: Path) -> None:
    run = FakeRun(watch=lambda drone, t_s: 1 if drone == 3 and t_s > 20 else drone, deaths={2: 25.0})
    summary = summarise(run.write(tmp_path / "run"))
    text = printed(summary)
    assert summary["drones"][1]["final_state"] == "DEAD"
    assert text.index("both watch animal 1 from 20") < text.index("died at 25 s")
    assert text.strip().startswith("✗ The drones did not each keep")


def test_a_scene_without_labels_is_neither_success_nor_failure(tmp_path: Path) -> None:
    summary = summarise(FakeRun(is_labelled=False).write(tmp_path / "run"))
    assert (summary["distinct"], summary["consensus"]) == (None, None)
    assert all(drone["in_image_share"] is None and drone["animal"] is None for drone in summary["drones"])
    assert headline(summary)[0] is None


def test_a_damaged_log_shows_and_the_rest_stands(tmp_path: Path) -> None:
    folder = FakeRun(duration_s=12, monitor_s=(5, 10)).write(tmp_path / "run")
    log = folder / "drone_3.mcap"
    log.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    summary = summarise(folder)
    assert any(problem.startswith("drone 3:") for problem in summary["problems"])
    assert summary["drones"][0]["monitor_s"] > 4
    assert "not everything could be read: drone 3" in printed(summary)


def test_a_drone_without_a_log_has_no_figures_but_a_row(tmp_path: Path) -> None:
    folder = FakeRun(duration_s=12, monitor_s=(5, 10)).write(tmp_path / "run")
    (folder / "drone_1.mcap").unlink()
    row = summarise(folder)["drones"][0]
    assert (row["final_state"], row["tracker_hz"], row["animal"], row["monitor_s"]) == (None, None, None, 0)


def test_a_fleet_that_a_person_calls_home_is_told_by_what_it_reached_until_then(tmp_path: Path) -> None:
    run = FakeRun(called={drone: (20.0 + 0.2 * drone, Event.ORDER_RETURN) for drone in (1, 2, 3)})
    summary = summarise(run.write(tmp_path / "run"))
    assert summary["ordered"] == {"order": "return", "at_s": pytest.approx(20.6, abs=0.2)}
    assert headline(summary) == (
        True,
        "Each drone kept an animal of its own in view, and all agreed which animal is which, until a person "
        "called the fleet home at 21 s.",
    )


def test_a_fleet_that_is_called_down_before_it_watched_has_not_failed(tmp_path: Path) -> None:
    run = FakeRun(called=dict.fromkeys((1, 2, 3), (5.0, Event.ORDER_LAND)))
    summary = summarise(run.write(tmp_path / "run"))
    assert summary["monitor_window_s"] is None
    sentence = "A person made the fleet land at 5 s, before it watched its animals together."
    assert headline(summary) == (None, sentence)
    assert printed(summary).strip().startswith(f"? {sentence}")


def test_one_drone_that_is_called_home_excuses_no_other(tmp_path: Path) -> None:
    run = FakeRun(called={2: (20.0, Event.ORDER_RETURN)}, watch=lambda drone, t_s: 1 if drone == 3 else drone)
    summary = summarise(run.write(tmp_path / "run"))
    assert summary["ordered"] is None
    is_good, words = headline(summary)
    assert is_good is False
    assert words.startswith("The drones did not each keep")
    assert words.endswith(" A person called drone 2 home at 20 s.")


def row(state: State, event: Event | None = None) -> podwatch.mission_state_t:
    return make(podwatch.mission_state_t, state=int(state), reason=event.value if event else "")


def test_an_order_ends_a_flight_only_where_nobody_works_on() -> None:
    ordered = [(1.0, row(State.SCOUT)), (30.0, row(State.RETURN, Event.ORDER_RETURN))]
    follows = [(31.0, row(State.MONITOR)), (32.0, row(State.RETURN, Event.FLEET_RETURNS))]
    at_home = [(1.0, row(State.RETURN, Event.BATTERY_LOW)), (60.0, row(State.LANDED))]
    of_its_own = [(31.0, row(State.MONITOR)), (32.0, row(State.RETURN, Event.WATCHED))]
    anew = [*ordered, (90.0, row(State.TAKEOFF))]
    order = Order("return", 30.0)
    assert fleet_order({1: ordered, 2: follows, 3: at_home}) == order
    assert fleet_order({1: ordered, 2: [(20.0, row(State.MONITOR))]}) == order, "it died before"
    assert fleet_order({1: ordered, 2: of_its_own}) is None
    assert fleet_order({1: anew}) is None
    assert fleet_order({1: at_home}) is None


@pytest.mark.parametrize(
    ("nearest_m", "words"),
    [
        (5.0, "A person called the fleet home at 21 s, before the flight had done all that its file expects"),
        (1.0, "The flight fell short of what its file expects"),
    ],
)
def test_what_a_called_home_flight_did_not_reach_is_no_failure_but_its_safety_is(
    good: dict[str, Any], monkeypatch: pytest.MonkeyPatch, nearest_m: float, words: str
) -> None:
    monkeypatch.setattr(flight, "read_safety", lambda *_: Safety(nearest_m, (1, 2), 3.0, ()))
    mission = SimMission(expect=Expect(distinct=True, min_monitor_s=55.0))
    summary = good | {"ordered": {"order": "return", "at_s": 20.6}}
    out = StringIO()
    flight._print_expected(mission, Path(), summary, Console(file=out, width=200))
    assert out.getvalue().strip().startswith(words)
    assert "expected at least 55 s" in out.getvalue()
