"""The emulated LMS2xx in virtual time: byte-exact replies, times."""

import numpy as np
import pytest
from virtual import Bench, lms

from lrfcal_lib.session.lms2xx_frame import (
    encode_telegram,
)

ZEROS = "00 " * 21
TYPE = "02 00 01 00 3A 1E 12"
STATUS = "02 00 01 00 31 15 12"
ERRORS = "02 00 01 00 32 16 12"
CONFIG = "02 00 01 00 74 50 12"
SCAN = "02 00 02 00 30 01 31 18"
RESET = "02 00 01 00 10 34 12"  # fmt: skip
STOP = "02 00 02 00 20 25 35 08"
INSTALL = "02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5"
VARIANT = {
    v: encode_telegram(0x3B, np.array(v, "<u2").tobytes()) for v in ((180, 50), (100, 25))
}
WRITE_TL = f"02 00 23 00 77 00 00 70 00 00 00 01 00 00 02 02 {ZEROS} 02 00 11 88"
WRITE_CAP = f"02 00 23 00 77 00 00 70 00 00 04 01 00 00 02 02 {ZEROS} 02 00 94 8A"


def bench(rate=None, **options):
    """A laser range finder and a program at its line."""
    return Bench(lms(**options), rate)


# ------------------------------------------------------------------------------------------------ byte-exact replies

DONE = "A0 00 10 16 0A"
REFUSED = "92 10 7F 33"
TYPE_REPLY = "BA 4C 4D 53 32 32 31 3B 33 30 32 30 36 33 3B 58 30 31 2E 32 37 20 10 02 EB"


@pytest.mark.parametrize(
    ("requests", "reply", "settings"),
    [
        ([TYPE], TYPE_REPLY, {}),
        (["33 44 55 00" + TYPE], TYPE_REPLY, {}),  # noise before a request
        ([TYPE], "BA 4C 4D 53 32 30 30 3B 53 31 38 30 36 33 3B 56 30 32 2E 31 39 20 10 85 6A",
         {"model": "LMS200;S18063;V02.19 "}),
        ([ERRORS], "B2 10 3F 13", {}),
        ([STOP], DONE, {}),
        (["02 00 02 00 20 10 00 08"], DONE, {}),
        ([INSTALL], DONE, {}),
        ([INSTALL], "A0 01 10 14 0B", {"password": b"OTHERONE"}),
        ([VARIANT[180, 50]], "BB 01 B4 00 32 00 10 03 9D", {}),
        ([VARIANT[100, 25]], "BB 01 64 00 19 00 10 BB 46", {}),
        ([encode_telegram(0x3B, bytes([180, 0, 25, 0]))], "BB 00 B4 00 32 00 10 23 8D", {}),
        ([INSTALL, WRITE_TL], f"F7 01 00 00 70 00 00 00 01 00 00 02 02 {ZEROS} 02 00 10 C5 7A", {}),
        ([INSTALL, WRITE_CAP, CONFIG], f"F4 00 00 70 00 00 04 01 00 00 02 02 {ZEROS} 02 00 10 36 FE", {}),
        *((requests, REFUSED, {}) for requests in (
            [WRITE_TL], [INSTALL, encode_telegram(0x77, bytes(31))], [INSTALL, encode_telegram(0x77, bytes(35))],
            [encode_telegram(0x55)], [encode_telegram(0x20, b"\x99")], [encode_telegram(0x20)],
            [encode_telegram(0x20, b"\x26\1")], [encode_telegram(0x20, b"\x27\5\0\4\0")],
            [encode_telegram(0x20, b"\x27\0\0\4\0")], [encode_telegram(0x20, b"\x27\5\0\x92\1")],
            [encode_telegram(0x20, b"\x2b\1\0\1\0")], [encode_telegram(0x20, b"\x2a\0")],
            [encode_telegram(0x30, b"\x55")], [encode_telegram(0x3B, b"\xb4\0")])),
    ],
)  # fmt: skip
def test_replies_of_the_fact_sheet(requests, reply, settings):
    one = bench(**settings)
    body = bytes.fromhex(reply)
    for request in requests:
        answer = one.send(request)
    assert (
        answer
        == b"\x06" + bytes([0x02, 0x80]) + (len(body) - 2).to_bytes(2, "little") + body
    )


@pytest.mark.parametrize(("request_", "answer"), [
    ("02 00 01 00 3A 1E 13", "15"), ("02 05 01 00 3A 1E 13", ""), ("FF 00 06", ""),
    (encode_telegram(0x3A, address=2), ""), (STOP, "06 02 81 03 00 A0 00 10 36 1A"),
    (encode_telegram(0x20, b"\x25", address=1), "06 02 81 03 00 A0 00 10 36 1A"),
])  # fmt: skip
def test_a_damaged_request_is_answered_nak_and_one_to_another_address_not(request_, answer):
    assert bench(address=1).send(request_) == bytes.fromhex(answer)


def test_reset_tells_its_power_on_string():
    one = bench(boot_s=1.0, rate=9600)
    one.send(VARIANT[100, 25])
    assert one.send(RESET, wait=0.5) == bytes.fromhex("06 02 80 02 00 91 10 79 30")
    assert one.send(TYPE, wait=0.2) == b""  # it hears nothing while it starts
    string = one.run(1.0)
    assert string[4:5] == b"\x90" and string[-2:] == bytes.fromhex("43 D4")
    assert one.device.baudrate == 9600 and one.device.memory.variant == (180, 50)


# ------------------------------------------------------------------------------------------------ times


@pytest.mark.parametrize(
    (
        "request_",
        "least",
        "most",
    ),  # milliseconds to the last byte, as measured at 38400 Bd on a real device
    [
        (STOP, 66, 91),
        (TYPE, 75, 80),
        (STATUS, 107, 114),
        (CONFIG, 75, 76),
        (SCAN, 190, 300),
        (WRITE_TL, 128, 129),
    ],
)
def test_times_of_replies(request_, least, most):
    one = bench(baudrate=38400, mode=0)
    one.send(request_)
    assert one.out[0][0] <= 0.060 and least - 4 <= 1000 * one.out[-1][0] <= most + 4
