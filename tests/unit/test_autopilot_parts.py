"""The parts of the bridge by themselves: limits, the followed point, requests, authority, codec, links."""

import math
import os
import pty
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.autopilots.ardupilot import Codec, Mode, mavlink
from drivers.autopilots.mavlink_link import MavlinkUdp, open_link
from drivers.autopilots.memory import link_pair
from procs.autopilot.authority import Authority
from procs.autopilot.limits import Envelope, Follower
from procs.autopilot.requests import Commands, Parameters, Streams
from procs.autopilot.telemetry import Telemetry
from procs.settings import LimitSettings, OriginSettings

LIMITS = LimitSettings(
    speed_m_s=8.0, climb_m_s=3.0, descent_m_s=2.0, min_height_m=10.0, max_height_m=60.0, fence_radius_m=200.0
)
ENVELOPE = Envelope(LIMITS)
SECOND_US = 1_000_000

anywhere = st.tuples(st.floats(-900, 900), st.floats(-900, 900), st.floats(-300, 50))
inside = st.tuples(st.floats(0, 199), st.floats(-math.pi, math.pi), st.floats(-59.9, -10.1)).map(
    lambda polar: (polar[0] * math.cos(polar[1]), polar[0] * math.sin(polar[1]), polar[2])
)
any_velocity = st.tuples(st.floats(-40, 40), st.floats(-40, 40), st.floats(-20, 20))
SMALL = 1e-6


def is_inside(place, slack_m=SMALL) -> bool:
    in_height = LIMITS.min_height_m - slack_m <= -place[2] <= LIMITS.max_height_m + slack_m
    return in_height and math.hypot(*place[:2]) <= LIMITS.fence_radius_m + slack_m


@given(anywhere)
@settings(deadline=None, max_examples=200)
def test_a_clamped_place_is_inside_and_an_inside_place_is_left_alone(place):
    clamped = ENVELOPE.position(place)
    assert is_inside(clamped)
    assert ENVELOPE.position(clamped) == pytest.approx(clamped)
    if is_inside(place, -SMALL):
        assert clamped == place


@given(anywhere, any_velocity)
@settings(deadline=None, max_examples=200)
def test_a_clamped_velocity_never_leads_out_nor_faster(place, velocity):
    vn, ve, vd = ENVELOPE.velocity(place, velocity)
    assert math.hypot(vn, ve) <= LIMITS.speed_m_s + SMALL
    assert -LIMITS.climb_m_s <= vd <= LIMITS.descent_m_s
    away_m = math.hypot(*place[:2])
    if away_m >= LIMITS.fence_radius_m:
        assert vn * place[0] + ve * place[1] <= SMALL * away_m
    if -place[2] >= LIMITS.max_height_m:
        assert vd >= 0
    if -place[2] <= LIMITS.min_height_m:
        assert vd <= 0


@given(anywhere.filter(lambda place: math.hypot(*place[:2]) > 1))
@settings(deadline=None, max_examples=100)
def test_a_velocity_that_leads_back_is_left_alone(place):
    length_m = math.hypot(*place[:2])
    wanted = (-5 * place[0] / length_m, -5 * place[1] / length_m, 0.0)
    assert ENVELOPE.velocity(place, wanted) == pytest.approx(wanted)


@given(inside, any_velocity)
@settings(deadline=None, max_examples=50)
def test_flying_any_velocity_for_a_minute_stays_inside(place, velocity):
    for _ in range(1200):
        allowed = ENVELOPE.velocity(place, velocity)
        place = tuple(p + v * 0.05 for p, v in zip(place, allowed, strict=True))
    assert is_inside(place, 0.1)  # steps along the tangent end a little outside


@given(inside, anywhere)
@settings(deadline=None, max_examples=50)
def test_the_followed_point_arrives_and_keeps_every_limit(start, wanted):
    goal = ENVELOPE.position(wanted)
    follower = Follower(ENVELOPE, start, (0.0, 0.0, 0.0))
    for _ in range(2400):
        before = follower.place, follower.velocity
        follower.step(goal, (0.0, 0.0, 0.0), follower.place, 0.05)
        assert is_inside(follower.place, 0.01)
        assert math.hypot(*follower.velocity[:2]) <= LIMITS.speed_m_s + SMALL
        moved = math.dist(before[0][:2], follower.place[:2])
        assert moved <= LIMITS.speed_m_s * 0.05 + SMALL
        assert -LIMITS.climb_m_s - SMALL <= follower.velocity[2] <= LIMITS.descent_m_s + SMALL
    assert follower.place == pytest.approx(goal, abs=0.1)


def test_the_followed_point_waits_for_a_vehicle_that_is_held_back():
    follower = Follower(ENVELOPE, (0.0, 0.0, -30.0), (0.0, 0.0, 0.0))
    for _ in range(200):
        follower.step((100.0, 0.0, -50.0), (0.0, 0.0, 0.0), (0.0, 0.0, -30.0), 0.05)
    assert follower.place == pytest.approx((5.0, 0.0, -35.0))


def test_a_command_is_sent_again_until_it_is_answered():
    commands = Commands()
    for utime in range(0, 2 * SECOND_US, 50_000):
        commands.ask(400, 1.0, utime=utime)
    sent = []
    for utime in range(2 * SECOND_US, 4 * SECOND_US, 50_000):
        commands.ask(400, 1.0, utime=utime)
        sent += [(utime, command.confirmation) for command in commands.due(utime)]
    assert sent == [(2_000_000, 0), (2_500_000, 1), (3_000_000, 2), (3_500_000, 3)]
    accepted = commands.answered(400, mavlink.MAV_RESULT_ACCEPTED, 4 * SECOND_US)
    assert accepted is not None
    assert accepted.parameters == (1.0,)
    assert commands.due(10 * SECOND_US) == []


def test_a_refused_command_is_asked_again_a_second_later():
    commands = Commands()
    commands.ask(400, 1.0, utime=0)
    commands.due(0)
    assert commands.answered(400, mavlink.MAV_RESULT_FAILED, 20_000) is None
    commands.ask(400, 1.0, utime=500_000)
    assert commands.due(900_000) == []
    assert [command.confirmation for command in commands.due(1_020_000)] == [0]


def test_an_answer_to_nothing_is_nothing():
    commands = Commands()
    assert commands.answered(400, mavlink.MAV_RESULT_ACCEPTED, 0) is None
    commands.ask(176, 1.0, 17.0, utime=0)
    assert commands.answered(176, mavlink.MAV_RESULT_ACCEPTED, 0) is None  # it was not even sent


def test_streams_are_asked_one_at_a_time_and_a_deaf_one_does_not_stop_the_rest():
    streams = Streams(((30, 20.0), (32, 20.0), (245, 5.0)))
    assert streams.due(0) is None
    streams.restart(0)
    answered = []
    for utime in range(0, 20 * SECOND_US, 50_000):
        asked = streams.due(utime)
        if asked is not None and asked[0] != 32:
            streams.answered(utime + 20_000)
            answered.append(asked)
    assert answered == [(30, 50_000.0), (245, 200_000.0)]
    assert not streams.is_done


def test_parameters_try_the_other_versions_name_and_report_what_is_not_set():
    parameters = Parameters(
        [(("MAV_GCS_SYSID", 255.0), ("SYSID_MYGCS", 255.0)), (("FENCE_ENABLE", 1.0),)], [(("WP_SPD", 5.0),)]
    )
    assert parameters.due(0) == []
    parameters.restart(0)
    asked = []
    for utime in range(0, 10 * SECOND_US, 100_000):
        for name, value in parameters.due(utime):
            asked.append(name)
            if name == "SYSID_MYGCS":
                parameters.heard(name, value)
    assert asked == ["MAV_GCS_SYSID", "FENCE_ENABLE", "WP_SPD"] * 3 + ["SYSID_MYGCS"]
    assert parameters.problem() == "FENCE_ENABLE got no answer"


def test_a_parameter_that_the_autopilot_does_not_take_is_named_with_both_values():
    parameters = Parameters([(("FS_GCS_ENABLE", 1.0),)])
    parameters.restart(0)
    for utime in range(0, 5 * SECOND_US, SECOND_US):
        for name, _ in parameters.due(utime):
            parameters.heard(name, 0.0)
    assert parameters.problem() == "FS_GCS_ENABLE is 0, wanted 1"


def test_authority_is_lost_to_any_mode_that_we_did_not_ask_for():
    authority = Authority()
    assert not authority.is_ours
    authority.observe(Mode.STABILIZE, 0)
    assert not authority.is_ours
    assert authority.may_take_off
    authority.ask(Mode.GUIDED, SECOND_US)
    authority.observe(Mode.GUIDED, 2 * SECOND_US)
    assert authority.is_ours
    authority.observe(Mode.LOITER, 3 * SECOND_US)
    assert not authority.is_ours
    assert not authority.may_take_off


def test_a_mode_asked_for_long_ago_is_not_ours_when_the_pilot_chooses_it():
    authority = Authority()
    authority.observe(Mode.GUIDED, 0)
    authority.ask(Mode.LAND, SECOND_US)  # refused, and no longer wanted
    authority.observe(Mode.GUIDED, 4 * SECOND_US)
    authority.observe(Mode.LAND, 5 * SECOND_US)
    assert not authority.is_ours


def test_our_own_brake_stays_ours_while_we_ask_to_leave_it():
    authority = Authority()
    authority.observe(Mode.GUIDED, 0)
    authority.ask(Mode.BRAKE, SECOND_US)
    authority.observe(Mode.BRAKE, SECOND_US)
    authority.ask(Mode.GUIDED, 20 * SECOND_US)
    for seconds in range(20, 40):
        authority.observe(Mode.BRAKE, seconds * SECOND_US)
        assert authority.is_ours
    authority.observe(Mode.LOITER, 41 * SECOND_US)
    assert not authority.is_ours


def test_a_jump_back_of_the_boot_time_is_a_restart():
    telemetry = Telemetry(OriginSettings())
    sender = Codec(1, 1)
    heard = []
    for boot_ms in (5000, 5050, 5040, 100, 150):
        sender.send.local_position_ned_send(boot_ms, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0)
        heard += [telemetry.hear(m, 1) for m in Codec(255, 190).parse(sender.take())]
    assert heard == [False, False, False, True, False]


def test_after_a_jump_of_the_boot_time_nobody_is_told_of_a_landing_before_the_next_heartbeat():
    telemetry, sender, flags = Telemetry(OriginSettings()), Codec(1, 1), mavlink.MAV_MODE_FLAG_SAFETY_ARMED

    def beat() -> None:
        sender.send.heartbeat_send(
            mavlink.MAV_TYPE_QUADROTOR, 3, flags, Mode.GUIDED, mavlink.MAV_STATE_ACTIVE
        )

    def status() -> None:
        sender.send.sys_status_send(0, 0, 0, 0, 12000, -1, 80, 0, 0, 0, 0, 0, 0)

    told = []
    for boot_ms, speak in ((9000, beat), (9050, status), (7000, status), (9100, beat), (9150, status)):
        speak()
        sender.send.local_position_ned_send(boot_ms, 1.0, 2.0, -30.0, 0.0, 0.0, 0.0)
        for message in Codec(255, 190).parse(sender.take()):
            telemetry.hear(message, 1)
        told.append((telemetry.is_known, telemetry.landed))
    assert told == [(False, False), (True, False), (False, True), (False, False), (True, False)]


def test_a_battery_of_which_nothing_is_told_is_below_0_and_not_empty():
    telemetry, sender = Telemetry(OriginSettings()), Codec(1, 1)
    told = []
    for remaining in (-1, 80, -1):
        sender.send.sys_status_send(0, 0, 0, 0, 12000, -1, remaining, 0, 0, 0, 0, 0, 0)
        for message in Codec(255, 190).parse(sender.take()):
            telemetry.hear(message, 1)
        told.append(telemetry.battery)
    assert told == [-1.0, 0.8, 0.8]


@given(st.lists(st.binary(max_size=80), max_size=8), st.randoms(use_true_random=False))
@settings(deadline=None, max_examples=100)
def test_damaged_bytes_raise_nothing_and_change_nothing(noise: list[bytes], chance: random.Random):
    """Whole messages with bytes changed, between noise: none is taken for a message."""
    sender, receiver = Codec(1, 1), Codec(255, 190)
    sender.send.local_position_ned_send(1, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    message = bytearray(sender.take())
    message[chance.randrange(1, len(message))] ^= chance.randrange(1, 256)
    assert [m for piece in (*noise, bytes(message)) for m in receiver.parse(piece)] == []


def test_the_memory_link_delivers_when_the_scheduler_says():
    waiting = []
    bridge_end, autopilot_end = link_pair(waiting.append, 3)
    arrivals = []
    autopilot_end.on_arrival(lambda: arrivals.append(autopilot_end.receive()))
    bridge_end.write(b"one")
    bridge_end.write(b"")
    bridge_end.write(b"two")
    assert arrivals == []
    for action in waiting:
        action()
    assert arrivals == [b"one", b"two"]
    assert (bridge_end.system_id, bridge_end.receive()) == (3, b"")
    autopilot_end.close()
    bridge_end.write(b"three")
    assert len(waiting) == 2


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("14550", "write udp:HOST:PORT"),
        ("udp:14550", "host:port"),
        ("tcp:localhost:http", "host:port"),
        ("udp:127.0.0.1:99999", "host:port"),
        ("serial:/dev/ttyAMA0", "serial:DEVICE:BAUD"),
        ("serial:/dev/null:12345", "12345 baud"),
    ],
)
def test_a_wrong_address_is_refused_with_the_form_to_write(address, says):
    with pytest.raises(ValueError, match=says):
        open_link(address)


def test_a_serial_link_over_a_pseudo_terminal():
    far, near = pty.openpty()
    link = open_link(f"serial:{os.ttyname(near)}:57600", 4)
    try:
        data = bytes(range(256))
        link.write(data)
        assert os.read(far, 1000) == data
        os.write(far, data)
        assert link.receive() == data
        assert link.receive() == b""
        assert link.system_id == 4
    finally:
        link.close()
        os.close(far)
        os.close(near)


@pytest.mark.parametrize(
    ("device", "says"), [("/dev/does-not-exist", "cannot open"), ("/dev/null", "not a serial")]
)
def test_a_serial_device_that_is_none_says_so(device, says):
    with pytest.raises(OSError, match=says):
        open_link(f"serial:{device}:57600")


def test_a_port_in_use_says_so():
    held = MavlinkUdp("127.0.0.1:0")
    try:
        with pytest.raises(OSError, match=rf"cannot listen on udp 127.0.0.1:{held.port}"):
            MavlinkUdp(f"127.0.0.1:{held.port}")
    finally:
        held.close()
