"""What a scenario expects, held against summaries and truths worked by hand."""

import re
from typing import Any

import pytest

from lcmtypes import make
from lcmtypes.podwatch import world_drone_t, world_state_t
from procs.settings import LimitSettings
from tools.sim.expect import Safety, check, flown_safely
from tools.sim.settings import Expect

LIMITS = LimitSettings(min_height_m=10, max_height_m=50, fence_radius_m=100)
SAFE = Safety(5.0, (1, 2), 10.0, ())


def drone(drone_id: int, **changes: Any) -> dict[str, Any]:
    """One drone's row of a summary in which all went well."""
    row = {"id": drone_id, "assigned": True, "final_state": "LANDED", "died_s": None}
    return row | {"monitor_s": 30.0, "in_image_share": 1.0} | changes


def summary(*drones: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A summary in which all went well, but for `changes`."""
    row = {"distinct": True, "consensus": True, "reasons": [], "episodes": 1, "seconds_to_monitor": 60.0}
    return row | {"drones": list(drones) or [drone(1), drone(2)]} | changes


def test_a_run_that_does_all_that_is_asked_falls_short_of_nothing():
    asked = Expect(
        distinct=True,
        consensus=True,
        drones_in_monitor=2,
        drones_standing_by=0,
        all_landed=True,
        min_monitor_s=30.0,
        min_in_image_share=1.0,
        max_seconds_to_monitor=60.0,
        min_episodes=1,
    )
    assert check(asked, summary(), SAFE) == []


@pytest.mark.parametrize(
    ("asked", "run", "words"),
    [
        ({"distinct": True}, summary(distinct=False, reasons=["both watch 3"]), "is False.*both watch 3"),
        ({"distinct": True}, summary(distinct=None), "distinct is None"),
        ({"consensus": False}, summary(), "consensus is True, expected False"),
        ({"drones_in_monitor": 2}, summary(drone(1), drone(2, monitor_s=0)), r"drones \[1\] came to MONITOR"),
        ({"drones_standing_by": 1}, summary(), r"drones \[\] stood by"),
        ({"all_landed": True}, summary(drone(1, final_state="RETURN")), "drone 1 ended in RETURN"),
        ({"min_monitor_s": 31}, summary(), "monitor_s of drone 1 is 30.0, expected at least 31 s"),
        ({"min_in_image_share": 0.9}, summary(drone(1, in_image_share=None)), "share of drone 1 is None"),
        ({"max_seconds_to_monitor": 59}, summary(), "after 60.0 s, expected within 59 s"),
        ({"max_seconds_to_monitor": 59}, summary(seconds_to_monitor=None), "after None s"),
        ({"min_episodes": 2}, summary(), "1 episodes, expected at least 2"),
    ],
)  # fmt: skip
def test_what_falls_short_is_said_with_its_value(asked, run, words):
    short = check(Expect(**asked), run, SAFE)
    assert any(re.search(words, one) for one in short), short


def test_a_drone_that_died_is_asked_for_nothing():
    asked = Expect(drones_in_monitor=1, all_landed=True, min_monitor_s=20.0)
    dead = drone(2, died_s=40.0, final_state="DEAD", monitor_s=5.0)
    assert check(asked, summary(drone(1), dead), SAFE) == []


def test_what_is_not_asked_is_not_checked():
    wreck = summary(drone(1, final_state="HOLD", monitor_s=0, in_image_share=None), distinct=False)
    assert check(Expect(), wreck, SAFE) == []


def test_safety_is_asked_of_every_scenario():
    assert check(Expect(), summary(), Safety(2.9, (1, 2), 10.0, ())) == [
        "nearest were drones 1 and 2: 2.9 m at 10.0 s, expected at least 3 m"
    ]
    assert check(Expect(), summary(), Safety(None, None, None, ("too high",))) == ["too high"]


def states(
    *instants: dict[int, tuple[float, float, float]], dead: tuple[int, ...] = ()
) -> list[world_state_t]:
    """One state of the world a second: drone -> (north, east, height) m."""
    return [
        make(
            world_state_t,
            utime=round(index * 1e6),
            n_drones=len(places),
            drones=[
                make(world_drone_t, id=key, alive=key not in dead, n_m=n_m, e_m=e_m, d_m=-up_m)
                for key, (n_m, e_m, up_m) in places.items()
            ],
        )
        for index, places in enumerate(instants)
    ]


def test_the_nearest_pass_is_found_in_three_dimensions():
    said = flown_safely(
        states(
            {1: (0, 0, 20), 2: (10, 0, 20)}, {1: (0, 0, 20), 2: (3, 0, 24)}, {1: (0, 0, 20), 2: (9, 0, 20)}
        ),
        LIMITS,
    )
    assert (said.nearest_m, said.nearest, said.nearest_s) == (5.0, (1, 2), 1.0)
    assert said.breaches == ()


@pytest.mark.parametrize(
    ("second", "dead"), [((1.0, 0.0, 0.5), ()), ((1.0, 0.0, 20.0), (2,))], ids=["on the ground", "dead"]
)
def test_only_living_drones_in_the_air_can_come_too_near(second, dead):
    said = flown_safely(states({1: (0, 0, 20), 2: second}, dead=dead), LIMITS)
    assert said.nearest is None
    assert str(said) == "no two drones were in the air at once"


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ([(0, 0, 5), (0, 0, 30), (0, 0, 5)], None),
        ([(0, 0, 20), (0, 104, 20), (0, 0, 20)], "104.0 m from the origin at 1.0 s.*fence_radius_m is 100"),
        ([(0, 0, 20), (0, 0, 54), (0, 0, 20)], "drone 1 was 54.0 m high at 1.0 s; limits.max_height_m is 50"),
        ([(0, 0, 5), (0, 0, 20), (0, 0, 6), (0, 0, 20)], "6.0 m high at 2.0 s; limits.min_height_m is 10"),
    ],
    ids=["up and down again", "beyond the fence", "too high", "too low on the way"],
)  # fmt: skip
def test_a_limit_that_is_truly_passed_is_said(path, words):
    breaches = flown_safely(states(*({1: place} for place in path)), LIMITS).breaches
    assert (words is None and breaches == ()) or re.search(words, breaches[0])
