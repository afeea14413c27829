"""The pitch axis: heads that answer fully, partly, with echo or not at all, in virtual time."""

import contextlib
import dataclasses
import logging
import math
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
import virtual

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.head import HeadSettings, PanTilt, drawn_to_readings
from lrfcal_lib.drivers.host import VirtualHost
from lrfcal_lib.drivers.port import DeviceError, LineLost, NoReply, OutOfRange, PortError, Refused, WrongDevice
from lrfcal_lib.emulators.head import EmulatedHead, Head
from lrfcal_lib.emulators.line import FAULTS, Clock, SerialDevice
from lrfcal_lib.simulate.rig import Platform

FAST = HeadSettings(baudrate=38400, settle_s=0.04, stall_s=0.2, poll_s=0.01, reply_s=0.1, gap_s=0.005, retries=2,
                    reconnect_s=2.0)  # fmt: skip
DEGREE = math.radians(1)


class FakeHead(SerialDevice):
    """A head without inertia whose habits can be switched while it runs.

    Speed byte 0x3F makes `fastest` deg/s, others in proportion; down is `down` times as fast. Angles are elevations.
    """

    def __init__(self, *, tells=True, tells_moving=True, obeys=True, echo=0, acknowledges="", short=False,
                 fastest=252.0, down=1.0, sign=1, delay_s=0.0, watchdog_s=None):  # fmt: skip
        super().__init__("head", "head", Clock(machine=VirtualHost()))
        self.tells, self.tells_moving, self.obeys, self.echo = tells, tells_moving, obeys, echo
        self.acknowledges, self.short, self.watchdog_s = acknowledges, short, watchdog_s
        self.fastest, self.down, self.sign, self.delay_s = fastest, down, sign, delay_s
        self.deaf = self.stuck = False
        self.lost, self.baudrate = 0, 38400  # set-tilts that will have no effect
        self.lies, self.ends, self.late = [], (-90.0, 90.0), None
        self.frames, self.segment, self.host = [], (0.0, 0.0, 0.0, 0.0), self.clock.machine
        self.start()

    def elevation(self):
        """Degrees, up positive."""
        begun, speed, start, goal = self.segment
        way = speed * max(0.0, self.clock.now() - begun - self.delay_s)
        return max(start - way, goal) if goal < start else min(start + way, goal)

    def go(self, goal, speed):
        here = self.elevation()
        goal = here if self.stuck or goal is None else min(max(goal, self.ends[0]), self.ends[1])
        self.segment = (self.clock.now(), speed * (self.down if goal < here else 1), here, goal)

    def stop(self, _=None):
        self.go(None, 0.0)

    def moves(self):
        return self.elevation() != self.segment[3]

    def halted(self):
        """Whether, as soon as all is said, it stands where it was told to stop; one that arrived was not stopped."""
        self.host.sleep(0.01)
        return self.segment[2] == self.segment[3]

    def receive(self, data, at):
        self.at(at, lambda _: self._take(data))

    def _take(self, data):
        if self.echo:
            self.write(data[-self.echo :], self.clock.now())
        for frame in () if self.deaf else pelco_d.split_frames(data)[0]:
            self._obey(frame)

    def _obey(self, frame):
        self.cancel("watchdog")
        if self.watchdog_s:
            self.at(self.clock.now() + self.watchdog_s, self.stop, "watchdog")
        self.frames.append(frame)
        if frame.command2 == pelco_d.QUERY_TILT:
            return self._tell()
        if frame.command2 == pelco_d.SET_TILT and self.lost:
            self.lost -= 1
        elif frame.command2 == pelco_d.SET_TILT and self.obeys:
            self.go(math.degrees(pelco_d.decode_tilt(frame.value)), self.fastest)
        elif not frame.command2 & 1:
            way = {pelco_d.UP: 1, pelco_d.DOWN: -1}.get(frame.command2 & 0x18, 0) * self.sign
            self.go(way * 1e9 if way else None, self.fastest * max(frame.data2, 1) / 0x3F)
        body = dataclasses.astuple(frame)
        answers = {"general": bytes([0xFF, frame.address, 0, sum(body) & 0xFF]), "success": b"\x01"}
        self.write(answers.get(self.acknowledges, b""), self.clock.now())

    def _tell(self):
        if self.tells and (self.tells_moving or not self.moves()):
            value = pelco_d.encode_tilt(math.radians(self.lies.pop() if self.lies else self.elevation()))
            raw = pelco_d.encode_extended(1, pelco_d.TILT, value)
            raw = bytes([*raw[2:6], sum(raw[2:6]) & 0xFF]) if self.short else raw
            if self.late is not None:  # this one comes after the next query, in place of its answer
                raw, self.late = self.late, raw if not self.late else None
            self.write(raw, self.clock.now())

    def when(self, holds, action):
        """Do something as soon as a condition holds, from another thread."""

        def run():
            self.host.wait(holds)
            action()

        self.host.thread(run, "when").start()
        self._look()

    def _look(self, instant=None):
        """Something happens every 10 ms, so that conditions are looked at."""
        self.at(self.clock.now() + 0.01, self._look)

    def go_away(self):
        """Vanish for a moment."""
        self.port.unplug()
        self.host.sleep(0.2)
        self.port.plug()


HEADS = []


@pytest.fixture(autouse=True)
def closed():
    """Close what a test opened."""
    yield
    while HEADS:
        HEADS.pop().close()


def opened(settings=FAST, device=None, **habits):
    """A head and its driver, which is closed at the end of the test."""
    device = device or FakeHead(**habits)
    HEADS.append(PanTilt(device.path, settings, host=device.clock.machine))
    return device, HEADS[-1]


def near(degrees, tolerance=0.6):
    return pytest.approx(degrees * DEGREE, abs=tolerance * DEGREE)


# ------------------------------------------------------------------------------------------------------ moves

HABITS = {
    "full": {},
    "echo": {"echo": 512},
    "partial echo": {"echo": 3},
    "general": {"acknowledges": "general"},
    "general and echo": {"acknowledges": "general", "echo": 512},
    "success": {"acknowledges": "success"},
    "short replies": {"short": True},
    "silent while moving": {"tells_moving": False},
    "no set-tilt": {"obeys": False},
    "no set-tilt, silent while moving": {"obeys": False, "tells_moving": False, "down": 1.5},
}


@pytest.mark.parametrize("habits", HABITS.values(), ids=HABITS)
def test_moves_to_where_it_is_sent(habits):
    device, head = opened(**habits)
    assert head.has_feedback
    for degrees in (10.0, -20.0):  # the first one learns
        pitch = head.move_to(degrees * DEGREE)
        assert pitch == near(degrees)
        assert device.elevation() * DEGREE == pytest.approx(pitch, abs=0.02 * DEGREE)
        assert head.pitch() == (pytest.approx(pitch, abs=0.02 * DEGREE), True)
        assert not head.moving()


@pytest.mark.parametrize("obeys", [True, False])
def test_inverted_head_with_another_zero(obeys):
    settings = dataclasses.replace(FAST, invert=True, position_zero_deg=5.0)
    device, head = opened(settings, obeys=obeys)
    assert head.move_to(20 * DEGREE) == near(20)
    assert device.elevation() == pytest.approx(-15, abs=0.6)


def test_pitch_of_a_head_whose_zero_is_far_off():
    settings = HeadSettings(position_zero_deg=170)
    for degrees in (-50, 0, 50):
        elevation = settings.elevation(degrees * DEGREE)
        told = pelco_d.decode_tilt(pelco_d.encode_tilt(elevation))
        assert settings.pitch(told) == near(degrees, 0.01)


def test_limits_are_named_and_nothing_moves():
    device, head = opened()
    before = len(device.frames)
    for call in (head.move_to, head.start_sweep):
        with pytest.raises(OutOfRange, match="-70.00 deg is beyond the head's limits of -60 to 60"):
            call(-70 * DEGREE)
    assert isinstance(pytest.raises(ValueError, head.move_to, math.nan).value, OutOfRange)
    assert len(device.frames) == before
    assert head.move_to(60 * DEGREE) == near(60)


def test_head_at_its_end_stop():
    device, head = opened()
    device.ends = (-10.0, 10.0)
    head.move_to(5 * DEGREE)
    with pytest.raises(Refused, match="stays at 10.00 deg on its way to 30.00"):
        head.move_to(30 * DEGREE)
    assert head.pitch()[0] == near(10)


def test_head_that_does_not_move():
    device, head = opened(dataclasses.replace(FAST, absolute=False))
    device.stuck = True
    with pytest.raises(Refused, match="does not move: look for an end stop"):
        head.move_to(10 * DEGREE)
    device.stuck = False
    assert head.move_to(10 * DEGREE) == near(10)


def test_head_that_moves_the_other_way():
    device, head = opened(obeys=False, sign=-1)
    with pytest.raises(Refused, match="the other way: set invert"):
        head.move_to(30 * DEGREE)
    assert device.halted()


def test_set_tilt_that_must_work():
    _, head = opened(dataclasses.replace(FAST, absolute=True), obeys=False)
    with pytest.raises(Refused, match="does not obey set-tilt"):
        head.move_to(10 * DEGREE)


def test_one_lost_set_tilt_is_sent_again():
    device, head = opened()
    device.lost = 1
    assert head.move_to(10 * DEGREE) == near(10)
    assert sum(frame.command2 == pelco_d.SET_TILT for frame in device.frames) == 2


def test_readings_that_jump_are_not_believed():
    device, head = opened()
    head.move_to(10 * DEGREE)
    device.lies = [20.0]
    assert head.pitch() == (near(10), True)
    assert not device.lies


def test_late_reply_is_not_taken_for_the_next():
    device, head = opened()
    device.late = b""
    assert head._line.pitch(0) is None
    device.segment = (0.0, 0.0, 2.0, 2.0)
    assert head._line.pitch(0)[1] == near(2, 0.01)
    assert device.late is None


def test_speed_nought_is_not_stop():
    device, head = opened(dataclasses.replace(FAST, tilt_speed=0, degrees_per_second=2.0), tells=False)
    head.move_to(0.5 * DEGREE)
    assert [frame.data2 for frame in device.frames if frame.command2 == pelco_d.UP] == [0]
    assert device.halted()
    assert 0.5 < device.elevation() < 1.5  # at 4 deg/s, twice what was stated


# ------------------------------------------------------------------------------------------------- timed moves

TIMED = dataclasses.replace(FAST, degrees_per_second=(64.0, 96.0), tilt_speed=0x10)


def test_timed_moves_say_what_they_are(caplog):
    with caplog.at_level(logging.INFO):
        device, head = opened(TIMED, tells=False, down=1.5)
        assert not head.has_feedback
        assert head.pitch() == (0.0, False)
        assert head.move_to(20 * DEGREE) == near(20, 1.5)
        assert head.move_to(-10 * DEGREE) == near(-10, 1.5)
    assert head.pitch() == (near(-10, 1.5), False)
    assert device.halted()
    assert device.elevation() == pytest.approx(-10, abs=1.5)
    said = [record.message for record in caplog.records if "timed moves" in record.message]
    assert len(said) == 1 and "64/96 deg/s (stated)" in said[0]


def test_start_of_a_head_without_feedback(caplog):
    settings = dataclasses.replace(FAST, start_pitch_deg=-15.0, feedback=False)
    device, head = opened(settings)
    assert "assumed, calibrate it" in caplog.text
    assert head.pitch() == (near(-15, 1e-6), False)
    head.set_pitch(0.1)
    assert head.pitch() == (0.1, False)
    assert not any(frame.command2 == pelco_d.QUERY_TILT for frame in device.frames)


def test_timed_move_that_takes_too_long():
    device, head = opened(TIMED, tells=False)
    with pytest.raises(Refused, match="takes 0.8 s: give it a longer timeout"):
        head.move_to(50 * DEGREE, timeout=0.2)
    assert device.halted()


def test_timed_moves_that_are_too_short_do_nothing():
    _, head = opened(TIMED, tells=False)
    assert head.move_to(0.1 * DEGREE) == 0.0


@pytest.mark.parametrize("habits", [{}, {"tells": False}], ids=["asks", "is told"])
def test_calibrated_speed(habits):
    device, head = opened(dataclasses.replace(FAST, tilt_speed=0x10), down=1.5, delay_s=0.05, **habits)
    reading = None if head.has_feedback else (lambda: device.elevation() * DEGREE)
    up, down, delay = head.calibrate_speed(reading, travel_deg=20)
    assert up == pytest.approx(64, rel=0.02) and down == pytest.approx(96, rel=0.02)
    assert delay == pytest.approx(0.05, abs=0.005)
    assert head.move_to(20 * DEGREE) == near(20)
    assert device.elevation() == pytest.approx(20, abs=1)


def test_calibration_without_any_reading():
    _, head = opened(tells=False)
    with pytest.raises(DeviceError, match="pass reading"):
        head.calibrate_speed()


def test_calibration_of_a_head_that_does_not_move():
    device, head = opened()
    device.stuck = True
    with pytest.raises(Refused, match="does not move the way"):
        head.calibrate_speed()


# ------------------------------------------------------------------------------------------------------- sweeps

SWEEPS = {
    "full": {},
    "echo and general": {"echo": 512, "acknowledges": "general"},
    "silent while moving": {"tells_moving": False},
    "tells nothing": {"tells": False},
}
SLOW = dataclasses.replace(FAST, degrees_per_second=32.0, tilt_speed=0x08)


@pytest.mark.parametrize("habits", SWEEPS.values(), ids=SWEEPS)
def test_sweep_logs_the_pitch(habits):
    device, head = opened(SLOW, **habits)
    head.move_to(-15 * DEGREE)
    host = device.host.time()
    truth = []
    head.start_sweep(15 * DEGREE)
    assert head.moving()
    with pytest.raises(DeviceError, match="is moving already"):
        head.move_to(0)
    while head.moving():
        truth.append((device.host.time(), device.elevation() * DEGREE))
        device.host.sleep(0.01)
    track = head.finish_sweep(10)
    assert track == head.track
    times, pitches, measured = zip(*track, strict=True)
    assert host <= times[0] and list(times) == sorted(times)
    assert device.elevation() == pytest.approx(15, abs=1)
    assert pitches[-1] == near(device.elevation(), 0.5 if habits.get("tells") is False else 0.02)
    assert measured[-1] == head.has_feedback
    assert any(measured[3:-3]) == (head.has_feedback and habits.get("tells_moving", True))
    worst = max(abs(np.interp(instant, times, pitches) - pitch) for instant, pitch in truth)
    assert worst < (0.5 if any(measured[3:-3]) else 1.5) * DEGREE


def test_sweep_of_a_silent_head_with_a_wrong_speed_is_drawn_to_where_it_ends():
    settings = dataclasses.replace(SLOW, degrees_per_second=24.0)
    device, head = opened(settings, tells_moving=False)
    head.start_sweep(15 * DEGREE)
    track = head.finish_sweep(20)
    assert device.elevation() == pytest.approx(20, abs=3)
    assert [pitch for _, pitch, measured in track if not measured][-1] == near(device.elevation(), 2)


def test_sweep_downwards_at_another_speed_learns_it():
    _, head = opened()
    head.move_to(20 * DEGREE)
    head.start_sweep(-20 * DEGREE, speed=0x1F)
    assert head.finish_sweep(20)[-1][1] == near(-20, 6)
    assert math.degrees(head.motion.speed(-1, 0x1F)) == pytest.approx(124, rel=0.25)


def test_dead_reckoning_is_drawn_to_the_readings():
    track = [(0, 0.0, True), (1, 1.0, False), (2, 2.0, False), (3, 6.0, True), (4, 7.0, False)]
    drawn = drawn_to_readings([(*row, at) for row, at in zip(track, [0.0, 1.0, 2.0, 3.0, 7.0], strict=True)])
    assert drawn == [(0, 0.0, True), (1, 2.0, False), (2, 4.0, False), (3, 6.0, True), (4, 7.0, False)]
    assert drawn_to_readings([(1, 1.0, False, 1.0)]) == track[1:2]


def test_sweep_of_a_silent_head_of_unknown_speed():
    device, head = opened(tells_moving=False)
    head.start_sweep(50 * DEGREE)
    with pytest.raises(NoReply, match="call calibrate_speed first"):
        head.finish_sweep(20)
    assert device.halted()


def test_sweep_of_a_head_that_moves_the_other_way():
    device, head = opened(sign=-1)
    head.start_sweep(50 * DEGREE)
    with pytest.raises(Refused, match="the other way"):
        head.finish_sweep(20)
    assert device.halted() and device.elevation() > -40


def test_sweep_is_ended_by_a_stop():
    device, head = opened(SLOW)
    head.start_sweep(50 * DEGREE)
    device.host.sleep(0.1)
    head.stop()
    assert not head.moving() and device.halted()
    assert head.finish_sweep()[-1][1] == near(device.elevation(), 0.1)


def test_sweep_that_takes_too_long():
    device, head = opened(SLOW)
    head.start_sweep(50 * DEGREE)
    with pytest.raises(NoReply, match="not over after 0.05 s"):
        head.finish_sweep(0.05)
    assert device.halted()


def test_sweeps_that_cannot_be():
    _, head = opened()
    with pytest.raises(DeviceError, match="there was no sweep"):
        head.finish_sweep()
    with pytest.raises(ValueError, match="speed is 64"):
        head.start_sweep(0.1, speed=64)
    assert head.track == []


# --------------------------------------------------------------------------------------------------------- stops


def test_stop_from_another_thread_ends_a_move():
    device, head = opened(TIMED, tells=False)
    device.when(lambda: device.elevation() > 5, head.stop)
    with pytest.raises(DeviceError, match="stopped before it arrived"):
        head.move_to(60 * DEGREE)
    assert device.halted()
    assert 0 < head.pitch()[0] < 59 * DEGREE


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_whatever_ends_a_move_stops_the_head(monkeypatch, error):
    device, head = opened(dataclasses.replace(FAST, absolute=False))
    moved = []

    def fail(*_):
        if not moved:
            device.host.wait(device.moves, 1.0)  # the frame is still on its way
        moved.append(device.moves())
        raise error

    monkeypatch.setattr(head.motion, "pause", fail)
    with pytest.raises(error):
        head.motion.run(1, 1, 5)
    assert moved == [True] and device.halted()
    with pytest.raises(error):
        head.move_to(30 * DEGREE)
    assert not head.moving() and device.halted()


def test_close_stops_the_head_and_is_final():
    device, head = opened(SLOW)
    head.start_sweep(60 * DEGREE)
    head.close()
    head.close()
    assert device.halted()
    for call in (head.pitch, head.stop, lambda: head.move_to(0)):
        with pytest.raises(DeviceError, match="closed"):
            call()


def test_opening_stops_a_head_that_was_left_running():
    device = FakeHead()
    device.go(80.0, 20.0)
    with PanTilt(device.path, FAST, host=device.host):
        assert device.halted()


@pytest.mark.parametrize("way", ["exit", "SIGTERM", "SIGHUP", "SIGINT"])
def test_the_end_of_the_process_stops_the_head(tmp_path, way):
    """In real time, on a pseudo-terminal."""
    code = """
    import sys, time
    from lrfcal_lib.drivers.head import HeadSettings, PanTilt
    head = PanTilt(sys.argv[1], HeadSettings(baudrate=38400, gap_s=0.005))
    head.start_sweep(1.0, speed=1)
    try:
        print("moving", flush=True)
        time.sleep(float(sys.argv[2]))
    finally:
        print("files closed", flush=True)
    """
    with EmulatedHead(path=tmp_path / "head", baudrate=38400, speeds=(0.01, 1.0)) as device:

        def becomes(moving):
            end = time.monotonic() + 30  # a guard against hanging; to its limit it takes much longer
            while device.head.tilt.moving(device.clock.now()) != moving and time.monotonic() < end:
                time.sleep(0.01)
            return time.monotonic() < end

        call = [sys.executable, "-c", textwrap.dedent(code), device.path, "0" if way == "exit" else "60"]
        process = subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert process.stdout.readline() == "moving\n"
        if way != "exit":
            assert becomes(moving=True)
            process.send_signal(getattr(signal, way))
        assert process.wait(60) == {"exit": 0, "SIGTERM": 143, "SIGHUP": 129, "SIGINT": -signal.SIGINT}[way]
        assert process.stdout.read() == "files closed\n"
        process.stdout.close()
        assert becomes(moving=False)
    assert device.error is None


def test_signal_handlers_are_put_back():
    before = signal.getsignal(signal.SIGTERM)
    _, head = opened()
    assert signal.getsignal(signal.SIGTERM) is not before
    head.close()
    assert signal.getsignal(signal.SIGTERM) is before


def test_motion_is_repeated_for_heads_with_a_watchdog():
    habits = {"tells": False, "watchdog_s": 0.12}
    device, head = opened(dataclasses.replace(TIMED, repeat_s=0.04), **habits)
    head.move_to(30 * DEGREE)
    assert device.elevation() == pytest.approx(30, abs=1)
    assert sum(frame.command2 == pelco_d.UP for frame in device.frames) > 5


# ----------------------------------------------------------------------------------------------------- bad lines


def test_line_that_comes_back_during_a_move():
    device, head = opened(fastest=40.0)
    device.when(lambda: device.elevation() > 5, device.go_away)
    assert head.move_to(40 * DEGREE) == near(40)
    assert head._line.counts["reconnects"] == 1


def test_line_that_comes_back_finds_the_head_stopped():
    device, head = opened()
    device.go(80.0, 4.0)
    device.port.unplug()
    device.port.plug()
    with contextlib.suppress(NoReply):
        head.pitch()
    assert device.halted()


def test_line_that_stays_away():
    device, head = opened(dataclasses.replace(FAST, reconnect_s=0.2))
    device.port.unplug()
    with pytest.raises(LineLost, match="there is no port"):
        head.move_to(10 * DEGREE)
    with pytest.raises(LineLost, match="there is no port"):
        head.pitch()
    device.port.plug()
    assert head.move_to(10 * DEGREE) == near(10)


def test_lost_line_makes_dead_reckoning_unknown():
    device, head = opened(dataclasses.replace(SLOW, settle_s=0.04), tells=False)
    device.when(lambda: device.elevation() > 3, device.go_away)
    with pytest.raises(LineLost):
        head.move_to(50 * DEGREE)
    assert device.halted()
    with pytest.raises(DeviceError, match="call set_pitch"):
        head.move_to(0)
    head.set_pitch(0.0)
    assert head.move_to(10 * DEGREE) == near(10, 1.5)


def test_line_lost_in_a_sweep():
    device, head = opened(SLOW)
    head.start_sweep(50 * DEGREE)
    device.when(lambda: device.elevation() > 3, device.go_away)
    with pytest.raises(LineLost):
        head.finish_sweep(20)
    assert device.halted()


def test_head_that_falls_silent():
    device, head = opened()
    device.deaf = True
    with pytest.raises(NoReply, match="address 1 and 38400 Bd"):
        head.pitch()
    with pytest.raises(NoReply):
        head.move_to(10 * DEGREE, timeout=0.3)


def test_head_that_falls_silent_in_a_move():
    device, head = opened(fastest=40.0)
    device.when(lambda: device.elevation() > 4, lambda: setattr(device, "tells", False))
    with pytest.raises(NoReply, match="stopped telling its tilt"):
        head.move_to(40 * DEGREE, timeout=1.5)
    assert device.halted()


def test_stated_feedback_that_does_not_come():
    device = FakeHead(tells=False, echo=512)
    with pytest.raises(NoReply, match="the adapter works: check its power"):
        PanTilt(device.path, dataclasses.replace(FAST, feedback=True), host=device.host)


def test_stated_echo(caplog):
    device = FakeHead()
    with pytest.raises(NoReply, match="does not echo"):
        PanTilt(device.path, dataclasses.replace(FAST, echo=True), host=device.host)
    device.echo = 512
    PanTilt(device.path, dataclasses.replace(FAST, echo=True), host=device.host).close()
    assert "not expected" not in caplog.text
    PanTilt(device.path, dataclasses.replace(FAST, echo=False), host=device.host).close()
    assert "not expected" in caplog.text


def test_another_device_at_the_port(monkeypatch):
    device = FakeHead()
    monkeypatch.setattr(device, "_obey", lambda frame: device.write(bytes(range(2, 200)), device.clock.now()))
    with pytest.raises(WrongDevice, match="no Pelco-D at 38400 Bd"):
        PanTilt(device.path, FAST, host=device.host)


def test_missing_port(tmp_path):
    with pytest.raises(PortError, match="there is no port"):
        PanTilt(tmp_path / "none", FAST)


@pytest.mark.parametrize(
    ("name", "value"),
    [("address", 256), ("tilt_speed", 64), ("pitch_limits_deg", (10, -10)), ("feedback", "maybe"), ("baudrate", 0),
     ("degrees_per_second", (4.0, 0.0)), ("repeat_s", 0.0), ("settle_s", -1.0), ("echo", "loud")],
)  # fmt: skip
def test_settings_that_no_head_has(name, value):
    with pytest.raises(ValueError, match=f"head.{name} is"):
        HeadSettings(**{name: value})


# ------------------------------------------------------------------------------------------------ emulated heads

QUICK = HeadSettings(baudrate=38400, settle_s=0.08, stall_s=0.2, poll_s=0.02, reply_s=0.1, gap_s=0.01, reconnect_s=3.0)
SPEEDY = {"baudrate": 38400, "speeds": (5.0, 120.0), "go_speed": 120.0}
KINDS = {
    "full": {},
    "general replies and echo": {"reply": "general", "echo": True},
    "5-byte replies": {"reply": "five"},
    "single byte": {"reply": "single"},
    "partial": {"feedback": "partial", "echo": True},
    "watchdog": {"feedback": "partial", "watchdog_s": 0.3},
    "inverted": {"invert": True},
    "nothing": {"feedback": "none"},
}


def emulated(settings=QUICK, settle=0.1, **options):
    return opened(settings, virtual.head(head=Head(Platform(settle=settle)), **options))


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_emulated_heads_of_every_kind(kind):
    settings = dataclasses.replace(QUICK, invert=kind.get("invert", False), degrees_per_second=5 + 115 * 32 / 63,
                                   repeat_s=0.1 if "watchdog_s" in kind else None)  # fmt: skip
    device, head = emulated(settings, **(SPEEDY | kind))
    with head:
        for degrees in (15.0, -10.0):
            pitch = head.move_to(degrees * DEGREE)
            device.clock.machine.sleep(0.1)
            assert pitch == near(degrees, 0.6 if head.has_feedback else 2.0)
            assert device.pitch() == pytest.approx(pitch, abs=(0.05 if head.has_feedback else 2.0) * DEGREE)


def test_emulated_head_swept_at_the_slowest_line():
    device, head = emulated(HeadSettings(settle_s=0.1), speeds=(2.0, 60.0))
    head.start_sweep(30 * DEGREE)
    times, pitches, measured = zip(*head.finish_sweep(20), strict=True)
    wrong = np.abs(device.head.tilt.motor(device.clock.device(times)) - pitches)
    assert sum(measured) >= 5 and pitches[-1] == near(30, 1.0)
    assert wrong.max() < 1.0 * DEGREE  # 30 deg/s and half of the query's 60 ms


@pytest.mark.parametrize("kind", [name for name, fault in FAULTS.items() if "head" in fault.devices])
def test_no_fault_of_an_emulated_head_ends_in_a_wrong_pitch(kind):
    device, head = emulated(settle=0.05, **SPEEDY)
    with head:
        for goal in (4 * DEGREE, -4 * DEGREE):
            device.faults.inject(kind, 1 if kind == "unplug" else 2)
            begun, pitch = device.clock.now(), None
            with contextlib.suppress(DeviceError):
                pitch = head.move_to(goal, timeout=6)
            assert device.clock.now() - begun < 10
            device.faults.clear()
            if pitch is None:
                pitch = head.move_to(goal, timeout=6)
                assert pitch == near(goal / DEGREE)
            device.clock.machine.sleep(0.06)
            assert device.pitch() == pytest.approx(pitch, abs=0.1 * DEGREE)
        assert head.pitch() == (pytest.approx(device.pitch(), abs=0.1 * DEGREE), True)
