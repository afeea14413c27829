"""Ten seconds of streaming at every rate, in virtual time: every scan of the device is accounted for."""

import math

import numpy as np
import pytest
from virtual import INDEXED, lms

from lrfcal_lib.drivers.lms2xx import LMS2xx
from lrfcal_lib.drivers.lms2xx_link import RATES

STREAM_S, SCAN_S, TURNS, BYTES = 10.0, 2 * 0.01332, 2, 732 + 2  # of the variant 180/0.5


@pytest.mark.parametrize("rate", RATES)
def test_every_scan_is_delivered_or_counted_with_the_instant_of_the_mirror(rate):
    device = lms(baudrate=rate, configuration=INDEXED)
    with LMS2xx(device.path, host=device.host) as driver:
        before = driver.counts
        driver.start()
        readings = driver.take(1)
        while readings[-1].time_s < readings[0].time_s + STREAM_S:
            readings += driver.take(1, after=readings[-1].time_s)
        counts = {key: value - before[key] for key, value in driver.counts.items()}
        driver.stop()
    truth = {record.telegram: record for record in device.scans}
    truth = [truth[reading.telegrams[0]] for reading in readings]
    assert np.all(np.diff([record.number for record in truth]) == 1)
    assert [reading.scan_index for reading in readings] == [record.turn % 256 for record in truth]
    assert counts["stale"] == counts["reconnects"] == device.counts["lost"] == 0
    # a telegram that takes longer than a scan keeps those in between from being sent; they are counted by the index
    period = math.ceil(BYTES * 10 / rate / SCAN_S)
    assert set(np.diff([record.turn for record in truth])) == {period * TURNS}
    assert counts["dropped"] == (len(readings) - 1) * (period - 1)
    assert [r.time_s for r in readings] == pytest.approx([record.time_s for record in truth], abs=5e-4)
