"""Start values without a rough measurement: closed forms and multi-starts that survive outlying placements."""

from __future__ import annotations

from itertools import combinations
from math import comb

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.geometry import DegenerateGeometry
from lrfcal_lib.solvers.checks import check_count, check_finite
from lrfcal_lib.solvers.least_squares import Block, minimise
from lrfcal_lib.solvers.planes import check_normals, compress, plane_block, plane_sets
from lrfcal_lib.solvers.pose import apply_pose, gradient_by_pose, move_pose, pose_transform, rotate_points

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


def sight_normals(lines, model):
    """Unit normals of the planes through the camera centre and image lines, and lengths of ``K^T l``."""
    raw = lines @ model.matrix
    length = np.linalg.norm(raw, axis=-1)
    return raw / length[..., None], length


def sight_block(pose, points, normals, sigma):
    """Distances of points from planes through the camera centre, metres.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
    points, normals : ndarray, shape (..., n, 3)
    sigma : ndarray, shape (..., n)
        Metres.

    Returns
    -------
    Block
    """
    rotated = rotate_points(pose, points)
    residuals = np.sum(normals * (rotated + pose[..., None, :, 3]), axis=-1)
    normals = np.broadcast_to(normals, rotated.shape)
    return Block(
        residuals, gradient_by_pose(rotated, normals), np.broadcast_to(1.0 / np.asarray(sigma), residuals.shape)
    )


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
