"""`podwatch boat` in a process of its own, beside drones' relays on real sockets."""

import contextlib
import os
import pty
import select
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rich.console import Console

from drivers.radios.udp import UdpRadio
from lcmtypes import make
from lcmtypes.podwatch import mission_state_t, operator_t, vehicle_state_t
from procs.bus_executor import load_driver
from procs.navigator.states import State
from procs.relay.keys import make_key, read_key
from procs.relay.relay import TICK_S, Relay
from procs.settings import BoatSettings, DroneEntry, MachineSettings, Mission, load_mission
from tools.boat.core import Boat
from tools.boat.orders import OrderError, Spoken, parse
from tools.boat.view import find_line, link_line, picture
from tools.buses import free_udp_ports
from tools.errors import FAILED, UNUSABLE
from tools.fleet.machine import boat_radio, drone_settings, read_fleet
from tools.fleet.text import mission_text

ROOT = Path(__file__).parents[2]
DEADLINE_S = 25.0
OBEYS = {
    operator_t.NONE: State.MONITOR,
    operator_t.HOLD: State.HOLD,
    operator_t.RETURN: State.RETURN,
}


def now_us() -> int:
    return time.monotonic_ns() // 1000


class Drone:
    """A relay on a real socket, and a navigator that obeys at once."""

    def __init__(self, mission: Mission, drone_id: int) -> None:
        spec = drone_settings(
            mission, drone_id, bus_url="", run="t", run_dir=Path(), log_path=Path("t.mcap")
        ).drivers["radio"]
        self.radio: UdpRadio = load_driver(spec)
        self.relay = Relay(
            own_id=drone_id,
            roster=mission.roster,
            fleet_key=read_key(Path(mission.radio.key_file)),
            session=self.radio.session_id(),
            send=self.radio.send,
            reachable=self.radio.peers,
            bytes_per_s=6000,
            lost_after_s=3.0,
            now_us=now_us(),
        )
        self.id, self.due_us, self.animal = drone_id, now_us(), 10 + drone_id

    def turn(self) -> None:
        for data in self.radio.receive():
            self.relay.receive(data, now_us())
        if now_us() < self.due_us:
            return
        self.due_us += round(TICK_S * 1e6)
        fleet = self.relay.fleet_state(now_us())
        order = fleet.order
        if self.animal in fleet.left:
            self.animal = -1
        mission = make(
            mission_state_t, state=OBEYS[order.command], animal=self.animal, found=True, found_n_m=40.0
        )
        vehicle = make(vehicle_state_t, utime=now_us(), d_m=-30.0, battery=0.8, position_ok=True)
        self.relay.describe(mission, vehicle, now_us())
        self.relay.tick(now_us())


class Bench:
    """Two drones and the fleet file with which a boat joins them."""

    def __init__(self, folder: Path) -> None:
        ports = free_udp_ports(3)
        drones = tuple(
            DroneEntry(id=k, home_e_m=10.0 * k, machine=MachineSettings(radio=f"127.0.0.1:{ports[k]}"))
            for k in (1, 2)
        )
        self.path = folder / "fleet.toml"
        written = Mission(drones=drones, boat=BoatSettings(radio=f"127.0.0.1:{ports[0]}"))
        self.path.write_text(mission_text(written))
        assert load_mission(self.path, Mission) == written
        make_key(folder / "fleet.key")
        self.mission = read_fleet(self.path)
        self.drones = [Drone(self.mission, k) for k in (1, 2)]

    def fly_while(self, goes_on: Callable[[], bool]) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while goes_on():
            assert time.monotonic() < deadline
            select.select([drone.radio for drone in self.drones], [], [], 0.05)
            for drone in self.drones:
                drone.turn()

    def boat(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run the command beside the drones."""
        code = "from tools.cli import main; main()"
        with subprocess.Popen(
            [sys.executable, "-c", code, "boat", str(self.path), *arguments],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            self.fly_while(lambda: process.poll() is None)
            out, error = process.communicate()
        return subprocess.CompletedProcess(arguments, process.returncode, out, error)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    for drone in made.drones:
        drone.radio.close()


def test_a_script_gives_an_order_and_ends_when_it_is_obeyed(bench):
    done = bench.boat("--say", "leave 12")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("said: leave 12\nobeyed by all within ")
    assert [drone.animal for drone in bench.drones] == [11, -1]
    status = bench.boat("--status")
    assert "drones 1 MONITOR over 11, 2 MONITOR" in status.stdout
    assert "pod found at 15.30036, -61.50000: 40 m north" in status.stdout


def test_an_order_that_is_not_obeyed_is_exit_1_and_names_who_does_not(bench, monkeypatch):
    monkeypatch.setitem(OBEYS, operator_t.HOLD, State.MONITOR)
    done = bench.boat("--say", "hold 2")
    assert done.returncode == FAILED
    assert "hold 2: not obeyed by drone 2 within 8 s" in done.stderr


def test_at_a_terminal_orders_are_typed_below_the_view(bench):
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (40, 100))
    code = "from tools.cli import main; main()"
    seen = bytearray()
    with subprocess.Popen(
        [sys.executable, "-c", code, "boat", str(bench.path)],
        cwd=ROOT,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
    ) as process:
        os.close(theirs)

        def read() -> None:
            if select.select([ours], [], [], 0)[0]:
                with contextlib.suppress(OSError):  # the other end was closed: it has ended
                    seen.extend(os.read(ours, 65536))

        try:
            bench.fly_while(lambda: (read(), b"% lost" not in seen)[1])
            os.write(ours, b"holx\x7fd 2\r")
            order = bench.drones[1].relay
            bench.fly_while(lambda: (read(), order.fleet_state(now_us()).order.command != operator_t.HOLD)[1])
            assert bench.drones[0].relay.fleet_state(now_us()).order.command == operator_t.NONE
            os.write(ours, b"quit\r")
            bench.fly_while(lambda: (read(), process.poll() is None)[1])
        finally:
            process.kill()
    os.close(ours)
    assert process.returncode == 0
    assert b"said: hold 2" in seen


def test_what_is_no_order_is_told_before_anything_is_sent(bench):
    done = bench.boat("--say", "leaf 3")
    assert done.returncode == UNUSABLE
    assert "'leaf 3' is no order; leave?" in done.stderr


@pytest.mark.parametrize(
    ("line", "order"),
    [
        ("start", Spoken(operator_t.START)),
        ("HOLD 2", Spoken(operator_t.HOLD, 2)),
        (" return all ", Spoken(operator_t.RETURN)),
        ("land 1", Spoken(operator_t.LAND, 1)),
        ("leave 0", Spoken(operator_t.LEAVE, 0, 0)),
        ("watch 12", Spoken(operator_t.WATCH, 0, 12)),
    ],
)
def test_what_is_typed(line, order):
    assert parse(line, (1, 2)) == order
    assert parse(str(order).replace("(all)", ""), (1, 2)) == order


@pytest.mark.parametrize(
    "line", ["", "hold 3", "hold two", "hold 1 2", "leave", "leave -1", "leave 255", "watch", "go"]
)
def test_what_is_no_order(line):
    with pytest.raises(OrderError):
        parse(line, (1, 2))


def test_the_view_shows_the_find_each_drone_and_what_was_not_obeyed_and_a_lone_order_holds_on(bench):
    radio = load_driver(boat_radio(bench.mission))
    boat = Boat(bench.mission, read_key(Path(bench.mission.radio.key_file)), radio, now_us())

    def shown() -> str:
        console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
        console.print(picture(boat, now_us(), link_line(boat, now_us()), "hol", ""))
        console.file.close()
        return console.export_text()

    due_us = now_us()

    def sail() -> None:
        nonlocal due_us
        boat.hear(now_us())
        if now_us() >= due_us:
            due_us += round(TICK_S * 1e6)
            boat.tick(now_us())

    def until(is_so: Callable[[], bool]) -> None:
        bench.fly_while(lambda: (sail(), not is_so())[1])

    assert "no drone hears the boat" in shown()
    until(lambda: boat.is_linked(now_us()) and len(boat.rows(now_us())) == 2)
    text = shown()
    assert "40 m north" in find_line(boat, now_us())
    assert "MONITOR" in text
    assert " 12 " in text
    assert "> hol" in text
    held = boat.say(Spoken(operator_t.HOLD, 2), now_us())
    assert "not yet by drone 2" in shown()
    until(lambda: not boat.left_to_obey(held, now_us()))
    left = boat.say(Spoken(operator_t.LEAVE, animal=11), now_us())
    until(lambda: not boat.left_to_obey(left, now_us()))
    assert bench.drones[1].relay.fleet_state(now_us()).order.command == operator_t.HOLD
    radio.close()
