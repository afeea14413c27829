"""How well a calibrated rig knows where a beam ends: in the cloud, and in the pixels of its images.

What counts is relative to the head at the pitch of the image: a point measured at that pitch owes
nothing to the axis.
"""

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.fit.least_squares import null_space, reduced_hessian
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.model.camera import project_jacobians, undistort
from lrfcal_lib.model.geometry import (
    POSE_NAMES,
    hat,
    polar_to_points,
    pose_array,
    pose_transform,
    tilt,
)
from lrfcal_lib.solvers.joint import SCALES, UNSEEN

COLUMNS = (*AXIS_NAMES, *POSE_NAMES, "range_offset", "pitch_scale", "pitch_by_direction")
PARTS = {
    "axis": range(4),
    "camera": range(4, 10),
    "range offset": range(10, 11),
    "pitch": range(11, 13),
}
# a motion that moves a point less than this, relative to all others, does not matter to it
SEEN = 1e-3
ROUNDS = 12  # of the search for the beam that ends in a pixel


@dataclass(frozen=True)
class Chain:
    """From a beam to the frame of an image, and how well each link is known.

    `head` is ``T_head_lrf`` (3, 4); `camera` ``T_camera_lrf`` of a camera on the head, or
    ``T_camera_platform``, None for points of the cloud. `covariances`, each (13, 13), are those of
    `COLUMNS` (increments ``[w, v]`` of the transforms; metres; fraction; radians): where there are
    several, the one that gives more counts, quantity by quantity. `unseen` (m, 13) are motions that
    nothing determines: what depends on them has no bound. `sweep_sigma`: offset (radians) and
    stretch of the pitch that every sweep has of its own.
    """

    head: np.ndarray
    camera: np.ndarray | None
    on_head: bool
    covariances: tuple
    unseen: np.ndarray
    sweep_sigma: tuple = (0.0, 0.0)


@dataclass(frozen=True)
class SigmaMap:
    """Standard deviations over an image or a field of view.

    Attributes
    ----------
    columns : ndarray, shape (c,)
        Pixels u, or bearings (radians).
    rows : ndarray, shape (r,)
        Pixels v, or pitch angles (radians).
    distances : ndarray, shape (d,)
        Metres.
    sigma : ndarray, shape (d, r, c)
        Root mean square distance from the true place, pixels or metres; inf where a motion that
        matters is not determined, NaN where no scan reaches.
    parts : dict of str to ndarray, shape (d, r, c)
        The same with only some links uncertain: 'axis', 'camera', 'range offset', 'pitch', 'sweep',
        and for points 'range noise', which `sigma` does not contain. Errors of axis and camera may
        compensate: parts larger than the whole are no contradiction.
    """

    columns: np.ndarray
    rows: np.ndarray
    distances: np.ndarray
    sigma: np.ndarray
    parts: dict

    def rms(self):
        """Root mean square over what scans reach, shape (d,); inf where they reach nothing."""
        number = np.sum(~np.isnan(self.sigma), axis=(1, 2))
        mean = np.nansum(self.sigma**2, axis=(1, 2)) / np.maximum(number, 1)
        return np.where(number > 0, np.sqrt(mean), np.inf)


def information(solution):
    """What every placement says about the shared unknowns at the noise that the solution
    reports, shape (p, c, c).
    """
    J = solution.solution.jacobian
    return (
        reduced_hessian(np.swapaxes(J, -1, -2) @ J, solution.unknowns.shared)
        / solution.solution.inflation
    )


def marginal(hessian, index):
    """Information on some unknowns with the others eliminated, shape (k, k)."""
    order = np.concatenate([index, np.setdiff1d(np.arange(len(hessian)), index)]).astype(int)
    return reduced_hessian(hessian[np.ix_(order, order)][None], len(index))[0]


def chain_of(solution, camera=None):
    """The chain of a joint solution to a camera, or to points of the cloud.

    A ValueError if there is no such camera.
    """
    if camera is not None and camera not in solution.transforms:
        raise ValueError(f"cameras are {', '.join(solution.transforms) or 'none'}; got '{camera}'")
    found = solution.solution
    unknowns = solution.unknowns
    sweep = solution.data.sweep_sigma
    wanted = [*AXIS_NAMES, *(f"{camera}_{name}" for name in POSE_NAMES), *COLUMNS[10:]]
    index = np.array([found.names.index(name) if name in found.names else -1 for name in wanted])
    known = index >= 0
    # zero for what is known; what has no bound is among `unseen`
    both = (C[np.ix_(index, index)] for C in (found.covariance, found.trusted))
    covariances = tuple(np.where(np.outer(known, known) & np.isfinite(C), C, 0.0) for C in both)
    # What stays open beside the links leaves no trace: cameras that planes fix are known, whatever
    # the edge bias.
    scales = np.array([SCALES.get(name, 1.0) for name in found.names])
    own = marginal(information(solution).sum(axis=0) * scales[:, None] * scales, index[known])
    motions = null_space(own, np.ones(len(own)), UNSEEN)[0] * scales[index[known]]
    unseen = np.zeros((len(motions), len(wanted)))
    unseen[:, known] = motions
    on_head = (
        camera is None
        or solution.observations.mounts[list(solution.transforms).index(camera)] == "head"
    )
    pose = None if camera is None else pose_array(solution.transforms[camera])
    sweep_sigma = (
        sweep[0] * (unknowns.sweep != "none"),
        sweep[1] * (unknowns.sweep == "offset_stretch"),
    )
    return Chain(pose_array(solution.T_head_lrf), pose, on_head, covariances, unseen, sweep_sigma)


def carried(chain, bearing, pitch, distance, image_pitch=0.0):
    """Ends of beams in the frame of an image, and what moves them.

    Of beams with bearing, pitch (radians) and distance from the mirror (metres), and for an image
    of a camera on the head at `image_pitch`: points (..., 3) in the camera frame (without a camera
    the LRF frame of a scan at that pitch), metres, and their derivatives by `COLUMNS` (..., 3, 13)
    and by the pitch of the beam (..., 3).
    """
    bearing, pitch, distance = np.broadcast_arrays(
        *(np.asarray(a, float) for a in (bearing, pitch, distance))
    )
    R = chain.head[:, :3]
    t = chain.head[:, 3]
    turn = pitch - image_pitch if chain.on_head else pitch
    d_head = polar_to_points(np.ones_like(distance), bearing) @ R.T
    p = distance[..., None] * d_head
    x = tilt(p + t, turn)
    M = np.swapaxes(tilt(np.broadcast_to(np.eye(3), turn.shape + (3, 3)), turn[..., None]), -1, -2)
    back = float(chain.on_head)
    by_axis = np.concatenate([back * hat(x - t) - M @ hat(p), M - back * np.eye(3)], axis=-1)[
        ..., [1, 2, 4, 5]
    ]
    by_range = -tilt(d_head, turn)[..., None]
    by_turn = np.cross([1.0, 0.0, 0.0], x)[..., None]
    pitches = np.concatenate([by_turn * turn[..., None, None], (1 - back) * by_turn], axis=-1)
    A = R.T if chain.on_head else np.eye(3)
    points = (x - back * t) @ A.T
    C = np.eye(3) if chain.camera is None else chain.camera[:, :3]
    points = points @ C.T
    A = C @ A
    own = np.concatenate([-hat(points), np.broadcast_to(np.eye(3), points.shape + (3,))], axis=-1)
    own = own * (chain.camera is not None)
    points = points if chain.camera is None else points + chain.camera[:, 3]
    return (
        points,
        np.concatenate([A @ by_axis, own, A @ by_range, A @ pitches], axis=-1),
        (A @ by_turn)[..., 0],
    )


def spread(chain, jacobian):
    """Root mean square error of quantities with a Jacobian (..., m, 13).

    Inf where an undetermined motion matters.
    """
    variances = [np.einsum("...ik,kl,...il->...", jacobian, C, jacobian) for C in chain.covariances]
    out = np.sqrt(np.maximum(np.max(variances, axis=0), 0.0))
    pull = np.linalg.norm(np.einsum("...ik,mk->...mi", jacobian, chain.unseen), axis=-1)
    size = np.linalg.norm(jacobian, axis=(-2, -1))[..., None] * np.linalg.norm(
        chain.unseen, axis=-1
    )
    return np.where(np.any(pull > SEEN * size, axis=-1), np.inf, out)


def beams_to(points, T_head_lrf):
    """Bearing, pitch (radians) and range (metres) at which scans of a pitching LRF reach points of
    the platform frame.

    Shapes (...) for points (..., 3); NaN where the scan plane never gets there.
    """
    points = np.asarray(points, float)
    R = T_head_lrf.rotation.as_matrix()
    t = T_head_lrf.translation
    k = R[:, 2]  # normal of the scan plane: k . (Rx(-pitch) x - t) = 0
    y = points[..., 1]
    z = points[..., 2]
    a = k[1] * y + k[2] * z
    b = k[1] * z - k[2] * y
    c = k @ t - k[0] * points[..., 0]
    with np.errstate(invalid="ignore"):
        pitch = np.arctan2(b, a) + np.arccos(c / np.hypot(a, b))
    pitch = (pitch + np.pi) % (2 * np.pi) - np.pi
    p = (tilt(points, -pitch) - t) @ R
    return np.arctan2(p[..., 1], p[..., 0]), pitch, np.linalg.norm(p, axis=-1)


def beams_of_pixels(chain, model, uv, distance, image_pitch):
    """Bearing and pitch of beams of a given length that end on the rays of pixels, shape (...,
    2).
    """
    normal = (undistort(uv, model) - [model.cx, model.cy]) / [model.fx, model.fy]
    ray = np.concatenate([normal, np.ones_like(normal[..., :1])], axis=-1)
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    depth = distance * np.ones(ray.shape[:-1])
    for _ in range(ROUNDS):
        x = (depth[..., None] * ray - chain.camera[:, 3]) @ chain.camera[:, :3]
        if chain.on_head:
            x = x @ chain.head[:, :3].T + chain.head[:, 3]
        bearing, pitch, reached = beams_to(x, pose_transform(chain.head))
        depth = depth + distance - reached
    return bearing, pitch + (image_pitch if chain.on_head else 0.0)


def _sigma_map(chain, axes, jacobian, by_pitch, turn, offset):
    """Standard deviations from Jacobians (d, r, c, m, 13) and by the pitch (d, r, c, m) of beams
    `turn` off the middle.

    `offset` says whether the offset that the pitch of every sweep has of its own matters.
    """
    links = {name: np.isin(range(len(COLUMNS)), columns) for name, columns in PARTS.items()}
    parts = {name: spread(chain, jacobian * link) for name, link in links.items()}
    sweep = np.hypot(offset * chain.sweep_sigma[0], chain.sweep_sigma[1] * turn) * np.linalg.norm(
        by_pitch, axis=-1
    )
    return SigmaMap(*axes, np.hypot(spread(chain, jacobian), sweep), parts | {"sweep": sweep})


def projection_sigma(
    solution, camera, model, distances, grid=(32, 24), *, image_pitch=0.0, pitches=None
):
    """How far off the pixel of an LRF point may be, over the image.

    Every point is measured at its own pitch, the image at `image_pitch`. For a camera on the head
    the tilt axis matters the more, the farther the two are apart.

    Parameters
    ----------
    solution : JointSolution or Chain
    camera : str
        Ignored for a Chain.
    model : CameraModel
    distances : array_like, shape (d,)
        From the LRF, metres.
    grid : tuple of int
        Columns and rows of the map.
    image_pitch : float
        Radians.
    pitches : tuple of float, optional
        First and last pitch of the sweeps, radians: pixels that they do not reach stay NaN. A
        sweep's own stretch acts about their middle (cameras on the base).

    Returns
    -------
    SigmaMap
        Pixels.
    """
    chain, distances = _asked(solution, camera, distances)
    u, v = (
        (np.arange(n) + 0.5) * size / n - 0.5
        for n, size in zip(grid, (model.width, model.height), strict=True)
    )
    away = distances[:, None, None]
    bearing, pitch = beams_of_pixels(
        chain, model, np.stack(np.meshgrid(u, v), axis=-1), away, image_pitch
    )
    points, J, by_pitch = carried(chain, bearing, pitch, away, image_pitch)
    P = project_jacobians(points, model)[0]
    low, high = (-np.inf, np.inf) if pitches is None else pitches
    turn = pitch - (image_pitch if chain.on_head or pitches is None else np.mean(pitches))
    by_pitch = (P @ by_pitch[..., None])[..., 0]
    found = _sigma_map(chain, (u, v, distances), P @ J, by_pitch, turn, not chain.on_head)
    return replace(found, sigma=np.where((pitch >= low) & (pitch <= high), found.sigma, np.nan))


def point_sigma(solution, bearings, pitches, distances, *, reference=0.0):
    """How far off a reconstructed point may be, over the field of view.

    Relative to the head at the pitch `reference`: a turn of the whole cloud does not count. Errors
    of single sweeps do: they shift sweeps against each other.

    Parameters
    ----------
    solution : JointSolution or Chain
    bearings, pitches, distances : array_like, shapes (c,), (r,), (d,)
        Radians, radians, metres.
    reference : float
        Radians.

    Returns
    -------
    SigmaMap
        Metres. `sigma` is the calibration's part, common to all points near each other;
        ``parts['range noise']`` is that of every single point.
    """
    chain, distances = _asked(solution, None, distances)
    bearings = np.atleast_1d(bearings).astype(float)
    pitches = np.atleast_1d(pitches).astype(float)
    _, J, by_pitch = carried(chain, bearings, pitches[:, None], distances[:, None, None], reference)
    found = _sigma_map(
        chain, (bearings, pitches, distances), J, by_pitch, (pitches - reference)[:, None], True
    )
    noise = np.full(found.sigma.shape, range_noise(solution))
    return replace(found, parts=found.parts | {"range noise": noise})


def range_noise(solution):
    """Standard deviation of one range as the solution found or took it, metres (0 for a Chain)."""
    sigma = () if isinstance(solution, Chain) else solution.observations.face_sigma
    return float(np.median(sigma) * solution.noise["face_scale"]) if len(sigma) else 0.0


def _asked(solution, camera, distances):
    """The chain of a solution (or the Chain given) and distances as an array."""
    distances = np.atleast_1d(np.asarray(distances, float))
    if not (np.isfinite(distances).all() and distances.min() > 0):
        raise ValueError(f"distances must be positive, metres; got {distances.tolist()}")
    return solution if isinstance(solution, Chain) else chain_of(solution, camera), distances
