"""Pair what the LRF and the cameras saw: name the sides that scans cross, stack the observations of every method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.outline import measure_outline
from lrfcal_lib.calibrate.reconstruct import MeasuredBoard, measure_board
from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    fit_line,
    lrf_to_platform,
    lrf_to_source,
    polar_to_points,
    tilt,
)
from lrfcal_lib.model.observations import CameraObservations, JointObservations
from lrfcal_lib.preprocess import board_in_scan, survey
from lrfcal_lib.preprocess.board_in_scan import face_points
from lrfcal_lib.preprocess.edges_in_image import side_lines
from lrfcal_lib.preprocess.edges_in_scan import edge_cells
from lrfcal_lib.preprocess.prepared import VARIANTS, Prepared
from lrfcal_lib.solvers import find_outlying_placements, solve_camera
from lrfcal_lib.solvers.joint_noise import pose_by_intrinsics

CROSSINGS_PER_EDGE = 24  # neighbouring scan lines repeat each other's errors; a line in space needs few points
NAME_DISTANCE = 0.08  # metres between a side in the cloud and the board edge it is named after, at most
LEAST_STRETCH = 0.4  # share of an edge that must be seen before its line decides a corner
NAME_ANGLE = np.deg2rad(3.0)  # between them; a side turned more is none (a cloud cut by hand, an occluder)


def observe(prepared, camera, variant="half_step", T_head_lrf=None, correct=None, crossings=CROSSINGS_PER_EDGE):
    """Pair what the LRF and one camera saw of the board.

    Parameters
    ----------
    prepared : Prepared
    camera : str
    variant : {'half_step', 'last_beam'}
        Rule for the edge point.
    T_head_lrf : RigidTransform, optional
        Platform calibration to use instead of the session's own.
    correct : callable, optional
        ``correct(placement, p_lrf, pitch) -> (p_lrf, pitch)`` takes known errors out of what was recorded; see
        :meth:`lrfcal_lib.solvers.joint.JointSolution.correct`.
    crossings : int
        Kept of each edge of a placement, evenly spread.

    Returns
    -------
    CameraObservations
    """
    view_of = prepared.views[camera]
    sources = _Sources(prepared, camera, platform_of(prepared, T_head_lrf), correct or _as_recorded)
    posed = [p for p, view in view_of.items() if view.T_camera_board is not None]
    pattern = prepared.board.pattern
    k = 0 if pattern is None else pattern.columns * pattern.rows
    pixels = [view_of[p].pixels if view_of[p].pixels is not None else np.full((k, 2), np.nan) for p in posed]
    return CameraObservations(
        camera=camera,
        source="platform" if prepared.session.cameras[camera].mount == "platform" else "lrf",
        model=prepared.models[camera],
        placements=np.array(posed, int),
        board_poses=_stack([view_of[p].T_camera_board.as_matrix() for p in posed], (4, 4)),
        board_covariance=_stack([view_of[p].covariance for p in posed], (6, 6)),
        pattern_points=_pattern_points(pattern, prepared.relief),
        pattern_pixels=_stack(pixels, (k, 2)),
        pattern_sigma_px=max(prepared.models[camera].rms_px or 0.0, 0.05),
        **_planes(prepared, sources),
        **_crossings(prepared, camera, variant, sources, crossings),
        **_corners(prepared, camera, variant, sources),
    )


def _pattern_points(pattern, relief):
    """Corners of the pattern in the board frame, with the waves of the sheet where they are known."""
    if pattern is None:
        return np.zeros((0, 3))
    points = pattern.points()
    if relief is not None:
        points[:, 2] += relief
    return points


def platform_of(prepared, T_head_lrf=None):
    """The platform calibration to use: the one given, else the session's, else a tilt axis along x of the LRF."""
    if T_head_lrf is None:
        T_head_lrf = prepared.session.T_head_lrf
    return RigidTransform.identity() if T_head_lrf is None else T_head_lrf


def _as_recorded(placement, p_lrf, pitch):
    return p_lrf, np.asarray(pitch)


@dataclass(frozen=True)
class _Sources:
    """Turns LRF points of a placement into the frame the camera is fixed to."""

    prepared: Prepared
    camera: str
    T_head_lrf: RigidTransform
    correct: Callable

    def transform(self, placement):
        """Function of LRF points and their pitch: moves them into the frame the camera is fixed to."""
        mount = self.prepared.session.cameras[self.camera].mount
        view = self.prepared.views[self.camera].get(placement)
        image_pitch = 0.0 if mount == "platform" or view is None else view.pitch
        if mount == "head":
            image_pitch = float(self.correct(placement, np.zeros(3), image_pitch)[1])

        def turn(p_lrf, pitch):
            return lrf_to_source(*self.correct(placement, p_lrf, pitch), self.T_head_lrf, mount, image_pitch)

        return turn

    def points(self, placement, p_lrf, pitch):
        return self.transform(placement)(p_lrf, pitch)

    def pitch_covariance(self, placement, p_lrf, pitch):
        """What the error of the recorded pitch does to points, shape (n, 3, 3)."""
        turn, step = self.transform(placement), 1e-6
        by_pitch = (turn(p_lrf, pitch + step) - turn(p_lrf, pitch - step)) / (2 * step)
        middle = np.mean(self.prepared.scans[placement].sweep.pitch)
        moved = by_pitch * self.prepared.pitch_noise.sigma(pitch, middle)[:, None]
        return moved[:, :, None] * moved[:, None, :]

    def corner_covariance(self, placement, corner, face):
        """What the error of the recorded pitch does to a corner of the cloud (platform frame), shape (3, 3)."""
        up = [np.arctan2(p[2], p[1]) for p in (corner, np.mean(face, axis=0))]
        step = self.prepared.pitch_noise.sigma(up[0], up[1]) * np.cross([1.0, 0.0, 0.0], corner)
        moved = self.from_platform(placement, corner + step) - self.from_platform(placement, corner)
        return np.outer(moved, moved)

    def from_platform(self, placement, p_platform):
        """Platform points in the source frame."""
        if self.prepared.session.cameras[self.camera].mount == "platform":
            return p_platform
        return self.T_head_lrf.inv().apply(tilt(p_platform, -self.prepared.views[self.camera][placement].pitch))

    def covariance(self, placement, covariance, pitch):
        rotation = self.rotation(placement, pitch)
        return rotation @ covariance @ rotation.swapaxes(-1, -2)

    def rotation(self, placement, pitch):
        """From the LRF at some pitch angles to the source frame, shape (n, 3, 3)."""
        turn = self.transform(placement)
        origin = turn(np.zeros((len(pitch), 3)), pitch)
        return np.stack([turn(np.tile(e, (len(pitch), 1)), pitch) - origin for e in np.eye(3)], axis=-1)

    def crossing(self, placement, found, rows):
        """Some edge points of a scan with all that is known of them, source frame."""
        p_lrf, pitch = found.points[rows], found.pitch[rows]
        error = self.pitch_covariance(placement, p_lrf, pitch)
        return {
            "points": self.points(placement, p_lrf, pitch),
            "covariance": self.covariance(placement, found.covariance[rows], pitch) + error,
            "noise": self.covariance(placement, found.noise[rows], pitch) + error,
            "half_step": (self.rotation(placement, pitch) @ found.half_step[rows][..., None])[..., 0],
            "radius": self.prepared.session.lrf.spot_radius(np.linalg.norm(p_lrf, axis=1)),
            "background": found.background[rows],
        }


def _stack(parts, shape):
    return np.stack(parts) if len(parts) else np.zeros((0,) + shape)


def join_parts(parts, shape, dtype=float):
    """Concatenate arrays, or make an empty one of the right shape."""
    return np.concatenate(parts).astype(dtype) if parts else np.zeros((0,) + shape, dtype)


def _planes(prepared, sources):
    """Face points of the placements of which the camera knows the board's pose."""
    points, covariances, numbers = [], [], []
    for placement, board_scan in prepared.scans.items():
        view = prepared.views[sources.camera].get(placement)
        if view is None or view.T_camera_board is None:
            continue
        p_lrf, pitch, covariance = board_in_scan.face_points(board_scan, FACE_POINTS)
        points.append(sources.points(placement, p_lrf, pitch))
        covariances.append(sources.covariance(placement, covariance, pitch))
        numbers.append(np.full(len(p_lrf), placement))
    return {
        "plane_points": join_parts(points, (3,)),
        "plane_covariance": join_parts(covariances, (3, 3)),
        "plane_placement": join_parts(numbers, (), int),
    }


def _crossings(prepared, camera, variant, sources, count):
    """Crossings of named sides with the image line of the same edge, thinned evenly along each edge."""
    parts = {key: [] for key in _CROSSING}
    for placement, name, found, side, across in _named_sides(prepared, variant):
        view = prepared.views[camera].get(placement)
        edge = None if view is None else view.edge(name)
        if edge is None:
            continue
        rows = thin(np.flatnonzero(found.side == side), count)
        here = {"placement": placement, "edge": name, "across": across, "line_sigma": np.sqrt(edge.covariance[0, 0])}
        here = {key: np.full(len(rows), value) for key, value in here.items()}
        here["lines"] = np.tile(edge.line, (len(rows), 1))
        for key, values in (here | sources.crossing(placement, found, rows)).items():
            parts[key].append(values)
    return {f"crossing_{k}": join_parts(v, *_CROSSING[k]) for k, v in parts.items()}


_CROSSING = {
    "points": ((3,),), "covariance": ((3, 3),), "lines": ((3,),), "line_sigma": ((),), "placement": ((), int),
    "edge": ((), object), "across": ((), bool), "half_step": ((3,),), "noise": ((3, 3),), "radius": ((),),
    "background": ((),),
}  # fmt: skip


def _named_sides(prepared, variant):
    """All named sides: placement, edge, points, side number, and whether it was found across the scan lines."""
    for placement, names in prepared.names.items():
        along, swept = prepared.edges[variant].get(placement), prepared.swept[variant].get(placement)
        numbers = set(np.unique(along.side))
        for side, name in names.items():
            if side in numbers:
                yield placement, name, along, side, False
            elif swept is not None:
                yield placement, name, swept, side, True


def thin(rows, count):
    """At most `count` of some rows, evenly spread."""
    return rows if len(rows) <= count else rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]


def name_sides(prepared, variant="half_step"):
    """Name the sides that scans cross: the nearest edge of the board, which the images place in the scan.

    Parameters
    ----------
    prepared : Prepared
        With views. The cameras' poses come from the planes alone (Zhang and Pless), which needs no names.
    variant : str

    Returns
    -------
    dict of int to dict of int to str
        Edge name by placement and side number. Sides farther than 8 cm from every edge stay unnamed; all do where
        nobody knows the outline of the board.
    """
    rough = rough_poses(prepared, variant)
    names = {}
    if prepared.board.corners is None:
        return names
    for placement, along in prepared.edges[variant].items():
        to_board = _to_board(prepared, placement, rough)
        if to_board is None:
            continue
        sides = {}
        for found in (along, prepared.swept[variant].get(placement)):
            for side in () if found is None else np.unique(found.side[found.side >= 0]):
                rows = found.side == side
                sides.setdefault(int(side), to_board(found.points[rows], found.pitch[rows]))
        names[placement], crooked = _nearest_edges(prepared.board, sides)
        prepared.problems.update(
            {f"{placement} {side}": f"placement {placement}: {why}" for side, why in crooked.items()}
        )
    return names


def rough_poses(prepared, variant="half_step"):
    """Poses of the cameras from the planes alone, and which placements disagree with all others.

    Parameters
    ----------
    prepared : Prepared
        Its `problems` gain an entry for each outlying placement, and each camera without a pose.
    variant : str

    Returns
    -------
    dict of str to RigidTransform
        ``T_camera_source`` by camera.
    """
    rough = {}
    for camera in prepared.views:
        obs = observe(prepared, camera, variant)
        try:
            judged = find_outlying_placements(obs, "planes")
            rough[camera] = solve_camera(obs.select(judged.inliers), "zhang_pless").transform
        except DegenerateGeometry as error:
            prepared.problems[f"camera {camera}"] = str(error)
            continue
        for placement in judged.outlying:
            miss = 1000 * judged.rms[judged.placements == placement][0]
            prepared.problems[placement] = f"camera {camera}: its plane is {miss:.0f} mm rms off the scan; left out"
    return rough


def _to_board(prepared, placement, rough):
    """Function from LRF points of a placement to the board frame, through any camera that sees the board."""
    for camera, T_camera_source in rough.items():
        view = prepared.views[camera].get(placement)
        if view is not None and view.T_camera_board is not None:
            turn = _Sources(prepared, camera, platform_of(prepared), _as_recorded).transform(placement)
            T_board_source = view.T_camera_board.inv() * T_camera_source
            return lambda p, pitch: T_board_source.apply(turn(p, pitch))
    return None


def _nearest_edges(board, sides):
    """Edge names of sides (board-frame points by number), each given once, and why the others got none."""
    lines, names, problems = board.lines(), {}, {}
    distances = {number: np.abs(p[:, :2] @ lines[:, :2].T + lines[:, 2]) for number, p in sides.items()}
    cost = np.array([np.median(d, axis=0) for d in distances.values()]).reshape(-1, len(lines))
    numbers = list(sides)
    for row, column in zip(*linear_sum_assignment(cost), strict=True):
        number, edge = numbers[row], board.edges[column]
        turned, allowed = _angle_to_line(sides[number], lines[column])
        if cost[row, column] > NAME_DISTANCE:
            problems[number] = (
                f"a side of the scan is {1000 * cost[row, column]:.0f} mm from the edge '{edge}': not used"
            )
        elif turned > allowed:
            problems[number] = (
                f"the scan's side '{edge}' is turned by {np.rad2deg(turned):.1f} deg against the board: not used"
            )
        else:
            names[number] = edge
    return names, problems


def _angle_to_line(points, line):
    """Angle between the line through board-frame points and a board line, and how large noise lets it be, radians."""
    if len(points) < 3:
        return 0.0, NAME_ANGLE
    _, direction, rms = fit_line(points)
    angle = float(np.arcsin(min(abs(direction[:2] @ line[:2]) / np.linalg.norm(direction[:2]), 1.0)))
    length = np.ptp(points @ direction)
    return angle, float(np.hypot(NAME_ANGLE, 3 * rms * np.sqrt(12 / len(points)) / length))


def _stretch(found, side):
    """Length over which a side is seen, metres."""
    return next((s.length for s in found.sides if s.side == side), 0.0)


@dataclass(frozen=True)
class PlacementOutline:
    """The board's outline in the cloud of one placement.

    Attributes
    ----------
    measured : MeasuredBoard
        In the platform frame.
    face, sides : ndarray, shape (n, 3), and dict of str to ndarray, shape (k, 3)
        The points it was measured from, platform frame, metres.
    across : frozenset of str
        Edges found across the scan lines (where the sweep enters or leaves the board): their place hangs on the
        recorded pitch.
    """

    measured: MeasuredBoard
    face: np.ndarray
    sides: dict
    across: frozenset


def outline_of(prepared, placement, variant="half_step", T_head_lrf=None):
    """Measure the board's outline in the cloud of a placement.

    Parameters
    ----------
    prepared : Prepared
    placement : int
    variant : {'half_step', 'last_beam'}
    T_head_lrf : RigidTransform, optional
        The session's own when left out.

    Returns
    -------
    PlacementOutline
        Without sides of which less than 40 % is seen: a stub does not carry a line to its corners.

    Raises
    ------
    DegenerateGeometry
        If the sweep does not cross enough scan lines to span a plane.
    """
    T_head_lrf = platform_of(prepared, T_head_lrf)
    face_lrf, pitch, _ = board_in_scan.face_points(prepared.scans[placement])
    face = lrf_to_platform(face_lrf, pitch, T_head_lrf)
    sides, across, length = {}, set(), prepared.board.lengths()
    for number, name, found, side, swept in _named_sides(prepared, variant):
        rows = found.side == side
        if number == placement and _stretch(found, side) >= LEAST_STRETCH * length[name]:
            sides[name] = lrf_to_platform(found.points[rows], found.pitch[rows], T_head_lrf)
            across |= {name} if swept else set()
    return PlacementOutline(measure_board(face, sides, prepared.board.edges), face, sides, frozenset(across))


def cells_of(prepared, placement):
    """Beams about the edges in the sweep of a placement, an EdgeCells."""
    along, swept = prepared.edges["half_step"][placement], prepared.swept["half_step"].get(placement)
    return edge_cells(prepared.scans[placement], along, swept, prepared.session.lrf)


def likely_outline_of(prepared, placement, model):
    """Measure the board's outline in one sweep by likelihood; :func:`outline_of` does it by least squares.

    Parameters
    ----------
    prepared : Prepared
    placement : int
    model : EdgeModel
        From other placements.

    Returns
    -------
    measured : MeasuredOutline
        Without sides of which less than 40 % is seen.
    across : frozenset of str
        Edges found across the scan lines.

    Raises
    ------
    DegenerateGeometry
        If the sweep does not cross enough scan lines to span a plane, or no side has enough beams.
    """
    board_scan, length, names, across = prepared.scans[placement], prepared.board.lengths(), {}, set()
    for number, name, found, side, swept in _named_sides(prepared, "half_step"):
        if number == placement and _stretch(found, side) >= LEAST_STRETCH * length[name]:
            names[side] = name
            across |= {name} if swept else set()
    points, pitch, _ = board_in_scan.face_points(board_scan)
    face = points, model.pitch(placement, points, pitch), board_scan.sigma_range
    cells = cells_of(prepared, placement)
    on_board = polar_to_points(cells.range_m, cells.bearing)
    cells = replace(cells, pitch=model.pitch(placement, on_board, cells.pitch))
    return measure_outline(cells, face, names, prepared.board.edges, model), frozenset(across)


def _corners(prepared, camera, variant, sources):
    """Corners of the outline that the cloud and the image can both name: where two fitted edges meet."""
    parts = {key: [] for key in ("points", "covariance", "pixels", "sigma_px", "placement")}
    for placement in prepared.names:
        view = prepared.views[camera].get(placement)
        if view is None or placement not in prepared.scans or placement not in prepared.swept[variant]:
            continue
        outline = outline_of(prepared, placement, variant, sources.T_head_lrf)
        for name, before in zip(prepared.board.edges, np.roll(prepared.board.edges, 1), strict=True):
            seen = view.edge(name), view.edge(str(before))
            if name not in outline.measured.corners or None in seen:
                continue
            sigma = max(_scatter(outline, name), _scatter(outline, str(before)))
            parts["points"].append(sources.from_platform(placement, outline.measured.corner_point(name))[None])
            noise = sources.corner_covariance(placement, outline.measured.corner_point(name), outline.face)
            parts["covariance"].append((sigma**2 * np.eye(3) + noise)[None])
            parts["pixels"].append(corners_of_lines(np.stack([seen[1].line, seen[0].line]))[1][None])
            parts["sigma_px"].append([np.hypot(*(np.sqrt(edge.covariance[0, 0]) for edge in seen))])
            parts["placement"].append([placement])
    shapes = {"points": (3,), "covariance": (3, 3), "pixels": (2,)}
    return {
        f"scene_{k}": join_parts(v, shapes.get(k, ()), int if k == "placement" else float) for k, v in parts.items()
    }


def _scatter(outline, name):
    """Rms distance of a side's points from its line; not averaged down, because neighbours share errors."""
    return fit_line(outline.sides[name])[2]


def observe_all(prepared, T_head_lrf=None):
    """Observations of all cameras in both edge-point variants, keyed by (camera, variant)."""
    keys = [(camera, variant) for camera in prepared.views for variant in VARIANTS]
    return {(camera, variant): observe(prepared, camera, variant, T_head_lrf) for camera, variant in keys}


FACE_POINTS = 150  # a placement: neighbouring ranges of a real device share their errors
CELLS_PER_EDGE = 160  # a placement, of each edge


def all_views(prepared):
    """The board in all images of a session, at every pitch, with the intrinsics and outline that are known by now.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    dict of str to list of BoardView
        By camera; images of no placement are left out. Where every placement has one image these are the prepared
        views.
    """
    session = prepared.session
    records = [r for r in session.images(purpose="board") if r.placement >= 0 and r.camera in prepared.views]
    known = sum(len(found) for found in prepared.views.values())
    if len(records) <= known or prepared.board.pattern is None:
        return {camera: list(found.values()) for camera, found in prepared.views.items()}
    options = {"picks": session.picks, "settled": prepared.views}  # sides of scans bear the names of that turn
    return survey.survey(records, session.read_image, prepared.board, prepared.models, **options).views


def observe_joint(prepared, views=None, *, face_points=FACE_POINTS, cells=CELLS_PER_EDGE):
    """Everything that the joint estimate uses of a session.

    Parameters
    ----------
    prepared : Prepared
    views : dict of str to list of BoardView, optional
        See :func:`all_views`.
    face_points, cells : int
        At most so many ranges a placement and beams an edge.

    Returns
    -------
    JointObservations
        Of the placements that `prepared.problems` does not name.
    """
    views = all_views(prepared) if views is None else views
    placements = [p for p in prepared.scans if p not in prepared.problems]
    index = {p: i for i, p in enumerate(placements)}
    parts = {"face": _faces(prepared, index, face_points), "beam": _beams(prepared, index, cells)}
    parts["view"] = _views(views, index, prepared)
    found = {f"{group}_{key}": value for group, part in parts.items() for key, value in part.items()}
    session = prepared.session
    return JointObservations(
        placements=np.array(placements, int),
        direction=np.array([session.sweep_direction(p) for p in placements], int),
        middle=np.array([float(np.mean(prepared.scans[p].sweep.pitch)) for p in placements]),
        edges=tuple(prepared.board.edges),
        corners=_extent(prepared.board),
        cameras=tuple(views),
        mounts=tuple(session.cameras[c].mount for c in views),
        T_head_lrf=session.T_head_lrf,
        lens_covariance=np.stack([_lens(prepared.models[c]) for c in views]) if views else None,
        **found,
    )


def _extent(board):
    """Corners of the board, of its printed squares where nobody knows them: no beam is named after those."""
    if board.corners is not None or board.pattern is None:
        return board.known_corners()
    return corners_of_lines(side_lines(board.pattern, np.full(4, board.pattern.square)))


def _faces(prepared, index, count):
    out = {key: [np.zeros(0)] for key in ("range", "bearing", "pitch", "sigma")} | {"placement": [np.zeros(0, int)]}
    for placement, i in index.items():
        board = prepared.scans[placement]
        points, pitch, _ = face_points(board, count)
        out["range"].append(np.linalg.norm(points, axis=1))
        out["bearing"].append(np.arctan2(points[:, 1], points[:, 0]))
        out["pitch"].append(pitch)
        out["sigma"].append(np.full(len(pitch), board.sigma_range))
        out["placement"].append(np.full(len(pitch), i))
    return {key: np.concatenate(value) for key, value in out.items()}


def _beams(prepared, index, count):
    keys = ("bearing", "pitch", "hit", "edge", "radius", "background", "step", "placement")
    out, edges = {key: [] for key in keys}, list(prepared.board.edges)
    for placement, i in index.items():
        named = {side: edges.index(name) for side, name in prepared.names.get(placement, {}).items()}
        cells = cells_of(prepared, placement)
        for side, edge in named.items():
            rows = thin(np.flatnonzero(cells.side == side), count)
            for key in ("bearing", "pitch", "hit", "radius", "background"):
                out[key].append(getattr(cells, key)[rows])
            out["step"].append(cells.step[rows] * cells.range_m[rows])
            out["edge"].append(np.full(len(rows), edge))
            out["placement"].append(np.full(len(rows), i))
    kinds = {"hit": bool, "edge": int, "placement": int}
    return {key: np.concatenate(value) if value else np.zeros(0, kinds.get(key, float)) for key, value in out.items()}


def _lens(model):
    """Covariance of the intrinsics; zeros where they are stated without one."""
    return np.zeros((9, 9)) if model.covariance is None else np.asarray(model.covariance)


def _views(views, index, prepared):
    out = {"camera": [], "pitch": [], "pose": [], "covariance": [], "placement": [], "lens": []}
    pattern = prepared.board.pattern
    for number, found in enumerate(views.values()):
        for view in found:
            if view.T_camera_board is None or view.placement not in index:
                continue
            corners = np.zeros((0, 3)) if pattern is None or view.pixels is None else pattern.points()
            seen = corners if view.pixels is None else corners[np.isfinite(view.pixels).all(axis=1)]
            lens = pose_by_intrinsics(view.T_camera_board, seen, prepared.models[view.camera])
            row = (number, view.pitch, view.T_camera_board.as_matrix(), view.covariance, index[view.placement], lens)
            for key, value in zip(out, row, strict=True):
                out[key].append(value)
    shapes = {"pose": (0, 4, 4), "covariance": (0, 6, 6), "lens": (0, 6, 9)}
    whole = {"camera": int, "placement": int}
    arrays = {k: np.array(v) if v else np.zeros(shapes.get(k, (0,)), whole.get(k, float)) for k, v in out.items()}
    return arrays | {"pitch": np.nan_to_num(arrays["pitch"])}
