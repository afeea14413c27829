"""The pitch axis: heads that answer fully, partly, with echo or not at all, on a pseudo-terminal."""

import contextlib
import dataclasses
import logging
import math
import os
import select
import signal
import subprocess
import sys
import textwrap
import threading
import time
import tty

import pytest
from hiccups import Hiccups

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.errors import DeviceError, LineLost, NoReply, OutOfRange, PortError, Refused, WrongDevice
from lrfcal_lib.drivers.head_sweep import drawn_to_readings
from lrfcal_lib.drivers.pan_tilt import HeadSettings, PanTilt

FAST = HeadSettings(baudrate=38400, settle_s=0.04, stall_s=0.2, poll_s=0.01, reply_s=0.1, gap_s=0.005, retries=2,
                    reconnect_s=2.0)  # fmt: skip
DEGREE = math.radians(1)


class PtyHead(threading.Thread):
    """A head on a pseudo-terminal whose habits can be switched while it runs.

    Speed byte 0x3F makes `fastest` deg/s, others in proportion; down is `down` times as fast. Angles are elevations.
    """

    def __init__(self, path, *, tells=True, tells_moving=True, obeys=True, echo=0, acknowledges="", short=False,
                 fastest=252.0, down=1.0, sign=1, delay_s=0.0, watchdog_s=None, at=0.0):  # fmt: skip
        super().__init__(daemon=True)
        self.tells, self.tells_moving, self.obeys, self.echo = tells, tells_moving, obeys, echo
        self.acknowledges, self.short, self.watchdog_s = acknowledges, short, watchdog_s
        self.fastest, self.down, self.sign, self.delay_s = fastest, down, sign, delay_s
        self.deaf = self.stuck = False
        self.lost = 0  # set-tilts that will have no effect
        self.lies, self.ends, self.late = [], (-90.0, 90.0), None
        self.frames, self._segment, self._heard = [], (0.0, 0.0, at, at), math.inf
        self.path, self._lock, self._quit = path, threading.Lock(), False
        self.plug()
        self.start()

    def plug(self):
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(slave))
        self._slave = slave

    def unplug(self):
        with self._lock:
            self.path.unlink()
            os.close(self._slave)
            os.close(self.master)
            self.master = None

    def go_away(self):
        """Vanish for a moment."""
        self.unplug()
        time.sleep(0.2)
        self.plug()

    def elevation(self):
        """Degrees, up positive."""
        begun, speed, start, goal = self._segment
        way = speed * max(0.0, time.monotonic() - begun - self.delay_s)
        return max(start - way, goal) if goal < start else min(start + way, goal)

    def _go(self, goal, speed):
        here = self.elevation()
        goal = here if self.stuck or goal is None else min(max(goal, self.ends[0]), self.ends[1])
        self._segment = (time.monotonic(), speed * (self.down if goal < here else 1), here, goal)

    def moves(self):
        return self.elevation() != self._segment[3]

    def stopped(self):
        """Whether it stands where it was told to stop, or never moved."""
        return self._segment[2] == self._segment[3]

    def run(self):
        data = b""
        while not self._quit:
            with self._lock:
                if self.master is None:
                    data = b""
                    received = b""
                else:
                    ready = select.select([self.master], [], [], 0.005)[0]
                    received = os.read(self.master, 512) if ready else b""
                    if self.echo and received:
                        os.write(self.master, received[-self.echo :])
                    frames, kept = pelco_d.split_frames(data := data + received)
                    data = data[kept:]
                    for frame in frames:
                        self._obey(frame)
            if self.watchdog_s and time.monotonic() - self._heard > self.watchdog_s:
                self._go(None, 0.0)
            if not received:
                time.sleep(0.001)

    def _obey(self, frame):
        if self.deaf:
            return
        self._heard = time.monotonic()
        self.frames.append(frame)
        if frame.command2 == pelco_d.QUERY_TILT:
            return self._tell()
        if frame.command2 == pelco_d.SET_TILT and self.lost:
            self.lost -= 1
        elif frame.command2 == pelco_d.SET_TILT and self.obeys:
            self._go(math.degrees(pelco_d.decode_tilt(frame.value)), self.fastest)
        elif not frame.command2 & 1:
            way = {pelco_d.UP: 1, pelco_d.DOWN: -1}.get(frame.command2 & 0x18, 0) * self.sign
            self._go(way * 1e9 if way else None, self.fastest * max(frame.data2, 1) / 0x3F)
        if self.acknowledges == "general":
            body = bytes([frame.address, frame.command1, frame.command2, frame.data1, frame.data2])
            os.write(self.master, bytes([0xFF, frame.address, 0, sum(body) & 0xFF]))
        elif self.acknowledges == "success":
            os.write(self.master, b"\x01")

    def _tell(self):
        if self.tells and (self.tells_moving or not self.moves()):
            value = pelco_d.encode_tilt(math.radians(self.lies.pop() if self.lies else self.elevation()))
            raw = pelco_d.encode_extended(1, pelco_d.TILT, value)
            raw = bytes([*raw[2:6], sum(raw[2:6]) & 0xFF]) if self.short else raw
            if self.late is not None:  # this one comes after the next query, in place of its answer
                raw, self.late = self.late, raw if not self.late else None
            os.write(self.master, raw)

    def close(self):
        self._quit = True
        self.join()


@pytest.fixture
def make(tmp_path):
    """Makes heads, and closes what was made."""
    with contextlib.ExitStack() as stack:

        def make(**habits):
            head = PtyHead(tmp_path / "head", **habits)
            stack.callback(head.close)
            return head

        make.stack = stack
        yield make


@pytest.fixture
def late():
    """Function: s by which a command may have come late so far; a timed move is as much longer or shorter.

    Both its start and its stop may be late by the longest time that this machine let a thread wait.
    """
    hiccups = Hiccups()
    hiccups.start()
    yield lambda: 2 * max((wait for _, wait in hiccups.waits), default=0.0)
    hiccups.over.set()
    hiccups.join()


def opened(make, settings=FAST, **habits):
    """A head and its driver."""
    device = make(**habits)
    return device, make.stack.enter_context(PanTilt.open(device.path, settings))


def wait_until(holds):
    """What the head does a moment later."""
    deadline = time.monotonic() + 5
    while not holds() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert holds()


def halted(device):
    """Wait for a stop to come to the head, which may be busy; one that arrived or ran into its end was not stopped."""
    wait_until(device.stopped)
    return True


def when(holds, action):
    """Do something as soon as a condition holds, from another thread."""

    def run():
        wait_until(holds)
        action()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


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
def test_moves_to_where_it_is_sent(make, habits):
    device, head = opened(make, **habits)
    assert head.has_feedback
    for degrees in (10.0, -20.0):  # the first one learns
        pitch = head.move_to(degrees * DEGREE)
        assert pitch == near(degrees)
        assert device.elevation() * DEGREE == pytest.approx(pitch, abs=0.02 * DEGREE)
        assert head.pitch() == (pytest.approx(pitch, abs=0.02 * DEGREE), True)
        assert not head.moving()


@pytest.mark.parametrize("obeys", [True, False])
def test_inverted_head_with_another_zero(make, obeys):
    settings = dataclasses.replace(FAST, invert=True, position_zero_deg=5.0)
    device, head = opened(make, settings, obeys=obeys)
    assert head.move_to(20 * DEGREE) == near(20)
    assert device.elevation() == pytest.approx(-15, abs=0.6)


def test_pitch_of_a_head_whose_zero_is_far_off():
    settings = HeadSettings(position_zero_deg=170)
    for degrees in (-50, 0, 50):
        elevation = settings.elevation(degrees * DEGREE)
        told = pelco_d.decode_tilt(pelco_d.encode_tilt(elevation))
        assert settings.pitch(told) == near(degrees, 0.01)


def test_limits_are_named_and_nothing_moves(make):
    device, head = opened(make)
    before = len(device.frames)
    for call in (head.move_to, head.start_sweep):
        with pytest.raises(OutOfRange, match="-70.00 deg is beyond the head's limits of -60 to 60"):
            call(-70 * DEGREE)
    assert isinstance(pytest.raises(ValueError, head.move_to, math.nan).value, OutOfRange)
    assert len(device.frames) == before
    assert head.move_to(60 * DEGREE) == near(60)


def test_head_at_its_end_stop(make):
    device, head = opened(make)
    device.ends = (-10.0, 10.0)
    head.move_to(5 * DEGREE)
    with pytest.raises(Refused, match="stays at 10.00 deg on its way to 30.00"):
        head.move_to(30 * DEGREE)
    assert head.pitch()[0] == near(10)


def test_head_that_does_not_move(make):
    device, head = opened(make, dataclasses.replace(FAST, absolute=False))
    device.stuck = True
    with pytest.raises(Refused, match="does not move: look for an end stop"):
        head.move_to(10 * DEGREE)
    device.stuck = False
    assert head.move_to(10 * DEGREE) == near(10)


def test_head_that_moves_the_other_way(make):
    device, head = opened(make, obeys=False, sign=-1)
    with pytest.raises(Refused, match="the other way: set invert"):
        head.move_to(30 * DEGREE)
    assert halted(device)


def test_set_tilt_that_must_work(make):
    _, head = opened(make, dataclasses.replace(FAST, absolute=True), obeys=False)
    with pytest.raises(Refused, match="does not obey set-tilt"):
        head.move_to(10 * DEGREE)


def test_one_lost_set_tilt_is_sent_again(make):
    device, head = opened(make)
    device.lost = 1
    assert head.move_to(10 * DEGREE) == near(10)
    assert sum(frame.command2 == pelco_d.SET_TILT for frame in device.frames) == 2


def test_readings_that_jump_are_not_believed(make):
    device, head = opened(make)
    head.move_to(10 * DEGREE)
    device.lies = [20.0]
    assert head.pitch() == (near(10), True)
    assert not device.lies


def test_late_reply_is_not_taken_for_the_next(make):
    device, head = opened(make)
    device.late = b""
    assert head._line.tilt(0) is None
    device._segment = (0.0, 0.0, 2.0, 2.0)
    assert head._line.tilt(0)[1] == near(2, 0.01)
    assert device.late is None


def test_speed_nought_is_not_stop(make, late):
    device, head = opened(make, dataclasses.replace(FAST, tilt_speed=0, degrees_per_second=2.0), tells=False)
    head.move_to(0.5 * DEGREE)
    assert [frame.data2 for frame in device.frames if frame.command2 == pelco_d.UP] == [0]
    wait_until(lambda: device.frames[-1].command2 == 0)
    assert halted(device)
    assert 0.4 < device.elevation() < 2.0 + 4 * late()  # 1.0 at 4 deg/s, twice what was stated


# ------------------------------------------------------------------------------------------------- timed moves

TIMED = dataclasses.replace(FAST, degrees_per_second=(64.0, 96.0), tilt_speed=0x10)


def test_timed_moves_say_what_they_are(make, caplog, late):
    with caplog.at_level(logging.INFO):
        device, head = opened(make, TIMED, tells=False, down=1.5)
        assert not head.has_feedback
        assert head.pitch() == (0.0, False)
        assert head.move_to(20 * DEGREE) == near(20, 1.5)
        assert head.move_to(-10 * DEGREE) == near(-10, 1.5)
    assert head.pitch() == (near(-10, 1.5), False)
    assert halted(device)
    assert device.elevation() == pytest.approx(-10, abs=3 + (64 + 96) * late())
    said = [record.message for record in caplog.records if "timed moves" in record.message]
    assert len(said) == 1 and "64/96 deg/s (stated)" in said[0]


def test_start_of_a_head_without_feedback(make, caplog):
    settings = dataclasses.replace(FAST, start_pitch_deg=-15.0, feedback=False)
    device, head = opened(make, settings)
    assert "assumed, calibrate it" in caplog.text
    assert head.pitch() == (near(-15, 1e-6), False)
    head.set_pitch(0.1)
    assert head.pitch() == (0.1, False)
    assert not any(frame.command2 == pelco_d.QUERY_TILT for frame in device.frames)


def test_timed_move_that_takes_too_long(make):
    device, head = opened(make, TIMED, tells=False)
    with pytest.raises(Refused, match="takes 0.8 s: give it a longer timeout"):
        head.move_to(50 * DEGREE, timeout=0.2)
    assert halted(device)


def test_timed_moves_that_are_too_short_do_nothing(make):
    _, head = opened(make, TIMED, tells=False)
    assert head.move_to(0.1 * DEGREE) == 0.0


@pytest.mark.parametrize("habits", [{}, {"tells": False}], ids=["asks", "is told"])
def test_calibrated_speed(make, habits, late):
    device, head = opened(make, dataclasses.replace(FAST, tilt_speed=0x10), down=1.5, delay_s=0.05, **habits)
    reading = None if head.has_feedback else (lambda: device.elevation() * DEGREE)
    up, down, delay = head.calibrate_speed(reading, travel_deg=20)
    wrong = 0.15 + late() / (2 / 3 * 20 / 96)  # the long move downwards lasts so much longer than the short one
    assert up == pytest.approx(64, rel=wrong) and down == pytest.approx(96, rel=wrong)
    assert delay == pytest.approx(0.05, abs=0.02 + late())
    assert head.move_to(20 * DEGREE) == near(20, 2 + 96 * late())
    assert device.elevation() == pytest.approx(20, abs=5 + 96 * late() + 20 * (wrong - 0.15))


def test_calibration_without_any_reading(make):
    _, head = opened(make, tells=False)
    with pytest.raises(DeviceError, match="pass reading"):
        head.calibrate_speed()


def test_calibration_of_a_head_that_does_not_move(make):
    device, head = opened(make)
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
def test_sweep_logs_the_pitch(make, habits, late):
    device, head = opened(make, SLOW, **habits)
    head.move_to(-15 * DEGREE)
    host = time.time()
    truth = []
    head.start_sweep(15 * DEGREE)
    assert head.moving()
    with pytest.raises(DeviceError, match="is moving already"):
        head.move_to(0)
    while head.moving():
        truth.append((time.time(), device.elevation() * DEGREE))
        time.sleep(0.01)
    track = head.finish_sweep(10)
    assert track == head.track
    times, pitches, measured = zip(*track, strict=True)
    assert host <= times[0] and list(times) == sorted(times)
    off = 3 + 32 * late()
    assert device.elevation() == pytest.approx(15, abs=off)
    assert pitches[-1] == near(device.elevation(), off if habits.get("tells") is False else 0.02)
    assert measured[-1] == head.has_feedback
    assert any(measured[3:-3]) == (head.has_feedback and habits.get("tells_moving", True))
    worst = max(abs(_interpolate(times, pitches, instant) - pitch) for instant, pitch in truth)
    assert worst < (1 if any(measured[3:-3]) else 3) * DEGREE + 32 * DEGREE * late()


def _interpolate(times, pitches, instant):
    import numpy as np

    return np.interp(instant, times, pitches)


def test_sweep_of_a_silent_head_with_a_wrong_speed_is_drawn_to_where_it_ends(make):
    settings = dataclasses.replace(SLOW, degrees_per_second=24.0)
    device, head = opened(make, settings, tells_moving=False)
    head.start_sweep(15 * DEGREE)
    track = head.finish_sweep(20)
    assert device.elevation() == pytest.approx(20, abs=3)
    assert [pitch for _, pitch, measured in track if not measured][-1] == near(device.elevation(), 2)


def test_sweep_downwards_at_another_speed_learns_it(make):
    _, head = opened(make)
    head.move_to(20 * DEGREE)
    head.start_sweep(-20 * DEGREE, speed=0x1F)
    assert head.finish_sweep(20)[-1][1] == near(-20, 6)
    assert math.degrees(head._motion.speed(-1, 0x1F)) == pytest.approx(124, rel=0.25)


def test_dead_reckoning_is_drawn_to_the_readings():
    track = [(0, 0.0, True), (1, 1.0, False), (2, 2.0, False), (3, 6.0, True), (4, 7.0, False)]
    drawn = drawn_to_readings(track, [0.0, 1.0, 2.0, 3.0, 7.0])
    assert drawn == [(0, 0.0, True), (1, 2.0, False), (2, 4.0, False), (3, 6.0, True), (4, 7.0, False)]
    assert drawn_to_readings(track[1:2], [1.0]) == track[1:2]


def test_sweep_of_a_silent_head_of_unknown_speed(make):
    device, head = opened(make, tells_moving=False)
    head.start_sweep(50 * DEGREE)
    with pytest.raises(NoReply, match="call calibrate_speed first"):
        head.finish_sweep(20)
    assert halted(device)


def test_sweep_of_a_head_that_moves_the_other_way(make):
    device, head = opened(make, sign=-1)
    head.start_sweep(50 * DEGREE)
    with pytest.raises(Refused, match="the other way"):
        head.finish_sweep(20)
    assert halted(device) and device.elevation() > -40


def test_sweep_is_ended_by_a_stop(make):
    device, head = opened(make, SLOW)
    head.start_sweep(50 * DEGREE)
    time.sleep(0.1)
    head.stop()
    assert not head.moving() and halted(device)
    assert head.finish_sweep()[-1][1] == near(device.elevation(), 0.1)


def test_sweep_that_takes_too_long(make):
    device, head = opened(make, SLOW)
    head.start_sweep(50 * DEGREE)
    with pytest.raises(NoReply, match="not over after 0.05 s"):
        head.finish_sweep(0.05)
    assert halted(device)


def test_sweeps_that_cannot_be(make):
    _, head = opened(make)
    with pytest.raises(DeviceError, match="there was no sweep"):
        head.finish_sweep()
    with pytest.raises(ValueError, match="speed is 64"):
        head.start_sweep(0.1, speed=64)
    assert head.track == []


# --------------------------------------------------------------------------------------------------------- stops


def test_stop_from_another_thread_ends_a_move(make):
    device, head = opened(make, TIMED, tells=False)
    when(lambda: device.elevation() > 5, head.stop)
    with pytest.raises(DeviceError, match="stopped before it arrived"):
        head.move_to(60 * DEGREE)
    assert halted(device)
    assert 0 < head.pitch()[0] < 59 * DEGREE


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_whatever_ends_a_move_stops_the_head(make, monkeypatch, error):
    device, head = opened(make, dataclasses.replace(FAST, absolute=False))
    moved = []

    def fail(*_):
        if not moved:
            wait_until(device.moves)  # the frame may still be on its way
        moved.append(device.moves())
        raise error

    monkeypatch.setattr(head._motion, "pause", fail)
    with pytest.raises(error):
        head._motion.run(1, 1, 5)
    assert moved == [True] and halted(device)
    with pytest.raises(error):
        head.move_to(30 * DEGREE)
    assert not head.moving() and halted(device)


def test_close_stops_the_head_and_is_final(make):
    device, head = opened(make, SLOW)
    head.start_sweep(60 * DEGREE)
    head.close()
    head.close()
    assert halted(device)
    for call in (head.pitch, head.stop, lambda: head.move_to(0)):
        with pytest.raises(DeviceError, match="closed"):
            call()


def test_opening_stops_a_head_that_was_left_running(make):
    device = make()
    device._go(80.0, 20.0)
    with PanTilt.open(device.path, FAST):
        assert halted(device)


@pytest.mark.parametrize("way", ["exit", "SIGTERM", "SIGHUP", "SIGINT"])
def test_the_end_of_the_process_stops_the_head(make, way):
    device = make()
    code = f"""
    import time
    from lrfcal_lib.drivers.pan_tilt import HeadSettings, PanTilt
    head = PanTilt.open({str(device.path)!r}, HeadSettings(baudrate=38400, gap_s=0.005))
    head.start_sweep(1.0, speed=1)
    try:
        print("moving", flush=True)
        time.sleep({0 if way == "exit" else 30})
    finally:
        print("files closed", flush=True)
    """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, text=True,
                               stderr=subprocess.DEVNULL)  # fmt: skip
    assert process.stdout.readline() == "moving\n"
    if way != "exit":
        wait_until(device.moves)
        process.send_signal(getattr(signal, way))
    assert process.wait(20) == {"exit": 0, "SIGTERM": 143, "SIGHUP": 129, "SIGINT": -signal.SIGINT}[way]
    assert process.stdout.read() == "files closed\n"
    process.stdout.close()
    assert halted(device)


def test_signal_handlers_are_put_back(make):
    before = signal.getsignal(signal.SIGTERM)
    _, head = opened(make)
    assert signal.getsignal(signal.SIGTERM) is not before
    head.close()
    assert signal.getsignal(signal.SIGTERM) is before


def test_motion_is_repeated_for_heads_with_a_watchdog(make, late):
    habits = {"tells": False, "watchdog_s": 0.12}
    device, head = opened(make, dataclasses.replace(TIMED, repeat_s=0.04), **habits)
    head.move_to(30 * DEGREE)
    assert device.elevation() == pytest.approx(30, abs=3 + 64 * late())
    assert sum(frame.command2 == pelco_d.UP for frame in device.frames) > 5


# ----------------------------------------------------------------------------------------------------- bad lines


def test_line_that_comes_back_during_a_move(make):
    device, head = opened(make, fastest=40.0)
    when(lambda: device.elevation() > 5, device.go_away)
    assert head.move_to(40 * DEGREE) == near(40)
    assert head._line.counts["reconnects"] == 1


def test_line_that_comes_back_finds_the_head_stopped(make):
    device, head = opened(make)
    device._go(80.0, 4.0)
    device.unplug()
    device.plug()
    with contextlib.suppress(NoReply):
        head.pitch()
    assert halted(device)


def test_line_that_stays_away(make):
    device, head = opened(make, dataclasses.replace(FAST, reconnect_s=0.2))
    device.unplug()
    with pytest.raises(LineLost, match="there is no port"):
        head.move_to(10 * DEGREE)
    with pytest.raises(LineLost, match="there is no port"):
        head.pitch()
    device.plug()
    assert head.move_to(10 * DEGREE) == near(10)


def test_lost_line_makes_dead_reckoning_unknown(make):
    device, head = opened(make, dataclasses.replace(SLOW, settle_s=0.04), tells=False)
    when(lambda: device.elevation() > 3, device.go_away)
    with pytest.raises(LineLost):
        head.move_to(50 * DEGREE)
    assert halted(device)
    with pytest.raises(DeviceError, match="call set_pitch"):
        head.move_to(0)
    head.set_pitch(0.0)
    assert head.move_to(10 * DEGREE) == near(10, 1.5)


def test_line_lost_in_a_sweep(make):
    device, head = opened(make, SLOW)
    head.start_sweep(50 * DEGREE)
    when(lambda: device.elevation() > 3, device.go_away)
    with pytest.raises(LineLost):
        head.finish_sweep(20)
    assert halted(device)


def test_head_that_falls_silent(make):
    device, head = opened(make)
    device.deaf = True
    with pytest.raises(NoReply, match="address 1 and 38400 Bd"):
        head.pitch()
    with pytest.raises(NoReply):
        head.move_to(10 * DEGREE, timeout=0.3)


def test_head_that_falls_silent_in_a_move(make):
    device, head = opened(make, fastest=40.0)
    when(lambda: device.elevation() > 4, lambda: setattr(device, "tells", False))
    with pytest.raises(NoReply, match="stopped telling its tilt"):
        head.move_to(40 * DEGREE, timeout=1.5)
    assert halted(device)


def test_stated_feedback_that_does_not_come(make):
    device = make(tells=False, echo=512)
    with pytest.raises(NoReply, match="the adapter works: check its power"):
        PanTilt.open(device.path, dataclasses.replace(FAST, feedback=True))


def test_stated_echo(make, caplog):
    device = make()
    with pytest.raises(NoReply, match="does not echo"):
        PanTilt.open(device.path, dataclasses.replace(FAST, echo=True))
    device.echo = 512
    PanTilt.open(device.path, dataclasses.replace(FAST, echo=True)).close()
    assert "not expected" not in caplog.text
    PanTilt.open(device.path, dataclasses.replace(FAST, echo=False)).close()
    assert "not expected" in caplog.text


def test_another_device_at_the_port(make, monkeypatch):
    monkeypatch.setattr(PtyHead, "_obey", lambda self, frame: os.write(self.master, bytes(range(2, 200))))
    with pytest.raises(WrongDevice, match="no Pelco-D at 38400 Bd"):
        PanTilt.open(make().path, FAST)


def test_missing_port(tmp_path):
    with pytest.raises(PortError, match="there is no port"):
        PanTilt.open(tmp_path / "none", FAST)


@pytest.mark.parametrize(
    ("name", "value"),
    [("address", 256), ("tilt_speed", 64), ("pitch_limits_deg", (10, -10)), ("feedback", "maybe"), ("baudrate", 0),
     ("degrees_per_second", (4.0, 0.0)), ("repeat_s", 0.0), ("settle_s", -1.0), ("echo", "loud")],
)  # fmt: skip
def test_settings_that_no_head_has(name, value):
    with pytest.raises(ValueError, match=f"head.{name} is"):
        HeadSettings(**{name: value})
