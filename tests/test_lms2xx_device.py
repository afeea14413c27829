"""The LMS2xx on a port: finding it, setting it up, scans and their instants; against the emulated device."""

import numpy as np
import pytest
from faults import RecordingLms
from virtual import INDEXED, Bench, Source
from virtual import lms as lms_on

from lrfcal_lib.drivers.lms2xx import LMS2xx
from lrfcal_lib.drivers.lms2xx_link import Link
from lrfcal_lib.drivers.port import (
    DeviceError,
    LineLost,
    NoReply,
    Refused,
    WrongDevice,
)
from lrfcal_lib.session.lms2xx_codec import (
    Configuration,
)
from lrfcal_lib.session.lms2xx_frame import (
    encode_telegram,
)


def emulated(**options):
    """A device on a virtual host, at 38400 Bd with indices unless told otherwise."""
    return lms_on(
        **(
            {"baudrate": 38400, "configuration": INDEXED, "seed": 1, "boot_s": 0.5}
            | options
        )
    )


def opened(device, **options):
    """Its driver, on the same host."""
    return LMS2xx(device.path, host=device.host, **options)


def commands(device):
    """Codes of the requests that an emulated device understood."""
    return [raw[4] for _, raw in device.requests]


def record_of(device, reading):
    """The emulated device's own records of the telegrams of a reading."""
    by_telegram = {one.telegram: one for one in device.scans}
    return [by_telegram[raw] for raw in reading.telegrams]


LMS211 = {
    "model": "LMS211;302063;X01.27 ",
    "variant": (100, 50),
    "baudrates": (9600, 19200, 38400),
}
NO_RANGES = [
    {"configuration": Configuration().changed(measuring_mode=mode)} for mode in (0x0F, 0x3F)
]


@pytest.mark.parametrize(("habits", "options", "error", "message"), [
    ({}, {"baudrate": 57600}, ValueError, "an LMS2xx has 9600, 19200, 38400, 500000 Bd, got 57600"),
    ({"model": "LMX400;302063;X01.27 "}, {}, WrongDevice, "'LMX400' answers, not an LMS2xx"),
    ({"variant": (90, 50)}, {}, WrongDevice, "the LMS221-302063 scans .* deg, which no LMS2xx does"),
    (NO_RANGES[0], {}, WrongDevice, "in measuring mode 0F, .*state measuring_mode, 0 to 6"),
    (NO_RANGES[1], {}, WrongDevice, "in measuring mode 3F, .*state measuring_mode, 0 to 6"),
    (LMS211, {"baudrate": 500000}, Refused, r"declines 500000 Bd \(A0 02\)"),
])  # fmt: skip
def test_what_cannot_be_opened_is_said_and_nothing_is_changed(
    habits, options, error, message
):
    device = emulated(**habits)
    with pytest.raises(error, match=message):
        opened(device, **options)
    assert device.baudrate == 38400 and device.memory.flash_writes == 0


def test_a_measuring_mode_without_ranges_is_changed_at_opening():
    device = emulated(**NO_RANGES[0])
    with opened(device, measuring_mode=4, unit="mm") as lms:
        assert device.memory.flash_writes == 1 and lms.configuration.measuring_mode == 4
        assert len(lms.request().ranges) == 361


def test_what_the_device_declines_is_said(monkeypatch):
    device = emulated(**LMS211, password=b"OTHERONE")
    with opened(device) as lms:
        with pytest.raises(
            Refused, match=r"declines the password of the installation mode \(A0 01\)"
        ):
            lms.configure(unit="cm")
        with pytest.raises(
            Refused,
            match="LMS211-302063 has no variant 180/0.5; it keeps 100 deg in steps of 0",
        ):
            lms.set_variant(180, 0.5)
        assert lms.baudrate == 38400 and len(lms.request().ranges) == 201
    device.memory.password = b"SICK_LMS"
    monkeypatch.setattr(device.memory, "write_configuration", lambda data: False)
    with (
        opened(device) as lms,
        pytest.raises(Refused, match="does not take the configuration 00 00"),
    ):
        lms.configure(unit="cm")
    assert device.memory.mode == 0x25


# ----------------------------------------------------------------------------------------------- finding the rate

PAST = {"quiet": b"", "stream": encode_telegram(0x20, b"\x24"), "interlaced": encode_telegram(0x20, b"\x2a"),
        "installation": encode_telegram(0x20, b"\x00SICK_LMS"),
        "half a telegram": encode_telegram(0x77, bytes(34))[:20]}  # fmt: skip


@pytest.mark.parametrize("past", PAST)
@pytest.mark.parametrize("rate", [9600, 19200, 38400, 500000])
def test_the_device_is_found_at_any_rate_whatever_it_was_doing(past, rate):
    device = emulated(baudrate=rate)
    bench = Bench(device)
    bench.send(PAST[past], wait=0.003 if past == "half a telegram" else 1.0)
    assert device.streaming == (past in ("stream", "interlaced"))
    bench.port.close()
    with opened(device) as lms:
        assert (lms.type, lms.variant) == ("LMS221-302063", (180, 0.5))
        assert (lms.baudrate, device.streaming, device.memory.mode) == (rate, False, 0x25)


@pytest.mark.parametrize("address", [0, 3])
def test_a_device_with_an_address_is_found_by_broadcast_and_by_its_own(address):
    with opened(emulated(address=3), address=address) as lms:
        assert lms.status.address == 3 and len(lms.request().ranges) == 361


# ------------------------------------------------------------------------------------------------------ settings


def test_only_what_differs_is_set():
    device = emulated(configuration=Configuration())
    with opened(device) as lms:
        lms.configure(unit="cm", measuring_mode=0, realtime_indices=False)
        lms.set_variant(180, 0.5)
        assert not {0x77, 0x3B} & set(commands(device)) and device.memory.flash_writes == 0
        block = device.memory.configuration.block
        lms.configure(unit="mm", measuring_mode=4, realtime_indices=True)
        lms.configure(unit="mm", measuring_mode=4)
        assert device.memory.flash_writes == 1
        now = device.memory.configuration
        assert (now.unit, now.measuring_mode, now.realtime_indices) == (
            "mm",
            4,
            True,
        ) and now == lms.configuration
        assert (
            now.changed(unit="cm", measuring_mode=0, realtime_indices=False).block == block
        )
        assert device.memory.mode == 0x25
        for _ in range(2):
            lms.set_variant(100, 1)
            assert commands(device).count(0x3B) == 1
        assert lms.variant == (100, 1) and len(lms.request().ranges) == 101
        with pytest.raises(ValueError, match="variants are 100/1.*got 180/0.25"):
            lms.set_variant(180, 0.25)


def test_a_rate_that_does_not_come_through_is_given_up():
    device = emulated()
    through = device.port.put
    hear = device.hear
    device.port.put = lambda data: None if device.baudrate == 500000 else through(data)

    def deaf(data):
        if device.port.rate == 500000:
            device.memory.baudrate = 38400  # as after it was switched off and on
        else:
            hear(data)

    device.hear = deaf
    with pytest.raises(
        NoReply,
        match="nothing comes through at 500000 Bd: 500000 needs RS-422.*; 38400 Bd now",
    ):
        opened(device, baudrate=500000)
    with opened(device) as lms:
        assert lms.baudrate == 38400 and len(lms.request().ranges) == 361


# ------------------------------------------------------------------------------------------------ scans of a device


@pytest.mark.parametrize("rate", [38400, 500000])
@pytest.mark.parametrize("variant", [(180, 0.5), (180, 1.0), (100, 0.5), (100, 0.25)])
def test_scans_on_request_are_those_of_the_device(rate, variant):
    device, (angle, step) = emulated(baudrate=rate), variant
    with opened(device) as lms:
        lms.set_variant(*variant)
        for _ in range(3):
            reading = lms.request()
            (truth,) = record_of(device, reading)
            np.testing.assert_allclose(
                np.degrees(reading.bearings),
                np.arange(90 - angle / 2, 90.1 + angle / 2, step),
            )
            np.testing.assert_allclose(reading.beam_times_s, truth.beam_times_s, atol=1e-4)
            assert reading.time_s == reading.beam_times_s[0]
            assert reading.telegram_index == truth.telegram_index
            valid = np.isfinite(reading.ranges)
            assert valid.tolist() == (truth.words < 8183).tolist()
            np.testing.assert_array_equal(
                np.rint(reading.ranges[valid] * 1000), truth.words[valid]
            )


def test_calls_at_the_wrong_time_say_so():
    device = emulated()
    lms = opened(device)
    with pytest.raises(DeviceError, match="does not stream; call start"):
        lms.take(1)
    lms.stop()  # nothing to stop
    lms.start()
    calls = (lms.request, lms.start, lms.reconnect, lms.configure)
    for call in (*calls, lambda: lms.set_variant(180, 1)):
        with pytest.raises(DeviceError, match="streams; call stop"):
            call()
    lms.close()
    assert not device.streaming
    with pytest.raises(LineLost, match="is closed"):
        lms.request()
    lms.close()


# -------------------------------------------------------------------------------------------- when things go wrong


@pytest.mark.parametrize("fault", ["nak", "refused"])
def test_a_request_declined_thrice_is_refused_and_once_is_not(fault):
    device = emulated()
    with opened(device) as lms:
        before = device.host.now()
        device.faults.inject(fault, 2)
        assert (
            lms.request() and device.host.now() - before > 2 * 0.03
        )  # not asked again at once
        device.faults.inject(fault, 3)
        with pytest.raises(Refused, match="refuses command 30"):
            lms.request()
        assert device.faults.counts[fault] == 5


def test_scans_that_come_late_are_asked_for_until_the_time_is_over(monkeypatch):
    """As on a busy machine: nobody knows the instant of such a scan."""
    ask = Link.ask
    late = [1.0] * 4  # seconds

    def slow(link, *request, **options):
        arrival = ask(link, *request, **options)
        link.asked_s -= late.pop() if late else 0.0
        return arrival

    with opened(emulated()) as lms:
        monkeypatch.setattr(Link, "ask", slow)
        assert lms.request() and not late
        late += [1.0] * 1000
        with pytest.raises(NoReply, match="scans arrive, but too late"):
            lms.request()


def test_a_scan_later_than_an_instant_is_asked_for_until_the_time_is_over():
    device = emulated()
    with opened(device) as lms:
        soon = device.host.time() + 1
        assert lms.request(after=soon).time_s > soon
        with pytest.raises(NoReply, match="scans arrive, but .*not new"):
            lms.request(after=soon + 1000)


@pytest.mark.parametrize(("call", "limit_s"), [
    (lambda lms: lms.request(), 4.5), (lambda lms: lms.request(timeout=0.1), 0.2),
    (lambda lms: lms.set_variant(100, 1), 5.2), (lambda lms: lms.configure(unit="cm"), 2.6),
])  # fmt: skip
def test_a_silent_device_is_given_up_in_time(call, limit_s):
    device = emulated()
    with opened(device) as lms:
        device.faults.inject("deaf", seconds=1000)
        begin = device.host.now()
        with pytest.raises(
            NoReply, match="no reply to command .* at 38400 Bd; is the device on"
        ):
            call(lms)
        assert device.host.now() - begin < limit_s


def test_a_line_that_does_not_come_back():
    device = emulated()
    with opened(device) as lms:
        lms.start()
        device.close()
        with pytest.raises(NoReply, match="no new scan within 1.5 s: .*(lost|come back)"):
            lms.take(1, after=device.host.time(), timeout=1.5)
        with pytest.raises(LineLost, match="the device may still stream"):
            lms.stop()
        with pytest.raises(LineLost, match="did not come back: there is no port"):
            lms.reconnect(deadline=0.5)


@pytest.mark.parametrize("fault", ["unplug", "reboot", "rate"])
def test_a_stream_comes_back_by_itself_with_the_same_settings(fault):
    device = emulated(baudrate=9600)
    with opened(device, baudrate=500000) as lms:
        lms.set_variant(100, 0.5)
        lms.start()
        lms.take(3)
        device.faults.inject(fault)
        if fault != "unplug":  # by itself, not when something is asked
            device.hear(encode_telegram(0x31))
        after = device.host.time() + 0.1
        (reading,) = lms.take(1, after=after, timeout=10)
        assert len(reading.ranges) == 201 and record_of(device, reading)
        assert device.baudrate == 500000 and device.memory.flash_writes == 0
    assert not device.streaming


def test_a_stream_that_does_not_end_is_said(monkeypatch):
    device = emulated()
    with opened(device) as lms:
        lms.start()
        with monkeypatch.context() as patch:
            patch.setattr(
                device, "set_mode", lambda data, at: device.answer(at, 0xA0, b"\0")
            )
            with pytest.raises(
                Refused,
                match="confirms to stop streaming and goes on; switch it off and on",
            ):
                lms.stop()


# ---------------------------------------------------------------------------------------------------- in real time


def test_on_a_pseudo_terminal(tmp_path):
    """The same on a real port; the limits guard against hanging only."""
    with RecordingLms(Source(), path=tmp_path / "lrf", configuration=INDEXED) as device:
        with LMS2xx(device.path, baudrate=500000, find_s=60) as lms:
            assert len(lms.request(timeout=60).ranges) == 361
            lms.start()
            numbers = [
                record_of(device, reading)[0].number for reading in lms.take(10, timeout=60)
            ]
            lms.stop()
    assert np.all(np.diff(numbers) > 0) and device.error is None and not device.streaming
