"""The bridge over real sockets: a twin in another process, one that dies, TCP, the shell on a real bus."""

import select
import socket
import subprocess
import sys
import time
from pathlib import Path

import lcm
import numpy as np
import pytest

from drivers.autopilots.mavlink_link import MavlinkTcp, MavlinkUdp, MavlinkUdpClient
from drivers.clocks.monotonic import MonotonicClock
from drivers.sim.autopilot import SimAutopilot
from drivers.sim.vehicle import Vehicle
from lcmtypes import channels, make
from lcmtypes.podwatch import setpoint_t, vehicle_state_t
from procs.autopilot.bridge import Bridge
from procs.settings import DriverSpec, DroneSettings, Mission
from tests.bus.autopilot_flights import FLOWN_M, FLOWN_WITHIN_M, Pilot, start_twin, there_and_back

ROOT = Path(__file__).parents[2]
DEADLINE_S = 60.0
SCALE = 5.0


def end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


@pytest.fixture
def link():
    link = MavlinkUdp("127.0.0.1:0")
    yield link
    link.close()


def test_a_flight_over_udp_to_another_process(link):
    twin = start_twin(f"udpout:127.0.0.1:{link.port}", scale=SCALE, system_id=3)
    try:
        mission = Mission(drones=[{"id": 3}])
        flown_m = there_and_back(Pilot(Bridge(mission, 3), link, drone_id=3, scale=SCALE), ready_s=200)
        assert flown_m == pytest.approx(FLOWN_M, abs=FLOWN_WITHIN_M)
    finally:
        end(twin)


def test_an_autopilot_that_dies_and_comes_back_is_taken_up_again(link):
    pilot = Pilot(Bridge(Mission(), 1), link, drone_id=1, scale=SCALE)
    twin = start_twin(f"udpout:127.0.0.1:{link.port}", scale=SCALE, system_id=1)
    try:
        pilot.fly_until(lambda: pilot.state["position_ok"], 200)
        end(twin)
        pilot.fly_until(lambda: not pilot.state["position_ok"] and pilot.state["link_age_ms"] > 3000, 30)
        assert pilot.bridge.problem(pilot.utime), "a bridge without an autopilot says so"
        twin = start_twin(f"udpout:127.0.0.1:{link.port}", scale=SCALE, system_id=1)  # from another port
        pilot.fly_until(lambda: pilot.state["position_ok"], 200)
        assert pilot.state["link_age_ms"] < 3000
        assert pilot.state["landed"]
    finally:
        end(twin)


def test_udp_answers_to_the_address_it_last_heard_and_drops_what_nobody_asked_for(link):
    link.write(b"nobody")
    first, second = (MavlinkUdpClient(f"127.0.0.1:{link.port}") for _ in range(2))
    try:
        for client, word in ((first, b"first"), (second, b"second")):
            client.write(word)
            assert select.select([link], [], [], DEADLINE_S)[0]
            assert link.receive() == word
            link.write(b"to " + word)
            assert select.select([client], [], [], DEADLINE_S)[0]
            assert client.receive() == b"to " + word
    finally:
        first.close()
        second.close()


def accept(server: socket.socket, link: MavlinkTcp) -> socket.socket:
    """The link's next connection; writing is what makes it try again."""
    deadline_s = time.monotonic() + DEADLINE_S
    while not select.select([server], [], [], 0.02)[0]:
        assert time.monotonic() < deadline_s
        link.write(b"")
    connection, _ = server.accept()
    return connection


def test_tcp_connects_again_after_the_autopilot_closed():
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = MavlinkTcp(f"127.0.0.1:{server.getsockname()[1]}")
        try:
            for word in (b"one", b"two"):
                connection = accept(server, link)
                link.write(b"")
                link.write(word)
                with connection:
                    connection.settimeout(DEADLINE_S)
                    assert connection.recv(100) == word
                    connection.sendall(b"back " + word)
                    assert select.select([link], [], [], DEADLINE_S)[0]
                    assert link.receive() == b"back " + word
                assert select.select([link], [], [], DEADLINE_S)[0]
                assert link.receive() == b""
                assert select.select([link], [], [], 0)[0] == []  # waits quietly while there is no connection
        finally:
            link.close()


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def test_the_process_on_a_real_bus_hears_setpoints_and_says_where_the_vehicle_is(tmp_path):
    port = free_port()
    url = f"udpm://239.255.76.191:{free_port()}?ttl=0&recv_buf_size=4194304"
    link_spec = DriverSpec(
        driver="drivers.autopilots.mavlink_link:open_link", options={"address": f"udp:127.0.0.1:{port}"}
    )
    settings = DroneSettings(drone_id=1, mission=Mission(), bus_url=url, drivers={"autopilot": link_spec})
    path = tmp_path / "drone1.json"
    path.write_text(settings.model_dump_json())
    process = subprocess.Popen([sys.executable, "-m", "procs.main", "autopilot", str(path)], cwd=ROOT)
    states: list[vehicle_state_t] = []
    bus = lcm.LCM(url)
    bus.subscribe(channels.VEHICLE_STATE, lambda _channel, data: states.append(vehicle_state_t.decode(data)))
    far_end = MavlinkUdpClient(f"127.0.0.1:{port}")
    vehicle = Vehicle((0.0, 0.0), np.random.default_rng(1))
    twin = SimAutopilot(vehicle, 1, np.random.default_rng(2), origin=(15.3, -61.5, 0.0), ready_s=0.0)
    clock = MonotonicClock()
    began_s = time.monotonic()
    try:
        while not (states and states[-1].armed and states[-1].d_m < -0.3):
            t_s = time.monotonic() - began_s
            assert t_s < DEADLINE_S, f"{len(states)} states, twin in mode {twin.flight.mode}"
            twin.receive(far_end.receive(), t_s)
            far_end.write(twin.step(t_s))
            utime = clock.utime()
            take_off = make(setpoint_t, utime=utime, drone_id=1, expiry_utime=utime + 500_000, d_m=-15.0)
            take_off.kind = setpoint_t.TAKEOFF
            bus.publish(channels.SETPOINT, take_off.encode())
            bus.handle_timeout(20)
        assert states[-1].position_ok
        assert 0 <= states[-1].setpoint_age_us < 500_000
    finally:
        far_end.close()
        process.terminate()
        assert process.wait(DEADLINE_S) == 0
