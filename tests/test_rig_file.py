"""The rig file: what is wrong with it is said, with the key and the value."""

import json
import math
import os

import numpy as np
import pytest
from fake_rig import changed

from lrfcal_lib.drivers.rig_file import Plan, RigFileError, read_rig_file


def read(tmp_path, data):
    file = tmp_path / "rig.json"
    file.write_text(json.dumps(data))
    return read_rig_file(file)


WRONG = {
    r"devices\.lrf\.port is missing": ("devices.lrf.port", None),
    r"lrf\.port and head\.port are both /dev/fake_lrf": ("devices.head.port", "/dev/fake_lrf"),
    r"devices\.head: adress is not known; known are address, .*port": ("devices.head.adress", 1),
    r"devices\.head\.tilt_speed is 99: less than or equal to 63": ("devices.head.tilt_speed", 99),
    r"devices\.head\.address is 'one': a valid integer": ("devices.head.address", "one"),
    r"devices\.head\.pitch_limits_deg is \[10, -10\]: .*comes first": ("devices.head.pitch_limits_deg", [10, -10]),
    r"devices\.lrf\.unit is 'inch': 'mm' or 'cm'": ("devices.lrf.unit", "inch"),
    r"devices\.lrf\.variant is 180: a valid tuple": ("devices.lrf.variant", 180),
    r"lrf\.baudrate is 300: one of 9600, 19200, 38400, 500000": ("devices.lrf.baudrate", 300),
    "230400: .*no other range finder is driven here; .*SessionWriter": ("devices.lrf.baudrate", 230400),  # an LD19
    r"devices\.cameras\.left\.size is \[640, 480\], rig\.cameras\.left states \[32, 24\]":
        ("devices.cameras.left.size", [640, 480]),
    r"devices\.cameras are none, rig\.cameras left": ("devices.cameras", {}),
    r"plan\.mode is 'fast': 'stop-and-go' or 'continuous'": ("plan.mode", "fast"),
    r"plan\.pitch_deg is \[-4, 4, 0\]: first, last, and a step of 0\.001 or more": ("plan.pitch_deg", [-4, 4, 0]),
    r"plan\.pitch_deg\.2 is missing": ("plan.pitch_deg", [-4, 4]),
    r"plan\.image_pitch_deg\.0 is 'up': a valid number": ("plan.image_pitch_deg", ["up"]),
    r"placement 1 asks for a pitch of -4 to 90 deg, .*pitch_limits_deg are -60 to 60": ("plan.image_pitch_deg", [90]),
    r"plan: placements: numbers must differ, got \[1, 1\]": ("plan.placements", [{"number": 1}, {"number": 1}]),
    r"square_m": ("board.pattern.square_m", -1),
    r"board is missing": ("board", None),
    r"rig\.platform is \[\]: an object": ("rig.platform", []),
    r"10 MB, more than 8 MB": ("source", "x" * 10_000_000),
}  # fmt: skip


@pytest.mark.parametrize("message", WRONG)
def test_a_wrong_rig_file_is_refused(tmp_path, message):
    with pytest.raises(RigFileError, match=rf"rig\.json: .*{message}"):
        read(tmp_path, changed(*WRONG[message]))


NO_JSON = (
    b"[" * 100_000,
    b'{"x": ' * 100_000,
    b"\xff",
    b'{"x": ' + b"9" * 5000 + b"}",
    b"",
    b"{",
)
NO_FILES = (os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero"))


@pytest.mark.parametrize(("made", "message"), [
    (lambda path: None, "No such file.*emulate --rig-file"),
    (lambda path: path.write_text("[1, 2]"), "holds a list, an object is needed"),
    *((lambda path, text=text: path.write_bytes(text), "not JSON") for text in NO_JSON),
    *((make, "is .*, not a file.*writes an example") for make in NO_FILES),
])  # fmt: skip
def test_no_rig_file(tmp_path, made, message):
    path = tmp_path / "rig.json"
    made(path)
    with pytest.raises(RigFileError, match=rf"rig\.json: {message}"):
        read_rig_file(path)


def test_interlaced_scans_need_a_head_at_rest(tmp_path):
    data = changed("devices.lrf.interlaced", True)
    data["plan"]["mode"] = "continuous"
    with pytest.raises(RigFileError, match=r"devices\.lrf\.interlaced is true"):
        read(tmp_path, data)


@pytest.mark.parametrize(
    ("step", "stops"), [(0.1, 151), (0.3, 51), (1, 16), (2.5, 7), (7, 4), (100, 2)]
)
def test_sweeps_meet_their_ends_and_do_not_exceed_their_step(step, stops):
    odd, even = Plan(pitch_deg=(-10, 5, step), count=2).to_do()
    np.testing.assert_allclose(np.degrees(odd.pitch[[0, -1]]), [-10, 5])
    assert (
        np.diff(odd.pitch).max() <= math.radians(step) + 1e-12 and len(odd.pitch) == stops
    )
    assert np.ptp(np.diff(odd.pitch)) < 1e-12
    np.testing.assert_array_equal(even.pitch, odd.pitch[::-1])
    assert (odd.descends, even.descends) == (False, True)
