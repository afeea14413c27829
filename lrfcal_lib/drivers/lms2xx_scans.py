"""Scans of an LMS2xx as they come in: checked, stamped with the mirror's instants, interlaced ones merged. No port."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.drivers.lms2xx import UNITS, TelegramError, decode_scan, scan_quarters
from lrfcal_lib.drivers.lms2xx_link import TURN_S, interval_s, transfer_s

VALUES = {(100, 1.0): 101, (100, 0.5): 201, (100, 0.25): 401, (180, 1.0): 181, (180, 0.5): 361}
WINDOW_S = 2.0  # arrivals in the last so many seconds tell the host's clock from the device's
OFF_S = 1.2  # how far a scan may arrive off its expected instant
JITTER_S = 0.05  # corrections of the clock up to this are spread over scans; at larger ones scans are left out
LEAST_S = TURN_S / 100  # between two instants told; far less than between two scans, emulated ones sped up included
FORGET_S = 30.0  # after such a pause the number of turns in between is not known
STUBBORN = 5  # so many implausible scan indices in a row: the device counts anew


@dataclass(frozen=True)
class Reading:
    """A scan with the instants of its beams.

    Attributes
    ----------
    telegrams : tuple of bytes
        As sent: one, or the four of a set of interlaced scans.
    ranges : ndarray, shape (B,)
        Metres, NaN where there is no range.
    reasons : ndarray of uint8, shape (B,)
        Index into `lms2xx.REASONS`, 0 for a range.
    bearings : ndarray, shape (B,)
        Radians in the LRF frame, ascending.
    time_s : float
        Clock of the host at the first beam.
    beam_times_s : ndarray, shape (B,)
        The same for every beam; neighbours of fine scans are 13.32 ms apart.
    scan_index, telegram_index : int or None
        Of the (first) telegram, modulo 256; None where the device does not send them.
    """

    telegrams: tuple[bytes, ...]
    ranges: np.ndarray
    reasons: np.ndarray
    bearings: np.ndarray
    time_s: float
    beam_times_s: np.ndarray
    scan_index: int | None
    telegram_index: int | None


class ScanClock:
    """Instants of scans: arrivals jitter late, the device's index of turns does not.

    Without indices an arrival counts as it is. With them, the earliest of the arrivals of the last two seconds ties
    the count of turns to the host's clock, so that a busy host or a late telegram does not shift a scan. A mirror that
    is off its nominal speed by a part e shifts it by up to 2 e seconds.
    """

    def __init__(self):
        self._seen, self._refused, self._told = deque(), 0, -np.inf

    def place(self, index, time_s):
        """Instant of a scan.

        Parameters
        ----------
        index : int
            Turns of the mirror modulo 256; -1 where the device does not send it.
        time_s : float
            Instant as of its arrival.

        Returns
        -------
        instant : float or None
            Rising from scan to scan; None for a telegram that is not newer than the last one.
        step : int
            Turns since the last one; 0 where that is not known.
        """
        if index < 0:
            return time_s, 0
        step = 0
        if self._seen:
            turn, last_s = self._seen[-1][0], self._instant()
            step = self._step(index - turn, time_s - last_s)
            if step is None:
                return None, 0
        turn = self._seen[-1][0] + step if step else index
        self._refused = 0
        self._seen.append((turn, time_s))
        while self._seen[0][1] < time_s - WINDOW_S and len(self._seen) > 1:
            self._seen.popleft()
        return self._rising(self._instant()), step

    def _rising(self, instant):
        """An instant after the last one told, or None where the clock was found to be far ahead."""
        if instant < self._told - JITTER_S:
            return None
        self._told = max(instant, self._told + LEAST_S)
        return self._told

    def _step(self, ahead, elapsed_s):
        """Turns since the last scan; None where the index does not fit the time that passed, 0 after a new start."""
        if elapsed_s > FORGET_S or self._refused >= STUBBORN:
            self._seen.clear()
            return 0
        step = ahead % 256
        step += 256 * round((elapsed_s / TURN_S - step) / 256)
        late = elapsed_s - step * TURN_S
        if step > 0 and abs(late) < OFF_S:
            return step
        self._refused += 1
        return None

    def _instant(self):
        """Of the last scan, by the earliest arrival of the window."""
        return self._seen[-1][0] * TURN_S + min(time_s - turn * TURN_S for turn, time_s in self._seen)


class Assembler:
    """Readings out of telegrams, one by one.

    Parameters
    ----------
    variant : tuple
        Field of view and resolution, degrees.
    configuration : Configuration
    baudrate : int
    interlaced : bool
        Merge four partial scans of 180 deg into one of 721 values.
    counts : dict
        'dropped' (scans between two telegrams that were not sent or got lost) and 'stale' are counted up.
    clock : ScanClock, optional
        Of the scans before, where the mirror went on turning: an old telegram that comes first is then known as such.
    """

    def __init__(self, variant, configuration, baudrate, interlaced, counts, clock=None):
        self.variant, self.configuration, self.baudrate, self.interlaced = variant, configuration, baudrate, interlaced
        self.counts, self._clock, self._parts, self._first = counts, clock or ScanClock(), [], True

    @property
    def turns(self):
        """Turns of the mirror for one telegram."""
        return 1 if self.interlaced else round(1 / self.variant[1])

    @property
    def size(self):
        """Bytes of a telegram."""
        values = 181 if self.interlaced else VALUES[self.variant]
        return 10 + 2 * values + 2 * self.configuration.realtime_indices

    @property
    def duration_s(self):
        """Seconds from the start of a scan to its last byte."""
        return self.turns * TURN_S + transfer_s(self.size, self.baudrate)

    @property
    def interval_s(self):
        """Seconds between two telegrams of a stream."""
        return interval_s(self.size, self.baudrate, self.turns * TURN_S)

    def feed(self, raw, arrival_s):
        """A telegram that came in.

        Parameters
        ----------
        raw : bytes
            With a sound checksum.
        arrival_s : float
            Instant of its last byte.

        Returns
        -------
        Reading or None
            None for a part of a set, and for what is no scan of this variant, unit and kind or is not new.
        """
        try:
            scan = decode_scan(raw, self.configuration.measuring_mode)
        except TelegramError:
            return None
        if not self._fits(scan):
            return None
        start_s = arrival_s - transfer_s(len(raw), self.baudrate) - self.turns * TURN_S
        start_s, step = self._clock.place(int(scan.scan_index[0]), start_s)
        if start_s is None:
            self.counts["stale"] += 1
            return None
        self.counts["dropped"] += 0 if self._first else max(0, step // self.turns - 1)
        self._first = False
        reading = self._reading(raw, scan, start_s)
        return self._merge(int(scan.partial[0]), reading) if self.interlaced else reading

    def _fits(self, scan):
        """Whether a scan is one of those that were asked for."""
        partial, indexed = int(scan.partial[0]), scan.scan_index[0] >= 0
        values = 181 - (partial > 0) if self.interlaced else VALUES[self.variant]
        kind = (scan.words.shape[1], UNITS.index(scan.unit), indexed, partial >= 0)
        own = self.configuration
        return kind == (values, UNITS.index(own.unit), own.realtime_indices, self.interlaced)

    def _reading(self, raw, scan, start_s):
        """A telegram alone; `start_s` is the begin of its first turn at bearing 0."""
        partial = int(scan.partial[0])
        quarters = scan_quarters(scan.words.shape[1], partial)
        turn = np.arange(len(quarters)) % self.turns
        times = start_s + (turn + quarters / 1440) * TURN_S
        ranges = np.where(np.isfinite(scan.ranges[0]), scan.ranges[0], np.nan)
        indices = [None if i < 0 else int(i) for i in (scan.scan_index[0], scan.telegram_index[0])]
        return Reading((raw,), ranges, scan.reasons[0], np.radians(quarters / 4), float(times[0]), times, *indices)

    def _merge(self, partial, part):
        """The set of four that a part completes, or None."""
        if partial != len(self._parts) or not self._follows(part):
            self._parts = []
        if partial == len(self._parts):
            self._parts.append(part)
        if len(self._parts) < 4:
            return None
        parts, self._parts = self._parts, []
        columns = {}
        for name in ("ranges", "reasons", "bearings", "beam_times_s"):
            columns[name] = np.empty(721, getattr(parts[0], name).dtype)
            for first, one in enumerate(parts):
                columns[name][first::4] = getattr(one, name)
        return replace(parts[0], telegrams=tuple(t for one in parts for t in one.telegrams), **columns)

    def _follows(self, part):
        """Whether no telegram is missing between a part and the one before."""
        if not self._parts:
            return True
        last = self._parts[-1]
        if part.telegram_index is not None:
            return (part.telegram_index - last.telegram_index) % 256 == 1
        return part.time_s - last.time_s < 1.5 * self.interval_s
