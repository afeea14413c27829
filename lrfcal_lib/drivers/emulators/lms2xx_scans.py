"""The scans of an emulated LMS2xx: its mirror, what a scan looks like on the wire, when a stream sends the next."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from lrfcal_lib.drivers.lms2xx import UNITS, encode_values

TURN_S = 1 / 75.08  # of the mirror, as 148 us for a ninetieth tells
KEPT = 20000  # scans in the record
STREAM, MEAN, PART, MEAN_PART, INTERLACED = 0x24, 0x26, 0x27, 0x28, 0x2A  # operating modes that stream
STREAMS = {STREAM, MEAN, PART, MEAN_PART, INTERLACED}
SPREAD = 4000  # counts: scans that differ by more hold a special value, of which no mean is taken


@dataclass(frozen=True)
class ScanRecord:
    """A scan that was sent, or that a fault kept from being sent.

    Attributes
    ----------
    number : int
        Running.
    turn : int
        Of the mirror since power-on, the first of the scan; modulo 256 it is the scan index.
    telegram_index : int
    time_s : float
        Host clock (time.time()) at the first beam.
    beam_times_s : ndarray, shape (B,)
        Host clock at every beam.
    pitch_rad : ndarray, shape (2,)
        True pitch of the head at the earliest and the latest beam; NaN without a head.
    partial : int
        0 to 3 for the quarters of interlaced scans, -1 for whole ones.
    words : ndarray of uint16, shape (B,)
        All values of the scan, as the device counts them.
    telegram : bytes
        Before any fault.
    """

    number: int
    turn: int
    telegram_index: int
    time_s: float
    beam_times_s: np.ndarray
    pitch_rad: np.ndarray
    partial: int
    words: np.ndarray
    telegram: bytes


class SyntheticSource:
    """Scans that are a cheap function of the mirror's turn: no two in a row alike, every range within 8 m."""

    def scan(self, turn, quarters, times):
        """Readings of a scan.

        Parameters
        ----------
        turn : int
            Of the mirror, the first of the scan.
        quarters : ndarray of int, shape (B,)
            Bearings, quarters of a degree.
        times : ndarray, shape (B,)
            Of every beam, seconds of the devices.

        Returns
        -------
        ranges : ndarray, shape (B,)
            Metres.
        reasons : ndarray of int, shape (B,)
            Index into `lms2xx.REASONS`; 0 for a range.
        pitch : ndarray, shape (2,)
            Of the head at the earliest and the latest beam; NaN here.
        """
        ranges = 1.0 + (quarters * 13 + turn * 37) % 6000 / 1000
        reasons = np.where((quarters + turn) % 97 == 0, 1 + turn % 2 * 3, 0)
        return ranges, reasons, np.full(2, np.nan)


@dataclass
class Measured:
    """A scan as measured, and its telegram: reply code, bytes before the values, slice of the values."""

    turn: int
    times: np.ndarray
    pitch: np.ndarray
    words: np.ndarray
    partial: int = -1
    code: int = 0xB0
    head: bytes = b""
    some: tuple = (None,)


class Scanner:
    """Mirror and receiver.

    Parameters
    ----------
    source : object
        See :class:`SyntheticSource`.
    memory : Memory
    clock : Clock
    zero : float
        Instant of power-on.

    Attributes
    ----------
    records : deque of ScanRecord
    telegrams : int
        Sent since power-on.
    """

    def __init__(self, source, memory, clock, zero):
        self.source, self.memory, self.clock, self.zero = source, memory, clock, zero
        self.records, self.telegrams, self._number, self._partial = deque(maxlen=KEPT), 0, 0, 0

    def turn_time(self, turn):
        """When a turn of the mirror begins."""
        return self.zero + turn * TURN_S

    def turn_at(self, instant, turns=None):
        """First turn of the scan that is being measured at an instant."""
        turns = turns or self.memory.turns
        return math.floor((instant - self.zero) / TURN_S / turns) * turns

    def turn_after(self, instant, turns=None):
        """First turn of the next scan that begins."""
        turns = turns or self.memory.turns
        return math.ceil((instant - self.zero) / TURN_S / turns) * turns

    def whole(self, turn, step=1):
        """A whole scan, or every `step`-th value of it."""
        return self._measure(turn, some=(None, None, step))

    def interlaced(self, turn):
        """The next of the partial scans of 1 deg steps; which there are depends on the resolution set."""
        partial, self._partial = self._partial * self.memory.variant[1] % 100 // 25, self._partial + 1
        return self._measure(turn, partial)

    def begin_interlaced(self):
        """Let the next partial scan be the first of a set."""
        self._partial = 0

    def part(self, turn, limits):
        """A sub-range, first and last value counted from 1."""
        first, last = limits
        head = b"".join(v.to_bytes(2, "little") for v in limits)
        return self._measure(turn, code=0xB7, head=head, some=(first - 1, last))

    def mean(self, turn, count, limits=None):
        """Mean of successive scans; a special value in one of them stays."""
        scans = [self._measure(turn + i * self.memory.turns) for i in range(count)]
        words = np.array([scan.words for scan in scans])
        alike = np.ptp(words, axis=0) < SPREAD
        words = np.where(alike, words.mean(axis=0), words.max(axis=0)).astype(np.uint16)
        limits = limits or ()
        head = bytes([count]) + b"".join(v.to_bytes(2, "little") for v in limits)
        some = (limits[0] - 1, limits[1]) if limits else (None,)
        last = scans[-1]
        return Measured(turn, last.times, last.pitch, words, code=0xBF if limits else 0xB6, head=head, some=some)

    def _measure(self, turn, partial=-1, **shape):
        quarters = np.array(self.memory.quarters(partial))
        times = self.turn_time(turn) + np.array(self.memory.beam_times(TURN_S, partial))
        ranges, reasons, pitch = self.source.scan(turn, quarters, times)
        c = self.memory.configuration
        words = encode_values(ranges, unit=c.unit, mode=c.measuring_mode, reasons=reasons)
        return Measured(turn, times, pitch, words, partial, **shape)

    def telegram(self, scan):
        """Telegram of a scan, which is then in the record."""
        c, words, index = self.memory.configuration, scan.words[slice(*scan.some)], self.telegrams % 256
        flags = UNITS.index(c.unit) << 14 | (scan.partial >= 0) << 13 | max(scan.partial, 0) << 11
        data = scan.head + (len(words) | flags).to_bytes(2, "little") + words.astype("<u2").tobytes()
        data += bytes([scan.turn % 256, index]) if c.realtime_indices else b""
        raw, host = self.memory.reply(scan.code, data), self.clock.host(scan.times)
        told = (scan.turn, index, float(host[0]), host, scan.pitch, scan.partial, scan.words, raw)
        self.records.append(ScanRecord(self._number, *told))
        self.telegrams, self._number = self.telegrams + 1, self._number + 1
        return raw


def sub_range(data, memory):
    """First and last value that four bytes ask for, counted from 1; None where they are not possible."""
    first, last = (int.from_bytes(data[i : i + 2], "little") & 0x7FFF for i in (0, 2))
    return (first, last) if len(data) == 4 and 1 <= first <= last <= len(memory.quarters()) else None


class ScanStream:
    """Scans that are sent by themselves.

    Parameters
    ----------
    mode : int
        Operating mode, one of `STREAMS`.
    data : bytes
        Its parameters.
    scanner : Scanner
    """

    def __init__(self, mode, data, scanner):
        self.mode, self.data, self.scanner, self.turn = mode, data, scanner, 0

    @staticmethod
    def possible(mode, data, memory):
        """Whether a mode streams with such parameters."""
        if mode in (STREAM, INTERLACED):
            return not data
        counted, ranged = mode in (MEAN, MEAN_PART), mode in (PART, MEAN_PART)
        if not (counted or ranged) or len(data) != counted + 4 * ranged:
            return False
        return (not counted or 2 <= data[0] <= 250) and (not ranged or sub_range(data[-4:], memory) is not None)

    @property
    def turns(self):
        """Mirror turns that one telegram takes to measure."""
        if self.mode == INTERLACED:
            return 1
        return self.scanner.memory.turns * (self.data[0] if self.mode in (MEAN, MEAN_PART) else 1)

    def begin(self, instant):
        """Go on with the next scan that begins; of interlaced ones with the first of a set."""
        self.scanner.begin_interlaced()
        self.turn = self.scanner.turn_after(instant, 1 if self.mode == INTERLACED else None)

    @property
    def complete_at(self):
        """When the next scan is complete."""
        return self.scanner.turn_time(self.turn + self.turns)

    def measure(self):
        """The scan that is complete."""
        limits = self._limits
        if self.mode == INTERLACED:
            return self.scanner.interlaced(self.turn)
        if self.mode in (MEAN, MEAN_PART):
            return self.scanner.mean(self.turn, self.data[0], limits)
        return self.scanner.part(self.turn, limits) if limits else self.scanner.whole(self.turn)

    def advance(self):
        """Pass on to the next scan that is sent: as many whole ones later as the transfer needs (manual, 10-17)."""
        memory, limits = self.scanner.memory, self._limits
        values = 181 if self.mode == INTERLACED else len(memory.quarters())
        values = limits[1] - limits[0] + 1 if limits else values
        size = 2 * values + 10 + 2 * memory.configuration.realtime_indices
        self.turn += math.ceil(size * 10 / memory.baudrate / (self.turns * TURN_S)) * self.turns

    @property
    def _limits(self):
        return sub_range(self.data[-4:], self.scanner.memory) if self.mode in (PART, MEAN_PART) else None
