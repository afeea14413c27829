"""The emulated rig: one world behind all devices, its cameras, its control socket, and the command line."""

import json
import signal
import subprocess
import sys
import time
import urllib.request
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import serial

from lrfcal_lib.drivers.port import REAL
from lrfcal_lib.drivers.rig_file import read_rig_file
from lrfcal_lib.emulators.head import Head
from lrfcal_lib.emulators.rig import EmulatedRig, main
from lrfcal_lib.emulators.world import CameraServer, EmulatedWorld, scaled
from lrfcal_lib.session.lms2xx_codec import split_stream
from lrfcal_lib.session.stated import parse_session
from lrfcal_lib.simulate import beam as lrf
from lrfcal_lib.simulate.record import world_of
from lrfcal_lib.simulate.rig import Placement, load_setup, placements_of

DEADLINE = 180.0  # s, against hanging
QUARTERS = np.arange(160, 561)
SETUP = load_setup("sim_quick")
SMALL = replace(SETUP, rig=scaled(replace(SETUP.rig, platform=replace(SETUP.rig.platform, settle=0.1)), 64))


@pytest.fixture(scope="module")
def placements():
    return placements_of(SETUP)[:4]


@pytest.fixture
def world(placements):
    return EmulatedWorld(SETUP, placements=placements)


@pytest.fixture
def small(placements):
    """A world whose images are small."""
    return EmulatedWorld(SMALL, placements=placements)


def until(condition, what):
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end, f"{what} did not happen"
        time.sleep(0.02)


@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_a_scan_is_the_one_of_the_simulator_at_the_true_pitch_of_every_beam(world, placements, speed):
    world.put(1)
    beam, start = SETUP.rig.beam, float(np.mean(placements[0].sweep))
    world.head = Head(SETUP.rig.platform, pitch=start)
    world.head.move(0.0, start + 0.5, speed)
    times = 0.1 + QUARTERS % 4 / 75.08
    scans, _, ends = zip(*(world.scan(0, QUARTERS, times) for _ in range(30)), strict=True)
    pitch, still = world.head.pitch(times), world_of(SETUP, placements[0].T_platform_board)
    ideal = lrf.ideal_readings(beam, still, beam.bearings(), pitch + 0 * times, SETUP.rig.T_head_lrf)[0]
    assert ends[0] == pytest.approx([pitch.min(), pitch.max()]) and (np.ptp(pitch) > 0.01) == (speed > 0)
    error = np.array(scans) - beam.systematic - ideal
    assert np.nanstd(error) == pytest.approx(beam.sigma_range, rel=0.05)
    assert abs(np.nanmean(error)) < 5 * beam.sigma_range / np.sqrt(error.size)


def test_places(world, placements):
    world.put(2)
    assert world.place.T_platform_board is placements[1].T_platform_board
    world.hold_close("left", 3)
    close = SETUP.rig.camera_pose(SETUP.rig.cameras[0], 0.0) * world.place.T_platform_board
    assert SETUP.rig.shows(SETUP.rig.cameras[0], close, SETUP.rig.board.pattern.points())
    assert 0.1 < close.translation[2] < 1.0 and not world.place.stand
    world.put(None)
    assert world.place.key == ("placement", None)
    for call, message in (
        (lambda: world.put(9), "no placement 9; there are 1, 2, 3, 4, and none"),
        (lambda: world.hold_close("left", 99), "no view 99 of camera 'left'"),
        (lambda: world.hold_close("middle", 0), "no view 0 of camera 'middle'"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_images_of_another_width_show_the_same():
    small = scaled(SETUP.rig, 320)
    for a, b in zip(small.cameras, SETUP.rig.cameras, strict=True):
        assert (a.model.width, a.model.height) == (320, 240) and a.model.fx == b.model.fx / 2
        assert (a.model.cx + 0.5) / a.model.fx == pytest.approx((b.model.cx + 0.5) / b.model.fx)


@pytest.fixture(scope="module")
def rig(placements):
    with EmulatedRig(SMALL, placements=placements) as rig:
        yield rig
    assert rig.error() is None and not rig.folder.exists()


def test_cameras_open_as_any_stream_and_show_the_place(rig):
    rig.world.put(1)
    video = cv2.VideoCapture(rig.camera_urls["left"])
    assert video.isOpened()
    ok, first = video.read()
    assert ok and first.shape == (48, 64, 3)
    rig.world.put(None)
    until(lambda: np.abs(video.read()[1].astype(int) - first).mean() > 3, "an image without the board")
    video.release()


def test_no_image_while_the_head_moves(rig):
    """A new one afterwards, which shows the new pitch."""
    cameras, head, now = rig.camera_server, rig.world.head, rig.host.now
    until(lambda: cameras.image("left", timeout=1.0)[0] is not None, "an image at rest")
    before = cameras.image("left", timeout=DEADLINE)[0]
    head.move(now(), head.measured(now()) + 0.2, 0.2)
    assert cameras.image("left", timeout=0.3) == (None, None)
    after = cameras.image("left", timeout=DEADLINE)[0]
    assert after[2] == pytest.approx(before[2] + 0.2, abs=0.01) and head.settled(rig.host.now())


@pytest.fixture
def drawing(small):
    """Makes camera servers whose drawing process is replaced by one that ends when it is told: pitch and result."""
    servers = []

    def drawing(**options):
        server, asked = CameraServer(small, **options), []
        server._pool.submit = lambda function, index, place, pitch, *_: asked.append((pitch, Future())) or asked[-1][1]
        servers.append(server)
        return server, asked

    yield drawing
    for server in servers:
        server.close()


def test_an_image_begun_before_a_move_is_not_sent(small, drawing):
    server, asked = drawing()
    until(lambda: server.image("left", timeout=0.05) == (None, None) and asked, "the wish for an image")
    small.head.go(small.host.now(), 0.05, 2.0)
    asked[0][1].set_result(b"old")
    until(lambda: server.image("left", timeout=0.05) == (None, None) and len(asked) > 1, "the wish for a new one")
    asked[-1][1].set_result(b"new")
    assert server.image("left", timeout=DEADLINE)[1] == b"new"


@pytest.mark.parametrize(("rest_s", "drawn"), [(1e6, False), (0.0, True)])
def test_an_image_is_drawn_only_where_the_head_rests_long_enough(small, drawing, rest_s, drawn):
    server, asked = drawing(rest_s=rest_s)
    small.head.go(small.host.now(), 0.01, 2.0)
    until(lambda: small.head.settled(small.host.now()), "rest")
    assert server.image("left", timeout=0.3) == (None, None) and bool(asked) == drawn


def obeyed(url, command):
    return urllib.request.urlopen(f"{url}/{command}", timeout=DEADLINE).status == 204


def test_the_board_is_put_elsewhere(world):
    server = CameraServer(world)
    server.start()
    for command, key in (("place/2", ("placement", 2)), ("place/none", ("placement", None)),
                         ("close/right/1", ("close", "right", 1))):  # fmt: skip
        assert obeyed(server.url, command) and world.place.key == key
    server.close()


@pytest.mark.parametrize(
    ("command", "match"),
    [("dance", "404.*there are left.mjpg, right.mjpg, place/NUMBER"), ("place/9", "400.*no placement 9"),
     ("place/x", "400.*invalid literal"), ("close/left", "404"), ("close/left/99", "400.*no view 99")],
)  # fmt: skip


def test_what_cannot_be_is_refused(rig, command, match):
    with pytest.raises(urllib.error.HTTPError, match=match):
        obeyed(rig.camera_server.url, command)


def test_the_devices_share_one_world(rig):
    """The head moves by Pelco-D, and the scans that leave the other port are of where it then is."""
    rig.world.put(1)
    head, port = serial.Serial(rig.pan_tilt.path, 2400), serial.Serial(rig.lrf.path, 9600, timeout=0.2)
    head.write(bytes.fromhex("FF 01 00 4D 01 F4 43"))  # 5 deg down
    until(lambda: rig.world.head.settled(rig.host.now()) and rig.pan_tilt.pitch() < -0.08, "the move")
    before, data, end = len(rig.scans), b"", time.monotonic() + DEADLINE
    while not len(split_stream(data).offset) and time.monotonic() < end:
        port.write(bytes.fromhex("02 00 02 00 30 01 31 18"))
        data += port.read(740) + port.read(740) + port.read(740) + port.read(740) + port.read(740)
    record = rig.scans[before]
    assert record.telegram in data
    assert np.degrees(record.pitch_rad) == pytest.approx(-5.0, abs=0.2)
    instant = record.time_s - REAL.time() + REAL.now()
    assert rig.pan_tilt.pitch(instant) == pytest.approx(record.pitch_rad[0])
    head.close()
    port.close()


def test_rig_file_states_what_a_session_states(rig, tmp_path):
    (tmp_path / "rig.json").write_text(json.dumps(rig.rig_file()))
    stated = json.loads((tmp_path / "rig.json").read_text())
    assert len(read_rig_file(tmp_path / "rig.json").plan.to_do()) == 4
    parsed = parse_session({**stated, "placements": [1]})
    assert parsed["board"].name == SETUP.rig.board.name and parsed["cameras"]["left"].width == 64
    assert stated["devices"]["lrf"]["port"] == rig.lrf.path and stated["devices"]["lrf"]["variant"] == [100, 0.25]
    assert stated["devices"]["head"]["pitch_limits_deg"] == [-60, 45]
    assert stated["plan"]["placements"][1]["pitch_deg"][0] > stated["plan"]["placements"][1]["pitch_deg"][1]
    assert all(camera["silence_s"] >= 60 for camera in stated["devices"]["cameras"].values())


def test_own_placements_and_unknown_setups(tmp_path):
    mine = [Placement(7, placements_of(SETUP)[0].T_platform_board, (-0.1, 0.1), (0.0,))]
    with EmulatedRig(SETUP, placements=mine, folder=tmp_path / "rig") as rig:
        rig.world.put(7)
        assert (tmp_path / "rig" / "lrf").is_symlink()
    EmulatedRig(SETUP, folder=tmp_path / "rig").close()  # what was not started can be closed
    assert list((tmp_path / "rig").iterdir()) == []
    before = signal.getsignal(signal.SIGHUP)
    with pytest.raises(ValueError, match="no set-up 'x'; there are sim_lms221, sim_quick"):
        main("x")
    assert signal.getsignal(signal.SIGHUP) is before


def test_the_command_line_cleans_up(tmp_path):
    file = tmp_path / "rig.json"
    call = [sys.executable, "-m", "lrfcal_lib", "emulate", "--rig-file", str(file)]
    run = subprocess.Popen(call, stdout=subprocess.PIPE, text=True)
    until(lambda: file.exists() or run.poll() is not None, "the rig file")
    said = "".join(iter(run.stdout.readline, f"  rig file {file}   python -m lrfcal_lib record --help\n"))
    assert "place/NUMBER puts it at 1, 2" in said
    devices = json.loads(file.read_text())["devices"]
    folder = Path(devices["lrf"]["port"]).parent
    port = serial.Serial(devices["lrf"]["port"], 9600, timeout=DEADLINE)
    port.write(bytes.fromhex("02 00 01 00 3A 1E 12"))
    assert port.read(30)[5:6] == b"\xba"
    assert obeyed(devices["control"], "place/1")
    run.send_signal(signal.SIGTERM)
    assert "the emulated rig is gone" in run.communicate(timeout=DEADLINE)[0] and run.returncode == 0
    assert not file.exists() and not folder.exists()
    port.close()
