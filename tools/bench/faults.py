"""`podwatch bench faults`: faults of one line, put into a copy of the checkout one by one. Each must turn the
test red that `tests/faults.toml` names (docs/faults.md).
"""

import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tools.bench import fault_notes

__all__ = ["Fault", "FaultsError", "Outcome", "command", "load", "measure"]

ROOT = Path(__file__).parents[2]
TABLE = "tests/faults.toml"
KEYS = ("name", "does", "file", "find", "put", "test")
GENERATED = ("lcmtypes/podwatch",)  # made by the build; git ignores it
RUN_LIMIT_S = 600
TIMEOUT = "Timeout"  # a test that ran out of time: on a busy machine that says nothing of the fault
SHOWN = 110  # characters of a failure's first line

RED, GREEN, NO_TEXT, NOT_RUN = "red", "GREEN", "NO TEXT", "NOT RUN"


class FaultsError(Exception):
    """The faults cannot be measured; the message says why and what to do."""


@dataclass(frozen=True)
class Fault:
    """One line of one file, made wrong. does: what that would do in the field. tests: those that turn red."""

    name: str
    does: str
    file: str
    find: str
    put: str
    tests: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """What became of one fault. said: the first line of the failure, or what was wrong with the run."""

    fault: Fault
    result: str
    said: str
    seconds: float


@dataclass(frozen=True)
class PytestRun:
    """One run of pytest in a copy."""

    code: int
    failures: list[tuple[str, str]]
    n_passed: int
    foreign: list[str]
    last_words: str


def load(path: Path) -> list[Fault]:
    """The faults of a table. Raises FaultsError naming what is wrong with it."""
    try:
        rows = tomllib.loads(path.read_text()).get("fault", [])
    except FileNotFoundError:
        raise FaultsError(f"{path}: not there; run this in a checkout of podwatch") from None
    except tomllib.TOMLDecodeError as error:
        raise FaultsError(f"{path}: not valid TOML ({error})") from error
    faults = []
    for number, row in enumerate(rows, 1):
        if sorted(row) != sorted(KEYS):
            raise FaultsError(f"{path}: fault {number} has {', '.join(row)}; each has {', '.join(KEYS)}")
        tests = row.pop("test")
        faults.append(Fault(**row, tests=tuple(tests) if isinstance(tests, list) else (tests,)))
    names = [fault.name for fault in faults]
    if not faults or len(set(names)) != len(names):
        raise FaultsError(f"{path}: {len(names)} faults of {len(set(names))} names; each needs its own")
    return faults


def copy_checkout(root: Path, copy: Path) -> None:
    """The working tree as it is, without what git ignores, but with what the build generated."""
    listing = ["git", "-C", str(root), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(listing, capture_output=True, text=True, check=False)
    if listed.returncode:
        raise FaultsError(f"{root}: {listed.stderr.strip()}; run this in a checkout of podwatch, with git")
    for name in dict.fromkeys(listed.stdout.split("\0")):
        source = root / name
        if name and source.is_file():  # a file that was deleted is listed still
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, copy / name)
    for name in GENERATED:
        if (root / name).is_dir():
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(root / name, copy / name, ignore=ignored, dirs_exist_ok=True)


def run_tests(copy: Path, tests: Sequence[str], *, to_first: bool) -> PytestRun:
    """Run some tests of a copy, with the copy's code before any that is installed."""
    notes, plugin = copy.parent / f"{copy.name}.json", copy.parent / "plugin"
    notes.unlink(missing_ok=True)
    environment = {
        **os.environ,
        "PYTHONPATH": f"{copy}{os.pathsep}{plugin}",
        # By its time in seconds and its size alone a compiled file may pass for that of a harmed line.
        "PYTHONDONTWRITEBYTECODE": "1",
        fault_notes.NOTES: str(notes),
    }
    words = [sys.executable, "-m", "pytest", "-p", "fault_notes", "-p", "no:cacheprovider", "-q"]
    words += [f"--rootdir={copy}", "--hypothesis-seed=0", *(["-x"] if to_first else [])]
    try:
        done = subprocess.run(
            [*words, *tests],
            cwd=copy,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=RUN_LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return PytestRun(-1, [], 0, [], f"nothing ended within {RUN_LIMIT_S} s")
    said: dict[str, Any] = {"failures": [], "n_passed": 0, "foreign": []}
    if notes.exists():
        said = json.loads(notes.read_text())
    lines = [line for line in done.stdout.decode(errors="replace").splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith(("ERROR", "E  "))] or lines[-1:]
    last_words = f"pytest ended with {done.returncode}: {' '.join(errors[:1])}"
    failures = [(test, why) for test, why in said["failures"]]
    return PytestRun(done.returncode, failures, said["n_passed"], said["foreign"], last_words)


def suffer(fault: Fault, copy: Path) -> Outcome:
    """Put one fault into a copy, run its tests, and take it out again."""
    began_s = time.monotonic()

    def outcome(result: str, said: str) -> Outcome:
        return Outcome(fault, result, said, time.monotonic() - began_s)

    path = copy / fault.file
    text = path.read_text() if path.is_file() else ""
    if text.count(fault.find) != 1:
        return outcome(NO_TEXT, f"its text occurs {text.count(fault.find)} times in {fault.file}, not once")
    path.write_text(text.replace(fault.find, fault.put))
    try:
        run = run_tests(copy, fault.tests, to_first=True)
    finally:
        path.write_text(text)
    if run.foreign:
        return outcome(NOT_RUN, f"not the copy's code was tested: {run.foreign[0]}")
    if run.code == 1 and run.failures and TIMEOUT not in run.failures[0][1]:
        return outcome(RED, run.failures[0][1])
    if run.code == 0 and run.n_passed:
        return outcome(GREEN, "")
    return outcome(NOT_RUN, run.failures[0][1] if run.failures else run.last_words)


@contextmanager
def copies(root: Path, count: int) -> Iterator[list[Path]]:
    """Copies of a checkout, side by side, and the plugin that they share; gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="podwatch-faults-") as name:
        folder = Path(name)
        (folder / "plugin").mkdir()
        shutil.copy(str(fault_notes.__file__), folder / "plugin" / "fault_notes.py")
        made = [folder / f"copy_{number}" for number in range(count)]
        for copy in made:
            copy.mkdir()
            copy_checkout(root, copy)
        yield made


def measure(root: Path, faults: Sequence[Fault], workers: int, tell: Callable[[str], None]) -> list[Outcome]:
    """What becomes of each fault, in their order; `tell` hears how far it is.

    Raises FaultsError where a test is not green without any fault.
    """
    workers = min(workers, len(faults))
    tell(f"copying the checkout, {workers} times")
    with copies(root, workers) as made:
        tests = list(dict.fromkeys(test for fault in faults for test in fault.tests))
        tell(f"the {len(tests)} tests without any fault")
        _check_unharmed(made[0], tests)
        idle: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for copy in made:
            idle.put(copy)

        def suffer_somewhere(fault: Fault) -> Outcome:
            copy = idle.get()
            try:
                return suffer(fault, copy)
            finally:
                idle.put(copy)

        pool = ThreadPoolExecutor(workers)
        try:
            waiting = {pool.submit(suffer_somewhere, fault): fault.name for fault in faults}
            outcomes: dict[str, Outcome] = {}
            tell(f"0 of {len(faults)} faults")
            for future in as_completed(waiting):
                done = outcomes[waiting[future]] = future.result()
                tell(f"{len(outcomes)} of {len(faults)} faults; {done.fault.name}: {done.result}")
        finally:
            pool.shutdown(cancel_futures=True)
    return [outcomes[fault.name] for fault in faults]


def _check_unharmed(copy: Path, tests: Sequence[str]) -> None:
    run = run_tests(copy, tests, to_first=False)
    if run.foreign:
        raise FaultsError(f"not the copy's code was tested, but {run.foreign[0]}; is PYTHONPATH overruled?")
    if run.code or not run.n_passed:
        told = "; ".join(f"{test}: {why}" for test, why in run.failures) or run.last_words
        raise FaultsError(f"without any fault not all tests are green, so red would say nothing: {told}")


def command(only: str, workers: int, out: Path) -> bool:
    """Measure, print the table, write bench_faults.json into `out` -> whether every fault was noticed.

    only: faults with this in their name. Raises FaultsError.
    """
    every = load(ROOT / TABLE)
    faults = [fault for fault in every if only.lower() in fault.name.lower()]
    if not faults:
        raise FaultsError(f"--only {only!r}: no such fault; there are: {', '.join(f.name for f in every)}")
    console = Console()
    with console.status("faults") as status:
        outcomes = measure(ROOT, faults, workers, lambda told: status.update(f"faults: {escape(told)}"))
    print_outcomes(outcomes, console)
    path = out / "bench_faults.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=2) + "\n")
    return all(outcome.result == RED for outcome in outcomes)


def print_outcomes(outcomes: Sequence[Outcome], console: Console) -> None:
    """The table, and how many were noticed."""
    table = Table(title="podwatch bench faults", title_justify="left")
    for heading in ("fault, and its file", "test, and the first line of its failure", "result"):
        table.add_column(heading, overflow="fold")
    table.add_column("s", justify="right")
    for outcome in outcomes:
        fault, colour = outcome.fault, "red" if outcome.result == RED else "bold yellow"
        said = outcome.said if len(outcome.said) <= SHOWN else f"{outcome.said[: SHOWN - 3]}..."
        tests = "\n".join(map(_short, fault.tests))
        table.add_row(
            f"{escape(fault.name)}\n[dim]{escape(fault.file)}[/]",
            f"{escape(tests)}\n[dim]{escape(said)}[/]",
            f"[{colour}]{outcome.result}[/]",
            f"{outcome.seconds:.1f}",
        )
    console.print(table)
    n_red = sum(outcome.result == RED for outcome in outcomes)
    console.print(f"{n_red} of {len(outcomes)} faults turn their test red", highlight=False)


def _short(test: str) -> str:
    """A test without its folder: test_ring.py::test_every_view."""
    return test.rpartition("/")[2]
