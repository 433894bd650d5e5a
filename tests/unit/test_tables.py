"""Each fact in one place: the channel table, the process table, the types, and who may import whom."""

import ast
import importlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from lcmtypes import channels, podwatch
from procs import processes
from procs.main import EXIT_CANNOT_START
from procs.processes import Restart
from tools.supervision import configuration, program

ROOT = Path(__file__).parents[2]
PACKAGES = ("lcmtypes", "procs", "drivers", "logs", "tools", "models", "fleets")
# Who may import whom: imports run one way.
MAY_IMPORT = {
    "lcmtypes": (),
    "models": (),
    "fleets": (),
    "drivers": ("lcmtypes",),
    "logs": ("lcmtypes",),
    "procs": ("lcmtypes", "drivers", "logs", "models"),
    "tools": ("lcmtypes", "drivers", "logs", "models", "fleets", "procs"),
}
CHANNEL_NAME_LIMIT_BYTES = 63
LONGEST_ID = 99
WORLD = {"world": ("-m", "tools.sim.world_process")}
# Files that speak MAVLink, which has a message of that name too.
MAVLINK_NAMES = {"HEARTBEAT"}


@cache
def sources() -> dict[Path, ast.Module]:
    """Every Python file of the packages, parsed; the generated classes left out."""
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    generated = ROOT / "lcmtypes" / "podwatch"
    return {
        path.relative_to(ROOT): ast.parse(path.read_text()) for path in paths if generated not in path.parents
    }


def imported(tree: ast.Module) -> Iterator[str]:
    """Dotted names that a file imports, within functions too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def spelled(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """(text, line) of every string literal that is no docstring."""
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value, node.lineno


def test_no_file_but_the_table_spells_a_channels_name():
    names = set(channels.BY_NAME)
    found = []
    for path, tree in sources().items():
        if path == Path("lcmtypes/channels.py"):
            continue
        speaks_mavlink = any("mavlink" in name for name in imported(tree)) or "autopilot" in str(path)
        allowed = MAVLINK_NAMES if speaks_mavlink else set()
        found += [
            f"{path}:{line}: {text!r}"
            for text, line in spelled(tree)
            if (text in names - allowed) or text.startswith("RX_")
        ]
    assert found == [], "name channels by lcmtypes.channels"


def test_imports_run_one_way():
    found = []
    for path, tree in sources().items():
        package = path.parts[0]
        for name in imported(tree):
            other = name.split(".")[0]
            if other in PACKAGES and other != package and other not in MAY_IMPORT[package]:
                found.append(f"{path}: {name}")
    assert found == []


def test_nothing_that_flies_knows_of_the_simulator():
    """Neither by import nor by a driver named in a string: procs/ never branches on the mode."""
    word = re.compile(r"lockstep|truth|virtual_clock|\btwin\b|drivers\.sim|drivers/sim", re.IGNORECASE)
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in sorted((ROOT / "procs").rglob("*.py"))
        for number, line in enumerate(path.read_text().splitlines(), start=1)
        if word.search(line)
    ]
    assert found == []
    for path, tree in sources().items():
        if path.parts[0] == "procs" or (path.parts[0] == "drivers" and path.parts[1] != "sim"):
            assert not [name for name in imported(tree) if name.startswith("drivers.sim")], path


def test_no_drone_hears_the_worlds_channels():
    on_a_drone = {channel.name for channel in channels.CHANNELS}
    assert on_a_drone.isdisjoint(channel.name for channel in channels.WORLD_CHANNELS)
    for path, tree in sources().items():
        if path.parts[0] == "procs":
            names = [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
            assert "WORLD_STATE" not in names, path


@pytest.mark.parametrize("process", processes.PROCESSES, ids=lambda process: process.name)
def test_each_process_of_the_table_is_a_module_with_its_page_and_its_setup(process):
    module = importlib.import_module(process.module)
    assert callable(module.setup)
    page = module.__doc__
    assert page is not None
    assert re.search(r"\b(Hears|In:)", page), "what it hears"
    assert re.search(r"\b(Says?|Out:)", page), "what it says"
    assert process.compute_s > 0
    assert process.heartbeat_limit_s > 1.0, "it beats at 1 Hz"


def test_names_of_channels_and_processes_are_unique():
    elsewhere = (*channels.WORLD_CHANNELS, *channels.LOG_CHANNELS)
    assert len(channels.BY_NAME) == len(channels.CHANNELS) + len(elsewhere)
    assert len(processes.BY_NAME) == len(processes.PROCESSES)
    constants = {name for name in vars(channels) if name.isupper() and name in channels.BY_NAME}
    assert constants == set(channels.BY_NAME)
    assert all(vars(channels)[name] == name for name in constants)


@pytest.mark.parametrize("name", sorted(channels.BY_NAME))
def test_a_channels_name_is_upper_snake_and_fits_lcm_as_a_neighbours_copy_too(name):
    assert re.fullmatch(r"[A-Z]+(_[A-Z]+)*", name)
    copy = channels.received(LONGEST_ID, name)
    assert len(copy.encode()) <= CHANNEL_NAME_LIMIT_BYTES
    assert channels.split_received(copy) == (LONGEST_ID, name)
    assert channels.kind_of(copy) is channels.kind_of(name) is channels.BY_NAME[name].kind


@pytest.mark.parametrize(
    "name", ["", "RX_", "RX_2", "RX_2_", "RX_2_NOWHERE", "RX_x_TRACK", "RX__TRACK", "track"]
)
def test_what_is_no_channel_has_no_type(name):
    assert channels.kind_of(name) is None
    assert channels.split_received(name) is None


@pytest.mark.parametrize("name", sorted(channels.BY_NAME))
def test_every_message_begins_with_utime_and_seq(name):
    members = members_of(channels.BY_NAME[name].kind.__name__)
    assert [text.split()[:2] for text, _ in members[:2]] == [["int64_t", "utime"], ["int32_t", "seq"]]
    if name not in {channel.name for channel in channels.WORLD_CHANNELS}:
        assert members[2][0].split() == ["int8_t", "drone_id"]


def test_what_crosses_the_ring_has_a_priority_and_dies_of_age():
    assert channels.CROSSING
    for channel in channels.CROSSING:
        assert 0 <= channel.priority < 9
        assert 0 < channel.max_age_s <= 5


def lcm_files() -> list[Path]:
    return sorted((ROOT / "lcmtypes").glob("*.lcm"))


def members_of(kind: str) -> list[tuple[str, str]]:
    """(declaration, its comment) of each member and constant of a struct, in order."""
    text = (ROOT / "lcmtypes" / f"{kind}.lcm").read_text()
    body = text[text.index("{") + 1 : text.rindex("}")]
    lines = [line.strip() for line in body.splitlines() if line.strip()]
    return [(line.partition(";")[0], line.partition("//")[2].strip()) for line in lines if line[:2] != "//"]


@pytest.mark.parametrize("path", lcm_files(), ids=lambda path: path.stem)
def test_every_member_of_every_type_says_what_it_is(path):
    text = path.read_text()
    assert text.startswith("package podwatch;")
    before = text[: text.index("struct")].strip().splitlines()
    assert before[-1].startswith("// "), "a type says what it is for"
    assert re.search(r"struct (\w+)", text).group(1) == path.stem  # type: ignore[union-attr]
    assert [declaration for declaration, comment in members_of(path.stem) if not comment] == []


@pytest.mark.parametrize("path", lcm_files(), ids=lambda path: path.stem)
def test_a_member_with_a_unit_in_its_name_gives_the_same_unit_in_its_comment(path):
    units = {
        "_m": "m",
        "_s": "s",
        "_px": "px",
        "_rad": "rad",
        "_us": "us",
        "_ms": "ms",
        "_deg": "deg",
        "_mb": "MB",
    }
    for declaration, comment in members_of(path.stem):
        if declaration.startswith("const"):
            continue
        name = declaration.split()[1].split("[")[0]
        for suffix, unit in units.items():
            if name.endswith(suffix) and not name.endswith(f"_m{suffix}"):
                assert re.search(rf"\b{unit}\b", comment), f"{path.stem}.{name}: {comment!r}"
        if name.endswith("_m_s"):
            assert "m/s" in comment, f"{path.stem}.{name}: {comment!r}"


def test_every_type_is_generated_and_no_two_types_can_be_taken_for_each_other():
    """A fingerprint covers member names and types only (tests/bus/test_lcm_facts.py, fact 5)."""
    kinds = [path.stem for path in lcm_files()]
    fingerprints = {getattr(podwatch, kind)._get_packed_fingerprint(): kind for kind in kinds}
    assert len(fingerprints) == len(kinds)


def test_the_supervisors_configuration_is_the_process_table(tmp_path):
    roster = (3, 5)
    config = configuration(tmp_path, tmp_path / "socket", roster, WORLD)
    programs = {name.removeprefix("program:") for name in config.sections() if name.startswith("program:")}
    table = {program(drone_id, process.name) for drone_id in roster for process in processes.PROCESSES}
    assert programs == table | {"world"}
    for drone_id in roster:
        for process in processes.PROCESSES:
            section = config[f"program:{program(drone_id, process.name)}"]
            assert f"-m procs.main {process.name} " in section["command"]
            assert "--end-with-parent" in section["command"]
            assert section["exitcodes"] == str(EXIT_CANNOT_START)
            is_kept = process.restart_ground is Restart.ALWAYS
            assert section["autorestart"] == ("unexpected" if is_kept else "false")
    assert config["program:world"]["autorestart"] == "false"


def test_the_tree_stops_in_the_order_of_the_table_and_the_world_last(tmp_path):
    """supervisord stops whole groups one after another, the highest priority first."""
    config = configuration(tmp_path, tmp_path / "socket", (1, 2), WORLD)
    groups = [config[name] for name in config.sections() if name.startswith("group:")]
    stopped = sorted(groups, key=lambda group: -int(group["priority"]))
    orders = [
        sorted(
            {processes.BY_NAME[name.rsplit("_", 1)[0]].stop_order for name in group["programs"].split(",")}
        )
        for group in stopped
    ]
    assert orders == [[order] for order in sorted({process.stop_order for process in processes.PROCESSES})]
    assert int(config["program:world"]["priority"]) < min(int(group["priority"]) for group in groups)
