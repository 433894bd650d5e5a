"""A real autopilot's place in the simulator: bytes pass unchanged, and cameras look from where it says it is.

A simulated autopilot in a process of its own stands in for the real one, over UDP.
"""

import json
import math
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

from drivers.autopilots.ardupilot import Codec, mavlink
from drivers.autopilots.mavlink_link import MavlinkUdp
from drivers.autopilots.memory import link_pair
from drivers.sim.routed_autopilot import MisplacedError, RoutedAutopilot
from drivers.sim.world import World, WorldSettings
from lcmtypes import channels, make
from lcmtypes.podwatch import setpoint_t
from logs.reader import read
from procs.autopilot.bridge import Bridge
from procs.settings import Mission
from tests.bus.autopilot_flights import start_twin
from tools.buses import free_udp_ports
from tools.sim.settings import PodTable

ROOT = Path(__file__).parents[2]
ORIGIN = (15.3, -61.5, 0.0)  # of the twin that start_twin starts
SCALE = 5.0
DEADLINE_S = 60.0


class Line:
    """The far autopilot's end of a link: what it hears, and what it says next."""

    system_id = 1

    def __init__(self) -> None:
        self.codec = Codec(1, 1)
        self.heard = b""
        self.says = b""

    def write(self, data: bytes) -> None:
        self.heard += data

    def receive(self) -> bytes:
        said, self.says = self.says + self.codec.take(), b""
        return said

    def asked(self) -> list[tuple[int, int]]:
        """(who asked, message id) of each stream that was asked for since the last call."""
        messages = Codec(9, 9).parse(self.heard)
        self.heard = b""
        return [
            (message.get_srcSystem(), int(message.param1))
            for message in messages
            if message.get_type() == "COMMAND_LONG"
        ]

    def fileno(self) -> int:
        return -1

    def close(self) -> None: ...


@pytest.fixture
def line() -> Line:
    return Line()


@pytest.fixture
def routed(line: Line) -> RoutedAutopilot:
    return RoutedAutopilot(line, 1, origin=ORIGIN, home=(4.0, 6.0))  # type: ignore[arg-type]


def heartbeat(line: Line) -> None:
    line.codec.send.heartbeat_send(mavlink.MAV_TYPE_QUADROTOR, 3, 0, 4, mavlink.MAV_STATE_ACTIVE)


def test_bytes_pass_unchanged_both_ways_whatever_they_are(line, routed):
    routed.step(0.0)
    line.heard = b""
    routed.receive(b"\xfd no message \x00", 0.1)
    assert line.heard == b"\xfd no message \x00"
    line.says = bytes(range(256))
    assert routed.step(0.2) == bytes(range(256))


def test_the_pose_is_what_the_autopilot_says_in_the_fleets_frame(line, routed):
    """Its origin lies 0.001 degrees north and 0.002 degrees east of the fleet's: at 15.3 degrees of latitude
    110.65 m and 214.79 m.
    """
    line.codec.send.local_position_ned_send(1000, 10.0, 20.0, -30.0, 1.0, 2.0, -0.5)
    routed.step(0.0)
    assert (routed.pose.n_m, routed.pose.e_m, routed.pose.d_m) == (4.0, 6.0, 0.0), "its origin is not known"
    line.codec.send.gps_global_origin_send(153010000, -614980000, 900_000)
    line.codec.send.attitude_send(1000, 0.1, -0.2, 2.5, 0, 0, 0)
    routed.step(0.1)
    pose = routed.pose
    assert (pose.n_m, pose.e_m, pose.d_m) == pytest.approx((120.65, 234.79, -30.0), abs=0.3)
    assert (pose.roll_rad, pose.pitch_rad, pose.yaw_rad) == pytest.approx((0.1, -0.2, 2.5))
    assert routed.velocity_ned == pytest.approx((1.0, 2.0, -0.5))


def test_numbers_that_are_none_and_other_components_change_nothing(line, routed):
    line.codec.send.gps_global_origin_send(153000000, -615000000, 0)
    line.codec.send.local_position_ned_send(1000, 10.0, 20.0, -30.0, 0, 0, 0)
    routed.step(0.0)
    line.codec.send.local_position_ned_send(1000, math.nan, 0, 0, 0, 0, 0)
    line.codec.send.attitude_send(1000, math.nan, 0, 0, 0, 0, 0)
    gimbal = Codec(1, 154)
    gimbal.send.local_position_ned_send(1000, 77.0, 77.0, 77.0, 0, 0, 0)
    line.says = gimbal.take()
    routed.step(0.1)
    pose = routed.pose
    assert (pose.n_m, pose.e_m, pose.d_m, pose.roll_rad) == pytest.approx((10.0, 20.0, -30.0, 0.0), abs=0.01)


def test_what_does_not_come_is_asked_for_and_what_comes_is_left_alone(line, routed):
    wanted = {
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    }
    routed.step(0.0)
    assert [message.get_type() for message in Codec(9, 9).parse(line.heard)] == ["HEARTBEAT"]
    assert line.asked() == []
    heartbeat(line)
    routed.step(1.0)
    assert {message_id for _, message_id in line.asked()} == wanted
    line.codec.send.attitude_send(1000, 0, 0, 0, 0, 0, 0)
    line.codec.send.gps_global_origin_send(153000000, -615000000, 0)
    routed.step(2.0)
    asked = line.asked()
    assert [message_id for _, message_id in asked] == [mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED]
    assert {system for system, _ in asked}.isdisjoint({255}), "an answer must not be taken for the bridge's"


def test_an_autopilot_of_another_place_is_refused_with_what_to_set(line, routed):
    line.codec.send.gps_global_origin_send(-353632621, 1491652374, 584_000)
    with pytest.raises(MisplacedError, match=r"-35\.36326, 149\.16524, .* km .*set \[origin\]"):
        routed.step(0.0)


def test_what_is_wrong_is_told(line, routed):
    routed.step(5.0)
    assert "is not heard" in routed.problem(5.0)
    other = Codec(3, 1)
    other.send.heartbeat_send(mavlink.MAV_TYPE_QUADROTOR, 3, 0, 4, mavlink.MAV_STATE_ACTIVE)
    line.says = other.take()
    routed.step(6.0)
    assert routed.problem(6.0) == "drone 1's autopilot is system 3; set its MAV_SYSID to 1"
    heartbeat(line)
    line.codec.send.gps_global_origin_send(153000000, -615000000, 0)
    line.codec.send.local_position_ned_send(1000, 4.0, 106.0, 0, 0, 0, 0)
    routed.step(7.0)
    assert "stands 100 m from its home" in routed.problem(7.0)


def test_a_bridge_flies_an_autopilot_of_another_process_and_the_world_sees_it_there():
    """The fleet's origin lies 0.0018 degrees, 199 m, south of the autopilot's."""
    link = MavlinkUdp("127.0.0.1:0")
    twin = start_twin(f"udpout:127.0.0.1:{link.port}", scale=SCALE, system_id=1)
    origin = (ORIGIN[0] - 0.0018, ORIGIN[1], 0.0)
    mission = Mission(
        origin={"latitude_deg": origin[0], "longitude_deg": origin[1]},
        drones=[{"id": 1, "home_n_m": 199.2}],
    )
    bridge_end, world_end = link_pair(lambda action: action())
    routed = RoutedAutopilot(link, 1, origin=origin, home=(199.2, 0.0))
    pod = PodTable(animals=0).settings()
    settings = WorldSettings(1, {1: (199.2, 0.0)}, origin, pod, 0.0, 0.0, 0.0)
    world = World(settings, {1: world_end}, {1: routed})
    bridge = Bridge(mission, 1)
    began_s, utime = time.monotonic(), 0
    try:
        while not (world.state().drones[0].d_m < -11.0 and bridge.state(utime)["d_m"] < -11.0):
            assert time.monotonic() - began_s < DEADLINE_S, bridge.problem(utime)
            select.select([link], [], [], 0.01)
            utime = round((time.monotonic() - began_s) * 1e6 * SCALE)
            world.step_to(utime)
            bridge.receive(bridge_end.receive(), utime)
            wish = make(setpoint_t, utime=utime, drone_id=1, expiry_utime=utime + 2_000_000, d_m=-12.0)
            wish.kind = setpoint_t.TAKEOFF
            bridge_end.write(bridge.setpoint(wish, utime))
            bridge_end.write(bridge.step(utime))
        seen, believed = world.state().drones[0], bridge.state(utime)
        assert (seen.n_m, seen.e_m) == pytest.approx((199.2, 0.0), abs=8.0), "GPS is 1.5 m off, twice"
        assert (seen.n_m, seen.e_m, seen.d_m) == pytest.approx(
            (believed["n_m"], believed["e_m"], believed["d_m"]), abs=1.5
        )
        assert routed.problem(utime / 1e6) == ""
    finally:
        twin.kill()
        twin.wait()
        link.close()


@pytest.mark.timeout(240)
def test_podwatch_sim_flies_a_real_autopilot_at_real_time(tmp_path):
    """One drone for 15 s: up it goes, and the clock was never slowed."""
    [port] = free_udp_ports(1)
    twin = start_twin(f"udpout:127.0.0.1:{port}", scale=1.0, system_id=1)
    mission = tmp_path / "mission.toml"
    mission.write_text("[[drones]]\nid = 1\n[search]\nnorth_m = 30.0\n[pod]\nnorth_m = 30.0\n")
    words = [
        "sim",
        str(mission),
        "--duration",
        "25",
        "--sensor",
        "boxes",
        "--headless",
        "--out",
        str(tmp_path),
    ]
    try:
        done = subprocess.run(
            [
                sys.executable,
                "-c",
                "from tools.cli import main; main()",
                *words,
                "--autopilot",
                f"127.0.0.1:{port}",
            ],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=200,
        )
    finally:
        twin.kill()
        twin.wait()
    assert done.returncode == 0, done.stderr + done.stdout
    [folder] = [path.parent for path in tmp_path.glob("*/truth.json")]
    about = json.loads((folder / "truth.json").read_text())
    assert about["autopilots"] == [f"udp:127.0.0.1:{port}"]
    assert about["realtime_factor"] == pytest.approx(1.0, abs=0.02)
    states = [message for _, _, message in read(folder / "truth.mcap", channels=channels.WORLD_STATE)]
    assert min(state.drones[0].d_m for state in states) < -4.0
