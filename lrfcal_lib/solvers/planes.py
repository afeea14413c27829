"""Cameras from planes (Zhang and Pless 2004): compressed points, closed form, refinement,
intrinsics.
"""

from dataclasses import replace
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lrfcal_lib.fit.least_squares import Block, minimise, minimise_in_rounds, pad, solve
from lrfcal_lib.fit.residuals import SIGMA_FLOOR, plane_residuals_m, read_pose
from lrfcal_lib.model import geometry
from lrfcal_lib.model.camera import INTRINSIC_NAMES, project, project_jacobians
from lrfcal_lib.model.geometry import (
    POSE_NAMES,
    DegenerateGeometry,
    apply_pose,
    move_pose,
    pose_transform,
)


class PlaneSets(NamedTuple):
    """Face points (..., p, n, 3) by placement, padded with zeros to the same number, source frame,
    metres.

    `boards` (..., p, 3, 4) are ``T_camera_board``, `rows` (p,) those of the placements among the
    observations' own, `number` (p,) that of each one's points.
    """

    placements: np.ndarray
    points: np.ndarray
    covariance: np.ndarray
    used: np.ndarray
    boards: np.ndarray
    board_covariance: np.ndarray
    rows: np.ndarray
    number: np.ndarray


def plane_sets(obs):
    """Group the face points of the placements (three at least) whose board pose the camera
    knows.
    """
    obs.require("plane", 3)
    placements, rows, _ = np.intersect1d(obs.placements, obs.plane_placement, return_indices=True)
    mine = np.flatnonzero(np.isin(obs.plane_placement, placements))
    where = np.searchsorted(placements, obs.plane_placement[mine])
    padded = pad({"row": mine, "placement": where}, len(placements), width=4)
    index = padded["row"]
    used = padded["used"]
    points = obs.plane_points[..., index, :]
    covariance = obs.plane_covariance[..., index, :, :]
    boards = obs.board_poses[..., rows, :3, :]
    spread = obs.board_covariance[..., rows, :, :]
    points = np.where(used[..., None], points, 0.0)
    return PlaneSets(placements, points, covariance, used, boards, spread, rows, used.sum(axis=1))


def compress(sets, weights):
    """Triangles of the weighted rows ``[p, 1]``, shape (..., p, 4, 4), from reciprocal standard
    deviations.
    """
    rows = np.concatenate([sets.points, np.ones(sets.points.shape[:-1] + (1,))], axis=-1)
    return np.linalg.qr(rows * (weights * sets.used)[..., None], mode="r")


def _seen_from(sets, pose):
    """The camera's planes in the source frame, ``across .

    P + last = 0``, and the noise that pulls points off them.
    """
    across = (np.swapaxes(pose[..., None, :, :3], -1, -2) @ sets.boards[..., 2:3])[..., 0]
    last = np.sum(
        sets.boards[..., 2] * (pose[..., None, :, 3] - sets.boards[..., 3]), axis=-1, keepdims=True
    )
    pull = (sets.covariance @ across[..., None, :, None])[..., 0]
    return across, last, pull, np.sum(pull * across[..., None, :], axis=-1) + SIGMA_FLOOR**2


def correct_and_compress(sets, pose):
    """Compress points that were moved onto the camera's planes, as seen at a pose, by their noise.

    A point's noise is in its residual and in its row of the Jacobian alike; rows of the moved
    points are free of the bias (see :mod:`lrfcal_lib.fit.least_squares`). Returns triangles (...,
    p, 4, 4), an offset (..., p, 4) and a rest: residuals are ``A h + offset``, at the pose what the
    moved rows see of the raw distances; the rest is the chi-square of what they do not see.
    """
    across, last, pull, variance = _seen_from(sets, pose)
    distance = np.sum(sets.points * across[..., None, :], axis=-1) + last
    weights = sets.used / np.sqrt(variance)
    moved = sets.points - pull * (distance * weights**2)[..., None]
    basis, triangles = np.linalg.qr(
        np.concatenate([moved, np.ones_like(moved[..., :1])], axis=-1) * weights[..., None]
    )
    seen = (np.swapaxes(basis, -1, -2) @ (weights * distance)[..., None])[..., 0]
    plane = np.concatenate([across, last], axis=-1)
    rest = np.sum((weights * distance) ** 2, axis=(-1, -2)) - np.sum(seen**2, axis=(-1, -2))
    return triangles, seen - (triangles @ plane[..., None])[..., 0], rest


def equal_weights(sets, pose):
    """One common weight for all points: the root mean square of their noise (plain least
    squares), (..., 1, 1).
    """
    variance = _seen_from(sets, pose)[3]
    return (np.sum(variance * sets.used, axis=(-1, -2), keepdims=True) / sets.used.sum()) ** -0.5


def plane_block(pose, triangles, boards, whitener=None, count=None, offset=0.0):
    """Distances of compressed points from the planes of boards with known poses, 4 p residuals.

    The whitener is that of :func:`board_whitener`, none when the boards' poses count as exact;
    `count` (p,) is the number of points of each placement, for losses on raw triangles. A loss
    judges a placement as a whole.
    """
    residuals, by_pose, _ = plane_terms(pose[..., None, :, :], triangles, boards, offset)
    shape = residuals.shape[:-2] + (-1,)
    whitener = np.broadcast_to(np.eye(4) if whitener is None else whitener, residuals.shape + (4,))
    return Block(residuals.reshape(shape), by_pose.reshape(shape + (6,)), whitener, count)


def board_whitener(pose, triangles, boards, board_covariance):
    """Whiteners (..., p, 4, 4) for errors of the boards' poses, common to all points of a
    placement.
    """
    _, _, by_board = plane_terms(pose[..., None, :, :], triangles, boards)
    covariance = np.eye(4) + by_board @ board_covariance @ np.swapaxes(by_board, -1, -2)
    return np.linalg.inv(np.linalg.cholesky(covariance))


def plane_terms(pose, triangles, boards, offset=0.0):
    """Residuals ``A h + offset`` (..., 4) and their Jacobians (..., 4, 6) by the pose and by
    the board's pose.
    """
    residuals, turned, between = plane_residuals(pose, triangles, boards, offset)
    normal = boards[..., 2]
    spin = turned @ geometry.hat(normal)
    normal = np.broadcast_to(normal, spin.shape[:-1])[..., None, :]
    moment = geometry.cross(normal[..., 0, :], between)[..., None, :]
    upper = np.concatenate([spin, np.zeros_like(spin)], axis=-1)
    by_pose = np.concatenate(
        [upper, np.concatenate([np.zeros_like(normal), normal], axis=-1)], axis=-2
    )
    by_board = np.concatenate([-upper, np.concatenate([moment, -normal], axis=-1)], axis=-2)
    return residuals, triangles @ by_pose, triangles @ by_board


def plane_residuals(pose, triangles, boards, offset=0.0):
    """Residuals of :func:`plane_terms`, the rotation back (..., 3, 3), and what lies between
    the origins (..., 3).
    """
    normal = boards[..., 2]
    between = pose[..., 3] - boards[..., 3]
    turned = np.swapaxes(pose[..., :3], -1, -2)
    top = (turned @ normal[..., None])[..., 0]
    last = np.sum(normal * between, axis=-1, keepdims=True)
    return (
        (triangles @ np.concatenate([top, last], axis=-1)[..., None])[..., 0] + offset,
        turned,
        between,
    )


def check_normals(sets, camera, least=0.02):
    """Refuse boards whose normals spread less than `least` (about radians) some way, naming
    what stays open.
    """
    normals = sets.boards[:, :, 2]
    _, spread, axes = np.linalg.svd(normals)
    spread = np.append(spread, np.zeros(3))[:3] / np.sqrt(len(normals))
    directions = ["({:.2f}, {:.2f}, {:.2f})".format(*(a + 0.0)) for a in axes]
    if spread[1] < least:
        raise DegenerateGeometry(
            f"camera '{camera}': all {len(normals)} boards are parallel: the rotation about "
            f"their normal {directions[0]} and the translation along {directions[1]} and "
            f"{directions[2]} stay "
            "unobservable; tilt the board in both directions"
        )
    if spread[2] < least:
        raise DegenerateGeometry(
            f"camera '{camera}': the boards turn about one axis only: the translation along "
            f"{directions[2]} "
            "of the camera frame stays unobservable; tilt the board in both directions"
        )


SUBSETS = 400
MINIMAL = 40
SAME_TURN = np.radians(10.0)  # poses nearer to each other than this are one minimum
MOST_APART = 6  # minima to choose from
CAPPED = 16.0  # times the usual square: a larger miss (four standard deviations) fits no minimum
NEARLY = 1.2  # times the misses of the best minimum: another one explains the data nearly as well
SEEN = 0.8  # of the placements: a few may be wrong
ROTATIONS = 200
FLAT = 1e-3  # of its extent: what leaves a common plane less is a set of single scan lines
TILT_LEVER = 0.3  # metres, about half a board: turns an offset into the tilt that bends as much
INTRINSIC_SCALES = (1e3, 1e3, 1e3, 1e3, 10.0, 10.0, 10.0, 10.0, 100.0)


def start_from_planes(obs):
    """Start values of ``T_camera_source``, the best one first: a stack, mostly of one.

    Minimal and closed forms in random subsets of the placements, least trimmed squares. Others than
    the best are minima far from it that explain the placements nearly as well.
    """
    sets = plane_sets(obs)
    check_normals(sets, obs.camera)
    triangles = compress(sets, 1.0)
    p = len(sets.placements)
    frame, flat = common_plane(triangles)
    lines = triangles @ frame
    threes = _subsets(p, 3)
    found = [
        three_planes(lines[threes[:MINIMAL]], sets.boards[threes[:MINIMAL]]).reshape(-1, 3, 4)
        @ frame.T
    ]
    every = np.arange(p)[None]
    if not flat:
        found += [closed_form(triangles, sets.boards, rows, True) for rows in (threes, every)]
    if p >= 5:
        own = _subsets(p, 5), every
        found += [closed_form(lines, sets.boards, rows, False) @ frame.T for rows in own]
    candidates = _before_boards(np.concatenate(found), sets, _centred(triangles)[1])

    def trimmed(count):
        """Order of the candidates by their mean square over so many placements that suit best."""
        squares = np.sort(_squares(candidates, triangles, sets), axis=1)
        return np.argsort(squares[:, :count].mean(axis=1))

    def evaluate(pose):
        return plane_block(pose, triangles / 0.005, sets.boards, None, sets.number)

    # more placements than a closed form uses; half of them may be wrong, or all but one right
    counts = {p // 2 + 2, max(p // 2 + 2, 7 if flat else 5)}
    orders = [trimmed(min(count, p)) for count in counts]
    first = [row for order in orders for row in (*order[:4], *_apart(candidates, order))]
    best = candidates[np.unique(first)]
    options = {"loss": "cauchy", "scale": "auto", "max_iterations": 12, "tolerance": 0.01}
    robust, *_ = minimise(evaluate, best, move_pose, **options)
    plain, *_ = minimise(evaluate, robust, move_pose, max_iterations=12, tolerance=0.01)
    every = np.concatenate([robust, plain, best])
    sizes = sizes_of_minima(_squares(every, triangles, sets), sets.number)
    apart = _apart(every, np.argsort(sizes))
    return pose_transform(every[[row for row in apart if sizes[row] <= NEARLY * sizes[apart[0]]]])


def _squares(poses, triangles, sets):
    """Mean squared distances (n, p) of each placement's points from its plane, at n poses."""
    residuals = plane_residuals(poses[:, None], triangles, sets.boards)[0]
    return np.sum(residuals**2, axis=2) / sets.number


def sizes_of_minima(squares, weights=None):
    """Robust sizes (n,) of the misses at n minima, which tell the one that explains the data best.

    Roots of weighted means of squares (n, k), each one counted up to `CAPPED` times the level: that
    of the minimum with the smallest median, one level for all. The median alone would not see what
    half of the data say.
    """
    level = np.median(squares, axis=1).min()
    capped = np.minimum(squares, CAPPED * level + SIGMA_FLOOR**2)
    return np.sqrt(np.average(capped, axis=1, weights=weights))


def _apart(poses, order):
    """Indices of the first poses in some order that are turned against all before, `MOST_APART`."""
    found = []
    left = np.asarray(order)
    while len(left) and len(found) < MOST_APART:
        first = left[0]
        found.append(first)
        turns = np.trace(poses[left, :, :3] @ poses[first, :, :3].T, axis1=1, axis2=2)
        left = left[turns < 1 + 2 * np.cos(SAME_TURN)]
    return found


def rival_words(camera, best, other):
    """That another pose of a camera explains the data nearly as well."""
    turn, shift = geometry.transform_difference(best, other)
    return (
        f"a second minimum explains the data nearly as well: camera '{camera}' "
        f"{np.degrees(turn):.0f} deg and "
        f"{1000 * shift:.0f} mm from where it is handed over; record more placements that lean "
        "other ways"
    )


def _before_boards(poses, sets, centres):
    """Poses that put (most of) the boards before the camera, and the range finder on the side
    that the camera sees.
    """
    normal = sets.boards[..., 2]
    point = sets.boards[..., 3]
    side = (
        np.sum((poses[:, None, :, 3] - point) * normal, axis=-1) * -np.sum(point * normal, axis=-1)
        > 0
    )
    seen = np.mean(side & (apply_pose(poses, centres)[..., 2] > 0), axis=1)
    return poses[(seen >= min(SEEN, seen.max())) & np.isfinite(poses).all(axis=(1, 2))]


def common_plane(triangles):
    """The plane that all compressed points of a recording lie in, and whether they do.

    The first, (4, 4), turns rows ``[p, 1]`` into rows of a frame whose plane z = 0 it is. They do
    for single scan lines in one plane of the LRF: how far noise scatters them within it tells
    nothing.
    """
    root, centre = _centred(triangles.reshape(1, -1, 4))
    _, spread, axes = np.linalg.svd(root[0])
    frame = np.eye(4)
    frame[:3, :3] = axes.T * np.array([1.0, 1.0, np.linalg.det(axes)])
    frame[3, :3] = -centre[0] @ frame[:3, :3]
    return frame, bool(spread[2] < FLAT * spread[0])


def _centred(triangles):
    """Scatter roots about the centroid (p, 3, 3), and the centroids (p, 3), of compressed
    points.
    """
    rows = np.concatenate([triangles[..., 3:], triangles[..., :3]], axis=-1)
    turned = np.linalg.qr(rows, mode="r")
    return turned[..., 1:, 1:], turned[..., 0, 1:] / turned[..., 0, :1]


def closed_form(triangles, boards, rows, solid):
    """The linear solution of Zhang and Pless, ``T_camera_source`` (n, 3, 4), from n sets (n, k) of
    the placements.

    `solid`: the points of a placement span a plane, the rotation comes from the planes' normals (k
    >= 3). Otherwise points of single scan lines (z = 0), nine linear unknowns (k >= 5).
    """
    normal = boards[..., 2]
    offset = np.sum(normal * boards[..., 3], axis=-1)
    root, centre = _centred(triangles)
    if solid:
        source = np.linalg.svd(root)[2][:, 2]
        source = source * np.sign(np.sum(source * centre, axis=-1, keepdims=True))
        camera = normal * np.where(offset < 0, -1.0, 1.0)[:, None]
        rotation = np.swapaxes(camera[rows], -1, -2) @ source[rows]
    else:
        # z is 0: the normal equations are linear in the first two columns of R, and t
        flat = triangles[..., [0, 1, 3]]
        square = np.swapaxes(flat, -1, -2) @ flat
        square = square / square[:, 2:, 2:]
        outer = normal[:, :, None] * normal[:, None, :]
        left = (square[:, :, None, :, None] * outer[:, None, :, None, :]).reshape(-1, 9, 9)
        right = (square[:, :, 2:] * (normal * offset[:, None])[:, None, :]).reshape(-1, 9)
        found = _solved(left[rows].sum(axis=1), right[rows].sum(axis=1)).reshape(-1, 3, 3)
        first = found[:, 0]
        second = found[:, 1]
        rotation = np.stack([first, second, np.cross(first, second)], axis=-1)
    return _on_planes(rotation, normal[rows], boards[rows][..., 3], centre[rows])


def _on_planes(rotation, normal, point, centre):
    """Poses with the proper rotations nearest to some matrices that put centroids on planes as
    well as they can.
    """
    u, _, vt = np.linalg.svd(rotation)
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))[..., None, None]
    rotation = np.concatenate([u[..., :2], u[..., 2:] * sign], axis=-1) @ vt
    moved = (rotation[..., None, :, :] @ centre[..., None])[..., 0]
    return shifted(rotation, normal, np.sum(normal * (point - moved), axis=-1))


def three_planes(triangles, boards):
    """The minimal solution of Vasconcelos, Barreto and Nunes (2012), ``T_camera_source`` (..., 8,
    3, 4).

    For stacks of three single scan lines (z = 0). That their directions lie in the boards' planes
    leaves three dimensions to the first two columns of R; two quadrics there make these orthogonal
    and of one length. Each of four solutions has both signs; complex ones keep their real part.
    """
    normal = boards[..., 2]
    (root, centre) = _centred(triangles)
    along = np.linalg.svd(root[..., :2])[2][..., 0, :]
    rows = (along[..., :, None] * normal[..., None, :]).reshape(*normal.shape[:-1], 6)
    null = np.linalg.svd(rows)[2][..., 3:, :]
    first = null[..., :3]
    second = null[..., 3:]
    lengths, angle = (
        [a @ np.swapaxes(b, -1, -2) for a, b in pairs]
        for pairs in (((first, first), (second, second)), ((first, second), (second, first)))
    )
    columns = _common_points(lengths[0] - lengths[1], angle[0] + angle[1]) @ null
    columns = np.concatenate([columns, -columns], axis=-2)
    one = columns[..., :3]
    two = columns[..., 3:]
    rotation = np.stack([one, two, np.cross(one, two)], axis=-1)
    rotation /= np.maximum(np.linalg.norm(one, axis=-1), 1e-12)[..., None, None]
    return _on_planes(
        rotation, normal[..., None, :, :], boards[..., None, :, :, 3], centre[..., None, :, :]
    )


@np.errstate(all="ignore")
def _common_points(one, two):
    """The four points ``[x, y, 1]`` (..., 4, 3) that two conics (..., 3, 3) share.

    Real parts of complex ones.
    """

    def at(y):
        """Numerator and denominator of x at y, and the resultant, which is zero where the
        conics meet.
        """
        (a, b, c), (d, e, f) = (
            (Q[0, 0], 2 * (Q[0, 1] * y + Q[0, 2]), Q[1, 1] * y**2 + 2 * Q[1, 2] * y + Q[2, 2])
            for Q in (np.moveaxis(Q, (-2, -1), (0, 1))[..., None] for Q in (one, two))
        )  # a x^2 + b x + c
        up = d * c - a * f
        down = a * e - d * b
        return up, down, up**2 - down * (b * f - e * c)

    nodes = np.arange(-2.0, 3.0)
    resultant = at(nodes)[2] @ np.linalg.inv(np.vander(nodes)).T
    companion = np.zeros(resultant.shape[:-1] + (4, 4))
    companion[..., 0, :] = -resultant[..., 1:] / resultant[..., :1]
    companion[..., [1, 2, 3], [0, 1, 2]] = 1.0
    # parallel boards leave nothing
    y = np.linalg.eigvals(np.nan_to_num(companion, posinf=0.0, neginf=0.0))
    up, down, _ = at(y)
    found = np.stack([(up / down).real, y.real, np.ones(y.shape)], axis=-1)
    return np.nan_to_num(found, posinf=0.0, neginf=0.0)


def shifted(rotation, normal, right):
    """Poses (..., 3, 4) of rotations with the translation for which ``n . t = right`` fits best."""
    normal = np.broadcast_to(normal, right.shape + (3,))
    transposed = np.swapaxes(normal, -1, -2)
    shift = _solved(transposed @ normal, (transposed @ right[..., None])[..., 0])
    return np.concatenate([rotation, shift[..., None]], axis=-1)


def _solved(square, right):
    """Solutions of normal equations (..., k, k), (..., k).

    What these leave open stays about zero.
    """
    size = square.shape[-1]
    ridge = 1e-13 * np.trace(square, axis1=-2, axis2=-1)[..., None, None] + 1e-300
    return np.linalg.solve(square + ridge * np.eye(size), right[..., None])[..., 0]


def _subsets(p, size):
    """Sets of placements to try: all minimal ones, or many of them."""
    if comb(p, size) <= SUBSETS:
        return np.array(list(combinations(range(p), size)))
    return np.argsort(np.random.default_rng(0).random((SUBSETS, p)), axis=1)[:, :size]


def start_rotations():
    """The 24 rotations of a cube and random ones, shape (n, 3, 3)."""
    some = Rotation.random(ROTATIONS, rng=np.random.default_rng(0)).as_matrix()
    return np.concatenate([Rotation.create_group("O").as_matrix(), some])


def estimate_from_planes(residual, obs, pose, *, method, uses, weighted=True, **options):
    """The pose of a camera from the board's planes (Zhang and Pless).

    Weighted by the points' covariance across the board and, correlated within a placement, that of
    the board's pose; or plain least squares. Residuals are four numbers a placement, in standard
    deviations; the distances themselves come from
    :func:`lrfcal_lib.fit.residuals.plane_residuals_m`. Points are compressed anew in every round,
    from an unweighted estimate on: weights of a bad pose would hold it there. A loss judges whole
    placements, because a bad board pose spoils all points of its placement.
    """
    sets = plane_sets(obs)
    if sets.boards.ndim == 3:
        check_normals(sets, obs.camera)

    def freeze(pose, number):
        """The residuals with weights and compressed points as they are at a pose."""
        if not (weighted and number):
            triangles = compress(sets, equal_weights(sets, pose))
            return lambda p: residual(p, triangles, sets.boards, None, sets.number)
        triangles, offset, _ = correct_and_compress(sets, pose)
        whitener = board_whitener(pose, triangles, sets.boards, sets.board_covariance)
        return lambda p: residual(p, triangles, sets.boards, whitener, offset=offset)

    problem, pose, earlier = minimise_in_rounds(
        freeze, pose, move_pose, 5 if weighted else 0, **options
    )
    count = int(sets.number.sum())
    return solve(
        problem,
        pose,
        move_pose,
        names=POSE_NAMES,
        method=method,
        read=read_pose,
        words=lambda d: geometry.motion_words(d, obs.camera),
        groups=sets.placements,
        freedom=count - 6,
        n_observations=count,
        earlier=earlier,
        **options,
        chi2_rest=correct_and_compress(sets, pose)[2] if weighted else 0.0,
    )


def plane_error(obs, solution):
    """Size of the errors common to a placement: rms over the placements of their mean distance,
    metres.

    Zero where chi-square agrees with the stated noise (``solution.inflation`` is 1).
    """
    if solution.inflation == 1.0:
        return 0.0
    distance = plane_residuals_m(obs, solution.transform)
    known = np.isfinite(distance)
    _, index = np.unique(obs.plane_placement[known], return_inverse=True)
    return float(np.sqrt(np.mean((np.bincount(index, distance[known]) / np.bincount(index)) ** 2)))


def planes_and_pattern(state, planes, obs, lens=9):
    """Residuals by placement of pose, intrinsics and board poses (p, 3, 4): point-plane distances,
    pattern corners.

    `planes` are triangles, offsets and whiteners of :func:`plane_terms`; zero where nothing was
    scanned. Unknowns: pose 6 and intrinsics (the first `lens`) are shared, the board's pose 6 is
    the placement's own.
    """
    pose, intrinsics, boards = state
    triangles, offset, whitener = planes
    residuals, by_pose, by_board = plane_terms(pose, triangles, boards, offset)
    by_lens = np.zeros(residuals.shape + (lens,))
    distances = Block(
        residuals, np.concatenate([by_pose, by_lens, by_board], axis=-1), whitener[:, None]
    )
    camera = obs.model.with_parameters(intrinsics)
    pixels = obs.pattern_pixels
    seen = np.isfinite(obs.pattern_pixels)
    q = apply_pose(boards, obs.pattern_points)
    rotated = geometry.rotate_points(boards, obs.pattern_points)
    by_point, by_lens = project_jacobians(q, camera)
    errors = np.where(seen, project(q, camera) - np.where(seen, pixels, 0.0), 0.0)
    by_board = np.stack(
        [geometry.gradient_by_pose(rotated, by_point[..., i, :]) for i in range(2)], axis=-2
    )
    jacobian = np.concatenate([np.zeros_like(by_board), by_lens[..., :lens], by_board], axis=-1)
    p = len(boards)
    sigma = seen.reshape(p, -1) / obs.pattern_sigma_px
    return [
        distances,
        Block(errors.reshape(p, -1), jacobian.reshape(p, sigma.shape[1], 12 + lens), sigma),
    ]


def estimate_with_lens(residual, obs, pose, *, method, uses, lens=9, **options):
    """Pose, intrinsics and board poses together: pattern reprojection plus point-plane distances.

    Of the intrinsics the first `lens` are free: 4 is K alone (as published), 9 with the distortion.
    The start is the estimate from planes with the board poses and the model that the observations
    hold; points are compressed once more at the first solution. An error that all points of a
    placement have in common (a bent board, a wrong pitch; see :func:`plane_error`) is allowed for:
    without it thousands of points would overrule the pattern. The solution's ``model`` holds the
    refined intrinsics with their covariance, ``board_poses`` the refined boards. Raises
    DegenerateGeometry without pattern corners.
    """
    if obs.pattern_points.shape[0] < 4 or not np.isfinite(obs.pattern_pixels).any():
        raise DegenerateGeometry(
            f"camera '{obs.camera}': {len(obs.pattern_points)} pattern corners, a joint "
            "refinement needs a printed pattern"
        )
    solution = estimate_from_planes(plane_block, obs, pose, method=method, uses=uses, **options)
    sets = plane_sets(obs)
    p = len(obs.placements)
    count = len(obs.pattern_points)
    error = plane_error(obs, solution)
    # of a board's pose: tilt over a lever, offset
    common = np.diag(np.repeat([error / TILT_LEVER, error], 3) ** 2)
    numbers = int(sets.number.sum() + np.isfinite(obs.pattern_pixels).sum())
    state = geometry.pose_array(solution.transform), obs.model.parameters, obs.board_poses[:, :3]
    fixed = np.zeros(9 - lens)
    earlier = []
    for _ in range(2):
        sets = sets._replace(boards=state[2][sets.rows])
        triangles, offset, rest = correct_and_compress(sets, state[0])
        whitener = board_whitener(state[0], triangles, sets.boards, common)
        planes = np.zeros((p, 4, 4)), np.zeros((p, 4)), np.zeros((p, 4, 4))
        for every, scanned in zip(planes, (triangles, offset, whitener), strict=True):
            every[sets.rows] = scanned
        solution = solve(
            lambda state, planes=planes: residual(state, planes, obs, lens),
            state,
            lambda s, step: (
                move_pose(s[0], step[0][:6]),
                s[1] + np.r_[step[0][6:], fixed],
                move_pose(s[2], step[1]),
            ),
            read=lambda s: (
                pose_transform(s[0]),
                np.concatenate([read_pose(s[0])[1], s[1][:lens]]),
            ),
            names=POSE_NAMES + INTRINSIC_NAMES[:lens],
            method=method,
            scales=(1.0,) * 6 + INTRINSIC_SCALES[:lens],
            shared=6 + lens,
            freedom=numbers - 6 - lens - 6 * p,
            chi2_rest=rest,
            n_observations=numbers,
            earlier=earlier,
            **options,
        )
        state = solution.state
        earlier = [solution.cost_history]
    errors = solution.residuals[:, -2 * count :] * obs.pattern_sigma_px
    # per corner, as OpenCV has it
    rms = float(np.sqrt(2 * np.sum(errors**2) / np.isfinite(obs.pattern_pixels).sum()))
    model = obs.model.with_parameters(
        solution.state[1], np.pad(solution.covariance[6:, 6:], (0, 9 - lens)), rms
    )
    return replace(solution, model=model, board_poses=pose_transform(solution.state[2]).as_matrix())
