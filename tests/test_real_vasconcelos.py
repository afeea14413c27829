"""Vasconcelos' demo: 12 board planes and scan lines, two of them gross outliers."""

import numpy as np
import pytest
import scipy.io

from lrfcal_lib.fit.residuals import plane_residuals_m
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.solvers import find_outlying_placements, solve_camera


@pytest.fixture(scope="module")
def obs(real_data):
    demo = scipy.io.loadmat(real_data / "vasconcelos_demo12" / "DemoData.mat")
    scans = [np.asarray(scan, float).T / 1000 for scan in demo["Points"].ravel()]
    poses = np.moveaxis(demo["Planes"].astype(float), 2, 0).copy()
    poses[:, :3, 3] /= 1000
    points = np.concatenate(
        [np.column_stack([scan, np.zeros(len(scan))]) for scan in scans]
    )
    return CameraObservations(
        CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0),
        plane_points=points,
        plane_covariance=np.tile(0.01**2 * np.eye(3), (len(points), 1, 1)),
        plane_placement=np.repeat(np.arange(1, 13), [len(scan) for scan in scans]),
        placements=np.arange(1, 13),
        board_poses=poses,
        board_covariance=np.zeros((12, 6, 6)),
    )


def rms_mm(obs, solution):
    return 1000 * np.sqrt(np.mean(plane_residuals_m(obs, solution.transform) ** 2))


def test_all_twelve_planes_disagree(obs):
    assert rms_mm(obs, solve_camera(obs, "zhang_pless")) == pytest.approx(39.57, abs=0.01)


def test_gross_outliers_are_found_untold(obs):
    inliers, outlying = find_outlying_placements(obs)
    assert list(outlying) == [3, 5] and min(outlying.values()) > 0.1
    inliers = obs.select(inliers)
    assert rms_mm(inliers, solve_camera(inliers, "zhang_pless")) < 5.76


def test_nine_inliers_give_the_reference(obs):
    inliers = obs.select([1, 2, 4, 6, 7, 8, 10, 11, 12])
    found = solve_camera(inliers, "zhang_pless")
    assert rms_mm(inliers, found) == pytest.approx(5.7558, abs=1e-3)
    np.testing.assert_allclose(
        1000 * found.transform.translation, [1470.28, 434.34, 118.20], atol=0.05
    )
