"""Pair what the LRF and the cameras saw: name the sides that scans cross, stack the observations of
every method.
"""

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from scipy.optimize import linear_sum_assignment

from lrfcal_lib.calibrate.outline import cells_of, named_sides, outline_of, platform_of
from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.geometry import DegenerateGeometry, fit_line, tilt
from lrfcal_lib.model.kinematics import AS_RECORDED, Corrections, SourceFrame
from lrfcal_lib.model.observations import (
    LENS,
    CameraObservations,
    JointObservations,
    PlatformObservations,
)
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
from lrfcal_lib.preprocess.board_in_scan import face_points
from lrfcal_lib.preprocess.intrinsics import raised_points
from lrfcal_lib.preprocess.outline_in_images import side_lines
from lrfcal_lib.preprocess.pattern_in_image import SMALL_SQUARE_PX
from lrfcal_lib.preprocess.prepared import VARIANTS, DroppedSide
from lrfcal_lib.preprocess.survey import all_views, small_squares
from lrfcal_lib.solvers import find_outlying_placements, solve_camera
from lrfcal_lib.solvers.joint_lens import pose_by_intrinsics
from lrfcal_lib.solvers.joint_start import thin

ONE_SCAN = "one_scan"
# neighbouring scan lines repeat each other's errors; a line in space needs few points
CROSSINGS_PER_EDGE = 24
FACE_POINTS = 150  # a placement: neighbouring ranges of a real device share their errors
CELLS_PER_EDGE = 160  # a placement, of each edge
PLATFORM_POINTS = 40  # per edge
# metres between a side in the cloud and the board edge it is named after, at most
NAME_DISTANCE = 0.08
# between them; a side turned more is none (a cloud cut by hand, an occluder)
NAME_ANGLE = np.deg2rad(3.0)
LEAST_CORNER_SIGMA = 0.05  # pixels; no chessboard corner is found better
# largest |cosine| between two sides that are taken for the board's perpendicular edges
RIGHT_ANGLE = 0.15


def stack(prefix, parts):
    """Parts of a table end to end: its columns by name, with a prefix; none without parts."""
    parts = list(parts)
    if not parts:
        return {}
    return {prefix + key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def observe(
    prepared,
    camera,
    variant="half_step",
    T_head_lrf=None,
    corrections: Corrections = AS_RECORDED,
    crossings=CROSSINGS_PER_EDGE,
    faces=FACE_POINTS,
    outlines: dict | None = None,
) -> CameraObservations:
    """Pair what the LRF and one camera saw of the board.

    Parameters
    ----------
    prepared : Prepared
    camera : str
    variant : {'half_step', 'last_beam', 'one_scan'}
        Rule for the edge point; 'one_scan' is the paper's: last beams of the two edges of
        `board.features`, on the middle one of the scan lines that cross both.
    T_head_lrf : RigidTransform, optional
        Platform calibration to use instead of the session's own.
    corrections : Corrections
        Known errors of what was recorded, which are taken out of points and pitch; see
        :attr:`lrfcal_lib.solvers.joint.JointSolution.corrections`.
    crossings, faces : int
        Kept of each edge and of the face of a placement, evenly spread; without `faces` only
        crossings are paired.
    outlines : dict, optional
        Filled with the outlines of the board by placement and variant, which other calls with the
        same `T_head_lrf` need not measure again.

    Returns
    -------
    CameraObservations
    """
    T_head_lrf = platform_of(prepared, T_head_lrf)
    mount = prepared.session.cameras[camera].mount
    views = prepared.views[camera]
    posed = {
        placement: view for placement, view in views.items() if view.T_camera_board is not None
    }
    planes = []
    crossed = []
    for placement, scan in prepared.scans.items():
        if placement not in views:
            continue
        source = source_of(prepared, camera, placement, T_head_lrf, corrections)
        if placement in posed and faces:
            planes.append(source.face(scan, faces))
        if variant == ONE_SCAN:
            sides = _one_scan_line(prepared, placement, views[placement])
        else:
            sides = _thinned_sides(prepared, placement, variant, crossings)
        crossed += _crossings(prepared, placement, views[placement], source, sides)
    corners = []
    if faces:
        rule = "last_beam" if variant == ONE_SCAN else variant
        corners = _corners(prepared, camera, rule, T_head_lrf, {} if outlines is None else outlines)
    return CameraObservations(
        camera=camera,
        source="platform" if mount == "platform" else "lrf",
        **_boards_in_images(prepared, camera, posed),
        **stack("plane_", planes),
        **stack("crossing_", crossed),
        **stack("scene_", corners),
    )


def _boards_in_images(prepared, camera, posed):
    """What one camera sees of the board: fields of CameraObservations by name."""
    model = prepared.models[camera]
    n = len(posed)
    pattern = np.zeros((0, 3))
    if prepared.board.pattern is not None:
        pattern = raised_points(prepared.board.pattern, prepared.relief)
    pixels = np.full((n, len(pattern), 2), np.nan)
    for row, view in enumerate(posed.values()):
        if view.pixels is not None:
            pixels[row] = view.pixels
    poses = [view.T_camera_board.as_matrix() for view in posed.values()]
    covariances = [view.covariance for view in posed.values()]
    return {
        "model": model,
        "placements": np.array(list(posed), int),
        "board_poses": np.array(poses).reshape(n, 4, 4),
        "board_covariance": np.array(covariances).reshape(n, 6, 6),
        "pattern_points": pattern,
        "pattern_pixels": pixels,
        "pattern_sigma_px": max(model.rms_px or 0.0, LEAST_CORNER_SIGMA),
    }


def observe_all(prepared, T_head_lrf=None):
    """Observations of all cameras in every edge-point variant, keyed by (camera, variant)."""
    outlines = {}
    observations = {}
    for camera, variant in product(prepared.views, (*VARIANTS, ONE_SCAN)):
        observations[camera, variant] = observe(
            prepared, camera, variant, T_head_lrf, outlines=outlines
        )
    return observations


@dataclass(frozen=True)
class RecordedSource:
    """Points of one placement as recorded, moved into the frame that a camera is fixed to.

    Known errors of ranges and pitch are taken out first; they change where a point lies, but not
    how its noise turns.
    """

    placement: int
    frame: SourceFrame
    corrections: Corrections

    def points(self, p_lrf, pitch):
        """Measured points (n, 3) at their recorded pitch (n,), in the camera's source frame,
        metres.
        """
        corrected = self.corrections.pitch(self.placement, pitch)
        return self.frame.apply(self.corrections.points(p_lrf), corrected)

    def covariance(self, covariance, pitch):
        """Covariances (n, 3, 3) of measured points, turned into the source frame."""
        R = self.frame.rotation(self.corrections.pitch(self.placement, pitch))
        return R @ covariance @ R.swapaxes(-1, -2)

    def by_pitch(self, p_lrf, pitch):
        """Derivative (n, 3) of :meth:`points` by an error of the recorded pitch, metres a
        radian.
        """
        corrected = self.corrections.pitch(self.placement, pitch)
        return self.frame.by_pitch(self.corrections.points(p_lrf), corrected)

    def face(self, scan, count):
        """At most `count` points of a board's face, with covariance, pitch and placement: columns
        by name.
        """
        points, pitch, covariance = face_points(scan, count)
        return {
            "points": self.points(points, pitch),
            "covariance": self.covariance(covariance, pitch),
            "pitch": pitch,
            "placement": np.full(len(pitch), self.placement),
        }


def source_of(prepared, camera, placement, T_head_lrf, corrections=AS_RECORDED):
    """The RecordedSource of a placement for one of its cameras."""
    mount = prepared.session.cameras[camera].mount
    image_pitch = 0.0
    if mount == "head":
        recorded = prepared.views[camera][placement].pitch
        image_pitch = float(corrections.pitch(placement, recorded))
    frame = SourceFrame(T_head_lrf, mount, image_pitch)
    return RecordedSource(placement, frame, corrections)


def _thinned_sides(prepared, placement, variant, count):
    """Named sides of a placement, each with `count` rows at most, evenly spread: pairs of NamedSide
    and rows.
    """
    for side in named_sides(prepared, placement, variant):
        yield side, thin(side.rows, count)


def _one_scan_line(prepared, placement, view):
    """The paper's choice: of the two edges of `features`, the last beams of the middle one of the
    lines crossing both.
    """
    features = [name for name in prepared.board.features if view.edge(name) is not None]
    sides = named_sides(prepared, placement, "last_beam")
    sides = [side for side in sides if side.name in features and not side.across]
    if len(sides) != 2:
        return
    both = np.intersect1d(*(side.edges.line[side.rows] for side in sides))
    middle = both[len(both) // 2 :][:1]
    for side in sides:
        yield side, side.rows[np.isin(side.edges.line[side.rows], middle)]


def _crossings(prepared, placement, view, source, sides):
    """Crossings of named sides with the image line of the same edge; `sides` are pairs of NamedSide
    and rows.
    """
    middle = np.mean(prepared.scans[placement].sweep.pitch)
    for side, rows in sides:
        edge = view.edge(side.name)
        if edge is None:
            continue
        n = len(rows)
        scanned = side.edges
        p_lrf = scanned.points[rows]
        pitch = scanned.pitch[rows]
        sigma_pitch = prepared.pitch_noise.sigma(pitch, middle)
        by_pitch = source.by_pitch(p_lrf, pitch) * sigma_pitch[:, None]
        pitch_error = by_pitch[:, :, None] * by_pitch[:, None, :]
        yield {
            "points": source.points(p_lrf, pitch),
            "pitch": pitch,
            "covariance": source.covariance(scanned.covariance[rows], pitch) + pitch_error,
            "radius": prepared.session.lrf.spot_radius(np.linalg.norm(p_lrf, axis=1)),
            "background": scanned.background[rows],
            "lines": np.tile(edge.line, (n, 1)),
            "line_sigma": np.full(n, np.sqrt(edge.covariance[0, 0])),
            "placement": np.full(n, placement),
            "edge": np.full(n, side.name),
            "across": np.full(n, side.across),
        }


def _corners(prepared, camera, variant, T_head_lrf, outlines):
    """Corners of the outline that the cloud and the image can both name: where two fitted edges
    meet.
    """
    mount = prepared.session.cameras[camera].mount
    edges = prepared.board.edges
    for placement in prepared.names:
        view = prepared.views[camera].get(placement)
        if (
            view is None
            or placement not in prepared.scans
            or placement not in prepared.swept[variant]
        ):
            continue
        if (placement, variant) not in outlines:  # the same for all cameras
            outlines[placement, variant] = outline_of(prepared, placement, variant, T_head_lrf)[0]
        board = outlines[placement, variant]
        for before, name in zip(edges[-1:] + edges[:-1], edges, strict=True):
            edge = view.edge(name)
            previous = view.edge(before)
            if name not in board.corners or edge is None or previous is None:
                continue
            corner = board.corner_point(name)
            by_pitch = _pitch_error(prepared, corner, board.T_platform_plane[:3, 3])
            points = np.stack([corner, corner + by_pitch])
            if mount == "head":
                points = T_head_lrf.inv().apply(tilt(points, -view.pitch))
            error = points[1] - points[0]
            # not averaged down: neighbours share errors
            scatter = max(board.scatter[name], board.scatter[before])
            yield {
                "points": points[:1],
                "covariance": [scatter**2 * np.eye(3) + np.outer(error, error)],
                "pixels": [corners_of_lines(np.stack([previous.line, edge.line]))[1]],
                "sigma_px": [np.sqrt(edge.covariance[0, 0] + previous.covariance[0, 0])],
                "placement": [placement],
            }


def _pitch_error(prepared, corner, middle):
    """By how much an error of the pitch moves a corner (3,) of a board with this middle, platform
    frame, metres.
    """
    at = np.arctan2(corner[2], corner[1])
    about = np.arctan2(middle[2], middle[1])
    return prepared.pitch_noise.sigma(at, about) * np.cross([1.0, 0.0, 0.0], corner)


def platform_observations(prepared, variant="half_step"):
    """Two perpendicular sides and the face of the board in every sweep, a PlatformObservations; no
    cameras are needed.

    Of each sweep the longest pair of perpendicular sides; a sweep with only one side gives that
    one.
    """
    edges = []
    faces = []
    for placement, swept in prepared.swept[variant].items():
        for number, (scanned, side) in enumerate(
            _feature_sides(prepared.edges[variant][placement], swept), 1
        ):
            rows = thin(np.flatnonzero(scanned.side == side.side), PLATFORM_POINTS)
            edges.append(
                {
                    "points": scanned.points[rows],
                    "covariance": scanned.covariance[rows],
                    "pitch": scanned.pitch[rows],
                    "placement": np.full(len(rows), placement),
                    "number": np.full(len(rows), number),
                }
            )
        points, pitch, covariance = face_points(prepared.scans[placement], FACE_POINTS)
        faces.append(
            {
                "points": points,
                "covariance": covariance,
                "pitch": pitch,
                "placement": np.full(len(pitch), placement),
            }
        )
    return PlatformObservations(**stack("edge_", edges), **stack("face_", faces))


def _feature_sides(along, swept):
    """The longest pair of perpendicular sides, else the longest side: tuple of (ScanEdges,
    ScanSide).
    """
    known = {s.side for s in along.sides}
    sides = [(along, s) for s in along.sides]
    sides += [(swept, s) for s in swept.sides if s.side not in known]
    candidates = [(one,) for one in sides]
    pairs = [pair for pair in combinations(sides, 2) if _cosine(*pair) < RIGHT_ANGLE]
    return max(
        pairs or candidates, key=lambda pair: np.prod([s.length for _, s in pair]), default=()
    )


def _cosine(one, other):
    """Absolute cosine between two sides, each with its ScanEdges."""
    return abs(one[1].direction @ other[1].direction)


def name_sides(prepared):
    """Name the sides that scans cross: the nearest edge of the board, which the images place in the
    scan.

    The cameras' poses come from the planes alone (Zhang and Pless), which needs no names. Returns
    edge names by placement and side number, those that got none likewise (DroppedSide), and
    problems: of :func:`rough_poses`, and why sides have no name. Those farther than 8 cm from every
    edge have none; nor has any where nobody knows the outline of the board.
    """
    rough, problems = rough_poses(prepared)
    names = {}
    dropped = {}
    maps = {}
    if prepared.board.corners is not None:
        maps = board_maps(prepared, rough)
    for placement, on_board in maps.items():
        sides = {}
        for found in (
            edges["half_step"].get(placement) for edges in (prepared.edges, prepared.swept)
        ):
            for side in () if found is None else np.unique(found.side[found.side >= 0]):
                rows = found.side == side
                sides.setdefault(int(side), on_board(found.points[rows], found.pitch[rows]))
        names[placement], dropped[placement] = nearest_edges(prepared.board, sides)
        for why in dropped[placement].values():
            problems.append(Problem(Stage.SIDES, ProblemKind.OTHER_SIDE, why.words, placement))
    return names, dropped, problems


def board_maps(prepared, rough):
    """Where points of each sweep lie on the board, through the first camera that sees it: dict of
    int to callable.

    From LRF points (n, 3) and their pitch (n,) to the board frame (n, 3); `rough` are poses by
    camera, and those of :func:`rough_poses` are good to about a centimetre.
    """
    maps = {}
    for camera, T_camera_source in rough.items():
        for placement, view in prepared.views[camera].items():
            if (
                view.T_camera_board is not None
                and placement in prepared.scans
                and placement not in maps
            ):
                source = source_of(prepared, camera, placement, platform_of(prepared))
                T = view.T_camera_board.inv() * T_camera_source
                maps[placement] = lambda p_lrf, pitch, T=T, source=source: T.apply(
                    source.points(p_lrf, pitch)
                )
    return maps


def rough_poses(prepared):
    """Poses ``T_camera_source`` of the cameras from the planes alone, and a list of Problem.

    Problems are placements that disagree with all others, and why a camera has no pose.
    """
    rough, problems, misses = {}, [], {}
    for camera in prepared.views:
        obs = observe(prepared, camera)
        try:
            inliers, outlying = find_outlying_placements(obs)
            rough[camera] = solve_camera(obs.select(inliers), "zhang_pless").transform
        except DegenerateGeometry as error:
            problems.append(Problem(Stage.SIDES, ProblemKind.NO_POSE, str(error), camera=camera))
            continue
        for placement in obs.placements.tolist():
            misses.setdefault(placement, {})[camera] = outlying.get(placement, 0.0)
    for placement, miss in misses.items():
        wrong = [camera for camera, off in miss.items() if off]
        if wrong:
            off = f"its plane is {1000 * max(miss.values()):.0f} mm rms off the"
            words = f"camera {wrong[0]}: {off} scan"
            if len(wrong) == len(miss) > 1:
                words = (
                    f"scan: {off} board in the images of all {len(miss)} cameras "
                    f"({_causes(prepared, placement)})"
                )
            words = f"{words}; left out"
            problems.append(Problem(Stage.SIDES, ProblemKind.OTHER_PLANE, words, placement))
    return rough, problems


def _causes(prepared, placement):
    """What may be wrong where the scan of a placement disagrees with all cameras."""
    causes = "another surface, mixed readings"
    views = {
        camera: {placement: seen[placement]}
        for camera, seen in prepared.views.items()
        if placement in seen
    }
    if small_squares(views, prepared.board.pattern):
        causes += (
            f"; or the images: squares below {SMALL_SQUARE_PX:.0f} px, whose distance may be biased"
        )
    return causes


def nearest_edges(board, sides):
    """Edge names of sides (board-frame points by number), each given once, and DroppedSide of those
    that got none.
    """
    lines = board.lines()
    names = {}
    dropped = {}
    numbers = list(sides)
    distances = [np.abs(p[:, :2] @ lines[:, :2].T + lines[:, 2]) for p in sides.values()]
    cost = np.array([np.median(d, axis=0) for d in distances]).reshape(-1, len(lines))
    for row, column in zip(*linear_sum_assignment(cost), strict=True):
        number, edge, off = numbers[row], board.edges[column], float(cost[row, column])
        turned, allowed, points = 0.0, NAME_ANGLE, sides[number]
        if len(points) > 2:  # what noise may turn the line through them is allowed
            _, direction, rms = fit_line(points)
            cosine = abs(direction[:2] @ lines[column, :2]) / np.linalg.norm(direction[:2])
            turned = np.arcsin(min(cosine, 1.0))
            noise = 3 * rms * np.sqrt(12 / len(points)) / np.ptp(points @ direction)
            allowed = np.hypot(NAME_ANGLE, noise)
        if off > NAME_DISTANCE:
            dropped[number] = DroppedSide(edge, off)
        elif turned > allowed:
            dropped[number] = DroppedSide(edge, off, float(turned))
        else:
            names[number] = edge
    return names, dropped


def observe_joint(prepared, views=None):
    """Everything that the joint estimate uses of a session, of the placements that
    are not left out.

    `views` are lists of BoardView by camera; those of :func:`all_views` when left out.
    """
    if views is None:
        views = all_views(prepared)
    session = prepared.session
    scans = {p: scan for p, scan in prepared.scans.items() if p not in prepared.left_out}
    ranges = [_ranges(scan, row) for row, scan in enumerate(scans.values())]
    lens_covariance = None
    if views:
        spreads = [prepared.models[camera].covariance for camera in views]
        lens_covariance = np.array([np.zeros((LENS, LENS)) if C is None else C for C in spreads])
    return JointObservations(
        placements=np.array(list(scans), int),
        direction=np.array([session.sweep_direction(p) for p in scans], int),
        middle=np.array([float(np.mean(scan.sweep.pitch)) for scan in scans.values()]),
        edges=tuple(prepared.board.edges),
        corners=_outline_corners(prepared.board),
        cameras=tuple(views),
        mounts=tuple(session.cameras[c].mount for c in views),
        T_head_lrf=session.T_head_lrf,
        lens_covariance=lens_covariance,
        **stack("face_", ranges),
        **stack("beam_", _beams(prepared, scans)),
        **stack("view_", _views(prepared, views, list(scans))),
    )


def _outline_corners(board):
    """Corners of the board's outline (n, 2); of its printed squares where nobody knows it: no beam
    is named after those.
    """
    if board.corners is None and board.pattern is not None:
        return corners_of_lines(side_lines(board.pattern, np.full(4, board.pattern.square)))
    return board.known_corners()


def _ranges(scan, row):
    """Ranges to the face of a board, of a placement in some row: columns by name."""
    p_lrf, pitch, _ = face_points(scan, FACE_POINTS)
    return {
        "range": np.linalg.norm(p_lrf, axis=1),
        "bearing": np.arctan2(p_lrf[:, 1], p_lrf[:, 0]),
        "pitch": pitch,
        "sigma": np.full(len(pitch), scan.sigma_range),
        "placement": np.full(len(pitch), row),
    }


def _beams(prepared, placements):
    """Beams about the named sides of placements, by row: columns by name."""
    for row, placement in enumerate(placements):
        cells = cells_of(prepared, placement)
        for side, name in prepared.names.get(placement, {}).items():
            about = cells[thin(np.flatnonzero(cells.side == side), CELLS_PER_EDGE)]
            columns = {
                key: about[key] for key in ("bearing", "pitch", "hit", "radius", "background")
            }
            columns["step"] = about.step * about.range_m
            columns["edge"] = np.full(len(about), prepared.board.edges.index(name))
            columns["placement"] = np.full(len(about), row)
            yield columns


def _views(prepared, views, placements):
    """Poses of the board in all images, of cameras by number and placements by row: columns by
    name.
    """
    for number, (camera, of_camera) in enumerate(views.items()):
        for view in of_camera:
            if view.T_camera_board is None or view.placement not in placements:
                continue
            corners = _visible_corners(prepared.board.pattern, view)
            yield {
                "camera": [number],
                "pitch": [np.nan_to_num(view.pitch)],
                "pose": [view.T_camera_board.as_matrix()],
                "covariance": [view.covariance],
                "placement": [placements.index(view.placement)],
                "lens": [pose_by_intrinsics(view.T_camera_board, corners, prepared.models[camera])],
            }


def _visible_corners(pattern, view):
    """Corners of the pattern (k, 3) that an image shows, board frame, metres."""
    if pattern is None or view.pixels is None:
        return np.zeros((0, 3))
    return pattern.points()[np.isfinite(view.pixels).all(axis=1)]
