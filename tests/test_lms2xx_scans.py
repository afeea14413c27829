"""Instants of scans, sets of interlaced ones, and ten seconds of streaming at every rate, in virtual time."""

import numpy as np
import pytest
from telegrams import encode_scan
from virtual import INDEXED, lms

from lrfcal_lib.drivers.lms2xx import KEPT, LMS2xx
from lrfcal_lib.drivers.lms2xx_link import RATES
from lrfcal_lib.drivers.lms2xx_scans import Assembler, ScanClock, interval_s, transfer_s
from lrfcal_lib.model.kinematics import MIRROR_TURN

# scans that a telegram takes by the manual's table 10-17: 812 (100/0.25), 732 (180/0.5), 372 bytes (180/1)
TABLE = {9600: (16, 29, 30), 19200: (8, 15, 15), 38400: (4, 8, 8), 500000: (1, 1, 1)}
VARIANTS = {(100, 25): 812, (180, 50): 732, (180, 100): 372}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("rate", RATES)
def test_every_scan_is_delivered_or_counted_with_the_instant_of_the_mirror(rate, variant):
    device = lms(baudrate=rate, variant=variant, configuration=INDEXED)
    with LMS2xx(device.path, host=device.host) as driver:
        driver.start()
        readings = driver.take(1)
        while readings[-1].time_s < readings[0].time_s + 10.0:
            readings += driver.take(1, after=readings[-1].time_s)
        driver.stop()
    truth = {record.telegram: record for record in device.scans}
    truth = [truth[reading.telegrams[0]] for reading in readings]
    assert np.all(np.diff([record.number for record in truth]) == 1)
    # a telegram that takes longer than a scan keeps those in between from being sent; they are counted by the index
    period = TABLE[rate][[*VARIANTS].index(variant)]
    turns = 100 // variant[1]
    assert set(np.diff([record.turn for record in truth])) == {period * turns}
    assert interval_s(VARIANTS[variant], rate, turns * MIRROR_TURN) == pytest.approx(
        period * turns * MIRROR_TURN
    )
    assert [r.time_s for r in readings] == pytest.approx(
        [record.time_s for record in truth], abs=5e-4
    )


def test_interlaced_scans_carry_the_instants_of_the_mirror():
    device = lms(baudrate=500000, configuration=INDEXED)
    with LMS2xx(device.path, host=device.host) as driver:
        driver.start(interlaced=True)
        readings = driver.take(20)
        driver.stop()
    begun = {record.telegram: record.time_s for record in device.scans}
    assert [r.time_s for r in readings] == pytest.approx(
        [begun[r.telegrams[0]] for r in readings], abs=5e-4
    )
    assert all(len(r.ranges) == 721 for r in readings) and driver.variant == (100, 0.25)


def test_more_scans_can_be_taken_than_are_kept():
    device = lms(baudrate=500000, configuration=INDEXED)
    with LMS2xx(device.path, host=device.host) as driver:
        driver.start()
        readings = driver.take(2 * KEPT, timeout=60)
        driver.stop()
    number = {record.telegram: record.number for record in device.scans}
    numbers = [number[reading.telegrams[0]] for reading in readings]
    assert numbers == [*range(numbers[0], numbers[0] + 2 * KEPT)]


def read_late(device, rng):
    """Bytes of a device get to the host at once for 5 to 120 ms of the line, as a busy machine reads them."""
    held = []
    put = device.port.put

    def hand_over(instant):
        put(b"".join(held))
        held.clear()
        device.at(instant + rng.uniform(0.005, 0.12), hand_over)

    device.port.put = held.append
    hand_over(device.host.now())


@pytest.mark.parametrize("indexed", [True, False])
def test_no_set_of_interlaced_scans_is_lost_where_its_parts_are_read_late(indexed):
    device = lms(baudrate=500000, configuration=INDEXED.changed(realtime_indices=indexed))
    read_late(device, np.random.default_rng(7))
    with LMS2xx(device.path, host=device.host) as driver:
        driver.start(interlaced=True)
        readings = driver.take(100)
        driver.stop()
    number = {record.telegram: record.number for record in device.scans}
    parts = [number[raw] for reading in readings for raw in reading.telegrams]
    assert parts == [*range(parts[0], parts[0] + 400)]


def test_late_arrivals_do_not_shift_scans():
    rng = np.random.default_rng(1)
    clock = ScanClock()
    turns = np.cumsum(rng.integers(1, 40, 400))  # over many rounds of the index
    late = np.where(rng.random(400) < 0.2, rng.exponential(0.05, 400), 0)
    late[0] = 0
    instants = map(clock.place, (turns % 256).tolist(), 100.0 + turns * MIRROR_TURN + late)
    off = np.array([*instants]) - 100.0 - turns * MIRROR_TURN
    assert (
        np.median(off) == pytest.approx(0, abs=1e-9)
        and np.abs(off).max() < 0.01 < late.max()
    )


def interlaced(partials, indexed, skipped=()):
    """Readings that telegrams of interlaced scans complete; ranges tell where they belong."""
    configuration = INDEXED.changed(realtime_indices=indexed)
    one = Assembler((100, 0.25), configuration, 500000, True, ScanClock())
    made = {}
    for k, partial in enumerate(partials):
        ranges = 1 + (4 * np.arange(181 - (partial > 0)) + partial) / 1000
        raw = encode_scan(
            ranges, partial=partial, indices=(k % 256, k % 256) if indexed else None
        )
        reading = (
            None
            if k in skipped
            else one.feed(raw, 9 + k * MIRROR_TURN + transfer_s(len(raw), 500000))
        )
        made |= {k: reading} if reading else {}
    return made


FOUR = [2, 3, 4, 5, 8, 9, 10, 11]  # 0 and 1 of one set and 2 and 3 of the next are left


@pytest.mark.parametrize(("indexed", "missing", "made"), [
    *((indexed, [part], [3, 11]) for indexed in (True, False) for part in (4, 5, 6, 7)),
    (True, FOUR, []), (False, FOUR, [7]),
])  # fmt: skip
def test_sets_with_a_missing_part_are_no_scan(indexed, missing, made):
    """Without indices four that are missing in a row are not seen."""
    found = interlaced([0, 1, 2, 3] * 3, indexed, missing)
    assert list(found) == made
    for reading in found.values():
        np.testing.assert_allclose(reading.ranges, 1 + np.arange(721) / 1000, atol=1e-9)
