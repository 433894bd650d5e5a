"""`podwatch play`: recorded logs on real buses again, one drone's or a whole fleet's on one clock."""

import json
import secrets
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from tools.errors import INTERRUPTED, plain_errors

if TYPE_CHECKING:
    from drivers.frames import SharedFrames
    from logs.fleet import DroneLog
    from tools.playback.player import Bus, Player

__all__ = ["play"]


def play(
    logs: Annotated[
        list[Path],
        typer.Argument(help="Logs, or a run's folder for all of its drones.", show_default=False),
    ],
    speed: Annotated[float, typer.Option(help="Seconds of the log a second.")] = 1.0,
    start: Annotated[float, typer.Option(help="First second, counted from the logs' first message.")] = 0.0,
    end: Annotated[float | None, typer.Option(help="Last second.", show_default="the logs' end")] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Begin anew at the end.")] = False,
    pause: Annotated[bool, typer.Option("--pause", help="Begin paused; a key goes on.")] = False,
    channel: Annotated[
        list[str] | None, typer.Option("--channel", "-c", help="Only this channel; RX_* is a pattern.")
    ] = None,
    without: Annotated[list[str] | None, typer.Option("--without", help="Not this channel.")] = None,
    rename: Annotated[list[str] | None, typer.Option("--rename", help="OLD=NEW name of a channel.")] = None,
    frames: Annotated[
        bool, typer.Option("--frames", help="Turn logged pictures into camera frames again.")
    ] = False,
    slot: Annotated[
        int | None, typer.Option(min=0, max=49, help="The buses' slot.", show_default="the lowest free one")
    ] = None,
    bus: Annotated[str | None, typer.Option(help="One LCM address for everything, udpm://...")] = None,
) -> None:
    """Play logs on real buses: space pauses, s steps one message, q quits.

    Several drones are one fleet on one clock, by the clock offsets that they measured in flight.
    """
    from logs.fleet import Fleet, find_logs
    from tools.log.shared import clear_errors, warn
    from tools.playback.keys import Keys
    from tools.playback.player import Player
    from tools.playback.selection import Selection, parse_renames

    console = Console(highlight=False)
    with clear_errors(), plain_errors(), ExitStack() as stack:
        selection = Selection(
            start, end, tuple(channel or ()), tuple(without or ()), parse_renames(rename or ())
        )
        fleet = Fleet(find_logs(logs), warn)
        buses = stack.enter_context(_open_buses(fleet.drone_ids, slot, bus, console))
        rings = stack.enter_context(_open_rings(fleet.drone_ids if frames else []))
        keys = stack.enter_context(Keys())
        show = _status(console, speed) if keys.is_terminal and console.is_terminal else None
        player = Player(buses, selection, _positive(speed), rings, _image_size(fleet.logs[0]), show)
        player.head.is_paused = pause and keys.is_terminal
        code = 0
        try:
            while player.play(fleet.messages(), keys) and loop and player.played.n_messages:
                player.again()
        except KeyboardInterrupt:
            code = INTERRUPTED
        done = player.played
        console.print(
            ("\n" if show else "") + f"{done.n_messages} messages and {done.n_frames} frames played, late by "
            f"{done.late_ms(0.5):.2f} ms (median), {done.late_ms(0.99):.2f} ms (99 of 100)",
            soft_wrap=True,
        )
    if code:
        raise typer.Exit(code)


def _positive(speed: float) -> float:
    from logs.exceptions import LogError

    if not speed > 0:
        raise LogError(f"--speed {speed:g}: it must be above 0")
    return speed


@contextmanager
def _open_buses(
    drone_ids: list[int], slot: int | None, address: str | None, console: Console
) -> Iterator[dict[int, "Bus"]]:
    """Each drone's bus; the slot is held for as long as they are open."""
    import lcm

    from procs.bus_executor import ROUTE_COMMAND
    from procs.runtime import RuntimeFailure
    from tools.buses import Slot, bus_url

    with ExitStack() as stack:
        if address is None and slot is None:
            slot = stack.enter_context(Slot()).number
        urls = {drone_id: address or bus_url(drone_id, slot or 0) for drone_id in drone_ids}
        try:
            opened = {url: lcm.LCM(url) for url in dict.fromkeys(urls.values())}
        except RuntimeError as error:
            raise RuntimeFailure(
                f"no bus at {', '.join(urls.values())} ({error}); is there a multicast route? "
                f"As root: {ROUTE_COMMAND}"
            ) from error
        for drone_id, url in urls.items():
            console.print(f"drone {drone_id} on {url}", soft_wrap=True)
        yield {drone_id: opened[url] for drone_id, url in urls.items()}


@contextmanager
def _open_rings(drone_ids: list[int]) -> Iterator[dict[int, "SharedFrames"]]:
    """Each drone's fresh frame ring; nothing is left in shared memory."""
    from drivers.frames import SharedFrames

    token = secrets.token_hex(4)
    rings = {drone_id: SharedFrames(f"play{token}", drone_id) for drone_id in drone_ids}
    try:
        yield rings
    finally:
        for ring in rings.values():
            ring.close()


def _image_size(log: "DroneLog") -> tuple[int, int] | None:
    """The camera's image size by the mission that the log holds, None where it holds none."""
    try:
        camera = json.loads(log.metadata.get("mission", ""))["camera"]
        return int(camera["width_px"]), int(camera["height_px"])
    except (ValueError, KeyError, TypeError):
        return None


def _status(console: Console, speed: float) -> Callable[["Player", float], None]:
    """A line that is written anew: where the play head is, and the keys."""

    def show(player: "Player", at_s: float) -> None:
        state = "paused " if player.head.is_paused else "playing"
        console.file.write(
            f"\r{at_s:9.1f} s  {state} x{speed:g}  {player.played.n_messages} messages  "
            "[space pause, s step, q quit] "
        )
        console.file.flush()

    return show
