"""What the boat shows: the find, every drone and its animal, how old that is, and what was ordered."""

import pymap3d
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from lcmtypes.podwatch import fleet_row_t
from procs.navigator.states import State
from tools.boat.core import Boat, Given
from tools.boat.orders import HELP
from tools.evidence import state_name

__all__ = ["find_line", "link_line", "picture", "status_line"]

OLD_S = 3.0
N_ORDERS = 4


def link_line(boat: Boat, now_us: int) -> str:
    """Whom the boat hears."""
    up = [link for link in boat.links(now_us) if link.up]
    if not up:
        return "no drone hears the boat"
    if not boat.is_linked(now_us):
        return f"drone {up[0].peer_id} hears the boat; it does not know the fleet's time yet"
    return "; ".join(
        f"drone {link.peer_id}, {link.age_ms / 1000:.1f} s ago, {link.loss:.0%} lost" for link in up
    )


def find_line(boat: Boat, now_us: int) -> str:
    """Where the pod is, "" where none was found."""
    row, origin = boat.find(now_us), boat.mission.origin
    if row is None:
        return ""
    latitude, longitude, _ = pymap3d.ned2geodetic(
        row.found_n_m, row.found_e_m, 0.0, origin.latitude_deg, origin.longitude_deg, origin.altitude_m
    )
    return (
        f"pod found at {latitude:.5f}, {longitude:.5f}: {row.found_n_m:.0f} m north, {row.found_e_m:.0f} m "
        f"east, {row.pod_radius_m:.0f} m from its middle to its edge"
    )


def status_line(boat: Boat, now_us: int) -> str:
    """The fleet in one line, for scripts."""
    rows = boat.rows(now_us)
    drones = ", ".join(
        f"{drone_id} {_state(rows.get(drone_id))}{_over(rows.get(drone_id))}"
        for drone_id in boat.mission.roster
    )
    return f"drones {drones}" + (f"; {find}" if (find := find_line(boat, now_us)) else "")


def picture(boat: Boat, now_us: int, link: str, typed: str, said: str) -> RenderableType:
    """The whole view. link: of `link_line`, taken once a second. typed: the line so far."""
    rows, left = boat.rows(now_us), list(boat.state(now_us).left)
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 2, 0, 0))
    for title in ("drone", "state"):
        table.add_column(title, no_wrap=True)
    for title in ("animal", "height", "battery", "north", "east", "heard"):
        table.add_column(title, justify="right", no_wrap=True)
    for drone_id in boat.mission.roster:
        table.add_row(str(drone_id), *_cells(rows.get(drone_id)))
    orders = [
        Text(
            f"  {(now_us - given.at_us) / 1e6:5.0f} s ago  {given.spoken}{_obeyed(boat, given, now_us)}",
            style="dim",
        )
        for given in boat.given[-N_ORDERS:]
    ]
    return Group(
        Text(boat.mission.name, style="bold").append(f"   {link}", style="not bold"),
        Text(
            find_line(boat, now_us) or "no find yet", style="bold green" if find_line(boat, now_us) else "dim"
        ),
        table,
        *([Text(f"left alone: animal {', '.join(map(str, left))}", style="cyan")] if left else []),
        *orders,
        Text(said, style="yellow"),
        Text(HELP, style="dim"),
        Text(f"> {typed}▏"),
    )


def _cells(row: fleet_row_t | None) -> list[Text]:
    if row is None:
        return [Text("never heard", style="dim")]
    age_s = row.age_ms / 1000
    style = "" if row.alive and age_s <= OLD_S else "red"
    return [
        Text(_state(row), style=style or ("bold green" if row.state == State.MONITOR else "")),
        Text(str(row.animal) if row.animal >= 0 else "-", style=style),
        Text(f"{-row.d_m:.0f} m", style=style),
        Text(f"{row.battery:.0%}", style=style),
        Text(f"{row.n_m:.0f} m", style=style),
        Text(f"{row.e_m:.0f} m", style=style),
        Text(f"{age_s:.1f} s" if row.alive else f"lost, {age_s:.0f} s", style=style),
    ]


def _state(row: fleet_row_t | None) -> str:
    return "never heard" if row is None else state_name(row.state) if row.alive else "lost"


def _over(row: fleet_row_t | None) -> str:
    return f" over {row.animal}" if row is not None and row.alive and row.animal >= 0 else ""


def _obeyed(boat: Boat, given: Given, now_us: int) -> str:
    waiting = boat.left_to_obey(given, now_us) if given is boat.given[-1] else []
    return f": not yet by drone {', '.join(map(str, waiting))}" if waiting else ""
