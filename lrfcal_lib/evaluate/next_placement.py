"""What a joint estimate knows badly, and which of the placements that a rig could record next
would help most.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.evaluate.uncertainty import beams_to, information, marginal
from lrfcal_lib.fit.least_squares import reduced_hessian, whiten
from lrfcal_lib.fit.residuals import named_blocks, rays
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.model import geometry
from lrfcal_lib.model.camera import project, project_jacobians
from lrfcal_lib.solvers.joint import UNSEEN, WORDS

# upright ahead of the LRF, print towards it
FACING = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
LEANS = {"": (0, 0), "back": (-1, 0), "forward": (1, 0), "left": (0, -1), "right": (0, 1)}
PLACES = {
    "distances": (1.0, 1.5, 2.0, 2.5, 3.0),
    "bearings": tuple(np.radians([-20, -10, 0, 10, 20])),
    "elevations": tuple(np.radians([-12, 0, 12])),
    "turns": tuple(np.radians(np.arange(0, 360, 60))),
    "leans": tuple(np.radians([0, 35])),
}
FIELD_OF_VIEW = (np.radians(40), np.radians(140))
PITCH_LIMITS = (np.radians(-30), np.radians(30))
LATTICE = np.linspace(*PITCH_LIMITS, 41)  # pitch angles that images are tried at
# of each camera on the head, spread over the pitch angles at which every camera sees the board
IMAGES = 3
MARGIN = 0.02  # of the image, that a board keeps from its border
STEEPEST = np.radians(60.0)  # incidence of beams and of lines of sight
THINNED = 3  # times fewer ranges and beams than a placement has, each counted as often: time
RADIUS = 2.0  # metres: a turn counts as much as what it shifts at this distance
# of a direction, components above this share of the largest are named, and so many of them
LARGE = 0.5
MOST = 3


def outline(solution):
    """Corners of the board, shape (e, 3), metres."""
    return np.column_stack(
        [solution.observations.corners, np.zeros(len(solution.observations.corners))]
    )


def board_grid(solution, distances, bearings, elevations, turns, leans):
    """All combinations of a grid of poses, visible or not; every lean above zero in four
    directions.

    A DataFrame with distance of the board's middle from the LRF (metres), bearing to the left,
    elevation, turn in the board's plane (anticlockwise as the rig sees it; 0 with the board's x to
    the right), lean out of the upright plane that faces the LRF (radians), towards ('back' with the
    top farther away, 'forward', 'left', 'right'; '' upright); and ``T_platform_board``, shape (n,
    3, 4).
    """
    leant = [(lean, way) for lean in leans for way in LEANS if bool(lean) == bool(way)]
    places = [
        (*place, *lean) for *place, lean in product(distances, bearings, elevations, turns, leant)
    ]
    places = pd.DataFrame(
        places, columns=["distance", "bearing", "elevation", "turn", "lean", "towards"]
    )
    gaze = Rotation.from_euler("ZX", places[["bearing", "elevation"]])
    tip = places[["lean"]].to_numpy() * [(*LEANS[way], 0) for way in places.towards]
    spin = Rotation.from_rotvec(places[["turn"]].to_numpy() * [0.0, 0.0, 1.0])
    face = gaze * FACING * Rotation.from_rotvec(tip) * spin
    head = solution.T_head_lrf
    rotation = (head.rotation * face).as_matrix()
    centre = head.apply(places[["distance"]].to_numpy() * gaze.apply([0.0, 1.0, 0.0]))
    origin = centre - rotation @ outline(solution).mean(axis=0)
    return places, np.concatenate([rotation, origin[..., None]], axis=-1)


def visible(boards, solution, models, field_of_view):
    """Which boards lie wholly in the view of LRF and cameras, (m,), and the pitch angles of
    their images, (m, k).
    """
    points = geometry.apply_pose(boards, outline(solution))
    normals = boards[:, :, 2]
    bearing, pitch, _ = beams_to(points, solution.T_head_lrf)
    inside = (bearing > field_of_view[0]) & (bearing < field_of_view[1])
    inside &= (pitch > PITCH_LIMITS[0]) & (pitch < PITCH_LIMITS[1])
    inside &= _facing(points - solution.T_head_lrf.translation, normals)
    rows = np.flatnonzero(inside.all(axis=1))
    seen = np.ones((len(LATTICE), len(rows)), bool)
    for name in solution.transforms:
        pose = camera_poses(solution, name, LATTICE)
        model = models[name]
        p = geometry.apply_pose(pose[:, None], points[rows])
        size = np.array([model.width, model.height])
        uv = project(p, model)
        border = MARGIN * size
        # far outside the image the lens model folds back: only rays near the image count
        tangent = np.abs(p[..., :2] / np.where(p[..., 2:] > 0, p[..., 2:], np.nan))
        inside = (
            (uv > border) & (uv < size - border) & (tangent < 0.65 * size / [model.fx, model.fy])
        )
        seen &= np.all(
            inside.all(axis=-1) & _facing(p, geometry.rotate_points(pose, normals[rows])), axis=2
        )
    rows = rows[seen.any(axis=0)]
    seen = seen[:, seen.any(axis=0)]
    low = LATTICE[np.argmax(seen, axis=0)]
    high = LATTICE[len(LATTICE) - 1 - np.argmax(seen[::-1], axis=0)]
    share = np.linspace(0, 1, IMAGES) if "head" in solution.observations.mounts else np.array([0.5])
    return rows, low[:, None] + (high - low)[:, None] * share


def _facing(sight, normals):
    """Whether lines of sight (..., n, k, 3) meet the fronts of boards (..., n, 3) steeply
    enough.
    """
    return -np.sum(sight * normals[..., None, :], axis=-1) > np.cos(STEEPEST) * np.linalg.norm(
        sight, axis=-1
    )


def camera_poses(solution, name, pitch):
    """``T_camera_platform`` of a camera at pitch angles (n,), shape (n, 3, 4)."""
    return np.broadcast_to(geometry.pose_array(solution.camera_at(name, pitch)), (len(pitch), 3, 4))


def _view_covariance(pose, features, model):
    """Covariance of board poses (n, 4, 4) in a camera from features of the board, 1 px each,
    shape (n, 6, 6).
    """
    turned = geometry.rotate_points(pose[:, :3], features)
    by_point = project_jacobians(turned + pose[:, None, :3, 3], model)[0]
    J = geometry.gradient_by_pose(turned[..., None, :], by_point)
    return np.linalg.inv(np.einsum("nkai,nkaj->nij", J, J))


def typical_placement(solution):
    """What the placement of median information recorded: data, state, and points (1, n, 3) of faces
    and of beams.

    The points are where their rays meet the board's plane, metres in its frame.
    """
    told = (
        np.diagonal(information(solution), axis1=1, axis2=2)
        @ scales_of(solution, solution.solution.names) ** 2
    )
    k = np.argsort(told)[[len(told) // 2]]
    state = solution.state
    groups = {}
    points = []
    state = replace(state, boards=state.boards[k], sweeps=state.sweeps[k], sides=state.sides[k])
    data = replace(
        solution.data, middle=solution.data.middle[k], direction=solution.data.direction[k]
    )
    # a whitener of ranges, a number of beams
    for name, weight in (("face", THINNED**0.5), ("beam", THINNED)):
        group = getattr(data, name)
        board = state.boards[0]
        some = np.flatnonzero(group["used"][k[0]])[::THINNED]
        groups[name] = {key: v[k][:, some] for key, v in group.items()} | {
            "used": np.full((1, len(some)), weight)
        }
        o, d = rays(state, data, groups[name])[:2]
        way = (board[:, 3] - o) @ board[:, 2] / (d @ board[:, 2])
        points.append((o + way[..., None] * d - board[:, 3]) @ board[:, :3])
    return replace(data, **groups), state, points


def spot_growth(solution):
    """Radius of the spot by distance, a polynomial."""
    obs = solution.observations
    radius = pd.Series(obs.beam_radius).groupby(obs.beam_placement).median()
    distance = np.linalg.norm(solution.state.boards[radius.index, :, 3], axis=1)
    if len(radius) < 2 or np.ptp(distance) < 0.1 or np.ptp(radius) < 1e-6:
        return np.array([0.0, radius.median() if len(radius) else 0.005])
    return np.polyfit(distance, radius, 1)


def _views(boards, pitches, solution, models, features):
    """Poses of the boards in all images, as well known as the recorded ones are beside those
    from features at 1 px.
    """
    obs = solution.observations
    parts = []
    corners = outline(solution)
    features = (
        np.concatenate([corners, (corners + np.roll(corners, 1, axis=0)) / 2])
        if features is None
        else features
    )
    for number, (name, mount) in enumerate(zip(solution.transforms, obs.mounts, strict=True)):
        mine = obs.view_camera == number
        recorded = np.diagonal(obs.view_covariance[mine], axis1=1, axis2=2)
        expected = np.diagonal(
            _view_covariance(obs.view_pose[mine], features, models[name]), axis1=1, axis2=2
        )
        pixels = np.sqrt(np.median(recorded / expected, axis=0)) if mine.any() else np.ones(6)
        for pitch in (pitches if mount == "head" else pitches[:, :1]).T:
            pose = geometry.pose_transform(
                camera_poses(solution, name, pitch)
            ) * geometry.pose_transform(boards)
            covariance = _view_covariance(pose.as_matrix(), features, models[name]) * np.outer(
                pixels, pixels
            )
            camera = np.full(len(pitch), number)
            parts.append(
                {
                    "camera": camera,
                    "pitch": pitch,
                    "pose": pose.as_matrix(),
                    "covariance": covariance,
                }
            )
    if not parts:
        return {key: value[: len(boards)] for key, value in solution.data.view.items()}
    group = {key: np.stack([part[key] for part in parts], axis=1) for key in parts[0]}
    whitener = np.linalg.inv(np.linalg.cholesky(group["covariance"]))
    return group | {"whitener": whitener, "used": np.ones(group["pitch"].shape, bool)}


def candidate_information(boards, pitches, solution, models, features=None):
    """Information that each candidate would add about the shared unknowns, shape (n, c, c).

    `boards` (n, 3, 4) are ``T_platform_board``, `pitches` (n, k) those of the images. A candidate
    shows what the typical placement of the recording showed, points of the face and beams about the
    edges, from where it stands: spots grow with the distance, and beams get fewer the smaller the
    board looks. Cameras see `features` of it (k, 3), those of its outline when left out. Its own
    pose and sweep are eliminated; at the noise levels of the solution.
    """
    (data, home, (face, beam)) = typical_placement(solution)
    n = len(boards)
    line = data.lines[data.beam["edge"]]
    middle = outline(solution).mean(axis=0, keepdims=True)
    (_, distance, size), (pitch, away, seen) = (
        _as_seen(b, middle, solution.T_head_lrf) for b in (home.boards, boards)
    )
    spot = spot_growth(solution)
    grown = np.polyval(spot, away) / np.polyval(spot, distance)
    off = np.sum((beam + [0, 0, 1.0]) * line, axis=-1)
    most = np.sqrt(
        max(solution.data.face["used"].sum(axis=1).max(), 1) / max(THINNED * face.shape[1], 1)
    )
    factors = {"radius": grown, "step": away / distance, "used": np.minimum(seen / size, most)}
    moved = beam + (grown * off - off)[..., None] * line * [1.0, 1.0, 0.0]
    groups = {
        name: _beams(getattr(data, name), p, boards, solution)
        for name, p in (("face", face), ("beam", moved))
    }
    groups["beam"] |= {key: groups["beam"][key] * factor for key, factor in factors.items()}
    groups["face"]["used"] = groups["face"]["used"] * factors["used"]
    groups["view"] = _views(boards, pitches, solution, models, features)
    state = replace(
        home, boards=boards, sweeps=np.zeros((n, 2)), sides=np.repeat(home.sides, n, axis=0)
    )
    data = replace(data, **groups, middle=pitch[:, 0], direction=np.ones(n, int))
    blocks = named_blocks(state, data, solution.unknowns)
    hessian = sum(
        np.swapaxes(J, -1, -2) @ J for J in (whiten(block)[1] for block in blocks.values())
    )
    return reduced_hessian(hessian, solution.unknowns.shared) / solution.solution.inflation


def _as_seen(boards, middle, T_head_lrf):
    """Pitch and range of beams to the middle (1, 3) of boards (n, 3, 4), and how wide a board
    looks, shapes (n, 1).
    """
    points = geometry.apply_pose(boards, middle)
    _, pitch, away = beams_to(points, T_head_lrf)
    cosine = np.abs(np.vecdot(points - T_head_lrf.translation, boards[:, None, :, 2])) / away
    return pitch, away, np.sqrt(cosine) / away


def _beams(group, points, boards, solution):
    """The beams of a group to points (k, 3) of other boards (n, 3, 4)."""
    bearing, pitch, distance = beams_to(geometry.apply_pose(boards, points), solution.T_head_lrf)
    recorded = pitch / (1 + solution.sensor["pitch_scale"])
    every = {
        key: np.broadcast_to(value, (len(boards), *value.shape[1:])) for key, value in group.items()
    }
    ray = geometry.polar_to_points(1.0, bearing)
    return every | {"bearing": bearing, "pitch": recorded, "range": distance, "ray": ray}


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
    plain = {
        name: 1 / RADIUS if name in turns or name[-3:] in ("_rx", "_ry", "_rz") else 1.0
        for name in names
    }
    return np.array([(plain | {"edge_log_odds": 2.0 / radius})[name] for name in names])


def observability(solution):
    """Directions of the scaled information of a JointSolution, the least known first: list of
    Direction.

    The softness of the edges is eliminated.
    """
    names = np.array(solution.solution.names)
    index = [i for i, n in enumerate(names) if n != "edge_log_softness"]
    scales = scales_of(solution, names[index])
    H = marginal(information(solution).sum(axis=0), index) * scales[:, None] * scales
    values, vectors = np.linalg.eigh(H)
    least = max(1e-13 * values[-1], UNSEEN**-2)
    cameras = tuple(solution.transforms)
    sigmas = np.where(values > least, np.maximum(values, least) ** -0.5, np.inf)
    found = zip(vectors.T, sigmas.tolist(), strict=True)
    return [Direction(direction_words(x, names[index], cameras), sigma) for x, sigma in found]


def direction_words(direction, names, cameras):
    """A direction (k,) of unknowns, scaled to metres at 2 m, in words.

    What cameras have in common is said once.
    """
    value = dict(zip(names, np.asarray(direction) / np.max(np.abs(direction)), strict=True))
    words = [(abs(value[name]), what) for name, what in WORDS.items() if name in value]
    for kind, part in (
        ("rotation about", geometry.POSE_NAMES[:3]),
        ("shift along", geometry.POSE_NAMES[3:]),
    ):
        found = {f"camera '{c}'": np.array([value[f"{c}_{p}"] for p in part]) for c in cameras}
        mean = np.mean([*found.values()], axis=0) if found else 0.0
        if len(found) > 1 and all(
            np.linalg.norm(v - mean) < 0.3 * np.linalg.norm(mean) for v in found.values()
        ):
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
        Standard deviation of 'axis' and of each camera, metres at 2 m (root of the sum of the
        variances of rotation times 2 m and of translation), of the propagated noise.
    gain, median_gain : float
        By how much the standard deviation of all of them shrinks, a fraction; of all candidates,
        what a placement chosen blindly brings.
    """

    T_platform_board: RigidTransform
    place: pd.Series
    pitches: np.ndarray | None
    before: dict
    after: dict
    gain: float
    median_gain: float

    def words(self):
        """The pose in words, e.g.

        ``board 1.5 m ahead, 20 deg to the left, turned 60 deg in its plane, ...``.
        """
        place = self.place
        parts = [f"board {self.place.distance:.1f} m ahead"]
        for angle, plus, minus in (
            (place.bearing, "to the left", "to the right"),
            (place.elevation, "up", "down"),
        ):
            if round(np.degrees(angle)):
                parts.append(f"{abs(np.degrees(angle)):.0f} deg {plus if angle > 0 else minus}")
        if round(np.degrees(place.turn)):
            parts.append(f"turned {np.degrees(place.turn):.0f} deg in its plane")
        way = {"back": "leaning back", "forward": "leaning forward"}.get(
            place.towards, f"facing {place.towards} by"
        )
        words = ", ".join(
            [*parts, f"{way} {np.degrees(place.lean):.0f} deg" if place.towards else "upright"]
        )
        if self.pitches is None:
            return words
        *most, last = [f"{np.degrees(p):+.0f}" for p in self.pitches]
        return f"{words}; images at pitch {', '.join(most)} and {last} deg"

    def sentence(self):
        """What to record next and what it brings."""
        pairs = (
            (name, brief(1000 * sigma), brief(1000 * self.after[name]))
            for name, sigma in self.before.items()
        )
        known = [f"{name} {before} to {after} mm" for name, before, after in pairs]
        return (
            f"Record next: {self.words()}. Predicted standard deviations at 2 m: {', '.join(known)} "
            f"({100 * self.gain:.0f} % less; a blindly chosen placement: {100 * self.median_gain:.0f} %)."
        )


def brief(value):
    """A number with two digits, or more before the point."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"


def suggest_placement(solution, models, *, field_of_view=FIELD_OF_VIEW, features=None, places=None):
    """The board pose and pitch angles of images that would make the summed variances of axis and
    cameras least.

    Parameters
    ----------
    solution : JointSolution
    models : dict of str to CameraModel
        Of every camera of the solution; a ValueError where one is missing.
    field_of_view : tuple of float
        Bearings that the LRF measures, radians.
    features : ndarray, shape (k, 3), optional
        What the cameras see of the board (its pattern), metres.
    places : dict of str to sequence of float, optional
        Replaces entries of `PLACES`.

    Raises
    ------
    DegenerateGeometry
        When no pose of the grid is seen by all.
    """
    missing = [c for c in solution.transforms if c not in models]
    if missing:
        raise ValueError(
            f"camera '{missing[0]}' has no intrinsics: give its CameraModel in `models`"
        )
    grid, boards = board_grid(solution, **PLACES | (places or {}))
    rows, pitches = visible(boards, solution, models, field_of_view)
    if len(rows) == 0:
        low, high = np.degrees(PITCH_LIMITS)
        raise geometry.DegenerateGeometry(
            f"none of {len(grid)} board poses lies wholly in the view of the LRF and of all cameras at a pitch from "
            f"{low:.0f} to {high:.0f} deg: give other distances, wider limits, or check the calibration"
        )
    known = information(solution).sum(axis=0)
    added = candidate_information(boards[rows], pitches, solution, models, features)
    # what is not observed counts as known to a metre at 2 m, not better, so that it can be compared
    # as well
    unit = np.multiply.outer(*[scales_of(solution, solution.solution.names)] * 2)
    covariances = (
        np.linalg.inv(H * unit + np.eye(len(unit))) * unit for H in (known, known + added)
    )
    before, after = (group_sigma(C, solution) for C in covariances)
    total, totals = (
        np.sqrt(sum(sigma**2 for sigma in groups.values())) for groups in (before, after)
    )
    best = int(np.argmin(totals))
    gains = 1 - totals / total
    T_platform_board = geometry.pose_transform(boards[rows[best]])
    place = grid.iloc[rows[best]]
    pitches = pitches[best] if "head" in solution.observations.mounts else None
    after = {name: sigma[best] for name, sigma in after.items()}
    return Suggestion(
        T_platform_board, place, pitches, before, after, gains[best], np.median(gains)
    )


def group_sigma(covariance, solution):
    """Standard deviations of the axis and of each camera, metres at 2 m, from covariances (...,
    c, c).
    """
    names = np.array(solution.solution.names)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1) / scales_of(solution, names) ** 2
    groups = {"axis": np.isin(names, AXIS_NAMES)}
    groups |= {camera: np.char.startswith(names, f"{camera}_") for camera in solution.transforms}
    return {
        name: np.sqrt(variance[..., rows].sum(axis=-1))
        for name, rows in groups.items()
        if rows.any()
    }
