"""Telegrams, for tests."""

from typing import NamedTuple

import numpy as np

from lrfcal_lib.session.lms2xx_codec import decode_scans, encode_values, encode_words
from lrfcal_lib.session.lms2xx_frame import DEVICE, TelegramError, split_stream


class Telegram(NamedTuple):
    """A telegram without its frame, and its data without the status."""

    code: int
    data: bytes


def parse_telegram(raw):
    """The Telegram in bytes from the start byte to the CRC; TelegramError where they are none or damaged."""
    reply = raw[1:2] >= bytes([DEVICE])
    if split_stream(raw, replies=reply).length.tolist() != [len(raw)]:
        raise TelegramError("no telegram, or a damaged one")
    return Telegram(raw[4], raw[5:-3] if reply else raw[5:-2])


def encode_scan(ranges, *, unit="mm", mode=0, reasons=None, **options):
    """Telegram 0xB0 of ranges in metres, other options as of `encode_words`.

    Examples
    --------
    >>> encode_scan([4.0, float("inf"), float("nan")], unit="cm").hex(" ")
    '02 80 0a 00 b0 03 00 90 01 f7 1f ff 1f 10 a2 f5'
    """
    values = encode_values(ranges, unit=unit, mode=mode, reasons=reasons)
    return encode_words(values, unit=unit, **options)


def decode_scan(raw, mode=0):
    """The Scans, of one row, of a telegram 0xB0; TelegramError where it is none or damaged."""
    parse_telegram(raw)
    scans = decode_scans(raw, np.array([0]), np.array([len(raw)]), mode)
    if not len(scans.rows):
        raise TelegramError("holds no scan")
    return scans
