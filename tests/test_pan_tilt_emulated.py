"""The pitch axis against the emulated heads: what they can, and rates of the line."""

import dataclasses
import math
import time

import numpy as np
import pytest

from lrfcal_lib.drivers.emulators import EmulatedHead, Head
from lrfcal_lib.drivers.pan_tilt import HeadSettings, PanTilt
from lrfcal_lib.simulate.rig import Platform

DEGREE = math.radians(1)
QUICK = HeadSettings(baudrate=38400, settle_s=0.08, stall_s=0.2, poll_s=0.02, reply_s=0.1, gap_s=0.01, reconnect_s=3.0)
FAST = {"baudrate": 38400, "speeds": (5.0, 120.0), "go_speed": 120.0}
KINDS = {
    "full": {},
    "general replies and echo": {"reply": "general", "echo": True},
    "5-byte replies": {"reply": "five"},
    "single byte": {"reply": "single"},
    "partial": {"feedback": "partial", "echo": True},
    "watchdog": {"feedback": "partial", "watchdog_s": 0.3},
    "inverted": {"invert": True},
}


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_heads_of_every_kind(tmp_path, kind):
    settings = dataclasses.replace(QUICK, invert=kind.get("invert", False),
                                   repeat_s=0.1 if "watchdog_s" in kind else None)  # fmt: skip
    with EmulatedHead(Head(Platform(settle=0.1)), path=tmp_path / "head", **(FAST | kind)) as device:
        with PanTilt.open(device.path, settings) as head:
            for degrees in (15.0, -10.0):
                pitch = head.move_to(degrees * DEGREE)
                assert pitch == pytest.approx(degrees * DEGREE, abs=0.6 * DEGREE)
                time.sleep(0.1)
                assert device.pitch() == pytest.approx(pitch, abs=0.05 * DEGREE)


def test_head_that_answers_nothing(tmp_path):
    settings = dataclasses.replace(QUICK, degrees_per_second=(5 + 115 * 32 / 63))
    with EmulatedHead(path=tmp_path / "head", feedback="none", **FAST) as device:
        with PanTilt.open(device.path, settings) as head:
            assert not head.has_feedback
            assert head.move_to(20 * DEGREE) == pytest.approx(20 * DEGREE, abs=2 * DEGREE)
            assert device.pitch() == pytest.approx(20 * DEGREE, abs=6 * DEGREE)


def test_sweep_at_the_slowest_line(tmp_path):
    settings = HeadSettings(settle_s=0.1)
    with EmulatedHead(Head(Platform(settle=0.1)), path=tmp_path / "head", speeds=(2.0, 60.0)) as device:
        with PanTilt.open(device.path, settings) as head:
            head.start_sweep(30 * DEGREE)
            track = head.finish_sweep(20)
            instants = [instant - device.clock.host(0.0) for instant, _, _ in track]
            truth = device.head.tilt.motor(np.array(instants))
            wrong = np.abs(truth - [pitch for _, pitch, _ in track])
            assert sum(measured for _, _, measured in track) > 5
            # 30 deg/s and half of the query's 60 ms; a busy machine is late with some
            assert np.median(wrong) < 1.5 * DEGREE and wrong.max() < 8 * DEGREE
