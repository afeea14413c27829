"""From corners of a chessboard: the intrinsics of a camera, poses, the waves of the sheet."""

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.covariance import dyads
from lrfcal_lib.model.board import Chessboard
from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.preprocess.bundle import (
    SIGMA_FLOOR_PX,
    UP,
    Adjustment,
    adjust_robust,
    better,
)
from lrfcal_lib.preprocess.pattern_in_image import scale_error, square_px

FEWEST_VIEWS = 3  # of the pattern, for intrinsics
FEWEST_CORNERS = 4  # for a pose
LEAST_TILT = np.radians(3.0)  # between views, to observe the focal length
K5 = 8  # place of the third radial term, the last one, in the intrinsics
MOST_ALIKE = 0.8  # correlation of neighbouring residuals


def estimate_intrinsics(
    pixels, pattern: Chessboard, size: tuple[int, int], *, relief: bool = False
) -> Adjustment:
    """Intrinsics of a camera from views of a chessboard.

    The third radial term k5 is kept only where it lowers the Bayesian information criterion.

    Parameters
    ----------
    pixels : sequence of ndarray, shape (k, 2)
        Corners of every view, in the order of ``pattern.points()``.
    pattern : Chessboard
    size : (int, int)
        Width and height of the images.
    relief : bool
        Estimate the waves of the sheet along: paper on cardboard is never flat, and 1 mm of waves
        costs more than the corner detector does, and biases the intrinsics.

    Returns
    -------
    Adjustment
        Its first model has the intrinsics.

    Raises
    ------
    ValueError
        With fewer than three views, or views that all lie in parallel planes (the focal length
        stays unobservable).
    """
    if len(pixels) < FEWEST_VIEWS:
        raise ValueError(
            f"intrinsics need at least three views of the pattern, got {len(pixels)}"
        )
    points = pattern.points()
    views = np.asarray(pixels, float)
    model, poses = _rough(views, points, size)
    normals = poses.rotation.as_matrix()[:, :, 2]
    spread = np.arccos(np.clip(normals @ normals.T, -1, 1)).max()
    if spread < LEAST_TILT:
        raise ValueError(
            f"the board is parallel to itself within {np.rad2deg(spread):.2f} deg in all "
            f"{len(views)} views: the focal length cannot be observed; tilt the board by 20 deg or "
            "more between views"
        )
    corners = views[None]
    best = adjust_robust(corners, points, [model], poses, lens=K5)
    if relief:
        start = best.models, best.poses
        best = adjust_robust(corners, points, *start, lens=K5, wavy=True)
        best = better(best, points, lens=K5)
    return better(best, points, wavy=np.any(best.relief))


def estimate_relief(pixels, pattern: Chessboard, model: CameraModel) -> Adjustment:
    """Shape of a wavy sheet with known intrinsics; flat where the BIC prefers that.

    Parameters
    ----------
    pixels : sequence of ndarray, shape (k, 2)
        Corners of every view, in the order of ``pattern.points()``.
    pattern : Chessboard
    model : CameraModel

    Returns
    -------
    Adjustment
    """
    poses = RigidTransform.concatenate(
        [board_pose(view, pattern, model)[0] for view in pixels]
    )
    corners = np.asarray(pixels, float)[None]
    points = pattern.points()
    best = adjust_robust(corners, points, [model], poses, lens=0, wavy=True)
    return better(best, points, lens=0)


def first_pose(
    points: np.ndarray, pixels: np.ndarray, model: CameraModel
) -> RigidTransform:
    """Pose by OpenCV's solver, good enough to start from.

    Parameters
    ----------
    points : ndarray, shape (k, 3)
        Board frame, metres.
    pixels : ndarray, shape (k, 2)
        NaN where a corner is not to be used.
    model : CameraModel

    Returns
    -------
    RigidTransform
        A stack of one ``T_camera_board``.

    Raises
    ------
    ValueError
        When there is none in front of the camera.
    """
    good = np.isfinite(pixels).all(axis=1)
    why = f"{good.sum()} corners do not determine a pose in front of the camera"
    try:
        solved, turn, shift = cv2.solvePnP(
            points[good],
            pixels[good],
            model.matrix,
            model.distortion,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error as error:
        raise ValueError(f"{why} (OpenCV: {error.err})") from error
    if not solved or not np.isfinite(shift).all() or shift[2, 0] <= 0:
        raise ValueError(why)
    return opencv_poses(turn, shift)


def opencv_poses(turns, shifts) -> RigidTransform:
    """A stack of transforms from rotation vectors and translations as OpenCV gives them.

    Parameters
    ----------
    turns, shifts : array_like, shape (n, 3, 1) or (3, 1)
        Radians and metres.
    """
    rotation = Rotation.from_rotvec(np.reshape(turns, (-1, 3)))
    return RigidTransform.from_components(np.reshape(shifts, (-1, 3)), rotation)


def board_pose(
    pixels,
    pattern: Chessboard,
    model: CameraModel,
    relief: np.ndarray | float = 0.0,
) -> tuple[RigidTransform, np.ndarray, np.ndarray]:
    """Pose of a chessboard in one image.

    The covariance is for the given intrinsics. The noise is taken from the residuals, and widened
    where neighbouring residuals agree (a wavy sheet), because such errors do not average out. Where
    squares are small a share of the distance is added, see :func:`scale_covariance`.

    Parameters
    ----------
    pixels : ndarray, shape (k, 2)
        In the order of ``pattern.points()``, NaN where a corner is not to be used; glaring ones are
        left out.
    pattern : Chessboard
    model : CameraModel
    relief : ndarray, shape (k,), optional
        Heights of the corners, metres.

    Returns
    -------
    pose : RigidTransform
        ``T_camera_board``.
    covariance : ndarray, shape (6, 6)
        Of ``[w, v]``.
    used : ndarray of bool, shape (k,)
        Corners.

    Raises
    ------
    ValueError
        With fewer than four corners, or when they do not determine a pose.
    """
    points = raised_points(pattern, relief)
    count = np.isfinite(pixels).all(axis=1).sum()
    if count < FEWEST_CORNERS:
        raise ValueError(f"a pose needs four corners of the pattern or more, got {count}")

    def settled(used):
        poses = first_pose(points, np.where(used, pixels, np.nan), model)
        return adjust_robust(pixels[None, None], points, [model], poses, lens=0)

    result = settled(True)
    used = np.isfinite(result.residuals[0, 0])
    if used.sum() < np.isfinite(pixels).sum():
        # a corner far off may have led to the mirrored lean of a small board
        result = min(result, settled(used), key=lambda each: each.sigma_px)
    residuals = result.residuals[0, 0]
    pose = result.poses[0]
    factor = max(1.0, SIGMA_FLOOR_PX / result.sigma_px) ** 2
    factor *= _alike_factor(pattern.grid(residuals))
    covariance = result.pose_covariance[0] * factor + scale_covariance(
        pose, pixels, pattern
    )
    return pose, covariance, np.isfinite(residuals).all(axis=1)


def scale_covariance(pose: RigidTransform, pixels, pattern: Chessboard) -> np.ndarray:
    """Covariance of a pose for a scale of all corners that small squares bias.

    Corners farther apart by a share bring the board nearer by it, along the way to its middle. The
    bias is much the same in images that are alike, and does not average out as these covariances
    do. It is left at that: the median over rendered views is below 0.01 % from 6 px a square on
    where the image is blurred by 0.7 px, 0.3 mm at 3 m; a wider blur below 9 px is said in words.

    Parameters
    ----------
    pose : RigidTransform
        ``T_camera_board``.
    pixels : ndarray, shape (k, 2)
    pattern : Chessboard

    Returns
    -------
    ndarray, shape (6, 6)
        Of ``[w, v]``.
    """
    side = square_px(pattern.grid(pixels))
    away = scale_error(side) * pose.apply(pattern.points().mean(axis=0))
    return dyads(np.append(np.zeros(3), away))


def raised_points(pattern: Chessboard, relief: np.ndarray | float) -> np.ndarray:
    """Corners of a pattern on a wavy sheet.

    Parameters
    ----------
    pattern : Chessboard
    relief : ndarray, shape (k,), or float
        Heights, metres.

    Returns
    -------
    ndarray, shape (k, 3)
        Board frame, metres.
    """
    return pattern.points() + np.multiply.outer(relief, UP)


def _rough(views, points, size):
    """Model and poses by OpenCV, from corners (v, k, 2) of a flat sheet."""
    board = [points.astype(np.float32)] * len(views)
    corners = list(views.astype(np.float32))
    try:
        _, matrix, lens, turns, shifts = cv2.calibrateCamera(
            board, corners, size, None, None, flags=cv2.CALIB_FIX_K3
        )
    except cv2.error as error:
        raise ValueError(
            f"{len(views)} views of the pattern do not determine the intrinsics (OpenCV: "
            f"{error.err})"
        ) from error
    of_pinhole = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]  # fx, fy, cx, cy
    model = CameraModel(*size, *of_pinhole.tolist(), lens.ravel())
    return model, opencv_poses(turns, shifts)


def _alike_factor(grid):
    """How much worse a smooth fit is because neighbouring residuals agree, AR(1) in x and y.

    `grid` (rows, columns, 2) holds NaN where a corner was not used.
    """
    factor = 1.0
    for axis in (0, 1):
        a = np.delete(grid, -1, axis=axis)
        b = np.delete(grid, 0, axis=axis)
        power = np.nansum((a**2 + b**2) / 2)
        rho = np.clip(np.nansum(a * b) / max(power, 1e-300), 0.0, MOST_ALIKE)
        factor *= (1 + rho) / (1 - rho)
    return factor
