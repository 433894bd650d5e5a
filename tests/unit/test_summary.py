"""summary.json has every figure that it promises, and people read the sentence that matters first."""

import json
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from tests.unit.fake_run import FakeRun
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
