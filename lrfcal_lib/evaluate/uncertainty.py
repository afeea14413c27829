"""How well a calibrated rig knows where a beam ends: in the cloud, and in the pixels of its images.

A beam at (bearing, pitch, range) is carried through the calibration to the frame of the image, and the covariance of
every link goes with it. What counts is relative to the head at the pitch of the image: a motion of the whole cloud
harms nobody, so a point measured at that very pitch does not depend on the tilt axis at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lrfcal_lib.fit.least_squares import null_space, reduced_hessian
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.model.camera import project_jacobians, undistort
from lrfcal_lib.model.geometry import POSE_NAMES, hat, polar_to_points, pose_array, pose_transform, tilt
from lrfcal_lib.solvers.joint import SCALES, UNSEEN

COLUMNS = (*AXIS_NAMES, *POSE_NAMES, "range_offset", "pitch_scale", "pitch_by_direction")
PARTS = {"axis": slice(0, 4), "camera": slice(4, 10), "range offset": slice(10, 11), "pitch": slice(11, 13)}
SEEN = 1e-3  # a motion that moves a point less than this, relative to all others, does not matter to it
ROUNDS = 12  # of the search for the beam that ends in a pixel


@dataclass(frozen=True)
class Chain:
    """From a beam to the frame of an image, and how well each link is known.

    Attributes
    ----------
    head : ndarray, shape (3, 4)
        ``T_head_lrf``.
    camera : ndarray, shape (3, 4), or None
        ``T_camera_lrf`` (mount 'head') or ``T_camera_platform``; None for points of the cloud.
    mount : {'head', 'platform'}
    covariances : tuple of ndarray, shape (13, 13)
        Of `COLUMNS` (increments ``[w, v]`` of the transforms; metres; fraction; radians). Where there are several, the
        one that gives more counts, quantity by quantity.
    unseen : ndarray, shape (m, 13)
        Motions that nothing determines: what depends on them has no bound.
    sweep_sigma : tuple of float
        Offset (radians) and stretch of the pitch that every sweep has of its own.
    """

    head: np.ndarray
    camera: np.ndarray | None
    mount: str
    covariances: tuple
    unseen: np.ndarray
    sweep_sigma: tuple = (0.0, 0.0)

    @property
    def on_head(self):
        return self.mount == "head"


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
        Root mean square distance from the true place, pixels or metres; inf where a motion that matters is not
        determined, NaN where no scan reaches.
    parts : dict of str to ndarray, shape (d, r, c)
        The same with only some links uncertain: 'axis', 'camera', 'range offset', 'pitch', 'sweep', and for points
        'range noise', which `sigma` does not contain. Errors of axis and camera may compensate: parts larger than the
        whole are no contradiction.
    """

    columns: np.ndarray
    rows: np.ndarray
    distances: np.ndarray
    sigma: np.ndarray
    parts: dict

    def rms(self):
        """Root mean square over what scans reach, shape (d,); inf where they reach nothing."""
        seen = np.isfinite(self.sigma) | np.isinf(self.sigma)
        total = np.sum(np.where(seen, self.sigma, 0.0) ** 2, axis=(1, 2))
        number = seen.sum(axis=(1, 2))
        return np.where(number > 0, np.sqrt(total / np.maximum(number, 1)), np.inf)


def information(solution):
    """What every placement says about the shared unknowns at the noise that the solution reports, shape (p, c, c)."""
    J = solution.solution.jacobian
    return reduced_hessian(np.swapaxes(J, -1, -2) @ J, solution.unknowns.shared) / solution.solution.inflation


def marginal(hessian, index):
    """Information on some unknowns with the others eliminated, shape (k, k)."""
    order = np.concatenate([index, np.setdiff1d(np.arange(len(hessian)), index)]).astype(int)
    return reduced_hessian(hessian[np.ix_(order, order)][None], len(index))[0]


def unseen_motions(solution, index):
    """Directions of some unknowns that the data do not determine, shape (m, k).

    What stays open beside those leaves no trace: cameras that planes fix are known, whatever the edge bias.
    """
    scales = np.array([SCALES.get(name, 1.0) for name in solution.solution.names])
    own = marginal(information(solution).sum(axis=0) * scales[:, None] * scales, index)
    return null_space(own, np.ones(len(index)), UNSEEN)[0] * scales[index]


def chain_of(solution, camera=None, clustered=True):
    """The chain of a joint solution.

    Parameters
    ----------
    solution : JointSolution
    camera : str, optional
        None for points of the cloud.
    clustered : bool
        Also consider the scatter over placements, which contains errors of the model, where it is known.

    Returns
    -------
    Chain

    Raises
    ------
    ValueError
        If there is no such camera.
    """
    if camera is not None and camera not in solution.transforms:
        raise ValueError(f"cameras are {', '.join(solution.transforms) or 'none'}; got '{camera}'")
    found = solution.solution
    prefix = "" if camera is None else f"{camera}_"
    wanted = [*AXIS_NAMES, *(prefix + name for name in POSE_NAMES), *COLUMNS[10:]]
    index = [found.names.index(name) if name in found.names else -1 for name in wanted]
    both = [found.covariance, found.trusted if clustered else None]
    covariances = tuple(_spread_out(C, index) for C in both if C is not None)
    number = list(solution.transforms).index(camera) if camera else 0
    on_head = camera is None or solution.data.on_head[number]
    pose = pose_array(solution.transforms[camera]) if camera else None
    sweep = solution.data.sweep_sigma if solution.unknowns.sweep != "none" else (0.0, 0.0)
    sweep = (sweep[0], sweep[1] * (solution.unknowns.sweep == "offset_stretch"))
    known = np.array(index) >= 0
    motions = unseen_motions(solution, np.array(index)[known])
    unseen = np.zeros((len(motions), len(wanted)))
    unseen[:, known] = motions
    head = pose_array(solution.T_head_lrf)
    return Chain(head, pose, "head" if on_head else "platform", covariances, unseen, sweep)


def _spread_out(covariance, index):
    """Covariance of `COLUMNS` from one of other unknowns; zero for what is known (index -1)."""
    wide = np.zeros((len(covariance) + 1,) * 2)
    wide[:-1, :-1] = np.where(np.isfinite(covariance), covariance, 0.0)  # what has no bound is among the unseen motions
    return wide[np.ix_(index, index)]


def carried(chain, bearing, pitch, distance, image_pitch=0.0):
    """Ends of beams in the frame of an image, and what moves them.

    Parameters
    ----------
    chain : Chain
    bearing, pitch, distance : array_like, shape (...)
        Radians, radians, and metres from the mirror.
    image_pitch : float
        Radians; only for mount 'head'.

    Returns
    -------
    points : ndarray, shape (..., 3)
        Camera frame; without a camera the LRF frame of a scan at `image_pitch`. Metres.
    jacobian : ndarray, shape (..., 3, 13)
        By `COLUMNS`.
    by_pitch : ndarray, shape (..., 3)
        By the pitch of the beam.
    """
    bearing, pitch, distance = np.broadcast_arrays(*(np.asarray(a, float) for a in (bearing, pitch, distance)))
    R, t = chain.head[:, :3], chain.head[:, 3]
    turn = pitch - image_pitch if chain.on_head else pitch
    d_head = polar_to_points(np.ones_like(distance), bearing) @ R.T
    p = distance[..., None] * d_head
    x = tilt(p + t, turn)
    M = np.swapaxes(tilt(np.broadcast_to(np.eye(3), turn.shape + (3, 3)), turn[..., None]), -1, -2)
    back = float(chain.on_head)
    by_axis = np.concatenate([back * hat(x - t) - M @ hat(p), M - back * np.eye(3)], axis=-1)[..., [1, 2, 4, 5]]
    by_range = -tilt(d_head, turn)[..., None]
    by_turn = np.cross([1.0, 0.0, 0.0], x)[..., None]
    pitches = np.concatenate([by_turn * turn[..., None, None], (1 - back) * by_turn], axis=-1)
    A = R.T if chain.on_head else np.eye(3)
    points = (x - back * t) @ A.T
    C = np.eye(3) if chain.camera is None else chain.camera[:, :3]
    points, A = points @ C.T, C @ A
    own = np.concatenate([-hat(points), np.broadcast_to(np.eye(3), points.shape + (3,))], axis=-1)
    own = own * (chain.camera is not None)
    points = points if chain.camera is None else points + chain.camera[:, 3]
    return points, np.concatenate([A @ by_axis, own, A @ by_range, A @ pitches], axis=-1), (A @ by_turn)[..., 0]


def spread(chain, jacobian):
    """Root mean square error of quantities with the given Jacobian.

    Parameters
    ----------
    chain : Chain
    jacobian : ndarray, shape (..., m, 13)

    Returns
    -------
    ndarray, shape (...)
        Root of the trace of the covariance; inf where an undetermined motion matters.
    """
    variances = [np.einsum("...ik,kl,...il->...", jacobian, C, jacobian) for C in chain.covariances]
    out = np.sqrt(np.maximum(np.max(variances, axis=0), 0.0))
    pull = np.linalg.norm(np.einsum("...ik,mk->...mi", jacobian, chain.unseen), axis=-1)
    size = np.linalg.norm(jacobian, axis=(-2, -1))[..., None] * np.linalg.norm(chain.unseen, axis=-1)
    return np.where(np.any(pull > SEEN * size, axis=-1), np.inf, out)


def _parts(chain, jacobian):
    parts = {}
    for name, columns in PARTS.items():
        only = np.zeros_like(jacobian)
        only[..., columns] = jacobian[..., columns]
        parts[name] = spread(chain, only)
    return parts


def _sweep(chain, by_pitch, turn, cancels):
    """What the pitch error that every sweep has of its own does."""
    offset = 0.0 if cancels else chain.sweep_sigma[0]
    return np.hypot(offset, chain.sweep_sigma[1] * turn) * np.linalg.norm(by_pitch, axis=-1)


def beams_to(points, T_head_lrf):
    """Bearing, pitch and range at which scans of a pitching LRF reach points.

    Parameters
    ----------
    points : ndarray, shape (..., 3)
        Platform frame, metres.
    T_head_lrf : RigidTransform

    Returns
    -------
    bearing, pitch, distance : ndarray, shape (...)
        Radians, radians, metres; NaN where the scan plane never gets there.
    """
    points = np.asarray(points, float)
    R, t = T_head_lrf.rotation.as_matrix(), T_head_lrf.translation
    k = R[:, 2]  # normal of the scan plane: k . (Rx(-pitch) x - t) = 0
    y, z = points[..., 1], points[..., 2]
    a, b, c = k[1] * y + k[2] * z, k[1] * z - k[2] * y, k @ t - k[0] * points[..., 0]
    with np.errstate(invalid="ignore"):
        pitch = np.arctan2(b, a) + np.arccos(c / np.hypot(a, b))
    pitch = (pitch + np.pi) % (2 * np.pi) - np.pi
    p = (tilt(points, -pitch) - t) @ R
    return np.arctan2(p[..., 1], p[..., 0]), pitch, np.linalg.norm(p, axis=-1)


def _beams_of_pixels(chain, model, uv, distance, image_pitch):
    """Beams of a given length that end on the rays of pixels."""
    normal = (undistort(uv, model) - [model.cx, model.cy]) / [model.fx, model.fy]
    ray = np.concatenate([normal, np.ones_like(normal[..., :1])], axis=-1)
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    R, t = chain.camera[:, :3], chain.camera[:, 3]
    head, depth = pose_transform(chain.head), np.full(ray.shape[:-1], float(distance))
    for _ in range(ROUNDS):
        x = (depth[..., None] * ray - t) @ R
        if chain.on_head:
            x = x @ chain.head[:, :3].T + chain.head[:, 3]
        bearing, pitch, reached = beams_to(x, head)
        depth = depth + distance - reached
    return bearing, pitch + (image_pitch if chain.on_head else 0.0)


def projection_sigma(
    solution, camera, model, distances, grid=(32, 24), *, image_pitch=0.0, pitches=None, clustered=True
):
    """How far off the pixel of an LRF point may be, over the image.

    Every point is measured at its own pitch, the image at `image_pitch`. For a camera on the head the tilt axis matters
    the more, the farther the two are apart.

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
        First and last pitch of the sweeps, radians: pixels that they do not reach stay NaN. A sweep's own stretch acts
        about their middle (cameras on the base).
    clustered : bool
        See :func:`chain_of`.

    Returns
    -------
    SigmaMap
        Pixels.
    """
    chain = solution if isinstance(solution, Chain) else chain_of(solution, camera, clustered)
    distances = _positive(distances)
    u = (np.arange(grid[0]) + 0.5) * model.width / grid[0] - 0.5
    v = (np.arange(grid[1]) + 0.5) * model.height / grid[1] - 0.5
    uv = np.stack(np.meshgrid(u, v), axis=-1)
    sigma, parts = [], []
    low, high = (-np.inf, np.inf) if pitches is None else pitches
    middle = image_pitch if chain.on_head or pitches is None else np.mean(pitches)
    for distance in distances:
        bearing, pitch = _beams_of_pixels(chain, model, uv, distance, image_pitch)
        points, J, by_pitch = carried(chain, bearing, pitch, distance, image_pitch)
        P = project_jacobians(points, model)[0]
        by_pitch = (P @ by_pitch[..., None])[..., 0]
        parts.append(_parts(chain, P @ J) | {"sweep": _sweep(chain, by_pitch, pitch - middle, chain.on_head)})
        lost = ~((pitch >= low) & (pitch <= high))
        sigma.append(np.where(lost, np.nan, np.hypot(spread(chain, P @ np.nan_to_num(J)), parts[-1]["sweep"])))
    return SigmaMap(u, v, distances, np.array(sigma), {k: np.array([p[k] for p in parts]) for k in parts[0]})


def point_sigma(solution, bearings, pitches, distances, *, sigma_range=None, reference=0.0, clustered=True):
    """How far off a reconstructed point may be, over the field of view.

    Relative to the head at the pitch `reference`: a turn of the whole cloud does not count. Errors of single sweeps do:
    they shift sweeps against each other.

    Parameters
    ----------
    solution : JointSolution or Chain
    bearings, pitches, distances : array_like, shapes (c,), (r,), (d,)
        Radians, radians, metres.
    sigma_range : float, optional
        Noise of one range, metres; as the solution has it when left out.
    reference : float
        Radians.
    clustered : bool
        See :func:`chain_of`.

    Returns
    -------
    SigmaMap
        Metres. `sigma` is the calibration's part, common to all points near each other; ``parts['range noise']`` is
        that of every single point.
    """
    chain = solution if isinstance(solution, Chain) else chain_of(solution, None, clustered)
    bearings, pitches = np.atleast_1d(bearings).astype(float), np.atleast_1d(pitches).astype(float)
    distances = _positive(distances)
    noise = range_noise(solution) if sigma_range is None else sigma_range
    _, J, by_pitch = carried(
        chain, bearings, pitches[:, None], np.broadcast_to(distances[:, None, None], (len(distances), 1, 1)), reference
    )
    turn = np.broadcast_to((pitches - reference)[:, None], J.shape[:-2])
    parts = _parts(chain, J) | {"sweep": _sweep(chain, by_pitch, turn, False)}
    sigma = np.hypot(spread(chain, J), parts["sweep"])
    return SigmaMap(bearings, pitches, distances, sigma, parts | {"range noise": np.full(sigma.shape, noise)})


def range_noise(solution):
    """Standard deviation of one range as the solution found or took it, metres (0 for a Chain)."""
    if isinstance(solution, Chain) or not solution.data.face["used"].any():
        return 0.0
    return float(np.median(solution.data.face["sigma"][solution.data.face["used"]]) * solution.data.face_scale)


def _positive(distances):
    distances = np.atleast_1d(np.asarray(distances, float))
    if not (np.isfinite(distances).all() and distances.min() > 0):
        raise ValueError(f"distances must be positive, metres; got {distances.tolist()}")
    return distances
