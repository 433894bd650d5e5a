"""The words of the bus: one struct a .lcm file, the generated classes, and the channel table."""

from typing import Any, Protocol, Self, TypeVar


class Message(Protocol):
    """What every generated message offers."""

    def encode(self) -> bytes: ...

    @classmethod
    def decode(cls, data: bytes) -> Self: ...


M = TypeVar("M")


def make(kind: type[M], /, **members: Any) -> M:
    """A message of `kind` with its members set by name; AttributeError names a member that it lacks."""
    message = kind()
    for name, value in members.items():
        setattr(message, name, value)
    return message
