"""The emulated rig: one world behind all devices, its cameras, its control socket, and the command line."""

import json
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import serial
from fake_rig import make_rig, rig_data
from shared import until

from lrfcal_lib import __main__ as command_line
from lrfcal_lib.drivers.port import DeviceError
from lrfcal_lib.emulators.head import Head
from lrfcal_lib.emulators.rig import EmulatedRig, main, written_rig_file
from lrfcal_lib.emulators.world import CameraServer, EmulatedWorld, scaled
from lrfcal_lib.simulate import beam as lrf
from lrfcal_lib.simulate.record import world_of
from lrfcal_lib.simulate.rig import load_setup, placements_of

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


@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_a_scan_is_the_one_of_the_simulator_at_the_true_pitch_of_every_beam(world, placements, speed):
    world.put(1)
    beam, start = SETUP.rig.beam, float(np.mean(placements[0].sweep))
    world.head = Head(SETUP.rig.platform, pitch=start)
    world.head.move(0.0, start + 0.5, speed)
    times = 0.1 + QUARTERS % 4 / 75.08
    scans, _ = zip(*(world.scan(0, QUARTERS, times) for _ in range(30)), strict=True)
    pitch, still = world.head.pitch(times), world_of(SETUP, placements[0].T_platform_board)
    ideal = lrf.ideal_readings(beam, still, beam.bearings(), pitch + 0 * times, SETUP.rig.T_head_lrf)[0]
    assert (np.ptp(pitch) > 0.01) == (speed > 0)
    error = np.array(scans) - beam.systematic - ideal
    assert np.nanstd(error) == pytest.approx(beam.sigma_range, rel=0.05)
    assert abs(np.nanmean(error)) < 5 * beam.sigma_range / np.sqrt(error.size)


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
    until(lambda: np.abs(video.read()[1].astype(int) - first).mean() > 3)
    video.release()


def test_the_board_is_moved_by_who_records(world):
    data, driver = rig_data(), make_rig()
    assert driver.move_board(1) is False and driver.hold_close("left", 0) is False  # there it is a person
    server = CameraServer(world)
    server.start()
    data["devices"]["control"] = server.control
    driver = make_rig(data)
    assert driver.move_board(2) and world.place.key == ("placement", 2)
    assert driver.hold_close("left", 3) and world.place.key == ("close", "left", 3)
    for call, message in (
        (lambda: driver.move_board(9), "control http:.* 400 'no placement 9; there are 1, 2, 3, 4, and none'"),
        (lambda: driver.move_board("x"), "invalid literal"),
        (lambda: driver.hold_close("left", 99), "no view 99 of camera 'left'"),
        (lambda: driver.hold_close("a/b", 0), "answers 404 'there are place/NUMBER"),
    ):
        with pytest.raises(DeviceError, match=message):
            call()
    server.close()
    with pytest.raises(DeviceError, match="is 'python -m lrfcal_lib emulate' still running"):
        driver.move_board(3)


STRANGE = {  # what a web page could send: method, address, Host
    "read": ("GET", "{control}/place/1", "{host}"),
    "no token": ("POST", "{url}/place/1", "{host}"),
    "another token": ("POST", "{url}/x/place/1", "{host}"),
    "another name": ("POST", "{control}/place/1", "example.org"),
    "another port": ("POST", "{control}/place/1", "127.0.0.1:80"),
    "images by another name": ("GET", "{url}/left.mjpg", "example.org"),
}


@pytest.mark.parametrize("order", STRANGE)
def test_no_web_page_moves_the_board(world, order):
    server = CameraServer(world)
    server.start()
    names = {"url": server.url, "control": server.control, "host": server.host}
    method, url, host = (text.format(**names) for text in STRANGE[order])
    request = urllib.request.Request(url, method=method, headers={"Host": host})
    with pytest.raises(urllib.error.HTTPError, match="40[34]"):
        urllib.request.urlopen(request, timeout=DEADLINE)
    assert world.place.key == ("placement", None)
    server.close()


def test_an_image_begun_before_a_move_is_not_sent(small):
    server, drawn = CameraServer(small), []

    def draw(name, scene, pitch):
        drawn.append(pitch)
        if len(drawn) == 1:
            small.head.go(small.host.now(), 0.05, 2.0)
        return b"%d" % len(drawn)

    server._draw = draw
    key, data = server.image("left", timeout=DEADLINE)
    assert data == b"2" and key[2] == drawn[1] != drawn[0]
    server.close()


def test_a_setup_that_is_not_there():
    with pytest.raises(ValueError, match="no set-up 'x'; there are sim_lms221, sim_quick"):
        main("x")


class Quiet:
    """An emulated rig without devices."""

    def rig_file(self):
        return {"plan": {}}


TAKEN = {  # what is there already, and what is said of it
    "a file": (lambda file: file.write_text("mine"), "exists already, and is not written over: name another file"),
    "a folder": (lambda file: file.mkdir(), "exists already, and is not written over: name another file"),
    "a dangling link": (lambda file: file.symlink_to("nowhere"), "exists already"),
    "no folder": (lambda file: file.parent.rmdir(), "No such file or directory.*a folder that exists"),
}


@pytest.mark.parametrize("case", TAKEN)
def test_a_rig_file_takes_no_other_file_s_place(tmp_path, case):
    make, words = TAKEN[case]
    file = tmp_path / "rigs" / "rig.json"
    file.parent.mkdir()
    make(file)
    before = file.read_text() if file.is_file() else sorted(tmp_path.rglob("*"))
    with pytest.raises(ValueError, match=f"{file}: .*{words}"), written_rig_file(Quiet(), file):
        pytest.fail("it was written")
    assert (file.read_text() if file.is_file() else sorted(tmp_path.rglob("*"))) == before


def replace_by_another(file):
    file.unlink()
    file.write_text("another")


@pytest.mark.parametrize("change", [lambda file: file.write_text("mine"), replace_by_another])
def test_a_rig_file_that_somebody_changed_stays(tmp_path, change, capsys):
    file = tmp_path / "rig.json"
    with written_rig_file(Quiet(), file):
        assert json.loads(file.read_text()) == {"plan": {}}
        change(file)
        changed = file.read_bytes()
    assert file.read_bytes() == changed and f"{file}: was changed, so it stays" in capsys.readouterr().out


def test_a_rig_file_on_a_full_disk_leaves_nothing(tmp_path, little_space):
    with little_space(5), pytest.raises(ValueError, match="rig.json: cannot be written .File too large.: name another"):
        with written_rig_file(Quiet(), tmp_path / "rig.json"):
            pytest.fail("it was written")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_rig_file_ends_the_command_line_at_once(tmp_path, capsys):
    file = tmp_path / "rig.json"
    file.write_text("mine")
    assert command_line.main(["emulate", "--rig-file", str(file)]) == 1
    assert f"error: {file}: exists already" in capsys.readouterr().err and file.read_text() == "mine"


def test_the_command_line_cleans_up(tmp_path):
    file = tmp_path / "rig.json"
    call = [sys.executable, "-m", "lrfcal_lib", "emulate", "--rig-file", str(file)]
    run = subprocess.Popen(call, stdout=subprocess.PIPE, text=True)
    until(lambda: file.exists() or run.poll() is not None)
    said = "".join(iter(run.stdout.readline, f"  rig file {file}   python -m lrfcal_lib record --help\n"))
    assert "place/NUMBER puts it at 1, 2" in said
    devices = json.loads(file.read_text())["devices"]
    folder = Path(devices["lrf"]["port"]).parent
    port = serial.Serial(devices["lrf"]["port"], 9600, timeout=DEADLINE)
    port.write(bytes.fromhex("02 00 01 00 3A 1E 12"))
    assert port.read(30)[5:6] == b"\xba"
    order = urllib.request.Request(f"{devices['control']}/place/1", method="POST")
    assert urllib.request.urlopen(order, timeout=DEADLINE).status == 204
    run.send_signal(signal.SIGTERM)
    assert "the emulated rig is gone" in run.communicate(timeout=DEADLINE)[0] and run.returncode == 0
    assert not file.exists() and not folder.exists()
    port.close()
