"""What a rig records of one placement: with devices that are not there."""

import contextlib
import math
import socket
import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from fake_rig import BEAMS, SIZE, changed, make_rig, raising, rig_data

from lrfcal_lib.drivers import rig as rig_module
from lrfcal_lib.drivers.port import DeviceError, NoReply, PortError
from lrfcal_lib.drivers.rig import Moved, Photographed, Rig, Scanned, Tracked
from lrfcal_lib.drivers.rig_file import RigFileError, rig_of
from lrfcal_lib.session.lms2xx_codec import Configuration

# ------------------------------------------------------------------------------------------------- stop-and-go


def begun(rig, number=1, events=0):
    """The recording of a placement, which is that far."""
    running = rig.acquire(rig.stated.plan.to_do()[number - 1])
    for _ in range(events):
        next(running)
    return running


def events_of(rig, number=1, kind=object):
    return [event for event in begun(rig, number) if isinstance(event, kind)]


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
    with pytest.raises(
        NoReply, match="the head did not move: .*address 1 and 2400 Bd at /dev/fake_head"
    ):
        events_of(rig)
    assert rig.head.stops and len(rig.lrf.readings) > 8
    rig.lrf._scan = scan
    assert events_of(rig)


@pytest.mark.parametrize(
    "error", [DeviceError("gone"), KeyboardInterrupt(), ZeroDivisionError(), None]
)
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
    return (
        events,
        readings,
        pitch,
        np.array([rig.head.true(np.mean(r.beam_times_s)) for r in readings]),
    )


@pytest.mark.parametrize("heads", [{}, {"silent_moving": True}, {"feedback": False}])
def test_scans_of_a_sweep_have_the_pitch_of_their_instant(heads):
    rig = make_rig(rig_data(mode="continuous", pitch_deg=[-10, 30, 1]), **heads)
    events, readings, pitch, true = sweep_of(rig)
    np.testing.assert_allclose(pitch, true, atol=math.radians(0.001))
    times = [r.time_s for r in readings]
    assert len(readings) > 40 and times == sorted(set(times))
    assert [type(e) for e in events[:3]] == [Moved, Photographed, Moved] and isinstance(
        events[-1], Tracked
    )
    assert np.ptp(pitch) > math.radians(38)


def test_a_sweep_without_scans_is_given_up(monkeypatch):
    monkeypatch.setattr(rig_module, "GAP_S", 0.05)
    monkeypatch.setattr(rig_module, "BATCH_S", 0.02)
    rig = make_rig(rig_data(mode="continuous"))
    rig.lrf.wait = lambda: setattr(rig.lrf, "silent", len(rig.lrf.readings) > 1)
    rig.head.speed = 1e-3
    with pytest.raises(NoReply, match="the stream is silent"):
        events_of(rig)
    assert rig.head.stops == 1


# --------------------------------------------------------------------------------------------- opening, the board


@pytest.mark.parametrize(("options", "error", "message"), [
    ({"LMS2xx": PortError("there is no port")}, PortError, "lrf: there is no port"),
    ({"Camera": PortError("there is no port")}, PortError, "camera 'left': there"),
    ({"LMS2xx": ValueError("an LMS2xx has 9600 Bd, got 300")}, RigFileError, r"rig\.json: lrf: an LMS2xx has 9600 Bd"),
    ({"size": (16, 12)}, RigFileError, r"camera 'left': it gives 16 x 12 .*rig\.cameras\.left states 32 x 24"),
])  # fmt: skip
def test_a_device_that_cannot_be_opened_closes_the_others(
    monkeypatch, options, error, message
):
    rig = make_rig()
    made = []
    rig.cameras["left"].size = options.get("size", SIZE)

    def make(driver, fake, *_, **__):
        if driver in options:
            raise options[driver]
        made.append(driver)
        fake.close = lambda: made.remove(driver)
        return fake

    for driver, fake in (
        ("PanTilt", rig.head),
        ("LMS2xx", rig.lrf),
        ("Camera", rig.cameras["left"]),
    ):
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
        with (
            contextlib.nullcontext()
            if message is None
            else pytest.raises(DeviceError, match=message)
        ):
            assert rig.move_board(3) is True
        thread.join()
    assert sum(sent) < ENDLESS


def test_what_the_device_says_about_itself_counts():
    rig = make_rig()
    rig.lrf.variant, rig.lrf.configuration = (
        (180.0, 0.5),
        Configuration().changed(unit="cm"),
    )
    info = rig.lrf_info
    np.testing.assert_allclose(np.degrees(info.field_of_view), [0, 180])
    assert (
        math.degrees(info.bearing_step) == pytest.approx(0.5)
        and info.range_resolution == 0.01
    )
    for mode, unit, longest in (
        (0, "cm", 81.82),
        (0, "mm", 8.182),
        (4, "mm", 16.374),
        (6, "mm", 32.758),
    ):
        rig.lrf.configuration = Configuration().changed(unit=unit, measuring_mode=mode)
        assert rig.lrf_info.max_range == pytest.approx(longest)
    rig = make_rig(changed("devices.lrf.interlaced", True))
    assert math.degrees(rig.lrf_info.bearing_step) == pytest.approx(0.25)
