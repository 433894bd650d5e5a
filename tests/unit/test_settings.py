"""Mission files: what may be said, and what is answered to what may not."""

from pathlib import Path

import pytest
from pydantic import ValidationError

import fleets
from procs.settings import DriverSpec, DroneSettings, Mission, MissionError, load_mission
from tools.sim.settings import SimMission


def written(folder: Path, text: str) -> Path:
    path = folder / "mission.toml"
    path.write_text(text)
    return path


def refused(folder: Path, text: str, model: type[Mission] = Mission) -> str:
    """What the file is refused with."""
    with pytest.raises(MissionError) as caught:
        load_mission(written(folder, text), model)
    return str(caught.value)


def test_a_file_that_says_nothing_is_the_default_fleet_of_three(tmp_path):
    mission = load_mission(written(tmp_path, ""), Mission)
    assert mission == Mission()
    assert mission.roster == (1, 2, 3)
    assert mission.home(2).home_e_m == 10.0


def test_the_roster_is_in_ring_order_whatever_the_order_of_the_file(tmp_path):
    text = "[[drones]]\nid = 9\nhome_n_m = 4.0\n[[drones]]\nid = 4\n"
    mission = load_mission(written(tmp_path, text), Mission)
    assert mission.roster == (4, 9)
    assert mission.home(9).home_n_m == 4.0
    with pytest.raises(KeyError, match=r"drone 5 is not in the roster \(4, 9\)"):
        mission.home(5)


def test_an_unknown_key_is_answered_with_the_nearest_valid_one(tmp_path):
    said = refused(tmp_path, "[search]\nheigth_m = 40\n")
    assert "unknown key 'search.heigth_m'; did you mean 'height_m'?" in said
    assert "north_m" in said, "and with all that are valid"
    assert "mission.toml" in said
    assert "did you mean 'search'" in refused(tmp_path, "[serach]\n")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[search]\nheight_m = 500\n", ("search.height_m", "120", "500")),
        ("[search]\nheight_m = nan\n", ("search.height_m", "finite")),
        ("[camera]\nrate_hz = 'fast'\n", ("camera.rate_hz", "number", "'fast'")),
        ("drones = []\n", ("at least one [[drones]] entry is needed",)),
        ("[[drones]]\nid = 100\n", ("drone 100: id:", "99", "100")),
        ("[[drones]]\nid = 7\ncamra = 3\n", ("drone 7: unknown key 'camra'; did you mean",)),
        ("[[drones]]\nhome_n_m = 3.0\n", ("[[drones]] entry 1: id: Field required",)),
        ("drones = [3]\n", ("[[drones]] entry 1: ",)),
        ("[boat]\nradio = 'boat'\n", ("boat.radio: write HOST:PORT, as", "'boat'")),
        ("[[drones]]\nid = 2\n[[drones]]\nid = 2\n", ("id 2 is given to 2 drones",)),
        ("[limits]\nmin_height_m = 90\n", ("min_height_m 90.0 must be below max_height_m 80.0",)),
        ("[limits]\nbattery_land = 0.3\n", ("battery_land 0.3 must be below battery_return 0.25",)),
        ("[watch]\nheight_m = 9\n", ("watch.height_m = 9.0 lies outside", "10.0 to 80.0")),
        ("search = 3\n", ("search",)),
        ("[search\n", ("not valid TOML",)),
    ],
)
def test_what_cannot_be_flown_is_refused_with_the_key_the_value_and_the_limit(text, says, tmp_path):
    said = refused(tmp_path, text)
    assert [part for part in says if part not in said] == [], said


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("radio = 'x'", "drone 4: machine.radio: write HOST:PORT, as \"10.76.0.1:14600\" (given: 'x')"),
        ("camera = '/dev/video0'", "machine.camera: write v4l2:DEVICE"),
        ("autopilot = 'ttyAMA0'", "machine.autopilot: write serial:DEVICE:BAUD"),
        ("drivers.radio.driver = 'lora'", "machine.drivers.radio.driver: write package.module:Class"),
    ],
)  # fmt: skip
def test_what_an_address_must_look_like_is_said_in_words(line, says, tmp_path):
    said = refused(tmp_path, f"[[drones]]\nid = 4\n[drones.machine]\n{line}\n")
    assert says in said
    assert "pattern" not in said


def test_a_file_that_cannot_be_read_says_so(tmp_path):
    with pytest.raises(MissionError, match="cannot be read"):
        load_mission(tmp_path / "nowhere.toml", Mission)
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(MissionError, match="not valid TOML"):
        load_mission(tmp_path / "bytes.toml", Mission)


def test_a_mission_that_flies_knows_nothing_of_the_simulated_world(tmp_path):
    """What is simulated has tables of its own, which only the simulator's missions may have."""
    assert "unknown key 'pod'" in refused(tmp_path, "[pod]\nanimals = 3\n")
    mission = load_mission(written(tmp_path, "[pod]\nanimals = 3\n"), SimMission)
    assert mission.pod.animals == 3


def test_a_fault_that_names_a_stranger_is_refused(tmp_path):
    said = refused(tmp_path, '[[faults]]\nkind = "kill"\ndrone = 7\n', SimMission)
    assert "drone 7 is not in the roster [1, 2, 3]" in said
    said = refused(tmp_path, '[[faults]]\nkind = "cut"\nbetween = [1, 8]\n', SimMission)
    assert "the link (1, 8) is not between members of [1, 2, 3]" in said


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[[drones]]\nid = 1\n[[drones]]\nid = 2\n", "the homes of drones 1 and 2 are 0 m apart"),
        ("[search]\nnorth_m = 500\n", "its spiral goes 650 m from the origin"),
        (
            "[[drones]]\nid = 1\nhome_n_m = 700\n",
            "the home of drone 1 lies outside limits.fence_radius_m = 600",
        ),
    ],
)
@pytest.mark.parametrize("kind", [Mission, SimMission])
def test_homes_that_meet_and_places_beyond_the_fence_are_refused(kind, text, says, tmp_path):
    assert says in refused(tmp_path, text, kind)


@pytest.mark.parametrize(
    "path", sorted(fleets.path("default").parent.glob("*.toml")), ids=lambda path: path.stem
)
def test_every_mission_that_ships_is_valid(path):
    assert load_mission(path, SimMission).roster


def test_settings_are_frozen():
    with pytest.raises(ValidationError):
        Mission().search.height_m = 10.0  # type: ignore[misc]


def test_a_drones_settings_come_back_from_their_file_as_they_were(tmp_path):
    spec = DriverSpec(driver="drivers.frames:SharedFrames", options={"run": "x", "drone_id": 2})
    settings = DroneSettings(
        drone_id=2, mission=Mission(), seed=4, bus_url="udpm://", drivers={"frames": spec}
    )
    path = tmp_path / "drone.json"
    path.write_text(settings.model_dump_json())
    assert DroneSettings.read(path) == settings


def test_a_simulated_mission_reaches_a_drone_without_its_simulated_tables(tmp_path):
    settings = DroneSettings(drone_id=2, mission=SimMission(seed=3))
    path = tmp_path / "drone.json"
    path.write_text(settings.model_dump_json())
    assert "pod" not in path.read_text()
    assert DroneSettings.read(path).mission == Mission()


@pytest.mark.parametrize("driver", ["drivers.frames", "drivers.frames:", ":SharedFrames", "a b:c"])
def test_a_driver_is_a_module_and_a_class(driver):
    with pytest.raises(ValidationError):
        DriverSpec(driver=driver)
