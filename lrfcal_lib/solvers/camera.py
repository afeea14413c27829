"""Camera from lines: a scan crosses the board's edges, the camera sees them as lines (eqs. 16-21)."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.camera import distort, line_through, undistort
from lrfcal_lib.solvers.checks import check_count, check_finite
from lrfcal_lib.solvers.least_squares import Block, minimise, solve
from lrfcal_lib.solvers.pose import (
    POSE_NAMES,
    gradient_by_pose,
    motion_words,
    move_pose,
    moved_noise,
    noise_correction,
    pose_array,
    pose_parameters,
    pose_transform,
    rotate_points,
)
from lrfcal_lib.solvers.start import starting_transform


def line_block(pose, points, covariance, lines, line_sigma, model):
    """Whitened-to-be distances d(e, ab) of projected crossings from their image lines.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
        ``T_camera_source``.
    points : ndarray, shape (..., n, 3)
        Crossings, source frame, metres.
    covariance : ndarray, shape (..., n, 3, 3)
    lines : ndarray, shape (..., n, 3)
        Undistorted pixel lines with unit normal.
    line_sigma : ndarray, shape (..., n)
        Pixels.
    model : CameraModel

    Returns
    -------
    Block
        Residuals in pixels; the whitener holds the crossing's covariance projected through the pinhole and the line's.

    Notes
    -----
    Equations (16), (19) and (20), with the sign of the distance. Behind the camera the formula goes on (mirrored), so
    that a poor start value can still find its way.
    """
    rotated = rotate_points(pose, points)
    q = rotated + pose[..., None, :, 3]
    a, b = lines[..., 0] * model.fx, lines[..., 1] * model.fy
    x, y, z = q[..., 0], q[..., 1], q[..., 2]
    slope = (a * x + b * y) / z
    residuals = slope + lines[..., 0] * model.cx + lines[..., 1] * model.cy + lines[..., 2]
    gradient = np.stack([a / z, b / z, -slope / z], axis=-1)
    shift = moved_noise(pose, gradient, covariance)
    variance = np.sum(shift * gradient, axis=-1) + np.asarray(line_sigma) ** 2
    jacobian = gradient_by_pose(rotated, gradient)
    corrected = jacobian - noise_correction(rotated, q, gradient, shift, residuals / variance)
    return Block(residuals, jacobian, 1.0 / np.sqrt(variance), corrected=corrected)


def solve_lines(obs, T0=None, *, loss=None, scale=1.0, weighted=True, max_iterations=60, required=True):
    """The pose of a camera from board edges (the method of the paper).

    Parameters
    ----------
    obs : CameraObservations
        Its crossings are used.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``; found by :func:`lrfcal_lib.solvers.start.starting_transform` when left out.
    loss : {None, 'huber', 'cauchy'}
        Robust loss for single crossings, with `scale` (standard deviations, or 'auto').
    scale : float or 'auto'
    weighted : bool
        False: every pixel distance counts the same, as the paper has it.
    max_iterations : int
    required : bool
        False: report unobservable motions instead of raising.

    Returns
    -------
    Solution

    Raises
    ------
    DegenerateGeometry
        With fewer than six crossings, or when they leave a motion open.
    ValueError
        When an observation is not finite.

    Notes
    -----
    Equation (21) is read as the sum of the *squared* distances. The covariance knows the edges' own noise;
    `covariance_placements` also covers what all crossings of one placement have in common.
    """
    check_finite(obs, "crossing")
    check_count(len(obs.crossing_points), 6, "crossings of scan lines with edges", obs.camera)
    T0 = starting_transform(obs) if T0 is None else T0
    data = (obs.crossing_points, obs.crossing_covariance, obs.crossing_lines, obs.crossing_line_sigma, obs.model)

    def evaluate(pose):
        return line_block(pose, *data)

    options = {"loss": loss, "scale": scale, "max_iterations": max_iterations, "required": required}
    about = {"camera": obs.camera, "groups": obs.crossing_placement, "method": "line"}
    return solve_pose(evaluate, T0, weighted=weighted, **about, **options)


def solve_pose(evaluate, T0, *, camera, groups, method, weighted=True, required=True, **options):
    """Solve for the pose of one camera: what the methods on edges and corners have in common.

    Parameters
    ----------
    evaluate : callable
        ``evaluate(pose array) -> Block``.
    T0 : RigidTransform
    camera, method : str
        For messages and the report.
    groups : ndarray of int
        Placement of every residual.
    weighted : bool
        False: every residual counts the same.
    required : bool
    **options
        ``loss``, ``scale`` and ``max_iterations`` of the least squares core.

    Returns
    -------
    Solution
    """
    pose, earlier = pose_array(T0), []
    if not weighted:
        evaluate, pose, earlier = equal_weights(evaluate, pose, **options)
    about = {"names": POSE_NAMES, "method": method, "read": read_pose, "words": lambda d: motion_words(d, camera)}
    return solve(evaluate, pose, move_pose, groups=groups, required=required, earlier=earlier, **about, **options)


def solve_paper_lines(obs, T0=None, **options):
    """The paper's own procedure: only crossings of scan lines, and every pixel counts the same.

    Parameters
    ----------
    obs : CameraObservations
        Made with the ``last_beam`` rule.
    T0 : RigidTransform, optional
    **options
        Of :func:`solve_lines`.

    Returns
    -------
    Solution

    Raises
    ------
    DegenerateGeometry, ValueError
        As :func:`solve_lines`.
    """
    return solve_lines(obs.along(), T0, weighted=False, **options)


def solve_lines_batch(
    points, covariance, lines, line_sigma, model, T0, *, groups=None, loss=None, scale=1.0, max_iterations=60
):
    """:func:`solve_lines` for many trials at once (Monte-Carlo).

    Parameters
    ----------
    points, covariance, lines, line_sigma : ndarray, shapes (b, n, 3), (b, n, 3, 3), (b, n, 3), (b, n)
        Any of them may lack the leading axis, or have it of length 1, when it is the same in all trials.
    model : CameraModel
    T0 : RigidTransform
        One start value, or a stack of b.
    groups : ndarray of int, shape (n,), optional
        Placement of each crossing.
    loss, scale, max_iterations
        See :func:`solve_lines`.

    Returns
    -------
    Solution
        With stacked transforms and leading axes b. Nothing is raised for degenerate trials: they do not converge.
    """
    batch = max(
        (a.shape[0] for a, d in ((points, 3), (lines, 3), (covariance, 4), (line_sigma, 2)) if np.ndim(a) == d),
        default=1,
    )
    start = np.broadcast_to(pose_array(T0), (batch, 3, 4))
    return solve(
        lambda pose: line_block(pose, points, covariance, lines, line_sigma, model),
        start,
        move_pose,
        names=POSE_NAMES,
        method="line",
        read=read_pose,
        groups=groups,
        loss=loss,
        scale=scale,
        max_iterations=max_iterations,
    )


def read_pose(pose):
    """Transform and parameters of a pose state."""
    return pose_transform(pose), pose_parameters(pose)


def equal_weights(evaluate, pose, **options):
    """Plain least squares: one weight for all residuals, from the mean of their propagated variances.

    Parameters
    ----------
    evaluate : callable
        ``pose -> Block`` with weights of its own.
    pose : ndarray, shape (3, 4)
        Start value.
    **options
        Of :func:`lrfcal_lib.solvers.least_squares.minimise`.

    Returns
    -------
    evaluate : callable
        ``pose -> Block`` with the common weight.
    pose : ndarray, shape (3, 4)
        The solution.
    earlier : list of ndarray
        Cost histories.
    """

    def plain(weight):
        def block(p):
            raw = evaluate(p)
            return Block(raw.residuals, raw.jacobian, np.full_like(raw.residuals, weight))

        return block

    earlier = []
    for _ in range(2):
        weight = np.mean(evaluate(pose).whitener ** -2.0) ** -0.5
        pose, _, _, history = minimise(plain(weight), pose, move_pose, **options)
        earlier.append(history)
    return plain(np.mean(evaluate(pose).whitener ** -2.0) ** -0.5), pose, earlier


def edge_residuals_px(obs, transform, model=None):
    """Signed distances of the projected crossings from their image lines, equation (20).

    Parameters
    ----------
    obs : CameraObservations
    transform : RigidTransform
        ``T_camera_source``.
    model : CameraModel, optional
        Other intrinsics than ``obs.model``: the image lines are then moved there (two points of each are distorted with
        the old model and undistorted with the new one).

    Returns
    -------
    ndarray, shape (n,)
        Undistorted pixels; positive outside the board.
    """
    lines = obs.crossing_lines if model is None else _moved_lines(obs, transform, model)
    sigma = np.ones(len(obs.crossing_points))
    return line_block(
        pose_array(transform), obs.crossing_points, obs.crossing_covariance, lines, sigma, model or obs.model
    ).residuals


def _moved_lines(obs, transform, model):
    """The image lines of the crossings under other intrinsics."""
    if len(obs.crossing_points) == 0:
        return obs.crossing_lines
    old, lines = obs.model, obs.crossing_lines
    q = transform.apply(obs.crossing_points)
    uv = q[:, :2] / q[:, 2:] * [old.fx, old.fy] + [old.cx, old.cy]
    foot = uv - (np.sum(uv * lines[:, :2], axis=1) + lines[:, 2])[:, None] * lines[:, :2]
    along = np.stack([-lines[:, 1], lines[:, 0]], axis=1) * 10.0
    focal, centre = np.array([old.fx, old.fy]), np.array([old.cx, old.cy])
    ends = [
        undistort(distort((p - centre) / focal, old.distortion) * focal + centre, model)
        for p in (foot - along, foot + along)
    ]
    found = line_through(*ends)
    return found * np.sign(np.sum(found[:, :2] * lines[:, :2], axis=1))[:, None]


def plane_residuals_m(obs, transform, board_poses=None):
    """Signed distances of the board-face points from the planes the camera sees.

    Parameters
    ----------
    obs : CameraObservations
    transform : RigidTransform
        ``T_camera_source``.
    board_poses : ndarray, shape (p, 4, 4), optional
        Other poses than ``obs.board_poses`` (of a joint refinement).

    Returns
    -------
    ndarray, shape (m,)
        Metres, along the board's z; NaN for placements whose board pose the camera does not know.
    """
    poses = obs.board_poses if board_poses is None else board_poses
    out = np.full(len(obs.plane_points), np.nan)
    if len(obs.placements) == 0 or len(out) == 0:
        return out
    index = np.searchsorted(obs.placements, obs.plane_placement, sorter=np.argsort(obs.placements))
    index = np.argsort(obs.placements)[np.minimum(index, len(obs.placements) - 1)]
    known = obs.placements[index] == obs.plane_placement
    normal, point = poses[index, :3, 2], poses[index, :3, 3]
    distance = np.sum(normal * (transform.apply(obs.plane_points) - point), axis=1)
    out[known] = distance[known]
    return out


def cost_readings(obs, transform, direction, steps):
    """Three readings of the garbled equation (21) along a line of parameters, for the notebook (not an estimator).

    Parameters
    ----------
    obs : CameraObservations
    transform : RigidTransform
        The pose at step 0.
    direction : array_like, shape (6,)
        ``[w, v]``.
    steps : array_like, shape (s,)
        Multiples of `direction`.

    Returns
    -------
    dict of str to ndarray, shape (s,)
        ``'sum of squares'`` d1^2 + d2^2, ``'squared sum'`` (d1 + d2)^2 and ``'squared product'`` (d1 d2)^2, each
        summed over the placements; d1 and d2 are the root mean square distances at a placement's first two edges.
        The product is zero as soon as one of the two edges fits.

    Raises
    ------
    ValueError
        When no placement has crossings on two edges.
    """
    pairs = _edge_pairs(obs)
    poses = move_pose(pose_array(transform), np.multiply.outer(np.asarray(steps, float), np.asarray(direction, float)))
    sigma = np.ones(len(obs.crossing_points))
    d2 = (
        line_block(poses, obs.crossing_points, obs.crossing_covariance, obs.crossing_lines, sigma, obs.model).residuals
        ** 2
    )
    first, second = (np.stack([d2[:, rows[i]].mean(axis=1) for rows in pairs], axis=1) for i in range(2))
    return {
        "sum of squares": np.sum(first + second, axis=1),
        "squared sum": np.sum((np.sqrt(first) + np.sqrt(second)) ** 2, axis=1),
        "squared product": np.sum(first * second, axis=1),
    }


def _edge_pairs(obs):
    """Row masks of the first two edges of every placement that has two."""
    pairs = []
    for placement in np.unique(obs.crossing_placement):
        here = obs.crossing_placement == placement
        names = np.unique(obs.crossing_edge[here])[:2]
        if len(names) == 2:
            pairs.append([here & (obs.crossing_edge == name) for name in names])
    if not pairs:
        raise ValueError(f"no placement of camera '{obs.camera}' has crossings on two edges: equation (21) needs pairs")
    return pairs
