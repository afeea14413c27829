"""Telegrams of the SICK LMS2xx laser range finders: bytes to values and back, without a port.

The frame is in `lms2xx_frame`, what a device says about itself in `lms2xx_replies`; here are the scans, telegram 0xB0.
Everything that can be wanted for a whole recording works on many telegrams at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lrfcal_lib.drivers.lms2xx_frame import (
    CHUNK,
    DEVICE,
    OVERHEAD,
    STX,
    Stream,
    Telegram,
    TelegramError,
    alike,
    check_crc,
    crc16,
    cut,
    encode_telegram,
    parse_telegram,
    split_stream,
)

__all__ = [
    "MODES", "OVERHEAD", "REASONS", "STX", "UNITS", "Mode", "Scans", "Stream", "Telegram", "TelegramError",
    "check_crc", "crc16", "decode_scan", "decode_scans", "decode_values", "encode_scan", "encode_telegram",
    "encode_values", "encode_words", "parse_telegram", "scan_quarters", "split_stream", "value_reasons",
]  # fmt: skip

SCAN = 0xB0
METRES = {"cm": 0.01, "mm": 0.001}
UNITS = ("cm", "mm")

REASONS = (
    "valid", "not valid", "dazzled", "overflow", "noise", "channel error", "larger than maximum", "reserved",
)  # fmt: skip
BEYOND = REASONS.index("larger than maximum")
# index: how far a value is below the largest one its bits can hold
_REASON_BELOW_TOP = np.array([1, 2, 3, 7, 4, 5, 7, 7, BEYOND], np.uint8)
_BELOW_TOP = {1: 0, 2: 1, 3: 2, 4: 4, 5: 5, BEYOND: 8}


@dataclass(frozen=True)
class Mode:
    """How a measuring mode shares the 16 bits of a value.

    Attributes
    ----------
    bits : int
        Lower bits, the range.
    flags : tuple of str
        Names of the upper bits, lowest first; 'reflector' where they hold a level instead.
    """

    bits: int
    flags: tuple[str, ...]

    @property
    def top(self):
        """Largest number the range bits hold: 'not valid'."""
        return (1 << self.bits) - 1

    @property
    def largest(self):
        """Largest number that is a range; the nine above are special."""
        return self.top - 9


MODES = {
    0: Mode(13, ("field A", "field B", "dazzled")),
    1: Mode(13, ("reflector",)),
    2: Mode(13, ("field A", "field B", "field C")),
    3: Mode(14, ("reflector",)),
    4: Mode(14, ("field A", "field B")),
    5: Mode(15, ("reflector",)),
    6: Mode(15, ("field A",)),
}


@dataclass(frozen=True)
class Scans:
    """Scans of the same number of values.

    Attributes
    ----------
    rows : ndarray of int, shape (n,)
        Which of the telegrams asked for these are.
    words : ndarray of uint16, shape (n, B)
        As sent, flags included.
    ranges : ndarray, shape (n, B)
        Metres; inf where the device says larger than its maximum, NaN for all other special values.
    unit : {'cm', 'mm'}
    mode : int
    partial : ndarray of int, shape (n,)
        Quarter degrees by which an interlaced scan of 1 deg steps is turned; -1 for a whole scan.
    scan_index, telegram_index : ndarray of int, shape (n,)
        Real-time indices, modulo 256; -1 where the device does not send them.
    status : ndarray of uint8, shape (n,)
    address : ndarray of uint8, shape (n,)
    """

    rows: np.ndarray
    words: np.ndarray
    ranges: np.ndarray
    unit: str
    mode: int
    partial: np.ndarray
    scan_index: np.ndarray
    telegram_index: np.ndarray
    status: np.ndarray
    address: np.ndarray

    @property
    def reasons(self):
        """Index into `REASONS` of every value, 0 for a range; ndarray of uint8, shape (n, B)."""
        return value_reasons(self.words, self.mode)

    @property
    def flags(self):
        """Upper bits of every value, see `MODES`; ndarray of uint8, shape (n, B)."""
        return (self.words >> MODES[self.mode].bits).astype(np.uint8)


def mode_of(number):
    """The measuring mode of a number.

    Raises
    ------
    ValueError
        For modes that send no range with special values.
    """
    if number not in MODES:
        raise ValueError(f"measuring mode {number:#04x} is none of 0x00 to 0x06: set one of those (command 77)")
    return MODES[number]


def encode_values(ranges, *, unit="mm", mode=0, reasons=None, flags=0):
    """Values of a scan as a device sends them.

    Parameters
    ----------
    ranges : array_like
        Metres, rounded to the unit. Whatever is larger than the mode can hold, inf included, becomes 'larger than
        maximum'; NaN becomes 'not valid'.
    unit : {'cm', 'mm'}
    mode : int
        Measuring mode, 0 to 6.
    reasons : array_like of int, optional
        Index into `REASONS` for each value; where it is not 0 the range does not count.
    flags : array_like of int
        The upper bits.

    Returns
    -------
    ndarray of uint16
        In the shape of `ranges`.

    Raises
    ------
    ValueError
        For negative ranges, flags that the mode has no bits for, an unknown unit, mode or reason.
    """
    ranges, mode, flags = np.asarray(ranges, float), mode_of(mode), np.asarray(flags)
    if np.any(ranges < 0):
        raise ValueError(f"a range is {np.nanmin(ranges):g} m: ranges are positive, use NaN for no return")
    if np.any(flags < 0) or np.any(flags >> (16 - mode.bits)):
        raise ValueError(f"flags must be 0 to {(1 << (16 - mode.bits)) - 1} in this mode, got up to {flags.max()}")
    counts = np.rint(np.nan_to_num(ranges, nan=0, posinf=1e9) / METRES[_unit(unit)])
    words = np.where(counts > mode.largest, mode.top - _BELOW_TOP[BEYOND], counts).astype(np.uint16)
    words = np.where(np.isnan(ranges), np.uint16(mode.top), words)
    reasons = np.zeros(ranges.shape, int) if reasons is None else np.asarray(reasons)
    if unknown := set(np.unique(reasons).tolist()) - {0, *_BELOW_TOP}:
        raise ValueError(f"reasons are 1 to {BEYOND}, 0 for a range, got {sorted(unknown)}")
    for reason, below in _BELOW_TOP.items():
        words = np.where(reasons == reason, np.uint16(mode.top - below), words)
    return words | (flags.astype(np.uint16) << np.uint16(mode.bits))


def _unit(unit):
    if unit not in METRES:
        raise ValueError(f"unit is one of {', '.join(METRES)}, got {unit!r}")
    return unit


def encode_words(words, *, unit="mm", partial=-1, indices=None, status=0x10, address=DEVICE):
    """Telegram 0xB0 of values that are encoded already.

    Parameters
    ----------
    words : array_like of uint16, shape (B,)
    unit : {'cm', 'mm'}
    partial : int
        0 to 3 for the quarters of a degree of an interlaced scan, -1 for a whole scan.
    indices : tuple of int, optional
        Real-time indices: scan and telegram, modulo 256.
    status, address : int

    Returns
    -------
    bytes

    Raises
    ------
    ValueError
        For more values or another partial scan than a telegram can state.
    """
    words = np.asarray(words)
    if np.any(words < 0) or np.any(words > 0xFFFF):
        raise ValueError(f"values are 16 bits, 0 to 65535, got {words.min()} to {words.max()}")
    if words.ndim != 1 or len(words) > 401:
        raise ValueError(f"a scan has up to 401 values in one row, got shape {words.shape}")
    if partial not in (-1, 0, 1, 2, 3):
        raise ValueError(f"partial is 0 to 3, or -1 for a whole scan, got {partial}")
    count = len(words) | UNITS.index(_unit(unit)) << 14 | (0 if partial < 0 else 1 << 13 | partial << 11)
    tail = b"" if indices is None else bytes(i % 256 for i in indices)
    data = count.to_bytes(2, "little") + words.astype("<u2").tobytes() + tail
    return encode_telegram(SCAN, data, status=status, address=address)


def encode_scan(ranges, *, unit="mm", mode=0, reasons=None, flags=0, **options):
    """Telegram 0xB0 of a scan: :func:`encode_values`, then :func:`encode_words` with the other options.

    Examples
    --------
    >>> encode_scan([4.0, np.inf, np.nan], unit="cm").hex(" ")
    '02 80 0a 00 b0 03 00 90 01 f7 1f ff 1f 10 a2 f5'
    """
    return encode_words(encode_values(ranges, unit=unit, mode=mode, reasons=reasons, flags=flags), unit=unit, **options)


def decode_scan(raw, mode=0):
    """One scan out of the telegram 0xB0.

    Parameters
    ----------
    raw : bytes-like
        The whole telegram.
    mode : int
        Measuring mode, which the telegram does not tell; 0 is the factory's.

    Returns
    -------
    Scans
        With one row.

    Raises
    ------
    TelegramError
        If it is damaged, another telegram, or its number of values does not fit its length.
    """
    telegram = parse_telegram(raw)
    if telegram.code != SCAN:
        raise TelegramError(f"code {telegram.code:02X} is no scan (B0)")
    found = decode_scans(raw, np.array([0]), np.array([len(raw)]), mode)
    if not found:
        raise TelegramError(f"{len(raw)} bytes do not fit the number of values {telegram.data[:2].hex(' ') or 'none'}")
    return found[0]


def decode_scans(data, offset, length, mode=0):
    """The scans among the telegrams of a stream, many at once. CRCs are not looked at again.

    Parameters
    ----------
    data : bytes-like
    offset, length : ndarray of int, shape (n,)
        As of :func:`split_stream`.
    mode : int
        Measuring mode.

    Returns
    -------
    list of Scans
        One for each number of values, unit, and kind (whole or partial, with or without indices). Telegrams with
        another code, or with a length that does not fit the number of values, are in none of them.
    """
    mode_of(mode)
    data, length = np.frombuffer(data, np.uint8), np.asarray(length)
    rows = np.flatnonzero(length >= 10)
    rows = rows[data[offset[rows] + 4] == SCAN]
    at = offset[rows]
    word = data[at + 5] | (data[at + 6].astype(int) << 8)
    extra = length[rows] - 10 - 2 * (word & 0x3FF)
    sound = ((extra == 0) | (extra == 2)) & (word < 1 << 15)
    rows, word, extra = rows[sound], word[sound], extra[sound]
    groups = alike(word & 0xE3FF, extra)
    return [_decode_alike(data, offset, rows[g], word[g], bool(extra[g[0]]), mode) for g in groups]


def _decode_alike(data, offset, rows, word, indexed, mode):
    values, unit = int(word[0] & 0x3FF), UNITS[word[0] >> 14]
    words, ranges = np.empty((len(rows), values), np.uint16), np.empty((len(rows), values))
    for first in range(0, len(rows), CHUNK):
        some = slice(first, first + CHUNK)
        words[some] = cut(data, offset[rows[some]] + 7, 2 * values).view("<u2")
        ranges[some] = decode_values(words[some], unit=unit, mode=mode)
    last = offset[rows] + 7 + 2 * values + 2 * indexed
    scan, telegram = (data[last - k].astype(int) if indexed else np.full(len(rows), -1) for k in (2, 1))
    partial = np.where(word >> 13 & 1, word >> 11 & 3, -1)
    return Scans(rows, words, ranges, unit, mode, partial, scan, telegram, data[last], data[offset[rows] + 1])


def decode_values(words, *, unit="mm", mode=0):
    """Ranges of values as a device sends them.

    Parameters
    ----------
    words : ndarray of uint16
    unit : {'cm', 'mm'}
    mode : int

    Returns
    -------
    ndarray
        Metres; inf where larger than maximum, NaN for all other special values.
    """
    mode = mode_of(mode)
    counts = words & np.uint16(mode.top)
    ranges = counts * METRES[_unit(unit)]
    special = np.nonzero(counts > mode.largest)  # few, so they are looked up one by one
    ranges[special] = np.where(_REASON_BELOW_TOP[mode.top - counts[special]] == BEYOND, np.inf, np.nan)
    return ranges


def value_reasons(words, mode=0):
    """Why values are no ranges.

    Parameters
    ----------
    words : ndarray of uint16
    mode : int

    Returns
    -------
    ndarray of uint8
        Index into `REASONS`; 0 for a range.
    """
    mode = mode_of(mode)
    counts = words & np.uint16(mode.top)
    reasons = np.zeros(counts.shape, np.uint8)
    special = np.nonzero(counts > mode.largest)
    reasons[special] = _REASON_BELOW_TOP[mode.top - counts[special]]
    return reasons


# values of a whole scan -> first bearing and step in quarters of a degree
_GRIDS = {101: (160, 4), 201: (160, 2), 401: (160, 1), 181: (0, 4), 361: (0, 2)}


def scan_quarters(values, partial=-1):
    """Bearings of the values of a scan, in quarters of a degree.

    Parameters
    ----------
    values : int
        How many there are; tells the variant (angle and resolution) of the device.
    partial : int
        -1 for a whole scan.

    Returns
    -------
    ndarray of int, shape (values,)
        0 at the right, 360 ahead; ascending. The 100 deg variants begin at 40 deg.

    Raises
    ------
    TelegramError
        If no variant sends that many values.
    """
    if partial >= 0:
        if values != 181 - (partial > 0):
            raise TelegramError(f"partial scan {partial} has {181 - (partial > 0)} values, got {values}")
        return 4 * np.arange(values) + partial
    if values not in _GRIDS:
        known = ", ".join(map(str, sorted(_GRIDS)))
        raise TelegramError(f"a whole scan has {known} values, got {values}: only a sub-range was asked for?")
    first, step = _GRIDS[values]
    return first + step * np.arange(values)
