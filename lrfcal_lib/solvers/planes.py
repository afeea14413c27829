"""Cameras from planes (Zhang and Pless 2004): compressed points, start values, refinement, intrinsics."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.least_squares import Block, minimise, solve
from lrfcal_lib.fit.residuals import SIGMA_FLOOR, plane_residuals_m, read_pose, sight_block, sight_normals
from lrfcal_lib.fit.result import check_count, check_finite
from lrfcal_lib.model.camera import project, project_jacobians
from lrfcal_lib.model.geometry import (
    POSE_NAMES,
    DegenerateGeometry,
    apply_pose,
    hat,
    motion_words,
    move_pose,
    pose_array,
    pose_transform,
    rotate_points,
)


@dataclass(frozen=True)
class PlaneSets:
    """Face points by placement, padded to the same number.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
    points : ndarray, shape (..., p, n, 3)
        Source frame, metres; padded rows are zero.
    covariance : ndarray, shape (..., p, n, 3, 3)
    used : ndarray of bool, shape (p, n)
    boards : ndarray, shape (..., p, 3, 4)
        ``T_camera_board``.
    board_covariance : ndarray, shape (..., p, 6, 6)
    """

    placements: np.ndarray
    points: np.ndarray
    covariance: np.ndarray
    used: np.ndarray
    boards: np.ndarray
    board_covariance: np.ndarray

    @property
    def count(self):
        """Number of points of each placement, shape (p,)."""
        return self.used.sum(axis=1)


def plane_sets(obs, least=3):
    """Group the face points of the placements whose board pose the camera knows.

    Parameters
    ----------
    obs : CameraObservations
    least : int
        Number of placements needed.

    Returns
    -------
    PlaneSets

    Raises
    ------
    DegenerateGeometry
        With fewer than `least` such placements.
    ValueError
        When something is not finite.
    """
    check_finite(obs, "plane")
    placements = np.intersect1d(obs.placements, obs.plane_placement)
    check_count(len(placements), least, "placements with a board pose and points on the board", obs.camera)
    rows = [np.flatnonzero(obs.plane_placement == placement) for placement in placements]
    width = max(4, max(len(r) for r in rows))
    index, used = np.zeros((len(rows), width), int), np.zeros((len(rows), width), bool)
    for i, r in enumerate(rows):
        index[i, : len(r)], used[i, : len(r)] = r, True
    points = np.where(used[..., None], obs.plane_points[index], 0.0)
    which = [int(np.flatnonzero(obs.placements == placement)[0]) for placement in placements]
    return PlaneSets(
        placements,
        points,
        obs.plane_covariance[index],
        used,
        obs.board_poses[which][:, :3],
        obs.board_covariance[which],
    )


def compress(sets, weights):
    """Triangles of the weighted rows ``[p, 1]``, shape (..., p, 4, 4).

    Parameters
    ----------
    sets : PlaneSets
    weights : ndarray, broadcastable to (..., p, n)
        Reciprocal standard deviations.
    """
    rows = np.concatenate([sets.points, np.ones(sets.points.shape[:-1] + (1,))], axis=-1)
    return np.linalg.qr(rows * (weights * sets.used)[..., None], mode="r")


def correct_and_compress(sets, pose):
    """Compress points that were moved onto the camera's planes by their noise, with what that leaves as residuals.

    A point's noise is in its residual and in its row of the Jacobian alike; rows of the moved points are free of the
    bias (see :mod:`lrfcal_lib.fit.least_squares`).

    Parameters
    ----------
    sets : PlaneSets
    pose : ndarray, shape (..., 3, 4)
        Where the points are moved to; to be renewed when the pose has changed.

    Returns
    -------
    triangles : ndarray, shape (..., p, 4, 4)
    offset : ndarray, shape (..., p, 4)
        Residuals are ``A h + offset``; at `pose` they are what the moved rows see of the raw distances.
    rest : ndarray, shape (...)
        Chi-square of the raw distances that they do not see.
    """
    across = (np.swapaxes(pose[..., None, :, :3], -1, -2) @ sets.boards[..., :, 2:3])[..., 0]
    last = np.sum(sets.boards[..., 2] * (pose[..., None, :, 3] - sets.boards[..., 3]), axis=-1)
    distance = (np.sum(sets.points * across[..., None, :], axis=-1) + last[..., None]) * sets.used
    weights = range_weights(sets, pose) * sets.used
    pull = (sets.covariance @ across[..., None, :, None])[..., 0]
    moved = sets.points - pull * (distance * weights**2)[..., None]
    rows = np.concatenate([moved, np.ones(moved.shape[:-1] + (1,))], axis=-1) * weights[..., None]
    basis, triangles = np.linalg.qr(rows)
    seen = (np.swapaxes(basis, -1, -2) @ (weights * distance)[..., None])[..., 0]
    plane = np.concatenate([across, last[..., None]], axis=-1)
    rest = np.sum((weights * distance) ** 2, axis=(-1, -2)) - np.sum(seen**2, axis=(-1, -2))
    return triangles, seen - (triangles @ plane[..., None])[..., 0], rest


def range_weights(sets, pose):
    """Reciprocal standard deviations of the point-plane distances from the points' covariance, shape (..., p, n)."""
    across = (np.swapaxes(pose[..., None, :, :3], -1, -2) @ sets.boards[..., :, 2:3])[..., 0]
    spread = sets.covariance @ across[..., None, :, None]
    variance = np.sum(spread[..., 0] * across[..., None, :], axis=-1)
    return 1.0 / np.sqrt(variance + SIGMA_FLOOR**2)


def equal_weights(sets, pose):
    """One common weight for all points: the root mean square of their noise (plain least squares)."""
    variance = range_weights(sets, pose) ** -2.0
    total = np.sum(variance * sets.used, axis=(-1, -2), keepdims=True) / sets.used.sum()
    return np.broadcast_to(total**-0.5, variance.shape)


def plane_block(pose, triangles, boards, whitener=None, count=None, offset=0.0):
    """Distances of compressed points from the planes of boards with known poses.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
        ``T_camera_source``.
    triangles : ndarray, shape (..., p, 4, 4)
    boards : ndarray, shape (..., p, 3, 4)
    whitener : ndarray, shape (..., p, 4, 4), optional
        From :func:`board_whitener`; none when the boards' poses count as exact.
    count : ndarray, shape (p,), optional
        Number of points of each placement, for losses on raw triangles.
    offset : ndarray, shape (..., p, 4), optional
        See :func:`correct_and_compress`.

    Returns
    -------
    Block
        ``4 p`` residuals in standard deviations; a loss judges a placement as a whole.
    """
    residuals, by_pose, _ = plane_terms(pose[..., None, :, :], triangles, boards, offset)
    shape = residuals.shape[:-2]
    whitener = np.broadcast_to(np.eye(4) if whitener is None else whitener, residuals.shape + (4,))
    count = None if count is None else np.maximum(count, 1)
    return Block(residuals.reshape(shape + (-1,)), by_pose.reshape(shape + (-1, 6)), whitener, count)


def board_whitener(pose, triangles, boards, board_covariance):
    """Whiteners (..., p, 4, 4) for errors of the boards' poses, common to all points of a placement."""
    _, _, by_board = plane_terms(pose[..., None, :, :], triangles, boards)
    covariance = np.eye(4) + by_board @ board_covariance @ np.swapaxes(by_board, -1, -2)
    return np.linalg.inv(np.linalg.cholesky(covariance))


def plane_terms(pose, triangles, boards, offset=0.0):
    """Residuals ``A h + offset`` and their Jacobians by the pose and by the board's pose.

    Parameters
    ----------
    pose, boards : ndarray, shape (..., 3, 4)
    triangles : ndarray, shape (..., 4, 4)
    offset : ndarray, shape (..., 4), optional

    Returns
    -------
    residuals : ndarray, shape (..., 4)
    by_pose, by_board : ndarray, shape (..., 4, 6)
    """
    normal = boards[..., 2]
    between = pose[..., 3] - boards[..., 3]
    turned = np.swapaxes(pose[..., :3], -1, -2)
    top, last = (turned @ normal[..., None])[..., 0], np.sum(normal * between, axis=-1, keepdims=True)
    residuals = (triangles @ np.concatenate([top, last], axis=-1)[..., None])[..., 0] + offset
    spin = turned @ hat(normal)
    normal = np.broadcast_to(normal, top.shape)[..., None, :]
    moment = np.cross(normal[..., 0, :], between)[..., None, :]
    upper = np.concatenate([spin, np.zeros_like(spin)], axis=-1)
    by_pose = np.concatenate([upper, np.concatenate([np.zeros_like(normal), normal], axis=-1)], axis=-2)
    by_board = np.concatenate([-upper, np.concatenate([moment, -normal], axis=-1)], axis=-2)
    return residuals, triangles @ by_pose, triangles @ by_board


def check_normals(sets, camera, least=0.02):
    """Refuse boards whose normals do not span space, naming what stays open.

    Parameters
    ----------
    sets : PlaneSets
    camera : str
    least : float
        Smallest accepted spread of the normals (root mean square component, about radians).
    """
    normals = sets.boards[:, :, 2]
    _, spread, axes = np.linalg.svd(normals)
    spread = np.append(spread, np.zeros(3))[:3] / np.sqrt(len(normals))
    directions = ["({:.2f}, {:.2f}, {:.2f})".format(*(a + 0.0)) for a in axes]
    if spread[1] < least:
        raise DegenerateGeometry(
            f"camera '{camera}': all {len(normals)} boards are parallel: the rotation about "
            f"their normal {directions[0]} and the translation along {directions[1]} and {directions[2]} stay "
            "unobservable; tilt the board in both directions"
        )
    if spread[2] < least:
        raise DegenerateGeometry(
            f"camera '{camera}': the boards turn about one axis only: the translation along {directions[2]} "
            "of the camera frame stays unobservable; tilt the board in both directions"
        )


SUBSETS = 400
ROTATIONS = 200
FLAT = 1e-3  # of its extent: what leaves a common plane less is a set of single scan lines


def starting_transform(obs, kinds=("planes", "lines", "scene"), required=True):
    """A start value of ``T_camera_source`` from whatever the observations hold.

    Parameters
    ----------
    obs : CameraObservations
    kinds : sequence of str
        Ways to try, in this order: 'planes' (closed form of Zhang and Pless in random subsets of the placements),
        'lines' (many start rotations at once), 'scene' (perspective n points).
    required : bool
        False: where no way determines the pose, one that fits the planes all the same.

    Returns
    -------
    RigidTransform

    Raises
    ------
    DegenerateGeometry
        When none of them works, with the reason of each.
    """
    ways = {"planes": start_from_planes, "lines": start_from_lines, "scene": start_from_scene}
    reasons = []
    for kind in kinds:
        try:
            return ways[kind](obs)
        except DegenerateGeometry as error:
            reasons.append(f"{kind}: {error}")
    if not required:
        return start_from_planes(obs, required=False)
    raise DegenerateGeometry("no start value, give T0. " + " | ".join(reasons))


def start_from_planes(obs, required=True):
    """Closed form from planes, least trimmed squares over placements; needs three placements where `required`."""
    sets = plane_sets(obs, 3 if required else 1)
    if required:
        check_normals(sets, obs.camera)
    triangles = compress(sets, 1.0)
    candidates, flat = _plane_candidates(sets, triangles)
    best = candidates[np.argsort(_trimmed(candidates, triangles, sets, flat))[:8]]
    refined, *_ = minimise(
        lambda pose: plane_block(pose, triangles / 0.005, sets.boards, None, sets.count),
        best,
        move_pose,
        loss="cauchy",
        scale="auto",
        max_iterations=25,
    )
    every = np.concatenate([refined, best])
    return pose_transform(every[np.argmin(_trimmed(every, triangles, sets, flat))])


def common_plane(triangles):
    """The plane that all points of a recording lie in, and whether they do.

    Parameters
    ----------
    triangles : ndarray, shape (p, 4, 4)
        From :func:`lrfcal_lib.solvers.planes.compress`.

    Returns
    -------
    frame : ndarray, shape (4, 4)
        Turns rows ``[p, 1]`` into rows of a frame whose plane z = 0 it is:
    flat : bool
        True for single scan lines in one plane of the LRF: how far noise scatters them within it tells nothing.
    """
    root, centre = _centred(triangles.reshape(1, -1, 4))
    _, spread, axes = np.linalg.svd(root[0])
    frame = np.eye(4)
    frame[:3, :3] = axes.T * np.array([1.0, 1.0, np.linalg.det(axes)])
    frame[3, :3] = -centre[0] @ frame[:3, :3]
    return frame, bool(spread[2] < FLAT * spread[0])


def _centred(triangles):
    """Scatter roots about the centroid (p, 3, 3), and the centroids (p, 3), of compressed points."""
    rows = np.concatenate([triangles[..., 3:], triangles[..., :3]], axis=-1)
    turned = np.linalg.qr(rows, mode="r")
    return turned[..., 1:, 1:], turned[..., 0, 1:] / turned[..., 0, :1]


def closed_form(triangles, boards, solid):
    """The linear solution of Zhang and Pless for stacks of placements.

    Parameters
    ----------
    triangles : ndarray, shape (..., p, 4, 4)
        Compressed scan points of each placement.
    boards : ndarray, shape (..., p, 3, 4)
        ``T_camera_board``.
    solid : bool
        True: the points of a placement span a plane, the rotation comes from the planes' normals (p >= 3). False:
        points of single scan lines (z = 0), nine linear unknowns (p >= 5).

    Returns
    -------
    ndarray, shape (..., 3, 4)
        ``T_camera_source``.
    """
    normal = boards[..., 2]
    offset = np.sum(normal * boards[..., 3], axis=-1)
    root, centre = _centred(triangles)
    rotation = (
        _rotation_from_normals(root, centre, normal, offset)
        if solid
        else _rotation_from_lines(triangles, normal, offset)
    )
    moved = (rotation[..., None, :, :] @ centre[..., None])[..., 0]
    right = offset - np.sum(normal * moved, axis=-1)
    return np.concatenate([rotation, _translation(normal, right)[..., None]], axis=-1)


def _translation(normal, right):
    """Least squares solution of ``n . t = right``."""
    transposed = np.swapaxes(normal, -1, -2)
    return (np.linalg.pinv(transposed @ normal, rcond=1e-12) @ (transposed @ right[..., None]))[..., 0]


def _proper(matrix):
    """Nearest rotation matrices."""
    u, _, vt = np.linalg.svd(matrix)
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    u = np.concatenate([u[..., :2], u[..., 2:] * sign[..., None, None]], axis=-1)
    return u @ vt


def _rotation_from_normals(root, centre, normal, offset):
    _, _, vt = np.linalg.svd(root)
    source = vt[..., 2, :]
    source = source * np.sign(np.sum(source * centre, axis=-1, keepdims=True))
    camera = normal * np.where(offset < 0, -1.0, 1.0)[..., None]
    return _proper(np.swapaxes(camera, -1, -2) @ source)


def _rotation_from_lines(triangles, normal, offset):
    rows = triangles[..., [0, 1, 3]]
    square = np.swapaxes(rows, -1, -2) @ rows
    square = square / square[..., 2:, 2:]
    outer = normal[..., :, None] * normal[..., None, :]
    p = square.shape[:-2]
    left = (square[..., :, None, :, None] * outer[..., None, :, None, :]).reshape(p + (9, 9)).sum(axis=-3)
    right = (square[..., :, 2:] * (normal * offset[..., None])[..., None, :]).reshape(p + (9,)).sum(axis=-2)
    found = (np.linalg.pinv(left, rcond=1e-14, hermitian=True) @ right[..., None])[..., 0].reshape(p[:-1] + (3, 3))
    first, second = found[..., 0, :], found[..., 1, :]
    return _proper(np.stack([first, second, np.cross(first, second)], axis=-1))


def _plane_candidates(sets, triangles):
    """Closed forms of minimal subsets, for planes and for lines; a grid of rotations where there are too few.

    Also whether the points leave one plane at all.
    """
    p, (frame, flat) = len(sets.placements), common_plane(triangles)
    found = []
    if p >= 3 and not flat:
        found += [closed_form(triangles[rows], sets.boards[rows], True) for rows in _subsets(p, 3)]
    if p >= 5:
        found += [closed_form(triangles[rows] @ frame, sets.boards[rows], False) @ frame.T for rows in _subsets(p, 5)]
    return np.concatenate(found) if found else _rotation_grid_on_planes(sets, triangles), flat


def _subsets(p, size):
    """Sets of placements to try: many minimal ones, and all together."""
    if comb(p, size) <= SUBSETS:
        return np.array(list(combinations(range(p), size))), np.arange(p)[None]
    return np.argsort(np.random.default_rng(0).random((SUBSETS, p)), axis=1)[:, :size], np.arange(p)[None]


def _rotation_grid_on_planes(sets, triangles):
    rotations = start_rotations()
    _, centre = _centred(triangles)
    normal = sets.boards[:, :, 2]
    right = np.sum(normal * sets.boards[:, :, 3], axis=1) - np.sum(
        normal * (centre @ np.swapaxes(rotations, -1, -2)), axis=-1
    )
    start = np.concatenate(
        [rotations, _translation(np.broadcast_to(normal, right.shape + (3,)), right)[..., None]], axis=-1
    )
    found, *_ = minimise(
        lambda pose: plane_block(pose, triangles / 0.005, sets.boards), start, move_pose, max_iterations=40
    )
    ahead = apply_pose(found, centre)[..., 2] > 0
    return found[ahead.all(axis=1)] if ahead.all(axis=1).any() else found


def _trimmed(candidates, triangles, sets, flat):
    """Least trimmed mean square (m^2) of candidates: over more placements than a closed form uses."""
    residuals = plane_block(candidates, triangles, sets.boards).residuals.reshape(len(candidates), -1, 4)
    squares = np.sort(np.sum(residuals**2, axis=2) / np.maximum(sets.count, 1), axis=1)
    keep = min(max(squares.shape[1] // 2 + 2, 7 if flat else 5), squares.shape[1])
    return squares[:, :keep].mean(axis=1)


def start_rotations(count=ROTATIONS):
    """The 24 rotations of a cube and random ones, shape (count + 24, 3, 3)."""
    cube = Rotation.create_group("O")
    return np.concatenate([cube.as_matrix(), Rotation.random(count, rng=np.random.default_rng(0)).as_matrix()])


def start_from_lines(obs):
    """Many rotations at once, each with its best translation, refined on planes of sight; robust vote."""
    check_finite(obs, "crossing")
    check_count(len(obs.crossing_points), 6, "crossings of scan lines with edges", obs.camera)
    normals, _ = sight_normals(obs.crossing_lines, obs.model)
    points, rotations = obs.crossing_points, start_rotations()
    right = -np.sum(normals * (points @ np.swapaxes(rotations, -1, -2)), axis=-1)
    start = np.concatenate(
        [rotations, _translation(np.broadcast_to(normals, right.shape + (3,)), right)[..., None]], axis=-1
    )
    found = start
    for loss in (None, "cauchy"):
        found, *_ = minimise(
            lambda pose: sight_block(pose, points, normals, 0.005),
            found,
            move_pose,
            loss=loss,
            scale="auto",
            max_iterations=40,
        )
    z = apply_pose(found, points)[..., 2]
    keep = (z > 0).mean(axis=1) > 0.8
    if not keep.any():
        raise DegenerateGeometry(
            f"camera '{obs.camera}': no pose puts the {len(points)} crossings in front of the camera"
        )
    found, z = found[keep], z[keep]
    distance = np.abs(sight_block(found, points, normals, 1.0).residuals) / np.abs(z)
    count = max(6, int(0.75 * len(points)))
    return pose_transform(found[np.argmin(np.sum(np.sort(distance, axis=1)[:, :count] ** 2, axis=1))])


def start_from_scene(obs):
    """Perspective n points (SQPnP within RANSAC) from points that LRF and camera both name."""
    check_finite(obs, "scene")
    check_count(len(obs.scene_points), 4, "scene points", obs.camera)
    arguments = (np.ascontiguousarray(obs.scene_points), np.ascontiguousarray(obs.scene_pixels), obs.model.matrix, None)
    found, rotvec, translation, _ = cv2.solvePnPRansac(
        *arguments, flags=cv2.SOLVEPNP_SQPNP, reprojectionError=20.0, iterationsCount=500
    )
    if not found:
        raise DegenerateGeometry(
            f"camera '{obs.camera}': no pose agrees with four of the {len(obs.scene_points)} scene points"
        )
    return RigidTransform.from_components(translation.ravel(), Rotation.from_rotvec(rotvec.ravel()))


TILT_LEVER = 0.3  # metres, about half a board: turns an offset into the tilt that bends as much
INTRINSIC_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "k5")
INTRINSIC_SCALES = (1e3, 1e3, 1e3, 1e3, 10.0, 10.0, 10.0, 10.0, 100.0)


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
        distances themselves come from :func:`lrfcal_lib.fit.residuals.plane_residuals_m`.

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
