"""What a joint estimate knows badly, and which of the placements that a rig could record next would help most."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import norm

from lrfcal_lib.evaluate.uncertainty import beams_to, information
from lrfcal_lib.fit.least_squares import reduced_hessian, whiten
from lrfcal_lib.fit.residuals import edge_shift, flip_sigma, named_blocks
from lrfcal_lib.fit.result import AXIS_NAMES, AXIS_WORDS
from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.camera import project, project_jacobians
from lrfcal_lib.model.geometry import POSE_NAMES, DegenerateGeometry, apply_pose, pose_transform, tilt
from lrfcal_lib.solvers.joint import UNSEEN

FACING = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # a board upright ahead of the LRF, its print towards it
LEANS = {"back": (-1, 0), "forward": (1, 0), "left": (0, -1), "right": (0, 1)}
MARGIN = 0.02  # of the image, that a board keeps from its border
STEEPEST = np.radians(60.0)  # incidence of beams and of lines of sight


@dataclass(frozen=True)
class Candidates:
    """Placements that could come next.

    Attributes
    ----------
    distance, bearing, elevation : ndarray, shape (n,)
        Of the board's middle from the LRF: metres, radians to the left and upwards.
    turn : ndarray, shape (n,)
        In the board's plane, anticlockwise as the rig sees it; 0 with the board's x to the right, radians.
    lean : ndarray, shape (n,)
        Out of the upright plane that faces the LRF, radians.
    towards : ndarray of str, shape (n,)
        'back' (the top farther away), 'forward', 'left', 'right'; '' upright.
    boards : ndarray, shape (n, 3, 4)
        ``T_platform_board``.
    pitches : ndarray, shape (n, k)
        Of the images, radians.
    """

    distance: np.ndarray
    bearing: np.ndarray
    elevation: np.ndarray
    turn: np.ndarray
    lean: np.ndarray
    towards: np.ndarray
    boards: np.ndarray
    pitches: np.ndarray

    def __len__(self):
        return len(self.distance)

    def take(self, rows):
        """Some of them."""
        return Candidates(**{name: value[rows] for name, value in vars(self).items()})


def board_grid(solution, distances, bearings, elevations, turns, leans):
    """All combinations of a grid of poses, visible or not.

    Parameters
    ----------
    solution : JointSolution
    distances, bearings, elevations, turns, leans : array_like
        See :class:`Candidates`; every lean above zero in four directions.

    Returns
    -------
    Candidates
        Without images.
    """
    poses = [(0.0, "")] * (0.0 in leans) + [(lean, way) for lean in leans if lean for way in LEANS]
    which = np.arange(len(poses))
    axes = np.meshgrid(distances, bearings, elevations, turns, which, indexing="ij")
    distance, bearing, elevation, turn, index = (a.ravel() for a in axes)
    lean = np.array([pose[0] for pose in poses])[index]
    towards = np.array([pose[1] for pose in poses])[index]
    way = np.array([LEANS.get(pose[1], (0, 0)) for pose in poses], float)[index]
    spin = Rotation.from_rotvec(turn[:, None] * [0.0, 0.0, 1.0])
    tip = Rotation.from_rotvec(np.column_stack([lean[:, None] * way, 0 * lean]))
    face = Rotation.from_euler("ZX", np.column_stack([bearing, elevation])) * Rotation.from_matrix(FACING) * tip * spin
    ahead = np.stack([-np.sin(bearing) * np.cos(elevation), np.cos(bearing) * np.cos(elevation), np.sin(elevation)], -1)
    middle = np.append(outline(solution).mean(axis=0), 0.0)
    head = solution.T_head_lrf
    rotation = (head.rotation * face).as_matrix()
    centre = head.apply(distance[:, None] * ahead)
    boards = np.concatenate([rotation, (centre - rotation @ middle)[..., None]], axis=-1)
    return Candidates(distance, bearing, elevation, turn, lean, towards, boards, np.zeros((len(distance), 0)))


def outline(solution):
    """Corners of the board, shape (e, 2), metres; with the sizes that were estimated."""
    lines = solution.data.lines.copy()
    lines[:, 2] -= solution.state.size
    return corners_of_lines(lines)


def visible(candidates, solution, models, field_of_view, pitch_limits, images):
    """Those whose board lies wholly in the view of LRF and cameras, with the pitch angles of their images.

    Parameters
    ----------
    candidates : Candidates
    solution : JointSolution
    models : dict of str to CameraModel
    field_of_view, pitch_limits : tuple of float
        First and last bearing, and pitch, radians.
    images : int
        Spread over the pitch angles at which every camera sees the board.

    Returns
    -------
    Candidates
    """
    corners = np.column_stack([outline(solution), np.zeros(len(solution.data.lines))])
    points = apply_pose(candidates.boards, corners)
    bearing, pitch, _ = beams_to(points, solution.T_head_lrf)
    inside = (bearing > field_of_view[0]) & (bearing < field_of_view[1])
    inside &= (pitch > pitch_limits[0]) & (pitch < pitch_limits[1])
    away = points - solution.T_head_lrf.translation
    normal = candidates.boards[:, None, :, 2]
    slant = -np.sum(away * normal, axis=-1) / np.linalg.norm(away, axis=-1)
    good = np.all(inside & (slant > np.cos(STEEPEST)), axis=1)
    candidates, points = candidates.take(good), points[good]
    lattice = np.linspace(*pitch_limits, max(3, 1 + round(np.ptp(pitch_limits) / np.radians(1.5))))
    seen = np.ones((len(points), len(lattice)), bool)
    for name in solution.transforms:
        seen &= _in_image(candidates, points, solution, name, models[name], lattice)
    some = seen.any(axis=1)
    low = lattice[np.argmax(seen[some], axis=1)]
    high = lattice[len(lattice) - 1 - np.argmax(seen[some][:, ::-1], axis=1)]
    images = images if any(solution.data.on_head) else 1
    share = np.linspace(0, 1, images) if images > 1 else np.array([0.5])
    pitches = low[:, None] + (high - low)[:, None] * share
    return replace(candidates.take(some), pitches=pitches)


def camera_poses(solution, name, pitch):
    """``T_camera_platform`` at pitch angles, as rotations (..., 3, 3) and translations (..., 3)."""
    number = list(solution.transforms).index(name)
    pose, head = solution.state.cameras[number], solution.state.head
    if not solution.data.on_head[number]:
        shape = np.shape(pitch)
        return np.broadcast_to(pose[:, :3], shape + (3, 3)), np.broadcast_to(pose[:, 3], shape + (3,))
    A = pose[:, :3] @ head[:, :3].T
    eye = np.broadcast_to(np.eye(3), np.shape(pitch) + (3, 3))
    back = np.swapaxes(tilt(eye, -np.asarray(pitch)[..., None]), -1, -2)
    return A @ back, np.broadcast_to(pose[:, 3] - A @ head[:, 3], np.shape(pitch) + (3,))


def _in_image(candidates, points, solution, name, model, lattice):
    """At which pitch angles a camera sees whole boards, shape (n, p)."""
    R, t = camera_poses(solution, name, lattice)
    p = np.einsum("pij,nkj->npki", R, points) + t[:, None, :]
    uv = project(p, model)
    # far outside the image the lens model folds back: only rays near the image count
    tangent = np.abs(p[..., :2] / np.where(p[..., 2:] > 0, p[..., 2:], np.nan))
    widest = 1.3 * np.array([model.width / model.fx, model.height / model.fy]) / 2
    border = MARGIN * np.array([model.width, model.height])
    inside = (uv > border) & (uv < [model.width, model.height] - border) & (tangent < widest)
    normal = np.einsum("pij,nj->npi", R, candidates.boards[:, :, 2])
    slant = -np.einsum("npki,npi->npk", p, normal) / np.linalg.norm(p, axis=-1)
    return np.all(inside.all(axis=-1) & (slant > np.cos(STEEPEST)), axis=2)


def own_placements(solution):
    """The placements of a solution as candidates, without images."""
    boards = solution.state.boards
    zero = np.zeros(len(boards))
    return Candidates(zero, zero, zero, zero, zero, np.full(len(boards), ""), boards, np.zeros((len(boards), 0)))


def placed(candidates, row):
    """``T_platform_board`` of a candidate."""
    return pose_transform(candidates.boards[row])


Z_NODES = np.array([-3.0, -1.5, 0.0, 1.5, 3.0])  # distances of sampled beams from where readings flip, in softnesses
ALONG = (np.arange(5) + 0.5) / 5
CHUNK = 400  # placements at a time: memory


@dataclass(frozen=True)
class Yield:
    """What a placement of this recording brings: steps of the scans and how many of the beams get used.

    Attributes
    ----------
    bearing_step, pitch_step : float
        Radians.
    spot : ndarray, shape (2,)
        Growth with distance and constant of the spot's radius.
    background : float
        See :mod:`lrfcal_lib.fit.residuals`.
    faces, cells : int
        Most ranges a placement, and most beams an edge.
    face_share, edge_share : float
        Of the beams that hit a board, and of the information about its edges, that really arrive.
    features : ndarray, shape (k, 3)
        What the cameras see of the board.
    pixels : ndarray, shape (6,)
        Standard deviations of the board's pose in an image, relative to that from features at 1 px each.
    """

    bearing_step: float
    pitch_step: float
    spot: np.ndarray
    background: float
    faces: int
    cells: int
    features: np.ndarray
    face_share: float = 1.0
    edge_share: float = 1.0
    pixels: np.ndarray | float = 1.0


def measure_yield(solution, models, steps=None, features=None):
    """Compare the placements of a solution with what is predicted for the same poses.

    Parameters
    ----------
    solution : JointSolution
    models : dict of str to CameraModel
    steps : tuple of float, optional
        Bearing and pitch step, radians; from the observations when left out.
    features : ndarray, shape (k, 3), optional
        What the cameras see of the board (its pattern), board frame, metres; all over it when left out.

    Returns
    -------
    Yield
    """
    data = solution.data
    bearing_step, pitch_step = steps or _steps(data)
    edges = [(data.beam["edge"] == e) & data.beam["used"] for e in range(len(data.lines))]
    cells = max(int(mine.sum(axis=1).max(initial=0)) for mine in edges)
    faces = int(data.face["used"].sum(axis=1).max(initial=0))
    background = float(np.median(data.beam["background"][data.beam["used"]])) if data.beam["used"].any() else 0.0
    features = _inner(outline(solution), 8) if features is None else np.asarray(features, float)
    first = Yield(bearing_step, pitch_step, _spot(solution), background, faces, cells, features)
    here = own_placements(solution)
    count, wanted = data.face["used"].sum(axis=1), np.sum(_faces(here, solution, first)["used"] ** 2, axis=1)
    face_share = _share(count, wanted)
    edge_share = _share(_edge_information(solution, data), _edge_information(solution, replace(
        data, beam=_beams(here, solution, first)), here.boards))  # fmt: skip
    return replace(first, face_share=face_share, edge_share=edge_share, pixels=_pixels(solution, models, features))


def _share(found, expected):
    good = (np.asarray(expected) > 0) & (np.asarray(found) > 0)
    return float(np.clip(np.median(found[good] / expected[good]), 0.05, 1.5)) if good.any() else 1.0


def _steps(data):
    """Median step between neighbouring beams of a scan line, and between scan lines."""
    group = data.beam if data.beam["used"].any() else data.face
    along, across = [], []
    for bearing, pitch, used in zip(group["bearing"], group["pitch"], group["used"], strict=True):
        lines = np.unique(pitch[used].round(7))
        across.append(np.diff(lines))
        along.append(np.diff(np.unique(bearing[used].round(7))))
    along, across = np.concatenate(along), np.concatenate(across)
    both = [np.median(x[x > 1e-5]) if np.any(x > 1e-5) else np.radians(0.5) for x in (along, across)]
    return float(both[0]), float(both[1])


def _spot(solution):
    """Radius of the spot over distance, fitted to the observations: growth and constant."""
    used = solution.data.beam["used"]
    rows = used.any(axis=1)
    if not rows.any():
        return np.array([0.0, 0.005])
    radius = np.array([np.median(r[u]) for r, u in zip(solution.data.beam["radius"][rows], used[rows], strict=True)])
    distance = np.linalg.norm(solution.state.boards[rows, :, 3], axis=1)
    if np.ptp(distance) < 0.1 or np.ptp(radius) < 1e-6:
        return np.array([0.0, np.median(radius)])
    return np.polyfit(distance, radius, 1)


def _pixels(solution, models, features):
    """Standard deviations of poses in the images, relative to those from features at 1 px each, shape (6,)."""
    data = solution.data
    ratios = []
    for number, name in enumerate(solution.transforms):
        mine = data.view["used"] & (data.view["camera"] == number)
        if mine.any():
            pose = data.view["pose"][mine]
            predicted = _view_covariance(pose[:, :3, :3], pose[:, :3, 3], features, models[name])
            both = (np.diagonal(C, axis1=1, axis2=2) for C in (data.view["covariance"][mine], predicted))
            ratios.append(np.sqrt(np.divide(*both)))
    return np.median(np.concatenate(ratios), axis=0) if ratios else np.ones(6)


def _view_covariance(R, t, features, model):
    """Covariance of board poses in a camera from features of the board, 1 px each, shape (n, 6, 6)."""
    turned = features @ np.swapaxes(R, -1, -2)
    by_point = project_jacobians(turned + t[:, None], model)[0]
    J = np.concatenate([np.cross(turned[..., None, :], by_point), by_point], axis=-1)
    return np.linalg.inv(np.einsum("nkai,nkaj->nij", J, J))


def _inner(corners, number):
    """Points spread over a polygon (convex or nearly so), shape (n, 3)."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle = (np.arange(number) + 0.5) / number
    x = np.stack(np.meshgrid(*(low[i] + middle * (high - low)[i] for i in (0, 1))), -1).reshape(-1, 2)
    along = np.roll(corners, -1, axis=0) - corners
    side = along[:, 0] * (x[:, None, 1] - corners[:, 1]) - along[:, 1] * (x[:, None, 0] - corners[:, 0])
    x = x[np.all(side > 0, axis=1) | np.all(side < 0, axis=1)]
    return np.column_stack([x, np.zeros(len(x))])


def _density(points, distance, bearing, rate):
    """Beams per square metre across the beam."""
    return 1 / (distance**2 * rate.bearing_step * rate.pitch_step * np.maximum(np.sin(bearing), 0.1))


def _faces(candidates, solution, rate):
    """Weighted samples of the boards' faces: `used` is the root of how many beams there are (a whitener)."""
    corners = outline(solution)
    local = _inner(corners, 5)
    points = apply_pose(candidates.boards, local)
    bearing, pitch, distance = beams_to(points, solution.T_head_lrf)
    ray = (points - solution.T_head_lrf.translation) / distance[..., None]
    slant = np.abs(np.sum(ray * candidates.boards[:, None, :, 2], axis=-1))
    area = 0.5 * abs(np.sum(corners[:, 0] * np.roll(corners[:, 1], -1) - np.roll(corners[:, 0], -1) * corners[:, 1]))
    number = _density(points, distance, bearing, rate) * slant * area / len(local)
    total = number.sum(axis=1, keepdims=True)
    used = np.sqrt(number * np.minimum(rate.face_share, rate.faces / total))
    sigma = solution.data.face["sigma"][solution.data.face["used"]]
    sigma = np.full(bearing.shape, np.median(sigma) if len(sigma) else 1.0)
    rays = np.stack([np.cos(bearing), np.sin(bearing), 0 * bearing], axis=-1)
    return {"range": distance, "bearing": bearing, "pitch": pitch, "sigma": sigma, "ray": rays, "used": used}


def _beams(candidates, solution, rate):
    """Weighted samples of beams about the edges; `used` is how many of them there are that read so."""
    corners, lines = outline(solution), solution.data.lines
    edges = len(lines)
    along = np.roll(corners, -1, axis=0) - corners
    place = corners[:, None] + ALONG[:, None] * along[:, None]
    local = np.column_stack([place.reshape(-1, 2), np.zeros(edges * len(ALONG))])
    edge = np.repeat(np.arange(edges), len(ALONG))
    points = apply_pose(candidates.boards, local)
    bearing, _, distance = beams_to(points, solution.T_head_lrf)
    R = candidates.boards[:, :, :3]
    ray = ((points - solution.T_head_lrf.translation) @ R) / distance[..., None]
    length = np.linalg.norm(along, axis=1)
    direction = np.column_stack([along / length[:, None], np.zeros(edges)])[edge]
    across = np.linalg.norm(np.cross(ray, direction), axis=-1)
    radius = np.maximum(np.polyval(rate.spot, distance), 1e-4)
    step = np.sqrt(rate.bearing_step * rate.pitch_step) * distance
    sigma, _ = flip_sigma(np.exp(solution.state.sensor[2]), radius, step)
    shift = edge_shift(solution.state.sensor[1], radius, rate.background)[0]
    density = _density(points, distance, bearing, rate)
    free = np.maximum(length[edge] - 4 * radius, 0.0)  # beams near a corner are not used
    number = density * free * across / len(ALONG) * sigma * (Z_NODES[1] - Z_NODES[0])
    rows = np.sum((density * free * across * 4 * step).reshape(len(points), edges, -1), axis=2) / len(ALONG)
    kept = np.minimum(1.0, rate.cells / np.maximum(rows, 1e-9))[:, edge] * rate.edge_share
    outside = (shift[..., None] - Z_NODES * sigma[..., None]) * (across / np.abs(ray[..., 2]))[..., None]
    return _beam_group(candidates, solution, local, edge, outside, (radius, step), number * kept, rate.background)


def _beam_group(candidates, solution, local, edge, outside, sizes, number, background):
    """Beams at distances outside the edges (n, points, z), each as a hit and as a miss."""
    n, shape = len(candidates), outside.shape
    normal = np.column_stack([solution.data.lines[edge, :2], np.zeros(len(edge))])
    points = local[None, :, None] + outside[..., None] * normal[None, :, None]
    points = apply_pose(candidates.boards, points.reshape(n, -1, 3))
    bearing, pitch, _ = beams_to(points, solution.T_head_lrf)
    share = np.broadcast_to(norm.cdf(Z_NODES), shape)
    used = np.concatenate([(number[..., None] * p).reshape(n, -1) for p in (share, 1 - share)], axis=1)
    hit = np.broadcast_to(np.arange(2 * bearing.shape[1]) < bearing.shape[1], used.shape)
    wide = np.broadcast_to(edge[None, :, None], shape).reshape(n, -1)
    radius, step = (np.repeat(size, len(Z_NODES), axis=1) for size in sizes)
    twice = {"bearing": bearing, "pitch": pitch, "edge": wide, "radius": radius, "step": step}
    group = {name: np.concatenate([value, value], axis=1) for name, value in twice.items()}
    b = group["bearing"]
    group["ray"] = np.stack([np.cos(b), np.sin(b), 0 * b], axis=-1)
    return group | {"hit": hit, "used": used, "background": np.full(used.shape, background)}


def _views(candidates, solution, models, rate):
    """Poses of the boards in all images."""
    parts = {"camera": [], "pitch": [], "pose": [], "covariance": []}
    for number, name in enumerate(solution.transforms):
        pitches = candidates.pitches if solution.data.on_head[number] else candidates.pitches[:, :1]
        for pitch in pitches.T:
            R, t = camera_poses(solution, name, pitch)
            pose = np.tile(np.eye(4), (len(pitch), 1, 1))
            pose[:, :3, :3] = R @ candidates.boards[:, :, :3]
            pose[:, :3, 3] = (R @ candidates.boards[:, :, 3:])[..., 0] + t
            covariance = _view_covariance(pose[:, :3, :3], pose[:, :3, 3], rate.features, models[name])
            covariance = covariance * np.multiply.outer(rate.pixels, rate.pixels)
            for key, value in zip(parts, (np.full(len(pitch), number), pitch, pose, covariance), strict=True):
                parts[key].append(value)
    if not parts["camera"]:
        return {key: value[: len(candidates)] for key, value in solution.data.view.items()}
    out = {key: np.stack(value, axis=1) for key, value in parts.items()}
    whitener = np.linalg.inv(np.linalg.cholesky(out["covariance"]))
    return out | {"whitener": whitener, "used": np.ones(out["pitch"].shape, bool)}


def _candidate_state(solution, boards):
    n = len(boards)
    state = solution.state
    return replace(state, boards=boards, sweeps=np.zeros((n, 2)), sides=np.zeros((n, state.sides.shape[1])))


def _edge_information(solution, data, boards=None):
    """Sum of the information about the distances of edges, of each placement."""
    state = solution.state if boards is None else _candidate_state(solution, boards)
    block = named_blocks(state, data, solution.unknowns).get("beam")
    if block is None:
        return np.zeros(len(state.boards))
    c = solution.unknowns.shared
    root = np.linalg.norm(block.jacobian[..., c + 3 : c + 6], axis=-1) * block.whitener
    return np.sum(root**2, axis=1)


def candidate_information(candidates, solution, models, rate):
    """Information that each candidate would add about the shared unknowns.

    Parameters
    ----------
    candidates : Candidates
    solution : JointSolution
    models : dict of str to CameraModel
    rate : Yield

    Returns
    -------
    ndarray, shape (n, c, c)
        Its own pose and sweep eliminated; at the noise levels of the solution.
    """
    found = []
    for first in range(0, len(candidates), CHUNK):
        some = candidates.take(slice(first, first + CHUNK))
        n = len(some)
        view = _views(some, solution, models, rate)
        groups = {"face": _faces(some, solution, rate), "beam": _beams(some, solution, rate), "view": view}
        for name in groups:
            if not getattr(solution.data, name)["used"].any():
                groups[name]["used"] = np.zeros_like(groups[name]["used"])
        middle = np.nanmean(groups["face"]["pitch"], axis=1)
        data = replace(solution.data, **groups, middle=middle, direction=np.ones(n, int))
        hessian = 0.0
        for block in named_blocks(_candidate_state(solution, some.boards), data, solution.unknowns).values():
            J = whiten(block)[1]
            hessian = hessian + np.swapaxes(J, -1, -2) @ J
        found.append(reduced_hessian(hessian, solution.unknowns.shared) / solution.solution.inflation)
    c = solution.unknowns.shared
    return np.concatenate(found) if found else np.zeros((0, c, c))


RADIUS = 2.0  # metres: a turn counts as much as what it shifts at this distance
PRIOR = 1.0  # metres at RADIUS, so that what is not observed at all can be compared as well
LARGE = 0.5  # components of a direction below this share of the largest are not named
MOST = 3  # parts of a direction that are named
FIELD_OF_VIEW = (np.radians(40), np.radians(140))
PITCH_LIMITS = (np.radians(-30), np.radians(30))
OTHERS = {
    "range_offset": "the range offset",
    "edge_log_odds": "the edge bias",
    "pitch_scale": "the scale of the pitch",
    "pitch_by_direction": "the pitch offset by sweep direction",
}
PLACES = {
    "distances": (1.0, 1.5, 2.0, 2.5, 3.0),
    "bearings": tuple(np.radians([-20, -10, 0, 10, 20])),
    "elevations": tuple(np.radians([-12, 0, 12])),
    "turns": tuple(np.radians(np.arange(0, 360, 60))),
    "leans": tuple(np.radians([0, 35])),
}


@dataclass(frozen=True)
class Direction:
    """A combination of unknowns that is known more or less well by itself.

    Attributes
    ----------
    value : float
        Singular value of the scaled information: reciprocal of `sigma`, per metre.
    words : str
    sigma : float
        Standard deviation, metres at a distance of 2 m; inf where it is not observed.
    """

    value: float
    words: str
    sigma: float


def scales_of(solution, names):
    """How much of each unknown makes a metre at 2 m."""
    used = solution.data.beam["used"]
    radius = np.median(solution.data.beam["radius"][used]) if used.any() else 0.01
    special = {"range_offset": 1.0, "edge_log_odds": 2.0 / radius}
    turns = (*AXIS_NAMES[:2], "pitch_scale", "pitch_by_direction")
    plain = [1 / RADIUS if n in turns or n[-3:] in ("_rx", "_ry", "_rz") else 1.0 for n in names]
    return np.array([special.get(n, p) for n, p in zip(names, plain, strict=True)])


def _marginal(hessian, index):
    """Information on some unknowns with the others eliminated, shape (..., k, k)."""
    rest = np.setdiff1d(np.arange(hessian.shape[-1]), index)
    cross = hessian[..., index[:, None], rest]
    inverse = np.linalg.pinv(hessian[..., rest[:, None], rest], rcond=1e-13, hermitian=True)
    return hessian[..., index[:, None], index] - cross @ inverse @ np.swapaxes(cross, -1, -2)


def observability(solution):
    """Singular values and directions of the scaled information.

    Parameters
    ----------
    solution : JointSolution

    Returns
    -------
    list of Direction
        The least known first. Softness of the edges and sizes of the board are eliminated.
    """
    names = np.array(solution.solution.names)
    index = np.array([i for i, n in enumerate(names) if n != "edge_log_softness" and not n.startswith("size_")])
    scales = scales_of(solution, names[index])
    H = _marginal(information(solution).sum(axis=0), index)
    values, vectors = np.linalg.eigh(H * scales[:, None] * scales)
    least = max(1e-13 * values[-1], UNSEEN**-2)
    cameras = tuple(solution.transforms)
    return [
        Direction(float(np.sqrt(max(v, 0.0))), direction_words(x, names[index], cameras), _sigma(v, least))
        for v, x in zip(values, vectors.T, strict=True)
    ]


def _sigma(value, least):
    return float(value**-0.5) if value > least else np.inf


def direction_words(direction, names, cameras):
    """A direction of scaled unknowns in words.

    Parameters
    ----------
    direction : ndarray, shape (k,)
        In metres at 2 m.
    names : sequence of str
    cameras : sequence of str

    Returns
    -------
    str
        At most three parts; what the cameras have in common is said once.
    """
    direction = np.asarray(direction) / np.max(np.abs(direction))
    value = dict(zip(names, direction, strict=True))
    single = dict(zip(AXIS_NAMES, AXIS_WORDS, strict=True)) | OTHERS
    words = [(abs(value[n]), w) for n, w in single.items() if n in value]
    poses = {c: np.array([value[f"{c}_{p}"] for p in POSE_NAMES]) for c in cameras}
    for kind, part in (("rotation about", slice(0, 3)), ("shift along", slice(3, 6))):
        words += _camera_words(kind, {c: pose[part] for c, pose in poses.items()})
    words.sort(key=lambda pair: -pair[0])
    return " with ".join(w for size, w in words[:MOST] if size > LARGE * words[0][0])


def _camera_words(kind, found):
    """Sizes of rotations or shifts of cameras, and words; said once where all move alike."""
    vectors = list(found.values())
    mean = np.mean(vectors, axis=0) if vectors else np.zeros(3)
    if len(vectors) > 1 and all(np.linalg.norm(v - mean) < 0.3 * np.linalg.norm(mean) for v in vectors):
        return [(np.linalg.norm(mean), f"{kind} {_main_axes(mean)} of all cameras")]
    return [(np.linalg.norm(v), f"{kind} {_main_axes(v)} of camera '{c}'") for c, v in found.items() if v.any()]


def _main_axes(vector):
    """The axes that a vector mostly lies along, e.g. ``x`` or ``y and z``."""
    return " and ".join(np.array(["x", "y", "z"])[np.abs(vector) > 0.4 * np.linalg.norm(vector)])


@dataclass(frozen=True)
class Suggestion:
    """The placement that would shrink the uncertainty most.

    Attributes
    ----------
    T_platform_board : RigidTransform
    distance, bearing, elevation, turn, lean : float
        See :class:`lrfcal_lib.evaluate.next_placement.Candidates`; metres and radians.
    towards : str
    pitches : ndarray, shape (k,)
        Of the images, radians.
    before, after : dict of str to float
        Standard deviation of 'axis' and of each camera, metres at 2 m (root of the sum of the variances of rotation
        times 2 m and of translation), of the propagated noise.
    covariance_after : ndarray, shape (c, c)
        Predicted, of the shared unknowns.
    gain : float
        By how much the criterion's standard deviation shrinks, a fraction.
    median_gain : float
        Of all candidates: what a placement chosen blindly brings.
    candidates : int
        How many were compared.
    criterion : {'A', 'D'}
    on_head : bool
        Whether the pitch of the images matters.
    """

    T_platform_board: RigidTransform
    distance: float
    bearing: float
    elevation: float
    turn: float
    lean: float
    towards: str
    pitches: np.ndarray
    before: dict
    after: dict
    covariance_after: np.ndarray
    gain: float
    median_gain: float
    candidates: int
    criterion: str
    on_head: bool

    def words(self):
        """The pose in words, e.g. ``board 1.5 m ahead, 20 deg to the left, turned 60 deg in its plane, ...``."""
        parts = [f"board {self.distance:.1f} m ahead"]
        for angle, plus, minus in ((self.bearing, "to the left", "to the right"), (self.elevation, "up", "down")):
            if round(np.degrees(angle)):
                parts.append(f"{abs(np.degrees(angle)):.0f} deg {plus if angle > 0 else minus}")
        if round(np.degrees(self.turn)):
            parts.append(f"turned {np.degrees(self.turn):.0f} deg in its plane")
        way = {"back": "leaning back", "forward": "leaning forward"}.get(self.towards, f"facing {self.towards} by")
        parts.append(f"{way} {np.degrees(self.lean):.0f} deg" if self.towards else "upright")
        if not self.on_head:
            return ", ".join(parts)
        angles = [f"{np.degrees(p):+.0f}" for p in self.pitches]
        images = " and ".join([", ".join(angles[:-1]), angles[-1]] if len(angles) > 1 else angles)
        return ", ".join(parts) + f"; images at pitch {images} deg"

    def sentence(self):
        """What to record next and what it brings."""
        known = ", ".join(
            f"{name} {brief(1000 * self.before[name])} to {brief(1000 * self.after[name])} mm" for name in self.before
        )
        gain, blind = 100 * self.gain, 100 * self.median_gain
        return (
            f"Record next: {self.words()}. Predicted standard deviations at 2 m: {known} ({gain:.0f} % less; a blindly "
            f"chosen placement: {blind:.0f} %)."
        )


def brief(value):
    """A number with two digits, or more before the point."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"


def suggest_placement(
    solution,
    models,
    *,
    criterion="A",
    field_of_view=FIELD_OF_VIEW,
    pitch_limits=PITCH_LIMITS,
    images=3,
    steps=None,
    features=None,
    places=None,
):
    """The board pose and pitch angles of images that would shrink the uncertainty most.

    Parameters
    ----------
    solution : JointSolution
    models : dict of str to CameraModel
        Of every camera of the solution.
    criterion : {'A', 'D'}
        Least sum of variances of axis and cameras in metres at 2 m, or least volume.
    field_of_view, pitch_limits : tuple of float
        Bearings that the LRF measures and pitch angles that the platform reaches, radians.
    images : int
        Of each camera on the head; cameras on the base take one.
    steps, features
        See :func:`lrfcal_lib.evaluate.next_placement.measure_yield`.
    places : dict of str to sequence of float, optional
        Replaces entries of `PLACES`.

    Returns
    -------
    Suggestion

    Raises
    ------
    ValueError
        For an unknown criterion, a camera without a model, or limits out of order.
    DegenerateGeometry
        When no pose of the grid is seen by all.
    """
    _check(solution, models, criterion, field_of_view, pitch_limits)
    grid = board_grid(solution, **{**PLACES, **(places or {})})
    options = visible(grid, solution, models, field_of_view, pitch_limits, images)
    if len(options) == 0:
        low, high = np.degrees(pitch_limits)
        raise DegenerateGeometry(
            f"none of {len(grid)} board poses lies wholly in the view of the LRF and of all cameras at a pitch from "
            f"{low:.0f} to {high:.0f} deg: give other distances, wider limits, or check the calibration"
        )
    known = information(solution).sum(axis=0)
    added = candidate_information(options, solution, models, measure_yield(solution, models, steps, features))
    before, covariances = _covariances(known, solution), _covariances(known + added, solution)
    start, values = (_criterion(C, solution, criterion) for C in (before, covariances))
    best = int(np.argmin(values))
    return _suggestion(solution, options, best, before, covariances[best], 1 - values / start, criterion)


def _check(solution, models, criterion, field_of_view, pitch_limits):
    if criterion not in ("A", "D"):
        raise ValueError(f"criterion is 'A' or 'D', got {criterion!r}")
    missing = [c for c in solution.transforms if c not in models]
    if missing:
        raise ValueError(f"camera '{missing[0]}' has no intrinsics: give its CameraModel in `models`")
    for name, limits in (("field_of_view", field_of_view), ("pitch_limits", pitch_limits)):
        if not limits[0] < limits[1]:
            raise ValueError(f"{name} must be (lower, upper) in radians, got {limits}")


def _covariances(hessian, solution):
    """Covariances of the shared unknowns; what is not observed counts as known to a metre at 2 m, not better."""
    unit = PRIOR * scales_of(solution, solution.solution.names)
    scaled = hessian * unit[:, None] * unit + np.eye(len(unit))
    return np.linalg.inv(scaled) * unit[:, None] * unit


def _groups(solution):
    """Indices of the unknowns of the axis and of each camera."""
    found = {"axis": [i for i, n in enumerate(solution.solution.names) if n in AXIS_NAMES]}
    found |= {c: solution.columns(f"{c}_") for c in solution.transforms}
    return {name: index for name, index in found.items() if index}


def _scaled(covariance, solution, index):
    scales = scales_of(solution, np.array(solution.solution.names)[index])
    return covariance[..., np.array(index)[:, None], index] / (scales[:, None] * scales)


def _criterion(covariance, solution, criterion):
    """Standard deviation to be made small, metres at 2 m, (...)."""
    index = sum(_groups(solution).values(), [])
    C = _scaled(covariance, solution, index)
    if criterion == "A":
        return np.sqrt(np.trace(C, axis1=-2, axis2=-1))
    return np.exp(np.linalg.slogdet(C)[1] / (2 * len(index)))


def group_sigma(covariance, solution):
    """Standard deviation of the axis and of each camera, metres at 2 m."""
    groups = _groups(solution)
    return {name: float(np.sqrt(np.trace(_scaled(covariance, solution, index)))) for name, index in groups.items()}


def _suggestion(solution, options, best, before, after, gains, criterion):
    pose = {n: float(getattr(options, n)[best]) for n in ("distance", "bearing", "elevation", "turn", "lean")}
    return Suggestion(
        T_platform_board=placed(options, best), **pose, towards=str(options.towards[best]),
        pitches=options.pitches[best], before=group_sigma(before, solution), after=group_sigma(after, solution),
        covariance_after=after, gain=float(gains[best]), median_gain=float(np.median(gains)), candidates=len(options),
        criterion=criterion, on_head=bool(np.any(solution.data.on_head)),
    )  # fmt: skip
