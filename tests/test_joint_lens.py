"""What errors of the intrinsics do to the joint estimate, against doing it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from joint_draws import MOUNTS, draw, joint_step, misses_of, none
from scipy.optimize import approx_fprime
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate.joint_observations import pose_by_intrinsics
from lrfcal_lib.model.camera import CameraModel, project
from lrfcal_lib.model.geometry import move_pose, pose_array
from lrfcal_lib.solvers.joint import solve_again, solve_joint

CORNERS = np.array([[0.05 * i, 0.05 * j, 0.0] for i in range(5) for j in range(4)])
MODEL = CameraModel(
    1280, 960, 900.0, 905.0, 641.0, 478.0, np.array([-0.2, 0.08, 0.001, -0.001, 0.0])
)


def a_pose():
    return RigidTransform.from_components(
        [-0.1, 0.05, 1.4], Rotation.from_rotvec([0.3, -0.4, 0.2])
    )


@pytest.mark.parametrize(("index", "step"), [(0, 2.0), (2, 1.0), (3, -1.0), (4, 0.01)])
def test_pose_moves_as_predicted(index, step):
    T = a_pose()
    pixels = project(T.apply(CORNERS), MODEL)
    values = MODEL.parameters.copy()
    values[index] += step
    other = CameraModel(1280, 960, *values[:4], values[4:])
    start = cv2.Rodrigues(T.rotation.as_matrix())[0], T.translation[:, None].copy()
    _, w, t = cv2.solvePnP(
        CORNERS,
        pixels,
        other.matrix,
        other.distortion,
        *start,
        True,
        cv2.SOLVEPNP_ITERATIVE,
    )
    turn = (Rotation.from_rotvec(w[:, 0]) * T.rotation.inv()).as_rotvec()
    moved = np.r_[turn, t[:, 0] - T.translation]
    predicted = pose_by_intrinsics(T, CORNERS, MODEL)[:, index] * step
    assert np.linalg.norm(moved - predicted) < 0.1 * np.linalg.norm(moved) + 1e-6


@pytest.mark.parametrize("mount", ["head", "platform"])
def test_a_known_error_moves_the_estimate_as_the_covariance_says(mount):
    """A principal point of the first camera that is 1 px off, as a covariance of rank one and as a fact."""
    obs, _, rig = draw(np.random.default_rng(5), 10, mount=mount)
    poses = [RigidTransform.from_matrix(pose) for pose in obs.view_pose]
    lens = np.stack([pose_by_intrinsics(pose, CORNERS, rig.model) for pose in poses])
    error = np.zeros(9)
    error[2] = 1.0
    spread = np.zeros((len(obs.cameras), 9, 9))
    spread[0] = np.outer(error, error)
    known = solve_joint(obs)
    told = solve_again(replace(obs, view_lens=lens, lens_covariance=spread), known)
    mine = (obs.view_camera == 0)[:, None]
    turned = move_pose(
        np.stack([pose_array(pose) for pose in poses]), mine * (lens @ error)
    )
    view_pose = obs.view_pose.copy()
    view_pose[:, :3] = turned
    moved = solve_again(replace(obs, view_pose=view_pose), known)
    name = obs.cameras[0]
    one = known.transforms[name]
    two = moved.transforms[name]
    change = np.r_[
        (two.rotation * one.rotation.inv()).as_rotvec(), two.translation - one.translation
    ]
    columns = known.columns(name)
    predicted = np.sqrt(np.diag(told.lens))[columns]
    # less moves by as little as two minima differ
    large = predicted > 0.035 * known.solution.sigma[columns]
    assert large.any()
    np.testing.assert_allclose(np.abs(change[large]), predicted[large], rtol=0.15)
    change = (moved.residuals("view") - known.residuals("view"))[
        ..., None
    ]  # what no unknown takes up
    square = np.sum(np.swapaxes(change, 1, 2) @ np.linalg.inv(obs.view_covariance) @ change)
    left = 6 * (len(change) - len(obs.placements))
    assert (
        told.lens_scale == pytest.approx(np.sqrt(square / left), rel=0.1)
        and told.lens_scale > 0.05
    )


@MOUNTS
def test_scipy_carries_the_lens_into_the_poses_alike(mount):
    """Differences of residuals as one would write them down, solved for all unknowns at once."""
    obs, truth, rig = draw(np.random.default_rng(7), 6, mount=mount)
    obs = none(obs, "beam").keep(face=np.arange(len(obs.face_range)) % 3 == 0)
    poses = [RigidTransform.from_matrix(pose) for pose in obs.view_pose]
    lens = np.stack([pose_by_intrinsics(pose, CORNERS, rig.model) for pose in poses])
    pixels = np.diag([2.0, 2.0, 1.0, 1.0, 0.01, 0.01, 0.0, 0.0, 0.0]) ** 2
    spread = np.stack([pixels] * len(obs.cameras))
    obs = replace(obs, view_lens=lens, lens_covariance=spread)
    found = solve_joint(
        obs, start=truth, sensor=("range_offset",), axis=mount == "head", noise="stated"
    )
    unknowns = found.unknowns
    shared = unknowns.shared

    def residuals(x):
        return misses_of(unknowns.move(found.state, joint_step(x, unknowns)), obs)

    def with_lens(error):
        moved = replace(obs, view_pose=obs.view_pose.copy())
        by_view = np.einsum("nij,nj->ni", lens, error.reshape(-1, 9)[obs.view_camera])
        pose = np.stack([pose_array(pose) for pose in poses])
        moved.view_pose[:, :3] = move_pose(pose, by_view)
        return misses_of(found.state, moved)

    J = approx_fprime(np.zeros(6 * unknowns.size - 5 * shared), residuals, 1e-7)
    by_lens = approx_fprime(np.zeros(9 * len(obs.cameras)), with_lens, 1e-7)
    gain = -np.linalg.lstsq(J, by_lens)[0][:shared]
    whole = np.zeros((len(gain.T), len(gain.T)))
    for number, covariance in enumerate(spread):
        mine = slice(9 * number, 9 * number + 9)
        whole[mine, mine] = covariance
    theirs = gain @ whole @ gain.T
    size = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
    np.testing.assert_allclose(found.lens / size, theirs / size, atol=0.01)
