"""Pelco-D frames: verified bytes, round trips, every kind of reply, echoes, and garbage."""

import math
import sys

import numpy as np
import pytest
from shared import STRINGS

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.pelco_d import (
    Frame,
    FrameError,
    decode_tilt,
    encode_extended,
    encode_frame,
    encode_motion,
    encode_stop,
    encode_tilt,
    split_frames,
    split_replies,
)

# TF-0002, and what other senders put on the line
FRAMES = {
    "FF 01 00 00 00 00 01": Frame(1),
    "FF 01 00 02 20 00 23": Frame(1, 0, pelco_d.RIGHT, 0x20),
    "FF 01 00 04 20 00 25": Frame(1, 0, pelco_d.LEFT, 0x20),
    "FF 01 00 02 40 00 43": Frame(1, 0, pelco_d.RIGHT, 0x40),
    "FF 01 00 08 00 20 29": Frame(1, 0, pelco_d.UP, 0, 0x20),
    "FF 01 00 10 00 20 31": Frame(1, 0, pelco_d.DOWN, 0, 0x20),
    "FF 01 00 0A 20 20 4B": Frame(1, 0, pelco_d.RIGHT | pelco_d.UP, 0x20, 0x20),
    "FF 01 00 14 20 20 55": Frame(1, 0, pelco_d.LEFT | pelco_d.DOWN, 0x20, 0x20),
    "FF 01 88 00 00 00 89": Frame(1, 0x88),
    "FF 01 08 00 00 00 09": Frame(1, 0x08),
    "FF 02 00 04 00 20 26": Frame(2, 0, pelco_d.LEFT, 0, 0x20),
    "FF 02 00 00 20 00 22": Frame(2, 0, 0, 0x20),
    "FF 0A 88 90 20 00 42": Frame(10, 0x88, 0x90, 0x20),
}
EXTENDED = {
    "FF 01 00 03 00 01 05": (0x03, 1),
    "FF 01 00 07 00 01 09": (0x07, 1),
    "FF 01 00 07 00 21 29": (0x07, 0x21),
    "FF 01 00 07 00 22 2A": (0x07, 0x22),
    "FF 01 00 0F 00 00 10": (0x0F, 0),
    "FF 01 00 49 00 00 4A": (0x49, 0),
    "FF 01 00 51 00 00 52": (pelco_d.QUERY_PAN, 0),
    "FF 01 00 53 00 00 54": (pelco_d.QUERY_TILT, 0),
}
# degrees up, and the frames' last three bytes for set pan, set tilt, pan reply, tilt reply
ANGLES = [
    (0.0, "00 00 4C", "00 00 4E", "00 00 5A", "00 00 5C"),
    (-45.0, "11 94 F1", "11 94 F3", "11 94 FF", "11 94 01"),
    (-90.0, "23 28 97", "23 28 99", "23 28 A5", "23 28 A7"),
    (-180.0, "46 50 E2", "46 50 E4", "46 50 F0", "46 50 F2"),
    (90.0, "69 78 2D", "69 78 2F", "69 78 3B", "69 78 3D"),
    (30.0, "80 E8 B4", "80 E8 B6", "80 E8 C2", "80 E8 C4"),
    (0.01, "8C 9F 77", "8C 9F 79", "8C 9F 85", "8C 9F 87"),
]
STOP, QUERY = encode_stop(1), encode_extended(1, pelco_d.QUERY_TILT)
LEVEL = bytes.fromhex("FF 01 00 5B 00 00 5C")
PAN_45 = bytes.fromhex("FF 01 00 59 11 94 FF")


@pytest.mark.parametrize(("raw", "frame"), FRAMES.items())
def test_printed_frames(raw, frame):
    raw = bytes.fromhex(raw)
    assert split_frames(raw) == ((frame,), 7) and encode_frame(*vars(frame).values()) == raw
    assert split_frames(raw[:-1] + bytes([raw[-1] ^ 1]))[0] == ()


@pytest.mark.parametrize(("raw", "said"), EXTENDED.items())
def test_extended_frames(raw, said):
    assert encode_extended(1, *said) == bytes.fromhex(raw)
    (frame,), _ = split_frames(bytes.fromhex(raw))
    assert (frame.command2, frame.value) == said


@pytest.mark.parametrize(("way", "speed", "raw"), [
    (1, 0x20, "FF 01 00 08 00 20 29"), (-1, 0x20, "FF 01 00 10 00 20 31"), (1, 0x3F, "FF 01 00 08 00 3F 48"),
    (1, 0, "FF 01 00 08 00 00 09"),
])  # fmt: skip
def test_motions(way, speed, raw):
    assert encode_motion(1, way, speed) == bytes.fromhex(raw) != STOP


@pytest.mark.parametrize(("degrees", "set_pan", "set_tilt", "pan", "tilt"), ANGLES)
def test_angles(degrees, set_pan, set_tilt, pan, tilt):
    value = encode_tilt(math.radians(degrees))
    for opcode, end in ((0x4B, set_pan), (0x4D, set_tilt), (0x59, pan), (0x5B, tilt)):
        raw = encode_extended(1, opcode, value)
        assert raw == bytes.fromhex(f"FF 01 00 {opcode:02X} {end}")
    reply = split_replies(raw).replies[0]
    assert (reply.opcode, reply.address) == (pelco_d.TILT, 1)
    assert math.degrees(decode_tilt(reply.value)) == pytest.approx(degrees)


def test_every_tilt_survives():
    elevations = [decode_tilt(value) for value in range(36000)]
    assert [encode_tilt(elevation) for elevation in elevations] == list(range(36000))
    assert min(elevations) == pytest.approx(-math.pi) and max(elevations) < math.pi
    assert encode_tilt(2 * math.pi + 0.5) == encode_tilt(0.5)


def test_numbers_that_no_frame_carries():
    for call, what in [
        (lambda: encode_frame(256), "address must be a byte"),
        (lambda: encode_frame(1, data2=-1), "data2 must be a byte"),
        (lambda: encode_motion(1, 1, 0x40), "tilt_speed must be 0 to 63"),
        (lambda: encode_extended(1, 0x08), "odd opcodes"),
        (lambda: encode_extended(1, 0x4D, 65536), "0 to 65535"),
        (lambda: encode_tilt(math.nan), "finite"),
        (lambda: decode_tilt(36000), "0 to 35999"),
    ]:
        with pytest.raises(FrameError, match=what):
            call()


# --------------------------------------------------------------------------------------------------- streams


def test_commands_between_garbage():
    frames = [encode_motion(1, 1, 0x20), encode_stop(255), encode_extended(1, 0x59, 4500), encode_frame(255, data1=255)]
    data = b"\xff\xff\x00".join([b"\x12", *frames]) + STOP[:5]
    found, pending = split_frames(data)
    assert list(found) == [split_frames(raw)[0][0] for raw in frames]
    assert data[pending:] == STOP[:5]
    assert split_frames(b"\x01\x02") == ((), 2)


@pytest.mark.parametrize(("data", "sent", "numbers"), [
    (LEVEL, QUERY, (1, pelco_d.TILT, 0)),
    (PAN_45, QUERY, (1, pelco_d.PAN, 4500)),
    (bytes.fromhex("00 59 00 64 BD"), QUERY, (None, pelco_d.PAN, 100)),
    (bytes.fromhex("FF 01 00 01"), STOP, (1, None, 0)),
    (bytes.fromhex("FF 01 05 06"), STOP, (1, None, 5)),
    (b"\x01", QUERY, (None, None, None)),
])  # fmt: skip
def test_kinds_of_reply(data, sent, numbers):
    received = split_replies(data, sent, complete=True)
    assert received == pelco_d.Received((pelco_d.Reply(data, *numbers),), 0, 0)


def test_general_reply_needs_the_frame_that_was_sent():
    raw = bytes.fromhex("FF 01 00 29")
    assert split_replies(raw, encode_motion(1, 1, 0x20)).replies
    assert not split_replies(raw, STOP).replies
    assert not split_replies(raw, complete=True).replies


def test_impossible_angles_are_noise():
    assert not split_replies(encode_extended(1, pelco_d.TILT, 36000), QUERY).replies
    assert split_replies(encode_extended(1, pelco_d.ZOOM, 36000), QUERY).replies


@pytest.mark.parametrize("count", range(8))
@pytest.mark.parametrize("end", ["first", "last"])
def test_echo_whole_or_part_of_it(count, end):
    echo = QUERY[:count] if end == "first" else QUERY[len(QUERY) - count :]
    received = split_replies(echo + PAN_45 + LEVEL, QUERY)
    assert [one.raw for one in received.replies] == [PAN_45, LEVEL]
    assert received.echoed + received.skipped == count
    assert received.echoed == (count if count == 7 or end == "last" else 0)


def test_a_piece_of_the_own_stop_is_no_reply():
    for count in range(1, 8):
        for piece in (STOP[:count], STOP[-count:]):
            assert split_replies(piece, STOP, complete=True) == pelco_d.Received((), count, 0)
    received = split_replies(STOP + b"\x01", STOP, complete=True)
    assert (received.echoed, [one.raw for one in received.replies]) == (7, [b"\x01"])


def test_echo_like_an_acknowledgement():
    command = encode_extended(1, pelco_d.SET_TILT, 0x11EE)  # ends in its opcode, so that its beginning looks like one
    assert command[6] == command[3]
    assert not split_replies(command[:4], command).replies
    assert not split_replies(command[:4], command, complete=True).replies
    received = split_replies(command + command[:4], command, complete=True)
    assert [one.raw for one in received.replies] == [command[:4]]


def test_bytes_that_come_one_by_one_give_no_premature_reply():
    for address in (1, 8, 255):
        sent = encode_extended(address, pelco_d.QUERY_TILT)
        data = sent + b"\xff" + encode_extended(address, pelco_d.TILT, 4500)
        for count in range(len(data)):
            assert not split_replies(data[:count], sent).replies
        assert split_replies(data, sent).replies[0].value == 4500


def test_reply_after_every_kind_of_noise():
    rng = np.random.default_rng(1)
    lost = 0
    for _ in range(2000):
        noise = rng.choice([0xFF, 0x00, 0x01, 0x59, 0x5B, *range(256)], rng.integers(0, 12)).astype(np.uint8).tobytes()
        received = split_replies(noise + LEVEL + noise, QUERY, complete=True)
        lost += LEVEL not in [one.raw for one in received.replies]
        assert received.echoed + received.skipped + sum(len(one.raw) for one in received.replies) == 7 + 2 * len(noise)
    assert lost < 20  # one in 256 of the places where noise and reply look like another reply


# -------------------------------------------------------------------------------------------------------- fuzz


def mutated(rng, count):
    """Byte strings: half of random bytes, half frames and replies with damage."""
    seeds = [STOP, QUERY, LEVEL, PAN_45, QUERY + LEVEL, bytes.fromhex("00 59 00 64 BD"), STOP[:4], b"\xff" * 9,
             QUERY[:5] + PAN_45]  # fmt: skip
    noise = rng.bytes(count)
    lengths, rows = rng.integers(0, 25, count).tolist(), rng.integers(0, len(seeds), count).tolist()
    places, values = rng.integers(0, count - 25, count).tolist(), rng.integers(0, 14, count).tolist()
    for length, row, place, value in zip(lengths, rows, places, values, strict=True):
        if row & 1:
            yield noise[place : place + length]
        else:
            seed = seeds[row]
            yield noise[place : place + value // 3] + seed[:value] + noise[place : place + 1] + seed[value + 1 :]


def test_fuzz():
    sent = [STOP, QUERY, encode_extended(1, pelco_d.SET_TILT), b""]
    blocks = sys.getallocatedblocks()
    found = 0
    for row, data in enumerate(mutated(np.random.default_rng(0), STRINGS)):
        if row % 3:
            received = split_replies(data, sent[row % 4], complete=bool(row & 4))
            used = received.echoed + received.skipped + sum(len(one.raw) for one in received.replies)
            assert used == len(data) or used < len(data) and not row & 4
            found += len(received.replies)
        else:
            frames, pending = split_frames(data)
            assert 7 * len(frames) <= pending <= len(data)
            found += len(frames)
    assert found > STRINGS / 10
    assert sys.getallocatedblocks() < blocks + 5000
