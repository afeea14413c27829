"""The line method: exact recovery, Jacobians, invariance, covariance, bad input; and what all camera methods share."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic import camera_case, camera_observations

from lrfcal_lib.fit.least_squares import whiten
from lrfcal_lib.fit.residuals import edge_residuals_px, line_block, plane_residuals_m
from lrfcal_lib.model.geometry import DegenerateGeometry, move_pose, pose_array, transform_difference
from lrfcal_lib.solvers import METHODS
from lrfcal_lib.solvers.lines import cost_readings, find_outlying_placements, solve_lines, solve_lines_batch
from lrfcal_lib.solvers.planes import start_from_lines, start_from_planes, start_from_scene, starting_transform

OFF = RigidTransform.from_components([0.05, -0.04, 0.06], Rotation.from_rotvec([0.05, -0.04, 0.03]))


def increment(found, truth):
    """Error as [w, v]."""
    turn = found.rotation * truth.rotation.inv()
    return np.concatenate([turn.as_rotvec(), found.translation - truth.translation], axis=-1)


def line_data(obs):
    return obs.crossing_points, obs.crossing_covariance, obs.crossing_lines, obs.crossing_line_sigma, obs.model


@pytest.mark.parametrize("source", ["lrf", "platform"])
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("given", [True, False])
def test_every_method_recovers_exact_data(name, source, given):
    rig, obs = camera_case(1, source=source)
    found = METHODS[name].solve(obs, rig.T_camera_lrf * OFF if given else None)
    angle, distance = transform_difference(found.transform, rig.T_camera_lrf)
    assert angle < 1e-9 and distance < 1e-9
    assert found.converged and found.unobservable == ()
    assert found.covariance.shape == (len(found.names),) * 2 and np.isfinite(found.covariance).all()


@pytest.mark.parametrize("name", METHODS)
def test_every_method_is_invariant_to_the_source_frame(name):
    rig, obs = camera_case(2, noise=1.0, source="platform")
    move = RigidTransform.from_components([0.3, -0.2, 0.5], Rotation.from_rotvec([0.4, 0.2, -0.7]))
    R = move.rotation.as_matrix()
    groups = {f"{g}_points": move.apply(getattr(obs, f"{g}_points")) for g in ("crossing", "plane", "scene")}
    spreads = {f"{g}_covariance": R @ getattr(obs, f"{g}_covariance") @ R.T for g in ("crossing", "plane", "scene")}
    spreads["crossing_noise"] = R @ obs.crossing_noise @ R.T
    spreads["crossing_half_step"] = obs.crossing_half_step @ R.T
    here = METHODS[name].solve(obs, rig.T_camera_lrf)
    there = METHODS[name].solve(replace(obs, **groups, **spreads), rig.T_camera_lrf * move.inv())
    angle, distance = transform_difference(there.transform * move, here.transform)
    assert angle < 1e-7 and distance < 1e-7


@pytest.mark.parametrize("name", METHODS)
def test_every_method_refuses_values_that_are_not_finite(name):
    _, obs = camera_case(3)
    field = METHODS[name].uses + "_points"
    points = getattr(obs, field).copy()
    points[2, 1] = np.nan
    with pytest.raises(ValueError, match=f"{field} of camera 'left' is not finite in row 2"):
        METHODS[name].solve(replace(obs, **{field: points}))


@pytest.mark.parametrize("name", METHODS)
def test_every_method_refuses_one_placement_only(name):
    _, obs = camera_case(4)
    one = obs.select([1])
    if METHODS[name].uses == "scene":
        one = replace(one, **{f: getattr(one, f)[:1] for f in vars(one) if f.startswith("scene_")})
    with pytest.raises(DegenerateGeometry, match="unobservable|do not determine"):
        METHODS[name].solve(one)


@pytest.mark.parametrize("name", METHODS)
def test_error_falls_with_more_placements_and_agrees_with_the_covariance(name):
    errors, scores = {}, []
    for count in (8, 32):
        rig, obs = camera_case(5, count)
        rng = np.random.default_rng(6)
        errors[count] = []
        for _ in range(25):
            poses = [RigidTransform.from_matrix(m) for m in obs.board_poses]
            noisy = camera_observations(rng, rig, poses, noise=1.0)
            found = METHODS[name].solve(noisy, rig.T_camera_lrf)
            e = increment(found.transform, rig.T_camera_lrf)
            errors[count].append(np.linalg.norm(e[3:]))
            scores.append(e @ np.linalg.solve(found.covariance[:6, :6], e) / 6)
    assert np.median(errors[32]) < 0.75 * np.median(errors[8])
    assert 0.6 < np.mean(scores) < 1.6


def test_residuals_are_pixels_with_their_sign():
    rig, obs = camera_case(7)
    np.testing.assert_allclose(edge_residuals_px(obs, rig.T_camera_lrf), 0, atol=1e-9)
    np.testing.assert_allclose(plane_residuals_m(obs, rig.T_camera_lrf), 0, atol=1e-12)
    outside = replace(obs, crossing_lines=obs.crossing_lines + [0, 0, 2.5])
    np.testing.assert_allclose(edge_residuals_px(outside, rig.T_camera_lrf), 2.5, atol=1e-9)
    np.testing.assert_array_equal(np.isnan(plane_residuals_m(obs.select([2]), rig.T_camera_lrf)), False)
    unknown = replace(obs, plane_placement=obs.plane_placement + 100)
    assert np.isnan(plane_residuals_m(unknown, rig.T_camera_lrf)).all()


def test_lines_move_with_other_intrinsics():
    rig, obs = camera_case(8)
    other = rig.model.with_parameters(rig.model.parameters + [0, 0, 0, 0, 0.02, 0, 0, 0, 0])
    np.testing.assert_allclose(
        edge_residuals_px(obs, rig.T_camera_lrf, rig.model), edge_residuals_px(obs, rig.T_camera_lrf), atol=1e-6
    )
    assert np.abs(edge_residuals_px(obs, rig.T_camera_lrf, other)).max() > 0.05


def test_line_jacobian_against_a_numeric_one():
    rig, obs = camera_case(9, noise=1.0)
    pose = pose_array(rig.T_camera_lrf * OFF)
    J = line_block(pose, *line_data(obs)).jacobian
    for k, step in enumerate(1e-6 * np.eye(6)):
        high, low = (line_block(move_pose(pose, s), *line_data(obs)).residuals for s in (step, -step))
        np.testing.assert_allclose(J[:, k], (high - low) / 2e-6, rtol=1e-6, atol=1e-5)


def test_scipy_agrees():
    rig, obs = camera_case(10, noise=1.0)
    start = pose_array(rig.T_camera_lrf)
    theirs = scipy.optimize.least_squares(
        lambda d: whiten(line_block(move_pose(start, d), *line_data(obs)), jacobian=False)[0],
        np.zeros(6),
        xtol=1e-15,
        ftol=1e-15,
    )
    ours = solve_lines(obs, rig.T_camera_lrf)
    np.testing.assert_allclose(pose_array(ours.transform), move_pose(start, theirs.x), atol=2e-6)
    assert ours.chi2 / 2 == pytest.approx(theirs.cost, rel=1e-9)


def test_batch_equals_single():
    rig, obs = camera_case(11, noise=1.0)
    rng = np.random.default_rng(12)
    points = obs.crossing_points + rng.normal(0, 0.002, (4, *obs.crossing_points.shape)) * [1, 1, 0]
    rest = line_data(obs)[1:]
    batch = solve_lines_batch(points, *rest, rig.T_camera_lrf, groups=obs.crossing_placement)
    for i in range(4):
        single = solve_lines(replace(obs, crossing_points=points[i]), rig.T_camera_lrf)
        np.testing.assert_allclose(batch.transform.as_matrix()[i], single.transform.as_matrix(), atol=1e-8)
        np.testing.assert_allclose(batch.covariance[i], single.covariance, rtol=1e-4)
        np.testing.assert_allclose(batch.covariance_placements[i], single.covariance_placements, rtol=1e-3)


def test_predicted_covariance_in_a_thousand_trials():
    rig, obs = camera_case(13, count=20)
    rng = np.random.default_rng(14)
    root = np.linalg.cholesky(obs.crossing_covariance + 1e-16 * np.eye(3))
    points = obs.crossing_points + (root @ rng.normal(size=(1000, *obs.crossing_points.shape, 1)))[..., 0]
    lines = np.repeat(obs.crossing_lines[None], 1000, axis=0)
    lines[..., 2] += rng.normal(0, obs.crossing_line_sigma, lines.shape[:2])
    found = solve_lines_batch(
        points, obs.crossing_covariance, lines, obs.crossing_line_sigma, obs.model, rig.T_camera_lrf
    )
    e = increment(found.transform, rig.T_camera_lrf)
    nees = np.einsum("bi,bij,bj->b", e, np.linalg.inv(found.covariance), e) / 6
    assert 0.9 < nees.mean() < 1.1
    bias = e.mean(axis=0) / (e.std(axis=0) / np.sqrt(1000))
    assert np.abs(bias).max() < 4.5


def test_robust_loss_resists_wrong_edges():
    rig, obs = camera_case(15, count=20, noise=1.0)
    lines = obs.crossing_lines.copy()
    lines[::10, 2] += 60.0
    spoiled = replace(obs, crossing_lines=lines)
    plain = transform_difference(solve_lines(spoiled).transform, rig.T_camera_lrf)[1]
    robust = transform_difference(solve_lines(spoiled, loss="cauchy").transform, rig.T_camera_lrf)[1]
    assert robust < 0.03 and robust < 0.5 * plain


def test_unweighted_lines_are_plain_least_squares():
    rig, obs = camera_case(16, noise=1.0)
    start = pose_array(rig.T_camera_lrf)
    theirs = scipy.optimize.least_squares(
        lambda d: line_block(move_pose(start, d), *line_data(obs)).residuals, np.zeros(6), xtol=1e-15, ftol=1e-15
    )
    ours = solve_lines(obs, rig.T_camera_lrf, weighted=False)
    np.testing.assert_allclose(pose_array(ours.transform), move_pose(start, theirs.x), atol=2e-6)


@pytest.mark.parametrize("start", [start_from_planes, start_from_lines, start_from_scene])
@pytest.mark.parametrize("source", ["lrf", "platform"])
def test_starts_without_a_guess(start, source):
    rig, obs = camera_case(17, count=15, noise=1.0, source=source)
    angle, distance = transform_difference(start(obs), rig.T_camera_lrf)
    assert angle < 0.05 and distance < 0.1


def test_lines_alone_are_enough_to_start():
    rig, obs = camera_case(18, count=15)
    bare = replace(obs, **{f: getattr(obs, f)[:0] for f in vars(obs) if f.startswith(("plane_", "scene_"))})
    bare = replace(
        bare, **{f: getattr(obs, f)[:0] for f in ("placements", "board_poses", "board_covariance", "pattern_pixels")}
    )
    angle, distance = transform_difference(solve_lines(bare).transform, rig.T_camera_lrf)
    assert angle < 1e-9 and distance < 1e-9


def test_nothing_to_start_from():
    _, obs = camera_case(19)
    with pytest.raises(DegenerateGeometry, match="no start value.*planes:.*lines:.*scene:"):
        starting_transform(obs.select([]))


def test_parallel_edges_leave_a_motion_open():
    rig, obs = camera_case(20, count=6)
    line = np.array([1.0, 0.0, -rig.model.cx])
    lines = np.repeat(line[None], len(obs.crossing_lines), axis=0)
    points = rig.T_camera_lrf.inv().apply(
        np.column_stack([0 * lines[:, 0], obs.crossing_points[:, 0], 2 + obs.crossing_points[:, 1]])
    )
    with pytest.raises(DegenerateGeometry, match="do not determine .*translation along"):
        solve_lines(replace(obs, crossing_lines=lines, crossing_points=points), rig.T_camera_lrf)
    found = solve_lines(replace(obs, crossing_lines=lines, crossing_points=points), rig.T_camera_lrf, required=False)
    assert len(found.unobservable) >= 2 and any("along y" in words for words in found.unobservable)


def test_a_product_of_distances_vanishes_when_one_edge_fits():
    rig, obs = camera_case(21)
    lines = obs.crossing_lines.copy()
    for placement in np.unique(obs.crossing_placement):
        rows = np.flatnonzero(obs.crossing_placement == placement)
        lines[rows[0], 2] += 10.0
    costs = cost_readings(replace(obs, crossing_lines=lines), rig.T_camera_lrf, [0, 0, 0, 1, 0, 0], [0.0, 0.01])
    assert costs["squared product"][0] < 1e-12 < costs["sum of squares"][0]
    assert all(values.shape == (2,) for values in costs.values())


def test_readings_need_pairs_of_edges():
    rig, obs = camera_case(22)
    single = replace(obs, crossing_edge=np.full(len(obs.crossing_edge), "left"))
    with pytest.raises(ValueError, match="crossings on two edges"):
        cost_readings(single, rig.T_camera_lrf, np.ones(6), [0.0])


@pytest.mark.parametrize("kind", ["planes", "lines"])
def test_outlying_placements_are_found_untold(kind):
    rig, obs = camera_case(23, count=16, noise=1.0, source="platform")
    shift = np.where(np.isin(obs.placements, (4, 9)), 0.08, 0.0)
    poses = obs.board_poses.copy()
    poses[:, :3, 3] += shift[:, None] * poses[:, :3, 2]
    lines = obs.crossing_lines.copy()
    lines[np.isin(obs.crossing_placement, (4, 9)), 2] += 15.0
    report = find_outlying_placements(replace(obs, board_poses=poses, crossing_lines=lines), kind)
    assert set(report.outlying) == {4, 9} and len(report.inliers) == 14
    assert np.all(report.rms[[3, 8]] > report.limit[[3, 8]])


def test_good_placements_are_left_alone():
    _, obs = camera_case(24, count=16, noise=1.0, source="platform")
    assert find_outlying_placements(obs, "planes").outlying == ()
    with pytest.raises(ValueError, match="unknown kind 'edges'"):
        find_outlying_placements(obs, "edges")
