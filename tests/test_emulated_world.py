"""The world behind emulated devices: scans, images, and who moves its board."""

import urllib.error
import urllib.request
from copy import copy

import numpy as np
import pytest
from fake_rig import make_rig, rig_data
from test_emulated_rig import DEADLINE, SETUP, SMALL

from lrfcal_lib.drivers.port import DeviceError
from lrfcal_lib.emulators.head import Head
from lrfcal_lib.emulators.world import CameraServer, EmulatedWorld
from lrfcal_lib.simulate import beam as lrf
from lrfcal_lib.simulate.record import world_of
from lrfcal_lib.simulate.rig import placements_of

QUARTERS = np.arange(160, 561)


@pytest.fixture(scope="module")
def placements():
    return placements_of(SETUP)[:4]


@pytest.fixture(scope="module")
def made(placements):
    return EmulatedWorld(SETUP, placements=placements)


@pytest.fixture
def world(made):
    """With the board nowhere, whatever other tests did."""
    return copy(made)


@pytest.fixture
def small(placements):
    """A world whose images are small."""
    return EmulatedWorld(SMALL, placements=placements)


@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_a_scan_is_the_one_of_the_simulator_at_the_true_pitch_of_every_beam(
    world, placements, speed
):
    world.put("place/1")
    beam = SETUP.rig.beam
    start = float(np.mean(placements[0].sweep[:2]))
    world.head = Head(SETUP.rig.platform, pitch=start)
    world.head.move(0.0, start + 0.5, speed)
    times = 0.1 + QUARTERS % 4 / 75.08
    scans, _ = zip(*(world.scan(0, QUARTERS, times) for _ in range(30)), strict=True)
    pitch = world.head.pitch(times)
    still = world_of(SETUP, placements[0])
    ideal = lrf.ideal_readings(
        beam, still, beam.bearings(), pitch + 0 * times, SETUP.rig.T_head_lrf
    )[0]
    assert (np.ptp(pitch) > 0.01) == (speed > 0)
    error = np.array(scans) - beam.systematic - ideal
    assert np.nanstd(error) == pytest.approx(beam.sigma_range, rel=0.05)
    assert abs(np.nanmean(error)) < 5 * beam.sigma_range / np.sqrt(error.size)


def board_at(world, place):
    """Whether the board is where one of the places has it."""
    wanted = world_of(SETUP, world.places[place])
    return np.array_equal(world.current.offsets, wanted.offsets)


def test_the_board_is_moved_by_who_records(world):
    data = rig_data()
    driver = make_rig()
    assert (
        driver.move_board(1) is False and driver.hold_close("left", 0) is False
    )  # there it is a person
    server = CameraServer(world)
    data["devices"]["control"] = server.control
    driver = make_rig(data)
    assert driver.move_board(2) and board_at(world, "place/2")
    assert driver.hold_close("left", 3) and board_at(world, "close/left/3")
    for call, message in (
        (
            lambda: driver.move_board(9),
            "control http:.* 400 'no place/9; there are place/none, place/1, place/2, place/3, place/4, close/left/0, ...",
        ),
        (lambda: driver.move_board("x"), "no place/x"),
        (
            lambda: driver.hold_close("left", 99),
            "no close/left/99; there are .* close/right/11",
        ),
        (lambda: driver.hold_close("a/b", 0), "answers 400 'no close/a/b/0; there are"),
    ):
        with pytest.raises(DeviceError, match=message):
            call()
    server.close()
    with pytest.raises(
        DeviceError, match="is 'python -m lrfcal_lib emulate' still running"
    ):
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
    names = {"url": server.url, "control": server.control, "host": server.host}
    method, url, host = (text.format(**names) for text in STRANGE[order])
    request = urllib.request.Request(url, method=method, headers={"Host": host})
    with pytest.raises(urllib.error.HTTPError, match="40[34]"):
        urllib.request.urlopen(request, timeout=DEADLINE)
    assert board_at(world, "place/none")
    server.close()


def test_an_image_begun_before_a_move_is_not_sent(small):
    server = CameraServer(small)
    drawn = []

    def draw(name, scene, pitch):
        drawn.append(pitch)
        if len(drawn) == 1:
            small.head.go(small.host.now(), 0.05, 2.0)
        return b"%d" % len(drawn)

    server._draw = draw
    assert server.image("left", timeout=DEADLINE) == b"2"
    assert drawn[1] != drawn[0]
    server.close()
