"""The pitch axis when anything goes wrong on its line: no move ends with a wrong pitch, every fault is survived."""

import math
import time

import pytest

from lrfcal_lib.drivers.emulators import EmulatedHead, Head
from lrfcal_lib.drivers.emulators.faults import FAULTS
from lrfcal_lib.drivers.errors import DeviceError
from lrfcal_lib.drivers.pan_tilt import HeadSettings, PanTilt
from lrfcal_lib.simulate.rig import Platform

DEGREE = math.radians(1)
QUICK = HeadSettings(baudrate=38400, settle_s=0.08, stall_s=0.2, poll_s=0.02, reply_s=0.1, gap_s=0.01, reconnect_s=3.0)
FAST = {"baudrate": 38400, "speeds": (5.0, 120.0), "go_speed": 120.0}


def test_every_fault(tmp_path):
    """No move ends with a wrong pitch, and the head is well when a fault is over."""
    kinds = [name for name, fault in FAULTS.items() if "head" in fault.devices]
    assert len(kinds) >= 20
    with EmulatedHead(Head(Platform(settle=0.05)), path=tmp_path / "head", **FAST) as device:
        with PanTilt.open(device.path, QUICK) as head:
            for number, kind in enumerate(kinds):
                device.faults.inject(kind, 1 if kind == "unplug" else 2)
                goal = (4 if number % 2 else -4) * DEGREE
                begun = time.monotonic()
                try:
                    pitch = head.move_to(goal, timeout=6)
                except DeviceError:
                    pitch = None
                assert time.monotonic() - begun < 30  # a guard against hanging
                time.sleep(0.06)
                if pitch is not None:
                    assert device.pitch() == pytest.approx(pitch, abs=0.1 * DEGREE), kind
                device.faults.clear()
                if pitch is None:
                    assert head.move_to(goal, timeout=6) == pytest.approx(goal, abs=0.6 * DEGREE), kind
            told, measured = head.pitch()
            assert measured and told == pytest.approx(device.pitch(), abs=0.1 * DEGREE)
