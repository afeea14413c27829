"""Cameras from lines (eqs. 16-21), by likelihood, after Wasielewski and Strauss, after Bauermann; odd placements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from lrfcal_lib.fit.least_squares import Block, minimise, solve
from lrfcal_lib.fit.residuals import (
    edge_residuals_px,
    edge_shift,
    interval_terms,
    line_block,
    plane_residuals_m,
    read_pose,
    sight_block,
    sight_normals,
)
from lrfcal_lib.fit.result import check_count, check_finite
from lrfcal_lib.model.camera import pinhole_jacobian
from lrfcal_lib.model.geometry import (
    POSE_NAMES,
    apply_pose,
    gradient_by_pose,
    motion_words,
    move_pose,
    moved_noise,
    noise_correction,
    pose_array,
    pose_parameters,
    pose_transform,
    propagated_variance,
    rotate_points,
)
from lrfcal_lib.solvers.planes import solve_zhang_pless, starting_transform


def solve_lines(obs, T0=None, *, loss=None, scale=1.0, weighted=True, max_iterations=60, required=True):
    """The pose of a camera from board edges (the method of the paper).

    Parameters
    ----------
    obs : CameraObservations
        Its crossings are used.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``; found by :func:`lrfcal_lib.solvers.planes.starting_transform` when left out.
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


def equal_weights(evaluate, pose, **options):
    """Plain least squares: one weight for all residuals, from the mean of their propagated variances.

    Parameters
    ----------
    evaluate : callable
        ``pose -> Block`` with weights of its own.
    pose : ndarray, shape (3, 4)
        Start value.
    **options
        Of :func:`lrfcal_lib.fit.least_squares.minimise`.

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


NAMES = (*POSE_NAMES, "log_odds")
SOFTNESS = 0.2  # spot radii, start value
SOFTEST = 2.0
LEAST_STEP = 0.1  # of a beam step: with a harder flip all places between two beams are alike, and none is the middle
LEAST_INFORMATION = 0.02  # of that of a uniform distribution over the interval; keeps steps finite where it is flat
MOST_ODDS = 6.0  # from there on the edge sits at the rim of the spot
ROUNDS = 5


class _Intervals:
    """Data of the crossings, any of them with leading trial axes, and what of them is frozen at a pose."""

    def __init__(self, points, half_step, noise, radius, background, lines, line_sigma, model):
        self.points, self.half_step, self.noise = points, half_step, noise
        self.radius, self.background, self.line_sigma = radius, background, line_sigma
        self.normals, self.lengths = sight_normals(lines, model)

    def freeze(self, pose):
        """Half widths of the intervals across the planes of sight and variances without the softness, metres."""
        z = np.abs(apply_pose(pose, self.points)[..., 2])
        half = np.abs(np.sum(self.normals * rotate_points(pose, self.half_step), axis=-1))
        half = np.maximum(half, 0.02 * np.linalg.norm(self.half_step, axis=-1))
        variance = propagated_variance(pose, self.normals, self.noise) + (self.line_sigma * z / self.lengths) ** 2
        return half, variance

    def margins(self, state):
        """Where readings flip less the distance of the half-step points from the planes of sight, and its Jacobian."""
        pose = state[..., :4]
        rotated = rotate_points(pose, self.points)
        outside = np.sum(self.normals * (rotated + pose[..., None, :, 3]), axis=-1)
        shift, slope = edge_shift(state[..., 0, 4, None], self.radius, self.background)
        by_pose = -gradient_by_pose(rotated, np.broadcast_to(self.normals, rotated.shape))
        slope = np.broadcast_to(slope, outside.shape)
        return shift - outside, np.concatenate([by_pose, slope[..., None]], axis=-1)

    def sigma(self, softness, half, variance):
        """Standard deviation of where readings flip, metres."""
        soft = np.maximum(softness[..., None] * self.radius, 2 * LEAST_STEP * half)
        return np.sqrt(soft**2 + variance)


def _block(intervals, state, half, sigma):
    margin, jacobian = intervals.margins(state)
    cost, score, information, _ = interval_terms(margin + half, margin - half, sigma)
    root = np.sqrt(np.maximum(information, LEAST_INFORMATION / (half**2 / 3 + sigma**2)))
    return Block(score / root, root[..., None] * jacobian, np.ones_like(root), cost=cost)


def _move(state, step):
    pose = move_pose(state[..., :4], step)
    own = state[..., 4:].copy()
    own[..., 0, 0] = np.clip(own[..., 0, 0] + step[..., 6], -MOST_ODDS, MOST_ODDS)
    return np.concatenate([pose, own], axis=-1)


def _read(state):
    return pose_transform(state[..., :4]), np.concatenate([pose_parameters(state[..., :4]), state[..., :1, 4]], axis=-1)


def _fit_softness(intervals, state, half, variance):
    """The softness that makes the intervals most likely at a state, in spot radii; the state holds its logarithm."""
    grid = np.geomspace(0.02, SOFTEST, 25)
    margin, _ = intervals.margins(state)
    shape = margin.shape[:-1]
    cost = []
    for softness in grid:
        sigma = intervals.sigma(np.full(shape, softness), half, variance)
        cost.append(np.sum(interval_terms(margin + half, margin - half, sigma)[0], axis=-1))
    out = state.copy()
    out[..., 1, 4] = np.log(grid[np.argmin(np.stack(cost), axis=0)])
    return out


def _rounds(intervals, start, log_odds):
    """Renew what is frozen a few times; the last function to minimise and the state there."""
    own = np.zeros(start.shape[:-1] + (1,))
    own[..., 0, 0], own[..., 1, 0] = log_odds, np.log(SOFTNESS)
    state, earlier = np.concatenate([start, own], axis=-1), []
    for k in range(ROUNDS):
        half, variance = intervals.freeze(state[..., :4])
        state = _fit_softness(intervals, state, half, variance) if k else state
        sigma = intervals.sigma(np.exp(state[..., 1, 4]), half, variance)

        def evaluate(s, half=half, sigma=sigma):
            return _block(intervals, s, half, sigma)

        if k < ROUNDS - 1:
            state, _, _, history = minimise(evaluate, state, _move, max_iterations=30)
            earlier.append(history)
    return evaluate, state, earlier


def solve_line_ml(obs, T0=None, *, log_odds=0.0, max_iterations=60, required=True):
    """The pose of a camera and the sensor's edge bias from the intervals in which the board's edges lie.

    Parameters
    ----------
    obs : CameraObservations
        Made with the ``half_step`` rule; its crossings are used.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source`` for :func:`lrfcal_lib.solvers.lines.solve_lines`, whose result is the start.
    log_odds : float
        Start value (see :mod:`lrfcal_lib.fit.residuals`).
    max_iterations : int
    required : bool
        False: report unobservable motions instead of raising.

    Returns
    -------
    Solution
        `parameters` ends with the sensor's log odds; :func:`edge_bias` makes a length of it. The softness of the flips
        is estimated too and held while the covariance is computed.

    Raises
    ------
    DegenerateGeometry
        With fewer than seven crossings, or when they leave a motion (or the edge bias) open.
    ValueError
        When an observation is not finite.

    Notes
    -----
    The distance of a crossing from the plane through the camera's centre and the image line stands for that of the
    beam from the edge: the same to first order where the camera is near the LRF.
    """
    check_finite(obs, "crossing")
    check_count(len(obs.crossing_points), 7, "crossings of scan lines with edges", obs.camera)
    start = pose_array(solve_lines(obs, T0, required=False).transform)
    own = (obs.crossing_half_step, obs.crossing_noise, obs.crossing_radius, obs.crossing_background)
    intervals = _Intervals(obs.crossing_points, *own, obs.crossing_lines, obs.crossing_line_sigma, obs.model)
    evaluate, state, earlier = _rounds(intervals, start, log_odds)
    about = {"names": NAMES, "method": "line_ml", "read": _read, "words": lambda d: _words(d, obs.camera)}
    scales = np.r_[np.ones(6), 10.0]
    options = {"groups": obs.crossing_placement, "earlier": earlier, "required": required, "scales": scales}
    return solve(evaluate, state, _move, max_iterations=max_iterations, **about, **options)


def _words(direction, camera):
    """A motion in words; the edge bias where it is (most of) what is open."""
    if abs(direction[6]) > 0.5:
        return "the sensor's edge bias"
    return motion_words(direction[:6], camera)


def solve_line_ml_batch(
    points, covariance, half_step, noise, radius, background, lines, line_sigma, model, T0, *, groups=None
):
    """:func:`solve_line_ml` for many trials at once (Monte-Carlo).

    Parameters
    ----------
    points, covariance, lines, line_sigma
        As for :func:`lrfcal_lib.solvers.lines.solve_lines_batch`.
    half_step, noise, radius, background : ndarray, shapes (b, n, 3), (b, n, 3, 3), (b, n), (b, n)
        As in CameraObservations.
    model : CameraModel
    T0 : RigidTransform
        One start value, or a stack of b.
    groups : ndarray of int, shape (n,), optional

    Returns
    -------
    Solution
        With leading axes b. Nothing is raised for degenerate trials: they do not converge.
    """
    start = solve_lines_batch(points, covariance, lines, line_sigma, model, T0, groups=groups).state
    intervals = _Intervals(points, half_step, noise, radius, background, lines, line_sigma, model)
    evaluate, state, earlier = _rounds(intervals, start, 0.0)
    about = {"names": NAMES, "method": "line_ml", "read": _read}
    return solve(evaluate, state, _move, groups=groups, earlier=earlier, **about)


def edge_bias(solution, radius=1.0, background=0.0):
    """By how much boards look larger at every edge, and its standard deviation, in units of `radius`.

    Parameters
    ----------
    solution : Solution
        Of :func:`solve_line_ml`.
    radius : float
        Of the spot; 1 gives spot radii.
    background : float
        See :func:`lrfcal_lib.fit.residuals.edge_shift`; say the mean over the crossings.

    Returns
    -------
    bias, sigma : float or ndarray
    """
    shift, slope = edge_shift(solution.parameters[..., 6], radius, background)
    return shift, np.abs(slope) * solution.sigma[..., 6]


def softness(solution):
    """Standard deviation of where a reading flips, in spot radii (a floor of 0.15 beam steps applies beside it)."""
    return np.exp(solution.state[..., 1, 4])


def solve_wasielewski_strauss(obs, T0=None, *, loss=None, scale=1.0, weighted=False, max_iterations=60, required=True):
    """The pose of a camera from distances, in space, between crossings and planes of sight.

    Parameters
    ----------
    obs : CameraObservations
        Its crossings are used.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``; see :func:`lrfcal_lib.solvers.planes.starting_transform`.
    loss : {None, 'huber', 'cauchy'}
        Robust loss for single crossings, with `scale` (standard deviations, or 'auto').
    scale : float or 'auto'
    weighted : bool
        False, as published: every distance counts the same. True: by the propagated noise; the method is then the same
        as :func:`lrfcal_lib.solvers.lines.solve_lines` to first order, because the two residuals differ by a factor
        (depth / focal length) that the weights take out.
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
    """
    check_finite(obs, "crossing")
    check_count(len(obs.crossing_points), 6, "crossings of scan lines with edges", obs.camera)
    T0 = starting_transform(obs) if T0 is None else T0
    normals, length = sight_normals(obs.crossing_lines, obs.model)

    def evaluate(pose):
        return distance_block(pose, obs, normals, length)

    options = {"loss": loss, "scale": scale, "max_iterations": max_iterations, "required": required}
    about = {"camera": obs.camera, "groups": obs.crossing_placement, "method": "wasielewski_strauss"}
    return solve_pose(evaluate, T0, weighted=weighted, **about, **options)


def distance_block(pose, obs, normals, length):
    """Distances from the planes of sight, metres, with the noise of point and line.

    Parameters
    ----------
    pose : ndarray, shape (3, 4)
    obs : CameraObservations
    normals, length : ndarray, shapes (n, 3) and (n,)
        From :func:`lrfcal_lib.fit.residuals.sight_normals`.

    Returns
    -------
    Block
    """
    plain = sight_block(pose, obs.crossing_points, normals, 1.0)
    rotated = rotate_points(pose, obs.crossing_points)
    q = rotated + pose[:, 3]
    shift = moved_noise(pose, normals, obs.crossing_covariance)
    line = (obs.crossing_line_sigma / length) ** 2 * q[:, 2]
    variance = np.sum(shift * normals, axis=-1) + line * q[:, 2]
    factor = plain.residuals / variance
    deeper = gradient_by_pose(rotated, np.broadcast_to([0.0, 0.0, 1.0], q.shape))
    change = noise_correction(rotated, q, normals, shift, factor, pinhole=False) + (factor * line)[:, None] * deeper
    return Block(plain.residuals, plain.jacobian, 1.0 / np.sqrt(variance), corrected=plain.jacobian - change)


def point_block(pose, points, covariance, pixels, sigma_px, model):
    """Reprojection errors of points with covariance.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
    points : ndarray, shape (..., q, 3)
        Source frame, metres.
    covariance : ndarray, shape (..., q, 3, 3)
    pixels : ndarray, shape (..., q, 2)
        Undistorted pixels.
    sigma_px : ndarray, shape (..., q)
    model : CameraModel

    Returns
    -------
    Block
        2 q residuals in pixels; a loss judges u and v of a point together.
    """
    rotated = rotate_points(pose, points)
    q = rotated + pose[..., None, :, 3]
    by_point = pinhole_jacobian(q, model)
    projected = q[..., :2] / q[..., 2:] * [model.fx, model.fy] + [model.cx, model.cy]
    errors = projected - pixels
    rows = np.stack([gradient_by_pose(rotated, by_point[..., i, :]) for i in range(2)], axis=-2)
    turned = by_point @ pose[..., None, :, :3]
    noise = turned @ covariance @ np.swapaxes(turned, -1, -2) + np.asarray(sigma_px)[..., None, None] ** 2 * np.eye(2)
    whitener = np.linalg.inv(np.linalg.cholesky(noise))
    force = np.linalg.solve(noise, errors[..., None])
    shift = (covariance @ np.swapaxes(turned, -1, -2) @ force)[..., 0] @ np.swapaxes(pose[..., :3], -1, -2)
    one = np.ones(errors.shape[:-1])
    change = [noise_correction(rotated, q, by_point[..., i, :], shift, one) for i in range(2)]
    shape = errors.shape[:-2]
    rows, corrected = (x.reshape(shape + (-1, 6)) for x in (rows, rows - np.stack(change, axis=-2)))
    return Block(errors.reshape(shape + (-1,)), rows, whitener, corrected=corrected)


def solve_bauermann(obs, T0=None, *, loss=None, scale=1.0, max_iterations=60, required=True):
    """The pose of a camera from scene points named in both sensors.

    Parameters
    ----------
    obs : CameraObservations
        Its scene points are used.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``; perspective n points when left out (planes and lines where that fails).
    loss : {None, 'huber', 'cauchy'}
        Robust loss for single points, with `scale` (standard deviations, or 'auto').
    scale : float or 'auto'
    max_iterations : int
    required : bool
        False: report unobservable motions instead of raising.

    Returns
    -------
    Solution

    Raises
    ------
    DegenerateGeometry
        With fewer than three points, or when they lie on one line.
    ValueError
        When an observation is not finite.
    """
    check_finite(obs, "scene")
    check_count(len(obs.scene_points), 3, "scene points", obs.camera)
    T0 = starting_transform(obs, kinds=("scene", "planes", "lines")) if T0 is None else T0
    data = (obs.scene_points, obs.scene_covariance, obs.scene_pixels, obs.scene_sigma_px, obs.model)
    options = {"loss": loss, "scale": scale, "max_iterations": max_iterations, "required": required}
    about = {"camera": obs.camera, "groups": np.repeat(obs.scene_placement, 2), "method": "bauermann"}
    return solve_pose(lambda pose: point_block(pose, *data), T0, **about, **options)


@dataclass(frozen=True)
class PlacementReport:
    """How well each placement agrees with a robust estimate.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
    rms : ndarray, shape (p,)
        Root mean square residual of the placement: metres from the plane, or pixels from the lines.
    limit : ndarray, shape (p,)
        What is still accepted.
    outlying : tuple of int
        Placements above their limit.
    inliers : tuple of int
    kind : str
        'planes' or 'lines'.
    """

    placements: np.ndarray
    rms: np.ndarray
    limit: np.ndarray
    outlying: tuple[int, ...]
    inliers: tuple[int, ...]
    kind: str


def find_outlying_placements(obs, kind="planes", T0=None, *, probability=0.999, rounds=10):
    """Find placements that disagree with the others, without being told how many there are.

    Parameters
    ----------
    obs : CameraObservations
    kind : {'planes', 'lines'}
        What is compared: point-plane distances or edge distances in the image.
    T0 : RigidTransform, optional
        Start value; a robust search over subsets of the placements (or many start rotations) when left out.
    probability : float
        A good placement is accepted with this probability, were the errors normal.
    rounds : int
        Rounds of estimating from the accepted placements and judging all again.

    Returns
    -------
    PlacementReport

    Raises
    ------
    ValueError
        For another `kind`.
    DegenerateGeometry
        When the observations do not determine the pose.

    Notes
    -----
    Residuals are compared with their own level, not with the stated noise: the median over the accepted placements of
    the mean square, divided by its expectation, sets the scale. A placement counts as many independent numbers as it
    has crossings, or two with planes (the distance and the slope of the scan: neighbouring points err together).
    """
    if kind not in ("planes", "lines"):
        raise ValueError(f"unknown kind {kind!r}: use 'planes' or 'lines'")
    T = (
        T0
        if T0 is not None
        else starting_transform(obs, kinds=("planes",) if kind == "planes" else ("planes", "lines"))
    )
    T = _solve_kind(obs, kind, T, loss="cauchy")
    placements, mean, freedom = _placement_squares(obs, kind, T)
    keep = _accepted(mean, freedom, np.ones(len(mean), bool), probability)[0]
    for _ in range(rounds):
        T = _solve_kind(obs.select(placements[keep]), kind, T)
        mean = _placement_squares(obs, kind, T)[1]
        found, limit = _accepted(mean, freedom, keep, probability)
        if np.array_equal(found, keep):
            break
        keep = found
    outlying, inliers = (tuple(int(x) for x in placements[flag]) for flag in (~keep, keep))
    return PlacementReport(placements, np.sqrt(mean), np.sqrt(limit), outlying, inliers, kind)


def _solve_kind(obs, kind, T0, loss=None):
    if kind == "planes":
        return solve_zhang_pless(obs, T0, loss=loss, scale="auto", weighted=False).transform
    return solve_lines(obs, T0, loss=loss, scale="auto", weighted=False).transform


def _placement_squares(obs, kind, transform):
    """Mean square residual of each placement, and the independent numbers it stands for."""
    planes = kind == "planes"
    residuals = plane_residuals_m(obs, transform) if planes else edge_residuals_px(obs, transform)
    groups = obs.plane_placement if planes else obs.crossing_placement
    known = np.isfinite(residuals)
    placements, index = np.unique(groups[known], return_inverse=True)
    count = np.bincount(index)
    mean = np.bincount(index, residuals[known] ** 2) / count
    return placements, mean, np.full(len(mean), 2.0) if planes else count.astype(float)


def _accepted(mean, freedom, keep, probability):
    """Placements below the limit that the accepted ones set."""
    level = np.median((mean * freedom / chi2.median(freedom))[keep])
    limit = level * chi2.ppf(probability, freedom) / freedom
    return mean <= limit, limit
