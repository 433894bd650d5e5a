"""`podwatch spy`: a drone's bus in the terminal, as text for scripts, or in lcm-spy's windows."""

import difflib
import sys
import time
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console, Group

from tools.errors import FAILED, plain_errors

if TYPE_CHECKING:
    from tools.playback.keys import Keys
    from tools.spy.session import Session

__all__ = ["spy"]

DRAIN_S = 0.1  # the socket holds what comes between
REDRAW_S = 1.0
PAGES = ("channels", "ring")
FOOT = " ↑ ↓ choose   ← → drone   r ring or channels   q quit"
UP, DOWN, RIGHT, LEFT = "\x1b[A", "\x1b[B", "\x1b[C", "\x1b[D"


def spy(
    drone: Annotated[int, typer.Option("--drone", "-d", min=1, max=99, help="Whose bus.")] = 1,
    slot: Annotated[
        int | None, typer.Option(min=0, max=49, help="Which run's.", show_default="the lowest that runs")
    ] = None,
    url: Annotated[str | None, typer.Option(help="Another bus, udpm://GROUP:PORT.")] = None,
    channel: Annotated[
        list[str] | None, typer.Option("--channel", "-c", help="Only this channel; RX_* is a pattern.")
    ] = None,
    page: Annotated[str, typer.Option(help="channels or ring")] = PAGES[0],
    text: Annotated[bool, typer.Option("--text", help="Plain lines, for scripts.")] = False,
    seconds: Annotated[float, typer.Option(min=0.1, help="With --text: how long to listen.")] = 3.0,
    count: Annotated[int, typer.Option(min=0, help="With --text: how many times; 0: until stopped.")] = 1,
    gui: Annotated[bool, typer.Option("--gui", help="Start lcm-spy with our message types.")] = False,
) -> None:
    """Show what is said on a drone's bus: how often, how evenly, what is missing, the newest message.

    The ring's page shows each link and whom each drone takes for living. With --text the exit code is 1 where
    nothing was heard.
    """
    from tools.buses import bus_url, taken_slots
    from tools.spy.datagrams import parse_url
    from tools.spy.session import Session

    for name in channel or ():
        _known(name)
    if page not in PAGES:
        raise typer.BadParameter(f"{page!r}; there are: {', '.join(PAGES)}", param_hint="--page")
    try:
        parse_url(url or bus_url(drone, 0))
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--url") from error
    taken = taken_slots() if slot is None else [slot]
    chosen = taken[0] if taken else 0
    if gui:
        from tools.spy.gui import start

        with plain_errors():
            raise typer.Exit(start(url or bus_url(drone, chosen)))
    with (
        plain_errors(),
        Session(
            lambda drone_id: url or bus_url(drone_id, chosen),
            drone,
            follows=url is None,
            patterns=channel or (),
        ) as session,
    ):
        console = Console(highlight=False)
        if text or not console.is_terminal:
            _print_text(session, page, seconds, count, is_detailed=bool(channel))
        else:
            _show(session, page, console)


def _known(name: str) -> None:
    """Refuse a name, not a pattern, that no table knows: nobody would ever be heard there."""
    from lcmtypes import channels

    if channels.kind_of(name) is not None or set(name) & set("*?["):
        return
    names = [channel.name for channel in channels.CHANNELS]
    near = difflib.get_close_matches(name.upper(), names, n=1)
    guess = f"; did you mean {near[0]}?" if near else "."
    raise typer.BadParameter(
        f"no channel is called {name!r}{guess} There are: {', '.join(names)}, and what neighbours said: "
        f"RX_2_RING_MAP. A program of your own is heard by a pattern: '{name}*'",
        param_hint="--channel",
    )


def _print_text(session: "Session", page: str, seconds: float, count: int, *, is_detailed: bool) -> None:
    """Listen and print, `count` times."""
    from tools.spy.listener import now_us
    from tools.spy.text import channel_text, ring_text

    printed = 0
    try:
        while count == 0 or printed < count:
            _listen(session, seconds, looks_round=page == "ring")
            if page == "ring":
                lines = ring_text(session.ring, now_us())
            else:
                lines = channel_text(session.listener, now_us(), is_detailed=is_detailed)
            sys.stdout.write("\n".join(lines) + "\n")
            sys.stdout.flush()
            printed += 1
    except KeyboardInterrupt:
        return
    if not session.has_heard:
        typer.echo(
            f"podwatch: nothing was heard on {session.listener.url} in {seconds * count:g} s; does a fleet "
            "run in this slot? `podwatch doctor` lists the slots in use",
            err=True,
        )
        raise typer.Exit(FAILED)


def _listen(session: "Session", seconds: float, *, looks_round: bool) -> None:
    ends_s = time.monotonic() + seconds
    while (left_s := ends_s - time.monotonic()) > 0:
        time.sleep(min(DRAIN_S, left_s))
        session.drain()
        if looks_round:
            session.look_round()


def _show(session: "Session", page: str, console: Console) -> None:
    """The live screen, until q or Ctrl-C."""
    from rich.live import Live

    from tools.playback.keys import Keys

    selected, scrolled, draw_at_s = "", 0, 0.0
    try:
        with Keys() as keys, Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                key = _key(keys)
                session.drain()
                if key == "q":
                    return
                if key == "r":
                    page = PAGES[1 - PAGES.index(page)]
                elif key in (LEFT, RIGHT):
                    session.step(1 if key == RIGHT else -1)
                elif key in (UP, DOWN) and page == "ring":
                    scrolled = max(scrolled + (1 if key == DOWN else -1), 0)
                elif key in (UP, DOWN):
                    selected = _next_channel(session, selected, 1 if key == DOWN else -1)
                if key or time.monotonic() >= draw_at_s:
                    draw_at_s = time.monotonic() + REDRAW_S
                    live.update(render(session, page, selected, console, scrolled), refresh=True)
    except KeyboardInterrupt:
        return


def render(session: "Session", page: str, selected: str, console: Console, scrolled: int = 0) -> Group:
    """The whole screen of this moment. `scrolled`: lines of a ring that does not fit, above the screen."""
    from rich.text import Text

    from tools.spy.listener import now_us
    from tools.spy.pages import channel_page, ring_page

    width, height = console.size
    room = height - 1
    if page == "ring":
        session.look_round()
        lines = ring_page(session.ring, now_us(), width)
        n_hidden = len(lines) - room + 1
        if n_hidden > 1:
            first = min(scrolled, n_hidden)
            note = f" lines {first + 1} to {first + room - 1} of {len(lines)}: ↑ ↓ move them"
            lines = [*lines[first : first + room - 1], Text(note, style="dim")]
    else:
        lines = channel_page(session.listener, selected, now_us(), width, room)
    lines += [Text("")] * (room - len(lines))
    return Group(*lines, Text(f"{FOOT:<{width}}"[:width], style="reverse", no_wrap=True))


def _key(keys: "Keys") -> str:
    """The next key; an arrow comes as three characters."""
    key = keys.wait(DRAIN_S)
    if key == "\x1b":
        key += keys.wait(0) + keys.wait(0)
    return {"k": UP, "j": DOWN, "h": LEFT, "l": RIGHT}.get(key, key)


def _next_channel(session: "Session", selected: str, by: int) -> str:
    names = [channel.name for channel in session.listener.statistics.in_order()]
    if not names:
        return ""
    return names[(names.index(selected) + by) % len(names)] if selected in names else names[0]
