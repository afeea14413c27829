"""The frame of SICK LMS2xx telegrams: checksum, one telegram, a stream of them.

::

    offset 0    1        2..3   4     5..          4+LEN
           0x02 address  LEN    code  data         CRC16        all numbers little-endian
                                      ... status   in replies the last byte of the data is the status

There is no end mark and the data may hold 0x02, so a stream is cut by LEN and CRC alone (:func:`split_stream`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

STX = 0x02
HOST, DEVICE = 0x00, 0x80  # address byte of telegrams to and from a device with the factory's address
LONGEST = 812 + 2  # bytes of the longest reply, 401 values, with real-time indices
OVERHEAD = 6  # start, address, length, CRC
CHUNK = 512  # telegrams worked on at once: what fits into the cache of a processor


class TelegramError(ValueError):
    """Bytes that are no telegram, or not the telegram asked for."""


@dataclass(frozen=True)
class Telegram:
    """A telegram without its frame.

    Attributes
    ----------
    code : int
        Command, or command + 0x80 in replies.
    data : bytes
        Without code and status.
    status : int or None
        Last byte of a reply; None in telegrams to the device.
    address : int
    """

    code: int
    data: bytes = b""
    status: int | None = None
    address: int = HOST


@dataclass(frozen=True)
class Stream:
    """Where the telegrams of a byte stream are.

    Attributes
    ----------
    offset, length : ndarray of int, shape (n,)
        Of whole telegrams with the right CRC.
    code : ndarray of uint8, shape (n,)
    rejected : ndarray of int, shape (m,)
        Offsets outside of those where a telegram seems to begin whose CRC is wrong.
    skipped : int
        Bytes before `pending` that belong to no telegram.
    pending : int
        Where a telegram may begin whose end has not come yet, so that the bytes from there on must be kept; the number
        of bytes if there is none.
    """

    offset: np.ndarray
    length: np.ndarray
    code: np.ndarray
    rejected: np.ndarray
    skipped: int
    pending: int


# ------------------------------------------------------------------------------------------------------ CRC


def crc16(data):
    """The device's checksum of one byte string, or of each row of an array.

    Parameters
    ----------
    data : bytes-like, or ndarray of uint8, shape (n, L)

    Returns
    -------
    int, or ndarray of uint16, shape (n,)

    Notes
    -----
    One shift for each byte, which enters together with the byte before it: ``crc <- x crc + (b[k-1] << 8 | b[k])``
    modulo ``x^16 + x^15 + x^2 + 1`` over GF(2). That is linear, ``crc = sum_k x^(L-1-k) w_k``, so the words before the
    last h (h a power of two) are multiplied by ``x^h`` and added to those, until one word is left.
    It is weaker than other checksums of 16 bits: bit j of byte k enters as ``x^(L-1-k+j) (x^7 + 1)``, the same as bit
    j + 1 of the next byte, so two flips on such a diagonal go unseen (one in L of all pairs or so).
    """
    if not isinstance(data, np.ndarray):
        return int(crc16(np.frombuffer(data, np.uint8)[None])[0])
    if data.shape[1] == 0:
        return np.zeros(len(data), np.uint16)
    words = data.astype(np.uint16)
    words[:, 1:] |= words[:, :-1] << 8
    while (n := words.shape[1]) > 1:
        last = 1 << ((n - 1).bit_length() - 1)
        rest = words[:, n - last :].copy()
        rest[:, 2 * last - n :] ^= _times_power(last)[words[:, : n - last]]
        words = rest
    return words[:, 0]


@lru_cache
def _times_power(power):
    """Table of every 16-bit polynomial times ``x^power``, shape (65536,); for powers of two."""
    if power > 1:
        root = _times_power(power // 2)
        return root[root]
    table = np.arange(1 << 16, dtype=np.uint16)
    return (table << 1) ^ np.where(table & 0x8000, 0x8005, 0).astype(np.uint16)


# ---------------------------------------------------------------------------------------------------- frame


def encode_telegram(code, data=b"", *, status=None, address=None):
    """Bytes of a telegram.

    Parameters
    ----------
    code : int
        Command, or reply code.
    data : bytes-like
    status : int, optional
        Makes it a reply: appended to the data.
    address : int, optional
        By default 0x00 to the device, 0x80 for replies.

    Returns
    -------
    bytes

    Raises
    ------
    ValueError
        For numbers that are no bytes, or more than 65535 bytes of data.
    """
    address = address if address is not None else HOST if status is None else DEVICE
    body = bytes([_byte(code, "code")]) + bytes(data) + (b"" if status is None else bytes([_byte(status, "status")]))
    if len(body) > 0xFFFF:
        raise ValueError(f"a telegram holds up to 65535 bytes, got {len(body)}: send several")
    head = bytes([STX, _byte(address, "address")]) + len(body).to_bytes(2, "little")
    return head + body + crc16(head + body).to_bytes(2, "little")


def _byte(value, what):
    if not 0 <= value <= 0xFF:
        raise ValueError(f"{what} must be a byte, 0 to 255, got {value}")
    return int(value)


def parse_telegram(raw):
    """Take the frame off one telegram.

    Parameters
    ----------
    raw : bytes-like
        From the start byte to the CRC, nothing else.

    Returns
    -------
    Telegram

    Raises
    ------
    TelegramError
        If the start byte, the length or the CRC is wrong.
    """
    raw = bytes(raw)
    if len(raw) < OVERHEAD + 1 or raw[0] != STX:
        raise TelegramError(f"a telegram begins with 02 and has 7 or more bytes, got {raw[:8].hex(' ') or 'none'}")
    stated = int.from_bytes(raw[2:4], "little") + OVERHEAD
    if stated != len(raw):
        raise TelegramError(f"the telegram states {stated} bytes, got {len(raw)}: cut it with split_stream")
    sent, computed = int.from_bytes(raw[-2:], "little"), crc16(raw[:-2])
    if sent != computed:
        raise TelegramError(f"CRC {sent:04X} sent, {computed:04X} computed: damaged on the line, ask again")
    reply = raw[1] >= DEVICE and len(raw) > OVERHEAD + 1
    return Telegram(raw[4], raw[5:-3] if reply else raw[5:-2], raw[-3] if reply else None, raw[1])


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
    Every place that looks like a beginning is checked by its CRC; of overlapping ones the first counts. By chance one
    in 65536 of the places inside other bytes passes.
    """
    data = np.frombuffer(data, np.uint8)
    offset, length = _candidates(data, replies)
    ends = offset + length
    whole = ends <= len(data)
    good = np.zeros(len(offset), bool)
    good[whole] = check_crc(data, offset[whole], length[whole])
    good[good] = _first_of_overlapping(offset[good], ends[good])
    inside = _covered(offset, offset[good], ends[good])
    rejected = offset[whole & ~good & ~inside]
    begun = offset[~whole & (offset >= ends[good].max(initial=0))]
    pending = int(begun[0]) if len(begun) else _begun_head(data, ends[good].max(initial=0))
    skipped = pending - int(length[good].sum())
    return Stream(offset[good], length[good], data[offset[good] + 4], rejected, skipped, pending)


def _begun_head(data, used):
    """Where the last bytes, too few to state a length, may begin a telegram; the number of bytes if nowhere."""
    first = max(len(data) - 3, int(used))
    starts = np.flatnonzero(data[first:] == STX)
    return first + int(starts[0]) if len(starts) else len(data)


def _candidates(data, replies):
    """Offsets where a telegram may begin, and the lengths stated there."""
    offset = np.flatnonzero(data == STX)
    offset = offset[offset + 4 <= len(data)]
    offset = offset[(data[offset + 1] >= DEVICE) == replies]
    length = data[offset + 2] + (data[offset + 3].astype(int) << 8) + OVERHEAD
    plausible = (length > OVERHEAD) & (length <= LONGEST)
    return offset[plausible], length[plausible]


def check_crc(data, offset, length):
    """Which telegrams have the right CRC.

    Parameters
    ----------
    data : ndarray of uint8, shape (n,)
    offset, length : ndarray of int, shape (m,)
        Whole telegrams inside of `data`.

    Returns
    -------
    ndarray of bool, shape (m,)
    """
    good = np.zeros(len(offset), bool)
    for rows in alike(length):
        for first in range(0, len(rows), CHUNK):
            some = rows[first : first + CHUNK]
            raw = cut(data, offset[some], length[some[0]])
            good[some] = crc16(raw[:, :-2]) == _word(raw, -2)
    return good


def alike(*keys):
    """Rows with the same keys, each group in order."""
    if not len(keys[0]):
        return []
    _, group = np.unique(np.stack(keys), axis=1, return_inverse=True)
    order = np.argsort(group.ravel(), kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group.ravel()[order])) + 1)


def cut(data, offset, length):
    """Pieces of the same length, shape (n, length)."""
    return np.lib.stride_tricks.sliding_window_view(data, int(length))[offset]


def _word(raw, at):
    return raw[:, at].astype(np.uint16) | (raw[:, at + 1].astype(np.uint16) << 8)


def _first_of_overlapping(offset, ends):
    """Mask of the intervals that do not begin inside of one kept before."""
    if np.all(offset[1:] >= ends[:-1]):
        return np.ones(len(offset), bool)
    keep, free = np.zeros(len(offset), bool), 0
    for row, (first, last) in enumerate(zip(offset.tolist(), ends.tolist(), strict=True)):
        if first >= free:
            keep[row], free = True, last
    return keep


def _covered(points, first, last):
    """Which points lie in one of the ordered intervals [first, last)."""
    if not len(first):
        return np.zeros(len(points), bool)
    before = np.searchsorted(first, points, side="right") - 1
    return (before >= 0) & (points < last[before])
