"""The relay's shell in virtual time: what a drone's bus hears of the others."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.radios.memory import MemoryEther
from lcmtypes import channels, make
from lcmtypes.podwatch import (
    fleet_state_t,
    heartbeat_t,
    link_state_t,
    mission_state_t,
    ring_map_t,
    vehicle_state_t,
)
from procs.queue_executor import ClockError, EventQueue, QueueRuntime, VirtualBus
from procs.relay.keys import make_key
from procs.relay.process import key_path, setup
from procs.runtime import RuntimeFailure
from procs.settings import DroneEntry, DroneSettings, Mission

S = 1_000_000


class Fleet:
    """Relays on their buses, with everything that is said on each bus written down."""

    def __init__(self, n: int, run_dir: Path) -> None:
        self.queue = EventQueue()
        self.ether = MemoryEther(
            np.random.default_rng(3),
            lambda delay_s, action: self.queue.schedule(self.queue.now_us + round(delay_s * S), action),
        )
        drones = (DroneEntry(id=drone_id, home_e_m=10.0 * drone_id) for drone_id in range(1, n + 1))
        mission = Mission(drones=tuple(drones))
        self.heard: dict[int, list[tuple[str, bytes]]] = {}
        self.buses: dict[int, VirtualBus] = {}
        self.runtimes: dict[int, QueueRuntime] = {}
        self.clocks: dict[int, ClockError] = {}
        for drone_id in mission.roster:
            settings = DroneSettings(drone_id=drone_id, mission=mission, run_dir=str(run_dir))
            clock = ClockError(10 * S * drone_id, 0.0)
            bus = VirtualBus(self.queue)
            drivers: dict[str, Any] = {
                "radio": lambda _process, drone_id=drone_id: self.ether.radio(drone_id, mission.roster)
            }
            runtime = QueueRuntime("relay", settings, bus, clock, drivers)
            setup(runtime)
            runtime.start()
            listener = QueueRuntime("logger", settings, bus, clock, {})
            heard = self.heard.setdefault(drone_id, [])
            listener.on_all(lambda channel, data, _utime, heard=heard: heard.append((channel, data)))
            self.buses[drone_id], self.runtimes[drone_id], self.clocks[drone_id] = bus, runtime, clock

    def say(self, drone_id: int, channel: str, message: Any) -> None:
        message.drone_id = drone_id
        message.utime = message.utime or self.clocks[drone_id].utime(self.queue.now_us)
        self.buses[drone_id].deliver(channel, message.encode())

    def run(self, seconds: float) -> None:
        """Every drone's navigator and autopilot speak at 10 Hz, its registrar at 5 Hz."""
        for k in range(round(seconds * 10)):
            for drone_id in self.buses:
                vehicle = make(vehicle_state_t, n_m=5.0 * drone_id, battery=0.75, position_ok=True)
                self.say(drone_id, channels.VEHICLE_STATE, vehicle)
                self.say(drone_id, channels.MISSION_STATE, make(mission_state_t, state=3, animal=drone_id))
                if k % 2 == 0:
                    self.say(drone_id, channels.RING_MAP, make(ring_map_t, seq=k, n_bytes=1, packet=b"m"))
            self.queue.run_until(self.queue.now_us + S // 10)

    def last(self, drone_id: int, channel: str, kind: Any) -> Any:
        return kind.decode([data for name, data in self.heard[drone_id] if name == channel][-1])


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    make_key(tmp_path / "fleet.key")
    return Fleet(5, tmp_path)


def test_a_bus_hears_the_two_neighbours_and_the_fleet_table(fleet: Fleet) -> None:
    fleet.run(12)
    rates = Counter(name for name, _ in fleet.heard[1])
    copies = {name for name in rates if name.startswith("RX_")}
    assert copies == {"RX_2_RING_MAP", "RX_5_RING_MAP"}
    assert 50 <= rates["RX_2_RING_MAP"] <= 60
    assert 46 <= rates["FLEET_STATE"] <= 48
    assert 11 <= rates["LINK_STATE"] <= 12
    copy = fleet.last(1, "RX_2_RING_MAP", ring_map_t)
    assert (copy.drone_id, copy.packet) == (2, b"m")
    state = fleet.last(1, channels.FLEET_STATE, fleet_state_t)
    assert [row.id for row in state.rows] == [1, 2, 3, 4, 5]
    assert [(row.n_m, row.animal, row.state) for row in state.rows] == [(5.0 * k, k, 3) for k in range(1, 6)]
    assert (state.left_id, state.right_id, state.is_line, state.members) == (5, 2, False, 0b11111)
    last = fleet.last(3, channels.FLEET_STATE, fleet_state_t)
    assert last.fleet_time_ok
    assert abs(last.fleet_offset_us + 20 * S) < 2_000  # drone 3's clock is 20 s ahead of drone 1's
    links = fleet.last(1, channels.LINK_STATE, link_state_t)
    assert [(link.peer_id, link.up) for link in links.links] == [(2, True), (5, True)]
    assert fleet.last(1, channels.HEARTBEAT, heartbeat_t).status == heartbeat_t.OK


def test_the_heartbeat_says_which_side_is_silent_and_what_was_refused(fleet: Fleet) -> None:
    fleet.run(6)
    fleet.ether.blocked = lambda sender, receiver: {sender, receiver} == {1, 2}
    fleet.run(6)
    beat = fleet.last(1, channels.HEARTBEAT, heartbeat_t)
    assert beat.status == heartbeat_t.DEGRADED
    assert beat.detail == "link to a living neighbour is silent: right"
    fleet.ether.blocked = lambda sender, receiver: False
    for _ in range(30):
        fleet.ether.carry(9, 1, b"noise")
        fleet.run(0.1)
    assert "stranger" in fleet.last(1, channels.HEARTBEAT, heartbeat_t).detail
    fleet.run(3)
    assert fleet.last(1, channels.HEARTBEAT, heartbeat_t).status == heartbeat_t.OK


def test_a_message_too_large_to_cross_is_not_sent_and_named(fleet: Fleet) -> None:
    fleet.run(4)
    fleet.heard[2].clear()
    for _ in range(15):
        fleet.say(1, channels.RING_ASSIGN, make(ring_map_t, n_bytes=1, packet=b"-"))  # of another type: bad
        fleet.say(1, channels.RING_MAP, make(ring_map_t, n_bytes=500, packet=bytes(500)))
        fleet.queue.run_until(fleet.queue.now_us + S // 10)
    assert "RING_MAP of 531 bytes: at most 400 may cross" in (
        fleet.last(1, channels.HEARTBEAT, heartbeat_t).detail
    )
    assert not any(name.startswith("RX_1") for name, _ in fleet.heard[2])


def test_a_position_that_is_not_known_makes_no_row(fleet: Fleet) -> None:
    for _ in range(30):
        for vehicle in (
            make(vehicle_state_t, position_ok=False),
            make(vehicle_state_t, position_ok=True, n_m=float("nan")),
        ):
            fleet.say(1, channels.VEHICLE_STATE, vehicle)
        fleet.say(1, channels.MISSION_STATE, make(mission_state_t))
        fleet.queue.run_until(fleet.queue.now_us + S // 10)
    state = fleet.last(1, channels.FLEET_STATE, fleet_state_t)
    assert (state.n_rows, state.members) == (0, 0b11111)


def test_without_a_usable_key_or_an_address_the_relay_does_not_start(tmp_path: Path) -> None:
    with pytest.raises(RuntimeFailure, match="no fleet key can be read"):
        Fleet(2, tmp_path)
    make_key(tmp_path / "fleet.key")
    (tmp_path / "fleet.key").chmod(0o644)
    with pytest.raises(RuntimeFailure, match="chmod 600"):
        Fleet(2, tmp_path)
    (tmp_path / "fleet.key").chmod(0o600)
    queue = EventQueue()
    ether = MemoryEther(np.random.default_rng(1), lambda delay_s, action: None)
    settings = DroneSettings(drone_id=1, mission=Mission(), run_dir=str(tmp_path))
    drivers: dict[str, Any] = {"radio": lambda _process: ether.radio(1, (1, 2))}
    with pytest.raises(RuntimeFailure, match=r"no address for drones \[3\]"):
        setup(QueueRuntime("relay", settings, VirtualBus(queue), ClockError(), drivers))


def test_the_key_lies_in_the_runs_folder_unless_its_path_is_absolute() -> None:
    assert key_path("runs/now", "fleet.key") == Path("runs/now/fleet.key")
    assert key_path("runs/now", "/etc/podwatch/fleet.key") == Path("/etc/podwatch/fleet.key")
