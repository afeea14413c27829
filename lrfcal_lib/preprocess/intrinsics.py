"""From a chessboard's corners in images: poses, intrinsics, the mounting of cameras, the waves
of the sheet.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.least_squares import Block, minimise
from lrfcal_lib.model.camera import CameraModel, project, project_jacobians
from lrfcal_lib.model.geometry import (
    apply_pose,
    gradient_by_pose,
    move_pose,
    pose_array,
    pose_transform,
    rotate_points,
)
from lrfcal_lib.preprocess.pattern_in_image import scale_error, square_px

SIGMA_FLOOR_PX = 0.05  # corner detectors are never better than this on real prints
OUTLIER_SIGMAS = 4.5
ROBUST_ROUNDS = 6
LEAST_TILT = np.radians(3.0)  # between views, to observe the focal length
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Adjustment:
    """Least squares over corners seen by rigidly mounted cameras.

    `models` have covariances and rms where the intrinsics were free. `mounting` is a stack of
    ``T_camera_first`` (the first is the identity), `poses` one of ``T_first_board``; their
    covariances (cameras - 1 or views, 6, 6) are of ``[w, v]``. `relief` (k,) are the heights of the
    corners over the sheet's mean plane, metres, `shape` (m,) their coefficients in the basis that
    was given, with their covariance. `residuals` (cameras, views, k, 2) are seen minus predicted
    pixels, NaN where a corner was not used. `sigma_px` is that of one coordinate, `rms_px` of
    distances, as OpenCV counts it; `bic` compares adjustments of the same corners.
    """

    models: tuple
    mounting: RigidTransform
    mounting_covariance: np.ndarray
    poses: RigidTransform
    pose_covariance: np.ndarray
    relief: np.ndarray
    shape: np.ndarray
    shape_covariance: np.ndarray
    residuals: np.ndarray
    sigma_px: float
    rms_px: float
    bic: float


def waves(points):
    """Heights that corners (k, 3) of a sheet may have over its mean plane: a basis, shape (k, k
    - 3).
    """
    return np.linalg.svd(np.column_stack([np.ones(len(points)), points[:, :2]]))[0][:, 3:]


def adjust(pixels, points, models, poses, mounting=None, *, intrinsics=True, basis=None, fixed=()):
    """Bundle adjustment of chessboard views (an Adjustment) with analytic derivatives.

    `pixels` (cameras, views, k, 2) hold NaN where a corner was not seen, `points` (k, 3) are the
    corners on the board. The rest are start values, of which the `intrinsics` (but for the `fixed`
    places in fx, fy, cx, cy, k1..k5) may stay as they are. The columns of `basis` (k, m) are
    heights that all views may have in common; those of :func:`waves` hold no plane, so that the
    poses are those of the sheet's mean plane.
    """
    cameras, views = pixels.shape[:2]
    basis = np.zeros((len(points), 0)) if basis is None else basis
    mounting = RigidTransform.identity(1) if mounting is None else mounting
    state = (
        np.stack([m.parameters for m in models]),
        pose_array(mounting),
        pose_array(poses),
        np.zeros(basis.shape[1]),
    )
    lens = np.full((cameras, 9), bool(intrinsics))
    lens[:, list(fixed)] = False
    cuts = np.cumsum([0, 9 * cameras, 6 * (cameras - 1), 6 * views, basis.shape[1]])
    free = np.r_[lens.ravel(), np.ones(cuts[4] - cuts[1], bool)]
    seen = np.isfinite(pixels)
    if seen.sum() < free.sum():
        raise ValueError(
            f"{seen.sum()} image coordinates cannot determine {free.sum()} unknowns: use more views"
        )

    def evaluate(state):
        predicted, jacobian = predict(state, points, basis)
        miss = np.where(seen, predicted - pixels, 0.0).ravel()
        return Block(miss, jacobian.reshape(miss.size, -1)[:, free], seen.ravel().astype(float))

    def retract(state, step):
        whole = np.zeros(len(free))
        whole[free] = step
        return moved(state, whole)

    state = minimise(evaluate, state, retract)[0]
    block = evaluate(state)
    count = int(seen.sum())
    error = block.residuals @ block.residuals
    sigma2 = max(error / max(count - free.sum(), 1), 1e-18)
    covariance = np.zeros((len(free),) * 2)
    normal = block.jacobian[seen.ravel()].T @ block.jacobian[seen.ravel()]
    # pixels, radians and metres mix safely
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scale = np.outer(scale, scale)
    covariance[np.ix_(free, free)] = sigma2 * np.linalg.pinv(normal * scale, hermitian=True) * scale
    own = [
        np.arange(a, b).reshape(-1, size)
        for a, b, size in zip(cuts, cuts[1:], (9, 6, 6), strict=False)
    ]
    lens, mount, view = (covariance[rows[:, :, None], rows[:, None]] for rows in own)
    residuals = np.where(seen, -block.residuals.reshape(seen.shape), np.nan)
    *each, rms = (float(np.sqrt(2 * np.nanmean(part**2))) for part in (*residuals, residuals))
    if intrinsics:
        models = [
            m.with_parameters(*known)
            for m, *known in zip(models, state[0], lens, each, strict=True)
        ]
    bic = float(count * np.log(max(error, 1e-300) / count) + free.sum() * np.log(count))
    mounts = (pose_transform(state[1]), mount)
    boards = (pose_transform(state[2]), view)
    sheet = basis @ state[3], state[3], covariance[cuts[3] :, cuts[3] :]
    return Adjustment(
        tuple(models), *mounts, *boards, *sheet, residuals, float(np.sqrt(sigma2)), rms, bic
    )


def predict(state, points, basis):
    """Pixels (c, v, k, 2) of corners on a sheet with heights ``basis @ relief``, and their
    derivatives (..., unknowns).

    The state is (intrinsics (c, 9), ``T_camera_first`` (c, 3, 4), ``T_first_board`` (v, 3, 4),
    relief); so are the unknowns, without the first mounting, poses as ``[w, v]``.
    """
    lenses, mounting, poses, shape = state
    turned = rotate_points(poses, points + (basis @ shape)[:, None] * UP)
    pixels = []
    derivatives = []
    p_first = turned + poses[:, None, :, 3]
    view = np.eye(len(poses))[:, None, None]

    def at(place, own):
        """Derivatives (..., m) by one of several (a row of their identity (..., n)) among those
        by all, (..., n m).
        """
        return (place[..., None] * own[..., None, :]).reshape(*own.shape[:-1], -1)

    for camera, lens, mount in zip(np.eye(len(lenses)), lenses, mounting, strict=True):
        mounted = rotate_points(mount, p_first)
        by_point, by_lens = project_jacobians(
            mounted + mount[:, 3], CameraModel(1, 1, *lens[:4], lens[4:])
        )
        # the derivatives by fx and fy are the distorted normalised coordinates themselves
        distorted = np.stack([by_lens[..., 0, 0], by_lens[..., 1, 1]], axis=-1)
        pixels.append(lens[:2] * distorted + lens[2:4])
        by_mount = gradient_by_pose(mounted[..., None, :], by_point)
        by_first = by_point @ mount[:, :3]
        by_view = at(view, gradient_by_pose(turned[..., None, :], by_first))
        by_shape = np.einsum("vkij,vj->vki", by_first, poses[:, :, 2])[..., None] * basis[:, None]
        derivatives.append(
            np.concatenate(
                [at(camera, by_lens), at(camera[1:], by_mount), by_view, by_shape], axis=-1
            )
        )
    return np.array(pixels), np.array(derivatives)


def moved(state, step):
    """The state of :func:`predict` after a step of all its unknowns."""
    lenses, mounting, poses, relief = state
    cuts = np.cumsum([lenses.size, 6 * (len(mounting) - 1), 6 * len(poses)])
    lens, mount, pose, height = np.split(step, cuts)
    mounting = np.concatenate([mounting[:1], move_pose(mounting[1:], mount.reshape(-1, 6))])
    return (
        lenses + lens.reshape(-1, 9),
        mounting,
        move_pose(poses, pose.reshape(-1, 6)),
        relief + height,
    )


def adjust_robust(pixels, points, models, poses, mounting=None, **options):
    """As :func:`adjust`, without corners far off the rest (glare, a shadow): NaN in `residuals`.

    Every corner is judged again in every round, so that one that its neighbour pulled out comes
    back.
    """
    result = adjust(pixels, points, models, poses, mounting, **options)
    used = np.isfinite(result.residuals)
    for _ in range(ROBUST_ROUNDS):
        raised = points + result.relief[:, None] * UP
        views = zip(pixels, result.models, result.mounting, strict=True)
        seen = [
            p - project(apply_pose(pose_array(mount * result.poses), raised), m)
            for p, m, mount in views
        ]
        distance = np.linalg.norm(seen, axis=-1)
        # the median of a Rayleigh variable is 1.1774 sigma
        near = distance <= OUTLIER_SIGMAS * max(np.nanmedian(distance) / 1.1774, SIGMA_FLOOR_PX)
        used, before = np.broadcast_to(near[..., None], pixels.shape), used
        if np.array_equal(used, before):
            break
        taken = np.where(used, pixels, np.nan)
        result = adjust(taken, points, result.models, result.poses, result.mounting, **options)
    return result


def better(result, pixels, points, **options):
    """The same corners adjusted otherwise, where the Bayesian information criterion prefers
    that.
    """
    same = np.where(np.isfinite(result.residuals), pixels, np.nan)
    other = adjust(same, points, result.models, result.poses, **options)
    return other if other.bic < result.bic else result


def estimate_intrinsics(pixels, pattern, size, *, relief=False):
    """Intrinsics of a camera from views of a chessboard: an Adjustment whose first model they are.

    `pixels` are the corners of every view (k, 2) in the order of ``pattern.points()``, `size` is
    the image's width and height. With `relief` the waves of the sheet are estimated along: paper on
    cardboard is never flat, and 1 mm of waves costs more than the corner detector does, and biases
    the intrinsics. The third radial term k5 is kept only where it lowers the Bayesian information
    criterion. ValueError with fewer than three views, or views that all lie in parallel planes (the
    focal length stays unobservable).
    """
    if len(pixels) < 3:
        raise ValueError(f"intrinsics need at least three views of the pattern, got {len(pixels)}")
    pixels = np.asarray(pixels, float)[None]
    points = pattern.points()
    board = [points.astype(np.float32)] * pixels.shape[1]
    views = list(pixels[0].astype(np.float32))
    try:
        out = cv2.calibrateCamera(board, views, size, None, None, flags=cv2.CALIB_FIX_K3)
    except cv2.error as error:
        why = (
            f"{len(views)} views of the pattern do not determine the intrinsics (OpenCV: "
            f"{error.err})"
        )
        raise ValueError(why) from error
    matrix, lens, turns, shifts = out[1:5]
    model = CameraModel(
        *size, *map(float, (matrix[0, 0], matrix[1, 1], *matrix[:2, 2])), lens.ravel()[:5]
    )
    turns = Rotation.from_rotvec(np.reshape(turns, (-1, 3)))
    normals = turns.as_matrix()[:, :, 2]
    spread = np.arccos(np.clip(normals @ normals.T, -1, 1)).max()
    if spread < LEAST_TILT:
        raise ValueError(
            f"the board is parallel to itself within {np.rad2deg(spread):.2f} deg in all "
            f"{len(views)} views: the focal "
            "length cannot be observed; tilt the board by 20 deg or more between views"
        )
    poses = RigidTransform.from_components(np.reshape(shifts, (-1, 3)), turns)
    best = adjust_robust(pixels, points, [model], poses, fixed=(8,))
    if relief:
        wavy = adjust_robust(
            pixels, points, best.models, best.poses, basis=waves(points), fixed=(8,)
        )
        best = better(wavy, pixels, points, fixed=(8,))
    return better(best, pixels, points, basis=waves(points) if np.any(best.relief) else None)


def estimate_relief(pixels, pattern, model):
    """Shape of a wavy sheet with known intrinsics: an Adjustment, without relief where the BIC
    prefers none.
    """
    poses = RigidTransform.concatenate([board_pose(p, pattern, model)[0] for p in pixels])
    pixels = np.asarray(pixels, float)[None]
    points = pattern.points()
    wavy = adjust_robust(pixels, points, [model], poses, basis=waves(points), intrinsics=False)
    return better(wavy, pixels, points, intrinsics=False)


def first_pose(points, pixels, model):
    """Pose by OpenCV's solver, good enough to start from.

    ValueError when there is none in front of the camera.
    """
    good = np.isfinite(pixels).all(axis=1)
    board = points[good].astype(float)
    image = np.ascontiguousarray(pixels[good], float)
    why = f"{good.sum()} corners do not determine a pose in front of the camera"
    how = cv2.SOLVEPNP_SQPNP
    try:
        found, rotvec, translation = cv2.solvePnP(
            board, image, model.matrix, model.distortion, flags=how
        )
    except cv2.error as error:
        raise ValueError(f"{why} (OpenCV: {error.err})") from error
    if not found or not np.isfinite(translation).all() or translation[2, 0] <= 0:
        raise ValueError(why)
    return RigidTransform.from_components(translation.ravel(), Rotation.from_rotvec(rotvec.ravel()))


def board_pose(pixels, pattern, model, relief=None, start=None):
    """Pose of a chessboard in one image: ``T_camera_board``, its covariance (6, 6) of ``[w, v]``,
    corners used (k,).

    `pixels` (k, 2) are in the order of ``pattern.points()``, NaN where a corner is not to be used;
    glaring ones are left out. The covariance is for the given intrinsics. The noise is taken from
    the residuals, and widened where neighbouring residuals agree (a wavy sheet), because such
    errors do not average out. `start` replaces OpenCV's start pose. Where squares are small a share
    of the distance is added, see :func:`scale_covariance`. ValueError with fewer than four corners,
    or when they do not determine a pose.
    """
    pixels = np.asarray(pixels, float)
    points = raised_points(pattern, relief)
    if pixels.shape != (len(points), 2) or np.isfinite(pixels).all(axis=1).sum() < 4:
        raise ValueError(
            f"a pose needs four or more of the pattern's {len(points)} corners, got shape "
            f"{pixels.shape}"
        )
    start = first_pose(points, pixels, model) if start is None else start
    start = RigidTransform.concatenate([start])
    result = adjust_robust(pixels[None, None], points, [model], start, intrinsics=False)
    residuals = result.residuals[0, 0]
    factor = max(1.0, SIGMA_FLOOR_PX / result.sigma_px) ** 2
    # a smooth fit is worse by this factor because neighbouring residuals agree, AR(1) in x and y
    grid = residuals.reshape(pattern.rows, pattern.columns, 2)
    for axis in (0, 1):
        a, b = (np.delete(grid, where, axis=axis) for where in (-1, 0))
        rho = np.clip(np.nansum(a * b) / max(np.nansum((a**2 + b**2) / 2), 1e-300), 0.0, 0.8)
        factor *= (1 + rho) / (1 - rho)
    used = np.isfinite(residuals).all(axis=1)
    covariance = result.pose_covariance[0] * factor
    return result.poses[0], covariance + scale_covariance(result.poses[0], pixels, pattern), used


def scale_covariance(pose, pixels, pattern):
    """Covariance (6, 6) of ``[w, v]`` of a pose for a scale of all corners that small squares bias.

    Corners farther apart by a share bring the board nearer by it, along the way to its middle. The
    bias is much the same in images that are alike, and does not average out as these covariances
    do. It is left at that: the median over rendered views is below 0.01 % from 6 px a square on
    where the image is blurred by 0.7 px, 0.3 mm at 3 m; a wider blur below 9 px is said in words.
    """
    side = square_px(pixels, (pattern.columns, pattern.rows))
    away = np.zeros(6)
    away[3:] = scale_error(side) * pose.apply(pattern.points().mean(axis=0))
    return np.outer(away, away)


def raised_points(pattern, relief=None):
    """Corners of a pattern on a wavy sheet, board frame, metres; shape (k, 3)."""
    return pattern.points() + (0.0 if relief is None else np.asarray(relief, float)[:, None] * UP)
