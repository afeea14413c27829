"""Telegrams of the SICK LMS2xx as bytes: their frame, checksum, and where they are in a stream."""

from dataclasses import dataclass

import numpy as np

STX = 0x02
# address bytes of telegrams to and from a device with the address of the factory
HOST = 0x00
DEVICE = 0x80
LONGEST = 812 + 2  # bytes of the longest reply, 401 values, with real-time indices
OVERHEAD = 6  # start, address, length, CRC
MANY = 20  # telegrams whose checksums are sooner computed side by side than one by one


class TelegramError(ValueError):
    """Bytes that are no telegram, or not the telegram asked for."""


@dataclass(frozen=True)
class Stream:
    """Where the telegrams of a byte stream are.

    Attributes
    ----------
    offset, length : ndarray, shape (n,)
        Of whole telegrams with the right CRC.
    rejected : ndarray of int
        Offsets behind the last of those where a telegram seems to begin whose CRC is wrong.
    pending : int
        Where a telegram may begin whose end has not come yet (the bytes from there on must be
        kept), or the end.
    """

    offset: np.ndarray
    length: np.ndarray
    rejected: np.ndarray
    pending: int


def crc16(data):
    """The device's checksum of a byte string, or of many in the columns of an array of uint16.

    Notes
    -----
    One shift for each byte, which enters together with the byte before it: ``crc <- x crc + (b[k-1]
    << 8 | b[k])`` modulo ``x^16 + x^15 + x^2 + 1`` over GF(2). It is weaker than other checksums of
    16 bits: bit j of byte k enters as ``x^(L-1-k+j) (x^7 + 1)``, the same as bit j + 1 of the next
    byte, so two flips on such a diagonal go unseen (one in L of all pairs or so).
    """
    crc = 0
    before = 0
    for byte in data:
        crc = (crc << 1 & 0xFFFF) ^ (crc >> 15) * 0x8005 ^ (before << 8) ^ byte
        before = byte
    return crc


def encode_telegram(
    code: int, data: bytes = b"", *, status: int = 0x10, address: int = HOST
) -> bytes:
    """Bytes of a telegram.

    Parameters
    ----------
    code
        Of the command or reply.
    data
        After it.
    status
        Of a reply; a request has none.
    address
        Of the device; 0x80 and above, as of `DEVICE`, make it a reply.

    Raises
    ------
    ValueError
        For numbers that are no bytes.
    """
    body = bytes([code, *data])
    if address >= DEVICE:
        body += bytes([status])
    raw = bytes([STX, address]) + len(body).to_bytes(2, "little") + body
    return raw + crc16(raw).to_bytes(2, "little")


def split_stream(data: bytes, *, replies: bool = True) -> Stream:
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
    raw = np.frombuffer(data, np.uint8)
    offset = np.flatnonzero(raw[:-3] == STX)
    offset = offset[(raw[offset + 1] >= DEVICE) == replies]
    length = word(raw, offset + 2) + OVERHEAD
    plausible = (length > OVERHEAD) & (length <= LONGEST)
    offset = offset[plausible]
    length = length[plausible]
    end = offset + length
    sound = []
    free = 0  # behind the last sound telegram
    for row in np.flatnonzero(are_sound(raw, offset, length)):
        if offset[row] >= free:
            sound.append(row)
            free = end[row]
    rejected = offset[(offset >= free) & (end <= len(data))]
    begun = offset[(offset >= free) & (end > len(data))]
    # too few bytes to state a length
    last = data.find(STX, max(free, len(data) - 3))
    pending = min([*begun, last if last >= 0 else len(data)])
    return Stream(offset[sound], length[sound], rejected, pending)


def word(data, at):
    """16-bit numbers at places in an array of bytes."""
    return data[at] | (data[at + 1].astype(int) << 8)


def are_sound(data, offset, length):
    """Which telegrams in an array of uint8 are whole, as long as they state, and have the right
    CRC, shape (m,).
    """
    sound = np.zeros(len(offset), bool)
    whole = offset + length <= len(data)
    for size in np.unique(length[whole]):
        rows = np.flatnonzero(whole & (length == size))
        raw = cut(data, offset[rows], size)
        if len(rows) < MANY:
            sums = [crc16(bytes(one)) for one in raw[:, :-2]]
        else:
            sums = crc16(raw[:, :-2].T.astype(np.uint16, order="C"))
        framed = (raw[:, 0] == STX) & (word(raw.T, 2) + OVERHEAD == size)
        sound[rows] = framed & (sums == word(raw.T, -2))
    return sound


def cut(data, offset, length):
    """Pieces of the same length, shape (n, length)."""
    return np.lib.stride_tricks.sliding_window_view(data, length)[offset]
