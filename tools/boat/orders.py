"""What a person types on the boat, and what it means: `start`, `hold 2`, `return`, `land 1`, `leave 3`,
`watch 3`."""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass

from lcmtypes.podwatch import operator_t

__all__ = ["HELP", "BoatError", "OrderError", "Spoken", "parse"]

HELP = "start [drone] | hold [drone] | return [drone] | land [drone] | leave <animal> | watch <animal> | quit"
COMMANDS = {
    "start": operator_t.START,
    "hold": operator_t.HOLD,
    "return": operator_t.RETURN,
    "land": operator_t.LAND,
    "leave": operator_t.LEAVE,
    "watch": operator_t.WATCH,
}
ABOUT_ANIMALS = (operator_t.LEAVE, operator_t.WATCH)
MOST_ANIMAL = 254


class BoatError(Exception):
    """An order that cannot be given, or was not obeyed; the message says which, why, and what to do."""


class OrderError(ValueError):
    """A line that is no order; the message says what to type."""


@dataclass(frozen=True)
class Spoken:
    """An order as it was typed. target: a drone's id, 0 for all. animal: for leave and watch, -1 else."""

    command: int
    target: int = 0
    animal: int = -1

    def __str__(self) -> str:
        word = next(word for word, command in COMMANDS.items() if command == self.command)
        if self.command in ABOUT_ANIMALS:
            return f"{word} {self.animal}"
        return f"{word} {self.target}" if self.target else f"{word} (all)"


def parse(line: str, roster: Sequence[int]) -> Spoken:
    """The order in a line. Raises OrderError."""
    words = line.lower().split()
    if not words or words[0] not in COMMANDS:
        near = difflib.get_close_matches(words[0] if words else "", COMMANDS, n=1)
        raise OrderError(f"{line.strip()!r} is no order{f'; {near[0]}?' if near else ''}. There are: {HELP}")
    command = COMMANDS[words[0]]
    if command in ABOUT_ANIMALS:
        if len(words) != 2 or not words[1].isdigit() or int(words[1]) > MOST_ANIMAL:
            raise OrderError(f"{line.strip()!r}: say which animal, by its number in the table: {words[0]} 3")
        return Spoken(command, animal=int(words[1]))
    if len(words) == 1 or (len(words) == 2 and words[1] == "all"):
        return Spoken(command)
    if len(words) != 2 or not words[1].isdigit() or int(words[1]) not in roster:
        raise OrderError(f"{line.strip()!r}: say one drone of {', '.join(map(str, roster))}, or none for all")
    return Spoken(command, target=int(words[1]))
