"""Camera from planes of sight (Wasielewski and Strauss 1995): a hit lies on the plane of camera and edge."""

from __future__ import annotations

import numpy as np

from lrfcal_lib.solvers.camera import solve_pose
from lrfcal_lib.solvers.checks import check_count, check_finite
from lrfcal_lib.solvers.least_squares import Block
from lrfcal_lib.solvers.pose import (
    gradient_by_pose,
    moved_noise,
    noise_correction,
    rotate_points,
)
from lrfcal_lib.solvers.start import sight_block, sight_normals, starting_transform


def solve_wasielewski_strauss(obs, T0=None, *, loss=None, scale=1.0, weighted=False, max_iterations=60, required=True):
    """The pose of a camera from distances, in space, between crossings and planes of sight.

    Parameters
    ----------
    obs : CameraObservations
        Its crossings are used.
    T0 : RigidTransform, optional
        Start value of ``T_camera_source``; see :func:`lrfcal_lib.solvers.start.starting_transform`.
    loss : {None, 'huber', 'cauchy'}
        Robust loss for single crossings, with `scale` (standard deviations, or 'auto').
    scale : float or 'auto'
    weighted : bool
        False, as published: every distance counts the same. True: by the propagated noise; the method is then the same
        as :func:`lrfcal_lib.solvers.camera.solve_lines` to first order, because the two residuals differ by a factor
        (depth / focal length) that the weights take out.
    max_iterations : int
    required : bool
        False: report unobservable motions instead of raising.

    Returns
    -------
    Solution

    Raises
    ------
    DegenerateGeometry
        With fewer than six crossings, or when they leave a motion open.
    ValueError
        When an observation is not finite.
    """
    check_finite(obs, "crossing")
    check_count(len(obs.crossing_points), 6, "crossings of scan lines with edges", obs.camera)
    T0 = starting_transform(obs) if T0 is None else T0
    normals, length = sight_normals(obs.crossing_lines, obs.model)

    def evaluate(pose):
        return distance_block(pose, obs, normals, length)

    options = {"loss": loss, "scale": scale, "max_iterations": max_iterations, "required": required}
    about = {"camera": obs.camera, "groups": obs.crossing_placement, "method": "wasielewski_strauss"}
    return solve_pose(evaluate, T0, weighted=weighted, **about, **options)


def distance_block(pose, obs, normals, length):
    """Distances from the planes of sight, metres, with the noise of point and line.

    Parameters
    ----------
    pose : ndarray, shape (3, 4)
    obs : CameraObservations
    normals, length : ndarray, shapes (n, 3) and (n,)
        From :func:`lrfcal_lib.solvers.start.sight_normals`.

    Returns
    -------
    Block
    """
    plain = sight_block(pose, obs.crossing_points, normals, 1.0)
    rotated = rotate_points(pose, obs.crossing_points)
    q = rotated + pose[:, 3]
    shift = moved_noise(pose, normals, obs.crossing_covariance)
    line = (obs.crossing_line_sigma / length) ** 2 * q[:, 2]
    variance = np.sum(shift * normals, axis=-1) + line * q[:, 2]
    factor = plain.residuals / variance
    deeper = gradient_by_pose(rotated, np.broadcast_to([0.0, 0.0, 1.0], q.shape))
    change = noise_correction(rotated, q, normals, shift, factor, pinhole=False) + (factor * line)[:, None] * deeper
    return Block(plain.residuals, plain.jacobian, 1.0 / np.sqrt(variance), corrected=plain.jacobian - change)
