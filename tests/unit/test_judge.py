"""The judge says no where two drones swap, share or mislabel an animal, and yes only where all is right."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tests.unit.fake_run import CAMERA, FakeRun
from tools.evidence import Clock, EvidenceError, Truth, load_run
from tools.judge import Verdict, judge
from tools.sights import NOBODY, Span, in_image_share, state_spans


def verdict(run: FakeRun) -> Verdict:
    return judge(run.truth(), run.logs())


def test_a_fleet_over_different_animals_with_one_set_of_names_is_right() -> None:
    result = verdict(FakeRun())
    assert result.distinct is True
    assert result.consensus is True
    assert [drone.animal for drone in result.drones] == [1, 2, 3]
    assert [drone.identity for drone in result.drones] == [11, 12, 13]
    assert result.monitor_window_s == pytest.approx((10, 35), abs=0.3)
    assert result.seconds_to_monitor == pytest.approx(10, abs=0.3)
    assert result.distinct_share == pytest.approx(1, abs=0.02)
    assert all(drone.in_image_share == 1 for drone in result.drones)
    assert result.episodes == 1
    assert "drone 2 over animal 2" in result.reasons[0]


def test_two_drones_that_share_an_animal_are_not_distinct() -> None:
    result = verdict(FakeRun(watch=lambda drone, t_s: 1 if drone == 3 and t_s > 21.3 else drone))
    assert result.distinct is False
    assert any(
        reason.startswith("drones 1 and 3 both watch animal 1 from 21.") for reason in result.reasons
    ), result.reasons


def test_an_animal_is_in_the_picture_while_it_swims_through_it() -> None:
    """A level camera 30 m up sees 30 tan(30 degrees) = 17.3 m to the front and back, of 40 m each way that it
    swims.
    """
    t_s = np.linspace(0, 8, 1601)
    here = np.tile([0.0, 0, -30, 0, 0, 0], (len(t_s), 1))
    swims = np.stack([10 * t_s - 40, 0 * t_s, 0 * t_s + 10, 0 * t_s], axis=1)
    truth = Truth(CAMERA, t_s, {1: here}, {7: swims})
    sights = np.array([3.0, 4.0, 5.0])
    share = in_image_share(truth, 1, [(0.0, 8.0)], sights, np.array([7, 7, NOBODY]))
    assert share == pytest.approx(2 * 30 * np.tan(np.radians(30)) / 80, abs=0.002)
    assert in_image_share(truth, 1, [(0.0, 8.0)], sights, np.array([NOBODY, NOBODY, 7])) == 0
    assert in_image_share(truth, 1, [], sights, np.array([7, 7, 7])) is None


def test_names_that_two_drones_swap_are_no_consensus() -> None:
    swapped = {1: 12, 2: 11}
    run = FakeRun(
        name=lambda drone, animal, t_s: swapped.get(animal, animal + 10) if drone == 2 else animal + 10
    )
    result = verdict(run)
    assert result.distinct is True
    assert result.consensus is False
    assert any(
        reason == "identity 11 is not one animal: animal 1 for drones 1 and 3, animal 2 for drone 2"
        for reason in result.reasons
    ), result.reasons


def test_one_drone_that_mislabels_one_animal_is_no_consensus() -> None:
    run = FakeRun(name=lambda drone, animal, t_s: 99 if (drone, animal) == (3, 3) else animal + 10)
    result = verdict(run)
    assert result.consensus is False
    assert any("animal 3 has 2 identities: 13 by drones 1 and 2, 99 by drone 3" in r for r in result.reasons)


def test_labels_that_match_without_a_claimed_consensus_do_not_count() -> None:
    result = verdict(FakeRun(claims=(1, 3)))
    assert result.distinct is True
    assert result.consensus is False
    assert result.reasons == ("drone 2 holds no consensus: its newest episode is 1 by drone 1",)


@pytest.mark.parametrize(("stray_every", "agreed"), [(60, True), (8, False)])
def test_stray_names_are_tolerated_below_a_twentieth(stray_every: int, agreed: bool) -> None:
    def name(drone: int, animal: int, t_s: float) -> int:
        is_stray = drone == 2 and round(t_s * 2.5) % stray_every == 0
        return 10 + (animal % 5) + 1 if is_stray else animal + 10

    result = verdict(FakeRun(name=name))
    assert result.consensus is agreed
    assert any("of its names on another animal" in reason for reason in result.reasons) is not agreed


def test_a_drone_that_drifts_off_its_animal_watches_nothing() -> None:
    result = verdict(FakeRun(aim_off_m=lambda drone, t_s: 8.0 if drone == 2 and t_s > 25 else 0.0))
    assert result.distinct is False
    assert "drone 2 watches no animal at the end of the window (35.1 s)" in result.reasons
    assert any("worst" in reason or "of the window" in reason for reason in result.reasons)


def test_a_short_slip_in_mid_window_is_forgiven_and_a_long_one_is_not() -> None:
    slip = FakeRun(aim_off_m=lambda drone, t_s: 8.0 if drone == 2 and 20 < t_s < 21.5 else 0.0)
    assert verdict(slip).distinct is True
    long = FakeRun(aim_off_m=lambda drone, t_s: 8.0 if drone == 2 and 20 < t_s < 25 else 0.0)
    result = verdict(long)
    assert result.distinct is False
    assert "worst is drone 2" in result.reasons[-1]


def test_a_track_within_six_tenths_of_a_length_counts_and_beyond_does_not() -> None:
    assert verdict(FakeRun(aim_off_m=lambda drone, t_s: 5.8)).distinct is True
    assert verdict(FakeRun(aim_off_m=lambda drone, t_s: 6.2)).distinct is False


def test_a_drone_that_says_one_name_and_watches_another_animal_is_no_consensus() -> None:
    run = FakeRun()
    logs = run.logs()
    logs[0] = dataclasses.replace(logs[0], track_ids=np.full_like(logs[0].track_ids, 14))
    result = judge(run.truth(), logs)
    assert result.distinct is True
    assert result.reasons == (
        "drone 1 says that it watches identity 14, which is animal 4, but it watches animal 1",
    )


def test_a_drone_that_never_named_its_animal_is_no_consensus() -> None:
    run = FakeRun(name=lambda drone, animal, t_s: -1 if (drone, animal) == (2, 2) else animal + 10)
    assert "drone 2 watches animal 2 but never named it" in verdict(run).reasons


def test_one_drone_alone_needs_no_ring_to_agree() -> None:
    result = verdict(FakeRun(n_drones=1, claims=()))
    assert (result.distinct, result.consensus) == (True, True)
    doubled = FakeRun(n_drones=1, name=lambda drone, animal, t_s: 11)
    assert verdict(doubled).consensus is False


def test_more_drones_than_animals_stand_by_and_that_is_success() -> None:
    result = verdict(FakeRun(n_drones=4, n_animals=3, standby=(4,)))
    assert (result.distinct, result.consensus) == (True, True)
    assert [drone.is_assigned for drone in result.drones] == [True, True, True, False]


def test_a_drone_that_stands_by_while_animals_are_left_is_a_failure() -> None:
    result = verdict(FakeRun(n_drones=3, n_animals=5, standby=(3,)))
    assert result.distinct is False
    assert "only 2 of 3 living drones took an animal, though there were 5" in result.reasons


def test_a_drone_that_dies_in_monitor_leaves_the_rest_to_be_judged() -> None:
    result = verdict(FakeRun(deaths={2: 20.0}))
    assert (result.distinct, result.consensus) == (True, True)
    assert result.monitor_window_s == pytest.approx((10, 35), abs=0.3)
    assert "drone 2" not in result.reasons[0]


def test_an_animal_that_dives_cannot_be_watched_and_is_not_held_against_the_fleet() -> None:
    def dive(animal: int, t_s: float) -> float:
        return 10.0 if 15 < t_s < 25 else 0.0

    def off(drone: int, t_s: float) -> float:
        return 9.0 if 15 < t_s < 25 else 0.0

    assert verdict(FakeRun(dive=dive, aim_off_m=off)).distinct is True
    assert verdict(FakeRun(aim_off_m=off)).distinct is False


def test_a_drone_that_never_comes_to_monitor_leaves_no_window() -> None:
    run = FakeRun()
    logs = run.logs()
    logs[2] = dataclasses.replace(
        logs[2], states=tuple((t_s, "ASSIGN" if name == "MONITOR" else name) for t_s, name in logs[2].states)
    )
    result = judge(run.truth(), logs)
    assert result.monitor_window_s is None
    assert (result.distinct, result.consensus) == (False, False)
    assert result.reasons == ("drone 3 had an animal to watch but never came to MONITOR",)


def test_a_drone_that_gave_its_animal_up_on_its_way_home_was_to_watch_it_all_the_same() -> None:
    run = FakeRun()
    logs = run.logs()
    states = tuple((t_s, "ASSIGN" if name == "MONITOR" else name) for t_s, name in logs[2].states)
    home_s = max(t_s for t_s, name in states if name == "ASSIGN")
    assert any(t_s > home_s for t_s, _ in states), "it goes home"
    words = [word for word in logs[2].assignments if word[0] <= home_s]
    logs[2] = dataclasses.replace(logs[2], states=states, assignments=(*words, (home_s + 0.5, -1)))
    assert judge(run.truth(), logs).reasons == ("drone 3 had an animal to watch but never came to MONITOR",)


def test_a_fleet_that_finds_nothing_is_told_how_each_drone_ended() -> None:
    run = FakeRun()
    logs = [dataclasses.replace(log, states=log.states[:10], assignments=(), labels=()) for log in run.logs()]
    result = judge(dataclasses.replace(run.truth(), deaths={3: 4.0}), logs)
    assert result.reasons == (
        "no drone ever came to MONITOR: drone 1 ended in SCOUT, drone 2 ended in STANDBY, "
        "drone 3 died at 4.0 s",
    )


def test_without_labels_nothing_is_claimed() -> None:
    result = verdict(FakeRun(is_labelled=False))
    assert (result.distinct, result.consensus) == (None, None)
    assert result.monitor_window_s is not None


def test_the_longest_common_time_in_monitor_is_the_window() -> None:
    run = FakeRun()
    logs = run.logs()
    logs[1] = dataclasses.replace(
        logs[1], states=tuple((t, "HOLD" if 14 < t < 16 else name) for t, name in logs[1].states)
    )
    result = judge(run.truth(), logs)
    assert result.monitor_window_s == pytest.approx((16, 35), abs=0.3)
    assert result.seconds_to_monitor == pytest.approx(10, abs=0.3)


def test_the_judge_does_not_change_its_inputs_and_repeats_itself() -> None:
    run = FakeRun(watch=lambda drone, t_s: 1 if drone == 3 and t_s > 20 else drone)
    truth, logs = run.truth(), run.logs()
    assert judge(truth, logs) == judge(truth, logs)


def test_states_that_fall_silent_end() -> None:
    states = [(0.0, "MONITOR"), (0.2, "MONITOR"), (10.0, "MONITOR"), (10.2, "RETURN"), (10.4, "RETURN")]
    assert state_spans(states) == [
        Span(0.0, 3.2, "MONITOR"),
        Span(10.0, 10.2, "MONITOR"),
        Span(10.2, 10.4, "RETURN"),
    ]


def test_a_run_on_disk_is_judged_like_one_in_memory_whatever_the_drones_clocks(tmp_path: Path) -> None:
    run = FakeRun(clocks={1: Clock(5e6, 40.0), 2: Clock(3.2e6, -35.0), 3: Clock(1.1e6, 0.0)})
    loaded = load_run(run.write(tmp_path / "run"))
    from_disk, in_memory = judge(loaded.truth, loaded.drones), verdict(run)
    assert loaded.problems == ()
    assert (from_disk.distinct, from_disk.consensus) == (True, True)
    assert from_disk.monitor_window_s == pytest.approx(in_memory.monitor_window_s, abs=1e-5)


def test_an_offset_that_is_off_by_three_seconds_moves_what_is_judged_by_three_seconds(tmp_path: Path) -> None:
    folder = FakeRun(clocks={2: Clock(6e6)}).write(tmp_path / "run")
    about = folder / "truth.json"
    about.write_text(about.read_text().replace("6000000.0", "3000000.0"))
    loaded = load_run(folder)
    result = judge(loaded.truth, loaded.drones)
    assert result.seconds_to_monitor == pytest.approx(13.1, abs=0.01)
    assert result.consensus is False  # its sights no longer fall on the animals that swim


def test_a_missing_or_broken_truth_is_named(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match=r"truth\.json: cannot be read"):
        load_run(tmp_path)
    folder = FakeRun(duration_s=12, monitor_s=(5, 10)).write(tmp_path / "run")
    (folder / "truth.mcap").write_bytes(b"")
    with pytest.raises(EvidenceError, match="nothing can be judged"):
        load_run(folder)


def test_a_log_that_is_missing_is_a_problem_and_not_the_end(tmp_path: Path) -> None:
    folder = FakeRun(duration_s=12, monitor_s=(5, 10)).write(tmp_path / "run")
    (folder / "drone_2.mcap").unlink()
    loaded = load_run(folder)
    assert len(loaded.problems) == 1
    assert "drone 2" in loaded.problems[0]
    result = judge(loaded.truth, loaded.drones)
    assert "only 2 of 3 living drones took an animal, though there were 5" in result.reasons
