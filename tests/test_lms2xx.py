"""Telegrams of the LMS2xx: verified bytes, round trips, garbage, and recordings of a real device."""

import json

import numpy as np
import pytest
from telegrams import decode_scan, encode_scan, parse_telegram

from lrfcal_lib.session import lms2xx_codec as codec
from lrfcal_lib.session import lms2xx_frame as frame
from lrfcal_lib.session.lms2xx_codec import (
    TOP,
)
from lrfcal_lib.session.lms2xx_frame import (
    encode_telegram,
    split_stream,
)

F7 = "00 00 70 00 00 0{} 01 00 00 02 02" + " 00" * 21 + " 02 00"
TO_DEVICE = [  # verified against the listing and real devices; without start, address and length
    "20 40 50 08", "20 48 58 08", "20 24 34 08", "20 25 35 08", "20 2A 3A 08", "20 10 00 08", "20 26 05 79 3E",
    "20 27 01 00 0A 00 6C B7", "20 00 53 49 43 4B 5F 4C 4D 53 BE C5", "20 30 53 49 43 4B 5F 4C 4D 53 EE F5",
    "30 01 31 18", "30 08 38 18", "31 15 12", "32 16 12", "3A 1E 12", "74 50 12", "7B 5F 12", "10 34 12",
    "3B B4 00 32 00 3B 1F", "3B B4 00 64 00 97 49", "3B 64 00 64 00 1D 0F", "3B 64 00 32 00 B1 59",
    "3B 64 00 19 00 E7 72", "66 00 9C 4E", "66 01 9D 4E", "36 02 3E 1E", "37 01 00 69 01 EB 75",
    f"77 {F7.format(0)} 11 88", f"77 {F7.format(4)} 94 8A",
]  # fmt: skip
FROM_DEVICE = [
    "A0 00 10 16 0A", "A0 01 10 14 0B", "A0 00 11 17 0A", "91 10 79 30", "92 10 7F 33", "B2 10 3F 13",
    "BB 01 B4 00 32 00 10 03 9D", "BB 01 64 00 19 00 10 BB 46", "BB 00 B4 00 32 00 10 23 8D",
    "BA 4C 4D 53 32 30 30 3B 33 30 31 30 36 33 3B 56 30 32 2E 31 30 20 10 22 61",
    "BA 4C 4D 53 32 30 30 3B 53 31 38 30 36 33 3B 56 30 32 2E 31 39 20 10 85 6A",
    "BA 4C 4D 53 32 32 31 3B 33 30 32 30 36 33 3B 58 30 31 2E 32 37 20 10 02 EB",
    "90 4C 4D 53 32 32 31 3B 33 30 32 30 36 33 3B 58 30 31 2E 32 37 20 10 43 D4",
    "B0 03 00 90 01 F7 1F FF 1F 10 A2 F5", "B0 03 40 D2 04 D2 24 FE 1F 10 5B 90", "E6 01 00 10 CD FC",
    f"F7 01 {F7.format(0)} 10 C5 7A", f"F4 {F7.format(4)} 10 36 FE",
]  # fmt: skip


def whole(text, address):
    """A telegram with its beginning."""
    body = bytes.fromhex(text)
    return bytes([2, address, *(len(body) - 2).to_bytes(2, "little"), *body])


SENT = [whole(text, 0) for text in TO_DEVICE]
REPLIES = [
    bytes.fromhex("02 81 03 00 A0 00 10 36 1A"),
    *(whole(text, 0x80) for text in FROM_DEVICE),
]
A0 = bytes.fromhex("02 80 03 00 A0 00 10 16 0A")


def random_words(rng, shape):
    return rng.integers(0, 1 << 16, shape, dtype=np.uint16)


# ---------------------------------------------------------------------------------------------- frame and CRC


@pytest.mark.parametrize("raw", SENT + REPLIES, ids=bytes.hex)
def test_telegrams_are_the_verified_bytes(raw):
    found = parse_telegram(raw)
    data = raw[5:-3] if raw in REPLIES else raw[5:-2]
    assert (found.code, found.data) == (raw[4], data)
    assert encode_telegram(found.code, found.data, status=raw[-3], address=raw[1]) == raw


REFUSED = [
    *(
        (parse_telegram, raw, "no telegram, or a damaged one")
        for raw in (b"", A0 + b"\0", A0[:5] + b"\x01" + A0[6:])
    ),
    (decode_scan, A0, "holds no scan"),
    (
        decode_scan,
        encode_telegram(0xB0, b"\x05\0\1\1", address=0x80),
        "holds no scan",
    ),
    (
        decode_scan,
        encode_telegram(0xB0, b"\x01\x80\1\1", address=0x80),
        "holds no scan",
    ),  # unit reserved
    (
        codec.parse_status,
        encode_telegram(0xB1, bytes(100), address=0x80),
        "100 bytes of data, needs 123",
    ),
    (
        codec.parse_configuration,
        encode_telegram(0xF4, bytes(6), address=0x80),
        "6 bytes of data, needs 7",
    ),
    (
        lambda block: codec.Configuration(block).unit,
        b"\0\0\0\0\0\0\7",
        "unit 7 is neither 0",
    ),
    (
        lambda values: codec.scan_quarters(*values),
        (100,),
        "101, 181, 201, 361, 401 values, got 100",
    ),
    (
        lambda values: codec.scan_quarters(*values),
        (181, 1),
        "partial scan 1 has 180 values, got 181",
    ),
]


@pytest.mark.parametrize(("parse", "given", "message"), REFUSED)
def test_what_is_no_telegram_or_another_one_is_refused(parse, given, message):
    with pytest.raises(frame.TelegramError, match=message):
        parse(given)


# ------------------------------------------------------------------------------------------------------ scans


def unit_and_partial(scan):
    """Of a single scan."""
    return codec.UNITS[scan.unit[0]], scan.partial[0]


def test_the_two_scans_of_the_fact_sheet():
    first, second = (raw for raw in REPLIES if raw[4] == 0xB0)
    scan = decode_scan(first)
    np.testing.assert_allclose(scan.ranges, [[4.0, np.inf, np.nan]])
    assert [codec.REASONS[r] for r in scan.reasons[0]] == [
        "valid",
        "larger than maximum",
        "not valid",
    ]
    assert unit_and_partial(scan) == ("cm", -1)
    assert scan.scan_index.tolist() == scan.telegram_index.tolist() == [-1]
    scan = decode_scan(second)
    np.testing.assert_allclose(scan.ranges, [[1.234, 1.234, np.nan]])
    assert codec.REASONS[scan.reasons[0, 2]] == "dazzled"
    assert unit_and_partial(scan) == ("mm", -1)
    values = codec.encode_values([1.234, 1.234, 0], reasons=[0, 0, 2])
    assert codec.encode_words(values | np.uint16([0, 1 << 13, 0])) == second


@pytest.mark.parametrize("mode", TOP)
def test_special_values_of_every_mode(mode):
    bits = {0: 13, 1: 13, 2: 13, 3: 14, 4: 14, 5: 15, 6: 15}[mode]
    top = (1 << bits) - 1
    stated = {0: 1, 1: 2, 2: 3, 4: 4, 5: 5, 8: 6, 3: 7, 6: 7, 7: 7, 9: 0}
    words = np.array([top - below for below in stated], np.uint16)
    for flags in (0, (1 << (16 - bits)) - 1):
        scan = decode_scan(codec.encode_words(words | np.uint16(flags << bits)), mode)
        assert scan.reasons[0].tolist() == list(stated.values())
        expected = [
            np.inf if r == 6 else np.nan if r else (top - 9) / 1000 for r in stated.values()
        ]
        np.testing.assert_allclose(scan.ranges[0], expected)


@pytest.mark.parametrize("mode", TOP)
@pytest.mark.parametrize("unit", ["cm", "mm"])
@pytest.mark.parametrize("partial", [-1, 0, 1, 2, 3])
@pytest.mark.parametrize("indices", [None, (7, 255)])
def test_any_scan_survives_both_ways(mode, unit, partial, indices):
    rng = np.random.default_rng(mode)
    for count in rng.integers(0, 402, 5):
        words = random_words(rng, count)
        raw = codec.encode_words(
            words, unit=unit, partial=partial, indices=indices, status=0x51, address=0x85
        )
        scan = decode_scan(raw, mode)
        assert unit_and_partial(scan) == (unit, partial)
        assert (raw[-3], raw[1]) == (0x51, 0x85)
        assert (scan.scan_index[0], scan.telegram_index[0]) == (indices or (-1, -1))
        np.testing.assert_array_equal(scan.words[0], words)
        known = scan.reasons[0] < 7
        values = codec.encode_values(
            scan.ranges[0, known], unit=unit, mode=mode, reasons=scan.reasons[0, known]
        )
        np.testing.assert_array_equal(values, words[known] & TOP[mode])


# ---------------------------------------------------------------------------------------------------- streams


@pytest.mark.parametrize("cut", range(1, 16))
def test_an_unfinished_telegram_is_kept_for_later(cut):
    raw = encode_scan([1.0, 2.0, 3.0])
    data = raw + b"\x06" + raw[:cut]
    stream = split_stream(data)
    assert stream.offset.tolist() == [0] and stream.pending == len(raw) + 1
    rest = split_stream(data[stream.pending :] + raw[cut:])
    assert rest.offset.tolist() == [0] and rest.pending == len(raw)


# --------------------------------------------------------------------------------------------- real recordings


@pytest.fixture(scope="module")
def captures(real_data):
    """Telegrams of a real LMS200: direction, bytes, whether the recorder found the CRC right."""
    lines = [
        line
        for file in sorted((real_data / "lms200_captures").glob("*.jsonl"))
        for line in file.open()
    ]
    found = [json.loads(line) for line in lines]
    return [(one["dir"], bytes.fromhex(one["hex"]), one["crc_ok"]) for one in found]


def test_real_scans_decode_and_encode_to_the_same_bytes(captures):
    raws = [raw for _, raw, _ in captures if raw[4] == 0xB0]
    data = b"\x06".join(raws)
    stream = split_stream(data)
    scans = codec.decode_scans(data, stream.offset, stream.length, mode=4)
    assert scans.ranges.shape == (316, 361) and len(stream.rejected) == 0
    counts = zip(
        *(found.tolist() for found in np.unique(scans.reasons, return_counts=True)),
        strict=True,
    )
    told = {codec.REASONS[reason]: count for reason, count in counts}
    assert told == {"valid": 112476, "not valid": 956, "noise": 622, "overflow": 22}
    assert np.isnan(scans.ranges).sum() == 956 + 622 + 22 and {raw[-3] for raw in raws} == {
        0x10,
        0x11,
    }
    words = codec.encode_values(
        scans.ranges, mode=4, reasons=scans.reasons
    ) | scans.words & np.uint16(0xC000)
    assert [
        codec.encode_words(w, status=raw[-3]) for w, raw in zip(words, raws, strict=True)
    ] == raws


def test_a_real_device_describes_itself(captures):
    replies = {raw[4]: raw for direction, raw, _ in captures if direction == "lms->host"}
    status = codec.parse_status(replies[0xB1])
    assert status.measuring_mode == 4
    assert status.variant == (180.0, 0.5)
    assert codec.parse_type(replies[0xBA]) == ("LMS200", "S18063", "V02.19")
    for code in (0xF4, 0xF7):
        read = codec.parse_configuration(replies[code])
        assert (read.measuring_mode, read.unit) == (4, "mm")
