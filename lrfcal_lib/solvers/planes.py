"""Cameras from planes (Zhang and Pless 2004): points on a board lie in the plane that the camera
sees; with the intrinsics, too.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from lrfcal_lib.fit.covariance import inverse_root, motion_words
from lrfcal_lib.fit.least_squares import Block, minimise_in_rounds, solve
from lrfcal_lib.fit.padding import pad
from lrfcal_lib.fit.residuals import SIGMA_FLOOR, plane_residuals_m, read_pose
from lrfcal_lib.fit.result import Solution
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.model.camera import INTRINSIC_NAMES, LENS, project, project_jacobians
from lrfcal_lib.model.geometry import (
    POSE,
    POSE_NAMES,
    DegenerateGeometry,
    apply_pose,
    cross,
    gradient_by_pose,
    hat,
    move_pose,
    pose_array,
    pose_transform,
    rotate_and_move,
)
from lrfcal_lib.model.observations import CameraObservations

ROUNDS = 5  # of new weights; the last change is far below the noise
LEAST_SPREAD = 0.02  # of the boards' normals some way, about radians
# metres, about half a board: turns an offset into the tilt that bends as much
TILT_LEVER = 0.3
LENS_SCALES = (1e3, 1e3, 1e3, 1e3, 10.0, 10.0, 10.0, 10.0, 100.0)
FEWEST_CORNERS = 4  # of the pattern, for intrinsics


class PlaneSets(NamedTuple):
    """Face points (..., p, n, 3) by placement, padded with zeros to the same number, source frame,
    metres.

    `boards` (..., p, 3, 4) are ``T_camera_board``, `number` (p,) that of each one's points.
    """

    placements: np.ndarray
    points: np.ndarray
    covariance: np.ndarray
    used: np.ndarray
    boards: np.ndarray
    board_covariance: np.ndarray
    number: np.ndarray


def estimate_from_planes(
    residual,
    obs: CameraObservations,
    pose: np.ndarray,
    *,
    method,
    uses,
    weighted=True,
    **options,
) -> Solution:
    """The pose of a camera from the board's planes (Zhang and Pless).

    Weighted by the points' covariance across the board and, correlated within a placement, that of
    the board's pose; or plain least squares. Points are compressed anew in every round, from an
    unweighted estimate on: weights of a bad pose would hold it there. A loss judges whole
    placements, because a bad board pose spoils all points of its placement.

    Parameters
    ----------
    residual : callable
        As :func:`plane_block`.
    obs : CameraObservations
    pose : ndarray, shape (..., 3, 4)
        Start value of ``T_camera_source``.
    method, uses : str
        Its name, and the kind of observations it works on.
    weighted : bool
    **options
        Of :func:`lrfcal_lib.fit.least_squares.minimise`.

    Returns
    -------
    Solution
        Its residuals are four numbers a placement, in standard deviations; the distances themselves
        come from :func:`lrfcal_lib.fit.residuals.plane_residuals_m`.
    """
    sets = plane_sets(obs)
    if sets.boards.ndim == 3:
        check_normals(sets, obs.camera)

    def freeze(pose, number):
        """The residuals with weights and compressed points as they are at a pose."""
        if not (weighted and number):  # one common weight: the mean of the points' noise
            _, variance = _noise_across(sets, source_planes(pose, sets.boards))
            total = np.sum(variance * sets.used, axis=(-1, -2), keepdims=True)
            triangles = compress(sets, np.sqrt(sets.used.sum() / total))
            return lambda p: residual(p, triangles, sets.boards, None, sets.number)
        triangles, offset, _ = correct_and_compress(sets, pose)
        whitener = board_whitener(pose, triangles, sets.boards, sets.board_covariance)
        return lambda p: residual(p, triangles, sets.boards, whitener, offset=offset)

    rounds = ROUNDS if weighted else 0
    problem, pose = minimise_in_rounds(freeze, pose, move_pose, rounds, **options)
    chi2_rest = correct_and_compress(sets, pose)[2] if weighted else 0.0
    count = sets.number.sum()
    return solve_pose(
        problem,
        pose,
        obs.camera,
        method=method,
        groups=sets.placements,
        freedom=count - POSE,
        n_observations=count,
        chi2_rest=chi2_rest,
        **options,
    )


def solve_pose(evaluate: Callable, pose: np.ndarray, camera: str, **asked) -> Solution:
    """The Solution of a problem whose only unknown is the pose (..., 3, 4) of a camera; what is
    asked as of :func:`lrfcal_lib.fit.least_squares.solve`.
    """
    return solve(
        evaluate,
        pose,
        move_pose,
        names=POSE_NAMES,
        read=read_pose,
        words=lambda direction: motion_words(direction, camera),
        **asked,
    )


def plane_sets(obs: CameraObservations, scanned: bool = True) -> PlaneSets:
    """Group the face points of the placements (three at least) whose board pose the camera knows.

    Without `scanned` also the placements that have none.
    """
    obs.require("plane")
    wanted = obs.plane_placement if scanned else obs.placements
    rows = np.flatnonzero(np.isin(obs.placements, wanted))
    where, mine = np.nonzero(obs.placements[rows, None] == obs.plane_placement)
    padded = pad(where, len(rows), width=4, row=mine)
    index = padded["row"]
    used = padded["used"]
    return PlaneSets(
        obs.placements[rows],
        points=obs.plane_points[..., index, :] * used[..., None],
        covariance=obs.plane_covariance[..., index, :, :],
        used=used,
        boards=obs.board_poses[..., rows, :3, :],
        board_covariance=obs.board_covariance[..., rows, :, :],
        number=used.sum(axis=1),
    )


def check_normals(sets: PlaneSets, camera: str) -> None:
    """Refuse boards whose normals hardly spread some way, naming what stays open."""
    normals = sets.boards[:, :, 2]
    _, spread, axes = np.linalg.svd(normals)
    spread = spread / np.sqrt(len(normals))
    directions = ["({:.2f}, {:.2f}, {:.2f})".format(*(axis + 0.0)) for axis in axes]
    if spread[1] < LEAST_SPREAD:
        raise DegenerateGeometry(
            f"camera '{camera}': all {len(normals)} boards are parallel: the rotation about "
            f"their normal {directions[0]} and the translation along {directions[1]} and "
            f"{directions[2]} stay unobservable; tilt the board in both directions"
        )
    if spread[2] < LEAST_SPREAD:
        raise DegenerateGeometry(
            f"camera '{camera}': the boards turn about one axis only: the translation along "
            f"{directions[2]} of the camera frame stays unobservable; tilt the board in both "
            "directions"
        )


def source_planes(pose, boards):
    """Planes of boards (..., p, 3, 4) in the source frame of poses (..., 3, 4), ``plane . [P, 1] =
    0``, shape (..., p, 4).
    """
    normal = boards[..., 2]
    last = np.vecdot(normal, pose[..., None, :, 3] - boards[..., 3])
    return np.concatenate([normal @ pose[..., :3], last[..., None]], axis=-1)


def _with_one(points):
    """Rows ``[p, 1]``."""
    return np.insert(points, 3, 1.0, axis=-1)


def compress(sets: PlaneSets, weights) -> np.ndarray:
    """Triangles of the weighted rows ``[p, 1]``, shape (..., p, 4, 4), from reciprocal standard
    deviations.
    """
    rows = _with_one(sets.points) * (weights * sets.used)[..., None]
    return np.asarray(np.linalg.qr(rows, mode="r"))


def _noise_across(sets, planes):
    """What pulls points off planes (..., p, n, 3), metres^2, and their variance across them."""
    across = planes[..., :3]
    pull = np.matvec(sets.covariance, across[..., None, :])
    return pull, np.vecdot(pull, across[..., None, :]) + SIGMA_FLOOR**2


def correct_and_compress(sets: PlaneSets, pose: np.ndarray):
    """Compress points that were moved onto the camera's planes, as seen at a pose, by their noise.

    A point's noise is in its residual and in its row of the Jacobian alike; rows of the moved
    points are free of the bias (see :mod:`lrfcal_lib.fit.least_squares`). Returns triangles (...,
    p, 4, 4), an offset (..., p, 4) and a rest: residuals are ``A h + offset``, at the pose what the
    moved rows see of the raw distances; the rest is the chi-square of what they do not see.
    """
    planes = source_planes(pose, sets.boards)
    pull, variance = _noise_across(sets, planes)
    weights = sets.used / np.sqrt(variance)
    distance = np.vecdot(_with_one(sets.points), planes[..., None, :])
    moved = sets.points - pull * (distance * weights**2)[..., None]
    basis, triangles = np.linalg.qr(_with_one(moved) * weights[..., None])
    whole = weights * distance
    visible = np.matvec(basis.mT, whole)
    rest = np.sum(np.vecdot(whole, whole) - np.vecdot(visible, visible), axis=-1)
    return triangles, visible - np.matvec(triangles, planes), rest


def plane_block(pose, triangles, boards, whitener=None, count=None, offset=0.0) -> Block:
    """Distances of compressed points from the planes of boards with known poses, 4 p residuals.

    The whitener is that of :func:`board_whitener`, none when the boards' poses count as exact;
    `count` (p,) is the number of points of each placement, for losses on raw triangles. A loss
    judges a placement as a whole.
    """
    residuals, by_pose, _ = plane_terms(pose, triangles, boards, offset)
    if whitener is None:
        whitener = np.eye(4)
    whitener = np.broadcast_to(whitener, residuals.shape + (4,))
    return Block.of_groups(residuals, by_pose, whitener, count=count)


def board_whitener(pose, triangles, boards, board_covariance):
    """Whiteners (..., p, 4, 4) for errors of the boards' poses, common to all points of a
    placement.
    """
    _, _, by_board = plane_terms(pose, triangles, boards)
    covariance = np.eye(4) + by_board @ board_covariance @ by_board.mT
    return inverse_root(covariance)


def plane_terms(pose, triangles, boards, offset=0.0):
    """Residuals ``A h + offset`` (..., p, 4) and their Jacobians (..., p, 4, 6) by the pose and by
    the board's pose.
    """
    residuals = plane_residuals(pose, triangles, boards, offset)
    normal = boards[..., 2]
    by_pose = np.zeros(residuals.shape + (6,))  # of h
    by_pose[..., :3, :3] = pose[..., None, :, :3].mT @ hat(normal)
    by_pose[..., 3, 3:] = normal
    by_board = -by_pose
    by_board[..., 3, :3] = cross(normal, pose[..., None, :, 3] - boards[..., 3])
    return residuals, triangles @ by_pose, triangles @ by_board


def plane_residuals(pose, triangles, boards, offset=0.0):
    """Residuals ``A h + offset`` (..., p, 4), h the boards' planes in the source frame."""
    return np.matvec(triangles, source_planes(pose, boards)) + offset


def plane_error(obs: CameraObservations, solution: Solution) -> float:
    """Size of the errors common to a placement: rms over the placements of their mean distance,
    metres.

    Zero where chi-square agrees with the stated noise (``solution.inflation`` is 1).
    """
    if solution.inflation == 1.0:
        return 0.0
    distance = plane_residuals_m(obs, solution.transform)
    placements = np.unique(obs.plane_placement)
    return rms(ndimage.mean(distance, obs.plane_placement, placements))


def planes_and_pattern(state, planes, obs: CameraObservations, lens) -> list[Block]:
    """Residuals by placement of pose, intrinsics and board poses (p, 3, 4): point-plane distances,
    pattern corners.

    `planes` are triangles, offsets and whiteners of :func:`plane_terms`; triangles are zero where
    nothing was scanned. Unknowns: pose 6 and intrinsics (the first `lens`) are shared, the board's
    pose 6 is the placement's own.
    """
    pose, intrinsics, boards = state
    triangles, offset, whitener = planes
    residuals, by_pose, by_board = plane_terms(pose, triangles, boards, offset)
    by_lens = np.zeros(residuals.shape + (lens,))
    jacobian = np.concatenate([by_pose, by_lens, by_board], axis=-1)
    distances = Block(residuals, jacobian, whitener[:, None])

    camera = obs.model.with_parameters(intrinsics)
    rotated, corners = rotate_and_move(boards, obs.pattern_points)
    by_point, by_lens = project_jacobians(corners, camera)
    visible = np.isfinite(obs.pattern_pixels)
    errors = np.where(visible, project(corners, camera) - obs.pattern_pixels, 0.0)
    by_board = gradient_by_pose(rotated[..., None, :], by_point)
    jacobian = np.concatenate(
        [np.zeros_like(by_board), by_lens[..., :lens], by_board], axis=-1
    )
    weights = visible.reshape(len(boards), -1) / obs.pattern_sigma_px
    return [distances, Block.of_groups(errors, jacobian, weights)]


def estimate_with_lens(
    residual,
    obs: CameraObservations,
    pose: np.ndarray,
    *,
    method,
    uses,
    lens=LENS,
    **options,
) -> Solution:
    """Pose, intrinsics and board poses together: pattern reprojection plus point-plane distances.

    The start is the estimate from planes with the board poses and the model that the observations
    hold; points are compressed once more at the first solution. An error that all points of a
    placement have in common (a bent board, a wrong pitch; see :func:`plane_error`) is allowed for:
    without it thousands of points would overrule the pattern.

    Parameters
    ----------
    residual : callable
        As :func:`planes_and_pattern`.
    obs, pose, method, uses, **options
        As of :func:`estimate_from_planes`.
    lens : int
        Of the intrinsics so many are free: 4 is K alone (as published), 9 with the distortion.

    Returns
    -------
    Solution
        Its ``model`` holds the refined intrinsics with their covariance, ``board_poses`` the
        refined boards.

    Raises
    ------
    DegenerateGeometry
        Without pattern corners.
    """
    visible = np.isfinite(obs.pattern_pixels)
    if len(obs.pattern_points) < FEWEST_CORNERS or not visible.any():
        raise DegenerateGeometry(
            f"camera '{obs.camera}': {len(obs.pattern_points)} pattern corners, a joint "
            "refinement needs a printed pattern"
        )
    solution = estimate_from_planes(
        plane_block, obs, pose, method=method, uses=uses, **options
    )
    error = plane_error(obs, solution)
    # of a board's pose: tilt over a lever, offset
    common = np.diag(np.repeat([error / TILT_LEVER, error], 3) ** 2)
    sets = plane_sets(obs, scanned=False)
    numbers = sets.number.sum() + visible.sum()
    state = (pose_array(solution.transform), obs.model.parameters, sets.boards)
    for _ in range(2):
        pose, _, boards = state
        triangles, offset, rest = correct_and_compress(sets._replace(boards=boards), pose)
        whitener = board_whitener(pose, triangles, boards, common)
        solution = solve(
            partial(residual, planes=(triangles, offset, whitener), obs=obs, lens=lens),
            state,
            _move_with_lens,
            read=partial(_read_with_lens, lens=lens),
            names=POSE_NAMES + INTRINSIC_NAMES[:lens],
            method=method,
            scales=(1.0,) * 6 + LENS_SCALES[:lens],
            shared=6 + lens,
            freedom=numbers - 6 - lens - 6 * len(obs.placements),
            chi2_rest=rest,
            n_observations=numbers,
            **options,
        )
        state = solution.state
    return _with_refined_model(solution, obs, lens)


def _move_with_lens(state, step):
    """Retraction of pose, intrinsics (the first of them, as many as are free) and board poses."""
    pose, intrinsics, boards = state
    change = step[0, 6:-6]
    refined = intrinsics + np.pad(change, (0, LENS - len(change)))
    return move_pose(pose, step[0, :6]), refined, move_pose(boards, step[:, -6:])


def _read_with_lens(state, lens):
    """The transform, and the shared unknowns."""
    transform, parameters = read_pose(state[0])
    return transform, np.concatenate([parameters, state[1][:lens]])


def _with_refined_model(solution, obs, lens):
    """The Solution with its intrinsics as a CameraModel, and the boards' poses."""
    _, intrinsics, boards = solution.state
    corners = apply_pose(boards, obs.pattern_points)
    misses = project(corners, obs.model.with_parameters(intrinsics)) - obs.pattern_pixels
    miss = 2**0.5 * rms(misses)  # per corner, as OpenCV has it
    covariance = np.pad(solution.covariance[6:, 6:], (0, LENS - lens))
    model = obs.model.with_parameters(intrinsics, covariance, miss)
    return replace(solution, model=model, board_poses=pose_transform(boards).as_matrix())
