"""From polar measurements to points, the tilt of the platform, lines and planes, poses as arrays,
motions in words.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

# axes of a camera that looks ahead of the LRF, and of an upright board with its print towards it
AHEAD = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
POSE_UNITS = np.repeat([np.degrees(1.0), 1000.0], 3)  # of rotation vector and translation
NEXT = np.array([1, 2, 0])  # the axis after one, and the one before it
PREVIOUS = np.array([2, 0, 1])


class DegenerateGeometry(ValueError):
    """The data do not determine what was asked for; the message names the motion that stays
    unobservable.
    """


def cross(a: ArrayLike, b: ArrayLike) -> np.ndarray:
    """Cross products; those of ``numpy.linalg`` to the bit, in an eighth of its time for few.

    Parameters
    ----------
    a, b : array_like, shape (..., 3)
        Broadcast against each other.

    Returns
    -------
    ndarray, shape (..., 3)
    """
    a = np.asarray(a)
    b = np.asarray(b)
    forward = a.take(NEXT, -1) * b.take(PREVIOUS, -1)
    backward = a.take(PREVIOUS, -1) * b.take(NEXT, -1)
    return forward - backward


def length_of(vectors: np.ndarray) -> np.ndarray:
    """Lengths (...) of vectors (..., k)."""
    return np.linalg.norm(vectors, axis=-1)


def unit_vector(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length 1 that point the same way.

    Parameters
    ----------
    vectors : ndarray, shape (..., k)

    Returns
    -------
    ndarray, shape (..., k)
    """
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def unit_lines(lines: np.ndarray) -> np.ndarray:
    """Lines ``a x + b y + c = 0`` with ``a^2 + b^2 = 1`` that are the same.

    Parameters
    ----------
    lines : ndarray, shape (..., 3)
        ``(a, b, c)``.

    Returns
    -------
    ndarray, shape (..., 3)
    """
    return lines / np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)


def hat(v: ArrayLike) -> np.ndarray:
    """Cross-product matrices, ``hat(v) @ u == cross(v, u)``.

    Parameters
    ----------
    v : array_like, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    v = np.asarray(v, float)
    return (v @ HATS).reshape(*v.shape, 3)


HATS = cross(np.eye(3), np.eye(3)[:, None]).reshape(3, 9)  # of the axes, a row each


def polar_to_points(ranges: ArrayLike, bearings: ArrayLike) -> np.ndarray:
    """Points of a 2D scan in the LRF frame, Li et al. 2009, equation (17).

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
    """
    ranges = np.asarray(ranges, float)
    x = ranges * np.cos(bearings)
    y = ranges * np.sin(bearings)
    return np.stack([x, y, 0.0 * x], axis=-1)


def bearings_of(points: np.ndarray) -> np.ndarray:
    """Bearings (...) of points (..., 3) in the LRF frame: the way back of
    :func:`polar_to_points`.
    """
    return np.arctan2(points[..., 1], points[..., 0])


def polar_covariance(
    ranges: np.ndarray,
    bearings: np.ndarray,
    sigma_range: float | np.ndarray,
    sigma_bearing: float | np.ndarray,
) -> np.ndarray:
    """Covariance of polar points from independent errors along and across the beam.

    Parameters
    ----------
    ranges, bearings : ndarray, shape (...)
        Metres and radians.
    sigma_range, sigma_bearing : array_like, broadcastable to `ranges`
        Standard deviations, metres and radians.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        LRF frame, square metres.
    """
    along = polar_to_points(sigma_range, bearings)
    across = polar_to_points(ranges * sigma_bearing, bearings + np.pi / 2)
    axes = np.stack([along, across], axis=-1)
    return axes @ axes.mT


def tilt(points: ArrayLike, pitch: ArrayLike) -> np.ndarray:
    """Turn points about the tilt axis, from the head to the platform frame, equations (4) and (5).

    Parameters
    ----------
    points : array_like, shape (..., 3)
        ``p_head``, metres.
    pitch : array_like, broadcastable with ``points.shape[:-1]``
        Radians; positive lifts the view.

    Returns
    -------
    ndarray, shape (..., 3)
        ``p_platform = Rx(pitch) p_head``.
    """
    points = np.asarray(points)
    y = points[..., 1]
    z = points[..., 2]
    cosine = np.cos(pitch)
    sine = np.sin(pitch)
    turned = np.empty((*np.broadcast_shapes(y.shape, cosine.shape), 3))
    turned[..., 0] = points[..., 0]
    turned[..., 1] = cosine * y - sine * z
    turned[..., 2] = sine * y + cosine * z
    return turned


def lrf_to_platform(
    p_lrf: ArrayLike, pitch: ArrayLike, T_head_lrf: RigidTransform
) -> np.ndarray:
    """Points of scans in the fixed platform frame, ``p_platform = Rx(pitch) (R p_lrf + t)``,
    equation (6).

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
        Metres.
    """
    return tilt(T_head_lrf.apply(p_lrf), pitch)


def carry(rotation: Rotation, point: ArrayLike, to: ArrayLike = 0.0) -> RigidTransform:
    """The transform, or a stack, with a rotation, that takes a point to a place.

    Parameters
    ----------
    rotation : Rotation
    point : array_like, shape (3,) or (n, 3)
        Such as the centre of a camera, metres.
    to : array_like, broadcastable to `point`
        By default the origin.
    """
    return RigidTransform.from_components(to - rotation.apply(point), rotation)


@dataclass(frozen=True)
class TiltAxis:
    """The tilt axis as a line in the LRF frame: all that the platform calibration can know (4
    degrees of freedom).

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
        direction = ", ".join(f"{value:.5f}" for value in self.direction)
        foot_mm = ", ".join(f"{1000 * value:.1f}" for value in self.foot)
        return f"TiltAxis(direction=({direction}), foot_mm=({foot_mm}))"


def axis_of(T_head_lrf: RigidTransform) -> TiltAxis:
    """The tilt axis that a head transform stands for: ``R^T e_x`` through ``-R^T t``.

    Parameters
    ----------
    T_head_lrf : RigidTransform
        Turning it about x and sliding it along x change nothing.
    """
    lrf_head = T_head_lrf.inv()
    direction = lrf_head.rotation.apply([1.0, 0.0, 0.0])
    point = lrf_head.translation
    return TiltAxis(direction, point - direction * (direction @ point))


def head_from_axis(axis: TiltAxis, stated: RigidTransform | None = None) -> RigidTransform:
    """The head transform that turns the LRF least: the gauge used in this repository.

    Parameters
    ----------
    axis : TiltAxis
    stated : RigidTransform, optional
        Turn about the axis and shift along it, which no data show, are those of this one.

    Returns
    -------
    RigidTransform
        ``T_head_lrf`` with the smallest rotation that maps the axis' direction to x, and no shift
        along the axis.
    """
    rotation, _ = Rotation.align_vectors([1.0, 0.0, 0.0], axis.direction)
    head = carry(rotation, axis.foot)
    if stated is None:
        return head
    return stated * head_from_axis(axis_of(stated)).inv() * head


def paper_parameters(T_head_lrf: RigidTransform) -> tuple[np.ndarray, float]:
    """Phi and t_y of equations (1) and (2) for the same tilt axis.

    Parameters
    ----------
    T_head_lrf : RigidTransform

    Returns
    -------
    phi : ndarray, shape (3,)
        ``(phi_x, phi_y, phi_z)`` of ``R = Rx(phi_x) Ry(phi_y) Rz(phi_z)``, radians.
    ty : float
        Metres, never negative. With ``ty = 0`` the axis meets the LRF's origin and phi_x cannot be
        known (0 is given).
    """
    about_x, phi_y, phi_z = T_head_lrf.rotation.as_euler("XYZ")
    back = Rotation.from_euler("X", -about_x)
    _, away_y, away_z = back.apply(T_head_lrf.translation)
    ty = float(np.hypot(away_y, away_z))
    phi_x = 0.0
    if ty > 0:
        phi_x = float(np.arctan2(-away_z, away_y))
    return np.array([phi_x, phi_y, phi_z]), ty


def head_from_paper(phi: ArrayLike, ty: float) -> RigidTransform:
    """``T_head_lrf`` by equations (1) to (3) with ``R = Rx Ry Rz`` (x last).

    Parameters
    ----------
    phi : array_like, shape (3,)
        Radians.
    ty : float
        Metres.
    """
    return RigidTransform.from_components([0.0, ty, 0.0], Rotation.from_euler("XYZ", phi))


def axis_difference(a: TiltAxis, b: TiltAxis) -> tuple[float, float]:
    """How far two axes are apart.

    Parameters
    ----------
    a, b : TiltAxis

    Returns
    -------
    angle : float
        Radians.
    offset : float
        Distance of their foot points, metres.
    """
    sine = length_of(np.cross(a.direction, b.direction))
    angle = float(np.arctan2(sine, a.direction @ b.direction))
    return angle, float(length_of(a.foot - b.foot))


def transform_difference(a: RigidTransform, b: RigidTransform) -> tuple[float, float]:
    """How far two transforms with the same frames are apart.

    Parameters
    ----------
    a, b : RigidTransform

    Returns
    -------
    angle : float
        Radians.
    distance : float
        Of the translations, metres.
    """
    turn = a.rotation * b.rotation.inv()
    return float(turn.magnitude()), float(length_of(a.translation - b.translation))


def rms(values: np.ndarray) -> float:
    """Root mean square.

    Parameters
    ----------
    values : array_like

    Returns
    -------
    float
        Of the finite values; NaN where there are none.
    """
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    if not len(values):
        return np.nan
    return float(np.sqrt(np.mean(values**2)))


def _principal(points):
    """Centre of points (n, 3), and variances along their principal axes (columns), the smallest
    first.
    """
    centre = np.mean(points, axis=0)
    away = points - centre
    variances, axes = np.linalg.eigh(away.T @ away / len(points))
    return centre, variances, axes


def fit_plane(points: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Total least squares plane ``normal . p = distance``.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Metres; rows with NaN are ignored.

    Returns
    -------
    normal : ndarray, shape (3,)
        Unit vector, away from the origin.
    distance : float
        Of the origin, never negative, metres.
    rms : float
        Of the points' distances, metres.

    Raises
    ------
    DegenerateGeometry
        With fewer than three points, or all on one line.
    """
    points = np.asarray(points, float)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 3:
        raise DegenerateGeometry(f"a plane needs three points, got {len(points)}")
    centre, values, vectors = _principal(points)
    if values[1] < 1e-12 * max(values[2], 1e-300):
        raise DegenerateGeometry(
            "the points lie on one line: the rotation of a plane about it stays unobservable"
        )
    normal = vectors[:, 0]
    if normal @ centre < 0:
        normal = -normal
    return normal, float(normal @ centre), float(np.sqrt(max(values[0], 0.0)))


def plane_axes(normal: np.ndarray) -> np.ndarray:
    """Two unit vectors in a plane, at right angles.

    Parameters
    ----------
    normal : ndarray, shape (3,)

    Returns
    -------
    ndarray, shape (2, 3)
    """
    other = [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0]
    across = unit_vector(np.cross(normal, other))
    return np.stack([np.cross(across, normal), across])


def fit_line(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Total least squares line of points.

    Parameters
    ----------
    points : ndarray, shape (n, 2) or (n, 3)

    Returns
    -------
    centre : ndarray, shape (2,) or (3,)
    direction : ndarray, shape (2,) or (3,)
        Unit vector.
    rms : float
        Of the points' distances.

    Raises
    ------
    DegenerateGeometry
        With fewer than two distinct points.
    """
    points = np.asarray(points, float)
    if len(points) < 2 or np.ptp(points, axis=0).max() == 0:
        raise DegenerateGeometry(f"a line needs two distinct points, got {len(points)}")
    centre, values, vectors = _principal(points)
    return centre, vectors[:, -1], float(np.sqrt(max(np.sum(values[:-1]), 0.0)))


POSE_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
POSE = 6  # numbers of a pose, [w, v]


def pose_array(transform: RigidTransform) -> np.ndarray:
    """Top three rows of a transform's matrix: the form the solvers move about.

    Parameters
    ----------
    transform : RigidTransform
        One, or a stack.

    Returns
    -------
    ndarray, shape (..., 3, 4)
    """
    return transform.as_matrix()[..., :3, :].copy()


def pose_transform(pose: np.ndarray, proper: bool = False) -> RigidTransform:
    """The transform (one, or a stack) of a pose array.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
    proper : bool
        The rotations are exact, and need not be made so.
    """
    whole = np.zeros((*pose.shape[:-2], 4, 4))
    whole[..., :3, :] = pose
    whole[..., 3, 3] = 1.0
    return RigidTransform(
        whole, normalize=not proper, copy=False
    )  # much faster than from components


def log_rotation(R: np.ndarray) -> np.ndarray:
    """Rotation vectors of rotation matrices.

    Parameters
    ----------
    R : ndarray, shape (..., 3, 3)
        Taken to be exact.

    Returns
    -------
    ndarray, shape (..., 3)
        Radians.
    """
    return Rotation.from_matrix(R, assume_valid=True).as_rotvec()


def pose_parameters(pose: np.ndarray) -> np.ndarray:
    """Rotation vectors and translations in the order of `POSE_NAMES`.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)

    Returns
    -------
    ndarray, shape (..., 6)
        Radians and metres.
    """
    return np.concatenate([log_rotation(pose[..., :3]), pose[..., 3]], axis=-1)


def pose_step(start: RigidTransform, end: RigidTransform) -> np.ndarray:
    """The small change ``[w, v]`` of :func:`move_pose` that leads from one transform to another.

    Parameters
    ----------
    start, end : RigidTransform
        Or stacks of n.

    Returns
    -------
    ndarray, shape (6,) or (n, 6)
        Radians and metres.
    """
    turn = (end.rotation * start.rotation.inv()).as_rotvec()
    return np.concatenate([turn, end.translation - start.translation], axis=-1)


def move_pose(pose: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """Small change of poses: ``R <- exp(w) R``, ``t <- t + v``.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
    delta : ndarray, shape (..., 6)
        ``[w, v]``, radians and metres, in the destination frame.

    Returns
    -------
    ndarray, shape (..., 3, 4)
    """
    turned = Rotation.from_rotvec(delta[..., :3]).as_matrix() @ pose[..., :3]
    return np.concatenate([turned, (pose[..., 3] + delta[..., 3:6])[..., None]], axis=-1)


def apply_pose(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """``R p + t`` of points under poses.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
    points : ndarray, shape (..., n, 3) or (n, 3)

    Returns
    -------
    ndarray, shape (..., n, 3)
    """
    return rotate_and_move(pose, points)[1]


def rotate_and_move(pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``R p`` and ``R p + t`` of points under poses, each (..., n, 3); see :func:`apply_pose`."""
    rotated = points @ pose[..., :3].mT
    return rotated, rotated + pose[..., None, :, 3]


def gradient_by_pose(rotated: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Jacobian rows of scalars by ``[w, v]`` of the pose that moves their points.

    ``a . (w x R p) + a . v = [R p x a, a] . [w, v]``.

    Parameters
    ----------
    rotated : ndarray, shape (..., n, 3)
        ``R p``, without the translation.
    gradient : ndarray, shape (..., n, 3)
        ``a``, of the scalars by the moved points.

    Returns
    -------
    ndarray, shape (..., n, 6)
    """
    return np.concatenate([cross(rotated, gradient), gradient], axis=-1)
