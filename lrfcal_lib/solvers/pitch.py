"""Errors of the recorded pitch, found from the boards that cameras on the base see."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.stats import f as f_distribution

from lrfcal_lib.fit.least_squares import Block, solve
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    gradient_by_pose,
    lrf_to_platform,
    move_pose,
    pose_array,
    pose_transform,
)
from lrfcal_lib.solvers.planes import start_from_planes

MODELS = ("none", "direction", "sweep", "sweep_stretch")
PLANE_NUMBERS, EDGE_NUMBERS = 3, 2  # independent numbers: a plane's distance and two angles; an edge's offset and angle
PRIOR_OFFSET, PRIOR_STRETCH = np.radians(5.0), 0.5  # hold what one sweep cannot show (and the common offset)


@dataclass(frozen=True)
class Scans:
    """Points of every placement, padded to (p, n).

    Attributes
    ----------
    points : ndarray, shape (p, n, 3)
        Platform frame, at the recorded pitch.
    pitch : ndarray, shape (p, n)
    used : ndarray of bool, shape (p, n)
    weight : ndarray, shape (p, n)
        Root of a point's share in the mean square of its placement's face, or of its edge.
    """

    points: np.ndarray
    pitch: np.ndarray
    used: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class PitchData:
    """All observations by placement.

    Attributes
    ----------
    placements, direction : ndarray of int, shape (p,)
    middle : ndarray, shape (p,)
    faces : Scans
    edges : list of Scans
        One for each camera; they may be empty.
    sights : list of ndarray, shape (p, n, 3)
        Of each camera: unit normals of the planes of sight through the edges.
    normal, point : ndarray, shape (c, p, 3)
        Planes of the boards in each camera.
    cameras : tuple of str
    """

    placements: np.ndarray
    direction: np.ndarray
    middle: np.ndarray
    faces: Scans
    edges: list
    sights: list
    normal: np.ndarray
    point: np.ndarray
    cameras: tuple

    @property
    def n_numbers(self):
        """Independent numbers in the data: the LRF's errors are the same for all cameras, so they count once."""
        edges = max(np.round(np.sum(e.weight**2)) for e in self.edges)
        return int(PLANE_NUMBERS * len(self.placements) + EDGE_NUMBERS * edges)


def gather(sweeps, cameras, number, use_edges=True):
    """Observations of the placements that all cameras know.

    Parameters
    ----------
    sweeps : SweepPoints
    cameras : dict of str to CameraObservations
    number : int
        Points used of each face, evenly thinned.
    use_edges : bool
        Also use the cameras' crossings.

    Returns
    -------
    PitchData
    """
    check_input(sweeps, cameras)
    known = [np.asarray(obs.placements) for obs in cameras.values()]
    placements = np.array([p for p in np.unique(sweeps.placement) if all(p in k for k in known)])
    if len(placements) < 4:
        raise DegenerateGeometry(
            f"{len(placements)} placements seen by the LRF and all cameras: at least 4 needed to compare sweeps"
        )
    rows = [np.flatnonzero(sweeps.placement == p) for p in placements]
    rows = [r[np.unique(np.linspace(0, len(r) - 1, number).astype(int))] for r in rows]
    p_platform = lrf_to_platform(sweeps.points, sweeps.pitch, sweeps.T_head_lrf)
    faces = _scans(p_platform, sweeps.pitch, rows, [np.full(len(r), 1 / len(r)) for r in rows])
    middle = np.array([sweeps.pitch[sweeps.placement == p].mean() for p in placements])
    if sweeps.middle is not None:
        middle = np.array([sweeps.middle[int(p)] for p in placements])
    edges = [_edges(obs, placements, sweeps.T_head_lrf, middle, use_edges) for obs in cameras.values()]
    boards = np.array(
        [[obs.board_poses[list(obs.placements).index(p)] for p in placements] for obs in cameras.values()]
    )
    direction = np.array([sweeps.direction.get(int(p), 0) for p in placements])
    scans, sights = zip(*edges, strict=True)
    planes = boards[..., :3, 2], boards[..., :3, 3]
    return PitchData(placements, direction, middle, faces, list(scans), list(sights), *planes, tuple(cameras))


def check_input(sweeps, cameras):
    """Refuse cameras that ride on the head, and points that are not finite."""
    for name, obs in cameras.items():
        if obs.source != "platform":
            raise ValueError(
                f"camera '{name}' has source '{obs.source}': pitch errors need cameras fixed to the platform"
            )
    if not (np.isfinite(sweeps.points).all() and np.isfinite(sweeps.pitch).all()):
        raise ValueError("points or pitch of the sweeps are not finite: leave such points out")


def _scans(points, pitch, rows, shares):
    """Pad rows of points to a rectangle."""
    width = max(1, max(len(r) for r in rows))
    index, used, weight = (np.zeros((len(rows), width), kind) for kind in (int, bool, float))
    for i, (r, share) in enumerate(zip(rows, shares, strict=True)):
        index[i, : len(r)], used[i, : len(r)], weight[i, : len(r)] = r, True, np.sqrt(share)
    if len(points) == 0:
        return Scans(np.zeros((len(rows), width, 3)), np.zeros((len(rows), width)), used, weight)
    return Scans(points[index], pitch[index], used, weight)


def _edges(obs, placements, T_head_lrf, middle, use_edges):
    """Crossings of one camera, with shares by edge and placement, and their normals of sight."""
    order = np.argsort(placements)
    wanted = np.isin(obs.crossing_placement, placements) & use_edges
    where = order[np.minimum(np.searchsorted(placements, obs.crossing_placement, sorter=order), len(placements) - 1)]
    pitch = pitch_of(obs.crossing_points, T_head_lrf, middle[where])
    wanted &= np.isfinite(pitch)
    rows = [np.flatnonzero(wanted & (obs.crossing_placement == p)) for p in placements]
    shares = [_edge_shares(obs.crossing_edge[r]) for r in rows]
    raw = obs.crossing_lines @ obs.model.matrix
    sights = raw / np.linalg.norm(raw, axis=1, keepdims=True)
    scans = _scans(obs.crossing_points, pitch, rows, shares)
    return scans, _scans(sights, pitch, rows, shares).points


def _edge_shares(edge):
    _, index, count = np.unique(edge, return_inverse=True, return_counts=True)
    return 1 / count[index] if len(edge) else np.zeros(0)


def pitch_of(p_platform, T_head_lrf, near):
    """Pitch at which the scan plane passes through platform points, the solution nearest to `near`; NaN where none."""
    normal, point = T_head_lrf.rotation.apply([0.0, 0.0, 1.0]), T_head_lrf.translation
    x, y, z = p_platform.T
    # n . (Rx(-pitch) p - t) = 0  is  a cos(pitch) + b sin(pitch) = c
    a, b, c = normal[1] * y + normal[2] * z, normal[1] * z - normal[2] * y, normal @ point - normal[0] * x
    with np.errstate(invalid="ignore", divide="ignore"):
        reach = np.arccos(c / np.hypot(a, b))
    both = np.arctan2(b, a) + np.stack([reach, -reach])
    both = near + (both - near + np.pi) % (2 * np.pi) - np.pi
    return np.where(np.abs(both[0] - near) <= np.abs(both[1] - near), both[0], both[1])


def corrected_points(scans, data, state):
    """Platform points with the recorded pitch corrected, and their derivative by the pitch."""
    _, direction, offset, stretch = state
    change = (direction * data.direction + offset)[:, None] + stretch[:, None] * (scans.pitch - data.middle[:, None])
    c, s = np.cos(change), np.sin(change)
    x, y, z = np.moveaxis(scans.points, -1, 0)
    q = np.stack([x, c * y - s * z, s * y + c * z], axis=-1)
    return q, np.stack([0 * x, -q[..., 2], q[..., 1]], axis=-1)


def pitch_blocks(state, data, name, sigma, sigma_edge):
    """Residuals in metres by placement with analytic Jacobian, and weak priors.

    Parameters
    ----------
    state : tuple
        Camera poses (c, 3, 4), offset by direction, offsets (p,), stretches (p,).
    data : PitchData
    name : str
        One of `MODELS`. Unknowns: 6 for each camera, then ('direction') the offset by direction; own to a placement
        ('sweep', 'sweep_stretch') its offset and stretch.
    sigma, sigma_edge : float
        Of one independent number, metres.

    Returns
    -------
    list of Block
    """
    poses, _, offset, stretch = state
    faces, blocks = corrected_points(data.faces, data, state), []
    for i, pose in enumerate(poses):
        normal = np.broadcast_to(data.normal[i][:, None], faces[0].shape)
        block = _block(i, pose, data.faces, faces, normal, data.point[i][:, None], data, name, len(poses))
        blocks.append(Block(*block, data.faces.weight / (sigma * np.sqrt(len(poses)))))
        edges = corrected_points(data.edges[i], data, state)
        block = _block(i, pose, data.edges[i], edges, data.sights[i], 0.0, data, name, len(poses))
        blocks.append(Block(*block, data.edges[i].weight / (sigma_edge * np.sqrt(len(poses)))))
    own = own_unknowns(name)
    if own:
        prior = np.zeros((len(offset), own, blocks[0].jacobian.shape[-1]))
        prior[:, range(own), range(prior.shape[-1] - own, prior.shape[-1])] = 1.0
        values = np.stack([offset, stretch], axis=1)[:, :own]
        blocks.append(Block(values, prior, np.broadcast_to([1 / PRIOR_OFFSET, 1 / PRIOR_STRETCH][:own], values.shape)))
    return blocks


def own_unknowns(name):
    """Number of unknowns of each sweep."""
    return {"sweep": 1, "sweep_stretch": 2}.get(name, 0)


def _block(i, pose, scans, corrected, normal, point, data, name, cameras):
    """Distances of corrected points from planes of camera i (through `point`), and their Jacobian."""
    q, by_pitch = corrected
    own = own_unknowns(name)
    shared = 6 * cameras + (name == "direction")
    rotated = q @ pose[:, :3].T
    r = np.sum(normal * (rotated + pose[:, 3] - point), axis=-1)
    J = np.zeros(r.shape + (shared + own,))
    J[..., 6 * i : 6 * i + 6] = gradient_by_pose(rotated, normal)
    slope = np.sum((normal @ pose[:, :3]) * by_pitch, axis=-1)
    if name == "direction":
        J[..., shared - 1] = slope * data.direction[:, None]
    if own:
        J[..., shared] = slope
    if own == 2:
        J[..., shared + 1] = slope * (scans.pitch - data.middle[:, None])
    return r, J


def move_pitch_state(state, step, name):
    """Retraction of the pitch models."""
    poses, direction, offset, stretch = state
    common, own = step
    cameras = len(poses)
    poses = move_pose(poses, common[: 6 * cameras].reshape(cameras, 6))
    direction = direction + common[6 * cameras] if name == "direction" else direction
    offset = offset + own[:, 0] if own.shape[1] > 0 else offset
    return poses, direction, offset, (stretch + own[:, 1] if own.shape[1] > 1 else stretch)


def misfit(data, state):
    """What the models are compared by.

    Returns
    -------
    total : float
        Sum over the placements of the mean square distance of the fitted scan plane from the camera's plane, and over
        their edges of the mean square distance of the crossings from the planes of sight, m^2; mean over the cameras.
    rms : dict of str to float
        Of the point-plane distances, metres.
    edge_rms : dict of str to float
        Of the crossings' distances, metres (nan without edges).
    """
    q, _ = corrected_points(data.faces, data, state)
    used = data.faces.used
    count = used.sum(axis=1)
    centre = np.sum(q * used[..., None], axis=1) / count[:, None]
    away = (q - centre[:, None]) * used[..., None]
    flat = np.linalg.svd(away, full_matrices=False)[2][:, 2]
    own = np.sum(flat[:, None] * away, axis=-1)
    total, rms, edge_rms = 0.0, {}, {}
    for i, (name, pose) in enumerate(zip(data.cameras, state[0], strict=True)):
        r = np.sum(data.normal[i][:, None] * (q @ pose[:, :3].T + pose[:, 3] - data.point[i][:, None]), axis=-1) * used
        rms[name] = float(np.sqrt(np.sum(r**2) / used.sum()))
        aligned = own * np.sign(np.sum((data.normal[i] @ pose[:, :3]) * flat, axis=1))[:, None]
        e = corrected_points(data.edges[i], data, state)[0] @ pose[:, :3].T + pose[:, 3]
        d = np.sum(data.sights[i] * e, axis=-1) * data.edges[i].used
        edges = data.edges[i].used.sum()
        edge_rms[name] = float(np.sqrt(np.sum(d**2) / edges)) if edges else np.nan
        total += np.sum(np.sum(((r - aligned) * used) ** 2, axis=1) / count)
        total += np.sum((d * data.edges[i].weight) ** 2)
    return float(total) / len(state[0]), rms, edge_rms


@dataclass(frozen=True)
class SweepPoints:
    """Points on the boards' faces as the LRF measured them.

    Attributes
    ----------
    points : ndarray, shape (m, 3)
        LRF frame, metres.
    pitch : ndarray, shape (m,)
        Recorded pitch, radians.
    placement : ndarray of int, shape (m,)
    T_head_lrf : RigidTransform
    direction : dict of int to int
        Sweep direction (+1 or -1; 0 for a single shot) of each placement.
    middle : dict of int to float, optional
        Pitch about which a sweep is stretched; the mean of the points' pitch when left out.
    """

    points: np.ndarray
    pitch: np.ndarray
    placement: np.ndarray
    T_head_lrf: RigidTransform
    direction: dict[int, int]
    middle: dict[int, float] | None = None


@dataclass(frozen=True)
class PitchModel:
    """One of the nested models, solved.

    Attributes
    ----------
    name : str
        'none', 'direction' (+offset for sweeps with direction +1, -offset for -1), 'sweep' (an offset each), or
        'sweep_stretch' (an offset and a stretch about the middle each).
    offset, offset_sigma : ndarray, shape (p,)
        Radians to *add* to the recorded pitch of each placement.
    stretch, stretch_sigma : ndarray, shape (p,)
        Relative; the corrected pitch is ``pitch + offset + stretch (pitch - middle)``.
    transforms : dict of str to RigidTransform
        ``T_camera_platform``.
    rms : dict of str to float
        Of all point-plane distances, metres.
    edge_rms : dict of str to float
        Of the crossings' distances from the planes of sight, metres; nan without edges.
    misfit : float
        See :func:`lrfcal_lib.solvers.pitch.misfit`, m^2.
    n_parameters, n_numbers : int
    F, p_value : float
        Test against the model before (nan for the first): would the misfit fall so much by chance?
    converged : bool
    """

    name: str
    offset: np.ndarray
    offset_sigma: np.ndarray
    stretch: np.ndarray
    stretch_sigma: np.ndarray
    transforms: dict[str, RigidTransform]
    rms: dict[str, float]
    edge_rms: dict[str, float]
    misfit: float
    n_parameters: int
    n_numbers: int
    F: float
    p_value: float
    converged: bool


@dataclass(frozen=True)
class PitchErrors:
    """What the recordings say about the recorded pitch.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
    direction : ndarray of int, shape (p,)
    direction_offset, direction_sigma : float
        Radians to add to the recorded pitch of sweeps with direction +1 (and to subtract for -1), with its standard
        deviation, the larger of noise (at the level of the residuals) and scatter over the placements. nan where the
        sweeps all go one way.
    models : dict of str to PitchModel
    wanted : str
        The model that the data ask for: each larger one must beat the last one wanted with p < 0.01.
    """

    placements: np.ndarray
    direction: np.ndarray
    direction_offset: float
    direction_sigma: float
    models: dict[str, PitchModel]
    wanted: str


def estimate_pitch_errors(
    sweeps, cameras, T0=None, *, sigma=0.003, sigma_edge=0.003, points=300, use_edges=True, required=False
):
    """Estimate errors of the recorded pitch together with the cameras' poses, in nested models.

    Parameters
    ----------
    sweeps : SweepPoints
    cameras : dict of str to CameraObservations
        Cameras fixed to the platform (``source='platform'``); their board poses are used, and their crossings.
    T0 : dict of str to RigidTransform, optional
        Start values of ``T_camera_platform``.
    sigma, sigma_edge : float
        Standard deviation of one of the three numbers that a placement's scan plane stands for, and of the two that the
        crossings of one edge stand for, metres: how much faces and edges weigh against each other. Neighbouring points
        do not count as independent.
    points : int
        Points used of each placement, evenly thinned.
    use_edges : bool
        False: faces only.
    required : bool
        Raise when the board poses leave a camera's pose open.

    Returns
    -------
    PitchErrors

    Raises
    ------
    DegenerateGeometry
        With fewer than four placements that the LRF and all cameras see.
    ValueError
        When a camera is not fixed to the platform, or an observation is not finite.
    """
    data, sigmas = gather(sweeps, cameras, points, use_edges), (sigma, sigma_edge)
    start = [pose_array((T0 or {}).get(name) or start_from_planes(cameras[name])) for name in data.cameras]
    models, state = {}, (np.array(start), 0.0, np.zeros(len(data.placements)), np.zeros(len(data.placements)))
    names = [m for m in MODELS if m != "direction" or len(set(data.direction[data.direction != 0])) == 2]
    direction = (np.nan, np.nan)
    for name in names:
        found, state = _solve_model(name, data, state, sigmas, required)
        if name == "direction":
            direction = float(state[1]), float(found.trusted_sigma[6 * len(data.cameras)])
        previous = models.get(names[names.index(name) - 1]) if models else None
        models[name] = _model(name, data, state, found, previous, sigma)
    return PitchErrors(data.placements, data.direction, *direction, models, wanted_model(models))


def _solve_model(name, data, state, sigmas, required):
    poses, direction, offset, stretch = state
    if name.startswith("sweep"):
        offset, direction = offset + direction * data.direction, 0.0
    start = (poses, direction, offset, stretch)
    cameras = len(poses)
    names = [f"{c}_{n}" for c in data.cameras for n in ("rx", "ry", "rz", "tx", "ty", "tz")] + ["direction_offset"] * (
        name == "direction"
    )

    def read(s):
        return None, np.concatenate([s[0][:, :, 3].ravel(), [s[1]] * (name == "direction")])

    found = solve(
        lambda s: pitch_blocks(s, data, name, *sigmas),
        start,
        lambda s, d: move_pitch_state(s, d, name),
        names=names,
        method=f"pitch_{name}",
        read=read,
        shared=6 * cameras + (name == "direction"),
        required=required,
        limit=10.0,
        freedom=data.n_numbers - 6,
    )
    # the stated sigmas only weigh faces against edges: the level of the noise comes from the residuals
    level = misfit(data, found.state)[0] / max(data.n_numbers - 6, 1) / sigmas[0] ** 2 / found.inflation
    return replace(found, covariance=level * found.covariance), found.state


def _model(name, data, state, found, previous, sigma):
    """Wrap a solved model and test it against the one before."""
    p = len(data.placements)
    total, rms, edge_rms = misfit(data, state)
    pitch_parameters = {"none": 0, "direction": 1, "sweep": p - 1, "sweep_stretch": 2 * p - 1}[name]
    parameters, numbers = 6 + pitch_parameters, data.n_numbers
    small = None if previous is None else (previous.misfit, previous.n_parameters)
    F, p_value = (np.nan, np.nan) if small is None else f_test(*small, total, parameters, numbers)
    level = total / max(numbers - parameters, 1) / sigma**2
    offset_sigma, stretch_sigma = _own_sigmas(name, found, p, len(data.cameras), level)
    offset = state[1] * data.direction + state[2]
    offset = offset - offset.mean() if name.startswith("sweep") else offset
    transforms = {c: pose_transform(pose) for c, pose in zip(data.cameras, state[0], strict=True)}
    return PitchModel(
        name,
        offset,
        offset_sigma,
        state[3],
        stretch_sigma,
        transforms,
        rms,
        edge_rms,
        total,
        parameters,
        numbers,
        float(F),
        p_value,
        bool(found.converged),
    )


def f_test(small_misfit, small_parameters, misfit, parameters, numbers):
    """F and its p-value: would the misfit fall so much by chance when parameters are added?"""
    more, free = parameters - small_parameters, numbers - parameters
    if more <= 0 or free <= 0:
        return np.nan, np.nan
    F = (small_misfit - misfit) / more / (misfit / free)
    return float(F), float(f_distribution.sf(F, more, free))


def wanted_model(models, level=0.01):
    """Name of the model that the data ask for: a larger one must beat the last one wanted at the given level."""
    names = list(models)
    wanted = models[names[0]]
    for name in names[1:]:
        model = models[name]
        test = f_test(wanted.misfit, wanted.n_parameters, model.misfit, model.n_parameters, model.n_numbers)
        wanted = model if test[1] < level else wanted
    return wanted.name


def _own_sigmas(name, found, p, cameras, level):
    """Standard deviations of the sweeps' own unknowns, from the scatter of the residuals (the shared ones held)."""
    if name == "none":
        return np.zeros(p), np.zeros(p)
    if name == "direction":
        return np.full(p, found.trusted_sigma[6 * cameras]), np.zeros(p)
    own = found.jacobian[..., 6 * cameras :]
    inverse = np.linalg.inv(np.swapaxes(own, -1, -2) @ own) * level
    sigma = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2))
    return sigma[:, 0], sigma[:, 1] if name == "sweep_stretch" else np.zeros(p)
