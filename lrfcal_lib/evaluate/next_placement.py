"""What a joint estimate knows badly, and which of the placements that a rig could record next would help most."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import ndtr

from lrfcal_lib.evaluate.uncertainty import beams_to, information, marginal
from lrfcal_lib.fit.least_squares import reduced_hessian, whiten
from lrfcal_lib.fit.residuals import edge_shift, flip_sigma, named_blocks
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.model import geometry
from lrfcal_lib.model.camera import project, project_jacobians
from lrfcal_lib.solvers.joint import UNSEEN, WORDS

FACING = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # upright ahead of the LRF, print towards it
LEANS = {"": (0, 0), "back": (-1, 0), "forward": (1, 0), "left": (0, -1), "right": (0, 1)}
PLACES = {
    "distances": (1.0, 1.5, 2.0, 2.5, 3.0), "bearings": tuple(np.radians([-20, -10, 0, 10, 20])),
    "elevations": tuple(np.radians([-12, 0, 12])), "turns": tuple(np.radians(np.arange(0, 360, 60))),
    "leans": tuple(np.radians([0, 35])),
}  # fmt: skip
FIELD_OF_VIEW = (np.radians(40), np.radians(140))
PITCH_LIMITS = (np.radians(-30), np.radians(30))
LATTICE = np.linspace(*PITCH_LIMITS, 41)  # pitch angles that images are tried at
IMAGES = 3  # of each camera on the head, spread over the pitch angles at which every camera sees the board
MARGIN = 0.02  # of the image, that a board keeps from its border
STEEPEST = np.radians(60.0)  # incidence of beams and of lines of sight
Z_NODES = np.array([-3.0, -1.5, 0.0, 1.5, 3.0])  # distances of sampled beams from where readings flip, in softnesses
ALONG = (np.arange(5) + 0.5) / 5  # an edge
CHUNK = 400  # placements at a time: memory
RADIUS = 2.0  # metres: a turn counts as much as what it shifts at this distance
LARGE, MOST = 0.5, 3  # of a direction, components above this share of the largest are named, and so many of them


def outline(solution):
    """Corners of the board, shape (e, 3), metres."""
    return np.column_stack([solution.observations.corners, np.zeros(len(solution.observations.corners))])


def board_grid(solution, distances, bearings, elevations, turns, leans):
    """All combinations of a grid of poses, visible or not; every lean above zero in four directions.

    A DataFrame with distance of the board's middle from the LRF (metres), bearing to the left, elevation, turn in the
    board's plane (anticlockwise as the rig sees it; 0 with the board's x to the right), lean out of the upright plane
    that faces the LRF (radians), towards ('back' with the top farther away, 'forward', 'left', 'right'; '' upright);
    and ``T_platform_board``, shape (n, 3, 4).
    """
    leant = [(lean, way) for lean in leans for way in LEANS if bool(lean) == bool(way)]
    places = [(*place, *lean) for *place, lean in product(distances, bearings, elevations, turns, leant)]
    places = pd.DataFrame(places, columns=["distance", "bearing", "elevation", "turn", "lean", "towards"])
    gaze = Rotation.from_euler("ZX", places[["bearing", "elevation"]])
    tip = places[["lean"]].to_numpy() * [(*LEANS[way], 0) for way in places.towards]
    spin = Rotation.from_rotvec(places[["turn"]].to_numpy() * [0.0, 0.0, 1.0])
    face, head = gaze * FACING * Rotation.from_rotvec(tip) * spin, solution.T_head_lrf
    rotation = (head.rotation * face).as_matrix()
    centre = head.apply(places[["distance"]].to_numpy() * gaze.apply([0.0, 1.0, 0.0]))
    origin = centre - rotation @ outline(solution).mean(axis=0)
    return places, np.concatenate([rotation, origin[..., None]], axis=-1)


def visible(boards, solution, models, field_of_view):
    """Which boards lie wholly in the view of LRF and cameras, (m,), and the pitch angles of their images, (m, k)."""
    points, normals = geometry.apply_pose(boards, outline(solution)), boards[:, :, 2]
    bearing, pitch, _ = beams_to(points, solution.T_head_lrf)
    inside = (bearing > field_of_view[0]) & (bearing < field_of_view[1])
    inside &= (pitch > PITCH_LIMITS[0]) & (pitch < PITCH_LIMITS[1])
    inside &= _facing(points - solution.T_head_lrf.translation, normals)
    rows = np.flatnonzero(inside.all(axis=1))
    seen = np.ones((len(LATTICE), len(rows)), bool)
    for name in solution.transforms:
        pose, model = camera_poses(solution, name, LATTICE), models[name]
        p, size = geometry.apply_pose(pose[:, None], points[rows]), np.array([model.width, model.height])
        uv, border = project(p, model), MARGIN * size
        # far outside the image the lens model folds back: only rays near the image count
        tangent = np.abs(p[..., :2] / np.where(p[..., 2:] > 0, p[..., 2:], np.nan))
        inside = (uv > border) & (uv < size - border) & (tangent < 0.65 * size / [model.fx, model.fy])
        seen &= np.all(inside.all(axis=-1) & _facing(p, geometry.rotate_points(pose, normals[rows])), axis=2)
    rows, seen = rows[seen.any(axis=0)], seen[:, seen.any(axis=0)]
    low, high = LATTICE[np.argmax(seen, axis=0)], LATTICE[len(LATTICE) - 1 - np.argmax(seen[::-1], axis=0)]
    share = np.linspace(0, 1, IMAGES) if "head" in solution.observations.mounts else np.array([0.5])
    return rows, low[:, None] + (high - low)[:, None] * share


def _facing(sight, normals):
    """Whether lines of sight (..., n, k, 3) meet the fronts of boards (..., n, 3) steeply enough."""
    return -np.sum(sight * normals[..., None, :], axis=-1) > np.cos(STEEPEST) * np.linalg.norm(sight, axis=-1)


def camera_poses(solution, name, pitch):
    """``T_camera_platform`` of a camera at pitch angles (n,), shape (n, 3, 4)."""
    return np.broadcast_to(geometry.pose_array(solution.camera_at(name, pitch)), (len(pitch), 3, 4))


def measure_yield(solution, models, features=None):
    """What a placement of this recording brings, by comparing its placements with what is predicted for the same poses.

    `features`, shape (k, 3), is what the cameras see of the board (its pattern), metres; all over it when left out.
    Returned are, by name, `bearing_step` and `pitch_step` of the scans (radians), `spot` (how the radius of a spot
    grows with distance, and its constant), `background` (see :mod:`lrfcal_lib.fit.residuals`), `faces` and `cells`
    (most ranges of a placement, and most beams about an edge), `features`, `face_share` and `edge_share` (of the beams
    that hit a board, and of the information about its edges, that really arrive), and `pixels` (6,): standard
    deviations of the board's pose in an image, relative to that from features at 1 px each.
    """
    obs, boards = solution.observations, solution.state.boards
    radius = pd.Series(obs.beam_radius).groupby(obs.beam_placement).median()
    distance, spot = np.linalg.norm(boards[radius.index, :, 3], axis=1), np.array([0.0, 0.005])
    if len(radius):
        grows = np.ptp(distance) >= 0.1 and np.ptp(radius) >= 1e-6
        spot = np.polyfit(distance, radius, 1) if grows else np.array([0.0, np.median(radius)])
    cells = np.bincount(obs.beam_placement * len(obs.edges) + obs.beam_edge).max(initial=0)
    features = _inner(solution, 8) if features is None else np.asarray(features, float)
    background = np.median(obs.beam_background) if len(radius) else 0.0
    faces, ratios = np.bincount(obs.face_placement, minlength=len(boards)), []
    rate = SimpleNamespace(spot=spot, background=background, faces=faces.max(), cells=cells, features=features)
    rate.bearing_step, rate.pitch_step = _step(obs, "bearing"), _step(obs, "pitch")
    rate.face_share = rate.edge_share = 1.0
    bare = replace(solution.state, sweeps=0 * solution.state.sweeps, sides=0 * solution.state.sides)
    expected = _edge_information(bare, replace(solution.data, beam=_beams(boards, solution, rate)), solution.unknowns)
    found = _edge_information(solution.state, solution.data, solution.unknowns)
    hits = np.sum(_faces(boards, solution, rate)["used"] ** 2, axis=1)
    for number, name in enumerate(solution.transforms):
        mine = obs.view_camera == number
        both = obs.view_covariance[mine], _view_covariance(obs.view_pose[mine], features, models[name])
        ratios.append(np.sqrt(np.divide(*(np.diagonal(C, axis1=1, axis2=2) for C in both))))
    rate.pixels = np.median(np.concatenate(ratios), axis=0) if len(obs.view_camera) else np.ones(6)
    rate.face_share, rate.edge_share = _share(faces, hits), _share(found, expected)
    return rate


def _step(obs, name):
    """Median step between neighbouring beams ('bearing') or scan lines ('pitch'), radians."""
    group = obs.group("beam" if len(obs.beam_hit) else "face")
    order = np.lexsort((group[name], group["placement"]))
    steps = np.diff(group[name][order].round(7))[np.diff(group["placement"][order]) == 0]
    return float(np.median(steps[steps > 1e-5])) if np.any(steps > 1e-5) else np.radians(0.5)


def _share(found, expected):
    good = (expected > 0) & (found > 0)
    return float(np.clip(np.median(found[good] / expected[good]), 0.05, 1.5)) if good.any() else 1.0


def _view_covariance(pose, features, model):
    """Covariance of board poses (n, 4, 4) in a camera from features of the board, 1 px each, shape (n, 6, 6)."""
    turned = geometry.rotate_points(pose[:, :3], features)
    by_point = project_jacobians(turned + pose[:, None, :3, 3], model)[0]
    J = geometry.gradient_by_pose(turned[..., None, :], by_point)
    return np.linalg.inv(np.einsum("nkai,nkaj->nij", J, J))


def _inner(solution, number):
    """Points spread over the board, shape (n, 3)."""
    corners, middle = outline(solution), (np.arange(number) + 0.5) / number
    low, high = corners.min(axis=0), corners.max(axis=0)
    x = low + np.stack(np.meshgrid(middle, middle, [0.0]), axis=-1).reshape(-1, 3) * (high - low)
    side = np.cross(np.roll(corners, -1, axis=0) - corners, x[:, None] - corners)[..., 2]
    return x[np.all(side > 0, axis=1) | np.all(side < 0, axis=1)]


def _sampled(boards, local, solution, rate):
    """Beams to points of boards: bearing, pitch, range, direction (board frame), beams per square metre across it."""
    points = geometry.apply_pose(boards, local)
    bearing, pitch, distance = beams_to(points, solution.T_head_lrf)
    ray = ((points - solution.T_head_lrf.translation) @ boards[:, :, :3]) / distance[..., None]
    solid_angle = rate.bearing_step * rate.pitch_step * np.maximum(np.sin(bearing), 0.1)
    return bearing, pitch, distance, ray, 1 / (distance**2 * solid_angle)


def _faces(boards, solution, rate):
    """Weighted samples of the boards' faces: `used` is the root of how many beams there are (a whitener)."""
    corners, local, stated = outline(solution), _inner(solution, 5), solution.observations.face_sigma
    bearing, pitch, distance, ray, density = _sampled(boards, local, solution, rate)
    area = np.linalg.norm(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)) / 2
    number = density * np.abs(ray[..., 2]) * area / len(local)
    used = np.sqrt(number * np.minimum(rate.face_share, rate.faces / number.sum(axis=1, keepdims=True)))
    sigma = np.full(bearing.shape, np.median(stated) if len(stated) else 1.0)
    rays = geometry.polar_to_points(1.0, bearing)
    return {"range": distance, "bearing": bearing, "pitch": pitch, "sigma": sigma, "ray": rays, "used": used}


def _beams(boards, solution, rate):
    """Weighted samples of beams about the edges, as hits and as misses; `used`: how many of them read so."""
    corners, n, edges = outline(solution), len(boards), len(solution.observations.edges)
    along = np.roll(corners, -1, axis=0) - corners
    length, edge = np.linalg.norm(along, axis=1), np.repeat(np.arange(edges), len(ALONG))
    local = (corners[:, None] + ALONG[:, None] * along[:, None]).reshape(-1, 3)
    direction, normal = (along / length[:, None])[edge], solution.observations.lines()[edge] * [1, 1, 0]
    bearing, _, distance, ray, density = _sampled(boards, local, solution, rate)
    across = np.linalg.norm(np.cross(ray, direction), axis=-1)
    radius = np.maximum(np.polyval(rate.spot, distance), 1e-4)
    step = np.sqrt(rate.bearing_step * rate.pitch_step) * distance
    sigma = flip_sigma(np.exp(solution.sensor["edge_log_softness"]), radius, step)[0]
    shift = edge_shift(solution.sensor["edge_log_odds"], radius, rate.background)[0]
    # beams per metre off the edge; those near a corner are not used
    number = density * np.maximum(length[edge] - 4 * radius, 0.0) * across / len(ALONG)
    rows = np.sum((number * 4 * step).reshape(n, edges, -1), axis=2)
    kept = np.minimum(1.0, rate.cells / np.maximum(rows, 1e-9))[:, edge] * rate.edge_share
    number = number * sigma * (Z_NODES[1] - Z_NODES[0]) * kept
    outside = (shift[..., None] - Z_NODES * sigma[..., None]) * (across / np.abs(ray[..., 2]))[..., None]
    points = local[:, None] + outside[..., None] * normal[:, None]
    bearing, pitch, _ = beams_to(geometry.apply_pose(boards, points.reshape(n, -1, 3)), solution.T_head_lrf)
    chance = np.stack([ndtr(Z_NODES), ndtr(-Z_NODES)])[:, None]
    number = number[:, None, :, None] * chance  # (n, 2, points, nodes): first the hits
    bearing, pitch = (v.reshape(n, 1, -1, len(Z_NODES)) for v in (bearing, pitch))
    group = {"bearing": bearing, "pitch": pitch, "edge": edge[:, None], "background": rate.background, "used": number}
    group |= {"radius": radius[:, None, :, None], "step": step[:, None, :, None]}
    group["hit"] = np.array([True, False])[:, None, None]
    group = {name: np.broadcast_to(value, number.shape).reshape(n, -1) for name, value in group.items()}
    return group | {"ray": geometry.polar_to_points(1.0, group["bearing"])}


def _views(boards, pitches, solution, models, rate):
    """Poses of the boards in all images."""
    parts = []
    for number, (name, mount) in enumerate(zip(solution.transforms, solution.observations.mounts, strict=True)):
        for pitch in (pitches if mount == "head" else pitches[:, :1]).T:
            pose = geometry.pose_transform(camera_poses(solution, name, pitch)) * geometry.pose_transform(boards)
            covariance = _view_covariance(pose.as_matrix(), rate.features, models[name])
            covariance = covariance * np.outer(rate.pixels, rate.pixels)
            camera = np.full(len(pitch), number)
            parts.append({"camera": camera, "pitch": pitch, "pose": pose.as_matrix(), "covariance": covariance})
    if not parts:
        return {key: value[: len(boards)] for key, value in solution.data.view.items()}
    group = {key: np.stack([part[key] for part in parts], axis=1) for key in parts[0]}
    whitener = np.linalg.inv(np.linalg.cholesky(group["covariance"]))
    return group | {"whitener": whitener, "used": np.ones(group["pitch"].shape, bool)}


def _edge_information(state, data, unknowns):
    """Sum of the information about the distances of edges, of each placement."""
    block = named_blocks(state, data, unknowns).get("beam")
    if block is None:
        return np.zeros(len(state.boards))
    shift = block.jacobian[..., unknowns.shared + 3 : unknowns.shared + 6]
    return np.sum((np.linalg.norm(shift, axis=-1) * block.whitener) ** 2, axis=1)


def candidate_information(boards, pitches, solution, models, rate):
    """Information that each candidate would add about the shared unknowns, shape (n, c, c).

    `boards` (n, 3, 4) are ``T_platform_board``, `pitches` (n, k) those of the images; `rate` is that of
    :func:`measure_yield`. The candidate's own pose and sweep are eliminated; at the noise levels of the solution.
    """
    c, found = solution.unknowns.shared, []
    for first in range(0, len(boards), CHUNK):
        some = boards[first : first + CHUNK]
        view = _views(some, pitches[first : first + CHUNK], solution, models, rate)
        groups = {"face": _faces(some, solution, rate), "beam": _beams(some, solution, rate), "view": view}
        for name, group in groups.items():
            group["used"] = group["used"] * (len(getattr(solution.observations, f"{name}_placement")) > 0)
        middle, direction = np.nanmean(groups["face"]["pitch"], axis=1), np.ones(len(some), int)
        data = replace(solution.data, **groups, middle=middle, direction=direction)
        sides = np.zeros((len(some), solution.state.sides.shape[1]))
        state = replace(solution.state, boards=some, sweeps=np.zeros((len(some), 2)), sides=sides)
        blocks = named_blocks(state, data, solution.unknowns).values()
        hessian = sum(np.swapaxes(J, -1, -2) @ J for J in (whiten(block)[1] for block in blocks))
        found.append(reduced_hessian(hessian, c) / solution.solution.inflation)
    return np.concatenate([*found, np.zeros((0, c, c))])


@dataclass(frozen=True)
class Direction:
    """A combination of unknowns that is known more or less well by itself.

    `sigma` is its standard deviation, metres at a distance of 2 m; inf where it is not observed.
    """

    words: str
    sigma: float


def scales_of(solution, names):
    """How much of each unknown makes a metre at 2 m."""
    radii = solution.observations.beam_radius
    radius = np.median(radii) if len(radii) else 0.01
    turns = (*AXIS_NAMES[:2], "pitch_scale", "pitch_by_direction")
    plain = {name: 1 / RADIUS if name in turns or name[-3:] in ("_rx", "_ry", "_rz") else 1.0 for name in names}
    return np.array([(plain | {"edge_log_odds": 2.0 / radius})[name] for name in names])


def observability(solution):
    """Directions of the scaled information of a JointSolution, the least known first: list of Direction.

    The softness of the edges is eliminated.
    """
    names = np.array(solution.solution.names)
    index = [i for i, n in enumerate(names) if n != "edge_log_softness"]
    scales = scales_of(solution, names[index])
    H = marginal(information(solution).sum(axis=0), index) * scales[:, None] * scales
    values, vectors = np.linalg.eigh(H)
    least, cameras = max(1e-13 * values[-1], UNSEEN**-2), tuple(solution.transforms)
    sigmas = np.where(values > least, np.maximum(values, least) ** -0.5, np.inf)
    found = zip(vectors.T, sigmas.tolist(), strict=True)
    return [Direction(direction_words(x, names[index], cameras), sigma) for x, sigma in found]


def direction_words(direction, names, cameras):
    """A direction (k,) of unknowns, scaled to metres at 2 m, in words; what cameras have in common is said once."""
    value = dict(zip(names, np.asarray(direction) / np.max(np.abs(direction)), strict=True))
    words = [(abs(value[name]), what) for name, what in WORDS.items() if name in value]
    for kind, part in (("rotation about", geometry.POSE_NAMES[:3]), ("shift along", geometry.POSE_NAMES[3:])):
        found = {f"camera '{c}'": np.array([value[f"{c}_{p}"] for p in part]) for c in cameras}
        mean = np.mean([*found.values()], axis=0) if found else 0.0
        if len(found) > 1 and all(np.linalg.norm(v - mean) < 0.3 * np.linalg.norm(mean) for v in found.values()):
            found = {"all cameras": mean}
        for who, vector in found.items():
            size = np.linalg.norm(vector)
            axes = " and ".join(np.array(["x", "y", "z"])[np.abs(vector) > 0.4 * size])
            words += [(size, f"{kind} {axes} of {who}")] * bool(size)
    words.sort(key=lambda pair: -pair[0])
    return " with ".join(w for size, w in words[:MOST] if size > LARGE * words[0][0])


@dataclass(frozen=True)
class Suggestion:
    """The placement that would shrink the uncertainty most.

    Attributes
    ----------
    T_platform_board : RigidTransform
    place : Series
        A row of :func:`board_grid`.
    pitches : ndarray, shape (k,)
        Of the images, radians; None where no camera is on the head.
    before, after : dict of str to float
        Standard deviation of 'axis' and of each camera, metres at 2 m (root of the sum of the variances of rotation
        times 2 m and of translation), of the propagated noise.
    gain, median_gain : float
        By how much the standard deviation of all of them shrinks, a fraction; of all candidates, what a placement
        chosen blindly brings.
    """

    T_platform_board: RigidTransform
    place: pd.Series
    pitches: np.ndarray | None
    before: dict
    after: dict
    gain: float
    median_gain: float

    def words(self):
        """The pose in words, e.g. ``board 1.5 m ahead, 20 deg to the left, turned 60 deg in its plane, ...``."""
        place, parts = self.place, [f"board {self.place.distance:.1f} m ahead"]
        for angle, plus, minus in ((place.bearing, "to the left", "to the right"), (place.elevation, "up", "down")):
            if round(np.degrees(angle)):
                parts.append(f"{abs(np.degrees(angle)):.0f} deg {plus if angle > 0 else minus}")
        if round(np.degrees(place.turn)):
            parts.append(f"turned {np.degrees(place.turn):.0f} deg in its plane")
        way = {"back": "leaning back", "forward": "leaning forward"}.get(place.towards, f"facing {place.towards} by")
        words = ", ".join([*parts, f"{way} {np.degrees(place.lean):.0f} deg" if place.towards else "upright"])
        if self.pitches is None:
            return words
        *most, last = [f"{np.degrees(p):+.0f}" for p in self.pitches]
        return f"{words}; images at pitch {', '.join(most)} and {last} deg"

    def sentence(self):
        """What to record next and what it brings."""
        pairs = ((name, brief(1000 * sigma), brief(1000 * self.after[name])) for name, sigma in self.before.items())
        known = [f"{name} {before} to {after} mm" for name, before, after in pairs]
        return (
            f"Record next: {self.words()}. Predicted standard deviations at 2 m: {', '.join(known)} "
            f"({100 * self.gain:.0f} % less; a blindly chosen placement: {100 * self.median_gain:.0f} %)."
        )


def brief(value):
    """A number with two digits, or more before the point."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"


def suggest_placement(solution, models, *, field_of_view=FIELD_OF_VIEW, features=None, places=None):
    """The board pose and pitch angles of images that would make the summed variances of axis and cameras least.

    Parameters
    ----------
    solution : JointSolution
    models : dict of str to CameraModel
        Of every camera of the solution; a ValueError where one is missing.
    field_of_view : tuple of float
        Bearings that the LRF measures, radians.
    features : ndarray, shape (k, 3), optional
        See :func:`measure_yield`.
    places : dict of str to sequence of float, optional
        Replaces entries of `PLACES`.

    Raises
    ------
    DegenerateGeometry
        When no pose of the grid is seen by all.
    """
    missing = [c for c in solution.transforms if c not in models]
    if missing:
        raise ValueError(f"camera '{missing[0]}' has no intrinsics: give its CameraModel in `models`")
    grid, boards = board_grid(solution, **PLACES | (places or {}))
    rows, pitches = visible(boards, solution, models, field_of_view)
    if len(rows) == 0:
        low, high = np.degrees(PITCH_LIMITS)
        raise geometry.DegenerateGeometry(
            f"none of {len(grid)} board poses lies wholly in the view of the LRF and of all cameras at a pitch from "
            f"{low:.0f} to {high:.0f} deg: give other distances, wider limits, or check the calibration"
        )
    known = information(solution).sum(axis=0)
    added = candidate_information(boards[rows], pitches, solution, models, measure_yield(solution, models, features))
    # what is not observed counts as known to a metre at 2 m, not better, so that it can be compared as well
    unit = np.multiply.outer(*[scales_of(solution, solution.solution.names)] * 2)
    covariances = (np.linalg.inv(H * unit + np.eye(len(unit))) * unit for H in (known, known + added))
    before, after = (group_sigma(C, solution) for C in covariances)
    total, totals = (np.sqrt(sum(sigma**2 for sigma in groups.values())) for groups in (before, after))
    best, gains = int(np.argmin(totals)), 1 - totals / total
    T_platform_board, place = geometry.pose_transform(boards[rows[best]]), grid.iloc[rows[best]]
    pitches = pitches[best] if "head" in solution.observations.mounts else None
    after = {name: sigma[best] for name, sigma in after.items()}
    return Suggestion(T_platform_board, place, pitches, before, after, gains[best], np.median(gains))


def group_sigma(covariance, solution):
    """Standard deviations of the axis and of each camera, metres at 2 m, from covariances (..., c, c)."""
    names = np.array(solution.solution.names)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1) / scales_of(solution, names) ** 2
    groups = {"axis": np.isin(names, AXIS_NAMES)}
    groups |= {camera: np.char.startswith(names, f"{camera}_") for camera in solution.transforms}
    return {name: np.sqrt(variance[..., rows].sum(axis=-1)) for name, rows in groups.items() if rows.any()}
