"""Camera from named points (Bauermann et al.): scene points of LRF and camera, reprojected in all frames."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.camera import pinhole_jacobian
from lrfcal_lib.solvers.camera import solve_pose
from lrfcal_lib.solvers.checks import check_count, check_finite
from lrfcal_lib.solvers.least_squares import Block
from lrfcal_lib.solvers.pose import (
    gradient_by_pose,
    noise_correction,
    rotate_points,
)
from lrfcal_lib.solvers.start import starting_transform


def point_block(pose, points, covariance, pixels, sigma_px, model):
    """Reprojection errors of points with covariance.

    Parameters
    ----------
    pose : ndarray, shape (..., 3, 4)
    points : ndarray, shape (..., q, 3)
        Source frame, metres.
    covariance : ndarray, shape (..., q, 3, 3)
    pixels : ndarray, shape (..., q, 2)
        Undistorted pixels.
    sigma_px : ndarray, shape (..., q)
    model : CameraModel

    Returns
    -------
    Block
        2 q residuals in pixels; a loss judges u and v of a point together.
    """
    rotated = rotate_points(pose, points)
    q = rotated + pose[..., None, :, 3]
    by_point = pinhole_jacobian(q, model)
    projected = q[..., :2] / q[..., 2:] * [model.fx, model.fy] + [model.cx, model.cy]
    errors = projected - pixels
    rows = np.stack([gradient_by_pose(rotated, by_point[..., i, :]) for i in range(2)], axis=-2)
    turned = by_point @ pose[..., None, :, :3]
    noise = turned @ covariance @ np.swapaxes(turned, -1, -2) + np.asarray(sigma_px)[..., None, None] ** 2 * np.eye(2)
    whitener = np.linalg.inv(np.linalg.cholesky(noise))
    force = np.linalg.solve(noise, errors[..., None])
    shift = (covariance @ np.swapaxes(turned, -1, -2) @ force)[..., 0] @ np.swapaxes(pose[..., :3], -1, -2)
    one = np.ones(errors.shape[:-1])
    change = [noise_correction(rotated, q, by_point[..., i, :], shift, one) for i in range(2)]
    shape = errors.shape[:-2]
    rows, corrected = (x.reshape(shape + (-1, 6)) for x in (rows, rows - np.stack(change, axis=-2)))
    return Block(errors.reshape(shape + (-1,)), rows, whitener, corrected=corrected)


def solve_bauermann(obs, T0=None, *, loss=None, scale=1.0, max_iterations=60, required=True):
    """The pose of a camera from scene points named in both sensors.

    Parameters
    ----------
    obs : CameraObservations
        Its scene points are used.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``; perspective n points when left out (planes and lines where that fails).
    loss : {None, 'huber', 'cauchy'}
        Robust loss for single points, with `scale` (standard deviations, or 'auto').
    scale : float or 'auto'
    max_iterations : int
    required : bool
        False: report unobservable motions instead of raising.

    Returns
    -------
    Solution

    Raises
    ------
    DegenerateGeometry
        With fewer than three points, or when they lie on one line.
    ValueError
        When an observation is not finite.
    """
    check_finite(obs, "scene")
    check_count(len(obs.scene_points), 3, "scene points", obs.camera)
    T0 = starting_transform(obs, kinds=("scene", "planes", "lines")) if T0 is None else T0
    data = (obs.scene_points, obs.scene_covariance, obs.scene_pixels, obs.scene_sigma_px, obs.model)
    options = {"loss": loss, "scale": scale, "max_iterations": max_iterations, "required": required}
    about = {"camera": obs.camera, "groups": np.repeat(obs.scene_placement, 2), "method": "bauermann"}
    return solve_pose(lambda pose: point_block(pose, *data), T0, **about, **options)
