"""The pitch axis: emulated heads that answer fully, partly, with echo or not at all, in virtual time."""

import contextlib
import math
import signal
import subprocess
import sys

import numpy as np
import pytest
import virtual
from faults import HEAD
from shared import until

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.head import PanTilt
from lrfcal_lib.drivers.port import (
    DeviceError,
    LineLost,
    NoReply,
    OutOfRange,
    PortError,
    Refused,
    WrongDevice,
)
from lrfcal_lib.drivers.rig_file import HeadSettings
from lrfcal_lib.emulators.head import EmulatedHead, Head
from lrfcal_lib.simulate.rig import Platform


def replace(settings, **changes):
    """Settings with others."""
    return HeadSettings(**{**vars(settings), **changes})


FAST = HeadSettings(
    baudrate=38400, settle_s=0.08, poll_s=0.01, reply_s=0.1, gap_s=0.005, retries=2
)
SPEEDS = 4.0, 67.0  # deg/s of the devices at speed bytes 0 and 0x3F: byte + 4
TIMED = replace(FAST, tilt_speed=0x10, degrees_per_second=20.0)
DEGREE = math.radians(1)
SURE = replace(FAST, absolute=False)  # moved by up and down


class Uneven(Head):
    """It moves down faster than up."""

    def move(self, instant, goal, speed):
        super().move(instant, goal, 1.5 * speed if goal < 0 else speed)


class Contrary(Head):
    """It moves the other way than told, which it tells."""

    def move(self, instant, goal, speed):
        super().move(instant, -goal, speed)


def terse(raw):
    """Replies of some heads: tilts without sync and address, and one byte for a confirmation."""
    return (
        bytes([0, *raw[3:6], sum(raw[3:6]) % 256]) if len(raw) == pelco_d.FRAME else b"\x01"
    )


def emulated(
    *, head=Head, limits=(-math.pi / 2, math.pi / 2), settle=0.0, prepare=None, **options
):
    """An emulated head on a virtual host; keywords are its habits."""
    options = {"baudrate": 38400, "speeds": SPEEDS, "go_speed": 120.0} | options
    device = virtual.head(head=head(Platform(settle=settle, limits=limits)), **options)
    device.prepare = prepare or device.prepare
    return device


def driven(device, settings=FAST):
    """Its driver."""
    return PanTilt(device.path, settings, host=device.host)


@pytest.fixture
def opened():
    """Opens an emulated head and its driver, which is closed at the end of the test."""
    with contextlib.ExitStack() as stack:

        def open_one(settings=FAST, **habits):
            device = emulated(**habits)
            return device, stack.enter_context(driven(device, settings))

        yield open_one


def near(degrees, tolerance=0.6):
    return pytest.approx(degrees * DEGREE, abs=tolerance * DEGREE)


def halted(device):
    """Whether it stands, as soon as it has reacted; limits are too far away to be what stopped it."""
    device.host.sleep(0.1)
    return not device.head.moving(device.host.now())


def later(device, action, degrees=None):
    """Do something, as soon as the head is above a pitch, in another thread."""
    host = device.host

    def look(_=None):
        device.at(device.host.now() + 0.01, look)  # so that the condition is looked at

    def run():
        host.wait(lambda: degrees is None or device.pitch() > degrees * DEGREE)
        action()

    host.thread(run, "later").start()
    look()


def go_away(device):
    """The port vanishes for a moment."""
    device.port.unplug()
    device.host.sleep(0.2)
    device.port.plug()


# ------------------------------------------------------------------------------------------------------ moves

HABITS = {
    "full": {},
    "general replies and echo": {"confirms": True, "echo": True},
    "short replies": {"confirms": True, "prepare": terse},
    "silent while moving, no set-tilt": {"feedback": "partial", "echo": True},
    "uneven": {"feedback": "partial", "head": Uneven},
    "watchdog": {"feedback": "partial", "watchdog_s": 0.3},
    "inverted": {"invert": True},
    "nothing": {"feedback": "none"},
}


@pytest.mark.parametrize("kind", HABITS.values(), ids=HABITS)
def test_heads_of_every_kind_move_to_where_they_are_sent(opened, kind):
    settings = replace(FAST, invert=kind.get("invert", False), repeat_s=0.1 if "watchdog_s" in kind else None,
                       degrees_per_second=36.0 if kind.get("feedback") == "none" else None)  # fmt: skip
    device, head = opened(settings, **kind)
    assert head.has_feedback == (kind.get("feedback") != "none")
    tolerance = 0.6 if head.has_feedback else 2.0
    for degrees in (15.0, -10.0):  # the first one learns
        pitch = head.move_to(degrees * DEGREE)
        assert halted(device) and pitch == near(degrees, tolerance)
        assert device.pitch() == pytest.approx(
            pitch, abs=(0.05 if head.has_feedback else 2.0) * DEGREE
        )
        assert head.pitch() == (pytest.approx(pitch, abs=0.05 * DEGREE), head.has_feedback)
        assert not head.moving()


@pytest.mark.parametrize("settings", [FAST, SURE], ids=["set-tilt", "up and down"])
def test_inverted_head_with_another_zero(opened, settings):
    device, head = opened(replace(settings, invert=True, position_zero_deg=5.0))
    assert head.move_to(20 * DEGREE) == near(20)
    assert device.pitch() == near(-15)


def test_limits_are_named_and_nothing_moves(opened):
    device, head = opened()
    before = device.heard
    for call in (head.move_to, head.start_sweep):
        with pytest.raises(
            OutOfRange, match="-70.00 deg is beyond the head's limits of -60 to 60"
        ):
            call(-70 * DEGREE)
    assert isinstance(pytest.raises(ValueError, head.move_to, math.nan).value, OutOfRange)
    assert device.heard == before
    assert head.move_to(60 * DEGREE) == near(60)


def to(degrees):
    return lambda head: head.move_to(degrees * DEGREE)


def swept(degrees):
    return lambda head: head.start_sweep(degrees * DEGREE) or head.finish_sweep()


TEN = to(10)
PARTIAL = {"feedback": "partial"}
NONE = {"feedback": "none"}
SLOW = replace(FAST, tilt_speed=0x08, degrees_per_second=12.0)
FAILURES = [  # settings, habits, fault that lasts, call, what it raises
    (
        FAST,
        {"limits": (-0.1, 0.1)},
        None,
        lambda head: (to(5)(head), to(30)(head)),
        Refused,
        "stays at 5.73 deg on its way to 30.00",
    ),
    (SURE, {}, "stall", TEN, Refused, "does not move: look for an end stop"),
    (
        FAST,
        PARTIAL | {"head": Contrary},
        None,
        to(30),
        Refused,
        "opposite direction: change invert",
    ),
    (
        replace(FAST, absolute=True),
        PARTIAL,
        None,
        to(10),
        Refused,
        "does not obey set-tilt",
    ),
    (FAST, {}, "deaf", PanTilt.pitch, NoReply, "address 1 and 38400 Bd"),
    (FAST, {}, "deaf", TEN, NoReply, "address 1 and 38400 Bd"),
    (FAST, PARTIAL, None, swept(50), NoReply, "speed is unknown: state degrees_per_second"),
    (FAST, {"head": Contrary}, None, swept(50), Refused, "opposite direction"),
    (SLOW, {}, "stall", swept(20), Refused, "the sweep does not get to its end"),
    (FAST, {}, None, PanTilt.finish_sweep, DeviceError, "there was no sweep"),
]


@pytest.mark.parametrize(
    ("settings", "habits", "fault", "call", "error", "message"), FAILURES
)
def test_what_cannot_be_is_said_and_the_head_stands(
    opened, settings, habits, fault, call, error, message
):
    device, head = opened(settings, **habits)
    if fault is not None:
        device.faults.inject(fault, seconds=1e6)
    with pytest.raises(error, match=message):
        call(head)
    assert halted(device) and not head.moving() and device.pitch() > -40 * DEGREE
    if call is TEN:
        device.faults.clear()
        assert head.move_to(10 * DEGREE) == near(10)


def test_a_reading_has_the_instant_of_its_own_query(opened):
    """Not that of the wait for the line before it."""
    device, head = opened(replace(FAST, gap_s=0.2))
    device.head.move(device.host.now(), 1.0, 0.5)
    device.host.sleep(0.1)
    for _ in range(3):
        pitch, instant = head.line.pitch(patient=False)
        assert pitch == pytest.approx(float(device.head.pitch(instant)), abs=0.01)


# ------------------------------------------------------------------------------------------------------- sweeps

SWEEPS = {"full": {}, "echo and general": {"echo": True, "confirms": True}, "silent while moving": PARTIAL,
          "tells nothing": NONE}  # fmt: skip


@pytest.mark.parametrize("habits", SWEEPS.values(), ids=SWEEPS)
def test_sweep_logs_the_pitch(opened, habits):
    device, head = opened(SLOW, **habits)
    head.move_to(-15 * DEGREE)
    host = device.host
    truth = []
    begun = host.time()
    head.start_sweep(15 * DEGREE)
    assert head.moving()
    with pytest.raises(DeviceError, match="is moving already"):
        head.move_to(0)
    while head.moving():
        truth.append((host.time(), device.pitch()))
        host.sleep(0.01)
    track = head.finish_sweep()
    assert track == head.track
    times, pitches, measured = zip(*track, strict=True)
    assert begun <= times[0] and list(times) == sorted(times)
    told = "feedback" not in habits
    assert halted(device) and device.pitch() == near(15, 1)
    assert pitches[-1] == near(device.pitch() / DEGREE, 0.02 if head.has_feedback else 0.5)
    assert measured[-1] == head.has_feedback and any(measured[3:-3]) == told
    worst = max(abs(np.interp(instant, times, pitches) - pitch) for instant, pitch in truth)
    assert worst < (0.5 if told else 1.5) * DEGREE


# --------------------------------------------------------------------------------------------------------- stops


@pytest.mark.parametrize(("settings", "habits", "stop", "above"), [
    (TIMED, NONE, PanTilt.stop, 5), (SURE, {}, PanTilt.emergency_stop, None),
])  # fmt: skip
def test_stop_from_another_thread_ends_a_move(opened, settings, habits, stop, above):
    device, head = opened(settings, **habits)
    later(device, lambda: stop(head), degrees=above)
    with pytest.raises(DeviceError, match="stopped before it arrived"):
        head.move_to(60 * DEGREE)
    assert halted(device) and -5 * DEGREE < device.pitch() < 30 * DEGREE


def test_close_stops_the_head_and_is_final(opened):
    device, head = opened(SLOW)
    head.start_sweep(60 * DEGREE)
    device.host.sleep(0.2)
    head.close()
    head.close()
    assert halted(device)
    for call in (head.pitch, head.stop, lambda: head.move_to(0)):
        with pytest.raises(DeviceError, match="closed"):
            call()


def test_opening_stops_a_head_that_was_left_running():
    device = emulated()
    device.head.move(0.0, 80 * DEGREE, 0.2)
    with driven(device):
        assert halted(device)


SWEEPING = """
import sys, time
from lrfcal_lib.drivers.head import PanTilt
from lrfcal_lib.drivers.rig_file import HeadSettings
head = PanTilt(sys.argv[1], HeadSettings(baudrate=38400, gap_s=0.005))
head.start_sweep(1.0, speed=1)
try:
    print("moving", flush=True)
    time.sleep(float(sys.argv[2]))
finally:
    print("files closed", flush=True)
"""


@pytest.mark.parametrize("way", ["exit", "SIGTERM", "SIGINT"])
def test_the_end_of_the_process_stops_the_head(tmp_path, way):
    """In real time, on a pseudo-terminal; at this speed the head gets to its limit after minutes."""
    with EmulatedHead(path=tmp_path / "head", baudrate=38400, speeds=(0.01, 1.0)) as device:

        def becomes(moving):
            until(lambda: device.head.moving(device.host.now()) == moving)

        call = [sys.executable, "-c", SWEEPING, device.path, "0" if way == "exit" else "60"]
        process = subprocess.Popen(
            call, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert process.stdout.readline() == "moving\n"
        if way != "exit":
            becomes(moving=True)
            process.send_signal(getattr(signal, way))
        assert (
            process.wait(timeout=60)
            == {"exit": 0, "SIGTERM": 143, "SIGINT": -signal.SIGINT}[way]
        )
        assert process.stdout.read() == "files closed\n"
        becomes(moving=False)
    assert device.error is None


# ----------------------------------------------------------------------------------------------------- bad lines


def test_line_that_stays_away(opened):
    device, head = opened()
    device.port.unplug()
    for call, message in ((to(10), "was unplugged"), (PanTilt.pitch, "there is no port")):
        with pytest.raises(LineLost, match=message):
            call(head)
    device.port.plug()
    assert head.move_to(10 * DEGREE) == near(10)


def test_lost_line_makes_dead_reckoning_unknown(opened):
    device, head = opened(SLOW, feedback="none")
    later(device, lambda: go_away(device), degrees=3)
    with pytest.raises(LineLost):
        head.move_to(50 * DEGREE)
    assert halted(device)
    with pytest.raises(DeviceError, match="call set_pitch"):
        head.move_to(0)
    head.set_pitch(0.0)
    assert head.move_to(10 * DEGREE) == near(10, 1.5)


def test_head_that_falls_silent_in_a_move(opened):
    device, head = opened()
    later(device, lambda: device.faults.inject("mute", seconds=1e6), degrees=4)
    with pytest.raises(NoReply, match="stopped telling its tilt"):
        head.move_to(40 * DEGREE)
    assert halted(device)


@pytest.mark.parametrize(("habits", "changes", "error", "message"), [
    ({"feedback": "none", "echo": True}, {"feedback": True}, NoReply, "the adapter works: check its power"),
    (None, {}, WrongDevice, "no Pelco-D at 38400 Bd"),
])  # fmt: skip
def test_what_was_stated_and_does_not_come(habits, changes, error, message):
    device = emulated(**habits or {})
    if habits is None:
        device.receive = lambda data, at: device.write(bytes(range(2, 200)), at)
    with pytest.raises(error, match=message):
        driven(device, replace(FAST, **changes))
    with pytest.raises(PortError, match="there is no port"):
        PanTilt("nowhere", FAST, host=device.host)


@pytest.mark.parametrize(
    "changes",
    [{"feedback": True}, {"feedback": True, "reply_s": 1.0}, {"feedback": "auto"}],
)
def test_what_to_state_for_a_head_that_answers_late(changes):
    device = emulated()
    reply = device.reply
    device.reply = lambda raw, at: reply(raw, at + 0.6)
    settings = replace(FAST, **changes)
    if changes == {"feedback": True}:
        with pytest.raises(
            NoReply,
            match='longer reply_s than 0.1 s if it answers late, or feedback "auto"',
        ):
            driven(device, settings)
    else:
        with driven(device, settings) as head:
            assert head.has_feedback == (settings.reply_s == 1.0)
            assert head.move_to(10 * DEGREE) == near(10, 0.6 if head.has_feedback else 5)


@pytest.mark.parametrize("kind", HEAD)
def test_no_fault_ends_in_a_wrong_pitch(opened, kind):
    device, head = opened(replace(FAST, retries=3), settle=0.05)
    for goal in (4, -4):
        device.faults.inject(kind, 1 if kind == "unplug" else 2)
        begun = device.host.now()
        pitch = None
        with contextlib.suppress(DeviceError):
            pitch = head.move_to(goal * DEGREE)
        assert device.host.now() - begun < 10
        device.faults.clear()
        if pitch is None:
            pitch = head.move_to(goal * DEGREE)
            assert pitch == near(goal)
        device.host.sleep(0.06)
        assert device.pitch() == pytest.approx(pitch, abs=0.1 * DEGREE)
    assert head.pitch() == (pytest.approx(device.pitch(), abs=0.1 * DEGREE), True)
