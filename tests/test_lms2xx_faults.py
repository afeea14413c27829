"""Fault campaign: whatever goes wrong on the line or in the device, no call hangs, no wrong scan is accepted, and
everything works again soon after the fault ended. In virtual time, so that every run is the same.
"""

import numpy as np
import pytest
from faults import LMS
from shared import campaign
from telegrams import decode_scan
from virtual import INDEXED, lms

from lrfcal_lib.drivers.lms2xx import LMS2xx
from lrfcal_lib.drivers.port import DeviceError

BOOT_S = 0.5
RECOVERY_S = 3.0
CALL_S = 12.0  # longest: until all works again, and of any call
LONG = {
    "unplug",
    "reboot",
    "rate",
    "deaf",
    "echo",
}  # they last for a while, so there are fewer of them
ON_REQUESTS = {
    "request_drop",
    "request_flip",
    "deaf",
    "echo",
    "nak",
    "no_ack",
    "refused",
    "reboot",
    "rate",
}


class Campaign:
    """One emulated device, one driver, one after the other of the faults."""

    def __init__(self, number):
        self.rng = np.random.default_rng([20091001, number])
        self.device = lms(baudrate=38400, boot_s=BOOT_S, seed=number, configuration=INDEXED)
        self.host, self.faults, self.readings = self.device.host, self.device.faults, []

    def run(self, times):
        """All kinds of faults in random order, long ones half as often: those of a stream, then those of requests."""
        kinds = self.rng.permutation(
            [kind for kind in LMS for _ in range(times // 2 if kind in LONG else times)]
        )
        with LMS2xx(self.device.path, host=self.host) as self.lms:
            self.lms.start()
            for kind in [kind for kind in kinds if kind not in ON_REQUESTS]:
                before = self.faults.counts[kind]
                self.inject(kind)
                self.host.wait(
                    lambda kind=kind, before=before: self.faults.counts[kind] > before
                )
                self.over(kind)
                self.recovers(kind, self.fresh)
            self.survive(self.lms.stop)
            for kind in kinds:
                self.inject(kind)
                worked = self.survive(self.some_call())  # may fail, within its deadline
                self.over(kind)
                self.recovers(kind, self.request, worked)

    def inject(self, kind):
        self.faults.inject(kind, seconds=0.3 if kind in LONG else None)

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

    def some_call(self):
        """Any of the calls of a quiet device."""
        angle = int(self.rng.choice([100, 180]))
        unit = str(self.rng.choice(["cm", "mm"]))
        calls = [self.request, self.request, lambda: (self.lms.start(), self.lms.stop()),
                 lambda: self.lms.set_variant(angle, 0.5), lambda: self.lms.configure(unit=unit)]  # fmt: skip
        return calls[self.rng.integers(len(calls))]

    def survive(self, call):
        """Whether a call worked, in time; what it raises must be a DeviceError."""
        begin = self.host.now()
        try:
            call()
            return True
        except DeviceError:
            return False
        finally:
            assert self.host.now() < begin + CALL_S

    def recovers(self, kind, call, worked=True):
        """A call works soon; after one that failed comes the one remedy that the driver offers."""
        begin = self.host.now()
        while not (worked and self.survive(call)):
            worked = self.survive(lambda: self.lms.reconnect(deadline=10))
        assert self.host.now() < begin + RECOVERY_S, kind

    def made(self, reading):
        """The device's own record of a scan; after two reboots the same turn may have been the first one sent."""
        told = reading.telegrams[0][4:-3]  # without address, status, checksum
        same = [record for record in self.device.scans if record.telegram[4:-3] == told]
        return min(same, key=lambda record: abs(record.time_s - reading.time_s))


@pytest.mark.parametrize(
    ("number", "times"), [(0, 8), *(pytest.param(n, 20, marks=campaign) for n in (1, 2, 3))]
)
def test_faults_are_recovered_from_and_no_wrong_scan_is_accepted(number, times):
    """Every scan is one that the device made, at its time, and none came twice."""
    one = Campaign(number)
    one.run(times)
    assert all(one.faults.counts[kind] for kind in LMS) and len(one.readings) > 30 * times
    found = [one.made(reading) for reading in one.readings]
    assert np.all(np.diff([record.number for record in found]) > 0)
    for reading, record in zip(one.readings, found, strict=True):
        assert (
            abs(reading.time_s - record.time_s) < 0.6
        )  # below the delay that the fault 'delay' makes
        unit = (0.01, 0.001)[decode_scan(record.telegram).unit[0]]
        valid = np.isfinite(reading.ranges)
        np.testing.assert_allclose(reading.ranges[valid], record.words[valid] * unit)
