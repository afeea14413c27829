"""The rig file, and what a rig records of one placement: with devices that are not there."""

import contextlib
import json
import math
import os
import socket
import threading
from dataclasses import replace
from functools import partial, reduce

import numpy as np
import pytest
from fake_rig import BEAMS, SIZE, make_rig, raising, rig_data

from lrfcal_lib.drivers import rig as rig_module
from lrfcal_lib.drivers.port import DeviceError, NoReply, PortError
from lrfcal_lib.drivers.rig import Moved, Photographed, Rig, Scanned, Tracked
from lrfcal_lib.drivers.rig_file import Plan, RigFileError, read_rig_file, rig_of
from lrfcal_lib.session.lms2xx_codec import Configuration

# ------------------------------------------------------------------------------------------------------ rig file


def changed(path, value, **plan):
    """A rig file with one key changed (or removed, where the value is None)."""
    data = rig_data(**plan)
    *way, last = path.split(".")
    at = reduce(dict.__getitem__, way, data)
    at[last] = value
    if value is None:
        del at[last]
    return data


def read(tmp_path, data):
    file = tmp_path / "rig.json"
    file.write_text(json.dumps(data))
    return read_rig_file(file)


WRONG = {
    r"devices\.lrf\.port is missing": ("devices.lrf.port", None),
    r"lrf\.port and head\.port are both /dev/fake_lrf": ("devices.head.port", "/dev/fake_lrf"),
    r"devices\.head: adress is not known; known are address, .*port": ("devices.head.adress", 1),
    r"devices\.head\.tilt_speed is 99: a whole number from 0 to 63": ("devices.head.tilt_speed", 99),
    r"devices\.head\.address is 'one': a whole number from 0 to 255": ("devices.head.address", "one"),
    r"devices\.head\.pitch_limits_deg is \[10, -10\]: .*comes first": ("devices.head.pitch_limits_deg", [10, -10]),
    r"devices\.lrf\.unit is 'inch': 'mm' or 'cm'": ("devices.lrf.unit", "inch"),
    r"devices\.lrf\.variant is 180: a valid tuple": ("devices.lrf.variant", 180),
    r"lrf\.baudrate is 300: one of 9600, 19200, 38400, 500000": ("devices.lrf.baudrate", 300),
    "230400: .*no other range finder is driven here; .*SessionWriter": ("devices.lrf.baudrate", 230400),  # an LD19
    r"devices\.cameras\.left\.size is \[640, 480\], rig\.cameras\.left states \[32, 24\]":
        ("devices.cameras.left.size", [640, 480]),
    r"devices\.cameras are none, rig\.cameras left": ("devices.cameras", {}),
    r"plan\.mode is 'fast': 'stop-and-go' or 'continuous'": ("plan.mode", "fast"),
    r"plan\.pitch_deg is \[-4, 4, 0\]: first, last, and a step of 0\.001 or more": ("plan.pitch_deg", [-4, 4, 0]),
    r"plan\.pitch_deg is \[-4, 4\]: a list of 3": ("plan.pitch_deg", [-4, 4]),
    r"plan\.image_pitch_deg\.0 is 'up': a number from -180 to 180 deg": ("plan.image_pitch_deg", ["up"]),
    r"placement 1 asks for a pitch of -4 to 90 deg, .*pitch_limits_deg are -60 to 60": ("plan.image_pitch_deg", [90]),
    r"plan: placements: numbers must differ, got \[1, 1\]": ("plan.placements", [{"number": 1}, {"number": 1}]),
    r"square_m": ("board.pattern.square_m", -1),
    r"board is missing": ("board", None),
    r"rig\.platform is \[\]: an object": ("rig.platform", []),
    r"more than 10000000 bytes": ("source", "x" * 10_000_000),
}  # fmt: skip


@pytest.mark.parametrize("message", WRONG)
def test_a_wrong_rig_file_is_refused(tmp_path, message):
    with pytest.raises(RigFileError, match=rf"rig\.json: .*{message}"):
        read(tmp_path, changed(*WRONG[message]))


NO_JSON = (b"[" * 100_000, b'{"x": ' * 100_000, b"\xff", b'{"x": ' + b"9" * 5000 + b"}", b"", b"{")
NO_FILES = (os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero"))


@pytest.mark.parametrize(("made", "message"), [
    (lambda path: None, "No such file.*emulate --rig-file"),
    (lambda path: path.write_text("[1, 2]"), "the file is .*: an object"),
    *((lambda path, text=text: path.write_bytes(text), "not JSON") for text in NO_JSON),
    *((make, "no file, or one of more than") for make in NO_FILES),
])  # fmt: skip


def test_no_rig_file(tmp_path, made, message):
    path = tmp_path / "rig.json"
    made(path)
    with pytest.raises(RigFileError, match=rf"rig\.json: {message}"):
        read_rig_file(path)


def test_interlaced_scans_need_a_head_at_rest(tmp_path):
    stated = read(tmp_path, changed("devices.lrf.interlaced", True))
    with pytest.raises(RigFileError, match=r"devices\.lrf\.interlaced is true"):
        stated.with_mode("continuous")


@pytest.mark.parametrize(("step", "stops"), [(0.1, 151), (0.3, 51), (1, 16), (2.5, 7), (7, 4), (100, 2)])
def test_sweeps_meet_their_ends_and_do_not_exceed_their_step(step, stops):
    odd, even = Plan(pitch_deg=(-10, 5, step), count=2).to_do()
    np.testing.assert_allclose(np.degrees(odd.pitch[[0, -1]]), [-10, 5])
    assert np.diff(odd.pitch).max() <= math.radians(step) + 1e-12 and len(odd.pitch) == stops
    assert np.ptp(np.diff(odd.pitch)) < 1e-12
    np.testing.assert_array_equal(even.pitch, odd.pitch[::-1])
    assert (odd.direction, even.direction) == (1, -1)


# ------------------------------------------------------------------------------------------------- stop-and-go


def begun(rig, number=1, events=0):
    """The recording of a placement, which is that far."""
    running = rig.acquire(rig.stated.plan.to_do()[number - 1])
    for _ in range(events):
        next(running)
    return running


def events_of(rig, number=1, kind=object):
    return [event for event in begun(rig, number) if isinstance(event, kind)]


def test_scans_that_stay_older_than_the_rest_are_refused(monkeypatch):
    monkeypatch.setattr(rig_module, "SCAN_S", 0.05)
    rig = make_rig()
    rig.lrf.stale = 1e6
    with pytest.raises(DeviceError, match="no scan later than"):
        events_of(rig)


def test_a_line_that_was_lost_is_mended_once_a_stop(caplog):
    rig = make_rig()
    rig.lrf.lost = 1
    assert len(events_of(rig, kind=Scanned)) == 9
    assert rig.lrf.reconnects == 1 and "the line is lost; looking for" in caplog.text
    rig.lrf.lost = 2
    with pytest.raises(DeviceError, match="the line is lost"):
        events_of(rig)


@pytest.mark.parametrize("mode", ["stop-and-go", "continuous"])
def test_a_head_that_tells_nothing_and_does_not_move_ends_the_sweep(mode):
    """As with a wrong address or rate: the driver reckons that it moved, the scans say that it did not."""
    rig = make_rig(rig_data(mode=mode, pitch_deg=[-10, 30, 1]), feedback=False)
    scan = rig.lrf._scan
    rig.lrf._scan = lambda instant: replace(scan(instant), ranges=np.full(BEAMS, 2.0))
    with pytest.raises(NoReply, match="the head did not move: .*address 1 and 2400 Bd at /dev/fake_head"):
        events_of(rig)
    assert rig.head.stops and len(rig.lrf.readings) > 8
    rig.lrf._scan = scan
    assert events_of(rig)


@pytest.mark.parametrize("error", [DeviceError("gone"), KeyboardInterrupt(), ZeroDivisionError(), None])
@pytest.mark.parametrize("mode", ["stop-and-go", "continuous"])
def test_whatever_goes_wrong_the_head_and_the_scans_stop(mode, error):
    """Also where the recording is broken off."""
    rig = make_rig(rig_data(mode=mode, pitch_deg=[-10, 30, 1]))
    events = begun(rig, events=4)
    rig.head.fail = error
    with pytest.raises(type(error)) if error else contextlib.nullcontext():
        list(events) if error else events.close()
    assert rig.head.stops == 1 and not rig.lrf.streaming


def test_the_scans_stop_also_where_the_head_cannot(caplog, monkeypatch):
    rig = make_rig()
    events = begun(rig, events=1)
    monkeypatch.setattr(rig.head, "stop", raising(DeviceError("the line is lost")))
    events.close()
    assert not rig.lrf.streaming
    assert "the head could not be stopped (the line is lost): cut its power" in caplog.text


# --------------------------------------------------------------------------------------------------- continuous


def sweep_of(rig):
    """Events of a continuous sweep, and true pitch of its scans at their middle beams."""
    events = events_of(rig)
    readings = [r for e in events if isinstance(e, Scanned) for r in e.readings]
    pitch = np.concatenate([e.pitch for e in events if isinstance(e, Scanned)])
    rig.head.sweep = rig.head.sweep_done
    return events, readings, pitch, np.array([rig.head.true(np.mean(r.beam_times_s)) for r in readings])


@pytest.mark.parametrize("heads", [{}, {"silent_moving": True}, {"feedback": False}])
def test_scans_of_a_sweep_have_the_pitch_of_their_instant(heads):
    rig = make_rig(rig_data(mode="continuous", pitch_deg=[-10, 30, 1]), **heads)
    events, readings, pitch, true = sweep_of(rig)
    np.testing.assert_allclose(pitch, true, atol=math.radians(0.001))
    times = [r.time_s for r in readings]
    assert len(readings) > 40 and times == sorted(set(times))
    assert [type(e) for e in events[:3]] == [Moved, Photographed, Moved] and isinstance(events[-1], Tracked)
    assert np.ptp(pitch) > math.radians(38)


def test_a_sweep_without_scans_is_given_up(monkeypatch):
    monkeypatch.setattr(rig_module, "GAP_S", 0.05)
    monkeypatch.setattr(rig_module, "BATCH_S", 0.02)
    rig = make_rig(rig_data(mode="continuous"))
    rig.lrf.wait = lambda: setattr(rig.lrf, "silent", len(rig.lrf.readings) > 1)
    rig.head.speed = 1e-3
    with pytest.raises(NoReply, match=r"no scan for 0\.05 s of the sweep"):
        events_of(rig)
    assert rig.head.stops == 1


# --------------------------------------------------------------------------------------------- opening, the board


@pytest.mark.parametrize(("options", "error", "message"), [
    ({"LMS2xx": PortError("there is no port")}, PortError, "lrf: there is no port"),
    ({"Camera": PortError("there is no port")}, PortError, "camera 'left': there"),
    ({"LMS2xx": ValueError("an LMS2xx has 9600 Bd, got 300")}, RigFileError, r"rig\.json: lrf: an LMS2xx has 9600 Bd"),
    ({"size": (16, 12)}, RigFileError, r"camera 'left': it gives 16 x 12 .*rig\.cameras\.left states 32 x 24"),
])  # fmt: skip


def test_a_device_that_cannot_be_opened_closes_the_others(monkeypatch, options, error, message):
    rig, made = make_rig(), []
    rig.cameras["left"].size = options.get("size", SIZE)

    def make(driver, fake, *_, **__):
        if driver in options:
            raise options[driver]
        made.append(driver)
        fake.close = lambda: made.remove(driver)
        return fake

    for driver, fake in (("PanTilt", rig.head), ("LMS2xx", rig.lrf), ("Camera", rig.cameras["left"])):
        monkeypatch.setattr(rig_module, driver, partial(make, driver, fake))
    with pytest.raises(error, match=message):
        Rig.open(rig_of(rig_data()))
    assert made == []


ENDLESS = 1 << 26  # bytes
ANSWERS = {  # first line of an answer, bytes after it, what is said (None: it counts)
    "done": ("204 No Content", 0, None),
    "elsewhere": ("302 Found\r\nLocation: /", 0, "it answers 302 'Found'; is 'python"),
    "a page": ("200 OK", 100, "it answers 200 'OK'"),
    "without end": ("200 OK", ENDLESS, "it answers 200 'OK'"),
    "escape codes": ("500 \x1b[2J" + 1000 * "x", 0, r"it answers 500 '\\x1b\[2Jx{196}';"),
    "nothing": (None, 0, "is 'python -m lrfcal_lib emulate' still running"),
}


@pytest.mark.parametrize("case", ANSWERS)
def test_only_204_of_a_control_counts_and_its_answer_is_not_read(case):
    line, length, message = ANSWERS[case]
    sent = []

    def answer(listener):
        link, _ = listener.accept()
        with link, contextlib.suppress(OSError):
            assert link.recv(4096).startswith(b"POST /token/place/3 HTTP/1.1\r\n")
            if line is not None:
                link.sendall(f"HTTP/1.1 {line}\r\n\r\n".encode())
            while sum(sent) < length:
                sent.append(link.send(bytes(min(length, 1 << 20))))

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=answer, args=(listener,), daemon=True)
        thread.start()
        address = f"http://127.0.0.1:{listener.getsockname()[1]}/token"
        rig = make_rig(changed("devices.control", address))
        with contextlib.nullcontext() if message is None else pytest.raises(DeviceError, match=message):
            assert rig.move_board(3) is True
        thread.join()
    assert sum(sent) < ENDLESS


def test_what_the_device_says_about_itself_counts():
    rig = make_rig()
    rig.lrf.variant, rig.lrf.configuration = (180.0, 0.5), Configuration().changed(unit="cm")
    info = rig.lrf_info
    np.testing.assert_allclose(np.degrees(info.field_of_view), [0, 180])
    assert math.degrees(info.bearing_step) == pytest.approx(0.5) and info.range_resolution == 0.01
    for mode, unit, longest in ((0, "cm", 81.82), (0, "mm", 8.182), (4, "mm", 16.374), (6, "mm", 32.758)):
        rig.lrf.configuration = Configuration().changed(unit=unit, measuring_mode=mode)
        assert rig.lrf_info.max_range == pytest.approx(longest)
    rig = make_rig(changed("devices.lrf.interlaced", True))
    assert math.degrees(rig.lrf_info.bearing_step) == pytest.approx(0.25)
