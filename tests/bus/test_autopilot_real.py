"""The bridge flies a real autopilot; its address comes from PODWATCH_AUTOPILOT, as `udp:127.0.0.1:14550`."""

import os

import pytest

from drivers.autopilots.ardupilot import Codec
from drivers.autopilots.mavlink_link import open_link
from procs.autopilot.bridge import Bridge
from procs.settings import Mission
from tests.bus.autopilot_flights import FLOWN_M, FLOWN_WITHIN_M, Pilot, there_and_back

ADDRESSES = [
    address.strip() for address in os.environ.get("PODWATCH_AUTOPILOT", "").split(",") if address.strip()
]
READY_S = 90.0  # 41 s after boot were measured


@pytest.mark.skipif(not ADDRESSES, reason="PODWATCH_AUTOPILOT names no autopilot")
@pytest.mark.timeout(420)
@pytest.mark.parametrize("address", ADDRESSES or ["none"])
def test_a_flight_on_a_real_autopilot(address):
    link = open_link(address if address.startswith(("udp", "tcp", "serial")) else f"udp:{address}")
    try:
        ear = Codec(255, 190)
        heard: dict[str, object] = {}

        def overhear(data: bytes) -> None:
            for message in ear.parse(data):
                if message.get_srcComponent() == 1:
                    heard[message.get_type()] = message

        # First a bridge that only learns which system it is and where it stands.
        scout = Pilot(Bridge(Mission(), 1, target_system=0), link, drone_id=1)
        scout.overhear = overhear
        scout.fly_until(lambda: "HEARTBEAT" in heard, 30)
        system_id = heard["HEARTBEAT"].get_srcSystem()
        scout.bridge = Bridge(Mission(), 1, target_system=system_id)
        scout.fly_until(lambda: "GPS_GLOBAL_ORIGIN" in heard, READY_S)
        where = heard["GPS_GLOBAL_ORIGIN"]
        origin = {
            "latitude_deg": where.latitude * 1e-7,
            "longitude_deg": where.longitude * 1e-7,
            "altitude_m": where.altitude * 1e-3,
        }
        pilot = Pilot(Bridge(Mission(origin=origin), 1, target_system=system_id), link, drone_id=1)
        flown_m = there_and_back(pilot, ready_s=READY_S)
        assert flown_m == pytest.approx(FLOWN_M, abs=FLOWN_WITHIN_M)
    finally:
        link.close()
