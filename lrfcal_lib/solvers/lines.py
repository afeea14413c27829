"""Residuals of cameras from lines (eqs. 16-21), by likelihood, after Wasielewski and Strauss, after Bauermann."""

import numpy as np

from lrfcal_lib.fit.least_squares import Block, minimise, minimise_in_rounds, solve
from lrfcal_lib.fit.residuals import edge_shift, interval_terms, line_block, read_pose, sight_block, sight_normals
from lrfcal_lib.model import geometry
from lrfcal_lib.model.camera import pinhole_jacobian
from lrfcal_lib.model.geometry import DegenerateGeometry, gradient_by_pose, move_pose, noise_correction, rotate_points
from lrfcal_lib.solvers.planes import shifted, start_rotations


def distance_block(pose, obs):
    """Distances of crossings from the planes of sight (Wasielewski and Strauss), metres, with the noise of both.

    Weighted by it, the method is the same as with :func:`lrfcal_lib.fit.residuals.line_block` to first order: the two
    residuals differ by a factor (depth / focal length) that the weights take out.
    """
    normals, length = sight_normals(obs.crossing_lines, obs.model)
    plain = sight_block(pose, obs.crossing_points, normals, 1.0)
    rotated = rotate_points(pose, obs.crossing_points)
    q = rotated + pose[..., None, :, 3]
    shift = geometry.moved_noise(pose, normals, obs.crossing_covariance)
    line = (obs.crossing_line_sigma / length) ** 2 * q[..., 2]
    variance = np.sum(shift * normals, axis=-1) + line * q[..., 2]
    factor = plain.residuals / variance
    deeper = gradient_by_pose(rotated, np.broadcast_to([0.0, 0.0, 1.0], q.shape))
    change = noise_correction(rotated, q, normals, shift, factor, pinhole=False) + (factor * line)[..., None] * deeper
    return Block(plain.residuals, plain.jacobian, 1.0 / np.sqrt(variance), corrected=plain.jacobian - change)


def point_block(pose, obs):
    """Reprojection errors of named points (Bauermann), pixels; a loss judges u and v of a point together."""
    rotated = rotate_points(pose, obs.scene_points)
    q, model, covariance = rotated + pose[..., None, :, 3], obs.model, obs.scene_covariance
    by_point = pinhole_jacobian(q, model)
    projected = q[..., :2] / q[..., 2:] * [model.fx, model.fy] + [model.cx, model.cy]
    errors = projected - obs.scene_pixels
    turned = by_point @ pose[..., None, :, :3]
    noise = turned @ covariance @ np.swapaxes(turned, -1, -2) + obs.scene_sigma_px[..., None, None] ** 2 * np.eye(2)
    force = np.linalg.solve(noise, errors[..., None])
    shift = (covariance @ np.swapaxes(turned, -1, -2) @ force)[..., 0] @ np.swapaxes(pose[..., :3], -1, -2)
    one, gradients = np.ones(errors.shape[:-1]), (by_point[..., 0, :], by_point[..., 1, :])
    rows = np.stack([gradient_by_pose(rotated, g) for g in gradients], axis=-2)
    change = np.stack([noise_correction(rotated, q, g, shift, one) for g in gradients], axis=-2)
    shape = errors.shape[:-2] + (-1,)
    rows, corrected = (x.reshape(shape + (6,)) for x in (rows, rows - change))
    return Block(errors.reshape(shape), rows, np.linalg.inv(np.linalg.cholesky(noise)), corrected=corrected)


def estimate_pose(residual, obs, pose, *, method, uses, weighted=True, **options):
    """The pose (..., 3, 4) of a camera by least squares, from ``residual(pose, obs) -> Block``.

    `uses` is the kind of observations that the residual has rows of. Without weights every residual counts the same:
    the mean of their propagated variances.
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

    problem, earlier = evaluate, []
    if not weighted:
        problem, pose, earlier = minimise_in_rounds(equal_weights, pose, move_pose, 2, **options)
    groups = getattr(obs, f"{uses}_placement")
    return solve(
        problem, pose, move_pose, names=geometry.POSE_NAMES, method=method, read=read_pose, groups=groups,
        words=lambda d: geometry.motion_words(d, obs.camera), earlier=earlier, **options,
    )


SOFTNESS = 0.2  # spot radii, start value
LEAST_STEP = 0.1  # of a beam step: with a harder flip all places between two beams are alike, and none is the middle
LEAST_INFORMATION = 0.02  # of that of a uniform distribution over the interval; keeps steps finite where it is flat
MOST_ODDS = 6.0  # from there on the edge sits at the rim of the spot
ROUNDS = 4


def interval_margins(state, obs, sight):
    """By how much readings flip outside the planes of sight (unit normals `sight`), and the Jacobian, (..., n, 7)."""
    rotated = rotate_points(state[..., :4], obs.crossing_points)
    outside = np.sum(sight * (rotated + state[..., None, :, 3]), axis=-1)
    shift, slope = edge_shift(state[..., 0, 4, None], obs.crossing_radius, obs.crossing_background)
    by_pose = -gradient_by_pose(rotated, np.broadcast_to(sight, rotated.shape))
    slope = np.broadcast_to(slope, outside.shape)
    return shift - outside, np.concatenate([by_pose, slope[..., None]], axis=-1)


def interval_block(state, obs, sight, half, sigma):
    """Likelihood that readings flip between two neighbouring beams, `half` (metres) to either side of each crossing.

    The state is a pose with one more column, the sensor's log odds (see :mod:`lrfcal_lib.fit.residuals`). The distance
    of a crossing from the plane through the camera's centre and the image line stands for that of the beam from the
    edge: the same to first order where the camera is near the LRF.
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
    """Half widths of the intervals across the planes of sight and standard deviations of where readings flip, metres.

    Of some values of the softness (spot radii) that is taken which makes the intervals most likely.
    """
    pose = state[..., :4]
    depth = np.abs(geometry.apply_pose(pose, obs.crossing_points)[..., 2])
    half = np.abs(np.sum(sight * rotate_points(pose, obs.crossing_half_step), axis=-1))
    half = np.maximum(half, 0.02 * np.linalg.norm(obs.crossing_half_step, axis=-1))
    noise = np.sum(geometry.moved_noise(pose, sight, obs.crossing_noise) * sight, axis=-1)
    margin = interval_margins(state, obs, sight)[0]
    soft = np.reshape(softness, (-1,) + (1,) * margin.ndim) * obs.crossing_radius
    variance = np.maximum(soft, 2 * LEAST_STEP * half) ** 2 + noise + (obs.crossing_line_sigma * depth / lengths) ** 2
    cost = np.sum(interval_terms(margin + half, margin - half, np.sqrt(variance))[0], axis=-1)
    best = np.argmin(cost, axis=0)[None, ..., None]
    return half, np.sqrt(np.take_along_axis(variance, best, axis=0)[0])


def estimate_likely(residual, obs, pose, *, method, uses):
    """The pose of a camera and the sensor's edge bias from the intervals in which the board's edges lie.

    `parameters` end with the sensor's log odds; :func:`edge_bias` makes a length of it. The softness of the flips is
    estimated too, and held while the covariance is computed. Start value is the estimate from lines.
    """
    pose = minimise(lambda pose: line_block(pose, obs), pose, move_pose)[0]
    sight, lengths = sight_normals(obs.crossing_lines, obs.model)

    def freeze(state, number):
        softness = np.geomspace(0.02, 2.0, 25) if number else SOFTNESS
        half, sigma = freeze_intervals(state, obs, sight, lengths, softness)
        return lambda state: residual(state, obs, sight, half, sigma)

    def read(state):
        transform, parameters = read_pose(state[..., :4])
        return transform, np.concatenate([parameters, state[..., :1, 4]], axis=-1)

    def words(direction):
        return "the sensor's edge bias" if abs(direction[6]) > 0.5 else geometry.motion_words(direction[:6], obs.camera)

    state = np.concatenate([pose, np.zeros(pose.shape[:-1] + (1,))], axis=-1)
    problem, state, earlier = minimise_in_rounds(freeze, state, move_biased, ROUNDS, max_iterations=30)
    return solve(
        problem, state, move_biased, names=(*geometry.POSE_NAMES, "log_odds"), method=method, read=read, words=words,
        scales=np.r_[np.ones(6), 10.0], groups=obs.crossing_placement, earlier=earlier,
    )  # fmt: skip


def edge_bias(solution, radius=1.0, background=0.0):
    """By how much boards look larger at every edge, and its standard deviation, in units of `radius`.

    The solution is one of the method 'line_ml'; a radius of 1 gives spot radii. For `background` see
    :func:`lrfcal_lib.fit.residuals.edge_shift`; say the mean over the crossings.
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
    lines = np.concatenate([np.column_stack([1 + 0 * u, 0 * u, -u]), np.column_stack([0 * v, 1 + 0 * v, -v])])
    return _start_from_sights(np.tile(obs.scene_points, (2, 1)), lines, obs)


def _start_from_sights(points, lines, obs):
    """Many rotations at once, each with its best translation, refined on planes of sight; robust vote."""
    normals, rotations = sight_normals(lines, obs.model)[0], start_rotations()
    found = shifted(rotations, normals, -np.sum(normals * (points @ np.swapaxes(rotations, -1, -2)), axis=-1))
    for loss in (None, "cauchy"):
        options = {"loss": loss, "scale": "auto", "max_iterations": 40}
        found = minimise(lambda pose: sight_block(pose, points, normals, 0.005), found, move_pose, **options)[0]
    z = geometry.apply_pose(found, points)[..., 2]
    keep = (z > 0).mean(axis=1) > 0.8
    if not keep.any():
        raise DegenerateGeometry(f"camera '{obs.camera}': no pose puts the {len(points)} points in front of the camera")
    found, z = found[keep], z[keep]
    distance = np.abs(sight_block(found, points, normals, 1.0).residuals) / np.abs(z)
    count = max(6, int(0.75 * len(points)))
    return geometry.pose_transform(found[np.argmin(np.sum(np.sort(distance, axis=1)[:, :count] ** 2, axis=1))])
