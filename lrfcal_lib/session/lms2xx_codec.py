"""Telegrams of the SICK LMS2xx: bytes to values and back, without a port."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

STX = 0x02
# address bytes of telegrams to and from a device with the address of the factory
HOST = 0x00
DEVICE = 0x80
LONGEST = 812 + 2  # bytes of the longest reply, 401 values, with real-time indices
OVERHEAD = 6  # start, address, length, CRC
CHUNK = 512  # telegrams worked on at once: what fits into the cache of a processor


class TelegramError(ValueError):
    """Bytes that are no telegram, or not the telegram asked for."""


@dataclass(frozen=True)
class Telegram:
    """A telegram without its frame.

    `code` is the command, or command + 0x80 in replies; `data` without code and status.
    """

    code: int
    data: bytes


@dataclass(frozen=True)
class Stream:
    """Where the telegrams of a byte stream are.

    Attributes
    ----------
    offset, length : ndarray, shape (n,)
        Of whole telegrams with the right CRC.
    rejected : ndarray of int, shape (m,)
        Offsets outside of those where a telegram seems to begin whose CRC is wrong.
    pending : int
        Where a telegram may begin whose end has not come yet (the bytes from there on must be
        kept), or the end.
    """

    offset: np.ndarray
    length: np.ndarray
    rejected: np.ndarray
    pending: int


def crc16(data):
    """The device's checksum of one byte string (int), or of each row of an array of uint8, shape
    (n, L).

    Notes
    -----
    One shift for each byte, which enters together with the byte before it: ``crc <- x crc + (b[k-1]
    << 8 | b[k])`` modulo ``x^16 + x^15 + x^2 + 1`` over GF(2). That is linear, ``crc = sum_k
    x^(L-1-k) w_k``, so the words before the last h (h a power of two) are multiplied by ``x^h`` and
    added to those, until one word is left. It is weaker than other checksums of 16 bits: bit j of
    byte k enters as ``x^(L-1-k+j) (x^7 + 1)``, the same as bit j + 1 of the next byte, so two flips
    on such a diagonal go unseen (one in L of all pairs or so).
    """
    if not isinstance(data, np.ndarray):
        return int(crc16(np.frombuffer(data, np.uint8)[None])[0])
    if data.shape[1] == 0:
        return np.zeros(len(data), np.uint16)
    # zeros in front change nothing
    raw = np.zeros((len(data), 1 + data.shape[1] + data.shape[1] % 2), np.uint8)
    raw[:, raw.shape[1] - data.shape[1] :] = data
    high, low = (
        np.ascontiguousarray(part).view(">u2").astype(np.uint16)
        for part in (raw[:, :-1], raw[:, 1:])
    )
    # neighbours, by shifts: twice as fast
    words = high << 1 ^ (high >> 15) * np.uint16(0x8005) ^ low
    while (n := words.shape[1]) > 1:
        last = 1 << ((n - 1).bit_length() - 1)
        rest = words[:, n - last :].copy()
        rest[:, 2 * last - n :] ^= times_power(2 * last)[words[:, : n - last]]
        words = rest
    return words[:, 0]


@lru_cache
def times_power(power):
    """Table of every 16-bit polynomial times ``x^power``, shape (65536,); for powers of two."""
    if power > 1:
        root = times_power(power // 2)
        return root[root]
    table = np.arange(1 << 16, dtype=np.uint16)
    return (table << 1) ^ np.where(table & 0x8000, 0x8005, 0).astype(np.uint16)


def encode_telegram(code, data=b"", *, status=None, address=None):
    """Bytes of a telegram; `status` makes it a reply, addresses are 0x00 to the device and 0x80 for
    replies by default.

    ValueError for numbers that are no bytes.
    """
    address = (HOST if status is None else DEVICE) if address is None else address
    body = bytes([code]) + bytes(data) + (b"" if status is None else bytes([status]))
    raw = bytes([STX, address]) + len(body).to_bytes(2, "little") + body
    return raw + crc16(raw).to_bytes(2, "little")


def parse_telegram(raw):
    """The Telegram in bytes from the start byte to the CRC; TelegramError if start, length or CRC
    is wrong.
    """
    raw = bytes(raw)
    if len(raw) < OVERHEAD + 1 or raw[0] != STX:
        raise TelegramError(
            f"a telegram begins with 02 and has 7 or more bytes, got {raw[:8].hex(' ') or 'none'}"
        )
    stated = int.from_bytes(raw[2:4], "little") + OVERHEAD
    if stated != len(raw):
        raise TelegramError(
            f"the telegram states {stated} bytes, got {len(raw)}: cut it with split_stream"
        )
    sent = int.from_bytes(raw[-2:], "little")
    computed = crc16(raw[:-2])
    if sent != computed:
        raise TelegramError(
            f"CRC {sent:04X} sent, {computed:04X} computed: damaged on the line, ask again"
        )
    reply = raw[1] >= DEVICE and len(raw) > OVERHEAD + 1
    return Telegram(raw[4], raw[5:-3] if reply else raw[5:-2])


def split_stream(data, *, replies=True):
    """Find the telegrams in a byte stream, whatever lies between them.

    Parameters
    ----------
    data : bytes-like
    replies : bool
        Only what devices send (address byte 0x80 and above); otherwise only what hosts send.

    Returns
    -------
    Stream

    Notes
    -----
    Every place that looks like a beginning is checked by its CRC; of overlapping ones the first
    counts. By chance one in 65536 of the places inside other bytes passes.
    """
    data = np.frombuffer(data, np.uint8)
    offset = np.flatnonzero(data[: max(len(data) - 3, 0)] == STX)
    offset = offset[(data[offset + 1] >= DEVICE) == replies]
    length = word(data, offset + 2) + OVERHEAD
    plausible = (length > OVERHEAD) & (length <= LONGEST)
    offset = offset[plausible]
    length = length[plausible]
    ends = offset + length
    whole = ends <= len(data)
    good = np.zeros(len(offset), bool)
    good[whole] = check_crc(data, offset[whole], length[whole])
    if np.any(offset[good][1:] < ends[good][:-1]):  # seldom
        free = 0
        for row in np.flatnonzero(good):
            good[row] = offset[row] >= free
            free = ends[row] if good[row] else free
    used = ends[good].max(initial=0)
    before = np.searchsorted(offset[good], offset, side="right") - 1
    inside = (before >= 0) & (offset < np.append(ends[good], 0)[before])
    begun = offset[~whole & (offset >= used)]
    tail = max(len(data) - 3, int(used))  # too few bytes to state a length
    begun = [*begun.tolist(), *(tail + np.flatnonzero(data[tail:] == STX)).tolist(), len(data)][0]
    return Stream(offset[good], length[good], offset[whole & ~good & ~inside], begun)


def word(data, at):
    """16-bit numbers at places in an array of bytes."""
    return data[at] | (data[at + 1].astype(int) << 8)


def check_crc(data, offset, length):
    """Which of the whole telegrams in an array of uint8 have the right CRC, shape (m,)."""
    good = np.zeros(len(offset), bool)
    for rows in alike(length):
        for first in range(0, len(rows), CHUNK):
            some = rows[first : first + CHUNK]
            raw = cut(data, offset[some], length[some[0]])
            good[some] = crc16(raw[:, :-2]) == word(data, offset[some] + length[some[0]] - 2)
    return good


def alike(*keys):
    """Rows with the same keys, each group in order."""
    if not len(keys[0]):
        return []
    if all((key == key[0]).all() for key in keys):
        return [np.arange(len(keys[0]))]
    _, group = np.unique(np.stack(keys), axis=1, return_inverse=True)
    order = np.argsort(group.ravel(), kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group.ravel()[order])) + 1)


def cut(data, offset, length):
    """Pieces of the same length, shape (n, length)."""
    return np.lib.stride_tricks.sliding_window_view(data, int(length))[offset]


SCAN = 0xB0
METRES = {"cm": 0.01, "mm": 0.001}
UNITS = ("cm", "mm")
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
# index: how far a value is below the largest one its bits can hold
REASON_BELOW_TOP = np.array([1, 2, 3, 7, 4, 5, 7, 7, BEYOND], np.uint8)
# the other way
BELOW_TOP = np.array([np.argmax(REASON_BELOW_TOP == reason) for reason in range(1 + BEYOND)])


@dataclass(frozen=True)
class Mode:
    """How a measuring mode shares the 16 bits of a value: the lower `bits` are the range, the upper
    ones flags.
    """

    bits: int

    @property
    def top(self):
        """Largest number the range bits hold: 'not valid'."""
        return (1 << self.bits) - 1

    @property
    def largest(self):
        """Largest number that is a range; the nine above are special."""
        return self.top - 9


# flags of modes 0, 2, 4 and 6: hits of the fields A, B and C (0: A, B, dazzled); of the others:
# level of a reflector
MODES = dict(enumerate(map(Mode, (13, 13, 13, 14, 14, 15, 15))))


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
    partial : ndarray of int, shape (n,)
        Quarter degrees by which an interlaced scan of 1 deg steps is turned; -1 for a whole scan.
    scan_index, telegram_index : ndarray of int, shape (n,)
        Real-time indices, modulo 256; -1 where the device does not send them.
    """

    rows: np.ndarray
    words: np.ndarray
    ranges: np.ndarray
    unit: str
    mode: int
    partial: np.ndarray
    scan_index: np.ndarray
    telegram_index: np.ndarray

    @property
    def reasons(self):
        """Index into `REASONS` of every value, 0 for a range; ndarray of uint8, shape (n, B)."""
        reasons = np.zeros(self.words.shape, np.uint8)
        special, reasons[special] = special_values(self.words, self.mode)
        return reasons


def special_values(words, mode):
    """Where values are no ranges, and why; they are few."""
    mode = MODES[mode]
    counts = words & np.uint16(mode.top)
    # ten times as fast as nonzero
    special = np.unravel_index(np.flatnonzero(counts > mode.largest), counts.shape)
    return special, REASON_BELOW_TOP[mode.top - counts[special]]


def encode_values(ranges, *, unit="mm", mode=0, reasons=None):
    """Values of a scan as a device sends them, without flags, ndarray of uint16.

    Parameters
    ----------
    ranges : array_like
        Metres, rounded to the unit. Whatever is larger than the mode can hold, inf included,
        becomes 'larger than maximum'; NaN becomes 'not valid'.
    unit : {'cm', 'mm'}
    mode : int
        Measuring mode, 0 to 6.
    reasons : array_like of int, optional
        Index into `REASONS` for each value; where it is not 0 the range does not count.
    """
    ranges = np.asarray(ranges, float)
    mode = MODES[mode]
    reasons = np.zeros(ranges.shape, int) if reasons is None else np.asarray(reasons, int)
    counts = np.rint(np.nan_to_num(ranges, nan=0, posinf=1e9) / METRES[unit])
    reasons = np.where(
        reasons > 0, reasons, np.where(np.isnan(ranges), 1, BEYOND * (counts > mode.largest))
    )
    return np.where(reasons > 0, mode.top - BELOW_TOP[reasons], counts).astype(np.uint16)


def encode_words(
    words, *, unit="mm", partial=-1, indices=None, status=0x10, address=DEVICE, code=SCAN, head=b""
):
    """Telegram 0xB0 of values that are encoded already, or one of another code, with bytes before
    the values.

    Parameters
    ----------
    words : array_like of uint16, shape (B,) or (B, 2)
    unit : {'cm', 'mm'}
    partial : int
        0 to 3 for the quarters of a degree of an interlaced scan, -1 for a whole scan.
    indices : tuple of int, optional
        Real-time indices: scan and telegram, modulo 256.
    """
    count = len(words) | UNITS.index(unit) << 14 | (0 if partial < 0 else 1 << 13 | partial << 11)
    tail = b"" if indices is None else bytes(i % 256 for i in indices)
    data = head + count.to_bytes(2, "little") + np.asarray(words, "<u2").tobytes() + tail
    return encode_telegram(code, data, status=status, address=address)


def decode_scan(raw, mode=0):
    """One scan out of the whole telegram 0xB0, Scans with one row, in a measuring mode that the
    telegram does not tell.

    TelegramError if it is damaged, another telegram, or its number of values does not fit its
    length.
    """
    telegram = parse_telegram(raw)
    if telegram.code != SCAN:
        raise TelegramError(f"code {telegram.code:02X} is no scan (B0)")
    found = decode_scans(raw, np.array([0]), np.array([len(raw)]), mode)
    if not found:
        raise TelegramError(
            f"{len(raw)} bytes do not fit the number of values "
            f"{telegram.data[:2].hex(' ') or 'none'}"
        )
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
        One for each number of values, unit, and kind (whole or partial, with or without indices).
        Telegrams with another code, or with a length that does not fit the number of values, are in
        none of them.
    """
    if mode not in MODES:  # others send no range with special values
        raise ValueError(
            f"measuring mode {mode:#04x} is none of 0x00 to 0x06: set one of those (command 77)"
        )
    data = np.frombuffer(data, np.uint8)
    length = np.asarray(length)
    rows = np.flatnonzero(length >= 10)
    rows = rows[data[offset[rows] + 4] == SCAN]
    head = word(data, offset[rows] + 5)
    extra = length[rows] - 10 - 2 * (head & 0x3FF)
    sound = np.isin(extra, (0, 2)) & (head < 1 << 15)
    rows = rows[sound]
    head = head[sound]
    extra = extra[sound]
    out = []
    for group in alike(head & 0xE3FF, extra):
        at = offset[rows[group]]
        head_of = head[group]
        indexed = extra[group[0]] > 0
        values = int(head_of[0] & 0x3FF)
        unit = UNITS[head_of[0] >> 14]
        words = np.empty((len(at), values), np.uint16)
        ranges = np.empty((len(at), values))
        for first in range(0, len(at), CHUNK):
            some = slice(first, first + CHUNK)
            words[some] = cut(data, at[some] + 7, 2 * values).view("<u2")
            np.multiply(words[some] & np.uint16(MODES[mode].top), METRES[unit], out=ranges[some])
            special, reasons = special_values(words[some], mode)
            ranges[some][special] = np.where(reasons == BEYOND, np.inf, np.nan)
        last = at + 7 + 2 * values + 2 * indexed
        indices = (data[last - k].astype(int) if indexed else np.full(len(at), -1) for k in (2, 1))
        partial = np.where(head_of >> 13 & 1, head_of >> 11 & 3, -1)
        out.append(Scans(rows[group], words, ranges, unit, mode, partial, *indices))
    return out


# values of a whole scan -> first bearing and step in quarters of a degree
GRIDS = {101: (160, 4), 201: (160, 2), 401: (160, 1), 181: (0, 4), 361: (0, 2)}


def scan_quarters(values, partial=-1):
    """Bearings of the values of a scan in quarters of a degree, shape (values,): 0 at the right,
    360 ahead; ascending.

    The number of values tells the variant (angle and resolution) of the device. TelegramError if
    none sends that many.
    """
    if partial >= 0 and values != 181 - (partial > 0):
        raise TelegramError(
            f"partial scan {partial} has {181 - (partial > 0)} values, got {values}"
        )
    if partial < 0 and values not in GRIDS:
        known = ", ".join(map(str, sorted(GRIDS)))
        raise TelegramError(
            f"a whole scan has {known} values, got {values}: only a sub-range was asked for?"
        )
    first, step = GRIDS[values] if partial < 0 else (partial, 4)
    return first + step * np.arange(values)


STATUS = 0xB1
TYPE = 0xBA
VARIANT = 0xBB
CONFIGURATION = 0xF4
CONFIGURED = 0xF7
CONFIGURATION_BYTES = 34


def whole(raw):
    """Bytes as a number, the least first."""
    return int.from_bytes(raw, "little")


def text(raw):
    """Bytes as text."""
    return raw.decode("ascii", "replace").strip(" \0")


def unit_of(raw):
    """'cm' or 'mm'."""
    if raw[0] >= len(UNITS):
        raise TelegramError(
            f"unit {raw[0]} is neither 0 (cm) nor 1 (mm): set one of those (block E, command 77)"
        )
    return UNITS[raw[0]]


@dataclass(frozen=True)
class DeviceStatus:
    """The parts of the status reply 0xB1 that a recording needs."""

    firmware: str
    measuring_mode: int
    scan_angle_deg: float
    resolution_deg: float
    address: int
    unit: str


@dataclass(frozen=True)
class Configuration:
    """The 34 bytes of configuration part 1 (0xF4, 0xF7, 0x77); older firmware sends fewer."""

    block: bytes = bytes(9) + b"\x02\x02" + bytes(21) + b"\x02\x00"

    @property
    def realtime_indices(self):
        """Whether scans carry their indices."""
        return bool(self.block[4] & 2)

    @property
    def measuring_mode(self):
        """Key of `MODES`."""
        return self.block[5]

    @property
    def unit(self):
        """'cm' or 'mm'."""
        return unit_of(self.block[6:])

    def changed(self, *, measuring_mode=None, unit=None, realtime_indices=None):
        """The same Configuration with other values; what is None stays."""
        block = bytearray(self.block)
        if realtime_indices is not None:
            block[4] = block[4] & ~2 | 2 * bool(realtime_indices)
        block[5] = block[5] if measuring_mode is None else measuring_mode
        block[6] = block[6] if unit is None else UNITS.index(unit)
        return Configuration(bytes(block))


def encode_configuration(configuration):
    """Reply 0xF4, as a device sends it; a recorded session begins with it (it states the measuring
    mode).
    """
    return encode_telegram(CONFIGURATION, configuration.block, status=0x10)


def reply_data(raw, code, shortest):
    """Data of a reply that must have a code and a least number of bytes; TelegramError
    otherwise.
    """
    telegram = parse_telegram(raw)
    if telegram.code != code:
        raise TelegramError(f"code {telegram.code:02X} is not the reply {code:02X} asked for")
    if len(telegram.data) < shortest:
        raise TelegramError(
            f"reply {code:02X} has {len(telegram.data)} bytes of data, needs {shortest}"
        )
    return telegram.data


def parse_status(raw):
    """DeviceStatus of the whole telegram 0xB1; TelegramError if it is damaged, another reply, or
    too short.
    """
    # counted as in the manual, which calls the code 0
    data = bytes([STATUS]) + reply_data(raw, STATUS, 123)
    return DeviceStatus(
        firmware=text(data[1:8]),
        measuring_mode=data[102],
        scan_angle_deg=float(whole(data[107:109])),
        resolution_deg=whole(data[109:111]) / 100,
        address=data[120],
        unit=unit_of(data[122:]),
    )


def parse_type(raw):
    """Model, order number and firmware out of the type reply 0xBA, such as ('LMS200', '301063',
    'V02.10').
    """
    return tuple(part.strip() for part in text(reply_data(raw, TYPE, 1)).split(";"))


def parse_configuration(raw):
    """Configuration out of the replies 0xF4 (read) or 0xF7 (written).

    TelegramError if it is damaged, another reply, or shorter than the measuring mode and the unit
    need.
    """
    written = bytes(raw[4:5]) == bytes([CONFIGURED])
    return Configuration(
        reply_data(raw, CONFIGURED, 8)[1:] if written else reply_data(raw, CONFIGURATION, 7)
    )
