"""How well a calibrated rig knows where a beam ends: in the cloud, and in the pixels of its images.

What counts is relative to the head at the pitch of the image: a point measured at that pitch owes
nothing to the axis.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.calibrate.rig_uncertainty import COLUMNS, columns_of
from lrfcal_lib.fit.axis_chart import AXIS_COLUMNS
from lrfcal_lib.model.camera import CameraModel, project_jacobians, undistort
from lrfcal_lib.model.geometry import (
    POSE_NAMES,
    gradient_by_pose,
    length_of,
    polar_to_points,
    tilt,
    unit_vector,
)
from lrfcal_lib.model.kinematics import TILT_AXIS, beams_to
from lrfcal_lib.preprocess.prepared import PitchNoise

# a motion that moves a point less than this, relative to all others, does not matter to it
SEEN = 1e-3
ROUNDS = 12  # of the search for the beam that ends in a pixel


@dataclass(frozen=True)
class Chain:
    """From a beam to the frame of an image, and how well each link is known.

    Attributes
    ----------
    head : RigidTransform
        ``T_head_lrf``.
    camera : RigidTransform or None
        ``T_camera_lrf`` of a camera on the head, or ``T_camera_platform``; None for points of the
        cloud.
    on_head : bool
    covariances : ndarray, shape (n, 13, 13)
        Of `COLUMNS` (increments ``[w, v]`` of the transforms). Where there are several, the one
        that gives more counts, quantity by quantity.
    links : ndarray, shape (13, c)
        Which of the rig's shared unknowns each of `COLUMNS` is: ones, a row of zeros where none.
    unseen : ndarray, shape (m, 13)
        Motions that nothing determines: what depends on them has no bound.
    sweep : PitchNoise
        Of the offset and the stretch that the pitch of every sweep has of its own.
    """

    head: RigidTransform
    camera: RigidTransform | None
    on_head: bool
    covariances: np.ndarray
    links: np.ndarray
    unseen: np.ndarray
    sweep: PitchNoise


def chain_of(rig: CalibratedRig, camera: str | None = None, doubt: float = 0.0) -> Chain:
    """The chain of a calibrated rig to a camera, or to points of the cloud.

    Parameters
    ----------
    rig
    camera
        Its name; None for points of the cloud.
    doubt
        By how much all ranges may be wrong beside what is known, metres.

    Raises
    ------
    ValueError
        Where nothing says how well the rig is known.
    """
    known = rig.known
    count = len(known.names)
    links = np.eye(count + 1, count)[columns_of(known.names, camera)]
    both = [known.covariance, known.trusted]
    # zero for what is known; what has no bound is among `unseen`
    bounded = np.nan_to_num(both, posinf=0.0, neginf=0.0)
    # boards of a wrong size stand elsewhere before the cameras: the range offset or the cameras'
    # places have taken it up
    taken_up = np.isin(COLUMNS, ["range_offset", *POSE_NAMES[3:]])
    covariances = links @ bounded @ links.T + np.diag(doubt**2 * taken_up)

    on_head = True
    pose = None
    unseen = known.unseen_of_cloud
    if camera is not None:
        on_head = rig.cameras[camera].mount == "head"
        pose = rig.cameras[camera].T_camera
        unseen = known.unseen_of_cameras[camera]
    return Chain(
        head=rig.T_head_lrf,
        camera=pose,
        on_head=on_head,
        covariances=covariances,
        links=links,
        unseen=unseen,
        sweep=PitchNoise(*known.sweep_sigma),
    )


def projection_sigma(
    chain: Chain,
    model: CameraModel,
    distance: float,
    grid: tuple[int, int],
    *,
    image_pitch: float,
    pitches: tuple[float, float],
) -> np.ndarray:
    """How far off the pixel of an LRF point may be, over the image.

    Every point is measured at its own pitch, the image at `image_pitch`. For a camera on the head
    the tilt axis matters the more, the farther the two are apart.

    Parameters
    ----------
    chain
        To the camera.
    model
    distance : float
        From the LRF, metres.
    grid
        Columns and rows, see :func:`pixel_grid`.
    image_pitch
        Radians.
    pitches
        First and last pitch of the sweeps, radians. A sweep's own stretch acts about their middle
        (cameras on the base).

    Returns
    -------
    ndarray, shape (rows, columns)
        Root mean square distance from the true pixel; inf where a motion that matters is not
        determined, NaN where no scan reaches.
    """
    bearing, pitch = beams_of_pixels(
        chain, model, pixel_grid(model, grid), distance, image_pitch
    )
    points, by_link, by_pitch = carried(chain, bearing, pitch, distance, image_pitch)
    P = project_jacobians(points, model)[0]
    sigma_pitch = chain.sweep.sigma(pitch, sum(pitches) / 2)
    if chain.on_head:  # the offset is that of the image, too
        sigma_pitch = chain.sweep.stretch * (pitch - image_pitch)
    by_sweep = sigma_pitch * length_of(np.matvec(P, by_pitch))
    sigma = np.hypot(spread(chain, P @ by_link), by_sweep)
    low, high = pitches
    return np.where((pitch >= low) & (pitch <= high), sigma, np.nan)


def pixel_grid(model: CameraModel, grid: tuple[int, int]) -> np.ndarray:
    """Middles of the cells that columns and rows cut an image into, (rows, columns, 2), pixels."""
    return (np.indices(grid).T + 0.5) * model.size / grid - 0.5


def point_sigma(
    chain: Chain,
    bearings: np.ndarray,
    pitches: np.ndarray,
    distance: float,
    *,
    reference: float,
) -> np.ndarray:
    """How far off a reconstructed point may be, over the field of view.

    Relative to the head at the pitch `reference`: a turn of the whole cloud does not count. Errors
    of single sweeps do: they shift sweeps against each other. The range noise of single points is
    no part of it.

    Parameters
    ----------
    chain
        To the cloud.
    bearings, pitches : ndarray, shapes (c,), (r,)
        Radians.
    distance : float
        Metres.
    reference
        Radians.

    Returns
    -------
    ndarray, shape (r, c)
        Metres; inf where a motion that matters is not determined.
    """
    pitch = pitches[:, None]
    _, by_link, by_pitch = carried(chain, bearings, pitch, distance, reference)
    by_sweep = chain.sweep.sigma(pitch, reference) * length_of(by_pitch)
    return np.hypot(spread(chain, by_link), by_sweep)


def root_mean_square(sigma: np.ndarray) -> float:
    """Of what scans reach (no NaN); inf where they reach nothing."""
    reached = sigma[~np.isnan(sigma)]
    return np.sqrt(np.mean(reached**2)) if reached.size else np.inf


def carried(
    chain: Chain,
    bearing: ArrayLike,
    pitch: ArrayLike,
    distance: ArrayLike,
    image_pitch: float | np.ndarray = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends of beams in the frame of an image, and what moves them.

    Parameters
    ----------
    chain
    bearing, pitch, distance : array_like, shape (...)
        Of the beams: radians, and metres from the mirror.
    image_pitch
        Of a camera on the head, radians.

    Returns
    -------
    ndarray, shape (..., 3)
        Points in the camera frame (without a camera the LRF frame of a scan at `image_pitch`),
        metres.
    ndarray, shape (..., 3, 13)
        Their derivatives by `COLUMNS`.
    ndarray, shape (..., 3)
        Their derivatives by the pitch of the beam.
    """
    bearing, pitch, distance = np.broadcast_arrays(bearing, pitch, distance)
    t = chain.head.translation
    # where it is 1, points go back through the axis to the head at the image
    back = chain.on_head
    turn = pitch - back * image_pitch
    beam = chain.head.rotation.apply(polar_to_points(1.0, bearing))
    p_head = distance[..., None] * beam
    x = tilt(p_head + t, turn)
    M = tilt(np.eye(3), turn[..., None]).mT
    # a turn of the head about x and a shift along it change nothing
    by_axis = (M @ by_pose(p_head) - back * by_pose(x - t))[..., AXIS_COLUMNS]
    by_pitch = np.cross(TILT_AXIS, x)
    by_scale = turn[..., None] * by_pitch
    by_sensor = np.stack([-tilt(beam, turn), by_scale, (1 - back) * by_pitch], axis=-1)

    last = chain.head.inv() if back else RigidTransform.identity()
    by_camera = np.zeros((*x.shape, 6))
    if chain.camera is not None:
        last = chain.camera * last
        by_camera = by_pose(last.apply(x) - chain.camera.translation)
    A = last.rotation.as_matrix()
    by_link = np.concatenate([A @ by_axis, by_camera, A @ by_sensor], axis=-1)
    return last.apply(x), by_link, by_pitch @ A.T


def by_pose(rotated):
    """Derivatives (..., 3, 6) of points by ``[w, v]`` of the pose that rotated them (..., 3)."""
    axes = np.broadcast_to(np.eye(3), (*rotated.shape, 3))
    return gradient_by_pose(rotated[..., None, :], axes)


def spread(chain: Chain, jacobian: np.ndarray) -> np.ndarray:
    """Root mean square error of quantities that the links of a chain move.

    Parameters
    ----------
    chain
    jacobian : ndarray, shape (..., m, 13)
        Of m quantities by `COLUMNS`.

    Returns
    -------
    ndarray, shape (...)
        Of all m together, in their unit; inf where an undetermined motion matters.
    """
    variance = np.einsum("...ik,nkl,...il->n...", jacobian, chain.covariances, jacobian)
    moved = chain.unseen @ jacobian.mT
    size = np.linalg.norm(jacobian, axis=(-2, -1))[..., None]
    least = SEEN * size * length_of(chain.unseen)
    matters = length_of(moved) > least
    sigma = np.sqrt(variance.max(axis=0, initial=0.0))
    return np.where(np.any(matters, axis=-1), np.inf, sigma)


def beams_of_pixels(chain, model, uv, distance, image_pitch):
    """Bearing and pitch of beams of a given length that end on the rays of pixels (..., 2)."""
    ray = unit_vector(model.sights(undistort(uv, model)))
    depth = np.asarray(distance)
    for _ in range(ROUNDS):
        x = chain.camera.inv().apply(depth[..., None] * ray)
        if chain.on_head:
            x = chain.head.apply(x)
        bearing, pitch, reached = beams_to(x, chain.head)
        depth = depth + distance - reached
    return bearing, pitch + chain.on_head * image_pitch
