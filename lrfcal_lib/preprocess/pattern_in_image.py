"""The printed chessboard in images: its corners, a camera's intrinsics, the board's pose, two cameras together."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.preprocess.intrinsics import SIGMA_FLOOR_PX, adjust_robust, better

WINDOW_SHARE, WIDEST_WINDOW = 0.4, 15  # half window around a corner: of the shortest side of a square; pixels
SMOOTH_ENOUGH_PX = 0.07  # corners that fit a smooth grid this well need no second detector
BEYOND, LEAST_BEYOND = 0.3, 0.25  # where to look outside the outermost corners, squares; contrast there, of that inside


class PatternNotFound(ValueError):
    """The image does not show the whole printed pattern."""


def grey(image):
    """8-bit grey image of a grey or BGR image; ValueError for anything else."""
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.size == 0:
        raise ValueError(f"an image must be uint8 of shape (h, w) or (h, w, 3), got {image.dtype} {image.shape}")
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def find_pattern(image, pattern):
    """Inner corners of a chessboard at sub-pixel level.

    Parameters
    ----------
    image : ndarray of uint8, shape (h, w) or (h, w, 3)
    pattern : Chessboard

    Returns
    -------
    ndarray, shape (columns * rows, 2)
        Recorded pixels in the order of ``pattern.points()``, x right and y down as seen from the printed side. A
        chessboard looks the same when it is turned by 180 deg: :mod:`lrfcal_lib.preprocess.survey` resolves that.

    Raises
    ------
    PatternNotFound
        If none of OpenCV's detectors finds all corners.
    ValueError
        If the image is not an 8-bit image.

    Notes
    -----
    The classic detector tells where to look (it wants dark squares on a light ground: boards with white squares on a
    dark ground are looked for in the negative). Two detectors then compete on that part of the image: the sector-based
    one (Duda and Frese 2018; 0.14 px on real prints where `cornerSubPix` has 0.18 px, but 0.1 to 0.6 px on simulated
    images where the other has 0.05 px) and `cornerSubPix` with a wide window. The smoother grid is taken; the
    sector-based detector, which is slow, is not asked where the other's grid is as smooth as a print can be.
    """
    return PatternFinder(pattern)(image)


class PatternFinder:
    """:func:`find_pattern` for many images of one board: remembers whether its squares are dark on light.

    Parameters
    ----------
    pattern : Chessboard
    """

    def __init__(self, pattern):
        self.pattern = pattern
        self._negatives = (False, True)

    def __call__(self, image):
        """Corners in one image, see :func:`find_pattern`."""
        picture = grey(image)
        size = (self.pattern.columns, self.pattern.rows)
        rough = self._rough(picture, size)
        corners = _sectors(picture, size) if rough is None else _smoothest(picture, size, rough)
        if corners is None or not _ends_in_squares(picture, corners, size):
            raise PatternNotFound(
                f"no chessboard with {size[0]} x {size[1]} inner corners in the image: it must be whole, and not glare"
            )
        return _clockwise(corners, size)

    def _rough(self, picture, size):
        for negative in self._negatives:
            corners = _classic(picture, size, negative)
            if corners is not None:
                self._negatives = (negative, not negative)
                return corners
        return None


def _classic(picture, size, negative=False):
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    # the quick check for a chessboard overlooks white squares on a dark board, and saves little time there
    picture, flags = (255 - picture, flags) if negative else (picture, flags | cv2.CALIB_CB_FAST_CHECK)
    try:
        found, corners = cv2.findChessboardCorners(picture, size, flags=flags)
    except cv2.error:  # some images a few pixels wide are too narrow for its thresholds
        return None
    return corners.reshape(-1, 2) if found else None


def _smoothest(picture, size, rough):
    """Of the corners of several sub-pixel detectors those whose grid has the least noise."""
    refined = _refined(picture, rough, size)
    noise = grid_noise(refined, size)
    if noise < SMOOTH_ENOUGH_PX:
        return refined
    sectors = _sectors_near(picture, size, rough)
    sectors = _sectors(picture, size) if sectors is None else sectors
    if sectors is None:
        return refined
    found = [refined, sectors]
    if noise > 2 * grid_noise(sectors, size):
        # a rough corner was too far off for its window: the sectors are the better start
        found.append(_refined(picture, sectors, size))
    return min(found, key=lambda corners: grid_noise(corners, size))


def grid_noise(corners, size):
    """Root mean square distance of a chessboard's corners from a smooth grid, pixels.

    Parameters
    ----------
    corners : ndarray, shape (columns * rows, 2)
        Row by row.
    size : tuple of int
        Inner corners in a row, and in a column.

    Returns
    -------
    float

    Notes
    -----
    A homography (perspective) and polynomials of third order of what it leaves (lens distortion, a bent sheet) are
    taken out; of second order where there are less than 16 corners.
    """
    y, x = (np.mgrid[: size[1], : size[0]] / (max(size) - 1) * 2 - 1).reshape(2, -1)
    order = 3 if len(x) >= 16 else 2
    homography = cv2.findHomography(np.column_stack([x, y]), np.asarray(corners, float))[0]
    left = corners - cv2.perspectiveTransform(np.column_stack([x, y])[None], homography)[0]
    design = np.stack([x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)
    noise = left - design @ np.linalg.lstsq(design, left, rcond=None)[0]
    return float(np.sqrt(np.mean(np.sum(noise**2, axis=1))))


def _sectors(picture, size, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE):
    found, corners = cv2.findChessboardCornersSB(picture, size, flags=flags)
    return corners.reshape(-1, 2).astype(float) if found else None


def _sectors_near(picture, size, rough):
    """The sector-based detector on the part of the image around corners that are roughly known."""
    low, high = rough.min(axis=0), rough.max(axis=0)
    margin = 0.22 * (high - low) + 4
    low = np.maximum(low - margin, 0).astype(int)
    high = np.minimum(high + margin, picture.shape[::-1]).astype(int)
    part = np.ascontiguousarray(picture[low[1] : high[1], low[0] : high[0]])
    corners = _sectors(part, size, cv2.CALIB_CB_ACCURACY)
    return None if corners is None else corners + low


def _refined(picture, rough, size):
    grid = rough.reshape(size[1], size[0], 2)
    step = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
    window = int(np.clip(WINDOW_SHARE * step, 2, WIDEST_WINDOW))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    return cv2.cornerSubPix(picture, rough.astype(np.float32).copy(), (window, window), (-1, -1), stop).astype(float)


def _ends_in_squares(picture, corners, size):
    """Whether squares alternate outside the outermost corners: not where a pattern that is cut is taken a row off."""
    grid = corners.reshape(size[1], size[0], 2)
    for side in (np.rot90(grid, k) for k in range(4)):
        edge, inner = (side[:2, 1:] + side[:2, :-1]) / 2
        both = np.array([edge - BEYOND * (inner - edge), edge + BEYOND * (inner - edge)])
        seen = np.all((both >= 0) & (both <= np.array(picture.shape[::-1]) - 1), axis=(0, 2))
        outside, inside = cv2.remap(picture, both.astype(np.float32), None, cv2.INTER_LINEAR)[:, seen].astype(float)
        sign = np.resize([1.0, -1.0], len(seen))[seen]
        sign -= sign.mean() if len(sign) else 0.0
        if (sign @ outside) * (sign @ inside) > -LEAST_BEYOND * (sign @ inside) ** 2:
            return False
    return True


def _clockwise(corners, size):
    """Corners ordered so that x to y turns clockwise in the image, as seen from the printed side."""
    grid = corners.reshape(size[1], size[0], 2)
    x, y = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    return (grid if x[0] * y[1] - x[1] * y[0] > 0 else grid[::-1]).reshape(-1, 2)


def turn_pattern(pixels):
    """The same corners with the pattern turned by 180 deg."""
    return pixels[::-1]


def mirror_pattern(pixels, pattern):
    """The same corners counted from the last row: x to y turns the other way (board frames whose z points out)."""
    return pixels.reshape(pattern.rows, pattern.columns, 2)[::-1].reshape(-1, 2)


def estimate_intrinsics(pixels, pattern, size, *, relief=False):
    """Intrinsics of a camera from views of a chessboard.

    Parameters
    ----------
    pixels : sequence of ndarray, shape (k, 2)
        Corners of every view in the order of ``pattern.points()``, recorded pixels.
    pattern : Chessboard
    size : tuple of int
        Image width and height, pixels.
    relief : bool
        Also estimate how wavy the sheet is (one height a corner, common to all views). Paper on cardboard is never
        flat: 1 mm of waves costs more than the corner detector does, and biases the intrinsics.

    Returns
    -------
    Adjustment
        ``.model`` is the camera with its covariance and rms. Corners that glare are left out (NaN in `residuals`).
        The third radial term k5 is kept only when it lowers the Bayesian information criterion.

    Raises
    ------
    ValueError
        With fewer than three views, or views that all lie in parallel planes (the focal length stays unobservable).
    """
    if len(pixels) < 3:
        raise ValueError(f"intrinsics need at least three views of the pattern, got {len(pixels)}")
    pixels = np.asarray(pixels, float)[None]
    model, poses = _first_intrinsics(pixels[0], pattern, size)
    _check_tilts(poses)
    best = adjust_robust(pixels, pattern, [model], poses, fixed=(8,))
    if relief:
        wavy = adjust_robust(pixels, pattern, best.models, best.poses, relief=True, fixed=(8,))
        best = better(wavy, pixels, pattern, relief=False, fixed=(8,))
    return better(best, pixels, pattern, relief=bool(np.any(best.relief)))


def spread_views(pixels, count):
    """Which views of a pattern differ most: by place, size and tilt in the image.

    Parameters
    ----------
    pixels : sequence of ndarray, shape (k, 2)
        Corners of every view.
    count : int

    Returns
    -------
    list of int
        At most `count` places in `pixels`, the largest view first. Each of the others is the one whose corners lie
        farthest from those of all views before it.
    """
    if not len(pixels):
        return []
    pixels = np.asarray(pixels, float)
    flat, size = pixels.reshape(len(pixels), -1), np.ptp(pixels, axis=1).prod(axis=1)
    chosen, nearest = [], np.full(len(flat), np.inf)
    while len(chosen) < min(count, len(flat)):
        chosen.append(int(np.argmax(nearest if chosen else size)))
        nearest = np.minimum(nearest, np.linalg.norm(flat - flat[chosen[-1]], axis=1))
        nearest[chosen[-1]] = -1.0
    return chosen


def estimate_relief(pixels, pattern, model):
    """Shape of a wavy sheet from views by a camera with known intrinsics.

    Parameters
    ----------
    pixels : sequence of ndarray, shape (k, 2)
    pattern : Chessboard
    model : CameraModel

    Returns
    -------
    Adjustment
        With `relief` zero where the Bayesian information criterion prefers a flat sheet.
    """
    pixels = np.asarray(pixels, float)[None]
    poses = [board_pose(p, pattern, model)[0] for p in pixels[0]]
    wavy = adjust_robust(pixels, pattern, [model], poses, relief=True, intrinsics=False)
    return better(wavy, pixels, pattern, relief=False, intrinsics=False)


@contextmanager
def _opencv(what):
    """OpenCV's refusal of what it was given is one of the values."""
    try:
        yield
    except cv2.error as error:
        raise ValueError(f"{what} (OpenCV: {error.err})") from error


def _first_intrinsics(pixels, pattern, size):
    board = [pattern.points().astype(np.float32)] * len(pixels)
    views = [np.ascontiguousarray(p, np.float32) for p in pixels]
    with _opencv(f"{len(pixels)} views of the pattern do not determine the intrinsics"):
        out = cv2.calibrateCamera(board, views, tuple(int(s) for s in size), None, None, flags=cv2.CALIB_FIX_K3)
    matrix, lens, turns, shifts = out[1:5]
    focal = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    model = CameraModel(int(size[0]), int(size[1]), *map(float, focal), lens.ravel()[:5])
    return model, [_transform(w, t) for w, t in zip(turns, shifts, strict=True)]


def _transform(rotvec, translation):
    return RigidTransform.from_components(np.ravel(translation), Rotation.from_rotvec(np.ravel(rotvec)))


def _check_tilts(poses, least_deg=3.0):
    normals = np.stack([p.rotation.as_matrix()[:, 2] for p in poses])
    spread = np.rad2deg(np.arccos(np.clip(normals @ normals.T, -1, 1)).max())
    if spread < least_deg:
        raise ValueError(
            f"the board is parallel to itself within {spread:.2f} deg in all {len(poses)} views: the focal length "
            "cannot be observed; tilt the board by 20 deg or more between views"
        )


def board_pose(pixels, pattern, model, *, relief=None):
    """Pose of a chessboard in one image.

    Parameters
    ----------
    pixels : array_like, shape (k, 2)
        Recorded pixels in the order of ``pattern.points()``; NaN where a corner is not to be used.
    pattern : Chessboard
    model : CameraModel
    relief : array_like, shape (k,), optional
        Heights of the corners along z of the board, metres.

    Returns
    -------
    T_camera_board : RigidTransform
    covariance : ndarray, shape (6, 6)
        Of ``[w, v]`` (see :mod:`lrfcal_lib`), for the given intrinsics. The noise is taken from the residuals, and
        widened where neighbouring residuals agree (a wavy sheet), because such errors do not average out.

    Raises
    ------
    ValueError
        With fewer than four corners, or when they do not determine a pose.
    """
    return pose_adjustment(pixels, pattern, model, relief)[:2]


def raised_points(pattern, relief=None):
    """Corners of a pattern on a wavy sheet, board frame, metres; shape (k, 3)."""
    height = 0.0 if relief is None else np.asarray(relief, float)[:, None]
    return pattern.points() + height * np.array([0.0, 0.0, 1.0])


def pose_adjustment(pixels, pattern, model, relief=None, start=None):
    """As :func:`board_pose`, and which corners were used (glaring ones are left out), shape (k,) bool.

    `start` replaces the start pose of OpenCV's solver.
    """
    pixels = np.asarray(pixels, float)
    points = raised_points(pattern, relief)
    if pixels.shape != (len(points), 2) or np.isfinite(pixels).all(axis=1).sum() < 4:
        raise ValueError(f"a pose needs four or more of the pattern's {len(points)} corners, got shape {pixels.shape}")
    raised = _Raised(points)
    start = first_pose(points, pixels, model) if start is None else start
    result = adjust_robust(pixels[None, None], raised, [model], [start], intrinsics=False)
    residuals = result.residuals[0, 0]
    inflation = _correlation(residuals, pattern) * max(1.0, SIGMA_FLOOR_PX / result.sigma_px) ** 2
    return result.poses[0], result.pose_covariance[0] * inflation, np.isfinite(residuals).all(axis=1)


@dataclass(frozen=True)
class _Raised:
    """Points that stand in for a flat pattern."""

    xyz: np.ndarray

    def points(self):
        return self.xyz


def first_pose(points, pixels, model):
    """Pose by OpenCV's solver, good enough to start from; ValueError when there is none in front of the camera."""
    good = np.isfinite(pixels).all(axis=1)
    board, image = points[good].astype(float), np.ascontiguousarray(pixels[good], float)
    why, how = f"{good.sum()} corners do not determine a pose in front of the camera", cv2.SOLVEPNP_SQPNP
    with _opencv(why):
        found, rotvec, translation = cv2.solvePnP(board, image, model.matrix, model.distortion, flags=how)
    if not found or not np.isfinite(translation).all() or translation[2, 0] <= 0:
        raise ValueError(why)
    return _transform(rotvec, translation)


def _correlation(residuals, pattern):
    """Factor by which the variance of a smooth fit grows because neighbouring residuals agree (AR(1) in x and y)."""
    grid = residuals.reshape(pattern.rows, pattern.columns, 2)
    factor = 1.0
    for axis in (0, 1):
        a, b = (np.delete(grid, where, axis=axis) for where in (-1, 0))
        rho = np.nansum(a * b) / max(np.nansum((a**2 + b**2) / 2), 1e-300)
        rho = np.clip(rho, 0.0, 0.8)
        factor *= (1 + rho) / (1 - rho)
    return factor


def stereo_transform(first, second, pattern, models, *, intrinsics=False, relief=False):
    """Relative pose of two cameras from chessboard views, and how well it is known.

    Parameters
    ----------
    first, second : dict of int to ndarray, shape (k, 2)
        Corners by placement, recorded pixels, in the same order in both cameras.
    pattern : Chessboard
    models : pair of CameraModel
    intrinsics : bool
        Refine the intrinsics of both cameras in the same estimate.
    relief : bool
        Let the sheet be wavy.

    Returns
    -------
    Adjustment
        ``.mounting[1]`` is ``T_second_first``, ``.mounting_covariance[0]`` its covariance.

    Raises
    ------
    ValueError
        If no placement is seen by both cameras.
    """
    common = sorted(set(first) & set(second))
    if not common:
        raise ValueError("no placement shows the pattern to both cameras: the stereo check needs at least one")
    pixels = np.stack([[first[p] for p in common], [second[p] for p in common]])
    poses = [[board_pose(p, pattern, m)[0] for p in views] for views, m in zip(pixels, models, strict=True)]
    between = [b * a.inv() for a, b in zip(*poses, strict=True)]
    turn = Rotation.concatenate([t.rotation for t in between]).mean()
    shift = np.median([t.translation for t in between], axis=0)
    mounting = (RigidTransform.identity(), RigidTransform.from_components(shift, turn))
    fixed = (8,) if all(m.distortion[4] == 0 for m in models) else ()
    return adjust_robust(pixels, pattern, models, poses[0], mounting, intrinsics=intrinsics, relief=relief, fixed=fixed)


def sigma_of(adjustment):
    """Standard deviations of a stereo transform as (rotation vector in radians, translation in metres)."""
    sigma = np.sqrt(np.diag(adjustment.mounting_covariance[0]))
    return sigma[:3], sigma[3:]
