"""What a joint estimate knows badly, and which placement would help most if recorded next."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pandas as pd
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.judge.uncertainty import beams_to, marginal
from lrfcal_lib.model import geometry
from lrfcal_lib.model.camera import project, project_jacobians
from lrfcal_lib.solvers.joint import UNSEEN
from lrfcal_lib.solvers.joint_solution import WORDS

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
    corners = solution.observations.corners
    return np.column_stack([corners, np.zeros(len(corners))])


def board_grid(solution, distances, bearings, elevations, turns, leans):
    """All combinations of a grid of poses, visible or not; leans above zero in four directions.

    A DataFrame with distance of the board's middle from the LRF (metres), bearing to the left,
    elevation, turn in the board's plane (anticlockwise as the rig sees it; 0 with the board's x to
    the right), lean out of the upright plane that faces the LRF (radians), towards ('back' with the
    top farther away, 'forward', 'left', 'right'; '' upright); and ``T_platform_board``, shape (n,
    3, 4).
    """
    rows = []
    for *place, lean, way in product(distances, bearings, elevations, turns, leans, LEANS):
        if bool(lean) == bool(way):
            rows.append((*place, lean, way))
    columns = ["distance", "bearing", "elevation", "turn", "lean", "towards"]
    places = pd.DataFrame(rows, columns=columns)
    gaze = Rotation.from_euler("ZX", places[["bearing", "elevation"]])
    tip = places[["lean"]].to_numpy() * [(*LEANS[way], 0) for way in places.towards]
    spin = Rotation.from_rotvec(places[["turn"]].to_numpy() * [0.0, 0.0, 1.0])
    face = gaze * geometry.AHEAD * Rotation.from_rotvec(tip) * spin
    head = solution.T_head_lrf
    rotation = (head.rotation * face).as_matrix()
    ahead = gaze.apply([0.0, 1.0, 0.0])
    centre = head.apply(places[["distance"]].to_numpy() * ahead)
    origin = centre - rotation @ outline(solution).mean(axis=0)
    return places, np.concatenate([rotation, origin[..., None]], axis=-1)


def visible(boards, solution, models, field_of_view):
    """Which boards (m,) lie wholly in all views, and the pitch angles (m, k) of their images."""
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
        depth = np.where(p[..., 2:] > 0, p[..., 2:], np.nan)
        tangent = np.abs(p[..., :2] / depth)
        near = tangent < 0.65 * size / [model.fx, model.fy]
        inside = near & (uv > border) & (uv < size - border)
        facing = _facing(p, geometry.rotate_points(pose, normals[rows]))
        seen &= np.all(inside.all(axis=-1) & facing, axis=2)
    ever = seen.any(axis=0)
    seen = seen[:, ever]
    first = np.argmax(seen, axis=0)
    last = len(LATTICE) - 1 - np.argmax(seen[::-1], axis=0)
    low = LATTICE[first]
    high = LATTICE[last]
    share = np.array([0.5])
    if "head" in solution.observations.mounts:
        share = np.linspace(0, 1, IMAGES)
    return rows[ever], low[:, None] + (high - low)[:, None] * share


def _facing(sight, normals):
    """Whether lines of sight (..., n, k, 3) meet the fronts of boards (..., n, 3) steeply."""
    towards = -np.sum(sight * normals[..., None, :], axis=-1)
    return towards > np.cos(STEEPEST) * np.linalg.norm(sight, axis=-1)


def camera_poses(solution, name, pitch):
    """``T_camera_platform`` of a camera at pitch angles (n,), shape (n, 3, 4)."""
    pose = geometry.pose_array(solution.camera_at(name, pitch))
    return np.broadcast_to(pose, (len(pitch), 3, 4))


def _view_covariance(pose, features, model):
    """Covariance (n, 6, 6) of board poses (n, 4, 4) in a camera from features known to 1 px."""
    turned = geometry.rotate_points(pose[:, :3], features)
    by_point = project_jacobians(turned + pose[:, None, :3, 3], model)[0]
    J = geometry.gradient_by_pose(turned[..., None, :], by_point)
    return np.linalg.inv(np.einsum("nkai,nkaj->nij", J, J))


def typical_placement(solution):
    """Number of the placement of median information."""
    by_unknown = np.diagonal(solution.information(), axis1=1, axis2=2)
    told = by_unknown @ scales_of(solution, solution.solution.names) ** 2
    return list(solution.boards)[np.argsort(told)[len(told) // 2]]


def points_on_board(solution, placement, bearing, pitch):
    """Where beams (k,) meet the plane of a placement's board, metres in its frame, (k, 3)."""
    board = solution.boards[placement]
    pitch = solution.corrections.pitch(placement, pitch)
    ray = geometry.polar_to_points(1.0, bearing)
    ends = board.inv().apply(geometry.lrf_to_platform(ray, pitch, solution.T_head_lrf))
    start = board.inv().apply(geometry.lrf_to_platform(0 * ray, pitch, solution.T_head_lrf))
    way = ends - start
    return start - start[:, 2:] / way[:, 2:] * way


def spot_growth(solution):
    """Radius of the spot by distance, a polynomial."""
    obs = solution.observations
    radius = pd.Series(obs.beam_radius).groupby(obs.beam_placement).median()
    distance = np.linalg.norm(solution.board_poses[radius.index, :, 3], axis=1)
    if not len(radius):
        return np.array([0.0, 0.005])
    if len(radius) < 2 or np.ptp(distance) < 0.1 or np.ptp(radius) < 1e-6:
        return np.array([0.0, radius.median()])
    return np.polyfit(distance, radius, 1)


def _views(boards, pitches, solution, models, features):
    """Poses of the boards in all images, as well known beside 1 px as the recorded ones are."""
    obs = solution.observations
    parts = []
    if features is None:
        corners = outline(solution)
        middles = (corners + np.roll(corners, 1, axis=0)) / 2
        features = np.concatenate([corners, middles])
    for number, (name, mount) in enumerate(zip(solution.transforms, obs.mounts, strict=True)):
        model = models[name]
        mine = obs.view_camera == number
        pixels = np.ones(6)
        if mine.any():
            expected = _view_covariance(obs.view_pose[mine], features, model)
            ratio = obs.view_covariance[mine] / expected
            pixels = np.sqrt(np.median(np.diagonal(ratio, axis1=1, axis2=2), axis=0))
        images = pitches if mount == "head" else pitches[:, :1]
        for pitch in images.T:
            T_camera_platform = geometry.pose_transform(camera_poses(solution, name, pitch))
            pose = (T_camera_platform * geometry.pose_transform(boards)).as_matrix()
            covariance = _view_covariance(pose, features, model)
            part = {
                "view_camera": np.full(len(pitch), number),
                "view_pitch": pitch,
                "view_pose": pose,
                "view_covariance": covariance * np.outer(pixels, pixels),
                "view_placement": np.arange(len(pitch)),
                "view_lens": np.zeros((len(pitch), 6, 9)),
            }
            parts.append(part)
    if not parts:
        return {}
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def candidate_information(boards, pitches, solution, models, features=None):
    """Information that each candidate would add about the shared unknowns, shape (n, c, c).

    `boards` (n, 3, 4) are ``T_platform_board``, `pitches` (n, k) those of the images. A candidate
    shows what the typical placement of the recording showed, points of the face and beams about the
    edges, from where it stands: spots grow with the distance, and beams get fewer the smaller the
    board looks. Cameras see `features` of it (k, 3), those of its outline when left out. Its own
    pose and sweep are eliminated; at the noise levels of the solution.
    """
    home = typical_placement(solution)
    typical = solution.observations.select([home])
    typical = typical.keep(
        face=np.arange(len(typical.face_range)) % THINNED == 0,
        beam=np.arange(len(typical.beam_hit)) % THINNED == 0,
    )
    middle = outline(solution).mean(axis=0, keepdims=True)
    home_board = geometry.pose_array(solution.boards[home])[None]
    _, distance, size = _as_seen(home_board, middle, solution.T_head_lrf)
    pitch, away, seen = _as_seen(boards, middle, solution.T_head_lrf)
    # as many more of them as the board looks larger, at most as many as a placement has
    recorded = max(np.bincount(solution.observations.face_placement).max(initial=0), 1)
    most = np.sqrt(recorded / max(THINNED * len(typical.face_range), 1))
    more = np.minimum(seen / size, most)
    spot = spot_growth(solution)
    grown = np.polyval(spot, away) / np.polyval(spot, distance)
    farther = replace(
        typical,
        placements=np.arange(len(boards)),
        direction=np.ones(len(boards), int),
        middle=pitch[:, 0],
        **_faces(typical, home, boards, more, solution),
        **_edge_beams(typical, home, boards, grown, away / distance, solution),
        **_views(boards, pitches, solution, models, features),
    )
    return solution.forecast(farther, boards, THINNED * more[:, 0], home)


def _faces(typical, home, boards, more, solution):
    """Ranges to the points of a typical face on other boards (n, 3, 4), `more` (n, 1) times as
    many.
    """
    points = points_on_board(solution, home, typical.face_bearing, typical.face_pitch)
    bearing, pitch, distance = _beams(points, boards, solution)
    return {
        "face_range": distance.ravel(),
        "face_bearing": bearing.ravel(),
        "face_pitch": pitch.ravel(),
        "face_sigma": (typical.face_sigma / (THINNED**0.5 * more)).ravel(),
        "face_placement": np.repeat(np.arange(len(boards)), len(points)),
    }


def _edge_beams(typical, home, boards, grown, farther, solution):
    """Beams about the edges of other boards (n, 3, 4) where spots and distances have grown
    (n, 1).
    """
    points = points_on_board(solution, home, typical.beam_bearing, typical.beam_pitch)
    # beams stay as many spots off the edge as they were
    line = typical.lines()[typical.beam_edge]
    off = np.sum((points + [0, 0, 1.0]) * line, axis=-1)
    moved = points + (grown * off - off)[..., None] * line * [1.0, 1.0, 0.0]
    bearing, pitch, _ = _beams(moved, boards, solution)
    n = len(boards)
    return {
        "beam_bearing": bearing.ravel(),
        "beam_pitch": pitch.ravel(),
        "beam_hit": np.tile(typical.beam_hit, n),
        "beam_edge": np.tile(typical.beam_edge, n),
        "beam_radius": (typical.beam_radius * grown).ravel(),
        "beam_background": np.tile(typical.beam_background, n),
        "beam_step": (typical.beam_step * farther).ravel(),
        "beam_placement": np.repeat(np.arange(n), len(points)),
    }


def _as_seen(boards, middle, T_head_lrf):
    """Pitch and range (n, 1) of beams to the middle (1, 3) of boards (n, 3, 4), and their size."""
    points = geometry.apply_pose(boards, middle)
    _, pitch, away = beams_to(points, T_head_lrf)
    sight = points - T_head_lrf.translation
    cosine = np.abs(np.vecdot(sight, boards[:, None, :, 2])) / away
    return pitch, away, np.sqrt(cosine) / away


def _beams(points, boards, solution):
    """Recorded bearing and pitch, and range (n, k) of beams to points (..., k, 3) on boards (n, 3,
    4).
    """
    bearing, pitch, distance = beams_to(geometry.apply_pose(boards, points), solution.T_head_lrf)
    return bearing, pitch / (1 + solution.sensor["pitch_scale"]), distance


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
    scales = np.ones(len(names))
    for i, name in enumerate(names):
        if name == "edge_log_odds":
            scales[i] = 2.0 / radius
        elif name in turns or name.endswith(("_rx", "_ry", "_rz")):
            scales[i] = 1 / RADIUS
    return scales


def observability(solution):
    """Directions of the scaled information of a JointSolution, a list, the least known first.

    The softness of the edges is eliminated.
    """
    names = np.array(solution.solution.names)
    index = np.flatnonzero(names != "edge_log_softness")
    scales = scales_of(solution, names[index])
    H = marginal(solution.information().sum(axis=0), index) * scales[:, None] * scales
    values, vectors = np.linalg.eigh(H)
    least = max(1e-13 * values[-1], UNSEEN**-2)
    cameras = tuple(solution.transforms)
    sigmas = np.where(values > least, np.maximum(values, least) ** -0.5, np.inf)
    out = []
    for vector, sigma in zip(vectors.T, sigmas.tolist(), strict=True):
        out.append(Direction(direction_words(vector, names[index], cameras), sigma))
    return out


def direction_words(direction, names, cameras):
    """A direction (k,) of unknowns, scaled to metres at 2 m, in words.

    What cameras have in common is said once.
    """
    relative = np.asarray(direction) / np.max(np.abs(direction))
    value = dict(zip(names, relative, strict=True))
    words = [(abs(value[name]), what) for name, what in WORDS.items() if name in value]
    kinds = {
        "rotation about": geometry.POSE_NAMES[:3],
        "shift along": geometry.POSE_NAMES[3:],
    }
    for kind, part in kinds.items():
        vectors = {}
        for camera in cameras:
            vectors[f"camera '{camera}'"] = np.array([value[f"{camera}_{p}"] for p in part])
        for who, vector in _in_common(vectors).items():
            size = np.linalg.norm(vector)
            axes = np.array(["x", "y", "z"])[np.abs(vector) > 0.4 * size]
            if size:
                words.append((size, f"{kind} {' and '.join(axes)} of {who}"))
    words.sort(key=lambda pair: -pair[0])
    least = LARGE * words[0][0]
    return " with ".join(what for size, what in words[:MOST] if size > least)


def _in_common(vectors):
    """Their mean as that of all cameras where the vectors (3,) of several cameras are alike."""
    if len(vectors) > 1:
        mean = np.mean([*vectors.values()], axis=0)
        apart = max(np.linalg.norm(vector - mean) for vector in vectors.values())
        if apart < 0.3 * np.linalg.norm(mean):
            return {"all cameras": mean}
    return vectors


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
        """The pose in words, like ``board 1.5 m ahead, 20 deg to the left, upright``."""
        place = self.place
        parts = [f"board {self.place.distance:.1f} m ahead"]
        right_or_left = "to the left" if place.bearing > 0 else "to the right"
        down_or_up = "up" if place.elevation > 0 else "down"
        for angle, way in ((place.bearing, right_or_left), (place.elevation, down_or_up)):
            if round(np.degrees(angle)):
                parts.append(f"{abs(np.degrees(angle)):.0f} deg {way}")
        if round(np.degrees(place.turn)):
            parts.append(f"turned {np.degrees(place.turn):.0f} deg in its plane")
        parts.append(self.lean_words())
        words = ", ".join(parts)
        if self.pitches is None:
            return words
        *most, last = [f"{np.degrees(p):+.0f}" for p in self.pitches]
        return f"{words}; images at pitch {', '.join(most)} and {last} deg"

    def lean_words(self):
        """How the board leans."""
        towards = self.place.towards
        if not towards:
            return "upright"
        way = f"leaning {towards}" if towards in ("back", "forward") else f"facing {towards} by"
        return f"{way} {np.degrees(self.place.lean):.0f} deg"

    def sentence(self):
        """What to record next and what it brings."""
        known = []
        for name, sigma in self.before.items():
            after = brief(1000 * self.after[name])
            known.append(f"{name} {brief(1000 * sigma)} to {after} mm")
        gain = f"{100 * self.gain:.0f} % less"
        blindly = f"a blindly chosen placement: {100 * self.median_gain:.0f} %"
        return (
            f"Record next: {self.words()}. Predicted standard deviations at 2 m: "
            f"{', '.join(known)} ({gain}; {blindly})."
        )


def brief(value):
    """A number with two digits, or more before the point."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"


def suggest_placement(solution, models, *, field_of_view=FIELD_OF_VIEW, features=None, places=None):
    """The board pose and pitch angles of images that would make axis and cameras known best.

    Their summed variances are made least.

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
            f"none of {len(grid)} board poses lies wholly in the view of the LRF and of all "
            f"cameras at a pitch from {low:.0f} to {high:.0f} deg: give other distances, wider "
            "limits, or check the calibration"
        )
    known = solution.information().sum(axis=0)
    added = candidate_information(boards[rows], pitches, solution, models, features)
    # what is not observed counts as known to a metre at 2 m, not better, so that it can be compared
    # as well
    scales = scales_of(solution, solution.solution.names)
    unit = np.outer(scales, scales)
    prior = np.eye(len(unit))
    before = group_sigma(np.linalg.inv(known * unit + prior) * unit, solution)
    after = group_sigma(np.linalg.inv((known + added) * unit + prior) * unit, solution)
    total = np.sqrt(sum(sigma**2 for sigma in before.values()))
    totals = np.sqrt(sum(sigma**2 for sigma in after.values()))
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
    """Standard deviations of axis and cameras, metres at 2 m, from covariances (..., c, c)."""
    names = np.array(solution.solution.names)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1) / scales_of(solution, names) ** 2
    groups = {"axis": np.isin(names, AXIS_NAMES)}
    for camera in solution.transforms:
        groups[camera] = np.char.startswith(names, f"{camera}_")
    out = {}
    for name, rows in groups.items():
        if rows.any():
            out[name] = np.sqrt(variance[..., rows].sum(axis=-1))
    return out
