"""Fault campaign: whatever goes wrong on the line or in the device, no call hangs, no wrong scan is accepted, and
everything works again soon after the fault ended. In virtual time, so that every run is the same.
"""

from collections import Counter

import numpy as np
import pytest
from faults import LMS
from shared import campaign
from virtual import INDEXED, lms

from lrfcal_lib.drivers.lms2xx import LMS2xx
from lrfcal_lib.drivers.port import DeviceError
from lrfcal_lib.session.lms2xx_codec import decode_scan

DEVICES, BOOT_S = 4, 0.5
RECOVERY_S, CALL_S = 3.0, 12.0  # longest: until all works again, and of any call
KINDS = LMS
LONG = {"unplug", "reboot", "rate", "deaf", "echo"}  # they last for a while, so there are fewer of them
ON_REQUESTS = {"request_drop", "request_flip", "deaf", "echo", "nak", "no_ack", "refused", "reboot", "rate", "stuck",
               "slow_mode"}  # fmt: skip
STREAMED = [kind for kind in KINDS if kind not in ON_REQUESTS]


class Campaign:
    """One emulated device, one driver, one after the other of the faults."""

    def __init__(self, number):
        self.rng = np.random.default_rng([20091001, number])
        self.device = lms(baudrate=38400, boot_s=BOOT_S, seed=number, configuration=INDEXED)
        self.host, self.faults = self.device.host, self.device.faults
        self.recoveries, self.calls, self.readings = [], [], []

    def run(self, streamed, requested):
        """All faults of this device: those of a stream, then those of requests."""
        with LMS2xx(self.device.path, host=self.host) as self.lms:
            self.lms.start()
            for kind in streamed:
                before = self.faults.counts[kind]
                self.faults.inject(kind, seconds=0.3 if kind in LONG else None)
                self.host.wait(lambda kind=kind, before=before: self.faults.counts[kind] > before)
                self.over(kind)
                self.recovers(kind, self.fresh)
            self.survive(self.lms.stop)
            for kind in requested:
                self.faults.inject(kind, seconds=0.3 if kind in LONG else None)
                worked = self.survive(self.some_call())  # may fail, within its deadline
                self.over(kind)
                self.recovers(kind, self.request, worked)
        return self

    def over(self, kind):
        """Wait until a fault has ended; a fault that found no opportunity is disarmed."""
        self.faults.clear(kind)
        self.host.wait(lambda: self.device.port.there)
        self.host.sleep(BOOT_S if kind == "reboot" else 0)

    def fresh(self):
        """A scan that was begun after this call."""
        self.readings += self.lms.take(1, after=self.host.time(), timeout=CALL_S)

    def request(self):
        self.readings.append(self.lms.request())

    def stream_a_little(self):
        self.lms.start()
        try:
            self.readings += self.lms.take(1, timeout=RECOVERY_S)
        finally:
            self.lms.stop()

    def some_call(self):
        """Any of the calls of a quiet device."""
        angle, unit = int(self.rng.choice([100, 180])), str(self.rng.choice(["cm", "mm"]))
        calls = [self.request, self.request, self.request, self.stream_a_little,
                 lambda: self.lms.set_variant(angle, 0.5), lambda: self.lms.configure(unit=unit)]  # fmt: skip
        return calls[self.rng.integers(len(calls))]

    def survive(self, call):
        """Whether a call worked; what it raises must be a DeviceError."""
        begin = self.host.now()
        try:
            call()
            return True
        except DeviceError:
            return False
        finally:
            self.calls.append(self.host.now() - begin)

    def recovers(self, kind, call, worked=True):
        """Time until a call works; after one that failed comes the one remedy that the driver offers."""
        begin = self.host.now()
        while not (worked and self.survive(call)):
            assert self.host.now() < begin + CALL_S, f"no recovery from {kind}"
            worked = self.survive(lambda: self.lms.reconnect(deadline=10))
        self.recoveries.append((self.host.now() - begin, kind))

    def made(self, reading):
        """The device's own record of a scan; after two reboots the same turn may have been the first one sent."""
        told = reading.telegrams[0][4:-3]  # without address, status, checksum
        same = [record for record in self.device.scans if record.telegram[4:-3] == told]
        return min(same, key=lambda record: abs(record.time_s - reading.time_s))


@pytest.fixture(scope="module", params=[1, pytest.param(2, marks=campaign)])
def campaigns(request):
    """All kinds of faults, long ones half as often, in random order."""
    rng, parts = np.random.default_rng(5), []
    for kinds, times in ((STREAMED, 7 * request.param), (KINDS, 5 * request.param)):
        everything = [kind for kind in kinds for _ in range(times // 2 if kind in LONG else times)]
        parts.append(np.array_split(rng.permutation(everything), DEVICES))
    return [Campaign(number).run(*part) for number, part in enumerate(zip(*parts, strict=True))]


def test_hundreds_of_faults_of_many_kinds_are_recovered_from(campaigns):
    counts = sum((one.faults.counts for one in campaigns), start=Counter())
    assert sum(counts.values()) >= 250 and sum(count > 0 for count in counts.values()) >= 20
    assert max(max(one.calls) for one in campaigns) < CALL_S
    took = sorted(recovery for one in campaigns for recovery in one.recoveries)
    assert len(took) > 250 and took[-1][0] < RECOVERY_S, took[-5:]


def test_no_wrong_scan_is_accepted(campaigns):
    """Every scan is one that the device made, at its time, and none came twice."""
    for one in campaigns:
        found = [one.made(reading) for reading in one.readings]
        assert np.all(np.diff([record.number for record in found]) > 0)
        for reading, record in zip(one.readings, found, strict=True):
            assert abs(reading.time_s - record.time_s) < 0.6  # below the delay that the fault 'delay' makes
            unit = {"cm": 0.01, "mm": 0.001}[decode_scan(record.telegram).unit]
            valid = reading.reasons == 0
            np.testing.assert_allclose(reading.ranges[valid], record.words[valid] * unit)
    assert sum(len(one.readings) for one in campaigns) > 200


