"""Two relays as real processes, on two real buses, over UDP through a forwarder that counts and records."""

import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import accumulate
from pathlib import Path

import lcm
import pytest

from drivers.clocks.monotonic import MonotonicClock
from lcmtypes import channels, make, podwatch
from procs.relay.keys import make_key
from procs.settings import DriverSpec, DroneEntry, DroneSettings, Mission

ROOT = Path(__file__).parents[2]
DEADLINE_S = 40.0
SAY_S = 0.1
TWENTY_ANIMALS_AND_A_STATE = 20 * 9 + 128


def udp_socket() -> socket.socket:
    """A socket on a free port of the loopback."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind(("127.0.0.1", 0))
    return made


def address(of: socket.socket) -> str:
    return f"127.0.0.1:{of.getsockname()[1]}"


def free_address() -> str:
    with udp_socket() as probe:
        return address(probe)


class Side:
    """One drone: its relay process, its bus, and the forwarder's socket that its neighbour sends to."""

    def __init__(self, drone_id: int, folder: Path) -> None:
        self.id = drone_id
        self.address = free_address()
        self.inbox = udp_socket()  # stands for this drone in its neighbour's list of peers
        self.recorded: list[bytes] = []  # datagrams to this drone
        self.url = f"udpm://239.255.76.{190 + drone_id}:{free_address().split(':')[1]}?ttl=0"
        self.bus = lcm.LCM(f"{self.url}&recv_buf_size=4194304")
        self.settings = folder / f"drone{drone_id}.json"
        self.process: subprocess.Popen[bytes] | None = None
        self.reports: list[podwatch.link_state_t] = []
        self.last_session = 0
        self.fleet: podwatch.fleet_state_t | None = None
        self.copies: list[podwatch.ring_map_t] = []
        self.bus.subscribe(channels.LINK_STATE, self._link_state)
        self.bus.subscribe(channels.FLEET_STATE, self._fleet_state)
        self.bus.subscribe(channels.received(3 - drone_id, channels.RING_MAP), self._copy)

    def start(self, other: "Side") -> None:
        """Start the relay; what it knows from now on comes from this start."""
        self.last_session = self.reports[-1].session if self.reports else 0
        self.reports, self.fleet, other.recorded = [], None, []
        settings = DroneSettings(
            drone_id=self.id,
            mission=Mission(drones=(DroneEntry(id=1), DroneEntry(id=2, home_e_m=10.0))),
            bus_url=f"{self.url}&recv_buf_size=4194304",
            run_dir=str(self.settings.parent),
            drivers={
                "radio": DriverSpec(
                    driver="drivers.radios.udp:UdpRadio",
                    options={"bind": self.address, "peers": {str(other.id): address(other.inbox)}},
                )
            },
        )
        self.settings.write_text(settings.model_dump_json())
        command = [sys.executable, "-m", "procs.main", "relay", str(self.settings)]
        self.process = subprocess.Popen(command, cwd=ROOT)

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    @property
    def link(self) -> podwatch.link_t | None:
        return self.reports[-1].links[0] if self.reports and self.reports[-1].links else None

    def _link_state(self, _channel: str, data: bytes) -> None:
        report = podwatch.link_state_t.decode(data)
        if report.session != self.last_session:  # else it was said before the relay was killed
            self.reports.append(report)

    def _fleet_state(self, _channel: str, data: bytes) -> None:
        if self.reports:
            self.fleet = podwatch.fleet_state_t.decode(data)

    def _copy(self, _channel: str, data: bytes) -> None:
        self.copies.append(podwatch.ring_map_t.decode(data))


class Pair:
    """Both drones and the forwarder between them."""

    def __init__(self, folder: Path) -> None:
        make_key(folder / "fleet.key")
        self.one, self.two = Side(1, folder), Side(2, folder)
        self.sides = (self.one, self.two)
        self._said_s = 0.0
        self._clock = MonotonicClock()
        self.one.start(self.two)
        self.two.start(self.one)

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Forward datagrams, hear both buses and say each drone's words until `condition` holds."""
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"not within {DEADLINE_S} s: {what}"
            ready, _, _ = select.select([side.inbox for side in self.sides], [], [], 0.01)
            for side in self.sides:
                if side.inbox in ready:
                    side.recorded.append(side.inbox.recv(2048))
                    self.send(side, side.recorded[-1])
                while side.bus.handle_timeout(0):
                    pass
            if time.monotonic() - self._said_s > SAY_S:
                self._said_s = time.monotonic()
                for side in self.sides:
                    self._speak(side)

    def send(self, side: Side, datagram: bytes) -> None:
        host, port = side.address.split(":")
        side.inbox.sendto(datagram, (host, int(port)))

    def close(self) -> None:
        for side in self.sides:
            side.kill()
            side.inbox.close()

    def _speak(self, side: Side) -> None:
        utime = self._clock.utime()
        packet = bytes(TWENTY_ANIMALS_AND_A_STATE)
        for channel, message in (
            (channels.RING_MAP, make(podwatch.ring_map_t, n_bytes=len(packet), packet=packet)),
            (channels.MISSION_STATE, make(podwatch.mission_state_t, state=4)),
            (channels.VEHICLE_STATE, make(podwatch.vehicle_state_t, n_m=7.0, position_ok=True)),
        ):
            message.utime, message.drone_id = utime, side.id
            side.bus.publish(channel, message.encode())


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    pair = Pair(tmp_path)
    yield pair
    pair.close()


def is_up(side: Side) -> bool:
    return side.link is not None and bool(side.link.up)


def test_the_links_report_what_a_forwarder_counts_with_twenty_animals(pair: Pair) -> None:
    pair.until(lambda: is_up(pair.one) and is_up(pair.two), "both links up")
    n_reports = len(pair.one.reports) + 4
    pair.until(lambda: len(pair.one.reports) >= n_reports and bool(pair.two.copies), "four more reports")

    reports = list(pair.one.reports)
    assert [report.seq for report in reports] == list(range(len(reports)))
    totals = list(accumulate(sum(sum(link.bytes_out) for link in report.links) for report in reports))
    pair.until(lambda: sum(map(len, pair.two.recorded)) >= totals[-1], "what was reported has passed")
    counted = list(accumulate(map(len, pair.two.recorded), initial=0))
    # A report falls between two datagrams: it and those before it say what had passed by then, to the byte.
    for total in totals:
        assert total in counted
    assert totals[-1] > 4 * 1000

    link = reports[-1].links[0]
    assert max(link.max_datagram) == max(map(len, pair.two.recorded)) <= 500
    place = list(link.kinds).index(channels.RING_MAP)
    assert link.max_payload[place] == max(link.max_payload) == 308
    assert max(link.max_encoded) <= 400
    assert abs(link.offset_us) < 5_000  # both read this machine's clock
    pair.until(lambda: pair.one.fleet is not None and pair.one.fleet.n_rows == 2, "both rows")
    assert pair.one.fleet is not None
    assert [row.id for row in pair.one.fleet.rows] == [1, 2]
    assert pair.one.fleet.rows[1].n_m == pytest.approx(7.0)
    assert (pair.two.copies[0].drone_id, len(pair.two.copies[0].packet)) == (1, 308)


def test_datagrams_recorded_before_both_relays_were_killed_are_refused(pair: Pair) -> None:
    pair.until(lambda: is_up(pair.one) and is_up(pair.two), "both links up")
    recorded = pair.one.recorded[-40:]
    pair.one.kill()
    pair.two.kill()
    pair.one.start(pair.two)
    pair.until(lambda: bool(pair.one.reports), "the first report of the new relay")
    for datagram in recorded:
        pair.send(pair.one, datagram)
    pair.until(lambda: pair.one.link is not None and pair.one.link.n_rejected == len(recorded), "refusals")
    assert not is_up(pair.one)
    pair.until(lambda: pair.one.fleet is not None and pair.one.fleet.n_rows > 0, "its own row")
    assert pair.one.fleet is not None
    assert [row.id for row in pair.one.fleet.rows] == [1]

    pair.two.start(pair.one)
    pair.until(lambda: is_up(pair.one) and is_up(pair.two), "both links up again")
