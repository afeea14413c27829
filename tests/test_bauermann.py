"""Bauermann: reprojection of named points."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic import camera_case

from lrfcal_lib.fit.least_squares import whiten
from lrfcal_lib.model.geometry import DegenerateGeometry, move_pose, pose_array, transform_difference
from lrfcal_lib.solvers.lines import point_block, solve_bauermann

OFF = RigidTransform.from_components([0.05, -0.04, 0.06], Rotation.from_rotvec([0.05, -0.04, 0.03]))


def make(seed, noise=1.0, count=10):
    return camera_case(seed, count, noise=noise)


def data(obs):
    return obs.scene_points, obs.scene_covariance, obs.scene_pixels, obs.scene_sigma_px, obs.model


def test_jacobian_against_a_numeric_one():
    rig, obs = make(1)
    pose = pose_array(rig.T_camera_lrf * OFF)
    J = point_block(pose, *data(obs)).jacobian
    for k, step in enumerate(1e-6 * np.eye(6)):
        high, low = (point_block(move_pose(pose, s), *data(obs)).residuals for s in (step, -step))
        np.testing.assert_allclose(J[:, k], (high - low) / 2e-6, rtol=1e-6, atol=1e-5)


def test_corrected_jacobian_is_the_gradient_of_chi_square():
    rig, obs = make(2)
    pose = pose_array(rig.T_camera_lrf)
    r, J = whiten(point_block(pose, *data(obs)))
    for k, step in enumerate(1e-6 * np.eye(6)):
        high, low = (np.sum(whiten(point_block(move_pose(pose, s), *data(obs)))[0] ** 2) for s in (step, -step))
        assert (J.T @ r)[k] == pytest.approx((high - low) / 4e-6, rel=1e-4, abs=1e-3)


def test_a_covariance_matters():
    """A point known badly along the ray only does not pull; one known badly across it must be weighed down."""
    rig, obs = make(3, noise=0.0)
    points, covariance = obs.scene_points.copy(), obs.scene_covariance.copy()
    points[0] += [0.3, 0.0, 0.2]
    covariance[0] += 0.5**2 * np.eye(3)
    weighed = solve_bauermann(replace(obs, scene_points=points, scene_covariance=covariance), rig.T_camera_lrf)
    trusted = solve_bauermann(replace(obs, scene_points=points), rig.T_camera_lrf)
    near, far = (transform_difference(s.transform, rig.T_camera_lrf)[1] for s in (weighed, trusted))
    assert near < 1e-3 < far


def test_gross_errors_are_survived_without_a_guess():
    rig, obs = make(4)
    pixels = obs.scene_pixels.copy()
    pixels[::9] += 150.0
    found = solve_bauermann(replace(obs, scene_pixels=pixels), loss="cauchy", scale="auto")
    assert transform_difference(found.transform, rig.T_camera_lrf)[1] < 0.03
    assert found.weights.reshape(-1, 2)[::9].max() < 0.05


def test_points_on_one_line_are_refused():
    rig, obs = make(5, noise=0.0, count=3)
    points = np.linspace([0.0, 1.5, -0.2], [0.2, 1.5, 0.3], 12)
    q = rig.T_camera_lrf.apply(points)
    pixels = q[:, :2] / q[:, 2:] * [rig.model.fx, rig.model.fy] + [rig.model.cx, rig.model.cy]
    line = replace(obs, scene_points=points, scene_pixels=pixels)
    with pytest.raises(DegenerateGeometry, match="do not determine rotation about"):
        solve_bauermann(line, rig.T_camera_lrf)


def test_two_points_are_refused():
    rig, obs = make(6)
    few = replace(obs, **{f: getattr(obs, f)[:2] for f in vars(obs) if f.startswith("scene_") and f != "scene_px"})
    with pytest.raises(DegenerateGeometry, match="2 scene points, at least 3 needed"):
        solve_bauermann(few, rig.T_camera_lrf)
