"""One peer as the relay sees it: when it was heard, how its clock stands, what waits for it and what was
sent to it."""

from collections import deque
from dataclasses import dataclass, field

from lcmtypes import channels, make
from lcmtypes.podwatch import link_t
from procs.relay.budget import ByteWindow, MessageQueue
from procs.relay.clock_sync import FleetOffer, LinkClock
from procs.relay.datagram import Body, ClockPart

__all__ = ["LINK_KIND", "NEVER_MS", "KindAccount", "Link"]

LINK_KIND = "link"  # the relay's own datagrams, beside the channels' names
LATEST_US = 2_000_000  # a datagram that was under way for longer was held back somewhere: not believed
UNMEASURED_US = 50_000  # taken for the time under way while the peer's clock is not measured
N_STAMPS = 200  # datagrams sent that an echo may still name: several seconds of them
NEVER_MS = 2**31 - 1


@dataclass
class KindAccount:
    """Bytes of one kind of datagram; the largest since start."""

    bytes_out: int = 0  # since the last report
    max_payload: int = 0
    max_encoded: int = 0
    max_datagram: int = 0


def _accounts() -> dict[str, KindAccount]:
    return {kind: KindAccount() for kind in (LINK_KIND, *(channel.name for channel in channels.CROSSING))}


@dataclass
class Link:
    """The state of one link. Times in us of the own clock."""

    peer_id: int
    window: ByteWindow
    limit_us: int  # silent for longer, it is down
    queue: MessageQueue = field(default_factory=MessageQueue)
    clock: LinkClock = field(default_factory=LinkClock)
    accounts: dict[str, KindAccount] = field(default_factory=_accounts)
    heard_us: int | None = None  # when a datagram came last
    heard_by_peer_us: int | None = None  # when the peer last said that it hears us
    sent_stamps_us: deque[int] = field(default_factory=lambda: deque(maxlen=N_STAMPS))
    peer_stamp_us: int = 0  # of the datagram heard last, peer's clock
    is_knocking: bool = False  # the peer calls in a session that it has not proven: it needs our challenge
    n_rejected: int = 0
    n_unsent: int = 0  # datagrams that the radio did not take

    def restart(self) -> None:
        """The peer's relay has begun a new session: its clock may be another too."""
        self.clock = LinkClock()
        self.heard_us = self.heard_by_peer_us = None

    def sent_here_us(self, stamp_us: int, now_us: int) -> int:
        """The peer's stamp by the own clock, never in the future."""
        offset_us = self.clock.offset_us(now_us)
        return now_us - UNMEASURED_US if offset_us is None else min(now_us, stamp_us - offset_us)

    def is_late(self, stamp_us: int, now_us: int) -> bool:
        """Whether a datagram with that stamp was under way for so long that somebody held it back."""
        return now_us - self.sent_here_us(stamp_us, now_us) > LATEST_US

    def hear(self, body: Body, now_us: int) -> None:
        """A believed datagram came."""
        self.heard_us, self.peer_stamp_us = now_us, body.stamp_us
        clock = body.clock
        # An echo of an earlier life of this relay would compare with a clock that may have begun anew since.
        if clock is not None and clock.held_us is not None and clock.echo_us in self.sent_stamps_us:
            self.heard_by_peer_us = now_us
            self.clock.add(clock.echo_us, body.stamp_us - clock.held_us, body.stamp_us, now_us)

    def clock_part(self, offer: FleetOffer, now_us: int) -> ClockPart:
        """What to send so that the peer can measure its clock against ours."""
        if self.heard_us is None or not self.is_heard(now_us):
            return ClockPart(0, None, offer)
        return ClockPart(self.peer_stamp_us, now_us - self.heard_us, offer)

    def is_heard(self, now_us: int) -> bool:
        """Whether the peer was heard within the limit."""
        return self.heard_us is not None and now_us - self.heard_us <= self.limit_us

    def is_up(self, now_us: int) -> bool:
        """Whether both ends have heard each other within the limit."""
        by_peer_us = self.heard_by_peer_us
        return self.is_heard(now_us) and by_peer_us is not None and now_us - by_peer_us <= self.limit_us

    def count_sent(self, kind: str, payload: int, encoded: int, size: int) -> None:
        """A datagram has gone out to the radio."""
        account = self.accounts[kind]
        account.bytes_out += size
        account.max_payload = max(account.max_payload, payload)
        account.max_encoded = max(account.max_encoded, encoded)
        account.max_datagram = max(account.max_datagram, size)

    def report(self, loss: float, now_us: int) -> link_t:
        """The link's line in LINK_STATE; begins a new second of counting."""
        kinds = list(self.accounts)
        accounts = list(self.accounts.values())
        message = make(
            link_t,
            peer_id=self.peer_id,
            up=self.is_up(now_us),
            age_ms=NEVER_MS if self.heard_us is None else min((now_us - self.heard_us) // 1000, NEVER_MS),
            loss=loss,
            offset_us=self.clock.offset_us(now_us) or 0,
            round_trip_us=min(self.clock.round_trip_us(now_us), NEVER_MS),
            n_rejected=self.n_rejected,
            n_dropped=self.queue.n_dropped + self.n_unsent,
            cap_bytes_s=self.window.bytes_per_s,
            n_kinds=len(kinds),
            kinds=kinds,
            bytes_out=[account.bytes_out for account in accounts],
            max_payload=[account.max_payload for account in accounts],
            max_encoded=[account.max_encoded for account in accounts],
            max_datagram=[account.max_datagram for account in accounts],
        )
        for account in accounts:
            account.bytes_out = 0
        return message

    @property
    def bytes_since_report(self) -> int:
        return sum(account.bytes_out for account in self.accounts.values())
