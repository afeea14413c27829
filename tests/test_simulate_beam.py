"""The simulated laser range finder: unbiased on planes, mixed pixels of the spot's size, noise, reasons."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.simulate.beam import LMS221, echo, ideal_readings, scan
from lrfcal_lib.simulate.scene import Thing, World, plain
from lrfcal_lib.simulate.shapes import rectangle

HEAD = RigidTransform.identity()
UPRIGHT = Rotation.from_euler("x", 90, degrees=True)
OFFSETS = np.arange(-0.06, 0.06, 2e-4)  # of beams from an edge, metres


def sheet(distance, turn=0.0, width=20.0, shift=0.0, **material):
    """A wall across the y axis of the rig, turned about the vertical."""
    turned = Rotation.from_euler("z", turn, degrees=True) * UPRIGHT
    pose = RigidTransform.from_components([shift, distance, 0.0], turned)
    return Thing(rectangle(width, 20.0), (plain, (0.6,) * 3), pose, **material)


def readings(things, bearings, beam=LMS221, pitch=0.0, head=HEAD):
    return ideal_readings(beam, World(things), bearings, pitch + 0 * bearings, head)[0]


@pytest.mark.parametrize("turn", [0.0, 25.0, -45.0])
@pytest.mark.parametrize("distance", [1.0, 2.0, 4.0])
def test_ranges_of_a_plane_are_unbiased(distance, turn):
    bearings = np.radians(np.arange(87.0, 93.1, 0.25))
    a = np.radians(turn)
    true = (
        distance * np.cos(a) / (np.sin(bearings) * np.cos(a) - np.cos(bearings) * np.sin(a))
    )
    assert abs(np.mean(readings([sheet(distance, turn)], bearings) - true)) < 1e-4


@pytest.mark.parametrize(
    "spot", [(0.012, 0.0044), (0.016, 0.0119)]
)  # of the LMS200 and the LMS221
@pytest.mark.parametrize("distance", [1.0, 2.0, 4.0])
def test_a_step_mixes_over_the_width_of_the_spot(spot, distance):
    """Of a uniform disc, between 5 % and 95 % lie on one side of an edge over 0.805 of its diameter."""
    front = sheet(distance, width=10.0, shift=5.0, infrared=0.5)  # right half
    back = sheet(
        distance + 0.4, infrared=0.5 * ((distance + 0.4) / distance) ** 2
    )  # as bright from there
    beam = replace(LMS221, rings=6, spot_exit=spot[0], divergence=spot[1])
    diameter = spot[0] + spot[1] * distance
    reading = readings([front, back], np.pi / 2 - np.arctan(OFFSETS / distance), beam)
    ends = np.hypot(OFFSETS, distance) * np.array([[1.0], [(distance + 0.4) / distance]])
    share = (ends[1] - reading) / (ends[1] - ends[0])
    assert np.sum((share > 0.05) & (share < 0.95)) * 2e-4 == pytest.approx(
        0.805 * diameter, rel=0.1
    )
    assert OFFSETS[np.argmin(np.abs(share - 0.5))] == pytest.approx(
        0.0, abs=0.05 * diameter
    )


def test_echo_takes_the_first_that_is_strong_enough():
    beam = replace(LMS221, least_energy=0.2, least_share=0.3)
    distance = np.array(
        [
            [1.0, 1.5, 4.0],
            [1.0, 4.0, 4.2],
            [1.0, np.inf, np.inf],
            [np.inf] * 3,
            [1.0, 3.0, 6.0],
        ]
    )
    energy = np.array(
        [[0.1, 0.3, 0.5], [0.1, 0.5, 0.5], [0.1, 0.0, 0.0], [0.0] * 3, [0.25, 1.0, 1.0]]
    )
    reading, total = echo(beam, distance, energy)
    np.testing.assert_allclose(reading, [1.375, 4.1, np.nan, np.nan, 3.0])
    np.testing.assert_allclose(total, [0.9, 1.1, 0.1, 0.0, 2.25])


@pytest.mark.parametrize("unit", [0.001, 0.01])
def test_noise_offset_and_rounding_of_scans(unit):
    beam = replace(LMS221, field_of_view=100, systematic=0.02, unit=unit)
    words = scan(
        beam, World([sheet(2.0)]), np.zeros((60, 1)), HEAD, np.random.default_rng(0)
    )
    error = words * unit - 2.0 / np.sin(beam.bearings())
    assert words.shape == (60, 201) and np.mean(error) == pytest.approx(0.02, abs=5e-4)
    assert np.std(error) == pytest.approx(np.hypot(0.010, unit / np.sqrt(12)), rel=0.05)
