"""The body of a datagram, inside its seal: the link's part, then a fleet table or one message of the bus.

    flags      1 byte    CLOCK, TABLE, MESSAGE
    stamp      8 bytes   us, sender's drone clock when it was sent
    ages       1 byte for the boat and each of the roster (procs.relay.members)
    clock      22 bytes, where CLOCK: the stamp last heard from the receiver, us that it was held, the
               sender's word on fleet time
    table      the rest, where TABLE (procs.relay.fleet)
    message    the rest, where MESSAGE: one byte, the place of its channel in channels.CROSSING, then the
               message as LCM encodes it

With the seal a message costs 42 bytes and one for each of the roster: 47 in a fleet of five.
"""

import struct
from dataclasses import dataclass

from procs.relay.clock_sync import FleetOffer

__all__ = ["Body", "ClockPart", "DatagramError", "MessagePart", "pack", "unpack"]

CLOCK, TABLE, MESSAGE = 1, 2, 4
HEAD = struct.Struct(">Bq")
CLOCK_PART = struct.Struct(">qIqBB")
NOT_HEARD = 0xFFFFFFFF


class DatagramError(ValueError):
    """A body that is not laid out as above: a relay of another version, since its seal was good."""


@dataclass(frozen=True)
class ClockPart:
    """What the receiver needs to measure its offset to the sender, and the sender's word on fleet time."""

    echo_us: int  # the receiver's own stamp that the sender heard last
    held_us: int | None  # since then, by the sender's clock; None where it has not heard the receiver of late
    offer: FleetOffer


@dataclass(frozen=True)
class MessagePart:
    """One message of the sender's bus."""

    channel: int  # place in channels.CROSSING
    data: bytes


@dataclass(frozen=True)
class Body:
    """One datagram, unsealed."""

    stamp_us: int
    ages: bytes
    clock: ClockPart | None = None
    table: bytes | None = None
    message: MessagePart | None = None


def pack(body: Body) -> bytes:
    """The bytes of `body`, which carries a table or a message but not both. Raises ValueError where it
    carries both."""
    if body.table is not None and body.message is not None:
        raise ValueError("a datagram carries a fleet table or a message, not both: send two")
    flags, parts = 0, [body.ages]
    if body.clock is not None:
        flags |= CLOCK
        offer, held_us = body.clock.offer, body.clock.held_us
        held = NOT_HEARD if held_us is None or not 0 <= held_us < NOT_HEARD else held_us
        parts.append(CLOCK_PART.pack(body.clock.echo_us, held, offer.offset_us, offer.reference, offer.hops))
    if body.table is not None:
        flags |= TABLE
        parts.append(body.table)
    if body.message is not None:
        flags |= MESSAGE
        parts.append(bytes([body.message.channel]) + body.message.data)
    return HEAD.pack(flags, body.stamp_us) + b"".join(parts)


def unpack(data: bytes, n_ages: int) -> Body:
    """The body in `data`; `n_ages` is the length of this fleet's age table. Raises DatagramError."""
    if len(data) < HEAD.size + n_ages:
        raise DatagramError(
            f"{len(data)} bytes: too short for {n_ages} ages; is the roster the same on all drones?"
        )
    flags, stamp_us = HEAD.unpack_from(data)
    ages, rest = data[HEAD.size : HEAD.size + n_ages], data[HEAD.size + n_ages :]
    clock = None
    if flags & CLOCK:
        if len(rest) < CLOCK_PART.size:
            raise DatagramError(f"{len(rest)} bytes where the clock part needs {CLOCK_PART.size}")
        echo_us, held, offset_us, reference, hops = CLOCK_PART.unpack_from(rest)
        clock = ClockPart(
            echo_us, None if held == NOT_HEARD else held, FleetOffer(offset_us, reference, hops)
        )
        rest = rest[CLOCK_PART.size :]
    if flags & TABLE and not flags & MESSAGE:
        return Body(stamp_us, ages, clock, table=rest)
    if flags & MESSAGE and not flags & TABLE and rest:
        return Body(stamp_us, ages, clock, message=MessagePart(rest[0], rest[1:]))
    if rest or flags & (TABLE | MESSAGE):
        raise DatagramError(f"flags {flags:#x} do not fit the {len(rest)} bytes that follow")
    return Body(stamp_us, ages, clock)
