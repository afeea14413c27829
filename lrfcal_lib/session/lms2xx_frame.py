"""Telegrams of the SICK LMS2xx as bytes: their frame, checksum, and where they are in a stream."""

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


def encode_telegram(
    code: int, data: bytes = b"", *, status: int | None = None, address: int | None = None
) -> bytes:
    """Bytes of a telegram.

    Parameters
    ----------
    code
        Of the command or reply.
    data
        After it.
    status
        Makes it a reply.
    address
        By default 0x00 to the device, and 0x80 for replies.

    Raises
    ------
    ValueError
        For numbers that are no bytes.
    """
    if address is None:
        address = HOST if status is None else DEVICE
    body = bytes([code, *data])
    if status is not None:
        body += bytes([status])
    raw = bytes([STX, address]) + len(body).to_bytes(2, "little") + body
    return raw + crc16(raw).to_bytes(2, "little")


def parse_telegram(raw: bytes) -> Telegram:
    """The telegram in bytes from the start byte to the CRC.

    Parameters
    ----------
    raw

    Raises
    ------
    TelegramError
        If start, length or CRC is wrong.
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
    data = raw[5:-2]
    if raw[1] >= DEVICE:
        data = data[:-1]  # without the status
    return Telegram(raw[4], data)


def split_stream(data: bytes | np.ndarray, *, replies: bool = True) -> Stream:
    """Find the telegrams in a byte stream, whatever lies between them.

    Parameters
    ----------
    data
    replies
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
            if good[row]:
                free = ends[row]
    used = ends[good].max(initial=0)
    before = np.searchsorted(offset[good], offset, side="right") - 1
    inside = (before >= 0) & (offset < np.append(ends[good], 0)[before])
    begun = offset[~whole & (offset >= used)]
    tail = max(len(data) - 3, int(used))  # too few bytes to state a length
    begun = np.r_[begun, tail + np.flatnonzero(data[tail:] == STX), len(data)]
    rejected = whole & ~good & ~inside
    return Stream(offset[good], length[good], offset[rejected], int(begun[0]))


def word(data, at):
    """16-bit numbers at places in an array of bytes."""
    return data[at] | (data[at + 1].astype(int) << 8)


def check_crc(data, offset, length):
    """Which of the whole telegrams in an array of uint8 have the right CRC, shape (m,)."""
    good = np.zeros(len(offset), bool)
    for rows in alike(length):
        for first in range(0, len(rows), CHUNK):
            chunk = rows[first : first + CHUNK]
            raw = cut(data, offset[chunk], length[rows[0]])
            good[chunk] = crc16(raw[:, :-2]) == word(raw.T, -2)
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
