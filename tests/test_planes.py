"""Zhang-Pless: closed form, refinement, joint refinement with the intrinsics, degenerate boards."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic import camera_case, camera_observations, random_board_poses, random_rig

from lrfcal_lib.fit.residuals import SIGMA_FLOOR, plane_residuals_m
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    pose_array,
    pose_transform,
    transform_difference,
)
from lrfcal_lib.solvers import plane_start, solve_camera
from lrfcal_lib.solvers.planes import (
    board_whitener,
    compress,
    correct_and_compress,
    plane_block,
    plane_sets,
)

OFF = RigidTransform.from_components(
    [0.05, -0.04, 0.06], Rotation.from_rotvec([0.05, -0.04, 0.03])
)


def test_correlated_weighting_equals_the_full_covariance():
    """Chi-square from four numbers a placement is that of all points with the board error common to them."""
    rig, obs = camera_case(6, noise=1.0)
    sets = plane_sets(obs)
    pose = pose_array(rig.T_camera_lrf)
    triangles, offset, rest = correct_and_compress(sets, pose)
    whitener = board_whitener(pose, triangles, sets.boards, sets.board_covariance)
    r = plane_block(pose, triangles, sets.boards, None, None, offset).residuals.reshape(
        12, 4
    )
    compressed = np.sum((whitener @ r[..., None]) ** 2) + rest
    expected = 0.0
    for g in range(12):
        n = sets.boards[g][:, 2]
        q = sets.points[g] @ pose[:, :3].T + pose[:, 3]
        lever = q - sets.boards[g][:, 3]
        distance = lever @ n
        slope = np.column_stack([np.cross(n, lever), np.tile(-n, (len(q), 1))])
        variance = (
            np.sum((sets.covariance[g] @ (pose[:, :3].T @ n)) * (pose[:, :3].T @ n), axis=1)
            + SIGMA_FLOOR**2
        )
        C = np.diag(variance) + slope @ sets.board_covariance[g] @ slope.T
        expected += distance @ np.linalg.solve(C, distance)
    assert compressed == pytest.approx(expected, rel=1e-3)


def test_joint_refinement_repairs_the_intrinsics():
    rig, obs = camera_case(13, count=25, noise=0.3, sigma_px=0.05)
    wrong = rig.model.with_parameters(
        rig.model.parameters + [8, -6, 5, -4, 0.02, -0.02, 0, 0, 0]
    )
    found = solve_camera(replace(obs, model=wrong), "zhang_pless_joint")
    assert found.converged and found.names[6:8] == ("fx", "fy")
    error = np.abs(found.model.parameters - rig.model.parameters)
    assert np.all(error < 4.5 * np.sqrt(np.diag(found.model.covariance)))
    assert error[:4].max() < 2.0
    assert found.model.rms_px == pytest.approx(0.3 * 0.05 * np.sqrt(2), rel=0.15)


def test_joint_refinement_bears_errors_common_to_a_placement():
    """Boards that bend by some millimetres must not bend the intrinsics."""
    rig, obs = camera_case(
        20, count=20, noise=1.0, sigma_px=0.1, source="platform", face=400
    )
    rng = np.random.default_rng(21)
    shift = rng.normal(0, 0.008, 21)[obs.plane_placement]
    along = obs.plane_points / np.linalg.norm(obs.plane_points, axis=1, keepdims=True)
    bent = replace(obs, plane_points=obs.plane_points + shift[:, None] * along)
    found = solve_camera(bent, "zhang_pless_joint")
    own = plane_residuals_m(replace(bent, board_poses=found.board_poses), found.transform)
    assert found.board_poses.shape == (20, 4, 4) and np.sqrt(np.mean(own**2)) < 0.013
    error = np.abs(found.model.parameters - rig.model.parameters)
    assert (error < 3 * np.sqrt(np.diag(found.model.covariance))).all(), (
        "and they know of it"
    )


def test_joint_refinement_needs_a_pattern():
    _, obs = camera_case(16, pattern=False)
    with pytest.raises(ValueError, match="0 pattern corners"):
        solve_camera(obs, "zhang_pless_joint")


@pytest.mark.parametrize("method", ["zhang_pless", "zhang_pless_joint"])
@pytest.mark.parametrize("source", ["lrf", "platform"])
def test_parallel_boards_are_refused(method, source):
    rig, obs = camera_case(17, spread=1e-4, source=source)
    with pytest.raises(
        DegenerateGeometry,
        match="all 12 boards are parallel: the rotation about their normal",
    ):
        solve_camera(obs, method, rig.T_camera_lrf)


def test_boards_turned_about_one_axis_are_refused():
    rng = np.random.default_rng(18)
    rig = random_rig(rng)
    poses = random_board_poses(rng, 8, rig, spread=1e-6)
    poses = [
        RigidTransform.from_components(
            p.translation, Rotation.from_rotvec([0, a, 0]) * p.rotation
        )
        for p, a in zip(poses, np.linspace(-0.6, 0.6, 8), strict=True)
    ]
    obs = camera_observations(rng, rig, poses, source="platform")
    with pytest.raises(
        DegenerateGeometry,
        match=r"turn about one axis only: the translation along \(.*1.00.*\)",
    ):
        solve_camera(obs, "zhang_pless")


@pytest.mark.parametrize(
    ("method", "source"),
    [("zhang_pless", "lrf"), ("zhang_pless", "platform"), ("line", "lrf")],
)
def test_any_start_value_reaches_the_best_minimum(method, source):
    rng, (_, obs) = np.random.default_rng(5), camera_case(6, 20, source=source, noise=1.0)
    best = solve_camera(obs, method).transform
    for turn in Rotation.random(6, rng=rng):
        far = RigidTransform.from_components(
            best.translation + rng.normal(0, 0.5, 3), turn * best.rotation
        )
        assert (
            transform_difference(solve_camera(obs, method, far).transform, best)[0] < 1e-6
        )


@pytest.mark.parametrize("seed", range(4))
def test_three_single_lines_have_the_truth_among_eight_poses(seed):
    rig, obs = camera_case(seed)
    sets = plane_sets(obs.select(obs.placements[:3]))
    found = plane_start.three_planes(compress(sets, 1.0), sets.boards)
    assert found.shape == (8, 3, 4)
    assert (
        min(
            max(transform_difference(pose_transform(pose), rig.T_camera_lrf))
            for pose in found
        )
        < 1e-7
    )


def test_a_second_minimum_is_handed_back_beside_the_best():
    """Three single lines fit several poses; nine fit one."""
    rig, obs = camera_case(3, noise=0.2)
    few = solve_camera(obs.select(obs.placements[:3]), "zhang_pless")
    poses = [few.transform, few.rival]
    assert min(transform_difference(pose, rig.T_camera_lrf)[0] for pose in poses) < 0.1
    assert transform_difference(*poses)[0] > plane_start.SAME_TURN
    assert solve_camera(obs, "zhang_pless").rival is None
