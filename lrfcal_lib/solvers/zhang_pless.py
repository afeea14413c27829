"""Camera from planes (Zhang and Pless 2004): scan points on the board lie in the plane that the camera sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lrfcal_lib.camera import project, project_jacobians
from lrfcal_lib.solvers.camera import plane_residuals_m, read_pose
from lrfcal_lib.solvers.least_squares import Block, minimise, solve
from lrfcal_lib.solvers.planes import (
    board_whitener,
    check_normals,
    compress,
    correct_and_compress,
    equal_weights,
    plane_block,
    plane_sets,
    plane_terms,
)
from lrfcal_lib.solvers.pose import (
    POSE_NAMES,
    apply_pose,
    motion_words,
    move_pose,
    pose_array,
    rotate_points,
)
from lrfcal_lib.solvers.start import closed_form, start_from_planes, starting_transform

TILT_LEVER = 0.3  # metres, about half a board: turns an offset into the tilt that bends as much
INTRINSIC_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "k5")
INTRINSIC_SCALES = (1e3, 1e3, 1e3, 1e3, 10.0, 10.0, 10.0, 10.0, 100.0)

__all__ = [
    "closed_form",
    "solve_zhang_pless",
    "solve_zhang_pless_batch",
    "solve_zhang_pless_joint",
    "start_from_planes",
]


def solve_zhang_pless(obs, T0=None, *, loss=None, scale=1.0, weighted=True, max_iterations=60, required=True):
    """The pose of a camera from the board's planes.

    Parameters
    ----------
    obs : CameraObservations
        Its plane points and board poses are used.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``; a closed form that survives outlying placements when left out.
    loss : {None, 'huber', 'cauchy'}
        Robust loss for whole placements (a bad board pose spoils all points of its placement), with `scale`.
    scale : float or 'auto'
    weighted : bool
        True: by the points' covariance across the board and, correlated within a placement, that of the board's pose.
        False: plain least squares, every point counts the same.
    max_iterations : int
    required : bool
        False: report unobservable motions instead of raising.

    Returns
    -------
    Solution
        Residuals are four numbers a placement (see :mod:`lrfcal_lib.solvers.planes`), in standard deviations; the
        distances themselves come from :func:`lrfcal_lib.solvers.camera.plane_residuals_m`.

    Raises
    ------
    DegenerateGeometry
        With fewer than three placements, or when all boards are parallel or turn about one axis only.
    ValueError
        When an observation is not finite.
    """
    sets = plane_sets(obs, 3 if required else 1)
    if required:
        check_normals(sets, obs.camera)
    T0 = starting_transform(obs, ("planes",), required) if T0 is None else T0
    options = dict(loss=loss, scale=scale, max_iterations=max_iterations)
    return _refine(sets, pose_array(T0), weighted, obs.camera, required=required, **options)


def solve_zhang_pless_batch(sets, T0, *, loss=None, scale=1.0, weighted=True, max_iterations=60):
    """:func:`solve_zhang_pless` for many trials at once.

    Parameters
    ----------
    sets : PlaneSets
        With leading trial axis b in `points`, `covariance` and `boards`.
    T0 : RigidTransform
        One start value, or a stack of b.
    loss, scale, weighted, max_iterations
        See :func:`solve_zhang_pless`.

    Returns
    -------
    Solution
        With leading axes b.
    """
    batch = np.broadcast_shapes(sets.points.shape[:-3], sets.boards.shape[:-3])
    start = np.broadcast_to(pose_array(T0), batch + (3, 4))
    return _refine(sets, start, weighted, "camera", loss=loss, scale=scale, max_iterations=max_iterations)


def _refine(sets, pose, weighted, camera, *, loss, scale, max_iterations, required=True):
    """Iterate with the compression renewed, from an unweighted estimate: weights of a bad pose would hold it there."""
    earlier = []
    for weigh in (False, True, True, True, True) if weighted else ():
        evaluate, _ = _compressed(sets, pose, weigh)
        pose, _, _, history = minimise(evaluate, pose, move_pose, loss=loss, scale=scale, max_iterations=max_iterations)
        earlier.append(history)
    evaluate, rest = _compressed(sets, pose, weighted)
    count = int(sets.count.sum())
    return solve(
        evaluate,
        pose,
        move_pose,
        names=POSE_NAMES,
        method="zhang_pless",
        read=read_pose,
        words=lambda d: motion_words(d, camera),
        groups=np.repeat(sets.placements, 4),
        freedom=count - 6,
        loss=loss,
        scale=scale,
        max_iterations=max_iterations,
        required=required,
        n_observations=count,
        chi2_rest=rest,
        earlier=earlier,
    )


def _compressed(sets, pose, weighted):
    """The plane problem with points compressed at a pose, and the chi-square that this leaves out."""
    if weighted:
        triangles, offset, rest = correct_and_compress(sets, pose)
        whitener = board_whitener(pose, triangles, sets.boards, sets.board_covariance)
        return lambda p: plane_block(p, triangles, sets.boards, whitener, offset=offset), rest
    triangles = compress(sets, equal_weights(sets, pose))
    return lambda p: plane_block(p, triangles, sets.boards, None, sets.count), 0.0


def solve_zhang_pless_joint(obs, T0=None, *, sigma_plane=None, loss=None, scale=1.0, max_iterations=60, required=True):
    """Pose, intrinsics and board poses together: pattern reprojection plus point-plane distances.

    Parameters
    ----------
    obs : CameraObservations
        Its plane points and pattern corners are used; its board poses and ``model`` are the start values.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``.
    sigma_plane : float, optional
        Standard deviation of an error that all points of a placement have in common (a bent board, a wrong pitch),
        metres; from :func:`plane_error` when left out. Without it thousands of points would overrule the pattern.
    loss, scale, max_iterations, required
        See :func:`solve_zhang_pless`. The loss judges single pattern corners, and the scan of a placement as a whole.

    Returns
    -------
    Solution
        ``model`` holds the refined intrinsics with their covariance, ``board_poses`` the refined boards, `parameters`
        pose and intrinsics.

    Raises
    ------
    ValueError
        Without pattern corners.
    DegenerateGeometry
        See :func:`solve_zhang_pless`.
    """
    sets = plane_sets(obs, 3 if required else 1)
    if required:
        check_normals(sets, obs.camera)
    if obs.pattern_points.shape[0] < 4 or not np.isfinite(obs.pattern_pixels).any():
        raise ValueError(
            f"camera '{obs.camera}': {len(obs.pattern_points)} pattern corners, a joint "
            "refinement needs a printed pattern"
        )
    first = solve_zhang_pless(obs, T0, loss=loss, scale=scale, required=required)
    pose = pose_array(first.transform)
    triangles, offset, rest = correct_and_compress(sets, pose)
    error = plane_error(obs, first) if sigma_plane is None else sigma_plane
    data = _joint_data(obs, sets, triangles, offset, board_whitener(pose, triangles, sets.boards, _common_error(error)))
    found = solve(
        lambda state: _joint_blocks(state, *data),
        (pose, obs.model.parameters, obs.board_poses[:, :3]),
        _move_joint,
        names=POSE_NAMES + INTRINSIC_NAMES,
        method="zhang_pless_joint",
        read=_read_joint,
        shared=15,
        loss=loss,
        scale=scale,
        scales=(1.0,) * 6 + INTRINSIC_SCALES,
        freedom=_joint_freedom(obs, sets),
        max_iterations=max_iterations,
        required=required,
        chi2_rest=rest,
        n_observations=int(sets.count.sum() + np.isfinite(obs.pattern_pixels).sum()),
    )
    rms = _pattern_rms(found, 2 * len(obs.pattern_points), obs.pattern_sigma_px)
    model = obs.model.with_parameters(found.parameters[6:], found.covariance[6:, 6:], rms)
    poses = np.repeat(np.eye(4)[None], len(obs.placements), axis=0)
    poses[:, :3] = found.state[2]
    return replace(found, model=model, board_poses=poses)


def plane_error(obs, solution):
    """Size of the errors common to a placement: rms over the placements of their mean distance, metres.

    Zero where chi-square agrees with the stated noise (``solution.inflation`` is 1).
    """
    if solution.inflation == 1.0:
        return 0.0
    distance = plane_residuals_m(obs, solution.transform)
    known = np.isfinite(distance)
    _, index = np.unique(obs.plane_placement[known], return_inverse=True)
    mean = np.bincount(index, distance[known]) / np.bincount(index)
    return float(np.sqrt(np.mean(mean**2)))


def _common_error(sigma):
    """Covariance of a board's pose that stands for an error common to a placement: offset, and tilt over a lever."""
    return np.diag([(sigma / TILT_LEVER) ** 2] * 3 + [sigma**2] * 3)


def _joint_data(obs, sets, triangles, offset, whitener):
    """Triangles for every placement of the camera (zero where nothing was scanned), and the pattern."""
    where = [int(np.flatnonzero(obs.placements == placement)[0]) for placement in sets.placements]
    every, whiteners = np.zeros((2, len(obs.placements), 4, 4))
    offsets = np.zeros((len(obs.placements), 4))
    every[where], offsets[where], whiteners[where] = triangles, offset, whitener
    return every, offsets, whiteners, obs.pattern_points, obs.pattern_pixels, obs.pattern_sigma_px, obs.model


def _joint_freedom(obs, sets):
    return int(sets.count.sum() + np.isfinite(obs.pattern_pixels).sum()) - 15 - 6 * len(obs.placements)


def _joint_blocks(state, triangles, offset, whitener, corners, pixels, sigma_px, model):
    """Pattern and plane residuals by placement; unknowns: pose 6, intrinsics 9, then the placement's board pose 6."""
    pose, intrinsics, boards = state
    residuals, by_pose, by_board = plane_terms(pose, triangles, boards, offset)
    middle = np.zeros(residuals.shape + (9,))
    planes = Block(residuals, np.concatenate([by_pose, middle, by_board], axis=-1), whitener[:, None])
    camera = model.with_parameters(intrinsics)
    q, rotated = apply_pose(boards, corners), rotate_points(boards, corners)
    by_point, by_intrinsics = project_jacobians(q, camera)
    seen = np.isfinite(pixels)
    errors = np.where(seen, project(q, camera) - np.where(seen, pixels, 0.0), 0.0)
    by_corner = np.stack([_pose_rows(rotated, by_point[..., i, :]) for i in range(2)], axis=-2)
    zero = np.zeros(by_corner.shape[:-1] + (6,))
    jacobian = np.concatenate([zero, by_intrinsics, by_corner], axis=-1)
    p = len(boards)
    pattern = Block(errors.reshape(p, -1), jacobian.reshape(p, -1, 21), seen.reshape(p, -1) / sigma_px)
    return [planes, pattern]


def _pose_rows(rotated, gradient):
    return np.concatenate([np.cross(rotated, gradient), gradient], axis=-1)


def _move_joint(state, step):
    common, own = step
    return move_pose(state[0], common[:6]), state[1] + common[6:], move_pose(state[2], own)


def _read_joint(state):
    transform, parameters = read_pose(state[0])
    return transform, np.concatenate([parameters, state[1]])


def _pattern_rms(found, width, sigma_px):
    """Root mean square distance of the pattern corners (per corner, as OpenCV counts it), pixels."""
    errors = found.residuals[:, -width:] * sigma_px
    seen = np.any(found.jacobian[:, -width:] != 0, axis=-1)
    return float(np.sqrt(2 * np.sum(errors**2) / seen.sum()))
