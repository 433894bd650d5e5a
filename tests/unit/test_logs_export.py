"""Exports, each opened in a reader that is not ours: GDAL, MCAP and protobuf for Foxglove, Rerun's own."""

import json
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pyogrio
import pytest
import rerun_cli
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from typer.testing import CliRunner

from drivers.cameras.replay import RAW_FORMAT
from lcmtypes import channels, make, podwatch
from logs.writer import LogWriter, picture_path
from procs.navigator.states import State
from procs.settings import Mission, OriginSettings
from tools.export.scenes import Picture, Recording
from tools.export.tracks import make_tracks
from tools.log import app

ORIGIN = OriginSettings(latitude_deg=15.3, longitude_deg=-61.5)
M_A_DEGREE = 110_640.0  # of latitude there, within 0.1 %
START_US = 40_000_000
SECONDS = 4


def ignore(_):
    """A log's warnings are not what is tested here."""


def write(path, drone_id=1, *, offset_us=0, links=(), utc_us=0):
    """A drone that flies north at 2 m/s and watches animal 3, 10 m east of its start; it sees 5 once."""
    mission = Mission(origin=ORIGIN)
    writer = LogWriter(path, drone_id=drone_id, metadata={"mission": mission.model_dump_json(), "seed": "1"})
    start = START_US + offset_us
    entries = [make(podwatch.link_t, peer_id=peer, up=True, offset_us=us) for peer, us in links]
    state = make(podwatch.link_state_t, utime=start, n_links=len(entries), links=entries)
    writer.write(channels.LINK_STATE, state.encode(), start)
    for k in range(10 * SECONDS):
        utime = start + k * 100_000
        messages = {channels.VEHICLE_STATE: _vehicle(k), channels.MISSION_STATE: _mission(k)}
        if k % 5 == 0:
            messages[channels.PREVIEW] = _preview()
        if k % 2 == 0:
            messages[channels.IDENTITIES] = _identities(k, drone_id)
            messages[channels.TRACK] = _track()
        if k % 10 == 0:
            messages[channels.HEARTBEAT] = _heartbeat(k)
        if utc_us and k >= 12:  # the GPS has a fix
            messages[channels.VEHICLE_STATE].utc_us = utc_us + 100_000 * k
        for channel, message in messages.items():
            message.utime = utime
            writer.write(channel, message.encode(), utime + 1000)
    writer.close()
    return path


def _vehicle(k):
    return make(podwatch.vehicle_state_t, position_ok=k >= 5, n_m=0.2 * k, e_m=1.0, d_m=-20.0, yaw_rad=0.5)


def _mission(k):
    state = State.SCOUT if k < 20 else State.MONITOR
    return make(podwatch.mission_state_t, state=state, animal=-1 if k < 20 else 3, reason="because")


def _heartbeat(k):
    trouble = k == 20
    status = podwatch.heartbeat_t.DEGRADED if trouble else podwatch.heartbeat_t.OK
    return make(podwatch.heartbeat_t, process="camera", status=status, detail="black" if trouble else "")


def _preview():
    image = np.full((240, 320, 3), (90, 60, 30), np.uint8)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    return make(
        podwatch.preview_t, width=320, height=240, scale=0.5, format="jpeg", n_bytes=len(data), data=data
    )


def _identities(k, drone_id):
    boxes = [
        make(podwatch.box_t, left_px=100, top_px=60, right_px=180, bottom_px=100, score=0.9),
        make(podwatch.box_t, left_px=300, top_px=200, right_px=340, bottom_px=260, score=0.62),
    ]
    seen = [
        make(
            podwatch.map_animal_t, id=3, n_m=4.0, e_m=10.0, size_m=9.0, mine=True, residual_m=0.5 * drone_id
        ),
        make(podwatch.map_animal_t, id=5, n_m=8.0, e_m=2.0, mine=k == 20, residual_m=1.25),
    ]
    return make(
        podwatch.identities_t, width=640, height=480, n_boxes=2, boxes=boxes, ids=[3, -1], n_map=2, map=seen
    )


def _track():
    outline = [[110, 60], [180, 80], [110, 100]]
    return make(
        podwatch.track_t, animal=3, state=podwatch.track_t.TRACKING, u_px=140, v_px=80, left_px=100,
        top_px=60, right_px=180, bottom_px=100, width=640, height=480, n_outline=3, outline=outline,
    )  # fmt: skip


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write(tmp_path_factory.mktemp("log") / "drone_1.mcap")


def run(*arguments):
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


def exported(log, folder, kind, *arguments):
    path = folder / f"out.{kind}"
    result = run(log, f"--{kind}", path, *arguments)
    assert result.exit_code == 0, result.output
    return path


# Tracks.


def test_gdal_reads_the_geojson(log, tmp_path):
    path = exported(log, tmp_path, "geojson", "--every", "0.5")
    meta, _, geometry, fields = pyogrio.raw.read(path)
    columns = dict(zip(meta["fields"], fields, strict=True))
    assert columns["name"].tolist() == ["drone 1", "animal 3", "animal 5"]
    assert meta["crs"] == "EPSG:4326"
    document = json.loads(path.read_text())
    drone, animal, once = document["features"]
    assert [feature["geometry"]["type"] for feature in document["features"]] == ["LineString"] * 2 + ["Point"]
    longitude, latitude, height_m = drone["geometry"]["coordinates"][-1]
    assert (latitude - 15.3) * M_A_DEGREE == pytest.approx(0.2 * 39, rel=2e-3)
    assert (longitude + 61.5) * M_A_DEGREE * np.cos(np.radians(15.3)) == pytest.approx(1.0, rel=1e-2)
    assert height_m == 20.0
    assert drone["properties"]["times_s"] == [0.9, 1.4, 1.9, 2.4, 2.9, 3.4, 3.9]
    assert drone["properties"]["notes"][-1] == "MONITOR, watching animal 3"
    assert "uncertainties_m" not in drone["properties"]
    assert set(animal["properties"]["uncertainties_m"]) == {0.5}
    assert once["properties"]["uncertainties_m"] == [1.25]
    assert "coordTimes" not in drone["properties"]
    assert "no drone's GPS told the time" in document["description"]
    assert len(geometry) == 3


def test_gdal_reads_the_gpx_with_its_times(log, tmp_path):
    path = exported(log, tmp_path, "gpx", "--began", "2026-05-01T09:30:00Z")
    tracks, _, _, names = pyogrio.raw.read(path, layer="tracks")
    assert names[list(tracks["fields"]).index("name")].tolist() == ["drone 1", "animal 3", "animal 5"]
    meta, _, _, fields = pyogrio.raw.read(path, layer="track_points")
    points = dict(zip(meta["fields"], fields, strict=True))
    times = points["time"].astype("datetime64[ms]")
    assert times[0] == np.datetime64("2026-05-01T09:30:00.900")
    assert times[1] == np.datetime64("2026-05-01T09:30:01.900")
    assert points["ele"].tolist()[:2] == [20.0, 20.0]
    assert points["desc"][3] == "MONITOR, watching animal 3"
    assert points["desc"][-1] == "seen by drone 1, within 1.25 m"
    assert path.read_text().count("<podwatch:uncertainty_m>0.50<") == SECONDS


def test_times_are_those_of_the_gps_where_it_told_one(tmp_path):
    began = datetime(2026, 5, 1, 9, 30, tzinfo=UTC)
    path = write(tmp_path / "drone_1.mcap", utc_us=round(began.timestamp() * 1e6))
    recording = Recording([path], ignore)
    # The first message is written 0 to 1 ms beside the instant that it tells of.
    assert abs((recording.began - began).total_seconds()) < 0.01
    rows = exported(path, tmp_path, "csv").read_text().splitlines()
    assert "2026-05-01T09:30:01" in rows[2]


def test_the_csv_has_its_units_in_its_header(log, tmp_path):
    path = exported(log, tmp_path, "csv")
    meta, _, _, fields = pyogrio.raw.read(path)
    rows = dict(zip(meta["fields"], fields, strict=True))
    assert list(rows)[2:10] == [
        "time_s", "time_utc", "latitude_deg", "longitude_deg", "height_m", "north_m", "east_m",
        "uncertainty_m",
    ]  # fmt: skip
    assert rows["kind"].tolist() == ["drone"] * 4 + ["animal"] * 5
    assert [float(north) for north in rows["north_m"][:4]] == pytest.approx([1.8, 3.8, 5.8, 7.8])
    assert rows["uncertainty_m"].tolist() == [""] * 4 + ["0.50"] * 4 + ["1.25"]
    assert rows["note"][3] == "MONITOR, watching animal 3"
    assert not any(rows["time_utc"])


def test_of_several_drones_the_surest_sight_of_an_animal_is_kept(tmp_path):
    write(tmp_path / "drone_1.mcap", 1)
    write(tmp_path / "drone_2.mcap", 2, offset_us=7_000_000, links=[(1, -7_000_000)])
    tracks = make_tracks(Recording([tmp_path], ignore))
    assert [track.name for track in tracks] == ["drone 1", "drone 2", "animal 3", "animal 5"]
    assert {point.note for point in tracks[2].points} == {"seen by drone 1"}
    assert {point.uncertainty_m for point in tracks[2].points} == {0.5}
    assert tracks[0].points[-1].time_s == tracks[1].points[-1].time_s


# Foxglove.


def decoded(path):
    """[(topic, log time ns, message)] of a file of protobuf messages, by its own schemas alone."""
    kinds, messages = {}, []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema.encoding == channel.message_encoding == "protobuf"
            if schema.name not in kinds:
                pool = descriptor_pool.DescriptorPool()
                for proto in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(proto)
                kinds[schema.name] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            kind = kinds[schema.name]
            messages.append((channel.topic, message.log_time, kind.FromString(message.data)))
    return messages


@pytest.fixture(scope="module")
def shown(log, tmp_path_factory):
    folder = tmp_path_factory.mktemp("foxglove")
    return decoded(exported(log, folder, "foxglove", "--began", "2026-05-01T09:30:00Z"))


def of(shown, topic):
    return [message for name, _, message in shown if name == topic]


def test_foxglove_gets_every_topic_at_its_time(shown):
    assert {topic for topic, _, _ in shown} == {
        "/drone_1/camera", "/drone_1/marks", "/drone_1/fix", "/animal_3/fix", "/animal_5/fix", "/scene",
        "/log",
    }  # fmt: skip
    began_ns = round(datetime(2026, 5, 1, 9, 30, tzinfo=UTC).timestamp() * 1e9)
    assert [time_ns for topic, time_ns, _ in shown if topic == "/drone_1/camera"] == [
        began_ns + k * 500_000_000 for k in range(8)
    ]


def test_foxglove_gets_pictures_with_boxes_masks_and_identities(shown):
    picture = of(shown, "/drone_1/camera")[0]
    image = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR)
    assert (image.shape, picture.format, picture.frame_id) == ((240, 320, 3), "jpeg", "drone_1")
    marks = [message for message in of(shown, "/drone_1/marks") if len(message.points) == 3][-1]
    corners = [[(point.x, point.y) for point in line.points] for line in marks.points]
    # in px of the preview, which has half of the frame's
    assert corners == [
        [(50, 30), (90, 30), (90, 50), (50, 50)],
        [(150, 100), (170, 100), (170, 130), (150, 130)],
        [(55, 30), (90, 40), (55, 50)],
    ]
    assert [text.text for text in marks.texts] == ["animal 3", "62%", "watching 3"]
    animal, nobody, mask = [line.outline_color for line in marks.points]
    assert animal == mask != nobody
    assert marks.points[2].fill_color.a > 0


def test_marks_are_those_of_a_pictures_instant(shown):
    """Pictures come each 0.5 s, tracks each 0.2 s: at every second picture none is of the same frame."""
    times = [time_ns for topic, time_ns, _ in shown if topic == "/drone_1/camera"]
    newest = {time_ns: len(message.points) for topic, time_ns, message in shown if topic == "/drone_1/marks"}
    assert list(newest) == times
    assert list(newest.values()) == [3, 2, 3, 2, 3, 2, 3, 2]


def test_foxglove_gets_positions_a_scene_and_words(shown):
    fix = of(shown, "/drone_1/fix")[-1]
    assert (fix.latitude - 15.3) * M_A_DEGREE == pytest.approx(7.8, rel=2e-3)
    assert (fix.altitude, fix.position_covariance_type) == (20.0, 0)  # its error is not known
    animal = of(shown, "/animal_5/fix")[0]
    assert animal.position_covariance_type == 1
    assert list(animal.position_covariance)[::4] == [1.5625, 1.5625, 0.0]
    entities = {message.entities[0].id: message.entities[0] for message in of(shown, "/scene")}
    assert set(entities) == {"drone_1", "animal_3", "animal_5"}
    place = entities["animal_3"].spheres[0].pose.position
    assert (place.x, place.y, place.z) == (10.0, 4.0, 0.0)  # east, north, up
    assert [(message.level, message.message) for message in of(shown, "/log")] == [
        (2, "SCOUT: because"), (2, "MONITOR: because"), (3, "black"), (2, "works again"),
    ]  # fmt: skip


def test_whole_frames_are_shown_in_place_of_previews(tmp_path):
    path = write(tmp_path / "drone_1.mcap")
    pixels = np.full((480, 640, 3), 120, np.uint8).tobytes()
    writer = LogWriter(picture_path(path), drone_id=1)
    image = make(
        podwatch.preview_t, utime=START_US, width=640, height=480, scale=1.0, format=RAW_FORMAT,
        n_bytes=len(pixels), data=pixels,
    )  # fmt: skip
    writer.write(channels.IMAGE, image.encode(), START_US)
    writer.close()
    pictures = [item for item in Recording([path], ignore).items() if isinstance(item, Picture)]
    assert [(item.width, item.scale) for item in pictures] == [(640, 1.0)]
    assert cv2.imdecode(np.frombuffer(pictures[0].jpeg, np.uint8), cv2.IMREAD_COLOR).shape == (480, 640, 3)


# Rerun.


def rerun(*arguments):
    """What Rerun's own program says."""
    program = next(Path(rerun_cli.__file__).parent.glob("rerun*"), None)
    assert program is not None
    done = subprocess.run([program, "rrd", *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_rerun_opens_its_recording(log, tmp_path):
    path = tmp_path / "out.rrd"
    assert run(log, "--rerun", path).exit_code == 0
    rerun("verify", path)
    told = rerun("print", "-v", path)
    for entity in ("/drone_1/camera", "/drone_1/camera/boxes", "/drone_1/camera/mask", "/scene/drone_1",
                   "/scene/animal_3", "/map/animal_5", "/log"):  # fmt: skip
        assert entity in told, entity
    for component in ("Boxes2D", "EncodedImage", "LineStrips2D", "Points3D", "GeoPoints", "TextLog"):
        assert component in told, component


# What cannot be done is told.


def test_nothing_to_write_and_nothing_overwritten(log, tmp_path):
    assert "nothing to write; give --geojson" in run(log).stderr
    there = tmp_path / "there.csv"
    there.write_text("kept")
    refused = run(log, "--csv", there)
    assert (refused.exit_code, there.read_text()) == (2, "kept")
    assert "exists already and is not overwritten" in refused.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--every", "0"], "--every 0: it must be above 0 s"),
        (["--began", "yesterday"], "write a date and a time, as 2026-05-01T09:30:00Z"),
    ],
)
def test_values_that_make_no_sense_are_refused(log, tmp_path, arguments, words):
    result = run(log, "--csv", tmp_path / "a.csv", *arguments)
    assert result.exit_code == 2
    assert words in result.stderr


def test_a_log_without_an_origin_is_told(tmp_path):
    writer = LogWriter(tmp_path / "a.mcap", drone_id=1)
    writer.write(channels.TRACK, podwatch.track_t().encode(), 1)
    writer.close()
    result = run(tmp_path / "a.mcap", "--csv", tmp_path / "a.csv")
    assert result.exit_code == 2
    assert "does not say where the fleet's origin lies" in result.stderr
