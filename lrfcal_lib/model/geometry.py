"""From polar measurements to points, the tilt of the platform, lines and planes, poses as arrays,
motions in words.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

# axes of a camera that looks ahead of the LRF, and of an upright board with its print towards it
AHEAD = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


class DegenerateGeometry(ValueError):
    """The data do not determine what was asked for; the message names the motion that stays
    unobservable.
    """


def hat(v):
    """Cross-product matrices (..., 3, 3) of vectors (..., 3), ``hat(v) @ u == cross(v, u)``."""
    v = np.asarray(v, dtype=float)
    upper = np.zeros(v.shape + (3,))
    upper[..., 0, 1] = -v[..., 2]
    upper[..., 0, 2] = v[..., 1]
    upper[..., 1, 2] = -v[..., 0]
    return upper - np.swapaxes(upper, -1, -2)


def cross(a, b):
    """Cross product along the last axis; several times faster than `numpy.cross` on stacks."""
    x = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    y = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    z = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.stack([x, y, z], axis=-1)


def polar_to_points(ranges, bearings):
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
    ranges, bearings = np.broadcast_arrays(np.asarray(ranges, float), np.asarray(bearings, float))
    x = ranges * np.cos(bearings)
    y = ranges * np.sin(bearings)
    return np.stack([x, y, 0.0 * ranges], axis=-1)


def polar_covariance(ranges, bearings, sigma_range, sigma_bearing):
    """Covariance (..., 3, 3) of polar points in the LRF frame, from independent errors along and
    across the beam.
    """
    sigma_range = np.asarray(sigma_range, float)
    ranges, bearings, sigma_range = np.broadcast_arrays(ranges, bearings, sigma_range)
    along = polar_to_points(sigma_range, bearings)
    across = polar_to_points(ranges * sigma_bearing, bearings + np.pi / 2)
    return _outer(along) + _outer(across)


def _outer(v):
    """``v v^T`` of vectors, shape (..., k) -> (..., k, k)."""
    return v[..., :, None] * v[..., None, :]


def tilt(points, pitch):
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
    x, y, z = np.moveaxis(np.asarray(points), -1, 0)
    cosine = np.cos(pitch)
    sine = np.sin(pitch)
    return np.stack([x + 0 * cosine, cosine * y - sine * z, sine * y + cosine * z], axis=-1)


def lrf_to_platform(p_lrf, pitch, T_head_lrf):
    """Points of scans in the fixed platform frame, ``p_platform = Rx(pitch) (R p_lrf + t)``,
    equation (6).

    Parameters
    ----------
    p_lrf : array_like, shape (..., 3)
        Metres.
    pitch : array_like, broadcastable to ``p_lrf.shape[:-1]``
        Radians.
    T_head_lrf : RigidTransform
    """
    return tilt(T_head_lrf.apply(p_lrf), pitch)


def lrf_to_source(p_lrf, pitch, T_head_lrf, mount, image_pitch=0.0):
    """Points of a sweep in the frame a camera is fixed to (the *source* frame of a camera
    calibration).

    Parameters
    ----------
    p_lrf, pitch, T_head_lrf
        See :func:`lrf_to_platform`.
    mount : {'platform', 'head'}
        What the camera is fixed to; ValueError for anything else.
    image_pitch : float
        Pitch at which the image was taken, radians; only used for a camera on the head.

    Returns
    -------
    ndarray, shape (..., 3)
        Platform coordinates for a camera on the base; for a camera on the head, LRF coordinates of
        a scan that would have been taken at `image_pitch`.
    """
    if mount == "platform":
        return lrf_to_platform(p_lrf, pitch, T_head_lrf)
    if mount != "head":
        raise ValueError(f"mount is 'head' or 'platform', got '{mount}'")
    return T_head_lrf.inv().apply(
        lrf_to_platform(p_lrf, np.asarray(pitch) - image_pitch, T_head_lrf)
    )


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


def axis_of(T_head_lrf):
    """The tilt axis that a head transform stands for: ``R^T e_x`` through ``-R^T t``.

    Turning about x and sliding along x change nothing.
    """
    lrf_head = T_head_lrf.inv()
    direction = lrf_head.rotation.apply([1.0, 0.0, 0.0])
    point = lrf_head.translation
    return TiltAxis(direction, point - direction * (direction @ point))


def head_from_axis(axis):
    """The head transform that turns the LRF least: the gauge used in this repository.

    It has the smallest rotation that maps the axis' direction to x, and no shift along the axis.
    """
    direction = np.asarray(axis.direction, float)
    turn = np.cross(direction, [1.0, 0.0, 0.0])
    sine = np.linalg.norm(turn)
    rotation = Rotation.identity()
    if sine > 0:
        rotation = Rotation.from_rotvec(turn / sine * np.arctan2(sine, direction[0]))
    return RigidTransform.from_components(-rotation.apply(axis.foot), rotation)


def paper_parameters(T_head_lrf):
    """Phi and t_y of equations (1) and (2) for the same tilt axis.

    Returns
    -------
    phi : ndarray, shape (3,)
        ``(phi_x, phi_y, phi_z)`` of ``R = Rx(phi_x) Ry(phi_y) Rz(phi_z)``, radians.
    ty : float
        Metres, never negative. With ``ty = 0`` the axis meets the LRF's origin and phi_x cannot be
        known (0 is given).
    """
    axis = axis_of(T_head_lrf)
    x, y, z = axis.direction
    phi_y = np.arctan2(z, np.hypot(x, y))
    phi_z = np.arctan2(-y, x)
    _, away_y, away_z = Rotation.from_euler("YZ", [phi_y, phi_z]).apply(-axis.foot)
    ty = float(np.hypot(away_y, away_z))
    phi_x = 0.0
    if ty > 0:
        phi_x = float(np.arctan2(-away_z, away_y))
    return np.array([phi_x, phi_y, phi_z]), ty


def head_from_paper(phi, ty):
    """``T_head_lrf`` from phi (radians) and ty (metres), equations (1) to (3) with ``R = Rx Ry Rz``
    (x last).
    """
    return RigidTransform.from_components([0.0, ty, 0.0], Rotation.from_euler("XYZ", phi))


def axis_difference(a, b):
    """Angle between two axes (radians) and the distance of their foot points (metres)."""
    sine = np.linalg.norm(np.cross(a.direction, b.direction))
    angle = float(np.arctan2(sine, a.direction @ b.direction))
    return angle, float(np.linalg.norm(a.foot - b.foot))


def transform_difference(a, b):
    """Rotation angle (radians) and translation distance (metres) between two transforms with the
    same frames.
    """
    turn = a.rotation * b.rotation.inv()
    return float(turn.magnitude()), float(np.linalg.norm(a.translation - b.translation))


def _principal(points):
    """Centre of points (n, 3), and variances along their principal axes (columns), the smallest
    first.
    """
    centre = np.mean(points, axis=0)
    away = points - centre
    variances, axes = np.linalg.eigh(away.T @ away / len(points))
    return centre, variances, axes


def fit_plane(points):
    """Total least squares plane ``normal . p = distance`` of points (n, 3), rows with NaN ignored.

    Returns the unit normal, away from the origin, the origin's distance (>= 0), and the root mean
    square distance of the points. DegenerateGeometry with fewer than three points, or all on one
    line.
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


def fit_line(points):
    """Total least squares line of points (n, 2 or 3): their centre, the unit direction, their rms
    distance.

    DegenerateGeometry with fewer than two distinct points.
    """
    points = np.asarray(points, float)
    if len(points) < 2 or np.ptp(points, axis=0).max() == 0:
        raise DegenerateGeometry(f"a line needs two distinct points, got {len(points)}")
    centre, values, vectors = _principal(points)
    return centre, vectors[:, -1], float(np.sqrt(max(np.sum(values[:-1]), 0.0)))


POSE_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")


def pose_array(transform):
    """Top three rows of a transform's matrix, shape (..., 3, 4): the form the solvers
    move about.
    """
    return transform.as_matrix()[..., :3, :].copy()


def pose_transform(pose, proper=False):
    """The `RigidTransform` (one, or a stack) of a pose array, shape (..., 3, 4); `proper` ones hold
    exact rotations.
    """
    whole = np.zeros((*pose.shape[:-2], 4, 4))
    whole[..., :3, :] = pose
    whole[..., 3, 3] = 1.0
    return RigidTransform(
        whole, normalize=not proper, copy=False
    )  # much faster than from components


def exp_rotation(w):
    """Rotation matrices of rotation vectors, shape (..., 3) -> (..., 3, 3)."""
    return Rotation.from_rotvec(w).as_matrix()


def log_rotation(R):
    """Rotation vectors of rotation matrices, shape (..., 3, 3) -> (..., 3); they are taken to be
    exact.
    """
    if R.ndim == 2:
        return Rotation.from_matrix(R, assume_valid=True).as_rotvec()
    x = R[..., 2, 1] - R[..., 1, 2]
    y = R[..., 0, 2] - R[..., 2, 0]
    z = R[..., 1, 0] - R[..., 0, 1]
    twice_sine = np.sqrt(x * x + y * y + z * z)
    twice_cosine = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1
    angle_by_sine = np.arctan2(twice_sine, twice_cosine) / np.maximum(twice_sine, 1e-12)
    turn = np.where(twice_sine > 1e-12, angle_by_sine, 0.5)
    w = np.stack([x, y, z], axis=-1) * turn[..., None]
    near_half_turn = twice_cosine < -1.8  # the sine says little there
    if near_half_turn.any():
        w[near_half_turn] = Rotation.from_matrix(R[near_half_turn], assume_valid=True).as_rotvec()
    return w


def pose_parameters(pose):
    """Rotation vector and translation of pose arrays, shape (..., 6), in the order of
    `POSE_NAMES`.
    """
    return np.concatenate([log_rotation(pose[..., :3]), pose[..., 3]], axis=-1)


def move_pose(pose, delta):
    """Small change of poses (..., 3, 4): ``R <- exp(w) R``, ``t <- t + v`` with ``delta = [w, v]``
    (..., 6).

    Radians and metres, in the destination frame.
    """
    turned = exp_rotation(delta[..., :3]) @ pose[..., :3]
    return np.concatenate([turned, (pose[..., 3] + delta[..., 3:6])[..., None]], axis=-1)


def rotate_points(pose, points):
    """``R p`` of points (..., n, 3) or (n, 3) under poses (..., 3, 4), shape (..., n, 3)."""
    return points @ np.swapaxes(pose[..., :3], -1, -2)


def apply_pose(pose, points):
    """``R p + t`` of points (..., n, 3) or (n, 3) under poses (..., 3, 4), shape (..., n, 3)."""
    return rotate_points(pose, points) + pose[..., None, :, 3]


def gradient_by_pose(rotated, gradient):
    """Jacobian rows (..., n, 6) by ``[w, v]`` of scalars with gradient ``a`` (..., n, 3) by the
    moved point.

    ``a . (w x R p) + a . v = [R p x a, a] . [w, v]``; `rotated` is ``R p``, without the
    translation.
    """
    return np.concatenate([cross(rotated, gradient), gradient], axis=-1)


def noise_correction(rotated, point, gradient, shift, factor, pinhole=True):
    """What errors in the points take from Jacobian rows by the pose: ``factor`` times half the
    change of the variance.

    `rotated` and `point` are ``R p`` and ``R p + t``, `gradient` that of a scalar by the moved
    point, ``l . pinhole(q)`` or, with `pinhole` False, ``m . q``, `shift` (:func:`moved_noise`) the
    direction in which the noise pulls the point, `factor` (..., n) the weighted residual.
    """
    by_turn = cross(shift, gradient)
    by_shift = np.zeros_like(by_turn)
    if pinhole:  # the gradient itself changes with the depth
        depth = point[..., 2:]
        by_shift = -gradient * shift[..., 2:] / depth
        by_shift[..., 2] -= np.vecdot(gradient, shift) / depth[..., 0]
        by_turn = by_turn + cross(rotated, by_shift)
    return factor[..., None] * np.concatenate([by_turn, by_shift], axis=-1)


def moved_noise(pose, gradient, covariance):
    """``R C R^T a`` of source-frame covariances and gradients by the moved point, shape (..., n,
    3).
    """
    in_source = gradient @ pose[..., :3]
    pulled = (in_source[..., None, :] @ covariance)[..., 0, :]
    return rotate_points(pose, pulled)


def axis_words(direction):
    """A direction in words: the name of an axis within 8 degrees, otherwise its components."""
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    largest = int(np.argmax(np.abs(direction)))
    direction = direction * np.sign(direction[largest])
    if direction[largest] > np.cos(np.radians(8)):
        return "xyz"[largest]
    return "({:.2f}, {:.2f}, {:.2f})".format(*(direction + 0.0))


def motion_words(delta, frame):
    """Name a small motion ``[w, v]`` by its direction, e.g. ``translation along x of the left
    frame``.
    """
    w = np.asarray(delta[:3], float)
    v = np.asarray(delta[3:6], float)
    turn = np.linalg.norm(w)
    shift = np.linalg.norm(v)
    if turn < 0.02 * shift:
        return f"translation along {axis_words(v)} of the {frame} frame"
    words = f"rotation about {axis_words(w)} of the {frame} frame"
    if shift < 0.02 * turn:
        return words
    return f"{words} with translation along {axis_words(v)}"


def point_set(positions, point, distance, tolerance):
    """Positions (..., 3) that a point at a measured distance allows: a spherical shell around it,
    figure 3 (a).
    """
    away = np.linalg.norm(np.asarray(positions, float) - point, axis=-1)
    return np.abs(away - distance) <= tolerance


def line_set(positions, point, direction, distance, tolerance):
    """Positions (..., 3) that a line with one hit point at a measured distance allows: a cylinder,
    figure 3 (b).

    Which point of the line (through `point`, with unit `direction`) was hit is not known.
    """
    away = np.linalg.norm(np.cross(np.asarray(positions, float) - point, direction), axis=-1)
    return away <= distance + tolerance


def plane_set(positions, point, normal, distance, tolerance):
    """Positions (..., 3) that a plane with one hit point at a measured distance allows: a slab,
    figure 3 (c).

    The unit `normal` points towards the sensor.
    """
    height = (np.asarray(positions, float) - point) @ np.asarray(normal, float)
    return (height >= -tolerance) & (height <= distance + tolerance)


def shell_volume(distance, tolerance):
    """Volume of a spherical shell of half thickness `tolerance`, cubic metres."""
    return 4 / 3 * np.pi * ((distance + tolerance) ** 3 - max(distance - tolerance, 0.0) ** 3)


def crossing_volume(radius, angle):
    """Volume common to two cylinders of equal radius whose axes meet at an angle (radians), cubic
    metres.

    ``16 r^3 / (3 sin angle)``: smallest for perpendicular axes, infinite for parallel ones.
    """
    sine = np.abs(np.sin(np.asarray(angle, float)))
    with np.errstate(divide="ignore"):
        return np.where(sine > 1e-15, 16 * radius**3 / 3 / sine, np.inf)


def ball(radius, count, rng):
    """Positions drawn evenly from a ball around the origin, shape (count, 3), metres."""
    positions = rng.normal(size=(count, 3))
    positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    return radius * positions * np.cbrt(rng.uniform(size=(count, 1)))


def triangle_angle(ab, ac, bc):
    """Angle at A of a triangle with the given sides, radians (law of cosines)."""
    cosine = (ab**2 + ac**2 - bc**2) / (2 * ab * ac)
    if abs(cosine) > 1:
        raise ValueError(
            f"sides {ab}, {ac} and {bc} make no triangle: "
            "each must be shorter than the sum of the others"
        )
    return float(np.arccos(cosine))
