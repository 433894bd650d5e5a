"""The mission's table of steps: complete, free of contradictions, and drawn in the docs as it is."""

from pathlib import Path

import pytest

from procs.navigator.states import AT_WORK, FLYING, RULES, Event, State, diagram, next_state

DOCS = Path(__file__).parents[2] / "docs" / "navigator.md"


def test_no_state_and_event_lead_to_two_places() -> None:
    pairs = [(source, rule.event) for rule in RULES for source in rule.sources]
    assert len(pairs) == len(set(pairs))


def test_every_event_is_used_and_every_state_can_be_reached_and_left() -> None:
    assert {rule.event for rule in RULES} == set(Event)
    assert {rule.target for rule in RULES} == set(State)
    reached = {State.IDLE}
    for _ in State:
        reached |= {rule.target for rule in RULES if reached & set(rule.sources)}
    assert reached == set(State)
    assert {source for rule in RULES for source in rule.sources} == set(State)


def test_what_the_table_does_not_name_changes_nothing() -> None:
    assert next_state(State.IDLE, Event.CERTIFIED) is None
    assert next_state(State.LANDED, Event.DOUBT) is None
    assert next_state(State.LAND, Event.BATTERY_LOW) is None


@pytest.mark.parametrize("state", FLYING)
def test_doubt_the_pilot_and_an_empty_battery_reach_every_flying_state(state: State) -> None:
    assert next_state(state, Event.DOUBT) == State.HOLD
    assert next_state(state, Event.PILOT) == State.HOLD
    assert next_state(state, Event.BATTERY_EMPTY) == State.LAND


@pytest.mark.parametrize("state", [state for state in State if state not in (State.IDLE, State.LANDED)])
def test_nothing_takes_off_in_flight(state: State) -> None:
    assert State.TAKEOFF not in [next_state(state, event) for event in Event]


def test_the_docs_show_the_table_as_it_is() -> None:
    assert f"```mermaid\n{diagram()}```" in DOCS.read_text(), "docs/navigator.md: paste states.diagram() anew"


def test_the_diagram_draws_each_rule() -> None:
    text = diagram()
    assert f"    AT_WORK --> RETURN : {Event.BATTERY_LOW.value}\n" in text
    assert f"    IDLE --> TAKEOFF : {Event.START.value}\n" in text
    grouped = sum(1 for rule in RULES if rule.sources in (FLYING, AT_WORK))
    single = sum(len(rule.sources) for rule in RULES if rule.sources not in (FLYING, AT_WORK))
    assert text.count("-->") == grouped + single + 1
