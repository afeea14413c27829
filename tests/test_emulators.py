"""Emulated devices: byte-exact replies, times, every fault, and clients as other people write them."""

import math
import os
import time

import numpy as np
import pytest
import serial

from lrfcal_lib.drivers.emulators import FAULTS, EmulatedHead, EmulatedLms, Faults, Head
from lrfcal_lib.drivers.emulators.line import RATES, Clock, Line, resample
from lrfcal_lib.drivers.emulators.lms2xx import AHEAD_S
from lrfcal_lib.drivers.emulators.lms2xx_memory import Memory
from lrfcal_lib.drivers.emulators.motion import REACT_S
from lrfcal_lib.drivers.emulators.pelco_d import tilt_elevation, tilt_raw
from lrfcal_lib.drivers.lms2xx import decode_scan, encode_telegram, parse_telegram, split_stream
from lrfcal_lib.drivers.lms2xx_replies import Configuration, parse_configuration, parse_status
from lrfcal_lib.simulate.rig import Platform

DEADLINE = 60.0  # s, against hanging; nothing is timed by it
ZEROS = "00 " * 21
TURN = 1 / 75.08
T0 = 100.0
TYPE, STATUS, ERRORS, CONFIG, SCAN = (
    "02 00 01 00 3A 1E 12", "02 00 01 00 31 15 12", "02 00 01 00 32 16 12", "02 00 01 00 74 50 12",
    "02 00 02 00 30 01 31 18",
)  # fmt: skip
STREAM, STOP, PARTIAL = "02 00 02 00 20 24 34 08", "02 00 02 00 20 25 35 08", "02 00 02 00 20 2A 3A 08"
RATE = {38400: "02 00 02 00 20 40 50 08", 19200: "02 00 02 00 20 41 51 08", 9600: "02 00 02 00 20 42 52 08",
        500000: "02 00 02 00 20 48 58 08"}  # fmt: skip
INSTALL = "02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5"
WRITE_TL = f"02 00 23 00 77 00 00 70 00 00 00 01 00 00 02 02 {ZEROS} 02 00 11 88"
WRITE_CAP = f"02 00 23 00 77 00 00 70 00 00 04 01 00 00 02 02 {ZEROS} 02 00 94 8A"
VARIANT = {(180, 50): "02 00 05 00 3B B4 00 32 00 3B 1F", (180, 100): "02 00 05 00 3B B4 00 64 00 97 49",
           (100, 100): "02 00 05 00 3B 64 00 64 00 1D 0F", (100, 50): "02 00 05 00 3B 64 00 32 00 B1 59",
           (100, 25): "02 00 05 00 3B 64 00 19 00 E7 72"}  # fmt: skip
OK = "02 80 03 00 A0 00 10 16 0A"


class Bench:
    """A device without its port: bytes in at an instant, bytes out with theirs; nothing depends on the machine."""

    def __init__(self, device):
        self.device, self.now, self.out = device, T0, []
        device.line._put = lambda data: self.out.extend((self.now, byte) for byte in data)

    def send(self, raw, wait=1.0):
        """What comes back within a while; the request ends now."""
        raw = bytes.fromhex(raw) if isinstance(raw, str) else raw
        self.out.clear()
        self.device.receive(raw, self.now)
        return self.run(wait)

    def run(self, wait, step=0.001):
        for _ in range(round(wait / step)):
            self.now += step
            self.device.line._act(self.now)
            self.device.line._send(self.now)
        return self.heard

    @property
    def heard(self):
        return bytes(byte for _, byte in self.out)


@pytest.fixture
def lms(tmp_path):
    """Maker of a bench with a laser range finder."""
    return lambda source=None, **options: Bench(EmulatedLms(source, path=tmp_path / "lrf", **options))


@pytest.fixture
def head(tmp_path):
    return lambda **options: Bench(EmulatedHead(path=tmp_path / "head", **options))


def frame(*body, address=1):
    body = bytes([address, *body])
    return bytes([0xFF, *body, sum(body) % 256])


def telegrams(data):
    found = split_stream(data)
    return [bytes(data[o : o + n]) for o, n in zip(found.offset.tolist(), found.length.tolist(), strict=True)]


# ------------------------------------------------------------------------------------------------ byte-exact replies


@pytest.mark.parametrize(
    ("requests", "reply", "settings"),
    [
        ([TYPE], "BA 4C 4D 53 32 32 31 3B 33 30 32 30 36 33 3B 58 30 31 2E 32 37 20 10 02 EB", {}),
        ([TYPE], "BA 4C 4D 53 32 30 30 3B 53 31 38 30 36 33 3B 56 30 32 2E 31 39 20 10 85 6A",
         {"model": "LMS200;S18063;V02.19 "}),
        ([ERRORS], "B2 10 3F 13", {}),
        ([STOP], "A0 00 10 16 0A", {}),
        (["02 00 02 00 20 10 00 08"], "A0 00 10 16 0A", {}),
        (["02 00 03 00 20 26 05 79 3E"], "A0 00 10 16 0A", {}),
        (["02 00 06 00 20 27 01 00 0A 00 6C B7"], "A0 00 10 16 0A", {}),
        ([INSTALL], "A0 00 10 16 0A", {}),
        (["02 00 0A 00 20 30 53 49 43 4B 5F 4C 4D 53 EE F5"], "A0 00 10 16 0A", {}),
        ([INSTALL], "A0 01 10 14 0B", {"password": b"OTHERONE"}),
        (["02 00 0A 00 20 30 53 49 43 4B 5F 4C 4D 53 EE F5"], "A0 01 10 14 0B", {"password": b"OTHERONE"}),
        ([VARIANT[180, 50]], "BB 01 B4 00 32 00 10 03 9D", {}),
        ([VARIANT[100, 25]], "BB 01 64 00 19 00 10 BB 46", {}),
        ([encode_telegram(0x3B, bytes([180, 0, 25, 0]))], "BB 00 B4 00 32 00 10 23 8D", {}),
        ([INSTALL, WRITE_TL], f"F7 01 00 00 70 00 00 00 01 00 00 02 02 {ZEROS} 02 00 10 C5 7A", {}),
        ([INSTALL, WRITE_CAP, CONFIG], f"F4 00 00 70 00 00 04 01 00 00 02 02 {ZEROS} 02 00 10 36 FE", {}),
        ([INSTALL, "02 00 02 00 66 00 9C 4E"], "E6 01 00 10 CD FC", {}),
        (["02 00 02 00 66 01 9D 4E"], "92 10 7F 33", {}),
        ([WRITE_TL], "92 10 7F 33", {}),
        ([encode_telegram(0x55)], "92 10 7F 33", {}),
        ([encode_telegram(0x20, b"\x99")], "92 10 7F 33", {}),
    ],
)  # fmt: skip
def test_replies_of_the_fact_sheet(lms, requests, reply, settings):
    bench = lms(**settings)
    for request in requests[:-1]:
        bench.send(request)
    answer = bench.send(requests[-1])
    body = bytes.fromhex(reply)
    whole = bytes([0x02, 0x80]) + (len(body) - 2).to_bytes(2, "little") + body
    assert answer[: 1 + len(whole)] == b"\x06" + whole
    assert len(answer) == 1 + len(whole) or bench.device.streaming


def test_an_address_of_its_own(lms):
    bench = lms(address=1)
    assert bench.send(STOP)[1:] == bytes.fromhex("02 81 03 00 A0 00 10 36 1A")
    assert bench.send(encode_telegram(0x20, b"\x25", address=1))[1:] == bytes.fromhex("02 81 03 00 A0 00 10 36 1A")
    assert bench.send(encode_telegram(0x20, b"\x25", address=2)) == b""


def test_reset_tells_its_power_on_string(lms):
    bench = lms(boot_s=1.0, baudrate=38400)
    bench.send(VARIANT[100, 25])
    answer = bench.send("02 00 01 00 10 34 12", wait=0.5)
    assert answer == bytes.fromhex("06 02 80 02 00 91 10 79 30")
    assert bench.send(TYPE, wait=0.2) == b""  # it hears nothing while it starts
    string = bench.run(1.0)
    assert string[4:5] == b"\x90" and string[-2:] == bytes.fromhex("43 D4")
    assert bench.device.baudrate == 9600 and bench.device.memory.variant == (180, 50)


def test_permanent_rate_survives_a_restart(lms):
    bench = lms(boot_s=0.1, baudrate=38400)
    bench.send(INSTALL)
    bench.send("02 00 02 00 66 01 9D 4E")
    bench.send("02 00 01 00 10 34 12")
    assert bench.device.baudrate == 38400 and bench.device.memory.flash_writes == 1


def test_status_has_every_field_where_the_sheet_says(lms):
    bench = lms(configuration=Configuration().changed(measuring_mode=4, unit="mm"), baudrate=38400)
    bench.send(INSTALL)
    raw = bench.send(STATUS)[1:]
    status, payload = parse_status(raw), b"\xb1" + parse_telegram(raw).data
    assert len(raw) == 0x9A + 6
    assert (status.firmware, status.serial, status.operating_mode, status.fault) == ("X01.27", "05270497", 0, 0)
    assert (status.scan_angle_deg, status.resolution_deg, status.baud, status.unit) == (180, 0.5, 38400, "mm")
    assert status.measuring_mode == 4 and status.laser_on and status.mirror_hz == pytest.approx(75.08, abs=0.01)
    at = {67: 148, 93: 921, 95: 921, 97: 921, 99: 921, 116: 0x8019}
    assert {k: int.from_bytes(payload[k : k + 2], "little") for k in at} == at
    assert (payload[18], payload[111], payload[118], payload[119], payload[120], payload[121]) == (0, 2, 2, 0, 0, 1)
    assert payload[124:131] == b"V02.02 "


def test_second_configuration_has_84_bytes(lms):
    assert lms().send("02 00 01 00 7B 5F 12")[-2:] == bytes.fromhex("AE F0")


@pytest.mark.parametrize("length", [32, 33, 34])
def test_configurations_of_older_hosts_are_taken(lms, length):
    bench = lms()
    bench.send(INSTALL)
    block = Configuration().changed(unit="mm", realtime_indices=True).block
    answer = bench.send(encode_telegram(0x77, block[:length]))
    assert parse_configuration(answer[1:]).block == block


@pytest.mark.parametrize("length", [31, 35])
def test_configurations_of_wrong_length_are_refused(lms, length):
    bench = lms()
    bench.send(INSTALL)
    assert parse_telegram(bench.send(encode_telegram(0x77, bytes(length)))[1:]).code == 0x92


def test_impossible_configuration_is_refused_and_not_written(lms):
    bench = lms()
    bench.send(INSTALL)
    answer = parse_telegram(bench.send(encode_telegram(0x77, bytes([0, 0, 0, 0, 0, 0, 7]) + bytes(27)))[1:])
    assert (answer.code, answer.data[0]) == (0xF7, 0) and bench.device.memory.flash_writes == 0


def test_a_damaged_request_is_answered_nak_and_a_foreign_one_not(lms):
    bench = lms()
    assert bench.send("02 00 01 00 3A 1E 13") == b"\x15"
    assert bench.send("02 05 01 00 3A 1E 13") == b""
    assert bench.send("FF 00 06") == b""
    assert len(bench.send("33 44 55 00" + TYPE)) > 20  # noise before a request


def test_a_pause_within_a_request_drops_it(lms):
    bench, raw = lms(), bytes.fromhex(TYPE)
    assert bench.send(raw[:3], wait=0.02) == b""
    assert bench.send(raw[3:]) == b""
    bench.send(raw[:3], wait=0.004)
    assert len(bench.send(raw[3:])) == 30


@pytest.mark.parametrize("settings", [{"model": "short"}, {"variant": (180, 25)}, {"baudrate": 1200}])
def test_settings_that_no_device_has(tmp_path, settings):
    with pytest.raises(ValueError, match="characters|no variant|no LMS2xx"):
        EmulatedLms(path=tmp_path / "lrf", **settings)


def test_the_211_sees_100_degrees_only():
    memory = Memory(model="LMS211;302063;X01.27 ", variant=(100, 50))
    assert memory.takes_variant((100, 25)) and not memory.takes_variant((180, 50))


# ------------------------------------------------------------------------------------------------ scans


@pytest.mark.parametrize("variant", VARIANT)
def test_a_scan_on_request_is_the_one_of_the_record(lms, variant):
    bench = lms(baudrate=500000)
    bench.send(VARIANT[variant])
    raw = bench.send(SCAN)[1:]
    record = bench.device.scans[-1]
    assert raw == record.telegram
    scan = decode_scan(raw)
    assert scan.words.shape[1] == variant[0] * 100 // variant[1] + 1
    assert np.array_equal(scan.words[0], record.words)
    assert np.all(np.diff(record.beam_times_s[:: 100 // variant[1]]) > 0)
    assert len(raw) == {101: 212, 181: 372, 201: 412, 361: 732, 401: 812}[scan.words.shape[1]]


def test_first_bytes_of_a_whole_scan_in_millimetres(lms):
    raw = lms(configuration=Configuration().changed(unit="mm"), baudrate=500000).send(SCAN)[1:]
    assert raw[:7] == bytes.fromhex("02 80 D6 02 B0 69 41")


def test_parts_steps_and_means(lms):
    bench = lms(baudrate=500000)
    whole = decode_scan(bench.send(SCAN)[1:]).words[0]
    every = parse_telegram(bench.send(encode_telegram(0x30, b"\x06"))[1:])
    assert int.from_bytes(every.data[:2], "little") == 181
    part = parse_telegram(bench.send("02 00 05 00 37 01 00 69 01 EB 75")[1:])
    assert part.code == 0xB7 and part.data[:6] == bytes.fromhex("01 00 69 01 69 01") and len(part.data) == 6 + 722
    mean = parse_telegram(bench.send("02 00 02 00 36 02 3E 1E")[1:])
    assert mean.code == 0xB6 and mean.data[:3] == bytes([2, 0x69, 0x01])
    assert whole.shape == (361,)
    assert bench.send(encode_telegram(0x37, bytes([5, 0, 2, 0])))[5:6] == b"\x92"
    assert bench.send(encode_telegram(0x36, b"\x01"))[5:6] == b"\x92"
    assert bench.send(encode_telegram(0x30, b"\x55"))[5:6] == b"\x92"


def test_mean_of_alike_scans_is_their_mean(lms):
    class Steps:
        def scan(self, turn, quarters, times):
            return np.full(len(quarters), 1.0 + turn / 2 % 2), np.zeros(len(quarters), int), np.zeros(2)

    data = parse_telegram(lms(Steps(), baudrate=500000).send("02 00 02 00 36 02 3E 1E")[1:]).data
    assert int.from_bytes(data[3:5], "little") == 150


@pytest.mark.parametrize(
    ("baud", "variant", "scans"),
    [(9600, (100, 25), 16), (9600, (180, 50), 29), (9600, (180, 100), 30), (19200, (100, 25), 8),
     (19200, (180, 50), 15), (19200, (180, 100), 15),
     (38400, (100, 25), 4), (38400, (180, 50), 8), (38400, (180, 100), 8),
     (500000, (100, 25), 1), (500000, (180, 50), 1), (500000, (180, 100), 1)],
)  # fmt: skip
def test_streams_send_as_often_as_the_listing_says(lms, baud, variant, scans):
    bench = lms(baudrate=baud, variant=variant)
    bench.send(STREAM, wait=3.5)
    turns = np.array([r.turn for r in bench.device.scans])
    times = np.array([r.time_s for r in bench.device.scans])
    assert len(turns) >= 4 and np.all(np.diff(turns) == scans * 100 // variant[1])
    assert np.allclose(np.diff(times), scans * 100 // variant[1] * TURN, atol=1e-6)
    assert telegrams(bench.heard)[1:] == [r.telegram for r in bench.device.scans][: len(telegrams(bench.heard)) - 1]


@pytest.mark.parametrize(("baud", "turns"), [(9600, 30), (19200, 15), (38400, 8), (500000, 1)])
def test_interlaced_scans_come_in_order(lms, baud, turns):
    indices = Configuration().changed(realtime_indices=True)
    bench = lms(baudrate=baud, variant=(100, 25), configuration=indices)
    bench.send(PARTIAL, wait=2.6)
    found = [decode_scan(raw) for raw in telegrams(bench.heard)[1:]]
    assert [int(s.partial[0]) for s in found] == [i % 4 for i in range(len(found))] and len(found) > 4
    assert [s.words.shape[1] for s in found[:5]] == [181, 180, 180, 180, 181]
    assert np.all(np.diff([int(s.telegram_index[0]) for s in found]) % 256 == 1)
    assert np.all(np.diff([int(s.scan_index[0]) for s in found]) % 256 == turns)


def test_scans_are_measured_ahead_by_less_than_a_head_reacts():
    assert AHEAD_S < REACT_S


@pytest.mark.parametrize(("variant", "order"), [((180, 50), [0, 2, 0, 2]), ((180, 100), [0, 0, 0, 0])])
def test_interlaced_scans_follow_the_resolution(lms, variant, order):
    bench = lms(baudrate=500000, variant=variant)
    bench.send(PARTIAL, wait=0.5)
    assert [int(decode_scan(raw).partial[0]) for raw in telegrams(bench.heard)[1:5]] == order
    bench.send(STOP)
    assert decode_scan(bench.send("02 00 02 00 30 08 38 18")[1:]).partial[0] in (0, 2)


def test_other_streams(lms):
    bench = lms(baudrate=500000)
    bench.send("02 00 06 00 20 27 01 00 0A 00 6C B7", wait=0.5)
    found = telegrams(bench.heard)[1:]
    assert {raw[4] for raw in found} == {0xB7} and len(found[0]) == 7 + 6 + 20 + 1
    bench.send("02 00 03 00 20 26 05 79 3E", wait=1.0)
    assert {raw[4] for raw in telegrams(bench.heard)[1:]} == {0xB6}
    assert np.all(np.diff([r.turn for r in list(bench.device.scans)[-3:]]) == 10)


# ------------------------------------------------------------------------------------------------ times


@pytest.mark.parametrize(
    ("request_", "least", "most"),  # milliseconds to the last byte, as measured at 38400 Bd on a real device
    [(STOP, 66, 91), (TYPE, 75, 80), (STATUS, 107, 114), (CONFIG, 75, 76), (SCAN, 190, 300), (WRITE_TL, 128, 129)],
)
def test_times_of_replies(lms, request_, least, most):
    bench = lms(baudrate=38400)
    bench.send(INSTALL)
    began = bench.now - len(bytes.fromhex(request_)) * 10 / 38400
    bench.send(request_)
    assert bench.out[0][0] - began <= 0.060
    assert least - 4 <= 1000 * (bench.out[-1][0] - began) <= most + 4


def test_stopping_a_stream_takes_its_time(lms):
    took = []
    for seed in range(8):
        bench = lms(baudrate=38400, seed=seed)
        bench.send(STREAM, wait=1.0)
        began = bench.now
        bench.send(STOP)
        assert bench.heard[-9:] == bytes.fromhex(OK)
        took.append(bench.out[-1][0] - began)
    assert min(took) >= 0.066 and max(took) <= 0.61 and np.ptp(took) > 0.1


def test_a_request_interrupts_a_stream_that_then_goes_on(lms):
    bench = lms(baudrate=38400)
    bench.send(STREAM, wait=1.0)
    whole = len(telegrams(bench.heard))
    bench.send(TYPE, wait=1.0)
    found = telegrams(bench.heard)
    assert found[0][4] == 0xBA and [raw[4] for raw in found[1:]].count(0xB0) >= 3 and whole >= 4


def test_a_stream_that_this_machine_is_too_slow_for_leaves_scans_out(lms, monkeypatch, caplog):
    bench = lms(baudrate=38400)
    device = bench.device
    monkeypatch.setattr(device.clock, "now", lambda: bench.now)

    def gaps(late):
        """Turns between the scans of a second after the machine did nothing for a while."""
        before = len(device.scans)
        bench.now += late
        bench.run(1.0)
        return np.diff([record.turn for record in list(device.scans)[before - 1 :]])

    bench.send(STREAM, wait=2.0)
    usual = set(gaps(0.0))
    assert len(usual) == 1 and set(gaps(0.9)) == usual and device.left_out == 0  # it may catch up
    bench.run(3.0)
    assert max(gaps(1.5)) * TURN > 1.2 and device.left_out == 1
    assert "too slowly for time_scale 1: 1." in caplog.text
    bench.run(3.0)
    assert max(gaps(0.8)) > max(usual) and device.left_out == 2 and len(caplog.records) == 1


def test_nothing_is_streamed_while_the_variant_changes(lms):
    bench = lms(baudrate=500000)
    bench.send(STREAM)
    bench.send(VARIANT[100, 100], wait=0.6)
    found = telegrams(bench.heard)
    assert found[0][4] == 0xBB and {len(raw) for raw in found[1:]} == {212}
    assert bench.heard.index(found[0]) == 1  # nothing but the ACK before


def test_at_most_508_bytes_leave_in_a_turn_of_the_mirror(lms):
    bench = lms(baudrate=500000)
    bench.send(SCAN)
    times = np.array([t for t, _ in bench.out[1:]])
    gap = int(np.argmax(np.diff(times)))
    assert gap + 1 == 508 and times[508] - times[0] == pytest.approx(TURN, abs=0.0021)


def test_the_rate_changes_after_the_reply(lms):
    bench = lms()
    bench.send(RATE[500000], wait=0.06)
    assert bench.device.baudrate == 9600
    bench.run(0.1)
    assert bench.heard[-9:] == bytes.fromhex(OK) and bench.device.baudrate == 500000
    slow = lms(baudrates=(9600, 19200, 38400))
    assert parse_telegram(slow.send(RATE[500000])[1:]).data == b"\x02" and slow.device.baudrate == 9600


@pytest.mark.parametrize("request_", [STATUS, STOP, SCAN, CONFIG, STATUS[:-2] + "00"])
@pytest.mark.parametrize("command", ["rate", "reset"])
def test_a_request_interrupts_a_reply_and_never_undoes_the_command(lms, command, request_):
    """At any time until the reply is out; the one with a wrong checksum as well."""
    for wait in np.arange(0, 0.09, 0.01 if command == "rate" else 0.002):
        bench = lms(boot_s=0.5, baudrate=19200, permanent_baud=True)
        bench.send(RATE[38400] if command == "rate" else "02 00 01 00 10 34 12", wait)
        bench.send(request_, wait=2.0)
        if command == "rate":
            assert bench.device.baudrate == 38400, wait
            assert telegrams(bench.send(TYPE))[0][4] == 0xBA
        else:
            assert telegrams(bench.heard)[-1][4] == 0x90, wait


class Carmen:
    """A host whose rate counts, with the order of commands of CARMEN's client: it gives each byte 250 ms."""

    def __init__(self, bench):
        self.bench, self.rate, self.heard = bench, 9600, bytearray()
        bench.device.line._put = lambda data: self.heard.extend(resample(data, bench.device.baudrate, self.rate))

    def send(self, raw):
        raw = bytes.fromhex(raw)
        self.bench.run(len(raw) * 10 / self.rate)
        self.bench.device.receive(resample(raw, self.rate, self.bench.device.baudrate), self.bench.now)

    def reply(self):
        """The next telegram, whatever it answers; None after a silence, or for a damaged one."""
        silent, count = 0, len(self.heard)
        while not (found := telegrams(self.heard)) and silent < 250:
            self.bench.run(0.001)
            silent, count = (0 if len(self.heard) > count else silent + 1), len(self.heard)
        self.heard.clear()
        return found[0] if found else None

    def find(self):
        """The rate at which two stops in a row are answered."""
        for self.rate in (9600, 19200, 38400, 500000):
            for _ in range(8):
                self.send(STOP)
                if self.reply() is None:
                    continue
                self.bench.run(0.01)
                self.send(STOP)
                if self.reply() is not None:
                    return self.rate
        return None

    def connect(self, rate):
        """Ask for the rate and, at once, for the status: any answer will do, then the device is looked for again."""
        for _ in range(2):
            if self.find() in (rate, None):
                return self.rate == rate
            self.send(RATE[rate])
            answered = False
            for _ in range(5):
                self.send(STATUS)
                answered = answered or self.reply() is not None
                if answered:
                    break
            if not answered:
                return False
        return False


@pytest.mark.parametrize("wanted", [9600, 19200, 38400, 500000])
@pytest.mark.parametrize("found", [9600, 19200, 38400])
def test_carmen_connects_in_its_own_order_of_commands(lms, found, wanted):
    bench = lms(baudrate=found)
    client = Carmen(bench)
    assert client.connect(wanted)
    client.send(STATUS)
    assert parse_status(client.reply()).baud == wanted == bench.device.baudrate


# ------------------------------------------------------------------------------------------------ the line


def test_the_same_rate_changes_nothing_and_a_near_one_neither():
    data = np.random.default_rng(0).bytes(400)
    assert resample(data, 9600, 9600) == data
    assert resample(data, 9600, 9700) == data
    assert resample(data, 9700, 9600) == data


@pytest.mark.parametrize("rates", [(9600, 19200), (38400, 9600), (500000, 38400), (9600, 500000), (38400, 19200)])
def test_another_rate_garbles(rates):
    data = np.random.default_rng(1).bytes(300)
    found = resample(data, *rates)
    assert found and data[:20] not in found and not telegrams(resample(bytes.fromhex(OK) * 10, *rates))


def test_no_rate_reads_nothing():
    assert resample(b"abc", 9600, 0) == b"" and resample(b"", 1, 2) == b""
    assert {9600, 500000} <= set(RATES.values())


def test_a_clock_runs_at_its_scale_and_back():
    clock = Clock(5.0)
    assert clock.device(clock.host(3.0)) == pytest.approx(3.0, abs=1e-4)
    with pytest.raises(ValueError, match="time_scale is 0"):
        Clock(0)
    with pytest.raises(ValueError, match="time_scale is 8.1: .* at most 8"):
        Clock(8.1)


def until(condition, what="it"):
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end, f"{what} did not happen"
        time.sleep(0.01)


class Client:
    """A host of the laser range finder that reads as the client of the ROS sicktoolbox does."""

    def __init__(self, path, baud=9600):
        self.port = serial.Serial(path, baud, timeout=0.05)

    def close(self):
        self.port.close()

    def send(self, raw, pace=None):
        raw = bytes.fromhex(raw) if isinstance(raw, str) else raw
        for piece in [raw] if pace is None else [raw[i : i + 1] for i in range(len(raw))]:
            self.port.write(piece)
            time.sleep(pace or 0)

    def read(self, wait):
        """The next sound telegram within a time; None without."""
        end, data = time.monotonic() + wait, b""
        while time.monotonic() < end:
            data += self.port.read(1)
            found = telegrams(data)
            if found:
                return found[0]
        return None

    def ask(self, raw, code, wait=1.0, tries=3, pace=None):
        """Send until a reply of that code comes."""
        for _ in range(tries):
            self.send(raw, pace)
            end = time.monotonic() + wait
            while (left := end - time.monotonic()) > 0:
                found = self.read(left)
                if found is not None and found[4] == code:
                    return found
        raise AssertionError(f"no reply {code:02X} in {tries} tries of {wait} s")


@pytest.fixture
def device(tmp_path):
    """Maker of a laser range finder on a port."""
    made = []

    def make(**options):
        made.append(EmulatedLms(path=tmp_path / f"lrf{len(made)}", **options).start())
        return made[-1]

    yield make
    for one in made:
        one.close()
        assert one.line.error is None and not os.path.exists(one.path)


def test_a_wrong_rate_is_not_understood(device):
    lrf = device(baudrate=19200)
    client = Client(lrf.path, 9600)
    client.send(TYPE)
    assert client.read(0.4) is None and not lrf.requests and lrf.line.counts["garbled"] >= 7
    client.port.baudrate = 19200
    assert client.ask(TYPE, 0xBA)
    client.close()


@pytest.mark.parametrize("baud", [9600, 19200, 38400, 500000])
def test_streams_arrive_whole_at_every_rate(device, baud):
    scale = {9600: 8, 19200: 6, 38400: 4}.get(baud, 1)
    lrf = device(baudrate=baud, time_scale=scale, configuration=Configuration().changed(realtime_indices=True))
    client = Client(lrf.path, baud)
    assert client.ask(STREAM, 0xA0)
    data, end = b"", time.monotonic() + DEADLINE
    while len(telegrams(data)) < 12 and time.monotonic() < end:
        data += client.port.read(4096)
    sent, found, cut = {r.telegram for r in lrf.scans}, telegrams(data), split_stream(data)
    assert len(found) >= 12 and set(found) <= sent
    assert cut.offset[0] == 0 and np.array_equal(np.diff(cut.offset), cut.length[:-1])  # nothing between them
    index = [int(decode_scan(raw).telegram_index[0]) for raw in found]
    assert np.all(np.diff(index) % 256 == 1)
    client.close()


def test_a_host_that_does_not_read_loses_bytes_and_nothing_else(device):
    lrf = device(baudrate=500000)
    client = Client(lrf.path, 500000)
    client.ask(STREAM, 0xA0)
    until(lambda: lrf.line.counts["lost"] > 0, "a full buffer")
    client.port.reset_input_buffer()
    assert client.ask(STOP, 0xA0)
    client.close()


def test_a_closed_port_forgets(device):
    lrf = device(baudrate=500000)
    client = Client(lrf.path, 500000)
    client.ask(STREAM, 0xA0)
    until(lambda: client.port.in_waiting > 500, "a stream")
    client.close()
    until(lambda: lrf.line.counts["unheard"] > 5000, "the stream into nowhere")
    newest = lrf.scans[-1].number
    raw = os.open(lrf.path, os.O_RDWR | os.O_NOCTTY)  # without a flush, as some programs open
    data = b""
    while len(telegrams(data)) < 1:
        data += os.read(raw, 4096)
    os.close(raw)
    by_bytes = {r.telegram: r.number for r in lrf.scans}
    assert by_bytes[telegrams(data)[0]] >= newest


def test_unplugged_and_back_at_the_same_path(device):
    lrf = device(baudrate=38400)
    client = Client(lrf.path, 38400)
    client.ask(TYPE, 0xBA)
    lrf.faults.inject("unplug", seconds=0.3)
    until(lambda: not lrf.line.plugged, "unplugging")
    assert not os.path.exists(lrf.path)
    with pytest.raises((serial.SerialException, OSError)):
        for _ in range(100):
            client.send(TYPE)
            client.port.read(10)
    client.close()
    until(lambda: os.path.exists(lrf.path), "the port's return")
    client = Client(lrf.path, 38400)
    assert client.ask(TYPE, 0xBA) and lrf.faults.counts["unplug"] == 1
    client.close()


def test_power_on_string_by_itself(device):
    lrf = device(powered_s=0.0, boot_s=0.5)
    client = Client(lrf.path)
    assert client.read(DEADLINE)[4] == 0x90
    client.close()


# ---------------------------------------------------------------------------------------------- other people's clients


@pytest.mark.parametrize("streaming", [False, True])
def test_a_client_like_sicktoolbox(device, streaming):
    """Ignores ACK, wants replies in 1 s (mode 3 s, configuration 15 s), three tries, 55 us between sent bytes."""
    lrf = device(model="LMS200;301063;V02.10 ", configuration=Configuration().changed(unit="mm"))
    client = Client(lrf.path)
    if streaming:  # left behind by a client that crashed
        client.ask(STREAM, 0xA0)
    assert client.ask(RATE[38400], 0xA0, wait=3.0, pace=55e-6) == bytes.fromhex(OK)
    client.port.baudrate = 38400
    time.sleep(0.25)
    assert client.ask(STOP, 0xA0, wait=3.0, pace=55e-6)
    assert b"LMS200;30106" in client.ask(TYPE, 0xBA, pace=55e-6)
    assert parse_status(client.ask(STATUS, 0xB1, pace=55e-6)).unit == "mm"
    config = parse_configuration(client.ask(CONFIG, 0xF4, pace=55e-6))
    assert client.ask(INSTALL, 0xA0, wait=3.0)
    block = config.changed(realtime_indices=True).block
    assert client.ask(encode_telegram(0x77, block), 0xF7, wait=15.0)[5] == 1
    assert client.ask(STOP, 0xA0, wait=3.0) and client.ask(VARIANT[100, 25], 0xBB, wait=3.0)[5] == 1
    assert client.ask(PARTIAL, 0xA0, wait=3.0)
    partial = [decode_scan(client.read(3.0)) for _ in range(12)]
    assert [int(s.partial[0]) for s in partial] == [0, 1, 2, 3] * 3
    assert np.all(np.diff([int(s.telegram_index[0]) for s in partial]) == 1)
    assert client.ask(STOP, 0xA0, wait=3.0) and client.ask(RATE[9600], 0xA0, wait=3.0)
    client.port.baudrate = 9600
    assert client.ask(TYPE, 0xBA)
    client.close()


def test_a_client_in_pure_python(device):
    """Wants ACK within 0.25 s before it looks for the reply within 1.5 s; writes the recorded configuration."""
    lrf = device(model="LMS200;S18063;V02.19 ")
    port = serial.Serial(lrf.path, 9600, timeout=0.25)

    def ask(raw, tries=3):
        for _ in range(tries):
            port.reset_input_buffer()
            port.write(bytes.fromhex(raw))
            if port.read(1) == b"\x06":
                end, data = time.monotonic() + 1.5, b""
                while not telegrams(data) and time.monotonic() < end:
                    data += port.read(1)
                if telegrams(data):
                    return telegrams(data)[0]
        raise AssertionError("no ACK in 0.25 s, or no reply in 1.5 s")

    assert ask(RATE[38400]) == bytes.fromhex(OK)
    port.baudrate = 38400
    assert ask(INSTALL) == bytes.fromhex(OK)
    assert ask(WRITE_CAP)[4:6] == b"\xf7\x01"
    assert ask(STREAM) == bytes.fromhex(OK)
    data = b""
    end = time.monotonic() + DEADLINE
    while len(telegrams(data)) < 3 and time.monotonic() < end:
        data += port.read(64)
    assert [raw[:7] for raw in telegrams(data)[:3]] == [bytes.fromhex("02 80 D6 02 B0 69 41")] * 3
    assert ask(STOP) == bytes.fromhex(OK)
    port.close()


def test_a_client_like_carmen(device):
    """Waits 250 ms for everything, up to 8 tries; 32 bytes of configuration; merges telegrams at 500000 Bd."""
    lrf = device()
    client = Client(lrf.path)

    def ask(raw, code):
        return client.ask(raw, code, wait=0.25, tries=8)

    assert ask(STOP, 0xA0) and ask(RATE[500000], 0xA0)
    client.port.baudrate = 500000
    assert ask(STOP, 0xA0)
    block = parse_configuration(ask(CONFIG, 0xF4)).changed(unit="mm").block
    assert ask(INSTALL, 0xA0)
    assert ask(encode_telegram(0x77, block[:32]), 0xF7)[5] == 1
    assert ask(STOP, 0xA0) and ask(VARIANT[100, 25], 0xBB)[5] == 1
    assert ask(PARTIAL, 0xA0)
    merged = np.zeros(721, np.uint16)
    for wanted in (0, 1, 2, 3):
        scan = decode_scan(client.read(2.0))
        assert scan.partial[0] == wanted
        merged[wanted::4] = scan.words[0]
    records = [r for r in lrf.scans if r.partial >= 0][:4]
    assert np.array_equal(merged[0::4], records[0].words) and np.array_equal(merged[3::4], records[3].words)
    client.close()


# ------------------------------------------------------------------------------------------------ the head


def moved(bench, wait):
    """Degrees the head turns in a while."""
    before = bench.device.pitch(bench.now)
    bench.run(wait)
    return float(np.degrees(bench.device.pitch(bench.now) - before))


def test_wire_values_of_tilts():
    for degrees, raw in [(0, 0), (-45, 4500), (-90, 9000), (90, 27000), (30, 33000), (0.01, 35999)]:
        assert tilt_raw(math.radians(degrees)) == raw
        assert tilt_elevation(raw) == pytest.approx(math.radians(degrees), abs=1e-9)


def test_absolute_tilt_and_queries(head):
    bench = head()
    assert bench.send("FF 01 00 53 00 00 54") == bytes.fromhex("FF 01 00 5B 00 00 5C")
    assert bench.send("FF 01 00 51 00 00 52") == bytes.fromhex("FF 01 00 59 00 00 5A")
    assert bench.send("FF 01 00 4D 80 E8 B6") == b""
    assert bench.send("FF 01 00 53 00 00 54") == b""  # no answers while it makes an absolute move
    bench.run(4.0)
    assert bench.send("FF 01 00 53 00 00 54") == bytes.fromhex("FF 01 00 5B 80 E8 C4")
    assert np.degrees(bench.device.pitch(bench.now)) == pytest.approx(30, abs=0.02)
    bench.send("FF 01 00 4B 11 94 F1", wait=7.0)
    assert bench.send("FF 01 00 51 00 00 52") == bytes.fromhex("FF 01 00 59 11 94 FF")


def test_up_is_up_speed_0_is_slow_and_stop_ignores_speeds(head):
    bench = head(speeds=(0.5, 12.6))
    bench.send("FF 01 00 08 00 3F 48", wait=0.5)
    assert moved(bench, 1.0) == pytest.approx(12.6, abs=0.01)
    bench.send("FF 01 00 00 20 00 21", wait=1.0)
    assert moved(bench, 1.0) == 0
    bench.send("FF 01 00 10 00 00 11", wait=0.5)
    assert moved(bench, 1.0) == pytest.approx(-0.5, abs=0.01)
    bench.send("FF 01 88 00 00 00 89", wait=1.0)
    assert moved(bench, 1.0) == 0


def test_limits_and_watchdog(head):
    bench = head(head=Head(Platform(limits=(-0.1, 0.2))), watchdog_s=1.0)
    bench.send("FF 01 00 08 00 3F 48", wait=0.6)
    assert abs(moved(bench, 0.3)) > 1
    bench.run(1.0)
    assert moved(bench, 1.0) == 0
    for _ in range(8):
        bench.send("FF 01 00 08 00 3F 48", wait=0.5)
    assert bench.device.pitch(bench.now) == pytest.approx(0.2, abs=1e-3)


def test_frames_are_found_in_rubbish(head):
    bench = head()
    query, reply = bytes.fromhex("FF 01 00 53 00 00 54"), bytes.fromhex("FF 01 00 5B 00 00 5C")
    assert bench.send(b"\xff\x00\xff\xff\x01" + query) == reply
    assert bench.send(query[:6] + b"\x55") == b""
    assert bench.send(query[:4], wait=0.2) + bench.send(query[4:]) == b""  # torn in two by a pause
    assert bench.send(query) == reply
    assert bench.send(frame(0, 0x53, 0, 0, address=2)) == b""


@pytest.mark.parametrize(
    ("reply", "query", "stop"),
    [("extended", "FF 01 00 5B 11 94 01", ""), ("general", "FF 01 00 5B 11 94 01", "FF 01 00 01"),
     ("five", "00 5B 11 94 00", ""), ("single", "FF 01 00 5B 11 94 01", "01"), ("none", "", "")],
)  # fmt: skip
def test_kinds_of_reply(head, reply, query, stop):
    bench = head(head=Head(pitch=math.radians(-45)), reply=reply)
    assert bench.send("FF 01 00 53 00 00 54") == bytes.fromhex(query)
    assert bench.send("FF 01 00 00 00 00 01") == bytes.fromhex(stop)


def test_part_number_has_18_bytes(head):
    answer = head().send("FF 01 00 45 00 00 46")
    assert len(answer) == 18 and answer[-1] == (0x46 + sum(answer[1:-1])) % 256


def test_echo_comes_first(head):
    query = bytes.fromhex("FF 01 00 53 00 00 54")
    assert head(echo=True).send(query) == query + bytes.fromhex("FF 01 00 5B 00 00 5C")


def test_partial_feedback_and_none(head):
    bench = head(feedback="partial")
    bench.send("FF 01 00 4D 80 E8 B6")
    assert moved(bench, 1.0) == 0
    bench.send("FF 01 00 08 00 3F 48", wait=0.3)
    assert bench.send("FF 01 00 53 00 00 54") == b""
    bench.send("FF 01 00 00 00 00 01")
    assert len(bench.send("FF 01 00 53 00 00 54")) == 7
    silent = head(feedback="none", reply="general")
    assert silent.send("FF 01 00 53 00 00 54") + silent.send("FF 01 00 00 00 00 01") == b""


def test_an_upside_down_head(head):
    bench = head(invert=True)
    bench.send("FF 01 00 08 00 3F 48", wait=0.5)
    assert moved(bench, 0.5) < -1
    assert bench.send("FF 01 00 4D 80 E8 B6", wait=9.0) == b""
    assert np.degrees(bench.device.pitch(bench.now)) == pytest.approx(-30, abs=0.02)


def test_presets(head):
    bench = head()
    bench.send("FF 01 00 03 00 01 05")
    bench.send("FF 01 00 08 00 3F 48")
    bench.send("FF 01 00 07 00 01 09", wait=4.0)
    assert bench.device.pitch(bench.now) == pytest.approx(0, abs=1e-4)


def test_unknown_options(tmp_path):
    with pytest.raises(ValueError, match="feedback is one of"):
        EmulatedHead(path=tmp_path / "head", feedback="some")


def test_a_client_that_searches_for_the_opcode(tmp_path):
    """As the query tool of Peltrack: 0.35 s for a reply, found by its opcode, also behind an echo."""
    with EmulatedHead(path=tmp_path / "head", baudrate=9600, address=7, echo=True) as head:
        port = serial.Serial(head.path, 9600, timeout=0.35)
        found = b""
        for _ in range(3):
            port.write(frame(0, 0x53, 0, 0, address=7))
            found += port.read(14)
            if b"\x5b" in found:
                break
        at = found.index(b"\x5b") - 3
        assert found[at : at + 7] == frame(0, 0x5B, 0, 0, address=7)
        port.close()
    assert head.line.error is None


def test_play_of_the_gear_and_stretch_as_the_simulator_has_them():
    platform = Platform(backlash=0.01, stretch=0.02, settle=0.0, speed=0.1)
    head = Head(platform)
    head.move(1.0, 0.5, 0.1)
    t = np.linspace(1.0, 4.0, 200)
    true, _ = platform.sweep(0.0, 0.5, t - 1.0 - REACT_S)
    assert np.allclose(head.pitch(t), np.maximum(true, 0.0), atol=1e-12)
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

PLAIN = bytes.fromhex("02 80 17 00 BA 4C 4D 53 32 32 31 3B 33 30 32 30 36 33 3B 58 30 31 2E 32 37 20 10 02 EB")


def _one_bit(found):
    return len(found) == len(PLAIN) and sum((a ^ b).bit_count() for a, b in zip(found, PLAIN, strict=True)) == 1


def _differ(found):
    return [i for i, (a, b) in enumerate(zip(found, PLAIN, strict=True)) if a != b]


BYTES = {
    "drop": lambda found: any(PLAIN[:i] + PLAIN[i + 1 :] == found for i in range(len(PLAIN))),
    "flip": _one_bit,
    "duplicate": lambda found: any(PLAIN[: i + 1] + PLAIN[i:] == found for i in range(len(PLAIN))),
    "insert": lambda found: any(found[:i] + found[i + 1 :] == PLAIN for i in range(len(found))),
    "swap": lambda found: sorted(found) == sorted(PLAIN) and len(_differ(found)) == 2,
    "blank": lambda found: 1 <= len(_differ(found)) <= 4 and not any(found[i] for i in _differ(found)),
    "cut": lambda found: len(found) < len(PLAIN) and PLAIN.startswith(found),
    "headless": lambda found: len(found) < len(PLAIN) and PLAIN.endswith(found),
    "noise": lambda found: 1 <= len(found) - len(PLAIN) <= 20 and found.endswith(PLAIN),
    "checksum": lambda found: _differ(found) == [len(PLAIN) - 1],
    "address": lambda found: parse_telegram(found).address == 0x85,
    "foreign": lambda found: [raw[4] for raw in telegrams(found)] == [0xB2, 0xBA],
    "length": lambda found: found[2:4] != PLAIN[2:4] and len(found) == len(PLAIN) and not telegrams(found),
    "silence": lambda found: found == b"",
    "twice": lambda found: found == 2 * PLAIN,
    "status": lambda found: parse_telegram(found).status == 0xD3,
    "delay": lambda found: found == PLAIN,
    "pause": lambda found: found == PLAIN,
}


@pytest.mark.parametrize("name", BYTES)
@pytest.mark.parametrize("seed", range(3))
def test_faults_of_a_reply(lms, name, seed):
    bench = lms(seed=seed, baudrate=38400)
    bench.device.faults.inject(name)
    answer = bench.send(TYPE, wait=2.0)
    assert answer[:1] == b"\x06" and BYTES[name](answer[1:]), answer.hex(" ")
    gaps = np.diff([t for t, _ in bench.out])
    assert gaps.max(initial=0) >= {"delay": 0.7, "pause": 0.075}.get(name, 0)
    assert bench.device.faults.counts[name] == 1 and not bench.device.faults.armed
    assert bench.send(TYPE)[1:] == PLAIN  # and it is over


def _nak(bench):
    assert bench.send(TYPE) == b"\x15"


def _no_ack(bench):
    assert bench.send(TYPE) == PLAIN


def _refused(bench):
    assert bench.send(TYPE)[1:] == bytes.fromhex("02 80 02 00 92 10 7F 33")


def _reboot(bench):
    assert bench.send(TYPE, wait=3.0)[-2:] == bytes.fromhex("43 D4") and bench.device.baudrate == 9600


def _rate(bench):
    bench.send(TYPE)
    assert bench.device.baudrate != 38400


def _stuck(bench):
    bench.device.faults.clear()
    bench.send(STREAM)
    bench.device.faults.inject("stuck")
    codes = [raw[4] for raw in telegrams(bench.send(STOP, wait=1.5))]
    assert codes[0] == 0xA0 and codes.count(0xB0) >= 3
    bench.send(STOP)
    assert not bench.device.streaming


def _slow_mode(bench):
    bench.send(STOP, wait=2.7)
    assert bench.heard == b"\x06" and bench.run(0.3)[1:] == bytes.fromhex(OK)


def _skip(bench):
    bench.send(STREAM, wait=2.5)
    assert np.diff([r.turn for r in bench.device.scans]).tolist()[:2] in ([16, 16], [32, 16])
    turns = [r.turn for r in bench.device.scans]
    assert bench.device.scanner.telegrams == len(turns) + 1


def _stale(bench):
    bench.device.faults.clear()
    first = bench.send(SCAN)[1:]
    bench.device.faults.inject("stale")
    assert bench.send(SCAN)[1:] == first and bench.device.scans[-1].telegram != first


DEVICE = {"nak": _nak, "no_ack": _no_ack, "refused": _refused, "reboot": _reboot, "rate": _rate, "stuck": _stuck,
          "slow_mode": _slow_mode, "skip": _skip, "stale": _stale}  # fmt: skip


@pytest.mark.parametrize("name", DEVICE)
def test_faults_of_the_laser_range_finder(lms, name):
    bench = lms(baudrate=38400)
    bench.device.faults.inject(name)
    DEVICE[name](bench)
    assert bench.device.faults.counts[name] == 1 and not bench.device.faults.armed


def _mute(bench):
    assert bench.send(frame(0, 0x53, 0, 0)) == b"" and len(bench.send(frame(0, 0x53, 0, 0))) == 7


def _stall(bench):
    bench.send(frame(0, 0x08, 0, 0x3F))
    assert moved(bench, 1.0) == 0
    bench.send(frame(0, 0x08, 0, 0x3F))
    assert moved(bench, 1.0) > 5


def _slip(bench):
    bench.send(frame(0, 0x08, 0, 0x3F))
    bench.send(frame(0, 0, 0, 0), wait=0.05)
    assert moved(bench, 0.25) > 2
    bench.run(1.0)
    assert moved(bench, 1.0) == 0


def _jump(bench):
    assert bench.send(frame(0, 0x53, 0, 0)) == frame(0, 0x5B, 0x03, 0xE8)


HEAD = {"mute": _mute, "stall": _stall, "slip": _slip, "jump": _jump}


@pytest.mark.parametrize("name", HEAD)
def test_faults_of_the_head(head, name):
    bench = head()
    bench.device.faults.inject(name)
    HEAD[name](bench)
    assert bench.device.faults.counts[name] == 1


@pytest.mark.parametrize("name", ["drop", "flip", "duplicate", "insert", "swap", "blank", "cut", "headless", "checksum",
                                  "address", "foreign", "twice", "silence"])  # fmt: skip
def test_faults_of_a_reply_of_the_head(head, name):
    bench = head(head=Head(pitch=math.radians(-45)))
    plain = bench.send(frame(0, 0x53, 0, 0))
    bench.device.faults.inject(name)
    found = bench.send(frame(0, 0x53, 0, 0))
    assert found != plain and bench.device.faults.counts[name] == 1
    if name == "address":
        assert found == frame(0, 0x5B, 0x11, 0x94, address=2)
    if name == "foreign":
        assert found[7:] == plain and found[6] == sum(found[1:6]) % 256
    assert bench.send(frame(0, 0x53, 0, 0)) == plain


LINE = ("request_drop", "request_flip", "deaf", "echo", "unplug")


@pytest.mark.parametrize("name", ["request_drop", "request_flip", "deaf", "echo"])
def test_faults_of_what_the_host_sends(device, name):
    lrf = device(baudrate=38400)
    client = Client(lrf.path, 38400)
    client.ask(TYPE, 0xBA)
    before = len(lrf.requests)
    lrf.faults.inject(name)
    client.send(TYPE)
    if name == "echo":
        until(lambda: client.port.in_waiting >= 37, "echo and reply")
        data = client.port.read(37)
        assert data[:7] == bytes.fromhex(TYPE) and data[8:] == PLAIN
    else:
        until(lambda: lrf.faults.counts[name] == 1, name)
        assert client.read(0.3) is None and len(lrf.requests) == before
    assert client.ask(TYPE, 0xBA) and lrf.faults.counts[name] == 1
    client.close()


def test_every_fault_is_tested_and_there_are_more_than_twenty():
    assert set(FAULTS) == {*BYTES, *DEVICE, *HEAD, *LINE}
    assert len(FAULTS) >= 20


def test_faults_follow_from_the_seed_and_are_counted(lms):
    def run(seed):
        bench = lms(baudrate=38400, seed=seed)
        for name in ("drop", "flip", "noise"):
            bench.device.faults.chance(name, 0.5)
        answers = [bench.send(TYPE, wait=0.2) for _ in range(10)]
        return answers, dict(bench.device.faults.counts)

    assert run(3) == run(3) != run(4)
    assert sum(run(3)[1].values()) > 5


def test_a_fault_for_a_while(head):
    bench = head()
    bench.device.faults.inject("mute", seconds=60)
    assert bench.send(frame(0, 0x53, 0, 0)) + bench.send(frame(0, 0x53, 0, 0)) == b""
    assert bench.device.faults.armed == {"mute"} and bench.device.faults.counts["mute"] == 2
    bench.device.faults.clear("mute")
    assert bench.send(frame(0, 0x53, 0, 0))


def test_faults_that_a_device_does_not_have():
    with pytest.raises(ValueError, match="no fault 'stall' of device 'lrf'"):
        Faults("lrf").inject("stall")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_device_that_fails_says_so(tmp_path):
    class Broken:
        baudrate = 9600

        def receive(self, data, at):
            raise RuntimeError("broken")

    line = Line(tmp_path / "x", Broken(), Clock(), Faults("lrf"))
    line.start()
    port = serial.Serial(str(tmp_path / "x"), 9600)
    port.write(b"x")
    until(lambda: line.error is not None, "the error")
    line.join(DEADLINE)
    assert str(line.error) == "broken" and not os.path.lexists(tmp_path / "x")
    port.close()
    line.close()
