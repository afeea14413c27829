"""The simulated laser range finder: unbiased on planes, mixed pixels of the spot's size, codes, bad settings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.simulate.beam import (
    DAZZLED,
    LMS200,
    LMS221,
    MIRROR_TURN,
    NOT_VALID,
    TOO_FAR,
    WEAK,
    echo,
    encode,
    ideal_readings,
    scan,
    spot_pattern,
)
from lrfcal_lib.simulate.scene import Thing, World, plain, rectangle

HEAD = RigidTransform.identity()
UPRIGHT = Rotation.from_euler("x", 90, degrees=True)


def sheet(distance, turn=0.0, width=20.0, shift=0.0, **material):
    """A wall across the y axis of the rig, turned about the vertical."""
    turned = Rotation.from_euler("z", turn, degrees=True) * UPRIGHT
    pose = RigidTransform.from_components([shift, distance, 0.0], turned)
    return Thing(rectangle(width, 20.0), plain((0.6,) * 3), pose, **material)


@pytest.mark.parametrize("turn", [0.0, 25.0, -45.0])
@pytest.mark.parametrize("distance", [1.0, 2.0, 4.0])
def test_ranges_of_a_plane_are_unbiased(distance, turn):
    bearings = np.radians(np.arange(87.0, 93.1, 0.25))
    reading, _, _ = ideal_readings(LMS221, World([sheet(distance, turn)]), bearings, 0 * bearings, HEAD)
    a = np.radians(turn)
    true = distance * np.cos(a) / (np.sin(bearings) * np.cos(a) - np.cos(bearings) * np.sin(a))
    assert abs(np.mean(reading - true)) < 1e-4


def test_the_plane_is_met_through_the_tilted_head():
    head = RigidTransform.from_components([0.02, -0.03, 0.06], Rotation.from_rotvec([0.01, -0.02, 0.03]))
    bearings, pitch = np.radians([85.0, 90.0, 100.0]), np.radians([-10.0, 0.0, 12.0])
    reading, _, _ = ideal_readings(LMS221, World([sheet(2.0)]), bearings, pitch, head)
    p_head = head.apply(reading[:, None] * np.stack([np.cos(bearings), np.sin(bearings), 0 * bearings], axis=1))
    y = p_head[:, 1] * np.cos(pitch) - p_head[:, 2] * np.sin(pitch)
    np.testing.assert_allclose(y, 2.0, atol=2e-4)


@pytest.mark.parametrize("device", [LMS200, LMS221])
@pytest.mark.parametrize("distance", [1.0, 2.0, 4.0])
def test_a_step_mixes_over_the_width_of_the_spot(device, distance):
    """Of a uniform disc, between 5 % and 95 % lie on one side of an edge over 0.805 of its diameter."""
    front = sheet(distance, width=10.0, shift=5.0, infrared=0.5)  # right half
    back = sheet(distance + 0.4, infrared=0.5 * ((distance + 0.4) / distance) ** 2)  # as bright from there
    offsets = np.arange(-0.06, 0.06, 2e-4)
    bearings = np.pi / 2 - np.arctan(offsets / distance)
    reading, _, _ = ideal_readings(replace(device, rings=6), World([front, back]), bearings, 0 * bearings, HEAD)
    ends = np.stack([np.hypot(offsets, distance), np.hypot(offsets, distance) * (distance + 0.4) / distance])
    share = (ends[1] - reading) / (ends[1] - ends[0])
    width = np.sum((share > 0.05) & (share < 0.95)) * 2e-4
    assert width == pytest.approx(0.805 * device.spot(distance), rel=0.1)
    assert offsets[np.argmin(np.abs(share - 0.5))] == pytest.approx(0.0, abs=0.05 * device.spot(distance))


def test_surfaces_a_pulse_apart_do_not_mix():
    front, back = sheet(2.0, width=10.0, shift=5.0, infrared=0.1), sheet(4.0, infrared=0.6)
    offsets = np.arange(-0.06, 0.06, 2e-4)
    bearings = np.pi / 2 - np.arctan(offsets / 2.0)
    reading, _, _ = ideal_readings(LMS221, World([front, back]), bearings, 0 * bearings, HEAD)
    near = reading < 3.0
    assert np.all(np.minimum(np.abs(reading - 2.0), np.abs(reading - 4.0)) < 5e-3)
    # the front needs a quarter of the back's echo: a share p of the disc with 0.025 p >= 0.25 * 0.0375 (1 - p)
    edge = offsets[near].min() / (LMS221.spot(2.0) / 2)
    share = 0.25 * 0.0375 / (0.025 + 0.25 * 0.0375)
    t = np.linspace(-1, 1, 4001)
    disc = (np.arccos(t) - t * np.sqrt(1 - t**2)) / np.pi  # part of the disc beyond t
    assert -edge == pytest.approx(t[np.argmin(np.abs(disc - share))], abs=0.1)


def test_echo_takes_the_first_that_is_strong_enough():
    beam = replace(LMS221, least_energy=0.2, least_share=0.3)
    distance = np.array([[1.0, 1.5, 4.0], [1.0, 4.0, 4.2], [1.0, np.inf, np.inf], [np.inf] * 3, [1.0, 3.0, 6.0]])
    energy = np.array([[0.1, 0.3, 0.5], [0.1, 0.5, 0.5], [0.1, 0.0, 0.0], [0.0] * 3, [0.25, 1.0, 1.0]])
    reading, total = echo(beam, distance, energy)
    np.testing.assert_allclose(reading, [1.375, 4.1, np.nan, np.nan, 3.0])
    np.testing.assert_allclose(total, [0.9, 1.1, 0.1, 0.0, 2.25])


def test_the_spot_has_the_moments_of_a_disc():
    disc = spot_pattern(4)
    assert len(disc) == LMS221.rays == 61
    np.testing.assert_allclose(disc.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(disc.T @ disc / len(disc), np.eye(2) / 4, atol=0.01)


def test_noise_offset_and_rounding_of_scans():
    beam = replace(LMS221, field_of_view=100, resolution=50, systematic=0.02)
    got = scan(beam, World([sheet(2.0)]), np.zeros((60, 1)), HEAD, np.random.default_rng(0))
    true = 2.0 / np.sin(beam.bearings())
    assert got.ranges.shape == (60, 201)
    np.testing.assert_array_equal(got.ranges, got.words * 0.001)
    assert np.mean(got.ranges - true) == pytest.approx(0.02, abs=5e-4)
    assert np.std(got.ranges - true) == pytest.approx(0.010, rel=0.05)


def test_codes_stand_where_there_is_no_range():
    readings = np.array([1.0, 9.0, np.nan, np.nan, 2.0])
    total, dazzled = np.array([1.0, 1.0, 0.0, 1e-6, 9.0]), np.array([False] * 4 + [True])
    got = encode(LMS221, readings, total, dazzled)
    np.testing.assert_array_equal(got.words, [1000, TOO_FAR, NOT_VALID, WEAK, DAZZLED])
    np.testing.assert_array_equal(got.ranges, [1.0, np.nan, np.nan, np.nan, np.nan])


def test_neighbours_of_a_fine_scan_are_turns_apart():
    times = replace(LMS221, field_of_view=100, resolution=25).beam_times()
    step = np.diff(times[:5]) - np.radians(0.25) / (2 * np.pi) * MIRROR_TURN
    np.testing.assert_allclose(step, np.array([1, 1, 1, -3]) * MIRROR_TURN, atol=1e-12)
    assert len(LMS221.beam_times()) == 361 and np.all(np.diff(replace(LMS221, resolution=100).beam_times()) > 0)


def test_a_moving_head_smears_a_fine_scan():
    beam = replace(LMS221, field_of_view=100, resolution=25, sigma_range=0.0)
    ceiling = Thing(rectangle(40, 40), plain((0.6,) * 3), RigidTransform.from_translation([0, 0, 1.0]))
    pitch = np.radians(30) + np.radians(5.0) * beam.beam_times()
    got = scan(beam, World([ceiling]), pitch[None], HEAD, np.random.default_rng(0)).ranges[0]
    middle = got[180:221]
    turns = np.arange(180, 221) % 4
    assert middle[turns == 0].mean() - middle[turns == 3].mean() > 0.003
