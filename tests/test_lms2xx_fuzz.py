"""Random and damaged byte strings through the parsers of the LMS2xx: values, or TelegramError, nothing else.

Strings are put side by side into streams where the parser takes streams. Because hardly any damaged string has a sound
checksum, those for the contents of telegrams get theirs after the damage.
"""

import sys
import tracemalloc

import numpy as np
import pytest
from shared import STRINGS

from lrfcal_lib.session import lms2xx_codec as codec
from lrfcal_lib.session.lms2xx_codec import MODES, crc16, decode_scans, encode_scan, encode_telegram

PARSERS = {0xB0: codec.decode_scan, 0xB1: codec.parse_status, 0xBA: codec.parse_type,
           0xF4: codec.parse_configuration, 0xF7: codec.parse_configuration}  # fmt: skip
ROUNDS, TRACED = 10, 3  # in the last rounds every byte is traced, which takes time; in all of them objects are counted
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
    """Strings in streams; returns how many of their places were telegrams."""
    found = 0
    for seed in seeds:
        strings, lengths = _strings(rng, seed, count)
        data = strings[np.arange(strings.shape[1]) < lengths[:, None]].tobytes()
        stream = codec.split_stream(data, replies=bool(seed[1]))
        assert len(stream.offset) == len(stream.length) and stream.pending <= len(data)
        assert np.all(stream.offset[1:] >= stream.offset[:-1] + stream.length[:-1])
        assert stream.length.sum() <= stream.pending
        for group in decode_scans(data, stream.offset, stream.length, int(rng.choice(list(MODES)))):
            assert group.words.shape == group.ranges.shape == group.reasons.shape
        found += len(stream.offset)
    return found


def _parse_contents(rng, seeds, count):
    """Scans with damaged contents and sound checksums, many at once."""
    values = 0
    for seed in seeds:
        strings, _ = _strings(rng, seed, count)
        strings[:, 4] = 0xB0
        data, offset, length = _sound(strings)
        for group in decode_scans(data, offset, length, int(rng.choice(list(MODES)))):
            assert np.all(np.isfinite(group.ranges) == (group.reasons == 0))
            values += group.words.size
    return values


def _parse_single(rng, seeds, count):
    """Damaged contents with sound checksums, and damaged frames, one string after the other."""
    outcomes = np.zeros(2, int)
    for seed in seeds:
        parse = PARSERS.get(int(seed[4]), codec.parse_telegram)
        strings, lengths = _strings(rng, seed, count)
        for row, (string, size) in enumerate(zip(strings, lengths, strict=True)):
            string[4] = string[4] if row % 4 == 0 else seed[4]
            raw = string[:size].tobytes()
            if row % 2 and size > 6:
                raw = encode_telegram(raw[4], raw[5:], status=int(string[-1]))
            try:
                parse(raw)
                outcomes += [1, 0]
            except codec.TelegramError:
                outcomes += [0, 1]
    return outcomes


@pytest.fixture(scope="module")
def seeds():
    return _seeds(np.random.default_rng(0))


def _rounds(parse, seeds, total):
    """Run a parser on so many strings; its results. Nothing may stay allocated."""
    rng, results, objects, kept = np.random.default_rng(20091001), [], [], []
    try:
        for number in range(ROUNDS):
            if number == ROUNDS - TRACED:
                tracemalloc.start()
            results.append(parse(rng, seeds, -(-int(total) // (ROUNDS * len(seeds)))))
            objects.append(sys.getallocatedblocks())
            kept += [tracemalloc.get_traced_memory()[0]] if tracemalloc.is_tracing() else []
    finally:
        tracemalloc.stop()
    assert objects[-1] - objects[ROUNDS // 2] < OBJECTS and kept[-1] - kept[0] < MEMORY
    return results


def test_streams_of_damaged_strings(seeds):
    found = sum(_rounds(_parse_streams, seeds, 0.48 * STRINGS))
    assert found > 0.02 * STRINGS  # those that were not hit, or not hit hard enough


def test_scans_with_damaged_contents(seeds):
    assert sum(_rounds(_parse_contents, [seed for seed in seeds if seed[4] == 0xB0], 0.5 * STRINGS)) > 0


def test_damaged_replies_one_by_one(seeds):
    outcomes = _rounds(_parse_single, seeds, 0.02 * STRINGS)
    assert min(sum(outcomes)) > 0.001 * STRINGS
