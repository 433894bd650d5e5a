"""Authenticated datagrams: who sent it, unaltered, once, and in this life of both relays (docs/relay.md).

On the wire: version, sender, session and counter in clear (14 bytes), then ChaCha20-Poly1305 (RFC 8439)
over one byte of flags, a challenge and an echo where they are due, and the body; 16 bytes of tag. The
header is authenticated too.

The traffic key is HKDF-SHA256 (RFC 5869) of the fleet key with sender and session as its context; each
relay start has a session of its own, so no key is ever used by two senders or two lives. The nonce is
(receiver, counter), a counter for each receiver: it never repeats under one key, a datagram opens only at
the drone that it was sealed for, and the gaps in the counter are the losses of that link.

A session counts only after its sender echoed the receiver's challenge. The challenge is drawn anew for
every receiver, life of it, peer and proof, so a datagram that was recorded before cannot hold the right
echo, even when both ends have restarted since and the replay window of its session is forgotten.
"""

import hashlib
import hmac
import struct
from dataclasses import dataclass, field
from enum import Enum

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

__all__ = ["MAX_OVERHEAD_BYTES", "Opened", "Refusal", "RefusedError", "ReplayWindow", "Sessions"]

VERSION = 1
HEADER = struct.Struct(">BBQI")  # version, sender, session, counter
TAG_BYTES = 16
PROOF_BYTES = 8  # of a challenge and of its echo
HAS_CHALLENGE, HAS_ECHO = 1, 2
OVERHEAD_BYTES = HEADER.size + 1 + TAG_BYTES  # of a datagram between proven sessions
MAX_OVERHEAD_BYTES = OVERHEAD_BYTES + 2 * PROOF_BYTES  # while one of them is not
WINDOW_BITS = 64
# Unproven sessions remembered for each peer; without a limit recorded datagrams could use up the memory.
MAX_CANDIDATES = 4
MAX_CHALLENGES = 40  # sent to one candidate before it is forgotten: 10 s at 4 Hz


class Refusal(Enum):
    """Why a datagram, or the message in it, was refused: the first four here, the rest by the relay."""

    STRANGER = "stranger"  # not of this fleet: another version, sender or key
    ALTERED = "altered"  # of a known session, but the tag does not fit
    REPLAYED = "replayed"  # its counter was seen, or is older than the window
    UNPROVEN = "unproven"  # sealed with the fleet key, but its sender has not echoed our challenge
    MALFORMED = "malformed"  # believed, but laid out otherwise: a relay of another version, or another roster
    LATE = "late"  # under way for so long that somebody held it back
    NOT_NEIGHBOUR = "not a neighbour"  # a message from a drone that is not beside this one on the ring
    BAD_MESSAGE = "bad message"  # its channel may not cross, or it is not what its channel carries
    STALE = "stale"  # a message older than its channel allows


class RefusedError(Exception):
    """A datagram that is not believed: `reason`, and `sender` as it claims, None where it claims nobody of
    the fleet."""

    def __init__(self, reason: Refusal, sender: int | None) -> None:
        super().__init__(f"datagram refused: {reason.value}, claims to be from {sender}")
        self.reason = reason
        self.sender = sender


@dataclass(frozen=True)
class Opened:
    """A believed datagram: the body, and whether it is the first of a session that was proven by it."""

    sender: int
    body: bytes
    is_new_session: bool


class ReplayWindow:
    """The newest counter and a bitmap of the 64 up to it (RFC 4303, 3.4.3): each counter passes once."""

    def __init__(self) -> None:
        self._newest = -1
        self._first = -1
        self._seen = 0  # bit k: counter newest - k has passed

    def accept(self, counter: int) -> bool:
        """Whether `counter` is new; a counter 64 or more behind the newest is not."""
        if self._newest < 0:
            self._first = counter
        ahead = counter - self._newest
        if self._newest < 0 or ahead >= WINDOW_BITS:
            self._seen = 1
        elif ahead > 0:
            self._seen = (self._seen << ahead | 1) & (1 << WINDOW_BITS) - 1
        elif -ahead >= WINDOW_BITS or self._seen >> -ahead & 1:
            return False
        else:
            self._seen |= 1 << -ahead
        self._first = min(self._first, counter)
        self._newest = max(self._newest, counter)
        return True

    @property
    def loss(self) -> float:
        """Share of the last 64 counters (or of all since the first) that never came, 0-1."""
        if self._newest < 0:
            return 0.0
        return 1.0 - self._seen.bit_count() / min(WINDOW_BITS, self._newest - self._first + 1)


@dataclass
class _Session:
    number: int
    cipher: ChaCha20Poly1305
    window: ReplayWindow = field(default_factory=ReplayWindow)
    challenge: bytes = b""  # what its sender asked us to echo, empty where nothing
    challenges_sent: int = 0


@dataclass
class _Peer:
    counter: int = 0  # of the next datagram to it
    proofs: int = 0  # sessions of it that were proven; part of the challenge
    proven: _Session | None = None
    candidates: list[_Session] = field(default_factory=list)  # heard, unproven; oldest first
    turn: int = 0  # whose challenge is echoed next

    def find(self, number: int) -> _Session | None:
        if self.proven is not None and self.proven.number == number:
            return self.proven
        return next((session for session in self.candidates if session.number == number), None)


class Sessions:
    """Both directions of every link of one relay: seals what it sends, opens what it hears."""

    def __init__(self, fleet_key: bytes, own_id: int, session: int, peer_ids: tuple[int, ...]) -> None:
        """`session`: this relay start's own number, 0 to 2^63 - 1, unpredictable on a real drone."""
        self.own_id = own_id
        self.session = session
        self._fleet_key = fleet_key
        self._cipher = self._traffic_cipher(own_id, session)
        self._challenge_key = hashlib.sha256(
            b"podwatch challenge" + fleet_key + struct.pack(">BQ", own_id, session)
        ).digest()
        self._peers = {peer_id: _Peer() for peer_id in peer_ids if peer_id != own_id}

    def __repr__(self) -> str:
        return f"Sessions(own_id={self.own_id}, session={self.session:#x})"

    def seal(self, peer_id: int, body: bytes) -> bytes:
        """The datagram that carries `body` to `peer_id`, with a challenge and an echo where they are due.

        After 2^32 datagrams to one peer (over a year) struct.error ends the relay, and its restart draws a
        new session.
        """
        peer = self._peers[peer_id]
        proofs = self._proofs(peer_id, peer)
        header = HEADER.pack(VERSION, self.own_id, self.session, peer.counter)
        sealed = self._cipher.encrypt(_nonce(peer_id, peer.counter), proofs + body, header)
        peer.counter += 1
        return header + sealed

    def open(self, datagram: bytes) -> Opened:
        """The body of a datagram that is authentic, new, and of a proven session; RefusedError for any
        other."""
        if len(datagram) < OVERHEAD_BYTES or datagram[0] != VERSION:
            raise RefusedError(Refusal.STRANGER, None)
        header = datagram[: HEADER.size]
        _, sender, number, counter = HEADER.unpack(header)
        peer = self._peers.get(sender)
        if peer is None:
            raise RefusedError(Refusal.STRANGER, None)
        session = peer.find(number)
        cipher = session.cipher if session else self._traffic_cipher(sender, number)
        try:
            plain = cipher.decrypt(_nonce(self.own_id, counter), datagram[HEADER.size :], header)
        except InvalidTag:
            raise RefusedError(Refusal.ALTERED if session else Refusal.STRANGER, sender) from None
        if session is None:
            session = _Session(number, cipher)
            peer.candidates = [*peer.candidates[1 - MAX_CANDIDATES :], session]
        if not session.window.accept(counter):
            raise RefusedError(Refusal.REPLAYED, sender)
        session.challenge, echo, body = _split_proofs(plain)
        is_new = session is not peer.proven
        if is_new:
            if not hmac.compare_digest(echo, self._challenge(sender, peer)):
                raise RefusedError(Refusal.UNPROVEN, sender)
            peer.proven, peer.candidates = session, []
            peer.proofs += 1
        return Opened(sender, body, is_new)

    def is_proven(self, peer_id: int) -> bool:
        """Whether the peer's present session has echoed our challenge."""
        return self._peers[peer_id].proven is not None

    def loss(self, peer_id: int) -> float:
        """Share of the peer's last 64 datagrams to us that never came, 0-1."""
        proven = self._peers[peer_id].proven
        return proven.window.loss if proven else 0.0

    def _proofs(self, peer_id: int, peer: _Peer) -> bytes:
        """Flags, our challenge while an unproven session waits for one, and the echo of a challenge that
        we were sent."""
        flags, parts = 0, b""
        if peer.proven is None or peer.candidates:
            flags, parts = HAS_CHALLENGE, self._challenge(peer_id, peer)
            for candidate in peer.candidates:
                candidate.challenges_sent += 1
            peer.candidates = [c for c in peer.candidates if c.challenges_sent <= MAX_CHALLENGES]
        heard = [peer.proven, *peer.candidates] if peer.proven else peer.candidates
        challenges = [session.challenge for session in heard if session.challenge]
        if challenges:  # in turn, so that a recorded challenge cannot keep the true one from its echo
            peer.turn += 1
            flags, parts = flags | HAS_ECHO, parts + challenges[peer.turn % len(challenges)]
        return bytes([flags]) + parts

    def _challenge(self, peer_id: int, peer: _Peer) -> bytes:
        """Unpredictable without the fleet key, and never the same for another life, peer or proof."""
        text = struct.pack(">BQ", peer_id, peer.proofs)
        return hmac.digest(self._challenge_key, text, "sha256")[:PROOF_BYTES]

    def _traffic_cipher(self, sender: int, session: int) -> ChaCha20Poly1305:
        context = b"podwatch traffic" + struct.pack(">BBQ", VERSION, sender, session)
        return ChaCha20Poly1305(HKDF(SHA256(), 32, salt=None, info=context).derive(self._fleet_key))


def _nonce(receiver: int, counter: int) -> bytes:
    return struct.pack(">IQ", receiver, counter)


def _split_proofs(plain: bytes) -> tuple[bytes, bytes, bytes]:
    """(challenge, echo, body) of an opened datagram; an absent one is empty."""
    flags, rest = plain[0], plain[1:]
    challenge = echo = b""
    if flags & HAS_CHALLENGE:
        challenge, rest = rest[:PROOF_BYTES], rest[PROOF_BYTES:]
    if flags & HAS_ECHO:
        echo, rest = rest[:PROOF_BYTES], rest[PROOF_BYTES:]
    return challenge, echo, rest
