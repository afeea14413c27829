"""Half a minute of streaming at every rate, all at the same time: every scan of the device is accounted for."""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from lrfcal_lib.drivers.emulators import EmulatedLms
from lrfcal_lib.drivers.lms2xx_device import LMS2xx
from lrfcal_lib.drivers.lms2xx_link import RATES
from lrfcal_lib.drivers.lms2xx_replies import Configuration

STREAM_S = 30.0
SCAN_S, TURNS = 2 * 0.01332, 2  # of the variant 180/0.5
BYTES = 732 + 2


def stream(folder, rate):
    """Everything that came through, the device's own record of the same time, and what the driver counted."""
    indexed = Configuration().changed(unit="mm", realtime_indices=True)
    device = EmulatedLms(path=folder / f"lrf{rate}", baudrate=rate, configuration=indexed)
    clock = device.clock  # of the host, which may be set meanwhile: not by time.time()
    with device, LMS2xx.open(device.path, clock=lambda: float(clock.host(clock.now()))) as lms:
        before = lms.counts
        lms.start()
        readings = lms.take(1, timeout=30)
        while readings[-1].time_s < readings[0].time_s + STREAM_S:
            readings += lms.take(1, after=readings[-1].time_s, timeout=30)
        lms.stop()
        counts = {key: value - before[key] for key, value in lms.counts.items()} | device.line.counts
    return readings, list(device.scans), counts


@pytest.fixture(scope="module")
def streamed(tmp_path_factory):
    """Results of `stream` by rate."""
    folder = tmp_path_factory.mktemp("streams")
    with ThreadPoolExecutor(len(RATES)) as pool:
        return dict(zip(RATES, pool.map(lambda rate: stream(folder, rate), RATES), strict=True))


@pytest.mark.parametrize("rate", RATES)
def test_every_scan_is_delivered_or_counted(streamed, rate):
    readings, records, counts = streamed[rate]
    by_telegram = {record.telegram: record for record in records}
    truth = [by_telegram[reading.telegrams[0]] for reading in readings]
    turns = np.array([record.turn for record in truth])
    numbers = [record.number for record in truth]
    # nothing came twice or out of order; only what the pseudo-terminal had no room for is missing (busy machines)
    assert np.all(np.diff(numbers) >= 1) and counts["stale"] == counts["reconnects"] == 0
    assert [reading.scan_index for reading in readings] == (turns % 256).tolist()
    missing = numbers[-1] - numbers[0] + 1 - len(numbers)
    assert counts["lost"] > 0 or missing == counts["crc_errors"] == 0
    # a telegram that takes longer than a scan keeps those in between from being sent; they are counted by the index
    period = math.ceil(BYTES * 10 / rate / SCAN_S)
    sent = {record.number: record.turn for record in records}
    assert {sent[n + 1] - sent[n] for n in range(numbers[0], numbers[-1])} == {period * TURNS}
    made = (turns[-1] - turns[0]) // TURNS + 1
    assert made >= STREAM_S / SCAN_S - period
    # on a busy machine some came before the first one taken or after the last
    unread = sum(not numbers[0] <= record.number <= numbers[-1] for record in records)
    assert 0 <= counts["dropped"] + len(readings) - made <= unread * (period - 1)


@pytest.mark.parametrize("rate", RATES)
def test_instants_are_those_of_the_mirror(streamed, rate):
    readings, records, _ = streamed[rate]
    by_telegram = {record.telegram: record for record in records}
    off = np.array([r.time_s - by_telegram[r.telegrams[0]].time_s for r in readings])
    assert np.all(np.diff([r.time_s for r in readings]) > 0)
    assert abs(np.median(off)) < 0.01


def test_every_stream_lasted(streamed):
    for readings, _, _ in streamed.values():
        assert readings[-1].time_s - readings[0].time_s >= STREAM_S
