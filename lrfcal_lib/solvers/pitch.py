"""Errors of the recorded pitch, found from the boards that cameras on the base see."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import fdtrc

from lrfcal_lib.fit.least_squares import Block, pad, solve
from lrfcal_lib.fit.residuals import sight_normals
from lrfcal_lib.model import geometry
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    gradient_by_pose,
    pose_array,
    pose_transform,
)
from lrfcal_lib.solvers.planes import start_from_planes

# of the pitch: the first is shared, the others each sweep's own
ERRORS = ("direction", "offset", "stretch")
MODELS = {
    "none": (),
    "direction": ("direction",),
    "sweep": ("offset",),
    "sweep_stretch": ("offset", "stretch"),
}
# independent numbers: a plane's distance and two angles; an edge's offset and angle
PLANE_NUMBERS = 3
EDGE_NUMBERS = 2
# offset, stretch: hold what one sweep cannot show (and the common offset)
PRIOR = np.array([np.radians(5.0), 0.5])
SIGMA = 0.003  # metres, of one independent number; the level of the noise comes from the residuals
LEVEL = 0.01  # a larger model must beat the last one wanted with this p-value


@dataclass(frozen=True)
class PitchData:
    """All observations by placement, padded to (p, n).

    `faces` holds ``points`` (platform frame, at the recorded pitch), ``pitch``, ``used``, and
    ``weight``: root of a point's share in the mean square of its placement's face, or of its edge.
    `edges` the same of each camera's crossings, and ``sight``, unit normals of the planes of sight.
    `boards` (c, p, 3, 4) are ``T_camera_board``.
    """

    placements: np.ndarray
    direction: np.ndarray
    middle: np.ndarray
    faces: dict
    edges: list
    boards: np.ndarray
    cameras: tuple

    @property
    def n_numbers(self):
        """Independent numbers in the data; errors of the LRF are common to all cameras: once."""
        edges = max(np.round(np.sum(e["weight"] ** 2)) for e in self.edges)
        return int(PLANE_NUMBERS * len(self.placements) + EDGE_NUMBERS * edges)


def gather(cameras, direction, middle):
    """Observations of the placements that all cameras know; the faces are those of the first."""
    every = list(cameras.values())
    for name, obs in cameras.items():
        if obs.source != "platform":
            raise ValueError(
                f"camera '{name}' has source '{obs.source}': pitch errors need cameras fixed to "
                "the platform"
            )
    placements = every[0].plane_placement
    for obs in every:
        placements = np.intersect1d(placements, obs.placements)
    if len(placements) < 4:
        raise DegenerateGeometry(
            f"{len(placements)} placements seen by the LRF and all cameras: at least 4 needed to "
            "compare sweeps"
        )
    edges = []
    boards = []
    for obs in every:
        group = obs.group("crossing")
        group["sight"] = sight_normals(obs.crossing_lines, obs.model)[0]
        edges.append(_shared_out(group, ("placement", "edge"), placements))
        order = np.argsort(obs.placements)
        rows = order[np.searchsorted(obs.placements, placements, sorter=order)]
        boards.append(obs.board_poses[rows, :3])
    direction = np.array([direction[p] for p in placements.tolist()])
    middle = np.array([middle[p] for p in placements.tolist()])
    faces = _shared_out(every[0].group("plane"), ("placement",), placements)
    return PitchData(placements, direction, middle, faces, edges, np.array(boards), tuple(cameras))


def _shared_out(group, part, placements):
    """A group padded by placement; the rows of a part (alike in these columns) weigh 1 together."""
    kept = np.isin(group["placement"], placements)
    number = np.zeros(kept.sum(), int)
    for key in part:
        names, value = np.unique(group[key][kept], return_inverse=True)
        number = number * len(names) + value
    _, index, count = np.unique(number, return_inverse=True, return_counts=True)
    columns = {key: group[key][kept] for key in ("points", "pitch", "sight") if key in group}
    columns["placement"] = np.searchsorted(placements, group["placement"][kept])
    columns["weight"] = 1 / np.sqrt(count[index])
    return pad(columns, len(placements))


def corrected_points(group, data, state):
    """Platform points with the recorded pitch corrected, and their derivative by the pitch."""
    _, direction, offset, stretch = state
    away = group["pitch"] - data.middle[:, None]
    common = direction * data.direction + offset
    change = common[:, None] + stretch[:, None] * away
    q = geometry.tilt(group["points"], change)
    return q, np.stack([0 * change, -q[..., 2], q[..., 1]], axis=-1)


def plane_distances(state, data):
    """Distances (p, n) of face points from boards' planes and of crossings from their sights.

    Yields for each camera twice: group, distances, and Jacobian by the poses of all cameras 6 c and
    by `ERRORS` 3.
    """
    for i, board in enumerate(data.boards):
        normal = np.broadcast_to(board[:, None, :, 2], data.faces["points"].shape)
        yield _camera_distances(state, data, i, data.faces, normal, board[:, None, :, 3])
        yield _camera_distances(state, data, i, data.edges[i], data.edges[i]["sight"], 0.0)


def _camera_distances(state, data, camera, group, normal, point):
    """One yield of :func:`plane_distances`: distances from planes through points of a camera."""
    poses = state[0]
    pose = poses[camera]
    q, by_pitch = corrected_points(group, data, state)
    rotated = q @ pose[:, :3].T
    r = np.sum(normal * (rotated + pose[:, 3] - point), axis=-1)
    slope = np.sum((normal @ pose[:, :3]) * by_pitch, axis=-1)
    away = group["pitch"] - data.middle[:, None]
    J = np.zeros(r.shape + (6 * len(poses) + len(ERRORS),))
    J[..., 6 * camera : 6 * camera + 6] = gradient_by_pose(rotated, normal)
    J[..., -3] = slope * data.direction[:, None]
    J[..., -2] = slope
    J[..., -1] = slope * away
    return group, r, J


def pitch_blocks(state, data, name):
    """Residuals in metres by placement with analytic Jacobian, and weak priors, of a model.

    The state are camera poses (c, 3, 4), offset by direction, offsets (p,), stretches (p,).
    Unknowns are 6 of each camera and the model's; what belongs to single sweeps is their own.
    """
    cameras = len(state[0])
    columns = [*range(6 * cameras), *(6 * cameras + ERRORS.index(error) for error in MODELS[name])]
    sigma = SIGMA * np.sqrt(cameras)
    blocks = []
    for group, r, J in plane_distances(state, data):
        blocks.append(Block(r, J[..., columns], group["weight"] / sigma))
    own = sum(error != "direction" for error in MODELS[name])
    if own:
        values = np.stack(state[2:], axis=1)[:, :own]
        k = len(columns)
        J = np.broadcast_to(np.eye(k)[k - own :], values.shape + (k,))
        blocks.append(Block(values, J, np.broadcast_to(1 / PRIOR[:own], values.shape)))
    return blocks


def move_pitch_state(state, step, name):
    """Retraction of the pitch models."""
    poses, direction, offset, stretch = state
    common, own = step
    by_pose, direction_step = np.split(common, [6 * len(poses)])
    steps = dict(zip(MODELS[name], [*direction_step, *own.T], strict=True))
    return (
        geometry.move_pose(poses, by_pose.reshape(-1, 6)),
        direction + steps.get("direction", 0.0),
        offset + steps.get("offset", 0.0),
        stretch + steps.get("stretch", 0.0),
    )


def misfit(data, state):
    """What the models are compared by (m^2), and rms distances of face points by camera, metres.

    Sum over the placements of the mean square distance of the fitted scan plane from the camera's
    plane, and over their edges of the mean square distance of the crossings from the planes of
    sight; mean over the cameras.
    """
    q, _ = corrected_points(data.faces, data, state)
    used = data.faces["used"]
    count = used.sum(axis=1)
    within = used[..., None]
    middle = np.sum(q * within, axis=1, keepdims=True) / count[:, None, None]
    away = (q - middle) * within
    flat = np.linalg.svd(away, full_matrices=False)[2][:, 2]
    # what the scan scatters about its own plane tells nothing of the pitch
    scatter = np.sum(flat[:, None] * away, axis=-1)
    total = 0.0
    rms = {}
    distances = plane_distances(state, data)
    for name, pose, board in zip(data.cameras, state[0], data.boards, strict=True):
        _, r, _ = next(distances)
        edges, d, _ = next(distances)
        r = r * used
        rms[name] = float(np.sqrt(np.sum(r**2) / used.sum()))
        side = np.sign(np.sum((board[..., 2] @ pose[:, :3]) * flat, axis=1))
        without_scatter = (r - scatter * side[:, None]) * used
        total += np.sum(np.sum(without_scatter**2, axis=1) / count)
        total += np.sum((d * edges["weight"]) ** 2)
    return float(total) / len(state[0]), rms


@dataclass(frozen=True)
class PitchModel:
    """One of the nested models, solved.

    Attributes
    ----------
    name : str
        'none', 'direction' (+offset for sweeps with direction +1, -offset for -1), 'sweep' (an
        offset each), or 'sweep_stretch' (an offset and a stretch about the middle each).
    offset, offset_sigma, stretch : ndarray, shape (p,)
        Radians to *add* to the recorded pitch of each placement, and relative: the corrected pitch
        is ``pitch + offset + stretch (pitch - middle)``.
    transforms : dict of str to RigidTransform
        ``T_camera_platform``.
    misfit, rms
        Of :func:`misfit`.
    F, p_value : float
        Test against the model before (nan for the first): would the misfit fall so much by chance?
    """

    name: str
    offset: np.ndarray
    offset_sigma: np.ndarray
    stretch: np.ndarray
    transforms: dict[str, RigidTransform]
    misfit: float
    rms: dict[str, float]
    n_parameters: int
    converged: bool
    F: float = np.nan
    p_value: float = np.nan

    def tested(self, small, numbers):
        """The model with F and p-value against a smaller one, of so many independent numbers."""
        if small is None or self.n_parameters <= small.n_parameters or numbers <= self.n_parameters:
            return self
        more = self.n_parameters - small.n_parameters
        free = numbers - self.n_parameters
        F = (small.misfit - self.misfit) / more / (self.misfit / free)
        return replace(self, F=float(F), p_value=float(fdtrc(more, free, max(F, 0.0))))


@dataclass(frozen=True)
class PitchErrors:
    """What the recordings say about the recorded pitch.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
    direction : ndarray of int, shape (p,)
    direction_offset, direction_sigma : float
        Radians to add to the recorded pitch of sweeps with direction +1 (and to subtract for -1),
        with its standard deviation (`Solution.trusted`, with the noise at the level of the
        residuals). nan where the sweeps all go one way.
    models : dict of str to PitchModel
    wanted : str
        The model that the data ask for: each larger one must beat the last one wanted with p <
        0.01.
    """

    placements: np.ndarray
    direction: np.ndarray
    direction_offset: float
    direction_sigma: float
    models: dict[str, PitchModel]
    wanted: str


def estimate_pitch_errors(cameras, direction, middle):
    """Estimate errors of the recorded pitch together with the cameras' poses, in nested models.

    Parameters
    ----------
    cameras : dict of str to CameraObservations
        Cameras fixed to the platform (``source='platform'``), with recorded pitch; their board
        poses are used, their crossings, and the face points of the first.
    direction : dict of int to int
        Sweep direction (+1 or -1; 0 for a single shot) of each placement.
    middle : dict of int to float
        Pitch about which a sweep is stretched, radians.

    Returns
    -------
    PitchErrors

    Raises
    ------
    DegenerateGeometry
        With fewer than four placements that the LRF and all cameras see.
    ValueError
        When a camera is not fixed to the platform.
    """
    data = gather(cameras, direction, middle)
    models = {}
    turn = (np.nan, np.nan)
    before = None
    wanted = None
    poses = [pose_array(start_from_planes(obs))[0] for obs in cameras.values()]
    zeros = 0.0 * data.middle
    state = (np.array(poses), 0.0, zeros, zeros)
    numbers = data.n_numbers
    for name in MODELS:
        if name == "direction" and not {-1, 1} <= set(data.direction.tolist()):
            continue
        if name.startswith("sweep"):
            state = (state[0], 0.0, state[2] + state[1] * data.direction, state[3])
        state, sigma, model = _solve_model(name, data, state)
        if name == "direction":
            turn = float(state[1]), sigma
        model = model.tested(before, numbers)
        if wanted is None or model.tested(wanted, numbers).p_value < LEVEL:
            wanted = model
        models[name] = model
        before = model
    return PitchErrors(data.placements, data.direction, *turn, models, wanted.name)


def _solve_model(name, data, state):
    """Solve one model: state, standard deviation of the last shared unknown, PitchModel.

    The stated sigmas only weigh faces against edges, the level comes from the residuals.
    """
    names = [f"{c}_{n}" for c in data.cameras for n in geometry.POSE_NAMES]
    if name == "direction":
        names.append("direction_offset")

    def read(state):
        """No transform, and the shared unknowns."""
        values = np.r_[geometry.pose_parameters(state[0]).ravel(), state[1]]
        return None, values[: len(names)]

    found = solve(
        lambda s: pitch_blocks(s, data, name),
        state,
        lambda s, step: move_pitch_state(s, step, name),
        names=names,
        read=read,
        required=False,
        method=f"pitch_{name}",
        shared=len(names),
        limit=10.0,
        freedom=data.n_numbers - 6,
    )
    poses, direction, offset, stretch = found.state
    p = len(data.placements)
    total, rms = misfit(data, found.state)
    level = total / max(data.n_numbers - 6, 1) / SIGMA**2 / found.inflation
    sigma = float(replace(found, covariance=level * found.covariance).trusted_sigma[-1])
    parameters = 6 + {"none": 0, "direction": 1, "sweep": p - 1, "sweep_stretch": 2 * p - 1}[name]
    offset = direction * data.direction + offset
    offset_sigma = np.full(p, sigma if name == "direction" else 0.0)
    if name.startswith("sweep"):  # from the scatter of the residuals, what is shared held
        offset = offset - offset.mean()
        own = found.jacobian[..., 6 * len(poses) :]
        inverse = np.linalg.inv(np.swapaxes(own, -1, -2) @ own)
        variance = total / max(data.n_numbers - parameters, 1)
        offset_sigma = np.sqrt(inverse[:, 0, 0] * variance) / SIGMA
    model = PitchModel(
        name,
        offset=offset,
        offset_sigma=offset_sigma,
        stretch=stretch,
        transforms=dict(zip(data.cameras, map(pose_transform, poses), strict=True)),
        misfit=total,
        rms=rms,
        n_parameters=parameters,
        converged=bool(found.converged),
    )
    return found.state, sigma, model
