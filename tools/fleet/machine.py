"""From the fleet file to what the processes of one real drone are told."""

from pathlib import Path
from typing import Any

from procs.relay.members import BOAT_ID
from procs.relay.process import key_path
from procs.settings import (
    DriverSpec,
    DroneSettings,
    MachineSettings,
    Mission,
    MissionError,
    beside,
    load_mission,
)

__all__ = ["AUTOPILOT_DRIVER", "boat_radio", "drone_settings", "listen_address", "machine_of", "read_fleet"]

LOOPBACK = "127."
AUTOPILOT_DRIVER = "drivers.autopilots.mavlink_link:open_link"


def read_fleet(path: Path) -> Mission:
    """The fleet file, the places of its key and its model made absolute: beside the file unless it says
    otherwise.

    Raises MissionError.
    """
    mission = load_mission(path, Mission)
    key = key_path(str(path.resolve().parent), mission.radio.key_file)
    radio = mission.radio.model_copy(update={"key_file": str(key)})
    return beside(path, mission).model_copy(update={"radio": radio})


def machine_of(mission: Mission, drone_id: int) -> MachineSettings:
    """What the fleet file says of one drone's computer. Raises MissionError where it says nothing."""
    if drone_id not in mission.roster:
        raise MissionError(
            f"drone {drone_id} is not in the roster {list(mission.roster)}; add its [[drones]] entry, or "
            "name another with --drone"
        )
    machine = mission.home(drone_id).machine
    if machine is None:
        raise MissionError(
            f"drone {drone_id}: its [[drones]] entry has no [drones.machine] table; it needs at least: "
            'radio = "HOST:PORT", where the others reach it'
        )
    return machine


def listen_address(address: str) -> str:
    """Where to listen for what is sent to `address`: any interface, or the loopback alone."""
    return address if address.startswith(LOOPBACK) else "0.0.0.0:" + address.rpartition(":")[2]


def drone_settings(
    mission: Mission, drone_id: int, *, bus_url: str, run: str, run_dir: Path, log_path: Path
) -> DroneSettings:
    """All that the processes of one drone are told. `run` names its shared memory. Raises MissionError."""
    machine = machine_of(mission, drone_id)
    specs = {
        "camera": _camera(machine.camera, mission),
        "frames": _spec("drivers.frames:SharedFrames", run=run, drone_id=drone_id),
        "autopilot": _spec(AUTOPILOT_DRIVER, address=machine.autopilot, system_id=drone_id),
        "radio": _radio(mission, drone_id, machine.radio),
        "detector": _spec("procs.detector.yolo:Detector", **mission.detector.options()),
        "tracker": _spec("procs.tracker.mask_tracker:MaskTracker"),
    }
    return DroneSettings(
        drone_id=drone_id,
        mission=mission,
        bus_url=bus_url,
        run_dir=str(run_dir),
        log_path=str(log_path),
        drivers=specs | machine.drivers,
    )


def boat_radio(mission: Mission) -> DriverSpec:
    """The boat's radio. Raises MissionError where the file gives it no address."""
    if not mission.boat.radio:
        raise MissionError('the fleet file names no boat; add a table: [boat] radio = "HOST:PORT"')
    return _radio(mission, BOAT_ID, mission.boat.radio)


def _radio(mission: Mission, own_id: int, own_address: str) -> DriverSpec:
    peers = {peer: machine_of(mission, peer).radio for peer in mission.roster}
    if mission.boat.radio:
        peers[BOAT_ID] = mission.boat.radio
    others = {str(peer): address for peer, address in sorted(peers.items()) if peer != own_id}
    return _spec("drivers.radios.udp:UdpRadio", bind=listen_address(own_address), peers=others)


def _camera(text: str, mission: Mission) -> DriverSpec:
    """`v4l2:/dev/video0`, `gstreamer:PIPELINE`, `ffmpeg:rtsp://...`, `pictures:FOLDER`."""
    kind, _, source = text.partition(":")
    if kind == "pictures":
        return _spec("drivers.cameras.capture:PictureCamera", path=source)
    size = [mission.camera.width_px, mission.camera.height_px]
    return _spec(
        "drivers.cameras.capture:OpenCvCamera",
        source=source,
        backend=kind,
        image_size=size,
        rate_hz=mission.camera.rate_hz,
    )


def _spec(driver: str, **options: Any) -> DriverSpec:
    return DriverSpec(driver=driver, options=options)
