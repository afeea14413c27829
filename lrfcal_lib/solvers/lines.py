"""Cameras from lines (equations 16 to 21), after Wasielewski and Strauss, and after Bauermann."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.covariance import inverse_root
from lrfcal_lib.fit.least_squares import Block, minimise, minimise_in_rounds
from lrfcal_lib.fit.residuals import (
    moved_noise,
    noise_correction,
    sight_block,
    sight_normals,
)
from lrfcal_lib.fit.result import Solution
from lrfcal_lib.model.camera import mirrored, pinhole_jacobian
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    apply_pose,
    gradient_by_pose,
    length_of,
    move_pose,
    pose_transform,
    rotate_and_move,
)
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.solvers.plane_start import on_planes, sizes_of_minima
from lrfcal_lib.solvers.planes import solve_pose

ROTATIONS = 200  # random ones, beside the 24 of a cube
AHEAD = 0.8  # of the points at least lie before the camera


def distance_block(pose: np.ndarray, obs: CameraObservations) -> Block:
    """Distances of crossings from the planes of sight (Wasielewski and Strauss), metres, with the
    noise of both.

    Two residuals of one thing: that of :func:`lrfcal_lib.fit.residuals.line_block` is larger by
    focal length / depth.
    """
    normals = sight_normals(obs.crossing_lines, obs.model)
    length = length_of(obs.crossing_lines @ obs.model.matrix)
    plain = sight_block(pose, obs.crossing_points, normals)
    depth = apply_pose(pose, obs.crossing_points)[..., 2]
    noise = moved_noise(pose, normals, obs.crossing_covariance)
    of_sight = obs.crossing_line_sigma * depth / length  # metres at the crossing
    variance = np.vecdot(noise, normals) + of_sight**2
    return replace(plain, whitener=variance**-0.5)


def point_block(pose: np.ndarray, obs: CameraObservations) -> Block:
    """Reprojection errors of named points (Bauermann), pixels; a loss judges u and v of a point
    together.
    """
    rotated, moved = rotate_and_move(pose, obs.scene_points)
    errors = mirrored(moved, obs.model) - obs.scene_pixels
    by_point = pinhole_jacobian(moved, obs.model)

    # u and v, two scalars of one point
    rotated = rotated[..., None, :]
    moved = moved[..., None, :]
    covariance = obs.scene_covariance[..., None, :, :]
    pulled = moved_noise(pose[..., None, :, :], by_point, covariance)
    noise = by_point @ pulled.mT + obs.scene_sigma_px[..., None, None] ** 2 * np.eye(2)
    shift = np.linalg.solve(noise, errors[..., None]).mT @ pulled
    jacobian = gradient_by_pose(rotated, by_point)
    correction = noise_correction(rotated, moved, by_point, shift)
    return Block.of_groups(errors, jacobian, inverse_root(noise), jacobian - correction)


def estimate_pose(
    residual,
    obs: CameraObservations,
    pose: np.ndarray,
    *,
    method: str,
    uses: str,
    weighted: bool = True,
    **options,
) -> Solution:
    """The pose of a camera by least squares.

    Parameters
    ----------
    residual : callable
        ``residual(pose, obs) -> Block``.
    obs : CameraObservations
    pose : ndarray, shape (..., 3, 4)
        Start value of ``T_camera_source``.
    method, uses : str
        Its name, and the kind of observations that the residual has rows of.
    weighted : bool
        Without weights every residual counts the same: the mean of their propagated variances.
    **options
        Of :func:`lrfcal_lib.fit.least_squares.minimise`.

    Returns
    -------
    Solution
    """
    problem: Callable = partial(residual, obs=obs)
    if not weighted:
        equally = partial(_equally, problem)
        problem, pose = minimise_in_rounds(equally, pose, move_pose, 2, **options)
    placements = getattr(obs, f"{uses}_placement")
    return solve_pose(
        problem, pose, obs.camera, method=method, groups=placements, **options
    )


def _equally(problem, pose, _):
    """The problem with one weight for all residuals, that of their mean variance at a pose."""
    start = problem(pose)
    *trials, n = start.residuals.shape
    roots = np.linalg.inv(start.whitener.reshape(*trials, -1, start.size, start.size))
    variance = np.sum(roots**2, axis=(-3, -2, -1)) / n

    def plain(pose):
        block = problem(pose)
        return Block(block.residuals, block.jacobian, variance[..., None] ** -0.5)

    return plain


def start_from_lines(obs: CameraObservations) -> RigidTransform:
    """From crossings and the image lines of their edges.

    Many rotations at once, each with its best translation, refined on planes of sight; robust vote.
    """
    obs.require("crossing")
    points = obs.crossing_points
    normals = sight_normals(obs.crossing_lines, obs.model)
    drawn = Rotation.random(ROTATIONS, rng=np.random.default_rng(0))
    rotations = Rotation.concatenate([Rotation.create_group("O"), drawn])
    poses = on_planes(rotations.as_matrix(), normals, 0.0, points)

    def evaluate(pose):
        return sight_block(pose, points, normals)

    for robust in (False, True):
        poses = minimise(evaluate, poses, move_pose, robust=robust, max_iterations=40).state
    depth = apply_pose(poses, points)[..., 2]
    ahead = (depth > 0).mean(axis=1) > AHEAD
    if not ahead.any():
        raise DegenerateGeometry(
            f"camera '{obs.camera}': no pose puts the {len(points)} points in front of the camera"
        )
    poses = poses[ahead]
    sines = evaluate(poses).residuals / depth[ahead]
    return pose_transform(poses[np.argmin(sizes_of_minima(sines**2))])
