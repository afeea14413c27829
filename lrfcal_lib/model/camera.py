"""Pinhole camera with lens distortion: projection, undistortion, straight lines in pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike

# in the order of CameraModel.parameters
INTRINSIC_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "k5")
LENS = len(INTRINSIC_NAMES)


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics of one camera.

    Attributes
    ----------
    width, height : int
        Image size, pixels.
    fx, fy, cx, cy : float
        Focal lengths and principal point, pixels; (0, 0) is the centre of the top-left pixel.
    distortion : ndarray, shape (5,)
        The paper's (k1, k2, k3, k4, k5), which is OpenCV's (k1, k2, p1, p2, k3): k1, k2, k5 radial,
        k3, k4 tangential.
    covariance : ndarray, shape (9, 9), or None
        Of (fx, fy, cx, cy, k1..k5), where it is known.
    rms_px : float or None
        Reprojection error of the calibration the intrinsics come from.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(5))
    covariance: np.ndarray | None = None
    rms_px: float | None = None

    @property
    def size(self):
        """(width, height), pixels."""
        return np.array([self.width, self.height])

    def shows(self, pixels: np.ndarray, margin: float = -0.5) -> np.ndarray:
        """Whether pixels (..., 2) are inside the image by more than a margin, (...)."""
        return np.all((pixels > margin) & (pixels < self.size - 1 - margin), axis=-1)

    def sights(self, pixels: ArrayLike) -> np.ndarray:
        """Points at depth 1 that undistorted pixels (..., 2) show, camera frame, (..., 3)."""
        normalized = (pixels - np.array([self.cx, self.cy])) / [self.fx, self.fy]
        return np.insert(normalized, 2, 1.0, axis=-1)

    @property
    def matrix(self):
        """The 3 x 3 matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def parameters(self):
        """(fx, fy, cx, cy, k1..k5), shape (9,)."""
        return np.r_[self.fx, self.fy, self.cx, self.cy, self.distortion]

    def with_parameters(
        self,
        values: Sequence[float] | np.ndarray,
        covariance: np.ndarray | None = None,
        rms_px: float | None = None,
    ) -> "CameraModel":
        """The same image size with other intrinsics.

        Parameters
        ----------
        values : array_like, shape (9,)
            In the order of `parameters`.
        covariance : ndarray, shape (9, 9), optional
        rms_px : float, optional
        """
        fx, fy, cx, cy = map(float, values[:4])
        lens = np.array(values[4:])
        return CameraModel(
            self.width, self.height, fx, fy, cx, cy, lens, covariance, rms_px
        )


def pinhole(p_camera: ArrayLike, model: CameraModel) -> np.ndarray:
    """Project points to undistorted pixels, equation (19): K without a lens.

    Parameters
    ----------
    p_camera : array_like, shape (..., 3)
        Metres.
    model : CameraModel

    Returns
    -------
    ndarray, shape (..., 2)
        NaN where z <= 0.
    """
    return _pixels(_before(p_camera), model)


def mirrored(p_camera: np.ndarray, model: CameraModel) -> np.ndarray:
    """As :func:`pinhole`, but behind the camera the formula goes on (mirrored), so that a poor
    start value can still find its way.

    Parameters
    ----------
    p_camera : ndarray, shape (..., 3)
        Metres.
    model : CameraModel

    Returns
    -------
    ndarray, shape (..., 2)
    """
    return _pixels(p_camera[..., :2] / p_camera[..., 2:], model)


def _before(p_camera):
    """Normalised coordinates ``(x / z, y / z)`` of points, NaN where z <= 0."""
    p_camera = np.asarray(p_camera, float)
    z = p_camera[..., 2:]
    return p_camera[..., :2] / np.where(z > 0, z, np.nan)


def _pixels(normalized, model):
    """Equation (19): pixels of normalised coordinates."""
    return normalized * [model.fx, model.fy] + [model.cx, model.cy]


def pinhole_jacobian(p_camera: np.ndarray, model: CameraModel) -> np.ndarray:
    """Derivative of :func:`pinhole` by the point.

    Parameters
    ----------
    p_camera : ndarray, shape (..., 3)
        Metres.
    model : CameraModel

    Returns
    -------
    ndarray, shape (..., 2, 3)
        Pixels per metre.
    """
    z = p_camera[..., 2:]
    J = model.matrix[:2] / z[..., None]  # of which pixels are J @ p_camera
    J[..., 2] -= np.matvec(J, p_camera) / z
    return J


def lens_terms(x, y, k1, k2, k3, k4, k5):
    """Equation (18): by how much the radius grows, and the tangential shifts of x and y.

    The radial part is read as 1 + k1 r^2 + k2 r^4 + k5 r^6; the growth is what it has beyond 1. For
    numbers, for arrays, and to be compiled by numba: a literal in it would turn single precision
    into double.

    Parameters
    ----------
    x, y : float or ndarray
        Normalised coordinates, x / z and y / z.
    k1, k2, k3, k4, k5 : float
        The paper's order, see :class:`CameraModel`.
    """
    r2 = x * x + y * y
    growth = r2 * (k1 + r2 * (k2 + r2 * k5))
    shift_x = (k3 + k3) * x * y + k4 * (r2 + (x + x) * x)
    shift_y = k3 * (r2 + (y + y) * y) + (k4 + k4) * x * y
    return growth, shift_x, shift_y


def distort(normalized: ArrayLike, distortion: np.ndarray) -> np.ndarray:
    """Lens distortion, equation (18).

    Parameters
    ----------
    normalized : array_like, shape (..., 2)
        ``(x / z, y / z)``.
    distortion : ndarray, shape (5,)
        (k1, k2, k3, k4, k5).

    Returns
    -------
    ndarray, shape (..., 2)
        Normalised coordinates.
    """
    x, y = np.moveaxis(np.asarray(normalized, float), -1, 0)
    growth, shift_x, shift_y = lens_terms(x, y, *distortion)
    return np.stack([x * (1 + growth) + shift_x, y * (1 + growth) + shift_y], axis=-1)


def fold(model: CameraModel) -> float:
    """Squared distance ``(x^2 + y^2) / z^2`` at which radial distortion turns back: points beyond
    are not in the image.

    Parameters
    ----------
    model : CameraModel

    Returns
    -------
    float
        Infinite for a lens that never does: ``1 + 3 k1 r^2 + 5 k2 r^4 + 7 k5 r^6`` is the slope of
        equation (18).
    """
    k1, k2, _, _, k5 = model.distortion
    roots = np.roots([7 * k5, 5 * k2, 3 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-9].real
    return float(min(real[real > 0], default=np.inf))


def project(p_camera: ArrayLike, model: CameraModel) -> np.ndarray:
    """Project points to pixels, equations (18) and (19).

    Parameters
    ----------
    p_camera : array_like, shape (..., 3)
        Metres.
    model : CameraModel

    Returns
    -------
    ndarray, shape (..., 2)
        NaN where z <= 0.
    """
    return _pixels(distort(_before(p_camera), model.distortion), model)


def project_jacobians(
    p_camera: ArrayLike, model: CameraModel
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of :func:`project` at points in front of the camera.

    Parameters
    ----------
    p_camera : array_like, shape (..., 3)
        Camera frame, metres.
    model : CameraModel

    Returns
    -------
    by_point : ndarray, shape (..., 2, 3)
        Pixels per metre.
    by_intrinsics : ndarray, shape (..., 2, 9)
        In the order of `CameraModel.parameters`.
    """
    p_camera = np.asarray(p_camera, float)
    J = np.zeros((0, 15))  # by rotation (3), translation (3), focal lengths, centre, lens
    if p_camera.size:
        still = np.zeros(3)
        flat = p_camera.reshape(-1, 1, 3)
        J = cv2.projectPoints(flat, still, still, model.matrix, model.distortion)[1]
    J = J.reshape(*p_camera.shape[:-1], 2, 15)
    return J[..., 3:6], J[..., 6:]


def undistort(uv: ArrayLike, model: CameraModel) -> np.ndarray:
    """Undistorted pixels of image points: of a camera with the same K and no lens distortion.

    Parameters
    ----------
    uv : array_like, shape (..., 2)
        Pixels.
    model : CameraModel

    Returns
    -------
    ndarray, shape (..., 2)
    """
    uv = np.ascontiguousarray(uv, float)
    if uv.size == 0:
        return uv
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-12)
    flat = uv.reshape(-1, 1, 2)
    out = cv2.undistortImagePoints(flat, model.matrix, model.distortion, arg1=stop)
    return out.reshape(uv.shape)


def redistort(uv: ArrayLike, model: CameraModel) -> np.ndarray:
    """Image points of undistorted pixels: the way back of :func:`undistort`.

    Parameters
    ----------
    uv : array_like, shape (..., 2)
        Undistorted pixels.
    model : CameraModel

    Returns
    -------
    ndarray, shape (..., 2)
        Pixels; NaN for what lies so far outside that the lens would fold it back into the image.
    """
    sights = model.sights(uv)
    recorded = project(sights, model)
    recorded[np.sum(sights[..., :2] ** 2, axis=-1) >= fold(model)] = np.nan
    return recorded


def line_through(a: ArrayLike, b: ArrayLike) -> np.ndarray:
    """Pixel line ``l0 u + l1 v + l2 = 0`` with ``l0^2 + l1^2 = 1`` through two pixels.

    Parameters
    ----------
    a, b : array_like, shape (..., 2)
        ValueError where they are the same.

    Returns
    -------
    ndarray, shape (..., 3)
    """
    a = np.asarray(a, float)
    along = b - a
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    if np.any(length == 0):
        raise ValueError(f"a line needs two different points, got {a} twice")
    normal = along[..., [1, 0]] * [1, -1] / length
    return np.insert(normal, 2, -np.vecdot(normal, a), axis=-1)


def line_distance(uv: ArrayLike, line: ArrayLike) -> np.ndarray:
    """Signed distance of pixels from lines, equation (20) with its sign kept; pixels.

    Parameters
    ----------
    uv : array_like, shape (..., 2)
    line : array_like, shape (..., 3)
        See :func:`line_through`.

    Returns
    -------
    ndarray, shape (...)
    """
    line = np.asarray(line, float)
    return np.vecdot(uv, line[..., :2]) + line[..., 2]
