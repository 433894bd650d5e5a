"""The table of faults fits the code as it is, and the machinery that measures them tells red from green."""

import ast
import io
import subprocess
from pathlib import Path

import pytest
from rich.console import Console

from tools.bench.faults import (
    GREEN,
    NO_TEXT,
    NOT_RUN,
    RED,
    ROOT,
    TABLE,
    Fault,
    FaultsError,
    load,
    measure,
    print_outcomes,
)

FAULTS = load(ROOT / TABLE)
by_name = pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)


@by_name
def test_a_faults_text_occurs_once_and_what_takes_its_place_is_code(fault: Fault) -> None:
    text = (ROOT / fault.file).read_text()
    assert text.count(fault.find) == 1, f"{fault.file} has changed: mend `find` in {TABLE}"
    harmed = text.replace(fault.find, fault.put)
    compile(harmed, fault.file, "exec")  # a file that does not compile turns every test red
    assert ast.dump(ast.parse(harmed)) != ast.dump(ast.parse(text))
    assert abs(harmed.count("\n") - text.count("\n")) <= 1


@by_name
def test_a_faults_tests_are_there(fault: Fault) -> None:
    assert fault.tests
    for test in fault.tests:
        file, _, name = test.partition("::")
        functions = ast.parse((ROOT / file).read_text()).body
        assert name.partition("[")[0] in {one.name for one in functions if isinstance(one, ast.FunctionDef)}
        assert not name.partition("[")[0] or name.startswith("test_")


def test_the_faults_are_many_and_lie_all_over_the_system() -> None:
    assert len(FAULTS) >= 20
    processes = {Path(fault.file).parts[1] for fault in FAULTS if fault.file.startswith("procs/")}
    assert processes >= {"assigner", "autopilot", "detector", "logger", "navigator", "registrar", "relay"}
    assert {Path(fault.file).parts[0] for fault in FAULTS} >= {"logs", "procs", "tools"}
    assert all(fault.does.endswith(".") for fault in FAULTS)


def test_the_page_tells_every_fault() -> None:
    page = (ROOT / "docs" / "faults.md").read_text()
    assert [fault.name for fault in FAULTS if f"| {fault.name} |" not in page] == []


SETTINGS = '[tool.pytest.ini_options]\naddopts = "--import-mode=importlib"\n'
CODE = "def double(x: int) -> int:\n    return 2 * x\n\n\ndef half(x: int) -> int:\n    return x // 2\n"
TESTS = """
from sums import double, half

def test_double():
    assert double(3) == 6, "three twice"

def test_half():
    assert half(2) == 1
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A checkout of two functions, each with its test."""
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    (tmp_path / "sums").mkdir()
    (tmp_path / "sums" / "__init__.py").write_text(CODE)
    (tmp_path / "test_sums.py").write_text(TESTS)
    (tmp_path / "pyproject.toml").write_text(
        '[tool.pytest.ini_options]\naddopts = "--import-mode=importlib"\n'
    )
    return tmp_path


def fault(find: str, put: str, test: str) -> Fault:
    return Fault(find, "It does harm.", "sums/__init__.py", find, put, (f"test_sums.py::{test}",))


def test_a_fault_is_red_green_without_its_text_or_not_run(project: Path) -> None:
    told: list[str] = []
    faults = [
        fault("2 * x", "3 * x", "test_double"),
        fault("x // 2", "x // 2 + 0", "test_half"),
        fault("x", "y", "test_half"),
        fault("z", "y", "test_half"),
        fault("def half", "def hulf", "test_half"),
    ]
    outcomes = measure(project, faults, 2, told.append)
    assert [outcome.fault for outcome in outcomes] == faults
    assert [outcome.result for outcome in outcomes] == [RED, GREEN, NO_TEXT, NO_TEXT, NOT_RUN]
    assert outcomes[0].said == "AssertionError: three twice"
    assert "occurs 4 times in sums/__init__.py, not once" in outcomes[2].said
    assert "occurs 0 times" in outcomes[3].said
    assert "pytest ended with" in outcomes[4].said
    assert told[-1].startswith("5 of 5 faults")
    assert (project / "sums" / "__init__.py").read_text() == CODE

    written = io.StringIO()
    print_outcomes(outcomes, Console(file=written, width=200))
    shown = written.getvalue()
    assert "1 of 5 faults turn their test red" in shown
    assert "test_sums.py::test_double" in shown


def test_where_a_test_is_red_without_any_fault_nothing_is_measured(project: Path) -> None:
    (project / "test_sums.py").write_text(TESTS.replace("== 6", "== 7"))
    with pytest.raises(FaultsError, match=r"test_sums.py::test_double: AssertionError: three twice"):
        measure(project, [fault("2 * x", "3 * x", "test_double")], 1, lambda _: None)


def test_other_code_than_the_copys_is_noticed(
    project: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    elsewhere = tmp_path_factory.mktemp("installed")
    (elsewhere / "sums.py").write_text(CODE)
    (project / "conftest.py").write_text(f"import sys\nsys.path.insert(0, {str(elsewhere)!r})\n")
    with pytest.raises(FaultsError, match=r"not the copy's code was tested, but .*installed.*sums.py"):
        measure(project, [fault("2 * x", "3 * x", "test_double")], 1, lambda _: None)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[[fault]\n", "not valid TOML"),
        ("", "0 faults"),
        ('[[fault]]\nname = "one"\n', "fault 1 has name; each has name, does, file, find, put, test"),
        (2 * '[[fault]]\nname="a"\ndoes="b"\nfile="c"\nfind="d"\nput="e"\ntest="f"\n', "2 faults of 1 names"),
    ],
)
def test_a_table_that_is_none_is_told(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "faults.toml"
    path.write_text(text)
    with pytest.raises(FaultsError, match=why):
        load(path)
    with pytest.raises(FaultsError, match="run this in a checkout"):
        load(tmp_path / "none.toml")
