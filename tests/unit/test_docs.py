"""The docs that are made from the code are the code's, and every link in the docs leads somewhere."""

import re
from pathlib import Path

import pytest

from tools.docs import PAGES

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
