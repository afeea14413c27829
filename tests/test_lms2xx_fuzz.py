"""Random and damaged byte strings through the parsers of the LMS2xx: values, or TelegramError, nothing else."""

from contextlib import suppress

import numpy as np
from shared import STRINGS
from telegrams import decode_scan, encode_scan, parse_telegram

from lrfcal_lib.session import lms2xx_codec as codec
from lrfcal_lib.session import lms2xx_frame as frame
from lrfcal_lib.session.lms2xx_codec import (
    TOP,
)
from lrfcal_lib.session.lms2xx_frame import (
    encode_telegram,
)

PARSERS = {0xB0: decode_scan, 0xB1: codec.parse_status, 0xBA: codec.parse_type,
           0xF4: codec.parse_configuration, 0xF7: codec.parse_configuration}  # fmt: skip


def seeds(rng):
    """Sound telegrams of every kind."""
    scans = [
        encode_scan(rng.uniform(0, 9, n), indices=i)
        for n in (0, 3, 20)
        for i in (None, (1, 2))
    ]
    scans += [
        encode_scan(rng.uniform(0, 9, 9), partial=p, unit=u)
        for p in range(4)
        for u in ("cm", "mm")
    ]
    sizes = {
        0xA0: 1,
        0xB1: 152,
        0xB2: 6,
        0xBA: 21,
        0xBB: 5,
        0xF4: 34,
        0xF7: 35,
        0x90: 21,
        0x92: 0,
    }
    replies = [
        encode_telegram(code, rng.bytes(size), address=0x80) for code, size in sizes.items()
    ]
    return [
        *scans,
        *replies,
        encode_telegram(0x20, b"\x25"),
        encode_telegram(0x77, bytes(34)),
    ]


def damaged(rng, seed, count):
    """Copies of a seed in which up to three bytes are others, some of them cut off or random altogether."""
    for _ in range(count):
        how = rng.random()
        raw = bytearray(rng.bytes(len(seed)) if how < 0.1 else seed)
        for at in rng.integers(len(raw), size=rng.integers(4)):
            raw[at] = rng.integers(256)
        yield bytes(raw[: rng.integers(len(raw))] if how > 0.8 else raw)


def test_fuzz_streams():
    """Strings side by side."""
    rng = np.random.default_rng(20091001)
    every = seeds(rng)
    found = 0
    for seed in every:
        data = b"".join(damaged(rng, seed, STRINGS // 2 // len(every)))
        stream = frame.split_stream(data, replies=bool(seed[1]))
        assert len(stream.offset) == len(stream.length) and stream.pending <= len(data)
        assert np.all(stream.offset[1:] >= stream.offset[:-1] + stream.length[:-1])
        assert stream.length.sum() <= stream.pending
        scans = codec.decode_scans(
            data, stream.offset, stream.length, int(rng.choice(list(TOP)))
        )
        assert scans.words.shape == scans.ranges.shape == scans.reasons.shape
        found += len(stream.offset)
    assert found > 0.02 * STRINGS  # those that were not hit


def test_fuzz_contents():
    """One string after the other, most of them with a checksum that is sound again."""
    rng = np.random.default_rng(20091001)
    every = seeds(rng)
    values = 0
    for seed in every:
        for raw in damaged(rng, seed, STRINGS // 2 // len(every)):
            if len(raw) > 7 and raw[-1] % 4:
                raw = encode_telegram(seed[4], raw[5:-3], status=raw[-3], address=0x80)
            with suppress(frame.TelegramError):
                parse = PARSERS.get(parse_telegram(raw).code, parse_telegram)
                scan = parse(raw)
                values += 1
                assert parse is not decode_scan or np.all(
                    np.isfinite(scan.ranges) == (scan.reasons == 0)
                )
    assert 0.1 * STRINGS < values < 0.45 * STRINGS
