"""Pelco-D frames: verified bytes, round trips, every kind of reply, echoes, and garbage."""

import math

import numpy as np
import pytest
from shared import STRINGS

from lrfcal_lib.drivers import pelco_d
from lrfcal_lib.drivers.pelco_d import (
    DOWN,
    UP,
    Frame,
    encode_extended,
    encode_frame,
    split_frames,
    split_replies,
)

# TF-0002, and what other senders put on the line
FRAMES = {
    "FF 01 00 00 00 00 01": Frame(1),
    "FF 01 00 02 20 00 23": Frame(1, 0, 2, 0x20),
    "FF 01 00 04 20 00 25": Frame(1, 0, 4, 0x20),
    "FF 01 00 02 40 00 43": Frame(1, 0, 2, 0x40),
    "FF 01 00 08 00 20 29": Frame(1, 0, UP, 0, 0x20),
    "FF 01 00 08 00 3F 48": Frame(1, 0, UP, 0, 0x3F),
    "FF 01 00 10 00 20 31": Frame(1, 0, DOWN, 0, 0x20),
    "FF 01 00 0A 20 20 4B": Frame(1, 0, 2 | UP, 0x20, 0x20),
    "FF 01 88 00 00 00 89": Frame(1, 0x88),
    "FF 02 00 00 20 00 22": Frame(2, 0, 0, 0x20),
    "FF 0A 88 90 20 00 42": Frame(10, 0x88, 0x90, 0x20),
    "FF 01 00 03 00 01 05": Frame(1, 0, 0x03, 0, 1),
    "FF 01 00 07 00 22 2A": Frame(1, 0, 0x07, 0, 0x22),
    "FF 01 00 51 00 00 52": Frame(1, 0, 0x51),
    "FF 01 00 53 00 00 54": Frame(1, 0, pelco_d.QUERY_TILT),
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
STOP = encode_frame(1)
MOTION = encode_frame(1, 0, UP, 0, 0x20)
QUERY = encode_extended(1, pelco_d.QUERY_TILT)
LEVEL = bytes.fromhex("FF 01 00 5B 00 00 5C")
PAN_45 = bytes.fromhex("FF 01 00 59 11 94 FF")


@pytest.mark.parametrize(("raw", "frame"), FRAMES.items())
def test_printed_frames(raw, frame):
    raw = bytes.fromhex(raw)
    assert split_frames(raw) == ([frame], 7) and encode_frame(*vars(frame).values()) == raw
    assert split_frames(raw[:-1] + bytes([raw[-1] ^ 1]))[0] == []
    if frame.command2 & 1:
        assert encode_extended(frame.address, frame.command2, frame.value) == raw


@pytest.mark.parametrize(("degrees", "set_pan", "set_tilt", "pan", "tilt"), ANGLES)
def test_angles(degrees, set_pan, set_tilt, pan, tilt):
    value = pelco_d.encode_tilt(math.radians(degrees))
    for opcode, end in ((0x4B, set_pan), (0x4D, set_tilt), (0x59, pan), (0x5B, tilt)):
        raw = encode_extended(1, opcode, value)
        assert raw == bytes.fromhex(f"FF 01 00 {opcode:02X} {end}")
    (told,) = split_replies(raw, QUERY).tilts
    assert math.degrees(pelco_d.decode_tilt(told)) == pytest.approx(degrees)


def test_every_tilt_survives():
    elevations = [pelco_d.decode_tilt(value) for value in range(36000)]
    assert [pelco_d.encode_tilt(elevation) for elevation in elevations] == list(
        range(36000)
    )
    assert min(elevations) == pytest.approx(-math.pi) and max(elevations) < math.pi
    assert pelco_d.encode_tilt(2 * math.pi + 0.5) == pelco_d.encode_tilt(0.5)


# --------------------------------------------------------------------------------------------------- streams


def test_commands_between_garbage():
    frames = [
        MOTION,
        encode_frame(255),
        encode_extended(1, 0x59, 4500),
        encode_frame(255, data1=255),
    ]
    data = b"\xff\xff\x00".join([b"\x12", *frames]) + STOP[:5]
    found, pending = split_frames(data)
    assert found == [split_frames(raw)[0][0] for raw in frames]
    assert data[pending:] == STOP[:5]
    assert split_frames(b"\x01\x02") == ([], 2)


ACKNOWLEDGED = bytes.fromhex("FF 01 00 29")  # of the motion
FAR = encode_extended(1, pelco_d.TILT, 36000)  # no such angle


@pytest.mark.parametrize(("data", "sent", "found"), [
    (LEVEL, QUERY, ((0,), False)), (FAR, QUERY, ((), False)), (PAN_45, QUERY, ((), False)),
    (encode_extended(2, pelco_d.TILT), QUERY, ((), False)), (b"\x01", STOP, ((), False)),
    (bytes.fromhex("00 5B 00 64 BF"), QUERY, ((100,), False)),  # without sync and address
    (ACKNOWLEDGED, MOTION, ((), True)), (ACKNOWLEDGED, STOP, ((), False)), (ACKNOWLEDGED, QUERY, ((), False)),
    (bytes.fromhex("FF 01 05 06"), STOP, ((), True)),  # with alarms
])  # fmt: skip
def test_what_is_a_reply_to_what_was_sent(data, sent, found):
    received = split_replies(data, sent)
    assert (received.tilts, received.acknowledged) == found
    again = split_replies(sent + data, sent)
    assert ((again.tilts, again.acknowledged), again.echoed) == (found, len(sent))


@pytest.mark.parametrize(
    "command", [STOP, MOTION, encode_extended(1, pelco_d.SET_TILT, 0x11EE)]
)
def test_a_piece_of_the_own_frame_is_no_reply(command):
    """The last one ends in its opcode, so that its beginning looks like a confirmation."""
    for count in range(1, 8):
        for piece in (command[:count], command[-count:]):
            received = split_replies(piece, command)
            assert received.echoed + received.skipped == count and not (
                received.tilts or received.acknowledged
            )


def test_fuzz():
    """Random bytes, and frames and replies in which a byte is another one, behind others."""
    rng = np.random.default_rng(0)
    found = 0
    seeds = [
        STOP,
        QUERY,
        LEVEL,
        PAN_45,
        QUERY + LEVEL,
        bytes.fromhex("00 59 00 64 BD"),
        STOP[:4],
        b"\xff" * 9,
    ]
    for row in range(STRINGS):
        data = rng.bytes(int(rng.integers(25)))
        sent = (STOP, QUERY, MOTION)[row % 3]
        if row % 2:
            seed = seeds[row // 2 % len(seeds)]
            at = int(rng.integers(2 * len(seed)))
            data = data[:4] + seed[:at] + data[5:6] * (at < len(seed)) + seed[at + 1 :]
        received = split_replies(data, sent)
        used = received.echoed + received.skipped + 5 * len(received.tilts)
        assert (
            used == len(data)
            or used < len(data)
            and (received.tilts or received.acknowledged)
        )
        frames, pending = split_frames(data)
        assert 7 * len(frames) <= pending <= len(data)
        found += len(frames) + len(received.tilts) + received.acknowledged
    assert found > STRINGS / 10
