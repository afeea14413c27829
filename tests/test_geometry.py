"""Frames, tilt axis, planes and lines."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model import geometry as g


def random_transform(rng, angle=1.0, shift=0.3):
    return RigidTransform.from_components(
        rng.normal(size=3) * shift, Rotation.from_rotvec(rng.normal(size=3) * angle)
    )


def test_polar_points_lie_in_the_scan_plane_at_their_range():
    p = g.polar_to_points([1.0, 2.0, np.nan], np.deg2rad([0.0, 90.0, 10.0]))
    np.testing.assert_allclose(p[:2], [[1, 0, 0], [0, 2, 0]], atol=1e-15)
    assert np.isnan(p[2]).all()


def test_tilt_is_the_rotation_about_x():
    rng = np.random.default_rng(2)
    p = rng.normal(size=(20, 3))
    pitch = rng.normal(size=20)
    np.testing.assert_allclose(
        g.tilt(p, pitch),
        Rotation.from_rotvec(np.outer(pitch, [1, 0, 0])).apply(p),
        atol=1e-14,
    )


@pytest.mark.parametrize("scale", [1.0, 0.1, 1e-7])
def test_the_axis_survives_every_chart(scale):
    T = random_transform(np.random.default_rng(4), 0.5 * scale, 0.2)
    axis = g.axis_of(T)
    for again in (g.head_from_axis(axis), g.head_from_paper(*g.paper_parameters(T))):
        angle, offset = g.axis_difference(axis, g.axis_of(again))
        assert angle < 1e-12 and offset < 1e-12


def test_turning_about_x_and_sliding_along_x_do_not_change_the_axis():
    T = random_transform(np.random.default_rng(5))
    other = RigidTransform.from_components([0.4, 0, 0], Rotation.from_euler("x", 0.7)) * T
    assert max(g.axis_difference(g.axis_of(T), g.axis_of(other))) < 1e-12


def test_plane_and_line_fits_recover_exact_data():
    rng = np.random.default_rng(8)
    normal, distance, rms = g.fit_plane(
        np.column_stack([rng.normal(size=(9, 2)), np.full(9, -2.0)])
    )
    np.testing.assert_allclose(np.r_[normal, distance], [0, 0, -1, 2], atol=1e-12)
    assert rms < 1e-9
    _, direction, rms = g.fit_line(np.outer(rng.normal(size=9), [1, 2, 2]) / 3 + 1)
    np.testing.assert_allclose(abs(direction @ [1, 2, 2]) / 3, 1, atol=1e-12)
    assert rms < 1e-7


@pytest.mark.parametrize(("function", "arguments", "words"), [
    (g.fit_plane, [np.zeros((2, 3))], "plane needs three"),
    (g.fit_plane, [np.outer(np.arange(5.0), [1, 1, 1])], "unobservable"),
    (g.fit_line, [np.ones((4, 3))], "two distinct points"),
])  # fmt: skip
def test_what_cannot_be_is_refused(function, arguments, words):
    with pytest.raises(ValueError, match=words):
        function(*arguments)
