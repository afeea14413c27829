"""Camera from lines by likelihood: each edge lies between the last beam on the board and the first off it.

Half-step points spend what the two beams say on one number. Here the edge may lie anywhere between them, moved by the
sensor's own edge bias (one unknown, see :mod:`lrfcal_lib.solvers.edge_likelihood`) and blurred by what else is
uncertain. Many intervals leave little room, so the estimate improves faster than the root of their number.
"""

from __future__ import annotations

import numpy as np

from lrfcal_lib.solvers.camera import solve_lines, solve_lines_batch
from lrfcal_lib.solvers.checks import check_count, check_finite
from lrfcal_lib.solvers.edge_likelihood import edge_shift, interval_terms
from lrfcal_lib.solvers.least_squares import Block, minimise, solve
from lrfcal_lib.solvers.pose import (
    POSE_NAMES,
    apply_pose,
    gradient_by_pose,
    motion_words,
    move_pose,
    pose_array,
    pose_parameters,
    pose_transform,
    propagated_variance,
    rotate_points,
)
from lrfcal_lib.solvers.start import sight_normals

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
        Start value of ``T_camera_source`` for :func:`lrfcal_lib.solvers.camera.solve_lines`, whose result is the start.
    log_odds : float
        Start value (see :mod:`lrfcal_lib.solvers.edge_likelihood`).
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
        As for :func:`lrfcal_lib.solvers.camera.solve_lines_batch`.
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
        See :func:`lrfcal_lib.solvers.edge_likelihood.edge_shift`; say the mean over the crossings.

    Returns
    -------
    bias, sigma : float or ndarray
    """
    shift, slope = edge_shift(solution.parameters[..., 6], radius, background)
    return shift, np.abs(slope) * solution.sigma[..., 6]


def softness(solution):
    """Standard deviation of where a reading flips, in spot radii (a floor of 0.15 beam steps applies beside it)."""
    return np.exp(solution.state[..., 1, 4])
