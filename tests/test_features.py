"""Section II: what a distance to a point, a line or a plane leaves of space."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lrfcal_lib.model import geometry

ORIGIN, UP = np.zeros(3), np.array([0.0, 0.0, 1.0])


def test_counted_shell_has_its_volume():
    rng = np.random.default_rng(1)
    tries = geometry.ball(3.0, 400_000, rng)
    share = geometry.point_set(tries, ORIGIN, 2.0, 0.1).mean()
    volume = 4 / 3 * np.pi * 27
    sigma = volume * np.sqrt(share * (1 - share) / len(tries))
    assert abs(volume * share - geometry.shell_volume(2.0, 0.1)) < 4 * sigma


@pytest.mark.parametrize("angle_deg", [90.0, 60.0, 35.0])
def test_counted_crossing_of_cylinders_has_its_volume(angle_deg):
    radius, angle = 0.5, np.radians(angle_deg)
    reach = radius / np.sin(angle / 2)
    tries = geometry.ball(1.05 * reach, 400_000, np.random.default_rng(3))
    other = np.array([0.0, np.sin(angle), np.cos(angle)])
    inside = geometry.line_set(tries, ORIGIN, UP, radius, 0) & geometry.line_set(tries, ORIGIN, other, radius, 0)
    counted = inside.mean() * 4 / 3 * np.pi * (1.05 * reach) ** 3
    np.testing.assert_allclose(counted, geometry.crossing_volume(radius, angle), rtol=0.02)


def test_perpendicular_lines_leave_least():
    angles = np.radians(np.arange(1, 180))
    volumes = geometry.crossing_volume(1.0, angles)
    assert np.argmin(volumes) == 89
    np.testing.assert_allclose(volumes, volumes[::-1])
    assert geometry.crossing_volume(1.0, 0.0) == np.inf


def test_sets_turn_with_their_feature():
    rng = np.random.default_rng(4)
    positions, turn, shift = rng.normal(size=(500, 3)), Rotation.random(rng=rng), rng.normal(size=3)
    moved = turn.apply(positions) + shift
    direction = turn.apply(UP)
    for kind in (geometry.line_set, geometry.plane_set):
        before = kind(positions, ORIGIN, UP, 0.8, 0.05)
        assert 0 < before.sum() < 500
        np.testing.assert_array_equal(kind(moved, shift, direction, 0.8, 0.05), before)
    np.testing.assert_array_equal(
        geometry.point_set(moved, shift, 1.0, 0.2), geometry.point_set(positions, ORIGIN, 1.0, 0.2)
    )


def test_a_plane_is_seen_from_its_front_only():
    heights = np.array([-0.2, 0.0, 0.5, 1.0, 1.2])[:, None] * UP
    np.testing.assert_array_equal(geometry.plane_set(heights, ORIGIN, UP, 1.0, 0.01), [False, True, True, True, False])


def test_the_papers_board_is_not_quite_right_angled():
    assert np.degrees(geometry.triangle_angle(3.0, 4.0, 5.0)) == pytest.approx(90.0)
    assert np.degrees(geometry.triangle_angle(0.315, 0.380, 0.491)) == pytest.approx(89.4, abs=0.05)
    with pytest.raises(ValueError, match="1.0, 1.0 and 3.0 make no triangle"):
        geometry.triangle_angle(1.0, 1.0, 3.0)
