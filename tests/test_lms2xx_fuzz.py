"""A million random and damaged byte strings through the parsers of the LMS2xx: values, or TelegramError, nothing else.

Strings are put side by side into streams where the parser takes streams. Because hardly any damaged string has a sound
checksum, those for the contents of telegrams get theirs after the damage.
"""

import sys
import tracemalloc

import numpy as np
import pytest

from lrfcal_lib.drivers import lms2xx_replies
from lrfcal_lib.drivers.lms2xx import (
    MODES,
    TelegramError,
    crc16,
    decode_scan,
    decode_scans,
    encode_scan,
    encode_telegram,
    parse_telegram,
    split_stream,
)

STREAMED, CONTENTS, SINGLE = 480_000, 500_000, 20_000  # strings, a million in all
TRACED = 0.8  # share of the strings after which every byte is traced, which takes time; before, objects are counted
MEMORY, OBJECTS = 200_000, 2000  # bytes and objects that may stay allocated


def _seeds(rng):
    """Sound telegrams of every kind, ndarrays of uint8."""
    scans = [encode_scan(rng.uniform(0, 9, n), indices=i) for n in (0, 3, 20) for i in (None, (1, 2))]
    scans += [encode_scan(rng.uniform(0, 9, 9), partial=p, unit=u) for p in range(4) for u in ("cm", "mm")]
    sizes = {0xA0: 1, 0xB1: 152, 0xB2: 6, 0xBA: 21, 0xBB: 5, 0xF4: 34, 0xF7: 35, 0x90: 21, 0x92: 0}
    replies = [encode_telegram(code, rng.bytes(size), status=0x10) for code, size in sizes.items()]
    commands = [encode_telegram(0x20, b"\x25"), encode_telegram(0x77, bytes(34))]
    return [np.frombuffer(raw, np.uint8) for raw in scans + replies + commands]


def _strings(rng, seed, count):
    """Strings of one seed: overwritten, cut, with bytes in front, or random; (count, L) and their lengths."""
    size = len(seed)
    strings = np.tile(seed, (count, 1))
    for _ in range(3):
        rows = np.flatnonzero(rng.random(count) < 0.5)
        strings[rows, rng.integers(0, size, len(rows))] = rng.integers(0, 256, len(rows), dtype=np.uint8)
    random = rng.random(count) < 0.2
    strings[random] = rng.integers(0, 256, (random.sum(), size), dtype=np.uint8)
    shifted = rng.random(count) < 0.2
    strings[shifted] = np.roll(strings[shifted], int(rng.integers(1, size)), axis=1)
    return strings, np.where(rng.random(count) < 0.3, rng.integers(0, size + 1, count), size)


def _sound(strings):
    """The same with head, length and checksum set right; raws side by side, and their offsets and lengths."""
    strings = strings.copy()
    size = strings.shape[1]
    strings[:, :4] = 2, 0x80, (size - 6) % 256, (size - 6) // 256
    checksum = crc16(strings[:, :-2])
    strings[:, -2], strings[:, -1] = checksum & 0xFF, checksum >> 8
    return strings.tobytes(), size * np.arange(len(strings)), np.full(len(strings), size)


def _parse_streams(rng, seeds, count):
    """Strings in streams; returns how many, and how many of their places were telegrams."""
    found = 0
    for seed in seeds:
        strings, lengths = _strings(rng, seed, count)
        data = strings[np.arange(strings.shape[1]) < lengths[:, None]].tobytes()
        stream = split_stream(data, replies=bool(seed[1]))
        assert len(stream.offset) == len(stream.length) and stream.pending <= len(data)
        assert np.all(stream.offset[1:] >= stream.offset[:-1] + stream.length[:-1])
        assert stream.skipped + stream.length.sum() == stream.pending
        for group in decode_scans(data, stream.offset, stream.length, int(rng.choice(list(MODES)))):
            assert group.words.shape == group.ranges.shape == group.reasons.shape
        found += len(stream.offset)
    return count * len(seeds), found


def _parse_contents(rng, seeds, count):
    """Scans with damaged contents and sound checksums, many at once."""
    scans = [seed for seed in seeds if seed[4] == 0xB0]
    values = 0
    for seed in scans:
        strings, _ = _strings(rng, seed, count)
        strings[:, 4] = 0xB0
        data, offset, length = _sound(strings)
        for group in decode_scans(data, offset, length, int(rng.choice(list(MODES)))):
            assert np.all(np.isfinite(group.ranges) == (group.reasons == 0))
            values += group.words.size
    return count * len(scans), values


def _parse_single(rng, seeds, count):
    """Damaged contents with sound checksums, and damaged frames, one string after the other."""
    outcomes = {True: 0, False: 0}
    parsers = {0xB0: decode_scan, 0xB1: lms2xx_replies.parse_status, 0xB2: lms2xx_replies.parse_errors,
               0xBA: lms2xx_replies.parse_type, 0xBB: lms2xx_replies.parse_variant,
               0xF4: lms2xx_replies.parse_configuration, 0xF7: lms2xx_replies.parse_configuration}  # fmt: skip
    for seed in seeds:
        parse = parsers.get(int(seed[4]), parse_telegram)
        strings, lengths = _strings(rng, seed, count)
        for row, (string, size) in enumerate(zip(strings, lengths, strict=True)):
            string[4] = string[4] if row % 4 == 0 else seed[4]
            raw = string[:size].tobytes()
            if row % 2 and size > 6:
                raw = encode_telegram(raw[4], raw[5:], status=int(string[-1]))
            try:
                parse(raw)
                outcomes[True] += 1
            except TelegramError:
                outcomes[False] += 1
    return count * len(seeds), outcomes


@pytest.fixture(scope="module")
def seeds():
    return _seeds(np.random.default_rng(0))


def _rounds(parse, seeds, total, size):
    """Run a parser until `total` strings are parsed; its results, and how many bytes stayed allocated."""
    rng, done, results, objects, kept = np.random.default_rng(20091001), 0, [], [], []
    try:
        while done < total or len(kept) < 3:
            if done >= TRACED * total and not tracemalloc.is_tracing():
                tracemalloc.start()
            count, result = parse(rng, seeds, size)
            done += count
            results.append(result)
            objects.append(sys.getallocatedblocks())
            kept += [tracemalloc.get_traced_memory()[0]] if tracemalloc.is_tracing() else []
    finally:
        tracemalloc.stop()
    assert objects[-1] - objects[0] < OBJECTS
    return results, kept[-1] - kept[0]


def test_streams_of_damaged_strings(seeds):
    found, growth = _rounds(_parse_streams, seeds, STREAMED, 2000)
    assert sum(found) > STREAMED / 20  # those that were not hit, or not hit hard enough
    assert growth < MEMORY


def test_scans_with_damaged_contents(seeds):
    values, growth = _rounds(_parse_contents, seeds, CONTENTS, 2000)
    assert sum(values) > 0 and growth < MEMORY


def test_damaged_replies_one_by_one(seeds):
    outcomes, growth = _rounds(_parse_single, seeds, SINGLE, 100)
    assert min(sum(one[way] for one in outcomes) for way in (True, False)) > SINGLE / 20
    assert growth < MEMORY
