"""The information that a placement would add to the joint estimate, predicted without drawing anything at random.

A face and its edges are sampled sparsely and weighted with the number of beams that would fall there: the face by its
solid angle, the edges at several distances from where readings flip, once as hits and once as misses. How many of the
beams a recording really uses is taken from its own placements.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from lrfcal_lib.camera import project_jacobians
from lrfcal_lib.candidates import camera_poses, outline, own_placements
from lrfcal_lib.solvers.edge_likelihood import edge_shift, flip_sigma
from lrfcal_lib.solvers.joint_blocks import named_blocks
from lrfcal_lib.solvers.least_squares import whiten
from lrfcal_lib.solvers.observability import reduced_hessian
from lrfcal_lib.solvers.pose import apply_pose
from lrfcal_lib.uncertainty import beams_to

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
        See :mod:`lrfcal_lib.solvers.edge_likelihood`.
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


__all__ = ["Yield", "candidate_information", "measure_yield"]
