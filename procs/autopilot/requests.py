"""What the bridge asks of the autopilot and asks again until it is answered: commands, streams, parameters.

None of them waits: each is asked for again and again with the time as an argument, and says what is due to be
sent.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.autopilots.ardupilot import mavlink

__all__ = ["Command", "Commands", "Parameters", "Streams"]

ANSWER_US = 500_000  # after which a command is sent again
REFUSED_US = 1_000_000  # after a refusal before the same command is sent again
STREAM_ATTEMPTS = 4
PARAMETER_US = 1_000_000
PARAMETER_ATTEMPTS = 3  # fact 14: an unknown name gets no answer at all
PARAMETER_TOLERANCE = 1e-4  # relative; values travel as float32


@dataclass
class Command:
    """One command on its way: `parameters` are param1 onwards, `confirmation` counts the repeats."""

    command: int
    parameters: tuple[float, ...]
    next_us: int
    confirmation: int = 0
    sent: bool = False


class Commands:
    """At most one of each command is on its way; `ask` it as long as it is wanted."""

    def __init__(self) -> None:
        self._waiting: dict[int, Command] = {}

    def ask(self, command: int, *parameters: float, utime: int) -> None:
        """Want a command; other parameters replace what was wanted before."""
        waiting = self._waiting.get(command)
        if waiting is None or waiting.parameters != parameters:
            self._waiting[command] = Command(command, parameters, utime)

    def drop(self, command: int) -> None:
        """No longer want a command."""
        self._waiting.pop(command, None)

    def due(self, utime: int) -> list[Command]:
        """The commands to send now."""
        due = [waiting for waiting in self._waiting.values() if waiting.next_us <= utime]
        for waiting in due:
            waiting.confirmation = min(waiting.confirmation + 1, 255) if waiting.sent else 0
            waiting.sent = True
            waiting.next_us = utime + ANSWER_US
        return due

    def answered(self, command: int, result: int, utime: int) -> Command | None:
        """The command that a COMMAND_ACK accepts, if any; a refused one is asked again later."""
        waiting = self._waiting.get(command)
        if waiting is None or not waiting.sent or result == mavlink.MAV_RESULT_IN_PROGRESS:
            return None
        if result == mavlink.MAV_RESULT_ACCEPTED:
            return self._waiting.pop(command)
        waiting.next_us = utime + REFUSED_US
        waiting.sent = False
        return None


class Streams:
    """Asks for the messages that we want, one at a time: an answer does not say which it is about."""

    def __init__(self, rates_hz: Sequence[tuple[int, float]]) -> None:
        self._rates_hz = tuple(rates_hz)
        self._left: list[tuple[int, float]] = []
        self._next_us = 0
        self._attempts = 0

    @property
    def is_done(self) -> bool:
        """Whether all was asked for and answered."""
        return not self._left

    def restart(self, utime: int) -> None:
        """Ask for all again: a new link or a restarted autopilot (fact 1)."""
        self._left = list(self._rates_hz)
        self._next_us = utime
        self._attempts = 0

    def due(self, utime: int) -> tuple[int, float] | None:
        """(message id, interval in us) to ask for now."""
        if not self._left or utime < self._next_us:
            return None
        if self._attempts == STREAM_ATTEMPTS:  # the answer may have been lost: go on, and come back to it
            self._left.append(self._left.pop(0))
            self._attempts = 0
        self._attempts += 1
        self._next_us = utime + ANSWER_US
        message_id, rate_hz = self._left[0]
        return message_id, 1e6 / rate_hz

    def answered(self, utime: int) -> None:
        """The autopilot has answered, be it a refusal: another time will not change it."""
        if self._attempts:
            self._left.pop(0)
            self._attempts = 0
            self._next_us = utime


@dataclass
class _Wish:
    """A parameter under the names that versions give it, the newest first; units differ too."""

    names: tuple[tuple[str, float], ...]
    is_needed: bool
    name_index: int = 0
    attempts: int = 0
    next_us: int = 0
    is_set: bool = False
    refused: str = ""


class Parameters:
    """Sets parameters, under the names of other versions too, and knows which of the needed ones was not set.

    needed, preferred: for each parameter its (name, value) in each version of the autopilot.
    """

    def __init__(
        self,
        needed: Sequence[tuple[tuple[str, float], ...]],
        preferred: Sequence[tuple[tuple[str, float], ...]] = (),
    ) -> None:
        self._wishes = [_Wish(names, True) for names in needed] + [_Wish(names, False) for names in preferred]
        self._begun = False

    def restart(self, utime: int) -> None:
        """Set all again."""
        self._wishes = [_Wish(wish.names, wish.is_needed, next_us=utime) for wish in self._wishes]
        self._begun = True

    def due(self, utime: int) -> list[tuple[str, float]]:
        """(name, value) of each PARAM_SET to send now."""
        due = []
        for wish in self._wishes if self._begun else ():
            if wish.is_set or wish.name_index == len(wish.names) or utime < wish.next_us:
                continue
            if wish.attempts == PARAMETER_ATTEMPTS:
                wish.name_index += 1
                wish.attempts = 0
                if wish.name_index == len(wish.names):
                    continue
            wish.attempts += 1
            wish.next_us = utime + PARAMETER_US
            due.append(wish.names[wish.name_index])
        return due

    def heard(self, name: str, value: float) -> None:
        """A PARAM_VALUE."""
        for wish in self._wishes:
            for known, wanted in wish.names:
                if known == name:
                    wish.is_set = abs(value - wanted) <= PARAMETER_TOLERANCE * max(1.0, abs(wanted))
                    wish.refused = "" if wish.is_set else f"{name} is {value:g}, wanted {wanted:g}"

    def problem(self) -> str:
        """What is needed and could not be set, for people; empty while it is still being tried."""
        texts = [
            wish.refused or f"{wish.names[0][0]} got no answer"
            for wish in self._wishes
            if wish.is_needed and not wish.is_set and wish.name_index == len(wish.names)
        ]
        return ", ".join(texts)
