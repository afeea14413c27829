"""Emulated devices in virtual time: byte-exact replies, times, every fault, and clients as other people write them."""

import os
import time
from functools import partial

import numpy as np
import pytest
import serial
from faults import HEAD, LMS, FaultyLms
from virtual import INDEXED, Bench, Source, VirtualHost, head, lms, telegrams

from lrfcal_lib.drivers.port import REAL
from lrfcal_lib.emulators.head import REACT_S, Head
from lrfcal_lib.emulators.line import SerialDevice
from lrfcal_lib.emulators.lms2xx import BAUD_COMMAND, VARIANTS
from lrfcal_lib.session.lms2xx_codec import (
    Configuration,
    decode_scan,
    encode_telegram,
    parse_status,
    parse_telegram,
)
from lrfcal_lib.simulate.rig import Platform

DEADLINE = 60.0  # s, against hanging; nothing is timed by it
ZEROS = "00 " * 21
TURN = 1 / 75.08
TYPE, STATUS, ERRORS, CONFIG, SCAN, RESET = (
    "02 00 01 00 3A 1E 12", "02 00 01 00 31 15 12", "02 00 01 00 32 16 12", "02 00 01 00 74 50 12",
    "02 00 02 00 30 01 31 18", "02 00 01 00 10 34 12",
)  # fmt: skip
STREAM, STOP, PARTIAL = "02 00 02 00 20 24 34 08", "02 00 02 00 20 25 35 08", "02 00 02 00 20 2A 3A 08"
RATE = {rate: encode_telegram(0x20, bytes([mode])) for mode, rate in BAUD_COMMAND.items()}
INSTALL = "02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5"
WRITE_TL = f"02 00 23 00 77 00 00 70 00 00 00 01 00 00 02 02 {ZEROS} 02 00 11 88"
WRITE_CAP = f"02 00 23 00 77 00 00 70 00 00 04 01 00 00 02 02 {ZEROS} 02 00 94 8A"
VARIANT = {v: encode_telegram(0x3B, np.array(v, "<u2").tobytes()) for v in VARIANTS}
OK = "02 80 03 00 A0 00 10 16 0A"
MILLIMETRES = Configuration().changed(unit="mm")


def bench(source=None, rate=None, **options):
    """A laser range finder and a program at its line."""
    return Bench(lms(source, **options), rate)


def turns_of(device):
    return np.array([record.turn for record in device.scans])


# ------------------------------------------------------------------------------------------------ byte-exact replies

DONE, REFUSED = "A0 00 10 16 0A", "92 10 7F 33"
TYPE_REPLY = "BA 4C 4D 53 32 32 31 3B 33 30 32 30 36 33 3B 58 30 31 2E 32 37 20 10 02 EB"


@pytest.mark.parametrize(
    ("requests", "reply", "settings"),
    [
        ([TYPE], TYPE_REPLY, {}),
        (["33 44 55 00" + TYPE], TYPE_REPLY, {}),  # noise before a request
        ([TYPE], "BA 4C 4D 53 32 30 30 3B 53 31 38 30 36 33 3B 56 30 32 2E 31 39 20 10 85 6A",
         {"model": "LMS200;S18063;V02.19 "}),
        ([ERRORS], "B2 10 3F 13", {}),
        ([STOP], DONE, {}),
        (["02 00 02 00 20 10 00 08"], DONE, {}),
        ([INSTALL], DONE, {}),
        ([INSTALL], "A0 01 10 14 0B", {"password": b"OTHERONE"}),
        ([VARIANT[180, 50]], "BB 01 B4 00 32 00 10 03 9D", {}),
        ([VARIANT[100, 25]], "BB 01 64 00 19 00 10 BB 46", {}),
        ([encode_telegram(0x3B, bytes([180, 0, 25, 0]))], "BB 00 B4 00 32 00 10 23 8D", {}),
        ([INSTALL, WRITE_TL], f"F7 01 00 00 70 00 00 00 01 00 00 02 02 {ZEROS} 02 00 10 C5 7A", {}),
        ([INSTALL, WRITE_CAP, CONFIG], f"F4 00 00 70 00 00 04 01 00 00 02 02 {ZEROS} 02 00 10 36 FE", {}),
        *((requests, REFUSED, {}) for requests in (
            [WRITE_TL], [INSTALL, encode_telegram(0x77, bytes(31))], [INSTALL, encode_telegram(0x77, bytes(35))],
            [encode_telegram(0x55)], [encode_telegram(0x20, b"\x99")], [encode_telegram(0x20)],
            [encode_telegram(0x20, b"\x26\5")],
            [encode_telegram(0x30, b"\x55")], [encode_telegram(0x3B, b"\xb4\0")])),
    ],
)  # fmt: skip


def test_replies_of_the_fact_sheet(requests, reply, settings):
    one, body = bench(**settings), bytes.fromhex(reply)
    for request in requests:
        answer = one.send(request)
    assert answer == b"\x06" + bytes([0x02, 0x80]) + (len(body) - 2).to_bytes(2, "little") + body


@pytest.mark.parametrize(("request_", "answer"), [
    ("02 00 01 00 3A 1E 13", "15"), ("02 05 01 00 3A 1E 13", ""), ("FF 00 06", ""),
    (encode_telegram(0x3A, address=2), ""), (STOP, "06 02 81 03 00 A0 00 10 36 1A"),
    (encode_telegram(0x20, b"\x25", address=1), "06 02 81 03 00 A0 00 10 36 1A"),
])  # fmt: skip


def test_a_damaged_request_is_answered_nak_and_one_to_another_address_not(request_, answer):
    assert bench(address=1).send(request_) == bytes.fromhex(answer)


def test_reset_tells_its_power_on_string():
    one = bench(boot_s=1.0, rate=9600)
    one.send(VARIANT[100, 25])
    assert one.send(RESET, wait=0.5) == bytes.fromhex("06 02 80 02 00 91 10 79 30")
    assert one.send(TYPE, wait=0.2) == b""  # it hears nothing while it starts
    string = one.run(1.0)
    assert string[4:5] == b"\x90" and string[-2:] == bytes.fromhex("43 D4")
    assert one.device.baudrate == 9600 and one.device.memory.variant == (180, 50)


def test_status_has_every_field_where_the_sheet_says():
    one = bench(configuration=Configuration().changed(measuring_mode=4, unit="mm"), baudrate=38400)
    one.send(INSTALL)
    raw = one.send(STATUS)[1:]
    status, payload = parse_status(raw), b"\xb1" + parse_telegram(raw).data
    assert len(raw) == 0x9A + 6
    assert (status.firmware, status.serial, status.measuring_mode, status.fault) == ("X01.27", "05270497", 4, 0)
    assert (status.scan_angle_deg, status.resolution_deg, status.unit) == (180, 0.5, "mm")
    at = {19: 95, 41: 92, 43: 100, 57: 100, 65: 95, 67: 148, 71: 17, 77: 16, 85: 120, 93: 921, 99: 921, 105: 20,
          116: 0x8019}  # fmt: skip
    assert {k: int.from_bytes(payload[k : k + 2], "little") for k in at} == at
    assert [payload[i] for i in (8, 18, 111, 118, 119, 120, 121, 123)] == [0, 0, 2, 2, 0, 0, 1, 1]
    assert payload[124:131] == b"V02.02 "


# ------------------------------------------------------------------------------------------------ scans


@pytest.mark.parametrize("variant", VARIANT)
def test_a_scan_on_request_is_the_one_of_the_record(variant):
    one = bench(baudrate=500000, configuration=MILLIMETRES)
    one.send(VARIANT[variant])
    raw, record = one.send(SCAN)[1:], one.device.scans[-1]
    assert raw == record.telegram and np.array_equal(decode_scan(raw).words[0], record.words)
    assert len(record.words) == variant[0] * 100 // variant[1] + 1 and len(raw) == 10 + 2 * len(record.words)
    assert np.all(np.diff(record.beam_times_s[:: 100 // variant[1]]) > 0)
    assert variant != (180, 50) or raw[:7] == bytes.fromhex("02 80 D6 02 B0 69 41")


@pytest.mark.parametrize("baud", [9600, 19200, 38400, 500000])
@pytest.mark.parametrize("variant", [(100, 25), (180, 50), (180, 100), "interlaced"])
def test_streams_send_as_often_as_the_listing_says(baud, variant):
    """Table 10-17, in whole scans; every one arrives, with nothing between them."""
    scans = {9600: (16, 29, 30, 30), 19200: (8, 15, 15, 15), 38400: (4, 8, 8, 8), 500000: (1, 1, 1, 1)}[baud]
    interlaced = variant == "interlaced"
    one = bench(baudrate=baud, variant=(100, 25) if interlaced else variant, configuration=INDEXED)
    one.send(PARTIAL if interlaced else STREAM, wait=3.5)
    step = scans[[(100, 25), (180, 50), (180, 100), "interlaced"].index(variant)]
    step *= 1 if interlaced else 100 // variant[1]
    records, found = list(one.device.scans), telegrams(one.heard)[1:]
    assert len(records) >= 4 and np.all(np.diff([r.turn for r in records]) == step)
    assert np.allclose(np.diff([r.time_s for r in records])[3 if interlaced else 0 :: 4 if interlaced else 1],
                       step * TURN, atol=0.011 if interlaced else 1e-6)  # fmt: skip
    assert one.heard[10:].startswith(b"".join(found))
    assert found == [r.telegram for r in records][: len(found)] and len(records) - len(found) <= 1
    found = [decode_scan(raw) for raw in found]
    assert np.all(np.diff([int(s.telegram_index[0]) for s in found]) % 256 == 1)
    if interlaced:
        assert [int(s.partial[0]) for s in found] == [i % 4 for i in range(len(found))]
        assert [s.words.shape[1] for s in found[:5]] == [181, 180, 180, 180, 181]


# ------------------------------------------------------------------------------------------------ times


@pytest.mark.parametrize(
    ("request_", "least", "most"),  # milliseconds to the last byte, as measured at 38400 Bd on a real device
    [(STOP, 66, 91), (TYPE, 75, 80), (STATUS, 107, 114), (CONFIG, 75, 76), (SCAN, 190, 300), (WRITE_TL, 128, 129)],
)


def test_times_of_replies(request_, least, most):
    one = bench(baudrate=38400, mode=0)
    one.send(request_)
    assert one.out[0][0] <= 0.060 and least - 4 <= 1000 * one.out[-1][0] <= most + 4


@pytest.mark.parametrize("request_", [STATUS, STOP, SCAN, CONFIG, STATUS[:-2] + "00"])
@pytest.mark.parametrize("command", ["rate", "reset"])
def test_a_request_interrupts_a_reply_and_never_undoes_the_command(command, request_):
    """At any time until the reply is out; the one with a wrong checksum as well."""
    for wait in np.arange(0, 0.09, 0.01 if command == "rate" else 0.002):
        one = bench(boot_s=0.5)
        one.send(RATE[38400] if command == "rate" else RESET, wait)
        one.send(request_, wait=2.0)
        if command == "rate":
            assert one.device.baudrate == 38400, wait
            assert telegrams(one.send(TYPE))[0][4] == 0xBA
        else:
            assert telegrams(one.heard)[-1][4] == 0x90, wait


def test_a_stream_that_this_machine_is_too_slow_for_leaves_scans_out(caplog):
    """Casting a scan takes the processor a time that passes meanwhile."""
    slow, host = [], VirtualHost()

    class Slow(Source):
        def scan(self, *args):
            host._now += slow.pop() if slow else 0
            return super().scan(*args)

    one = Bench(lms(Slow(), host, baudrate=38400))
    one.send(STREAM, wait=2.0)

    def gaps(late):
        """Turns between the scans of the time after the machine did nothing for a while."""
        before = len(one.device.scans)
        slow[:] = [late]
        one.run(3.0)
        return np.diff(turns_of(one.device)[before - 1 :])

    usual = set(gaps(0.0))
    assert len(usual) == 1 and set(gaps(0.9)) == usual and one.device.left_out == 0  # it may catch up
    assert max(gaps(1.5)) * TURN > 1.2 and one.device.left_out == 1
    assert "casts scans too slowly: 1." in caplog.text
    assert max(gaps(0.8)) > max(usual) and one.device.left_out == 2 and len(caplog.records) == 1


# ------------------------------------------------------------------------------------------------ the line


def test_a_host_that_does_not_read_loses_bytes_and_nothing_else():
    one = bench(baudrate=500000)
    one.port.write(bytes.fromhex(STREAM))
    one.machine.sleep(1.0)
    assert one.device.counts["lost"] > 0 and one.port.in_waiting == 4095
    assert one.reply(STOP, 0xA0)
    one.port.write(bytes.fromhex(STREAM))
    one.port.close()
    one.machine.sleep(1.0)
    assert one.device.counts["unheard"] > 5000
    newest, raw = one.device.scans[-1].number, Bench(one.device).read(1.2)
    numbers = {record.telegram: record.number for record in one.device.scans}
    assert numbers[raw] >= newest  # nothing was kept while nobody listened


# --------------------------------------------------------------------------------------------- on a pseudo-terminal


def test_a_laser_range_finder_on_a_pseudo_terminal(tmp_path):
    """In real time; the limits only guard against hanging."""
    with FaultyLms(Source(), path=tmp_path / "lrf", baudrate=38400, configuration=INDEXED) as device:
        port = serial.Serial(device.path, 38400, timeout=DEADLINE)
        port.write(bytes.fromhex(STREAM))
        assert port.read(10) == b"\x06" + bytes.fromhex(OK)
        data = port.read(3 * 734)
        assert telegrams(data) == [r.telegram for r in list(device.scans)[:3]]
        device.faults.inject("unplug", seconds=0.01)
        with pytest.raises((serial.SerialException, OSError)):
            while True:
                port.write(b"\0")
                port.read(100)
        port.close()
        while not os.path.exists(device.path):
            time.sleep(0.01)
        with serial.Serial(device.path, 9600, timeout=DEADLINE) as port:  # streamed at another rate
            assert not telegrams(port.read(200)) and device.counts["garbled"] > 200
    assert device.error is None and not os.path.lexists(device.path)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_device_that_fails_says_so(tmp_path):
    class Broken(SerialDevice):
        baudrate = 9600

        def receive(self, data, at):
            raise RuntimeError("broken")

    with Broken(tmp_path / "x", REAL) as device, serial.Serial(device.path, 9600) as port:
        port.write(b"x")
        device.port.join(DEADLINE)
        assert str(device.error) == "broken" and not os.path.lexists(device.path)


# ---------------------------------------------------------------------------------------------- other people's clients


CONNECT = [RATE[38400], 38400, STOP, TYPE, STATUS, CONFIG, INSTALL, encode_telegram(0x77, INDEXED.block), STOP,
           VARIANT[100, 25], PARTIAL, "12 scans", STOP, RATE[9600], 9600, TYPE]  # fmt: skip
CLIENTS = {  # seconds that it waits for a reply, how often it asks; what it does: requests, its rate, scans to be read
    "sicktoolbox": (1.0, 3, CONNECT),
    "sicktoolbox, after one that crashed in a stream": (1.0, 3, [STREAM, *CONNECT]),
    "a client in pure Python": (1.5, 1, [RATE[38400], 38400, INSTALL, WRITE_CAP, STREAM, "3 scans", STOP]),
    "CARMEN": (0.25, 8, [STOP, RATE[500000], 500000, STOP, CONFIG, INSTALL, encode_telegram(0x77, INDEXED.block[:32]),
                         STOP, VARIANT[100, 25], PARTIAL, "8 scans"]),
}  # fmt: skip


@pytest.mark.parametrize("client", CLIENTS)
def test_clients_of_other_people(client):
    """Every request is answered in time, with what it asked for, and scans come whole and in order."""
    one, (wait, tries, steps) = bench(rate=9600, configuration=MILLIMETRES), CLIENTS[client]
    for step in steps:
        if isinstance(step, int):
            one.rate = step
            one.machine.sleep(0.25)
        elif str(step).endswith("scans"):
            found = [one.read(3.0) for _ in range(int(step.split()[0]))]
            assert found == [record.telegram for record in one.device.scans][: len(found)]
            assert [int(decode_scan(raw).partial[0]) for raw in found] == (
                [-1] * 3 if len(found) == 3 else [i % 4 for i in range(len(found))])  # fmt: skip
        else:
            one.device.scans.clear()
            code = parse_telegram(bytes.fromhex(step) if isinstance(step, str) else step).code | 0x80
            answer = one.reply(step, code, wait=wait, tries=tries)
            assert code not in (0xA0, 0xF7, 0xBB) or answer[5] == (code != 0xA0)


# ------------------------------------------------------------------------------------------------ the head

QUERY, UP = "FF 01 00 53 00 00 54", "FF 01 00 08 00 3F 48"
STOPPED, TO_30 = "FF 01 00 00 00 00 01", "FF 01 00 4D 80 E8 B6"
LEVEL = bytes.fromhex("FF 01 00 5B 00 00 5C")


def at_head(**options):
    return Bench(head(**options))


def moved(one, wait):
    """Degrees the head turns in a while."""
    before = one.device.pitch()
    one.run(wait)
    return float(np.degrees(one.device.pitch() - before))


def test_absolute_tilt_and_queries():
    one = at_head()
    assert one.send(QUERY) == LEVEL
    assert one.send(TO_30) == b""
    assert one.send(QUERY) == b""  # no answers while it makes an absolute move
    one.run(4.0)
    assert one.send(QUERY) == bytes.fromhex("FF 01 00 5B 80 E8 C4")
    assert np.degrees(one.device.pitch()) == pytest.approx(30, abs=0.02)


@pytest.mark.parametrize(("command", "stop", "speed"), [
    (UP, "FF 01 00 00 20 00 21", 12.6), ("FF 01 00 10 00 00 11", "FF 01 88 00 00 00 89", -0.5),
])  # fmt: skip


def test_up_is_up_speed_0_is_slow_and_stop_ignores_speeds(command, stop, speed):
    one = at_head(speeds=(0.5, 12.6))
    one.send(command, wait=0.5)
    assert moved(one, 1.0) == pytest.approx(speed, abs=0.01)
    one.send(stop)
    assert moved(one, 1.0) == 0


def test_partial_feedback_and_none():
    one = at_head(feedback="partial")
    one.send(TO_30)
    assert moved(one, 1.0) == 0
    one.send(UP, wait=0.3)
    assert one.send(QUERY) == b""
    one.send(STOPPED)
    assert len(one.send(QUERY)) == 7
    silent = at_head(feedback="none", confirms=True)
    assert silent.send(QUERY) + silent.send(STOPPED) == b""


def test_play_of_the_gear_and_stretch():
    head = Head(Platform(backlash=0.01, stretch=0.02, settle=0.0))
    head.move(1.0, 0.5, 0.1)
    t = np.linspace(1.0, 4.0, 200)
    motor = np.clip(0.1 * (t - 1.0 - REACT_S), 0.0, 0.5)
    assert np.allclose(head.pitch(t), np.maximum(1.02 * motor - 0.005, 0.0), atol=1e-12)
    head.move(4.0, 0.0, 0.1)
    turning = head.pitch(np.linspace(4.0 + REACT_S, 5.0, 300))
    assert np.count_nonzero(np.abs(np.diff(turning)) < 1e-12) > 20  # the play, then down
    assert np.all(np.diff(turning) <= 0) and np.ptp(turning) > 0.05


def test_a_head_wobbles_and_settles():
    head = Head(Platform(settle=0.5))
    head.move(0.0, 1.0, 0.2)
    head.stop(2.0)
    assert not head.settled(2.2) and head.settled(2.6)
    rest = float(head.pitch(3.0))
    swing = head.pitch(np.linspace(2.05, 2.5, 100)) - rest
    assert 1e-4 < np.abs(swing).max() < 5e-3 and head.pitch(2.6) == rest
    head.stop(3.0)
    assert np.all(head.pitch(np.linspace(3.0, 4.0, 50)) == rest)  # a stop at rest shakes nothing


# ------------------------------------------------------------------------------------------------ faults

AT_LMS, AT_HEAD = (TYPE, SCAN, SCAN, STREAM, STOP, TYPE), (QUERY, UP, QUERY, STOPPED, QUERY)


@pytest.mark.parametrize(("make", "requests", "name"), [
    *((partial(bench, baudrate=38400), AT_LMS, name) for name in sorted({*LMS} - {"unplug"})),
    *((at_head, AT_HEAD, name) for name in sorted({*HEAD} - {"unplug", "stale"})),
])  # fmt: skip


def test_every_fault_happens_once_and_is_noticed(make, requests, name):
    """What each is made up for: test_lms2xx_faults, test_pan_tilt."""

    def told(fault):
        one = make()
        if fault is not None:
            one.device.faults.inject(fault)
        return [(one.send(request), tuple(one.out))[1] for request in requests], one.device.faults

    plain, (found, faults) = told(None)[0], told(name)
    assert found != plain and faults.counts[name] == 1 and not faults.armed


def test_faults_follow_from_the_seed_and_are_counted():
    def run(seed):
        one = bench(baudrate=38400, seed=seed)
        for name in ("drop", "flip", "noise"):
            one.device.faults.inject(name, count=3)
        return [one.send(TYPE, wait=0.2) for _ in range(10)], dict(one.device.faults.counts)

    assert run(3) == run(3) != run(4)
    assert run(3)[1] == {"drop": 3, "flip": 3, "noise": 3}


def test_a_fault_for_a_while():
    one = at_head()
    one.device.faults.inject("mute", seconds=2.5)
    assert one.send(QUERY) + one.send(QUERY) == b"" and one.device.faults.armed == {"mute"}
    assert one.send(QUERY) == b"" and one.send(QUERY) and one.device.faults.counts["mute"] == 3
    one.device.faults.inject("mute", seconds=60)
    one.device.faults.clear("mute")
    assert one.send(QUERY)
