"""Clock offsets of the links and one fleet time for all (docs/relay.md, Fleet state).

Each link is measured with four timestamps as in NTP (RFC 5905, section 8): of the recent exchanges the one
with the least round trip says the offset, since queues only ever add to it. Fleet time is the clock of the
lowest living id plus a constant; every drone says its own offset to it, so a neighbour's offset plus the
link's gives one's own, hop by hop round the ring.

Fleet time must not leap: a drone that becomes the reference keeps the offset that it had, and one that
restarts first asks what the fleet's time is. Only two partitions that meet differ, and then the one
without the lowest id steps once.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

__all__ = ["NO_REFERENCE", "FleetClock", "FleetOffer", "LinkClock"]

N_EXCHANGES = 16
EXCHANGE_LIFE_US = 8_000_000  # at 50 ppm the offset drifts 0.4 ms in this time
OFFER_LIFE_US = 3_000_000
LISTEN_US = 2_000_000  # a relay that starts listens this long before it takes its own clock for the fleet's
HOLDOVER_US = 60_000_000  # without any offer the offset is still good: 50 ppm make 3 ms of it
MIN_EXCHANGES = 4  # before a link's offset is passed on
SLEW_SHARE = 0.25  # of the error that is taken out at each update
STEP_US = 50_000  # an error larger than this is not noise: step
NO_REFERENCE = 255


class LinkClock:
    """The offset of one peer's clock, from exchanges of timestamps. All in us."""

    def __init__(self) -> None:
        self._exchanges: deque[tuple[int, int, int]] = deque(maxlen=N_EXCHANGES)  # round trip, offset, when

    def add(self, sent_us: int, peer_received_us: int, peer_sent_us: int, received_us: int) -> None:
        """One exchange: sent here, received there, answered there, received here; each by its own clock."""
        round_trip_us = (received_us - sent_us) - (peer_sent_us - peer_received_us)
        if round_trip_us < 0:
            return  # a clock was set back in between: the exchange says nothing
        offset_us = ((peer_received_us - sent_us) + (peer_sent_us - received_us)) // 2
        self._exchanges.append((round_trip_us, offset_us, received_us))

    def _best(self, now_us: int) -> tuple[int, int, int] | None:
        while self._exchanges and now_us - self._exchanges[0][2] > EXCHANGE_LIFE_US:
            self._exchanges.popleft()
        return min(self._exchanges) if self._exchanges else None

    def offset_us(self, now_us: int) -> int | None:
        """Peer's clock minus the own, None before the first exchange and when the last is too old."""
        best = self._best(now_us)
        return best[1] if best else None

    def round_trip_us(self, now_us: int) -> int:
        """The least of late, 0 where there is none."""
        best = self._best(now_us)
        return best[0] if best else 0

    @property
    def is_settled(self) -> bool:
        """Whether there were enough exchanges to pass the offset on."""
        return len(self._exchanges) >= MIN_EXCHANGES


@dataclass(frozen=True)
class FleetOffer:
    """What a drone says of fleet time: fleet time = its clock + offset_us; NO_REFERENCE where it does not
    know."""

    offset_us: int
    reference: int  # whose clock it is
    hops: int  # links between that drone and the one that says this


class FleetClock:
    """This drone's offset to fleet time, in us of its own clock."""

    def __init__(self, own_id: int, n_members: int, now_us: int) -> None:
        self.own_id = own_id
        self.offset_us = 0
        self.reference = NO_REFERENCE
        self.hops = 0
        self._max_hops = n_members
        self._started_us = now_us
        self._fed_us = now_us  # when the offset was last measured or held as the reference
        self._offers: dict[int, tuple[FleetOffer, int]] = {}

    def is_ok(self, now_us: int) -> bool:
        """Whether the offset was measured of late, or this drone is the reference."""
        return self.reference != NO_REFERENCE and now_us - self._fed_us <= HOLDOVER_US

    def offer(self, now_us: int) -> FleetOffer:
        """What this drone says of fleet time to its neighbours."""
        if not self.is_ok(now_us):
            return FleetOffer(0, NO_REFERENCE, 0)
        return FleetOffer(round(self.offset_us), self.reference, self.hops)

    def hear(self, peer_id: int, offer: FleetOffer, now_us: int) -> None:
        """Keep a peer's word on fleet time until the next update."""
        self._offers[peer_id] = (offer, now_us)

    def update(self, living: Sequence[int], links: Mapping[int, LinkClock], now_us: int) -> None:
        """Settle who the reference is and follow it. `living`: ids of the living drones."""
        lowest = min(living, default=NO_REFERENCE)
        if self.reference == self.own_id and lowest == self.own_id:
            self._fed_us = now_us
            return
        best = self._best_offer(living, links, now_us)
        if lowest == self.own_id:
            self._take_over(best, now_us)
        elif best is not None:
            measured_us, offer = best
            self._follow(measured_us, offer)
            self._fed_us = now_us

    def _best_offer(
        self, living: Sequence[int], links: Mapping[int, LinkClock], now_us: int
    ) -> tuple[int, FleetOffer] | None:
        """(own offset that follows from it, offer) of the lowest living reference by the fewest hops.

        A reference that has died serves only a drone that has no fleet time yet.
        """
        ranked = []
        for peer_id, (offer, heard_us) in self._offers.items():
            link = links[peer_id]
            offset_us = link.offset_us(now_us)
            is_fresh = now_us - heard_us <= OFFER_LIFE_US and link.is_settled and offset_us is not None
            is_known = offer.reference != NO_REFERENCE and offer.hops < self._max_hops
            is_dead = offer.reference not in living
            # What goes back to this drone itself tells it something only after a restart.
            is_news = not (is_dead or offer.reference == self.own_id) or not self.is_ok(now_us)
            if is_fresh and is_known and is_news:
                rank = (is_dead, offer.reference, offer.hops, peer_id)
                ranked.append((rank, (offset_us or 0) + offer.offset_us, offer))
        if not ranked:
            return None
        _, measured_us, offer = min(ranked, key=lambda entry: entry[0])
        return measured_us, offer

    def _take_over(self, best: tuple[int, FleetOffer] | None, now_us: int) -> None:
        """Become the reference without a leap: with the offset that the fleet has, or as the first after
        listening."""
        if not self.is_ok(now_us):
            if best is not None:
                self.offset_us = best[0]
            elif now_us - self._started_us < LISTEN_US:
                return
        self.reference, self.hops, self._fed_us = self.own_id, 0, now_us

    def _follow(self, measured_us: int, offer: FleetOffer) -> None:
        error_us = measured_us - self.offset_us
        if self.reference == NO_REFERENCE or abs(error_us) > STEP_US:
            self.offset_us = measured_us
        else:
            self.offset_us += round(SLEW_SHARE * error_us)
        self.reference, self.hops = offer.reference, offer.hops + 1
