"""From polar measurements to points, the tilt of the platform, planes and lines in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation


class DegenerateGeometry(ValueError):
    """The data do not determine what was asked for; the message names the motion that stays unobservable."""


def hat(v):
    """Cross-product matrices of vectors, ``hat(v) @ u == cross(v, u)``.

    Parameters
    ----------
    v : array_like, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    v = np.asarray(v, dtype=float)
    out = np.zeros(v.shape + (3,))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def polar_to_points(ranges, bearings):
    """Points of a 2D scan in the LRF frame.

    Parameters
    ----------
    ranges : array_like, shape (...)
        Metres; NaN where nothing came back.
    bearings : array_like, broadcastable to `ranges`
        Radians, 0 to the right (x), pi/2 ahead (y).

    Returns
    -------
    ndarray, shape (..., 3)
        ``p_lrf``, metres; NaN rows where the range is NaN.

    Notes
    -----
    Li et al. 2009, equation (17).
    """
    ranges, bearings = np.broadcast_arrays(np.asarray(ranges, float), np.asarray(bearings, float))
    return np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings), 0.0 * ranges], axis=-1)


def polar_covariance(ranges, bearings, sigma_range, sigma_bearing):
    """Covariance of polar points in the LRF frame, from independent errors along and across the beam.

    Parameters
    ----------
    ranges, bearings : array_like, shape (...)
        Metres and radians.
    sigma_range, sigma_bearing : array_like, broadcastable
        Standard deviations, metres and radians.

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    ranges, bearings = np.broadcast_arrays(np.asarray(ranges, float), np.asarray(bearings, float))
    along = np.stack([np.cos(bearings), np.sin(bearings), 0 * bearings], -1)
    across = np.stack([-np.sin(bearings), np.cos(bearings), 0 * bearings], -1)
    across = across * (ranges * sigma_bearing)[..., None]
    along = along * np.broadcast_to(np.asarray(sigma_range, float), ranges.shape)[..., None]
    return along[..., :, None] * along[..., None, :] + across[..., :, None] * across[..., None, :]


def tilt(points, pitch):
    """Turn points about the tilt axis, from the head to the platform frame.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        ``p_head``, metres.
    pitch : array_like, broadcastable to ``points.shape[:-1]``
        Radians; positive lifts the view.

    Returns
    -------
    ndarray, shape (..., 3)
        ``p_platform = Rx(pitch) p_head``; equations (4) and (5).
    """
    points = np.asarray(points, float)
    c, s = np.cos(pitch), np.sin(pitch)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    x = np.broadcast_to(x, np.broadcast_shapes(x.shape, np.shape(c)))
    return np.stack([x, c * y - s * z, s * y + c * z], axis=-1)


def lrf_to_platform(p_lrf, pitch, T_head_lrf):
    """Points of scans taken at known pitch angles in the fixed platform frame, equation (6).

    Parameters
    ----------
    p_lrf : array_like, shape (..., 3)
        Metres.
    pitch : array_like, broadcastable to ``p_lrf.shape[:-1]``
        Radians.
    T_head_lrf : RigidTransform

    Returns
    -------
    ndarray, shape (..., 3)
        ``p_platform = Rx(pitch) (R p_lrf + t)``.
    """
    p_lrf = np.asarray(p_lrf, float)
    p_head = T_head_lrf.apply(p_lrf.reshape(-1, 3)).reshape(p_lrf.shape)
    return tilt(p_head, pitch)


def lrf_to_source(p_lrf, pitch, T_head_lrf, mount, image_pitch=0.0):
    """Points of a sweep in the frame a camera is fixed to (the *source* frame of a camera calibration).

    Parameters
    ----------
    p_lrf : array_like, shape (..., 3)
        Metres.
    pitch : array_like, broadcastable to ``p_lrf.shape[:-1]``
        Pitch of each point's scan, radians.
    T_head_lrf : RigidTransform
    mount : {'platform', 'head'}
        What the camera is fixed to.
    image_pitch : float
        Pitch at which the image was taken, radians; only used for a camera on the head.

    Returns
    -------
    ndarray, shape (..., 3)
        Platform coordinates for a camera on the base; for a camera on the head, LRF coordinates of a scan that would
        have been taken at `image_pitch`.

    Raises
    ------
    ValueError
        For another `mount`.
    """
    if mount == "platform":
        return lrf_to_platform(p_lrf, pitch, T_head_lrf)
    if mount != "head":
        raise ValueError(f"mount is 'head' or 'platform', got '{mount}'")
    turned = lrf_to_platform(p_lrf, np.asarray(pitch) - image_pitch, T_head_lrf)
    return T_head_lrf.inv().apply(turned.reshape(-1, 3)).reshape(turned.shape)


@dataclass(frozen=True)
class TiltAxis:
    """The tilt axis as a line in the LRF frame: all that the platform calibration can know (4 degrees of freedom).

    Attributes
    ----------
    direction : ndarray, shape (3,)
        Unit vector, ``R^T e_x``; points to the side of +x of the LRF.
    foot : ndarray, shape (3,)
        The point of the axis nearest to the LRF's origin, metres.
    """

    direction: np.ndarray
    foot: np.ndarray

    def __repr__(self):
        d, f = self.direction, 1000 * self.foot
        return f"TiltAxis(direction=({d[0]:.5f}, {d[1]:.5f}, {d[2]:.5f}), foot_mm=({f[0]:.1f}, {f[1]:.1f}, {f[2]:.1f}))"


def axis_of(T_head_lrf):
    """The tilt axis in the LRF frame that a head transform stands for.

    Parameters
    ----------
    T_head_lrf : RigidTransform

    Returns
    -------
    TiltAxis
        ``direction = R^T e_x``, ``foot`` = the foot of the perpendicular from the LRF's origin on the line through
        ``-R^T t``. Turning about x and sliding along x change nothing.
    """
    lrf_head = T_head_lrf.inv()
    direction = lrf_head.rotation.apply([1.0, 0.0, 0.0])
    point = lrf_head.translation
    return TiltAxis(direction, point - direction * (direction @ point))


def head_from_axis(axis):
    """The head transform that turns the LRF least: the gauge used in this repository.

    Parameters
    ----------
    axis : TiltAxis

    Returns
    -------
    RigidTransform
        ``T_head_lrf`` with the smallest rotation that maps the axis direction to x, and no shift along the axis.
    """
    d = np.asarray(axis.direction, float)
    w = np.cross(d, [1.0, 0.0, 0.0])
    sine, cosine = np.linalg.norm(w), d[0]
    rotation = Rotation.identity() if sine == 0 else Rotation.from_rotvec(w / sine * np.arctan2(sine, cosine))
    return RigidTransform.from_components(-rotation.apply(axis.foot), rotation)


def paper_parameters(T_head_lrf):
    """Phi and t_y of equations (1) and (2) for the same tilt axis.

    Parameters
    ----------
    T_head_lrf : RigidTransform

    Returns
    -------
    phi : ndarray, shape (3,)
        ``(phi_x, phi_y, phi_z)`` of ``R = Rx(phi_x) Ry(phi_y) Rz(phi_z)``, radians.
    ty : float
        Metres, never negative. With ``ty = 0`` the axis meets the LRF's origin and phi_x cannot be known (0 is given).
    """
    axis = axis_of(T_head_lrf)
    d = axis.direction
    phi_y = np.arctan2(d[2], np.hypot(d[0], d[1]))
    phi_z = np.arctan2(-d[1], d[0])
    turned = Rotation.from_euler("YZ", [phi_y, phi_z]).apply(-axis.foot)
    ty = float(np.hypot(turned[1], turned[2]))
    phi_x = float(np.arctan2(-turned[2], turned[1])) if ty > 0 else 0.0
    return np.array([phi_x, phi_y, phi_z]), ty


def head_from_paper(phi, ty):
    """``T_head_lrf`` from the paper's parameters, equations (1) to (3) with ``R = Rx Ry Rz`` (x last).

    Parameters
    ----------
    phi : array_like, shape (3,)
        Radians.
    ty : float
        Metres.

    Returns
    -------
    RigidTransform
    """
    return RigidTransform.from_components([0.0, ty, 0.0], Rotation.from_euler("XYZ", phi))


def axis_difference(a, b):
    """Angle between two axes and the distance of their foot points.

    Returns
    -------
    angle : float
        Radians.
    offset : float
        Distance of the two lines at the LRF (of the foot points), metres.
    """
    angle = np.arctan2(np.linalg.norm(np.cross(a.direction, b.direction)), a.direction @ b.direction)
    return float(angle), float(np.linalg.norm(a.foot - b.foot))


def transform_difference(a, b):
    """Rotation angle (radians) and translation distance (metres) between two transforms with the same frames."""
    return float((a.rotation * b.rotation.inv()).magnitude()), float(np.linalg.norm(a.translation - b.translation))


def fit_plane(points, weights=None):
    """Total least squares plane ``normal . p = distance``.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        Rows with NaN are ignored.
    weights : array_like, shape (n,), optional

    Returns
    -------
    normal : ndarray, shape (3,)
        Unit vector, away from the origin (``distance >= 0``).
    distance : float
    rms : float
        Root mean square distance of the points from the plane.

    Raises
    ------
    DegenerateGeometry
        With fewer than three points, or all on one line.
    """
    points = np.asarray(points, float)
    good = np.isfinite(points).all(axis=1)
    points = points[good]
    weights = np.ones(len(points)) if weights is None else np.asarray(weights, float)[good]
    if len(points) < 3:
        raise DegenerateGeometry(f"a plane needs three points, got {len(points)}")
    centre = np.average(points, axis=0, weights=weights)
    values, vectors = np.linalg.eigh(((points - centre) * weights[:, None]).T @ (points - centre) / weights.sum())
    if values[1] < 1e-12 * max(values[2], 1e-300):
        raise DegenerateGeometry("the points lie on one line: the rotation of a plane about it stays unobservable")
    normal = vectors[:, 0]
    normal = -normal if normal @ centre < 0 else normal
    return normal, float(normal @ centre), float(np.sqrt(max(values[0], 0.0)))


def fit_line(points, weights=None):
    """Total least squares line in space.

    Parameters
    ----------
    points : array_like, shape (n, 3)
    weights : array_like, shape (n,), optional

    Returns
    -------
    point : ndarray, shape (3,)
        Centre of the points, on the line.
    direction : ndarray, shape (3,)
        Unit vector.
    rms : float
        Root mean square distance of the points from the line.

    Raises
    ------
    DegenerateGeometry
        With fewer than two distinct points.
    """
    points = np.asarray(points, float)
    weights = np.ones(len(points)) if weights is None else np.asarray(weights, float)
    if len(points) < 2 or np.ptp(points, axis=0).max() == 0:
        raise DegenerateGeometry(f"a line needs two distinct points, got {len(points)}")
    centre = np.average(points, axis=0, weights=weights)
    values, vectors = np.linalg.eigh(((points - centre) * weights[:, None]).T @ (points - centre) / weights.sum())
    return centre, vectors[:, 2], float(np.sqrt(max(values[0] + values[1], 0.0)))


def line_gap(point1, direction1, point2, direction2):
    """Distance of two lines in space, equation (14); the distance of parallel lines is measured across them."""
    normal = np.cross(direction1, direction2)
    between = np.asarray(point1) - np.asarray(point2)
    length = np.linalg.norm(normal)
    if length < 1e-12 * np.linalg.norm(direction1) * np.linalg.norm(direction2):
        return float(np.linalg.norm(np.cross(between, direction1)) / np.linalg.norm(direction1))
    return float(abs(normal @ between) / length)
