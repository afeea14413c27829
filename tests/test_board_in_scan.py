"""The board in a sweep, filtered ranges and lines, points on its face."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scanned_boards import (
    HEAD,
    TRIANGLE,
    facing,
    found,
    noisy_triangle,
    on_plane,
    scene,
    spoiled,
)

from lrfcal_lib.model.geometry import lrf_to_platform
from lrfcal_lib.preprocess import board_in_scan
from lrfcal_lib.preprocess.board_in_scan import BoardNotFound, fit_lines, median_filter


@pytest.mark.parametrize("wall", [None, 3.5, 1.9])
def test_the_board_and_nothing_else_is_found(wall):
    s = scene(wall=wall, sigma=0.004)
    b = found(s)
    assert np.mean(b.mask != s.on) < 1e-4
    assert abs(b.normal @ s.pose.rotation.apply([0, 0, 1.0])) > np.cos(1e-3)
    assert b.sigma_range == pytest.approx(0.004, rel=0.05)


def test_the_nearest_of_two_boards_is_taken_and_no_small_thing_before_it():
    near = scene()
    far = scene(pose=facing(2.6), wall=None)
    apart = scene(pose=facing(1.2, x=-0.5), wall=None)
    small = near.sweep.ranges.copy()
    small[10:16, 100:110] = 0.6
    for s, ranges, limit in (
        (near, np.fmin(near.sweep.ranges, far.sweep.ranges), 0.01),
        (apart, np.fmin(near.sweep.ranges, apart.sweep.ranges), 1e-3),
        (near, small, 0.01),
    ):
        assert np.mean(found(spoiled(s, ranges)).mask != s.on) < limit


def test_a_board_that_stands_on_the_floor_is_cut_out_of_it():
    s = scene(pose=facing(roll=0.0, tilt=10.0), wall=None, sigma=0.003)
    floor = on_plane(s.sweep, np.array([0.0, 0.0, 1.0]), s.pose.apply([0.4, 0.7, 0.0])[2])[
        0
    ]
    b = found(
        spoiled(
            s, np.fmin(s.sweep.ranges, np.where((floor > 0) & (floor < 6), floor, np.nan))
        )
    )
    assert np.mean(b.mask & ~s.on) < 0.01 and np.mean(s.on & ~b.mask) < 0.005


def shelf(s):
    """A shelf at the height of the sensor that a single scan line sees, triangular in the scan plane."""
    ranges = s.sweep.ranges.copy()
    ranges[12, 60:100] = 0.95 + 0.25 * np.abs(np.linspace(-1, 1, 40))
    return ranges


def edge_on(s):
    """Returns from a surface that is seen along itself."""
    flat = np.abs(np.degrees(s.sweep.bearings)[None] - 70) < 1.0
    ranges = np.full(s.on.shape, np.nan)
    depth = 1.0 + 0.5 * np.random.default_rng(0).random(s.on.shape) ** 0.5
    ranges[40:80] = np.where(flat, depth, np.nan)[40:80]
    return np.sort(ranges, axis=0)


def patchy(s):
    return np.where(
        np.random.default_rng(1).random(s.on.shape) < 0.75, np.nan, s.sweep.ranges
    )


MISSING = {
    "no return in 161 scan lines": (scene, lambda s: np.full_like(s.sweep.ranges, np.nan)),
    r"no flat surface of the board's size; seen: .* m2": (
        scene,
        lambda s: np.where(s.on, np.nan, s.sweep.ranges),
    ),
    "seen: no flat": (scene, lambda s: np.random.default_rng(0).uniform(1, 90, s.on.shape)),
    "on 1 of 161 scan lines": (noisy_triangle, lambda s: np.where(s.on, np.nan, shelf(s))),
    "seen along itself": (lambda: noisy_triangle(wall=None), edge_on),
    "filled to 2[0-9] %": (lambda: noisy_triangle(wall=None), patchy),
    r"seen: 0\.5\d m2": (
        lambda: replace(scene(wall=None), board=TRIANGLE),
        lambda s: s.sweep.ranges,
    ),
}


@pytest.mark.parametrize("message", MISSING)
def test_no_board_is_said_with_what_was_seen(message):
    make, change = MISSING[message]
    s = make()
    with pytest.raises(BoardNotFound, match=message):
        found(spoiled(s, change(s)))


def test_median_filter_is_the_median_of_what_exists():
    rng = np.random.default_rng(0)
    ranges = rng.random((7, 30))
    ranges[rng.random(ranges.shape) < 0.2] = np.nan
    mask = rng.random(ranges.shape) < 0.8
    taken = np.where(mask, ranges, np.nan)
    expected = pd.DataFrame(taken).T.rolling(5, min_periods=1, center=True).median().T
    np.testing.assert_array_equal(
        median_filter(ranges, mask, 5), np.where(np.isfinite(taken), expected, np.nan)
    )
    np.testing.assert_array_equal(median_filter(ranges, True, 1), ranges)
    assert np.isnan(median_filter(np.full((2, 3), np.nan), True)).all()
    for width in (0, 4, -1):
        with pytest.raises(ValueError, match=f"odd and positive, got {width}"):
            median_filter(ranges, True, width)


def test_lines_are_fitted_exactly_and_outliers_do_not_count():
    bearings = np.radians(np.arange(60, 121, 0.5))
    truth = np.array([[0.1, 0.5], [-0.3, 0.7], [0.0, 0.4]])
    ranges = 1 / (truth @ np.stack([np.cos(bearings), np.sin(bearings)]))
    np.testing.assert_allclose(fit_lines(ranges, bearings)[0], truth, atol=1e-12)
    ranges[:, ::9] += 0.3
    np.testing.assert_allclose(fit_lines(ranges, bearings)[0], truth, atol=1e-6)
    ranges[1, 3:] = np.nan
    assert np.isnan(fit_lines(ranges, bearings)[0][1]).all()


def test_face_points_lie_on_the_face_and_away_from_the_edges():
    s = scene(sigma=0.005)
    p_lrf, pitch, covariance = board_in_scan.face_points(found(s), 300)
    assert (
        p_lrf.shape == (300, 3)
        and pitch.shape == (300,)
        and covariance.shape == (300, 3, 3)
    )
    p = s.pose.inv().apply(lrf_to_platform(p_lrf, pitch, HEAD))
    lines = s.board.lines()
    assert (p[:, :2] @ lines[:, :2].T + lines[:, 2]).max() < -0.01
    normal = s.in_lrf([0, 0, 1.0], pitch)
    assert (
        0.8
        < np.mean(p[:, 2] ** 2 / np.einsum("ni,nij,nj->n", normal, covariance, normal))
        < 1.25
    )
    assert np.linalg.eigvalsh(covariance)[:, 1].min() > 0
