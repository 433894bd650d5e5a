"""The docs that are made from the code are the code's, and every link in the docs leads somewhere."""

import re
from pathlib import Path

import pytest

from drivers.sim.render.species import MORE_SPECIES, SPECIES
from tools.docs import PAGES
from tools.docs_mission import EXAMPLE, comments, mission_page, tables
from tools.sim.flight import read_mission
from tools.sim.settings import Expect, PodTable, SimMission

ROOT = Path(__file__).parents[2]
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("name", sorted(PAGES))
def test_a_made_page_is_what_the_tables_say(name: str) -> None:
    assert (ROOT / "docs" / name).read_text() == PAGES[name](), "run: python -m tools.docs"


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.name)
def test_every_local_link_leads_to_a_file(text: Path) -> None:
    links = re.findall(r"\]\((?!http)([^)#]+)", text.read_text())
    missing = [link for link in links if not (text.parent / link).exists()]
    assert not missing, f"{text.name} links to what is not there: {missing}"


def test_the_mission_page_has_every_table_and_says_of_every_key_what_it_is() -> None:
    page = mission_page("")
    every = tables(SimMission)
    assert {"pod", "drones.machine.drivers.NAME", "faults", "expect"} < {table.place for table in every}
    within = {table.place.removesuffix(".NAME").split(".")[-1] for table in every}
    for title, model in [("# The mission file", SimMission), *((t.title, t.model) for t in every)]:
        assert title in page
        said = comments(model)
        for key in model.model_fields:
            assert f"| `{key}` |" in page or key in within, key
            assert said[key] or key in within, f"{model.__name__}.{key}: a comment beside it says what it is"


def test_a_key_is_told_with_its_unit_bounds_and_default() -> None:
    page = mission_page("")
    for row in (
        "| `bytes_per_s` | whole number, 1500 to 1000000 bytes/s | 6000 | cap for each link,",
        "| `vfov_deg` | number, above 10, below 150 degrees | 60 | vertical field of view, as calibrated |",
        '| `surface` | `"sea"` or `"grass"` | `"sea"` |',
        "| `id` | whole number, 1 to 99 | needed |",
        "| `distinct` | true or false |  |",
        "| `between` | [whole number, whole number] | `[1, 2]` |",
    ):
        assert f"\n{row}" in page


def test_the_example_of_the_mission_page_is_a_mission(tmp_path: Path) -> None:
    path = tmp_path / "my_mission.toml"
    path.write_text(EXAMPLE)
    mission = read_mission(str(path))
    assert mission.roster == (1, 2)
    assert mission.faults[0].kind == "dive"
    assert mission.expect != Expect()


def test_the_mission_page_names_every_species_that_can_be_drawn() -> None:
    words = comments(PodTable)["species"]
    assert set(re.findall(r"\w+", words)) - {"or"} == {*SPECIES, *MORE_SPECIES}


def test_no_cited_fact_of_the_autopilot_leads_nowhere() -> None:
    told = set(re.findall(r"^\| (\d+) \|", (ROOT / "docs" / "autopilot_facts.md").read_text(), re.MULTILINE))
    folders = [ROOT / name for name in ("procs", "drivers")]
    sources = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    cited = re.findall(r"\((\d+)\)", (ROOT / "docs" / "autopilot.md").read_text())
    for path in sources:
        text = path.read_text()
        assert "shared/AUTOPILOT" not in text, f"{path}: name docs/autopilot_facts.md"
        for numbers in re.findall(r"(?:\bfacts?|autopilot_facts\.md,)\s+(\d+(?:(?:,| and)\s\d+)*)", text):
            cited += re.findall(r"\d+", numbers)
    assert len(cited) > 30
    assert sorted(set(cited) - told) == []
