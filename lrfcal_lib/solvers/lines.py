"""Residuals of cameras from lines (eqs. 16-21), by likelihood, after Wasielewski and Strauss, after
Bauermann.
"""

import numpy as np

from lrfcal_lib.fit.edge_likelihood import edge_shift, interval_terms
from lrfcal_lib.fit.least_squares import Block, minimise, minimise_in_rounds, solve
from lrfcal_lib.fit.residuals import (
    line_block,
    read_pose,
    sight_block,
    sight_normals,
)
from lrfcal_lib.model.camera import pinhole_jacobian
from lrfcal_lib.model.geometry import (
    POSE_NAMES,
    DegenerateGeometry,
    apply_pose,
    gradient_by_pose,
    motion_words,
    move_pose,
    moved_noise,
    noise_correction,
    pose_transform,
    rotate_points,
)
from lrfcal_lib.solvers.planes import shifted, start_rotations


def distance_block(pose, obs):
    """Distances of crossings from the planes of sight (Wasielewski and Strauss), metres, with the
    noise of both.

    Weighted by it, the method is the same as with :func:`lrfcal_lib.fit.residuals.line_block` to
    first order: the two residuals differ by a factor (depth / focal length) that the weights take
    out.
    """
    normals, length = sight_normals(obs.crossing_lines, obs.model)
    plain = sight_block(pose, obs.crossing_points, normals, 1.0)
    rotated = rotate_points(pose, obs.crossing_points)
    moved = rotated + pose[..., None, :, 3]
    depth = moved[..., 2]
    noise = moved_noise(pose, normals, obs.crossing_covariance)
    line_variance = (obs.crossing_line_sigma / length) ** 2  # of the sight's direction, radians
    variance = np.vecdot(noise, normals) + line_variance * depth**2
    factor = plain.residuals / variance
    depth_by_pose = gradient_by_pose(rotated, np.broadcast_to([0.0, 0.0, 1.0], moved.shape))
    correction = noise_correction(rotated, moved, normals, noise, factor, pinhole=False)
    correction = correction + (factor * line_variance * depth)[..., None] * depth_by_pose
    corrected = plain.jacobian - correction
    return Block(plain.residuals, plain.jacobian, 1.0 / np.sqrt(variance), corrected=corrected)


def point_block(pose, obs):
    """Reprojection errors of named points (Bauermann), pixels; a loss judges u and v of a point
    together.
    """
    rotated = rotate_points(pose, obs.scene_points)
    moved = rotated + pose[..., None, :, 3]
    by_point = pinhole_jacobian(moved, obs.model)
    focal = [obs.model.fx, obs.model.fy]
    principal = [obs.model.cx, obs.model.cy]
    errors = moved[..., :2] / moved[..., 2:] * focal + principal - obs.scene_pixels

    by_source = by_point @ pose[..., None, :, :3]  # by the point in the source frame
    pulled = obs.scene_covariance @ np.swapaxes(by_source, -1, -2)
    noise = by_source @ pulled + obs.scene_sigma_px[..., None, None] ** 2 * np.eye(2)
    force = np.linalg.solve(noise, errors[..., None])
    shift = (pulled @ force)[..., 0] @ np.swapaxes(pose[..., :3], -1, -2)

    one = np.ones(errors.shape[:-1])
    gradients = [by_point[..., 0, :], by_point[..., 1, :]]  # of u and of v
    rows = [gradient_by_pose(rotated, gradient) for gradient in gradients]
    corrections = [noise_correction(rotated, moved, gradient, shift, one) for gradient in gradients]
    jacobian = np.stack(rows, axis=-2)
    corrected = jacobian - np.stack(corrections, axis=-2)
    shape = errors.shape[:-2] + (-1,)
    return Block(
        errors.reshape(shape),
        jacobian.reshape(shape + (6,)),
        np.linalg.inv(np.linalg.cholesky(noise)),
        corrected=corrected.reshape(shape + (6,)),
    )


def estimate_pose(residual, obs, pose, *, method, uses, weighted=True, **options):
    """The pose (..., 3, 4) of a camera by least squares, from ``residual(pose, obs) -> Block``.

    `uses` is the kind of observations that the residual has rows of. Without weights every residual
    counts the same: the mean of their propagated variances.
    """

    def evaluate(pose):
        return residual(pose, obs)

    def equal_weights(pose, _):
        """The residuals with one weight for all, at a pose."""
        weight = np.mean(evaluate(pose).whitener ** -2.0) ** -0.5

        def plain(pose):
            block = evaluate(pose)
            return Block(block.residuals, block.jacobian, np.full_like(block.residuals, weight))

        return plain

    problem = evaluate
    earlier = []
    if not weighted:
        problem, pose, earlier = minimise_in_rounds(equal_weights, pose, move_pose, 2, **options)
    return solve(
        problem,
        pose,
        move_pose,
        names=POSE_NAMES,
        method=method,
        read=read_pose,
        groups=obs.group(uses)["placement"],
        words=lambda direction: motion_words(direction, obs.camera),
        earlier=earlier,
        **options,
    )


SOFTNESS = 0.2  # spot radii, start value
# of a beam step: with a harder flip all places between two beams are alike, and none is the middle
LEAST_STEP = 0.1
# of that of a uniform distribution over the interval; keeps steps finite where it is flat
LEAST_INFORMATION = 0.02
MOST_ODDS = 6.0  # from there on the edge sits at the rim of the spot
ROUNDS = 4
LEAST_HALF = 0.02  # of the half step: an edge along the step would have an interval of no width
# metres, of a crossing from its plane of sight, for the search of a start value
START_SIGMA = 0.005


def interval_margins(state, obs, sight):
    """By how much readings flip outside the planes of sight (unit normals `sight`), and the
    Jacobian, (..., n, 7).
    """
    rotated = rotate_points(state[..., :4], obs.crossing_points)
    outside = np.sum(sight * (rotated + state[..., None, :, 3]), axis=-1)
    shift, slope = edge_shift(state[..., 0, 4, None], obs.crossing_radius, obs.crossing_background)
    by_pose = -gradient_by_pose(rotated, np.broadcast_to(sight, rotated.shape))
    slope = np.broadcast_to(slope, outside.shape)
    return shift - outside, np.concatenate([by_pose, slope[..., None]], axis=-1)


def interval_block(state, obs, sight, half, sigma):
    """Likelihood that readings flip between two neighbouring beams, `half` (metres) to either side
    of each crossing.

    The state is a pose with one more column, the sensor's log odds (see
    :mod:`lrfcal_lib.fit.edge_likelihood`). The distance of a crossing from the plane through the
    camera's centre and the image line stands for that of the beam from the edge: the same to first
    order where the camera is near the LRF.
    """
    margin, jacobian = interval_margins(state, obs, sight)
    cost, score, information = interval_terms(margin + half, margin - half, sigma)
    root = np.sqrt(np.maximum(information, LEAST_INFORMATION / (half**2 / 3 + sigma**2)))
    return Block(score / root, root[..., None] * jacobian, np.ones_like(root), cost=cost)


def move_biased(state, step):
    """Retraction of a pose with log odds in a fifth column."""
    own = state[..., 4:].copy()
    own[..., 0, 0] = np.clip(own[..., 0, 0] + step[..., 6], -MOST_ODDS, MOST_ODDS)
    return np.concatenate([move_pose(state[..., :4], step), own], axis=-1)


def freeze_intervals(state, obs, sight, lengths, softness):
    """Half widths of the intervals across the planes of sight and standard deviations of where
    readings flip, metres.

    Of some values of the softness (spot radii) that is taken which makes the intervals most likely.
    """
    pose = state[..., :4]
    half = np.abs(np.vecdot(sight, rotate_points(pose, obs.crossing_half_step)))
    half = np.maximum(half, LEAST_HALF * np.linalg.norm(obs.crossing_half_step, axis=-1))
    depth = np.abs(apply_pose(pose, obs.crossing_points)[..., 2])
    noise = np.vecdot(moved_noise(pose, sight, obs.crossing_noise), sight)
    noise = noise + (obs.crossing_line_sigma * depth / lengths) ** 2
    margin, _ = interval_margins(state, obs, sight)
    soft = np.reshape(softness, (-1,) + (1,) * margin.ndim) * obs.crossing_radius
    variance = np.maximum(soft, 2 * LEAST_STEP * half) ** 2 + noise
    costs, _, _ = interval_terms(margin + half, margin - half, np.sqrt(variance))
    best = np.argmin(np.sum(costs, axis=-1), axis=0)[None, ..., None]
    return half, np.sqrt(np.take_along_axis(variance, best, axis=0)[0])


def estimate_likely(residual, obs, pose, *, method, uses):
    """The pose of a camera and the sensor's edge bias from the intervals in which the board's edges
    lie.

    `parameters` end with the sensor's log odds; :func:`edge_bias` makes a length of it. The
    softness of the flips is estimated too, and held while the covariance is computed. Start value
    is the estimate from lines.
    """
    pose = minimise(lambda pose: line_block(pose, obs), pose, move_pose)[0]
    sight, lengths = sight_normals(obs.crossing_lines, obs.model)

    def freeze(state, number):
        softness = SOFTNESS
        if number > 0:
            softness = np.geomspace(0.02, 2.0, 25)
        half, sigma = freeze_intervals(state, obs, sight, lengths, softness)
        return lambda state: residual(state, obs, sight, half, sigma)

    def read(state):
        transform, parameters = read_pose(state[..., :4])
        return transform, np.concatenate([parameters, state[..., :1, 4]], axis=-1)

    def words(direction):
        if abs(direction[6]) > 0.5:
            return "the sensor's edge bias"
        return motion_words(direction[:6], obs.camera)

    state = np.concatenate([pose, np.zeros(pose.shape[:-1] + (1,))], axis=-1)
    problem, state, earlier = minimise_in_rounds(
        freeze, state, move_biased, ROUNDS, max_iterations=30
    )
    return solve(
        problem,
        state,
        move_biased,
        names=(*POSE_NAMES, "log_odds"),
        method=method,
        read=read,
        words=words,
        scales=np.r_[np.ones(6), 10.0],
        groups=obs.crossing_placement,
        earlier=earlier,
    )


def edge_bias(solution, radius=1.0, background=0.0):
    """By how much boards look larger at every edge, and its standard deviation, in units of
    `radius`.

    The solution is one of the method 'line_ml'; a radius of 1 gives spot radii. For `background`
    see :func:`lrfcal_lib.fit.edge_likelihood.edge_shift`; say the mean over the crossings.
    """
    shift, slope = edge_shift(solution.parameters[..., 6], radius, background)
    return shift, np.abs(slope) * solution.sigma[..., 6]


def start_from_lines(obs):
    """From crossings and the image lines of their edges."""
    obs.require("crossing", 6)
    return _start_from_sights(obs.crossing_points, obs.crossing_lines, obs)


def start_from_scene(obs):
    """From named points: each is seen where a column and a row of the image cross."""
    obs.require("scene", 4)
    u, v = obs.scene_pixels.T
    zero = np.zeros(len(u))
    columns = np.column_stack([zero + 1, zero, -u])
    rows = np.column_stack([zero, zero + 1, -v])
    lines = np.concatenate([columns, rows])
    return _start_from_sights(np.tile(obs.scene_points, (2, 1)), lines, obs)


def _start_from_sights(points, lines, obs):
    """Many rotations at once, each with its best translation, refined on planes of sight; robust
    vote.
    """
    normals, _ = sight_normals(lines, obs.model)
    rotations = start_rotations()
    offsets = -np.vecdot(normals, points @ np.swapaxes(rotations, -1, -2))
    poses = shifted(rotations, normals, offsets)

    def evaluate(pose):
        return sight_block(pose, points, normals, START_SIGMA)

    for loss in (None, "cauchy"):
        options = {"loss": loss, "scale": "auto", "max_iterations": 40}
        poses = minimise(evaluate, poses, move_pose, **options)[0]
    depth = apply_pose(poses, points)[..., 2]
    ahead = (depth > 0).mean(axis=1) > 0.8
    if not ahead.any():
        raise DegenerateGeometry(
            f"camera '{obs.camera}': no pose puts the {len(points)} points in front of the camera"
        )
    poses = poses[ahead]
    angle = np.abs(sight_block(poses, points, normals, 1.0).residuals) / np.abs(depth[ahead])
    best = np.sort(angle, axis=1)[:, : max(6, int(0.75 * len(points)))]
    return pose_transform(poses[np.argmin(np.sum(best**2, axis=1))])
