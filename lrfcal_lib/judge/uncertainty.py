"""How well a calibrated rig knows where a beam ends: in the cloud, and in the pixels of its images.

What counts is relative to the head at the pitch of the image: a point measured at that pitch owes
nothing to the axis.
"""

from dataclasses import dataclass, replace

import numpy as np

from lrfcal_lib.fit.covariance import null_space
from lrfcal_lib.fit.least_squares import reduced_hessian
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


def marginal(hessian, index):
    """Information on some unknowns with the others eliminated, shape (k, k)."""
    others = np.setdiff1d(np.arange(len(hessian)), index)
    order = np.concatenate([index, others]).astype(int)
    return reduced_hessian(hessian[np.ix_(order, order)][None], len(index))[0]


def chain_of(solution, camera=None):
    """The chain of a joint solution to a camera, or to points of the cloud.

    A ValueError if there is no such camera.
    """
    if camera is not None and camera not in solution.transforms:
        cameras = ", ".join(solution.transforms) or "none"
        raise ValueError(f"cameras are {cameras}; got '{camera}'")
    estimate = solution.solution
    wanted = [*AXIS_NAMES, *(f"{camera}_{name}" for name in POSE_NAMES), *COLUMNS[10:]]
    place = {name: i for i, name in enumerate(estimate.names)}
    index = np.array([place.get(name, -1) for name in wanted])
    known = index >= 0
    covariances = []
    for C in (estimate.covariance, estimate.trusted):
        part = C[np.ix_(index, index)]
        # zero for what is known; what has no bound is among `unseen`
        estimated = np.outer(known, known) & np.isfinite(part)
        covariances.append(np.where(estimated, part, 0.0))
    # What stays open beside the links leaves no trace: cameras that planes fix are known, whatever
    # the edge bias.
    scales = np.array([SCALES.get(name, 1.0) for name in estimate.names])
    scaled = solution.information().sum(axis=0) * scales[:, None] * scales
    hessian = marginal(scaled, index[known])
    motions = null_space(hessian, np.ones(len(hessian)), UNSEEN) * scales[index[known]]
    unseen = np.zeros((len(motions), len(wanted)))
    unseen[:, known] = motions
    on_head = True
    pose = None
    if camera is not None:
        number = list(solution.transforms).index(camera)
        on_head = solution.observations.mounts[number] == "head"
        pose = pose_array(solution.transforms[camera])
    head = pose_array(solution.T_head_lrf)
    return Chain(head, pose, on_head, tuple(covariances), unseen, solution.sweep_sigma)


def carried(chain, bearing, pitch, distance, image_pitch=0.0):
    """Ends of beams in the frame of an image, and what moves them.

    Of beams with bearing, pitch (radians) and distance from the mirror (metres), and for an image
    of a camera on the head at `image_pitch`: points (..., 3) in the camera frame (without a camera
    the LRF frame of a scan at that pitch), metres, and their derivatives by `COLUMNS` (..., 3, 13)
    and by the pitch of the beam (..., 3).
    """
    beams = (np.asarray(values, float) for values in (bearing, pitch, distance))
    bearing, pitch, distance = np.broadcast_arrays(*beams)
    R = chain.head[:, :3]
    t = chain.head[:, 3]
    identity = np.eye(3)
    turn = pitch
    back = 0.0  # 1 where the image is taken from the head: points go back through the axis
    if chain.on_head:
        turn = pitch - image_pitch
        back = 1.0
    d_head = polar_to_points(np.ones_like(distance), bearing) @ R.T
    p = distance[..., None] * d_head
    x = tilt(p + t, turn)
    axes = tilt(np.broadcast_to(identity, turn.shape + (3, 3)), turn[..., None])
    M = np.swapaxes(axes, -1, -2)  # rotation by the turn
    by_rotation = back * hat(x - t) - M @ hat(p)
    by_translation = M - back * identity
    by_head = np.concatenate([by_rotation, by_translation], axis=-1)
    by_axis = by_head[..., [1, 2, 4, 5]]  # a turn about x and a shift along it change nothing
    by_range = -tilt(d_head, turn)[..., None]
    by_turn = np.cross([1.0, 0.0, 0.0], x)[..., None]
    by_scale = by_turn * turn[..., None, None]
    by_direction = (1 - back) * by_turn
    A = identity
    if chain.on_head:
        A = R.T
    points = (x - back * t) @ A.T
    by_camera = np.zeros((*points.shape, 6))
    if chain.camera is not None:
        C = chain.camera[:, :3]
        A = C @ A
        points = points @ C.T
        by_camera[..., :3] = -hat(points)
        by_camera[..., 3:] = identity
        points = points + chain.camera[:, 3]
    columns = [A @ by_axis, by_camera, A @ by_range, A @ by_scale, A @ by_direction]
    return points, np.concatenate(columns, axis=-1), (A @ by_turn)[..., 0]


def spread(chain, jacobian):
    """Root mean square error of quantities with a Jacobian (..., m, 13).

    Inf where an undetermined motion matters.
    """
    variance = 0.0
    for C in chain.covariances:
        by_this = np.einsum("...ik,kl,...il->...", jacobian, C, jacobian)
        variance = np.maximum(variance, by_this)
    moved = np.einsum("...ik,mk->...mi", jacobian, chain.unseen)
    size = np.linalg.norm(jacobian, axis=(-2, -1))[..., None]
    least = SEEN * size * np.linalg.norm(chain.unseen, axis=-1)
    matters = np.linalg.norm(moved, axis=-1) > least
    return np.where(np.any(matters, axis=-1), np.inf, np.sqrt(variance))


def beams_to(points, T_head_lrf):
    """Bearing, pitch (radians) and range (metres) at which scans reach points (platform frame).

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
    """Bearing and pitch of beams of a given length that end on the rays of pixels (..., 2)."""
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
    if chain.on_head:
        pitch = pitch + image_pitch
    return bearing, pitch


def _sigma_map(chain, axes, jacobian, by_pitch, turn, offset):
    """Standard deviations from Jacobians (d, r, c, m, 13) and by the pitch (d, r, c, m) of beams.

    The beams are `turn` off the middle; `offset` says whether the offset that the pitch of every
    sweep has of its own matters.
    """
    parts = {}
    for name, columns in PARTS.items():
        link = np.isin(range(len(COLUMNS)), columns)
        parts[name] = spread(chain, jacobian * link)
    sigma_offset, sigma_stretch = chain.sweep_sigma
    sigma_pitch = np.hypot(offset * sigma_offset, sigma_stretch * turn)
    parts["sweep"] = sigma_pitch * np.linalg.norm(by_pitch, axis=-1)
    sigma = np.hypot(spread(chain, jacobian), parts["sweep"])
    return SigmaMap(*axes, sigma, parts)


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
    columns, rows = grid
    u = (np.arange(columns) + 0.5) * model.width / columns - 0.5
    v = (np.arange(rows) + 0.5) * model.height / rows - 0.5
    uv = np.stack(np.meshgrid(u, v), axis=-1)
    away = distances[:, None, None]
    bearing, pitch = beams_of_pixels(chain, model, uv, away, image_pitch)
    points, J, by_pitch = carried(chain, bearing, pitch, away, image_pitch)
    P = project_jacobians(points, model)[0]
    by_pitch = (P @ by_pitch[..., None])[..., 0]
    middle = image_pitch
    if pitches is not None and not chain.on_head:
        middle = np.mean(pitches)
    axes = u, v, distances
    out = _sigma_map(chain, axes, P @ J, by_pitch, pitch - middle, not chain.on_head)
    if pitches is None:
        return replace(out, sigma=np.where(np.isnan(pitch), np.nan, out.sigma))
    low, high = pitches
    reached = (pitch >= low) & (pitch <= high)
    return replace(out, sigma=np.where(reached, out.sigma, np.nan))


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
    away = distances[:, None, None]
    _, J, by_pitch = carried(chain, bearings, pitches[:, None], away, reference)
    axes = bearings, pitches, distances
    out = _sigma_map(chain, axes, J, by_pitch, (pitches - reference)[:, None], True)
    out.parts["range noise"] = np.full(out.sigma.shape, range_noise(solution))
    return out


def range_noise(solution):
    """Standard deviation of one range as the solution found or took it, metres (0 for a Chain)."""
    if isinstance(solution, Chain) or not len(solution.observations.face_sigma):
        return 0.0
    return float(np.median(solution.observations.face_sigma) * solution.noise["face_scale"])


def _asked(solution, camera, distances):
    """The chain of a solution (or the Chain given) and distances as an array."""
    distances = np.atleast_1d(np.asarray(distances, float))
    if not (np.isfinite(distances).all() and distances.min() > 0):
        raise ValueError(f"distances must be positive, metres; got {distances.tolist()}")
    if isinstance(solution, Chain):
        return solution, distances
    return chain_of(solution, camera), distances
