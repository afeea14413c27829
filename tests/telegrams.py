"""Telegrams with scans, for tests."""

from lrfcal_lib.session.lms2xx_codec import encode_values, encode_words


def encode_scan(ranges, *, unit="mm", mode=0, reasons=None, **options):
    """Telegram 0xB0 of ranges in metres, other options as of `encode_words`.

    Examples
    --------
    >>> encode_scan([4.0, float("inf"), float("nan")], unit="cm").hex(" ")
    '02 80 0a 00 b0 03 00 90 01 f7 1f ff 1f 10 a2 f5'
    """
    values = encode_values(ranges, unit=unit, mode=mode, reasons=reasons)
    return encode_words(values, unit=unit, **options)
