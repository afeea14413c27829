"""Telegrams of the SICK LMS2xx: bytes to values and back, without a port."""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lrfcal_lib.session.files import check_amount, short
from lrfcal_lib.session.lms2xx_frame import (
    DEVICE,
    TelegramError,
    cut,
    encode_telegram,
    word,
)

SCAN = 0xB0
METRES = {"cm": 0.01, "mm": 0.001}
UNITS = tuple(METRES)
REASONS = (
    "valid",
    "not valid",
    "dazzled",
    "overflow",
    "noise",
    "channel error",
    "larger than maximum",
    "reserved",
)
BEYOND = REASONS.index("larger than maximum")
# by how far a value is below the largest one its bits can hold; nine and more are ranges
REASON_BELOW_TOP = np.array([1, 2, 3, 7, 4, 5, 7, 7, BEYOND, 0], np.uint8)
# Largest number that the range bits of a value hold, by measuring mode. The bits above are flags:
# in modes 0, 2, 4 and 6 hits of the fields A, B and C (0: A, B, dazzled), in the others the level
# of a reflector.
TOP = dict(enumerate((0x1FFF, 0x1FFF, 0x1FFF, 0x3FFF, 0x3FFF, 0x7FFF, 0x7FFF)))


def largest(mode: int) -> int:
    """The largest number that is a range in a measuring mode; the nine above are special.

    Parameters
    ----------
    mode
        Key of `TOP`.
    """
    return TOP[mode] - len(REASON_BELOW_TOP) + 1


@dataclass(frozen=True)
class Scans:
    """Scans, each with B values: those of the longest; behind the others stand zeros.

    Attributes
    ----------
    rows : ndarray of int, shape (n,)
        Which of the telegrams asked for these are.
    count : ndarray of int, shape (n,)
        Values of each.
    words : ndarray of uint16, shape (n, B)
        As sent, flags included.
    ranges : ndarray, shape (n, B)
        Metres; inf where the device says larger than its maximum, NaN for all other special values.
    reasons : ndarray of uint8, shape (n, B)
        Index into `REASONS` of every value, 0 for a range.
    unit : ndarray of int, shape (n,)
        Index into `UNITS`.
    partial : ndarray of int, shape (n,)
        Quarter degrees by which an interlaced scan of 1 deg steps is turned; -1 for a whole scan.
    scan_index, telegram_index : ndarray of int, shape (n,)
        Real-time indices, modulo 256; -1 where the device does not send them.
    """

    rows: np.ndarray
    count: np.ndarray
    words: np.ndarray
    ranges: np.ndarray
    reasons: np.ndarray
    unit: np.ndarray
    partial: np.ndarray
    scan_index: np.ndarray
    telegram_index: np.ndarray


def encode_values(
    ranges: ArrayLike, *, unit: str = "mm", mode: int = 0, reasons: ArrayLike = 0
) -> np.ndarray:
    """Values of a scan as a device sends them, without flags.

    Parameters
    ----------
    ranges
        Metres, rounded to the unit. Whatever is larger than the mode can hold, inf included,
        becomes 'larger than maximum'; NaN becomes 'not valid'.
    unit
        'cm' or 'mm'.
    mode
        Measuring mode, 0 to 6.
    reasons
        Index into `REASONS` for each value; where it is not 0 the range does not count.

    Returns
    -------
    ndarray of uint16
        Of the shape of the ranges.
    """
    counts = np.rint(np.asarray(ranges, float) / METRES[unit])
    why = np.where(counts > largest(mode), BEYOND, 0)
    why[np.isnan(counts)] = REASONS.index("not valid")
    why = np.where(reasons, reasons, why)
    # of reasons that have several values the first
    below = np.argmax(REASON_BELOW_TOP == why[..., None], axis=-1)
    return np.where(why, TOP[mode] - below, counts).astype(np.uint16)


def encode_words(
    words: ArrayLike,
    *,
    unit: str = "mm",
    partial: int = -1,
    indices: tuple[int, int] | None = None,
    status: int = 0x10,
    address: int = DEVICE,
    code: int = SCAN,
    head: bytes = b"",
) -> bytes:
    """Telegram 0xB0 of values that are encoded already, or one like it.

    Parameters
    ----------
    words
        Of uint16, shape (B,) or (B, 2).
    unit
        'cm' or 'mm'.
    partial
        0 to 3 for the quarters of a degree of an interlaced scan, -1 for a whole scan.
    indices
        Real-time indices: scan and telegram, modulo 256.
    status, address, code
        Of the telegram.
    head
        Before the values.
    """
    values = np.asarray(words, "<u2")
    count = len(values) | UNITS.index(unit) << 14
    if partial >= 0:
        count |= 1 << 13 | partial << 11
    data = head + count.to_bytes(2, "little") + values.tobytes()
    data += bytes(i % 256 for i in indices or ())
    return encode_telegram(code, data, status=status, address=address)


def decode_scans(
    data: bytes | np.ndarray,
    offset: np.ndarray,
    length: np.ndarray,
    mode: ArrayLike,
) -> Scans:
    """The scans among the telegrams of a stream, many at once. CRCs are not looked at again.

    Parameters
    ----------
    data
    offset, length
        As of :func:`split_stream`.
    mode
        Measuring mode, of all or of each; the telegrams do not tell it.

    Returns
    -------
    Scans
        Without telegrams of another code, or of a length that does not fit the number of values.
    """
    modes = np.broadcast_to(mode, len(offset))
    for other in set(modes.tolist()) - TOP.keys():  # sends no range with special values
        raise ValueError(
            f"measuring mode {other:#04x} is none of 0x00 to 0x06: set one of those (command 77)"
        )
    data = np.frombuffer(data, np.uint8)
    rows = np.flatnonzero(length >= 10)
    rows = rows[data[offset[rows] + 4] == SCAN]
    heads = word(data, offset[rows] + 5)
    count = heads & 0x3FF
    extra = length[rows] - 10 - 2 * count  # bytes of indices
    fits = np.isin(extra, (0, 2)) & (heads < 1 << 15)
    rows, heads, count, extra = np.stack([rows, heads, count, extra])[:, fits]
    begin = offset[rows] + 7
    most = count.max(initial=0)
    check_amount(len(rows) * most)
    words = np.zeros((len(rows), most), np.uint16)
    for size in np.unique(count):
        same = count == size
        words[same, :size] = cut(data, begin[same], 2 * size).view("<u2")
    top = np.array([*TOP.values()], np.uint16)[modes[rows], None]
    counts = words & top
    below = (top - counts).ravel()
    special = np.flatnonzero(below < len(REASON_BELOW_TOP))  # few
    reasons = np.zeros(counts.shape, np.uint8)
    reasons.flat[special] = REASON_BELOW_TOP[below[special]]
    unit = heads >> 14
    ranges = counts * np.array([*METRES.values()])[unit, None]
    ranges[reasons > 0] = np.nan
    ranges[reasons == BEYOND] = np.inf
    partial = np.where(heads >> 13 & 1, heads >> 11 & 3, -1)
    behind = word(data, begin + 2 * count)
    indices = np.where(extra, [behind & 0xFF, behind >> 8], -1)
    return Scans(rows, count, words, ranges, reasons, unit, partial, *indices)


# field of view and step of whole scans, deg
VARIANTS = ((100, 1.0), (100, 0.5), (100, 0.25), (180, 1.0), (180, 0.5))
# number of values -> first bearing in quarters of a degree
GRIDS = {round(view / step) + 1: 2 * (180 - view) for view, step in VARIANTS}


def scan_quarters(values: int, partial: int = -1) -> np.ndarray:
    """Bearings of the values of a scan in quarters of a degree: 0 right, 360 ahead, ascending.

    The number of values tells the variant (angle and resolution) of the device.

    Parameters
    ----------
    values
        Their number.
    partial
        0 to 3 of an interlaced scan, -1 for a whole scan.

    Returns
    -------
    ndarray of int, shape (values,)

    Raises
    ------
    TelegramError
        If no variant sends that many.
    """
    if partial < 0:
        if values not in GRIDS:
            raise TelegramError(
                f"a whole scan has {short(sorted(GRIDS))} values, got {values}: only a sub-range "
                "was asked for?"
            )
        first = GRIDS[values]
        return np.linspace(first, 720 - first, values, dtype=int)
    quarters = np.arange(partial, 721, 4)
    if len(quarters) != values:
        raise TelegramError(
            f"partial scan {partial} has {len(quarters)} values, got {values}"
        )
    return quarters


STATUS = 0xB1
CONFIGURATION = 0xF4
CONFIGURED = 0xF7


@dataclass(frozen=True)
class DeviceStatus:
    """The parts of the status reply 0xB1 that a recording needs."""

    measuring_mode: int
    variant: tuple[float, float]  # field of view and resolution, degrees
    address: int


@dataclass(frozen=True)
class Configuration:
    """The 34 bytes of configuration part 1 (0xF4, 0xF7, 0x77); older firmware sends fewer.

    TelegramError for a unit that no manual lists.
    """

    block: bytes = bytes(9) + b"\x02\x02" + bytes(21) + b"\x02\x00"

    def __post_init__(self):
        unit = self.block[6]
        if unit >= len(UNITS):
            raise TelegramError(
                f"unit {unit} is neither 0 (cm) nor 1 (mm): set one of those (block E, command 77)"
            )

    @property
    def realtime_indices(self):
        """Whether scans carry their indices."""
        return bool(self.block[4] & 2)

    @property
    def measuring_mode(self):
        """Key of `TOP`."""
        return self.block[5]

    @property
    def unit(self):
        """'cm' or 'mm'."""
        return UNITS[self.block[6]]

    def changed(
        self,
        *,
        measuring_mode: int | None = None,
        unit: str | None = None,
        realtime_indices: bool | None = None,
    ) -> "Configuration":
        """The same Configuration with other values; what is None stays.

        Parameters
        ----------
        measuring_mode
            Key of `TOP`.
        unit
            'cm' or 'mm'.
        realtime_indices
            Whether scans carry their indices.
        """
        block = bytearray(self.block)
        if realtime_indices is not None:
            block[4] = block[4] & ~2 | 2 * realtime_indices
        if measuring_mode is not None:
            block[5] = measuring_mode
        if unit is not None:
            block[6] = UNITS.index(unit)
        return Configuration(bytes(block))


def encode_configuration(configuration: Configuration) -> bytes:
    """Reply 0xF4, as a device sends it; a recorded session begins with it (it states the measuring
    mode).
    """
    return encode_telegram(CONFIGURATION, configuration.block, address=DEVICE)


def reply_data(raw, shortest):
    """Data of a reply that must have a least number of bytes; TelegramError otherwise."""
    data = raw[5:-3]
    if len(data) < shortest:
        raise TelegramError(
            f"reply {raw[4]:02X} has {len(data)} bytes of data, needs {shortest}"
        )
    return data


def parse_status(raw: bytes) -> DeviceStatus:
    """What the telegram 0xB1 says.

    Parameters
    ----------
    raw
        Sound, with its frame.

    Raises
    ------
    TelegramError
        If it is too short.
    """
    # in the manual, which calls the code 0, the bytes 102, 107 to 110, and 120
    data = reply_data(raw, 123)
    mode, view, step, address = struct.unpack_from("<101x B 4x 2H 9x B", data)
    return DeviceStatus(mode, (float(view), step / 100), address)


def parse_type(raw: bytes) -> tuple[str, ...]:
    """Model, order number and firmware out of the type reply 0xBA.

    Parameters
    ----------
    raw
        As for :func:`parse_status`.

    Returns
    -------
    tuple of str
        Such as ('LMS200', '301063', 'V02.10').
    """
    text = reply_data(raw, 1).decode("ascii", "replace").strip(" \0")
    return tuple(map(str.strip, text.split(";")))


def parse_configuration(raw: bytes) -> Configuration:
    """Configuration out of the replies 0xF4 (read) or 0xF7 (written).

    Parameters
    ----------
    raw
        As for :func:`parse_status`.

    Raises
    ------
    TelegramError
        If it is shorter than the measuring mode and the unit need, or of a unit that there is not.
    """
    if raw[4] == CONFIGURED:
        return Configuration(reply_data(raw, 8)[1:])
    return Configuration(reply_data(raw, 7))


STATE_MODE = {  # by code, how to read the replies that do
    CONFIGURATION: parse_configuration,
    CONFIGURED: parse_configuration,
    STATUS: parse_status,
}
