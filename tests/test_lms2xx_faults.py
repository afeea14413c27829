"""Fault campaign: whatever goes wrong on the line or in the device, no call hangs, no wrong scan is accepted, and
everything works again soon after the fault ended.
"""

import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hiccups import Hiccups

from lrfcal_lib.drivers.emulators import FAULTS, EmulatedLms
from lrfcal_lib.drivers.errors import DeviceError
from lrfcal_lib.drivers.lms2xx import crc16, decode_scan, encode_scan
from lrfcal_lib.drivers.lms2xx_device import LMS2xx
from lrfcal_lib.drivers.lms2xx_replies import Configuration

DEVICES = 12
SCALE = 2.0  # seconds of the devices in one of the host
RECOVERY_S, HANG_S = 3.0, 30.0  # the second one only guards against hanging
STAMP_S = 0.6  # of the devices: below the delay that the fault 'delay' makes
KINDS = [name for name, fault in FAULTS.items() if "lrf" in fault.devices]
LONG = {"unplug", "reboot", "rate", "deaf", "echo"}  # they last for a while, so there are fewer of them
ON_REQUESTS = {"request_drop", "request_flip", "deaf", "echo", "nak", "no_ack", "refused", "reboot", "rate", "stuck",
               "slow_mode"}  # fmt: skip
STREAMED = [kind for kind in KINDS if kind not in ON_REQUESTS]


class Campaign:
    """One emulated device, one driver, one after the other of the faults."""

    def __init__(self, folder, number):
        self.rng = np.random.default_rng([20091001, number])
        configuration = Configuration().changed(unit="mm", realtime_indices=True)
        options = {"baudrate": 38400, "boot_s": 0.5 * SCALE, "time_scale": SCALE, "seed": number}
        self.device = EmulatedLms(path=folder / f"lrf{number}", configuration=configuration, **options)
        self.recoveries, self.calls, self.readings = [], [], []

    def run(self, streamed, requested):
        """All faults of this device: those of a stream, then those of requests."""
        with self.device, LMS2xx.open(self.device.path, clock=self.now) as self.lms:
            self.lms.start()
            self.accept(self.lms.take(1, timeout=HANG_S))
            for kind in streamed:
                self.disturb(kind)
                self.recovers(kind, self.fresh)
            self.survive(self.lms.stop)
            for kind in requested:
                self.disturb(kind)
                worked = self.survive(self.some_call())  # may fail, within its deadline
                self.over(kind)
                self.recovers(kind, self.request, worked)
        return self

    # ------------------------------------------------------------------------------------------ causing a fault

    def now(self):
        """Clock of the driver; not time.time(), which may be set meanwhile."""
        return float(self.device.clock.host(self.device.clock.now())) * SCALE

    def disturb(self, kind):
        """Inject a fault; in a stream wait until it happened and ended."""
        before = self.device.faults.counts[kind]
        self.device.faults.inject(kind, seconds=0.3 if kind in LONG else None)
        if self.lms._reader is None:
            return
        self.wait(lambda: self.device.faults.counts[kind] > before)
        self.over(kind)

    def over(self, kind):
        """Wait until a fault has ended; a fault that found no opportunity is disarmed."""
        self.device.faults.clear(kind)
        self.wait(lambda: self.device.line.plugged and not self.device._booting)

    def wait(self, condition):
        end = time.monotonic() + HANG_S
        while not condition():
            assert time.monotonic() < end and self.device.line.error is None
            time.sleep(0.005)

    # ------------------------------------------------------------------------------------------ what a user does

    def fresh(self):
        """A scan that was begun after this call."""
        self.accept([self.lms.newest(after=self.now(), timeout=HANG_S)])

    def request(self):
        self.accept([self.lms.request()])

    def stream_a_little(self):
        self.lms.start()
        try:
            self.accept([self.lms.newest(timeout=RECOVERY_S)])
        finally:
            self.lms.stop()

    def some_call(self):
        """Any of the calls of a quiet device."""
        angle = int(self.rng.choice([100, 180]))
        unit = str(self.rng.choice(["cm", "mm"]))
        calls = [self.request, self.request, self.request, self.lms.read_status, self.stream_a_little,
                 lambda: self.lms.set_variant(angle, 0.5), lambda: self.lms.configure(unit=unit)]  # fmt: skip
        return calls[self.rng.integers(len(calls))]

    def survive(self, call):
        """Whether a call worked; what it raises must be a DeviceError."""
        begin = time.monotonic()
        try:
            call()
            return True
        except DeviceError:
            return False
        finally:
            self.calls.append(time.monotonic() - begin)

    def recovers(self, kind, call, worked=True):
        """Time until a call works; after one that failed comes the one remedy that the driver offers."""
        begin = time.monotonic()
        while not (worked and self.survive(call)):
            assert time.monotonic() < begin + HANG_S, f"no recovery from {kind}"
            worked = self.survive(lambda: self.lms.reconnect(deadline=10))
        self.recoveries.append((kind, begin, time.monotonic()))

    def accept(self, readings):
        self.readings += readings

    def made(self, reading):
        """The device's own record of a scan; after two reboots the same turn may have been the first one sent."""
        told = reading.telegrams[0][4:-3]  # without address, status, checksum
        same = [record for record in self.device.scans if record.telegram[4:-3] == told]
        return min(same, key=lambda record: abs(record.time_s * SCALE - reading.time_s), default=None)

    def check(self, late_s):
        """Every scan accepted is one that the device made, at its time, and none came twice."""
        found = [self.made(reading) for reading in self.readings]
        assert None not in found
        assert np.all(np.diff([record.number for record in found]) > 0)
        for reading, record in zip(self.readings, found, strict=True):
            assert abs(reading.time_s - record.time_s * SCALE) < STAMP_S + late_s * SCALE
            unit = {"cm": 0.01, "mm": 0.001}[decode_scan(record.telegram).unit]
            valid = reading.reasons == 0
            np.testing.assert_allclose(reading.ranges[valid], record.words[valid] * unit)


def share(kinds, times, rng):
    """Faults for each device: every kind so many times (long ones half as often), in random order."""
    everything = [kind for kind in kinds for _ in range(times // 2 if kind in LONG else times)]
    return [list(part) for part in np.array_split(rng.permutation(everything), DEVICES)]


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("faults"), np.random.default_rng(5)
    parts = zip(share(STREAMED, 14, rng), share(KINDS, 10, rng), strict=True)
    hiccups = Hiccups()
    hiccups.start()
    with ThreadPoolExecutor(DEVICES) as pool:
        runs = [pool.submit(Campaign(folder, number).run, *part) for number, part in enumerate(parts)]
        found = [run.result() for run in runs]
    hiccups.over.set()
    hiccups.join()
    return found, hiccups


def test_hundreds_of_faults_of_many_kinds_were_injected(campaigns):
    counts = sum((one.device.faults.counts for one in campaigns[0]), start=Counter())
    assert sum(counts.values()) >= 500
    assert sum(count > 0 for count in counts.values()) >= 20


def test_no_call_hangs(campaigns):
    assert max(max(one.calls) for one in campaigns[0]) < HANG_S


def test_no_wrong_scan_is_accepted(campaigns):
    campaigns, hiccups = campaigns
    for one in campaigns:
        one.check(hiccups.longest)
    assert sum(len(one.readings) for one in campaigns) > 400


def test_everything_works_again_soon(campaigns):
    """All of them, with what this machine withheld from its threads meanwhile taken off."""
    campaigns, hiccups = campaigns
    recoveries = [recovery for one in campaigns for recovery in one.recoveries]
    took = [(end - begin - hiccups.within(begin, end), kind) for kind, begin, end in recoveries]
    assert len(took) > 500 and max(took)[0] < RECOVERY_S, sorted(took)[-5:]


def test_what_the_checksum_cannot_see():
    """Two flips on a diagonal weigh the same (see crc16): such a scan looks sound, with one wrong range or two."""
    ranges = np.linspace(1, 8, 361)
    raw = bytearray(encode_scan(ranges))
    raw[100] ^= 1 << 2
    assert crc16(raw[:-2]) != int.from_bytes(raw[-2:], "little")
    raw[101] ^= 1 << 3
    assert crc16(raw[:-2]) == int.from_bytes(raw[-2:], "little")
    wrong = np.flatnonzero(~np.isclose(decode_scan(raw).ranges[0], ranges, atol=0.001))
    assert 1 <= len(wrong) <= 2
