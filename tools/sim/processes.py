"""A fleet as operating-system processes under supervisord: real multicast buses, real MAVLink over UDP, real
radios on loopback.
"""

import json
import secrets
import select
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import lcm

from drivers.sim.clock import ClockPage
from drivers.sim.remote import world_url
from lcmtypes import channels
from lcmtypes.podwatch import heartbeat_t
from procs import processes
from procs.navigator.states import State
from procs.relay.members import BOAT_ID
from procs.settings import BoatSettings, DriverSpec, DroneSettings, MachineSettings, Mission
from tools.buses import Slot, bus_url, free_udp_ports
from tools.fleet.text import mission_text
from tools.heartbeats import HeartbeatGuard, Hung, end_hung
from tools.sim.plan import RunPlan
from tools.sim.watch import Watch
from tools.supervision import Supervisor, SupervisorError, program

__all__ = ["ProcessFleet"]

START_LIMIT_S = 90.0
# supervisord looks at its children once a second, and whenever somebody speaks to it: asked twice a second it
# starts what has died within one.
CHECK_EVERY_S = 0.5
LOOK_S = 0.1
TELL_EVERY_S = 5.0
SHARED_FOLDER = Path("/dev/shm")
MASK_TRACKER = "procs.tracker.mask_tracker:MaskTracker"

Specs = dict[str, tuple[str, dict[str, Any]]]  # edge -> (driver, options)


class ProcessFleet:
    """All processes of a plan; use as a context manager. `watch` hears every bus."""

    def __init__(self, plan: RunPlan, watch: Watch) -> None:
        self.plan = plan
        self._watch = watch
        self._slot = Slot()
        # Named by the slot, which nobody else holds now: what an earlier run there left behind is known as
        # such.
        prefix = f"podwatch_s{self._slot.number}x"
        _remove(prefix)
        self._run = f"s{self._slot.number}x{secrets.token_hex(4)}"
        roster = plan.mission.roster
        sailing = (BOAT_ID, *roster)  # the boat has a radio too, for whoever sails one
        ports = free_udp_ports(3 * len(sailing))
        self._mavlink_ports = dict(zip(roster, ports[: len(roster)], strict=True))
        self._radio_ports = dict(zip(sailing, ports[len(roster) :], strict=False))
        self._ether_ports = dict(zip(sailing, ports[len(roster) + len(sailing) :], strict=False))
        self._heard: set[str] = set()
        self._guard = HeartbeatGuard()
        self._world = lcm.LCM(world_url(self._slot.number))
        self._buses = [self._listen(drone_id) for drone_id in roster]
        self._page_path = SHARED_FOLDER / f"podwatch_{self._run}_clock"
        self._page = ClockPage(self._page_path, create=True)
        self._write_settings()
        world = {"world": ("-m", "tools.sim.world_process", plan.folder / "output" / "world.json")}
        self.supervisor = Supervisor(plan.folder, roster, self._slot.fileno(), world)
        self._next_check = 0.0
        self._in_flight = False

    def __enter__(self) -> "ProcessFleet":
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    @property
    def now_s(self) -> float:
        """Simulation time, s."""
        return self._page.read()[0] / 1e6

    def wait_until_ready(
        self, check_interrupt: Callable[[], None], tell: Callable[[str], None] = lambda _: None
    ) -> None:
        """Until every process has beaten once; then the simulation clock begins.

        `tell` is given a line now and then, for people. Raises SupervisorError, and what `check_interrupt`
        raises.
        """
        wanted = {program(d, p.name) for d in self.plan.mission.roster for p in processes.PROCESSES}
        began_s = told_s = time.monotonic()
        while self._page.read()[1] == 0:
            check_interrupt()
            missing = sorted(wanted - self._heard) or ["world"]
            now_s = time.monotonic()
            if now_s > began_s + START_LIMIT_S:
                raise SupervisorError(
                    f"{', '.join(missing)}: not ready within {START_LIMIT_S:.0f} s; is the machine too busy? "
                    f"What they said is in {self.plan.folder / 'output'}"
                )
            if missing == ["world"]:  # again and again, as the world may not listen yet
                self._command(kind="go")
            elif now_s >= told_s + TELL_EVERY_S:
                told_s = now_s
                tell(f"{len(self._heard)} of {len(wanted)} run after {now_s - began_s:.0f} s")
            self.look()
        tell(f"All {len(wanted)} run after {time.monotonic() - began_s:.0f} s; the fleet begins.")
        self._in_flight = True

    def look(self) -> None:
        """Hear what waits on the buses; end what hangs; now and then see whether the tree still stands."""
        ready, _, _ = select.select(self._buses, [], [], LOOK_S)
        for bus in ready:
            while bus.handle_timeout(0) > 0:
                pass
        for hung in self._guard.look(time.monotonic(), self.now_s):
            self._end(hung)
        if time.monotonic() >= self._next_check:
            self._next_check = time.monotonic() + CHECK_EVERY_S
            self.supervisor.check(in_flight=self._in_flight)

    def close(self) -> None:
        """Stop all in order; leave nothing in shared memory."""
        self.supervisor.stop()
        _remove(f"podwatch_{self._run}_")
        self._slot.close()

    def dive(self, on: bool) -> None:
        self._command(kind="dive", on=on)

    def cut(self, first: int, second: int, on: bool) -> None:
        self._command(kind="cut", between=[first, second], on=on)

    def kill(self, drone_id: int) -> None:
        """The whole drone, vehicle and processes."""
        self._command(kind="kill", drone=drone_id)
        self._guard.forget(drone_id)
        names = {program(drone_id, process.name) for process in processes.PROCESSES}
        pids = [pid for name, (_, pid) in self.supervisor.states().items() if name in names]
        self.supervisor.drop_drone(drone_id, pids)

    def _end(self, hung: Hung) -> None:
        """Kill a process that hangs, so that supervisord starts it again, where the table lets it."""
        _, pid = self.supervisor.states().get(program(hung.drone_id, hung.process), ("", 0))
        told = end_hung(hung, pid, self._watch.states.get(hung.drone_id, State.IDLE))
        if told:
            self._watch.note(told)

    def _listen(self, drone_id: int) -> Any:
        bus = lcm.LCM(bus_url(drone_id, self._slot.number))
        handle = bus.subscribe(".*", partial(self._hear, drone_id))
        handle.set_queue_capacity(2000)
        return bus

    def _hear(self, drone_id: int, channel: str, data: bytes) -> None:
        if channel == channels.HEARTBEAT:
            beat = heartbeat_t.decode(data)
            self._heard.add(program(drone_id, beat.process))
            self._guard.beat(drone_id, beat.process, beat.pid)
        self._watch.hear(drone_id, channel, data)

    def _command(self, **command: Any) -> None:
        self._world.publish(channels.WORLD_COMMAND, json.dumps(command).encode())

    def _write_settings(self) -> None:
        output = self.plan.folder / "output"
        output.mkdir(exist_ok=True)
        (output / "world.json").write_text(json.dumps(self._world_settings()))
        for drone_id in self.plan.mission.roster:
            path = output / f"drone_{drone_id}.json"
            path.write_text(self._drone_settings(drone_id).model_dump_json(indent=1))
        (self.plan.folder / "boat.toml").write_text(mission_text(self._boat_mission()))

    def _boat_mission(self) -> Mission:
        """The fleet file with which `podwatch boat` joins this run: it flies by the simulation's clock."""
        mission = self.plan.plain_mission
        drones = [
            entry.model_copy(
                update={"machine": MachineSettings(radio=f"127.0.0.1:{self._ether_ports[entry.id]}")}
            )
            for entry in mission.drones
        ]
        clock = DriverSpec(driver="drivers.sim.clock:SimClock", options={"page": str(self._page_path)})
        boat = BoatSettings(radio=f"127.0.0.1:{self._radio_ports[BOAT_ID]}", drivers={"clock": clock})
        return mission.model_copy(update={"drones": tuple(drones), "boat": boat})

    def _world_settings(self) -> dict[str, Any]:
        plan = self.plan
        return {
            "mission": plan.mission.model_dump(mode="json"),
            "folder": str(plan.folder),
            "sensor": plan.sensor,
            "scene": str(plan.scene) if plan.scene else "",
            "slot": self._slot.number,
            "clock_page": str(self._page_path),
            "mavlink_ports": self._mavlink_ports,
            "radio_ports": self._radio_ports,
            "ether_ports": self._ether_ports,
            "autopilots": dict(zip(plan.mission.roster, plan.autopilots, strict=False)),
        }

    def _drone_settings(self, drone_id: int) -> DroneSettings:
        mission = self.plan.mission
        specs = {**self._edges(drone_id), **self._models(drone_id)}
        return DroneSettings(
            drone_id=drone_id,
            mission=mission,
            seed=mission.seed,
            bus_url=bus_url(drone_id, self._slot.number),
            run_dir=str(self.plan.folder),
            log_path=str(self.plan.log_path(drone_id)),
            drivers={
                name: DriverSpec(driver=driver, options=options) for name, (driver, options) in specs.items()
            },
        )

    def _edges(self, drone_id: int) -> Specs:
        """A drone's clock, camera, frames, autopilot link and radio in this run."""
        mission, camera = self.plan.mission, self.plan.mission.camera
        clock = self.plan.clock(drone_id)
        page = str(self._page_path)
        peers = [peer for peer in (BOAT_ID, *mission.roster) if peer != drone_id]
        return {
            "clock": (
                "drivers.sim.clock:SimClock",
                {"page": page, "offset_us": clock.offset_us, "drift_ppm": clock.drift_ppm},
            ),
            "camera": (
                "drivers.sim.remote:RemoteCamera",
                {
                    "drone_id": drone_id,
                    "world_url": world_url(self._slot.number),
                    "clock_page": page,
                    "image_size": [camera.width_px, camera.height_px],
                    "vfov_deg": camera.vfov_deg,
                    "surface": self.plan.surface_options(),
                    "poster": mission.pod.poster,
                },
            ),
            "frames": ("drivers.frames:SharedFrames", {"run": self._run, "drone_id": drone_id}),
            "autopilot": (
                "drivers.autopilots.mavlink_link:MavlinkUdp",
                {"listen": f"127.0.0.1:{self._mavlink_ports[drone_id]}", "system_id": drone_id},
            ),
            "radio": (
                "drivers.radios.udp:UdpRadio",
                {
                    "bind": f"127.0.0.1:{self._radio_ports[drone_id]}",
                    "peers": {str(peer): f"127.0.0.1:{self._ether_ports[peer]}" for peer in peers},
                },
            ),
        }

    def _models(self, drone_id: int) -> Specs:
        """What looks at the pixels; their stand-ins with `--sensor boxes`."""
        if self.plan.sensor != "boxes":
            options = self.plan.mission.detector.options()
            return {"detector": ("procs.detector.yolo:Detector", options), "tracker": (MASK_TRACKER, {})}
        seed = {"seed": self.plan.mission.seed * 100 + drone_id}
        return {
            "detector": ("drivers.sim.boxes:BoxDetector", seed),
            "tracker": ("drivers.sim.boxes:BoxTracker", seed),
        }


def _remove(prefix: str) -> None:
    """Take out of shared memory all that is named so."""
    for leftover in SHARED_FOLDER.glob(f"{prefix}*"):
        leftover.unlink(missing_ok=True)
