"""Projection, undistortion, pixel lines."""

import cv2
import numpy as np
import pytest

from lrfcal_lib.model import camera as c

MODEL = c.CameraModel(
    1280, 720, 700.0, 702.0, 640.0, 350.0, np.array([-0.17, 0.02, 0.001, -0.0004, 0.003])
)


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform([-1, -0.6, 1.5], [1, 0.6, 3], (60, 3))


def test_the_papers_distortion_is_opencvs(points):
    expected = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), MODEL.matrix, MODEL.distortion
    )[0][:, 0]
    np.testing.assert_allclose(c.project(points, MODEL), expected, atol=1e-9)


def test_undistort_undoes_the_lens(points):
    np.testing.assert_allclose(
        c.undistort(c.project(points, MODEL), MODEL), c.pinhole(points, MODEL), atol=1e-7
    )
    assert c.undistort(np.zeros((0, 2)), MODEL).shape == (0, 2)


def test_points_behind_the_camera_are_nan():
    behind = np.array([0.1, 0.1, -1.0])
    assert (
        np.isnan(c.project(behind, MODEL)).all()
        and np.isnan(c.pinhole(behind, MODEL)).all()
    )


def test_line_distance_is_signed_and_in_pixels():
    line = c.line_through([0, 0], [10, 0])
    np.testing.assert_allclose(
        c.line_distance([[3, 2], [3, -2], [99, 0]], line), [-2, 2, 0]
    )


def test_a_line_through_one_point_is_refused():
    with pytest.raises(ValueError, match="two different points"):
        c.line_through([1, 2], [1, 2])
