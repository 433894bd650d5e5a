"""`podwatch boat`: a terminal on the boat, or one order from a script."""

import contextlib
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tools.boat.orders import BoatError, OrderError, Spoken, parse
from tools.errors import INTERRUPTED, plain_errors

if TYPE_CHECKING:
    from tools.boat.core import Boat, Given

__all__ = ["boat"]

LINK_LIMIT_S = 20.0
OBEY_LIMIT_S = 8.0
SAID_FOR_US = 1_500_000  # an order is sent again this long
LINK_LINE_S = 1.0
STATUS_S = 5.0
REDRAW_S = 0.25


def boat(
    fleet: Annotated[Path, typer.Argument(help="The fleet file.", show_default=False)],
    say: Annotated[
        str,
        typer.Option(help="Give one order, wait until it is obeyed, and end: 'start', 'hold 2', 'leave 3'."),
    ] = "",
    status: Annotated[bool, typer.Option("--status", help="Say once how the fleet is, and end.")] = False,
) -> None:
    """See the find, every drone and its animal; type orders: start, hold, return, land, leave,
    watch.
    """
    from procs.bus_executor import DEFAULT_CLOCK, load_driver
    from procs.relay.keys import read_key
    from procs.runtime import RuntimeFailure
    from tools.boat.core import Boat
    from tools.fleet.machine import boat_radio, read_fleet

    with plain_errors():
        mission = read_fleet(fleet)
        key = read_key(Path(mission.radio.key_file))
        order = parse(say, mission.roster) if say else None
        clock = load_driver(mission.boat.drivers.get("clock", DEFAULT_CLOCK))
        try:
            radio = load_driver(boat_radio(mission))
        except RuntimeFailure as error:
            raise BoatError(f"{error}; is another `podwatch boat` open here? Type the order there") from error
        with contextlib.closing(radio):
            loop = _Loop(Boat(mission, key, radio, clock.utime()), radio, clock)
            try:
                if order is not None:
                    _say_once(loop, order)
                elif status:
                    _status_once(loop)
                elif sys.stdin.isatty() and sys.stdout.isatty():
                    _at_the_terminal(loop)
                else:
                    _from_a_pipe(loop)
            except KeyboardInterrupt:
                raise typer.Exit(INTERRUPTED) from None


class _Loop:
    """Time passes for the boat's relay while something is waited for."""

    def __init__(self, core: "Boat", radio: Any, clock: Any) -> None:
        from procs.relay.relay import TICK_S

        self.core, self._radio, self._clock, self._tick_us = core, radio, clock, round(TICK_S * 1e6)
        self._due_us = self.now_us
        signal.signal(signal.SIGTERM, signal.default_int_handler)

    @property
    def now_us(self) -> int:
        return int(self._clock.utime())

    def turn(self, *sources: Any, longest_s: float = 0.25) -> list[Any]:
        """Wait for the radio, the next tick or one of `sources` -> those that have something to read."""
        wait_s = max(0.0, min(self._clock.real_seconds((self._due_us - self.now_us) / 1e6), longest_s))
        ready, _, _ = select.select([self._radio, *sources], [], [], wait_s)
        self.core.hear(self.now_us)
        if self.now_us >= self._due_us:
            self._due_us = self.now_us + self._tick_us
            self.core.tick(self.now_us)
        return [source for source in ready if source is not self._radio]

    def until(self, is_so: Callable[[], bool], limit_s: float) -> bool:
        """Whether it became so within the limit."""
        deadline = time.monotonic() + limit_s
        while not is_so():
            if time.monotonic() > deadline:
                return False
            self.turn()
        return True


def _say_once(loop: _Loop, order: Spoken) -> None:
    given = _given(loop, order)
    typer.echo(f"said: {order}")
    # One datagram may be lost, and what asks nothing of any drone is obeyed before it is heard.
    loop.until(lambda: loop.now_us - given.at_us > SAID_FOR_US, OBEY_LIMIT_S)
    if not loop.until(lambda: not loop.core.left_to_obey(given, loop.now_us), OBEY_LIMIT_S):
        late = ", ".join(map(str, loop.core.left_to_obey(given, loop.now_us)))
        raise BoatError(
            f"{order}: not obeyed by drone {late} within {OBEY_LIMIT_S:.0f} s; see podwatch boat --status"
        )
    took_s = (loop.now_us - given.at_us) / 1e6
    typer.echo(f"obeyed by all within {took_s:.1f} s")


def _status_once(loop: _Loop) -> None:
    from tools.boat.view import status_line

    _link(loop)
    loop.until(lambda: len(loop.core.rows(loop.now_us)) == len(loop.core.mission.roster), 3.0)
    typer.echo(status_line(loop.core, loop.now_us))


def _link(loop: _Loop) -> None:
    if not loop.until(lambda: loop.core.is_linked(loop.now_us), LINK_LIMIT_S):
        raise BoatError(
            f"no drone heard the boat within {LINK_LIMIT_S:.0f} s; do they fly this fleet file with this "
            f"key? [boat] radio is {loop.core.mission.boat.radio}"
        )


def _given(loop: _Loop, order: Spoken) -> "Given":
    _link(loop)
    return loop.core.say(order, loop.now_us)


def _from_a_pipe(loop: _Loop) -> None:
    """Orders line by line, a status line each few seconds and when something has changed; until the end."""
    from tools.boat.view import status_line

    _link(loop)
    shown, due_s, n_refused = "", 0.0, 0
    while True:
        if loop.turn(sys.stdin):
            line = sys.stdin.readline()
            if not line or line.strip() == "quit":
                if n_refused:
                    raise OrderError(f"orders that were not given: {n_refused}; each is told above")
                return
            if line.strip():
                is_given, told = _answer(loop, line)
                n_refused += not is_given
                typer.echo(told)
        now = status_line(loop.core, loop.now_us)
        if now != shown or time.monotonic() >= due_s:
            shown, due_s = now, time.monotonic() + STATUS_S
            typer.echo(now)


def _answer(loop: _Loop, line: str) -> tuple[bool, str]:
    """Give the order in a line -> (whether it was given, what is told of it)."""
    try:
        order = parse(line, loop.core.mission.roster)
        watched = [row.animal for row in loop.core.rows(loop.now_us).values()]
        loop.core.say(order, loop.now_us)
    except (OrderError, BoatError) as error:
        return False, str(error)
    nobody = order.animal >= 0 and order.animal not in watched
    return True, f"said: {order}" + (f" (nobody watches animal {order.animal} now)" if nobody else "")


def _at_the_terminal(loop: _Loop) -> None:
    """The live view with a line to type in; until `quit` or Ctrl-C."""
    from rich.console import Console
    from rich.live import Live

    from tools.boat.view import link_line, picture
    from tools.playback.keys import Keys

    typed = said = link = ""
    link_due_s = drawn_s = 0.0
    with Keys() as keys, Live(console=Console(), auto_refresh=False) as live:
        while True:
            if loop.turn(sys.stdin, longest_s=0.1):
                key = keys.wait(0.0)
                if key in ("\n", "\r"):
                    if typed.strip() == "quit":
                        return
                    said, typed = _answer(loop, typed)[1] if typed.strip() else "", ""
                elif key in ("\x7f", "\b"):
                    typed = typed[:-1]
                elif key.isprintable():
                    typed += key
                drawn_s = 0.0
            now_s = time.monotonic()
            if now_s >= link_due_s:
                link, link_due_s = link_line(loop.core, loop.now_us), now_s + LINK_LINE_S
            if now_s - drawn_s >= REDRAW_S:
                drawn_s = now_s
                live.update(picture(loop.core, loop.now_us, link, typed, said), refresh=True)
