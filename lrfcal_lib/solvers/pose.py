"""Poses as arrays, so that a thousand trials move at once; and motions in words."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

POSE_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")


def pose_array(transform):
    """Top three rows of a transform's matrix, shape (..., 3, 4): the form the solvers move about."""
    return transform.as_matrix()[..., :3, :].copy()


def pose_transform(pose):
    """The `RigidTransform` (one, or a stack) of a pose array, shape (..., 3, 4)."""
    return RigidTransform.from_components(pose[..., 3], Rotation.from_matrix(pose[..., :3]))


def pose_parameters(pose):
    """Rotation vector and translation of pose arrays, shape (..., 6), in the order of `POSE_NAMES`."""
    flat = pose.reshape(-1, 3, 4)
    rotvec = Rotation.from_matrix(flat[:, :, :3]).as_rotvec()
    return np.concatenate([rotvec, flat[:, :, 3]], axis=1).reshape(pose.shape[:-2] + (6,))


def exp_rotation(w):
    """Rotation matrices of rotation vectors, shape (..., 3) -> (..., 3, 3)."""
    w = np.asarray(w, float)
    return Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(w.shape[:-1] + (3, 3))


def move_pose(pose, delta):
    """Small change of poses: ``R <- exp(w) R``, ``t <- t + v`` with ``delta = [w, v]``.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
    delta : ndarray, shape (..., 6)
        Radians and metres, in the destination frame.

    Returns
    -------
    ndarray, shape (..., 3, 4)
    """
    turned = exp_rotation(delta[..., :3]) @ pose[..., :3]
    return np.concatenate([turned, (pose[..., 3] + delta[..., 3:6])[..., None]], axis=-1)


def rotate_points(pose, points):
    """``R p`` of points (..., n, 3) or (n, 3) under poses (..., 3, 4), shape (..., n, 3)."""
    return points @ np.swapaxes(pose[..., :3], -1, -2)


def apply_pose(pose, points):
    """``R p + t`` of points (..., n, 3) or (n, 3) under poses (..., 3, 4), shape (..., n, 3)."""
    return rotate_points(pose, points) + pose[..., None, :, 3]


def cross(a, b):
    """Cross product along the last axis; several times faster than `numpy.cross` on stacks."""
    x = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    y = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    z = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.stack([x, y, z], axis=-1)


def gradient_by_pose(rotated, gradient):
    """Jacobian rows by ``[w, v]`` of scalars with gradient `gradient` by the moved point.

    Parameters
    ----------
    rotated : ndarray, shape (..., n, 3)
        ``R p`` (without the translation).
    gradient : ndarray, shape (..., n, 3)

    Returns
    -------
    ndarray, shape (..., n, 6)
        ``a . (w x R p) + a . v = [R p x a, a] . [w, v]``.
    """
    return np.concatenate([cross(rotated, gradient), gradient], axis=-1)


def noise_correction(rotated, point, gradient, shift, factor, pinhole=True):
    """What errors in the points take from Jacobian rows by the pose: ``factor`` times half the change of the variance.

    Parameters
    ----------
    rotated, point : ndarray, shape (..., n, 3)
        ``R p`` and ``R p + t``.
    gradient : ndarray, shape (..., n, 3)
        Of a scalar by the moved point: ``l . pinhole(q)`` or, with `pinhole` False, ``m . q``.
    shift : ndarray, shape (..., n, 3)
        ``R C R^T`` times a gradient: the direction in which the noise pulls the point.
    factor : ndarray, shape (..., n)
        Weighted residual.

    Returns
    -------
    ndarray, shape (..., n, 6)
    """
    spun = cross(shift, gradient)
    if not pinhole:
        return factor[..., None] * np.concatenate([spun, np.zeros_like(spun)], axis=-1)
    z = point[..., 2:]
    change = -gradient * shift[..., 2:] / z
    change[..., 2] -= np.sum(gradient * shift, axis=-1) / z[..., 0]
    return factor[..., None] * np.concatenate([spun + cross(rotated, change), change], axis=-1)


def moved_noise(pose, gradient, covariance):
    """``R C R^T a`` of source-frame covariances and gradients by the moved point, shape (..., n, 3)."""
    return ((gradient @ pose[..., :3])[..., None, :] @ covariance)[..., 0, :] @ np.swapaxes(pose[..., :3], -1, -2)


def propagated_variance(pose, gradient, covariance):
    """Variance that a point's covariance (source frame) gives to scalars with the given gradient, shape (..., n)."""
    row = gradient @ pose[..., :3]
    return np.sum((row[..., None, :] @ covariance)[..., 0, :] * row, axis=-1)


def axis_words(direction):
    """A direction in words: the name of an axis within 8 degrees, otherwise its components."""
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    largest = int(np.argmax(np.abs(direction)))
    direction = direction * np.sign(direction[largest])
    if direction[largest] > np.cos(np.radians(8)):
        return "xyz"[largest]
    return "({:.2f}, {:.2f}, {:.2f})".format(*(direction + 0.0))


def motion_words(delta, frame="destination"):
    """Name a small motion of a transform, e.g. ``translation along x of the left frame``.

    Parameters
    ----------
    delta : array_like, shape (6,)
        ``[w, v]``; only its direction counts.
    frame : str
        Destination frame of the transform.

    Returns
    -------
    str
    """
    delta = np.asarray(delta, float)
    w, v = delta[:3], delta[3:6]
    turn, shift = np.linalg.norm(w), np.linalg.norm(v)
    if turn < 0.02 * shift:
        return f"translation along {axis_words(v)} of the {frame} frame"
    words = f"rotation about {axis_words(w)} of the {frame} frame"
    return words if shift < 0.02 * turn else f"{words} with translation along {axis_words(v)}"
