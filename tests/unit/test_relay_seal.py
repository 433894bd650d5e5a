"""Sealed datagrams: who is believed, and who never is."""

import pytest
from hypothesis import given
from hypothesis import settings as cases
from hypothesis import strategies as st

from procs.relay.seal import OVERHEAD_BYTES, Opened, Refusal, RefusedError, ReplayWindow, Sessions

KEY = bytes(range(32))
IDS = (1, 2, 3)


def refusal(receiver: Sessions, datagram: bytes) -> Refusal:
    with pytest.raises(RefusedError) as caught:
        receiver.open(datagram)
    return caught.value.reason


def believed(receiver: Sessions, datagram: bytes) -> Opened | None:
    try:
        return receiver.open(datagram)
    except RefusedError:
        return None


def proven_pair(first_session: int = 11, second_session: int = 22) -> tuple[Sessions, Sessions]:
    """Relays of drones 1 and 2 that have proven their sessions to each other."""
    one, two = Sessions(KEY, 1, first_session, IDS), Sessions(KEY, 2, second_session, IDS)
    for _ in range(3):
        believed(two, one.seal(2, b"hello"))
        believed(one, two.seal(1, b"hello"))
    assert one.is_proven(2)
    assert two.is_proven(1)
    return one, two


@cases(deadline=None, max_examples=30)
@given(body=st.binary(max_size=450), session=st.integers(0, 2**63 - 1))
def test_a_sealed_body_opens_at_its_receiver(body: bytes, session: int) -> None:
    one, two = proven_pair(session, 7)
    datagram = one.seal(2, body)
    assert len(datagram) == OVERHEAD_BYTES + len(body)
    assert two.open(datagram) == Opened(1, body, False)


@cases(deadline=None, max_examples=60)
@given(place=st.integers(0, 60), bit=st.integers(0, 7))
def test_one_altered_bit_anywhere_is_refused(place: int, bit: int) -> None:
    one, two = proven_pair()
    datagram = bytearray(one.seal(2, b"thirty bytes of some table or "))
    datagram[place % len(datagram)] ^= 1 << bit
    # The sender and the session choose the key: altered there, the datagram is nobody's.
    assert refusal(two, bytes(datagram)) in (Refusal.ALTERED, Refusal.STRANGER)


def test_an_altered_body_is_told_from_a_stranger() -> None:
    one, two = proven_pair()
    datagram = one.seal(2, b"body")
    assert refusal(two, datagram[:-1] + bytes([datagram[-1] ^ 1])) is Refusal.ALTERED
    stranger = Sessions(bytes(32), 1, 99, IDS)
    assert refusal(two, stranger.seal(2, b"body")) is Refusal.STRANGER


@cases(deadline=None, max_examples=60)
@given(noise=st.binary(max_size=80))
def test_noise_is_a_stranger(noise: bytes) -> None:
    _, two = proven_pair()
    assert refusal(two, noise) is Refusal.STRANGER


def test_a_datagram_opens_only_at_the_drone_that_it_was_sealed_for() -> None:
    one, _ = proven_pair()
    three = Sessions(KEY, 3, 33, IDS)
    assert refusal(three, one.seal(2, b"for two")) is Refusal.STRANGER
    assert refusal(one, one.seal(2, b"thrown back at its sender")) is Refusal.STRANGER


def test_a_repeated_datagram_is_refused() -> None:
    one, two = proven_pair()
    datagram = one.seal(2, b"once")
    assert two.open(datagram).body == b"once"
    assert refusal(two, datagram) is Refusal.REPLAYED


def test_nothing_is_believed_before_the_challenge_came_back() -> None:
    one, two = Sessions(KEY, 1, 11, IDS), Sessions(KEY, 2, 22, IDS)
    early = one.seal(2, b"carries one's challenge")
    assert refusal(two, early) is Refusal.UNPROVEN
    assert refusal(two, one.seal(2, b"again, without an echo")) is Refusal.UNPROVEN
    assert one.open(two.seal(1, b"echoes it")) == Opened(2, b"echoes it", True)
    assert two.open(one.seal(2, b"echoes two's")) == Opened(1, b"echoes two's", True)
    assert two.open(one.seal(2, b"steady")) == Opened(1, b"steady", False)
    assert refusal(two, early) is Refusal.REPLAYED


def test_datagrams_recorded_before_both_ends_restarted_are_refused_for_good() -> None:
    one, two = Sessions(KEY, 1, 11, IDS), Sessions(KEY, 2, 22, IDS)
    recorded = []
    for k in range(100):  # more than a replay window, with challenges and echoes among them
        recorded.append(one.seal(2, b"%d" % k))
        believed(two, recorded[-1])
        believed(one, two.seal(1, b"-"))
    assert two.is_proven(1)

    one, two = Sessions(KEY, 1, 111, IDS), Sessions(KEY, 2, 222, IDS)
    assert [believed(two, datagram) for datagram in recorded] == [None] * 100
    for _ in range(3):  # replays in between do not keep the true drone 1 out
        believed(one, two.seal(1, b"-"))
        believed(two, recorded[0])
        believed(two, one.seal(2, b"-"))
    assert two.is_proven(1)
    assert [believed(two, datagram) for datagram in recorded] == [None] * 100


def test_a_session_that_ended_cannot_come_back_by_its_own_recorded_proof() -> None:
    first, two = Sessions(KEY, 1, 11, IDS), Sessions(KEY, 2, 22, IDS)
    believed(first, two.seal(1, b"challenge"))
    held_back = [first.seal(2, b"echo of that challenge") for _ in range(3)]
    believed(two, held_back[0])
    assert two.is_proven(1)
    second = Sessions(KEY, 1, 12, IDS)
    for _ in range(3):
        believed(two, second.seal(2, b"-"))
        believed(second, two.seal(1, b"-"))
    assert two.open(second.seal(2, b"now it is the second's")).body
    assert refusal(two, held_back[1]) is Refusal.UNPROVEN
    assert two.open(second.seal(2, b"and stays so")).body


def test_a_peer_that_restarts_is_believed_again_within_a_few_datagrams() -> None:
    one, two = proven_pair()
    one = Sessions(KEY, 1, 12, IDS)
    assert believed(two, one.seal(2, b"calls")) is None
    assert believed(one, two.seal(1, b"echoes and challenges"))
    assert believed(two, one.seal(2, b"echoes"))


def test_recorded_challenges_do_not_starve_the_true_one() -> None:
    one, two = Sessions(KEY, 1, 11, IDS), Sessions(KEY, 2, 22, IDS)
    old = [Sessions(KEY, 2, 1000 + k, IDS).seal(1, b"-") for k in range(50)]
    answered = []
    for k in range(50):
        believed(one, old[k])  # an attacker replays dead sessions of drone 2, each with a challenge
        believed(one, two.seal(1, b"-"))
        answered.append(bool(believed(two, one.seal(2, b"-"))))
    assert any(answered), "drone 2's challenge never came back among the recorded ones"


@cases(deadline=None, max_examples=100)
@given(counters=st.lists(st.integers(0, 200), max_size=150))
def test_the_window_passes_each_counter_once(counters: list[int]) -> None:
    window = ReplayWindow()
    newest, seen = -1, []
    for counter in counters:
        is_new = counter not in seen and counter > newest - 64
        assert window.accept(counter) is is_new
        newest, seen = max(newest, counter), [*seen, counter]


def test_the_window_passes_late_counters_and_measures_the_loss() -> None:
    window = ReplayWindow()
    outcomes = {counter: window.accept(counter) for counter in (5, 7, 6, 80, 16, 17)}
    assert outcomes == {5: True, 7: True, 6: True, 80: True, 16: False, 17: True}
    assert not window.accept(80)
    steady = ReplayWindow()
    for counter in range(0, 400, 2):
        steady.accept(counter)
    assert steady.loss == 0.5


def test_no_key_in_a_repr() -> None:
    assert KEY.hex() not in repr(proven_pair()[0])
    assert "fleet_key" not in repr(proven_pair()[0])
