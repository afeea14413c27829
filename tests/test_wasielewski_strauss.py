"""Wasielewski-Strauss: distances from planes of sight."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic import camera_case

from lrfcal_lib.fit.least_squares import whiten
from lrfcal_lib.fit.residuals import edge_residuals_px, sight_normals
from lrfcal_lib.model.geometry import DegenerateGeometry, move_pose, pose_array
from lrfcal_lib.solvers.lines import distance_block, solve_lines, solve_wasielewski_strauss

OFF = RigidTransform.from_components([0.05, -0.04, 0.06], Rotation.from_rotvec([0.05, -0.04, 0.03]))


@pytest.fixture
def noisy():
    return camera_case(1, 15, noise=1.0)


def test_distance_is_the_pixel_distance_scaled_by_depth(noisy):
    rig, obs = noisy
    normals, length = sight_normals(obs.crossing_lines, obs.model)
    pose = pose_array(rig.T_camera_lrf * OFF)
    metres = distance_block(pose, obs, normals, length).residuals
    depth = obs.crossing_points @ pose[2, :3] + pose[2, 3]
    np.testing.assert_allclose(
        metres * length / depth, edge_residuals_px(obs, rig.T_camera_lrf * OFF), rtol=1e-9, atol=1e-9
    )


def test_jacobians_against_numeric_ones(noisy):
    rig, obs = noisy
    sight = sight_normals(obs.crossing_lines, obs.model)
    pose = pose_array(rig.T_camera_lrf * OFF)
    block = distance_block(pose, obs, *sight)
    white = whiten(block)[1]
    for k, step in enumerate(1e-6 * np.eye(6)):
        high, low = (distance_block(move_pose(pose, s), obs, *sight) for s in (step, -step))
        np.testing.assert_allclose(block.jacobian[:, k], (high.residuals - low.residuals) / 2e-6, atol=1e-8)
        numeric = (whiten(high)[0] - whiten(low)[0]) / 2e-6
        np.testing.assert_allclose(white[:, k], numeric, atol=1e-5 * np.abs(white).max())


def test_weighted_it_equals_the_line_method(noisy):
    rig, obs = noisy
    lines = solve_lines(obs, rig.T_camera_lrf)
    sight = solve_wasielewski_strauss(obs, rig.T_camera_lrf, weighted=True)
    difference = np.abs(sight.parameters - lines.parameters) / lines.sigma
    assert difference.max() < 0.1


def test_as_published_it_is_plain_least_squares_in_space(noisy):
    rig, obs = noisy
    sight = sight_normals(obs.crossing_lines, obs.model)
    start = pose_array(rig.T_camera_lrf)
    theirs = scipy.optimize.least_squares(
        lambda d: distance_block(move_pose(start, d), obs, *sight).residuals,
        np.zeros(6),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    ours = solve_wasielewski_strauss(obs)
    np.testing.assert_allclose(pose_array(ours.transform), move_pose(start, theirs.x), atol=2e-6)


def test_too_few_crossings_are_refused(noisy):
    _, obs = noisy
    with pytest.raises(DegenerateGeometry, match="at least 6 needed"):
        solve_wasielewski_strauss(obs.select([1]))


def test_infinite_covariance_is_refused(noisy):
    _, obs = noisy
    covariance = obs.crossing_covariance.copy()
    covariance[0, 0, 0] = np.inf
    with pytest.raises(ValueError, match="crossing_covariance .* not finite in row 0"):
        solve_wasielewski_strauss(replace(obs, crossing_covariance=covariance))
