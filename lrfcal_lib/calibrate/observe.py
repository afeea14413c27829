"""Pair what the LRF and the cameras saw: name the sides that scans cross, stack the observations of every method."""

from itertools import combinations, product

import numpy as np
from scipy.optimize import linear_sum_assignment

from lrfcal_lib.calibrate.outline import as_recorded, cells_of, named_sides, outline_of, platform_of
from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.geometry import DegenerateGeometry, fit_line, lrf_to_source, tilt
from lrfcal_lib.model.observations import CameraObservations, JointObservations, PlatformObservations
from lrfcal_lib.preprocess.board_in_scan import face_points
from lrfcal_lib.preprocess.edges_in_image import side_lines
from lrfcal_lib.preprocess.intrinsics import raised_points
from lrfcal_lib.preprocess.prepared import VARIANTS, DroppedSide
from lrfcal_lib.preprocess.survey import all_views
from lrfcal_lib.solvers import find_outlying_placements, solve_camera
from lrfcal_lib.solvers.joint_noise import pose_by_intrinsics
from lrfcal_lib.solvers.joint_start import thin

ONE_SCAN = "one_scan"
CROSSINGS_PER_EDGE = 24  # neighbouring scan lines repeat each other's errors; a line in space needs few points
FACE_POINTS = 150  # a placement: neighbouring ranges of a real device share their errors
CELLS_PER_EDGE = 160  # a placement, of each edge
PLATFORM_POINTS = 40  # per edge
NAME_DISTANCE = 0.08  # metres between a side in the cloud and the board edge it is named after, at most
NAME_ANGLE = np.deg2rad(3.0)  # between them; a side turned more is none (a cloud cut by hand, an occluder)
RIGHT_ANGLE = 0.15  # largest |cosine| between two sides that are taken for the board's perpendicular edges


def stack(prefix, parts):
    """Parts of a table end to end: its columns by name, with a prefix; none without parts."""
    parts = list(parts)
    return {prefix + key: np.concatenate([part[key] for part in parts]) for key in (parts[0] if parts else ())}


def observe(
    prepared, camera, variant="half_step", T_head_lrf=None, correct=as_recorded, crossings=CROSSINGS_PER_EDGE,
    faces=FACE_POINTS, made=None,
):
    """Pair what the LRF and one camera saw of the board.

    Parameters
    ----------
    prepared : Prepared
    camera : str
    variant : {'half_step', 'last_beam', 'one_scan'}
        Rule for the edge point; 'one_scan' is the paper's: last beams of the two edges of `board.features`, on the
        middle one of the scan lines that cross both.
    T_head_lrf : RigidTransform, optional
        Platform calibration to use instead of the session's own.
    correct : callable
        ``correct(placement, p_lrf, pitch) -> (p_lrf, pitch)`` takes known errors out of what was recorded; see
        :meth:`lrfcal_lib.solvers.joint.JointSolution.correct`.
    crossings, faces : int
        Kept of each edge and of the face of a placement, evenly spread; without `faces` only crossings are paired.
    made : dict, optional
        Filled with what other calls with the same `T_head_lrf`, `correct` and `faces` need not work out again.

    Returns
    -------
    CameraObservations
    """
    board, model, T_head_lrf = prepared.board, prepared.models[camera], platform_of(prepared, T_head_lrf)
    posed = {p: view for p, view in prepared.views[camera].items() if view.T_camera_board is not None}
    pattern = np.zeros((0, 3)) if board.pattern is None else raised_points(board.pattern, prepared.relief)
    n, k = len(posed), len(pattern)
    pixels = [np.full((k, 2), np.nan) if view.pixels is None else view.pixels for view in posed.values()]
    planes, crossed, one_scan, made = [], [], variant == ONE_SCAN, {} if made is None else made
    variant = "last_beam" if one_scan else variant
    for placement, scan in prepared.scans.items():
        view = prepared.views[camera].get(placement)
        if view is None:
            continue
        turn = source_of(prepared, camera, placement, T_head_lrf, correct)
        if placement in posed and faces:
            if (camera, placement) not in made:
                points, pitch, covariance = face_points(scan, faces)
                R, number = _rotation(turn, pitch), np.full(len(pitch), placement)
                points, covariance = turn(points, pitch), R @ covariance @ R.swapaxes(-1, -2)
                face = {"points": points, "covariance": covariance, "pitch": pitch, "placement": number}
                made[camera, placement] = face
            planes.append(made[camera, placement])
        crossed += _crossings(prepared, placement, view, variant, turn, crossings, one_scan)
    return CameraObservations(
        camera=camera,
        source="platform" if prepared.session.cameras[camera].mount == "platform" else "lrf",
        model=model,
        placements=np.array(list(posed), int),
        board_poses=np.array([view.T_camera_board.as_matrix() for view in posed.values()]).reshape(n, 4, 4),
        board_covariance=np.array([view.covariance for view in posed.values()]).reshape(n, 6, 6),
        pattern_points=pattern,
        pattern_pixels=np.array(pixels).reshape(n, k, 2),
        pattern_sigma_px=max(model.rms_px or 0.0, 0.05),
        **stack("plane_", planes),
        **stack("crossing_", crossed),
        **stack("scene_", _corners(prepared, camera, variant, T_head_lrf, made) if faces else ()),
    )


def observe_all(prepared, T_head_lrf=None):
    """Observations of all cameras in every edge-point variant, keyed by (camera, variant)."""
    keys, made = product(prepared.views, (*VARIANTS, ONE_SCAN)), {}
    return {(camera, variant): observe(prepared, camera, variant, T_head_lrf, made=made) for camera, variant in keys}


def source_of(prepared, camera, placement, T_head_lrf, correct=as_recorded):
    """Function of LRF points of a placement and their pitch: moves them into the frame that a camera is fixed to."""
    mount, image_pitch = prepared.session.cameras[camera].mount, 0.0
    if mount == "head":
        image_pitch = float(correct(placement, np.zeros(3), prepared.views[camera][placement].pitch)[1])
    return lambda p_lrf, pitch: lrf_to_source(*correct(placement, p_lrf, pitch), T_head_lrf, mount, image_pitch)


def _rotation(turn, pitch):
    """From the LRF at some pitch angles to the frame that points are turned to, shape (n, 3, 3)."""
    origin, *axes = turn(np.broadcast_to(np.eye(4, 3, -1)[:, None], (4, len(pitch), 3)), pitch)
    return np.stack(axes, axis=-1) - origin[..., None]


def _crossings(prepared, placement, view, variant, turn, count, one_scan):
    """Crossings of named sides with the image line of the same edge, thinned evenly along each edge."""
    middle = np.mean(prepared.scans[placement].sweep.pitch)
    sides = list(named_sides(prepared, placement, variant))
    if one_scan:
        features = [name for name in prepared.board.features if view.edge(name) is not None]
        sides = [part for part in sides if part[0] in features and not part[3]]
        lines = [found.line[found.side == side] for _, found, side, _ in sides]
        both = np.intersect1d(*lines) if len(lines) == 2 else np.zeros(0, int)
    for name, found, side, across in sides:
        edge = view.edge(name)
        if edge is None:
            continue
        rows = thin(np.flatnonzero(found.side == side), count)
        if one_scan:
            rows = np.flatnonzero((found.side == side) & np.isin(found.line, both[len(both) // 2 :][:1]))
        p_lrf, pitch, n, step = found.points[rows], found.pitch[rows], len(rows), 1e-6
        points, *beside = turn(np.stack([p_lrf] * 3), pitch + step * np.array([[0.0], [1.0], [-1.0]]))
        moved = (beside[0] - beside[1]) / (2 * step) * prepared.pitch_noise.sigma(pitch, middle)[:, None]
        R, error = _rotation(turn, pitch), moved[:, :, None] * moved[:, None, :]  # of the recorded pitch
        yield {
            "points": points,
            "pitch": pitch,
            "covariance": R @ found.covariance[rows] @ R.swapaxes(-1, -2) + error,
            "noise": R @ found.noise[rows] @ R.swapaxes(-1, -2) + error,
            "half_step": (R @ found.half_step[rows][..., None])[..., 0],
            "radius": prepared.session.lrf.spot_radius(np.linalg.norm(p_lrf, axis=1)),
            "background": found.background[rows],
            "lines": np.tile(edge.line, (n, 1)),
            "line_sigma": np.full(n, np.sqrt(edge.covariance[0, 0])),
            "placement": np.full(n, placement),
            "edge": np.full(n, name),
            "across": np.full(n, across),
        }


def _corners(prepared, camera, variant, T_head_lrf, made):
    """Corners of the outline that the cloud and the image can both name: where two fitted edges meet."""
    edges, mount = prepared.board.edges, prepared.session.cameras[camera].mount
    for placement in prepared.names:
        view = prepared.views[camera].get(placement)
        if view is None or placement not in prepared.scans or placement not in prepared.swept[variant]:
            continue
        if (placement, variant) not in made:  # the same for all cameras
            made[placement, variant] = outline_of(prepared, placement, variant, T_head_lrf)[0]
        board = made[placement, variant]
        for before, name in zip(edges[-1:] + edges[:-1], edges, strict=True):
            seen = view.edge(name), view.edge(before)
            if name not in board.corners or None in seen:
                continue
            corner = board.corner_point(name)
            up = [np.arctan2(p[2], p[1]) for p in (corner, board.T_platform_plane[:3, 3])]
            off = prepared.pitch_noise.sigma(*up) * np.cross([1.0, 0.0, 0.0], corner)  # by the error of the pitch
            points = np.stack([corner, corner + off])
            if mount == "head":
                points = T_head_lrf.inv().apply(tilt(points, -view.pitch))
            error = points[1] - points[0]
            scatter = max(board.scatter[name], board.scatter[before])  # not averaged down: neighbours share errors
            yield {
                "points": points[:1],
                "covariance": [scatter**2 * np.eye(3) + np.outer(error, error)],
                "pixels": [corners_of_lines(np.stack([seen[1].line, seen[0].line]))[1]],
                "sigma_px": [np.hypot(*(np.sqrt(edge.covariance[0, 0]) for edge in seen))],
                "placement": [placement],
            }


def platform_observations(prepared, variant="half_step"):
    """Two perpendicular sides and the face of the board in every sweep, a PlatformObservations; no cameras are needed.

    Of each sweep the longest pair of perpendicular sides; a sweep with only one side gives that one.
    """
    edges, faces = [], []

    def cosine(pair):
        u, v = (s.ends[1] - s.ends[0] for _, s in pair)
        return u @ v / (np.linalg.norm(u) * np.linalg.norm(v))

    for placement, swept in prepared.swept[variant].items():
        along = prepared.edges[variant][placement]
        known = {s.side for s in along.sides}
        sides = [(along, s) for s in along.sides] + [(swept, s) for s in swept.sides if s.side not in known]
        pairs = [pair for pair in combinations(sides, 2) if abs(cosine(pair)) < RIGHT_ANGLE]
        best = max(pairs or zip(sides, strict=True), key=lambda some: np.prod([s.length for _, s in some]), default=())
        for number, (found, side) in enumerate(best, 1):
            rows = thin(np.flatnonzero(found.side == side.side), PLATFORM_POINTS)
            points = {key: getattr(found, key)[rows] for key in ("points", "covariance", "pitch")}
            edges.append(points | {"placement": np.full(len(rows), placement), "number": np.full(len(rows), number)})
        points, pitch, covariance = face_points(prepared.scans[placement], FACE_POINTS)
        face = {"points": points, "covariance": covariance, "pitch": pitch}
        faces.append(face | {"placement": np.full(len(pitch), placement)})
    return PlatformObservations(**stack("edge_", edges), **stack("face_", faces))


def name_sides(prepared):
    """Name the sides that scans cross: the nearest edge of the board, which the images place in the scan.

    The cameras' poses come from the planes alone (Zhang and Pless), which needs no names. Returns edge names by
    placement and side number, those that got none likewise (DroppedSide), and problems: of
    :func:`rough_poses`, and why sides have no name. Those farther than 8 cm from every edge have
    none; nor has any where nobody knows the outline of the board.
    """
    rough, problems = rough_poses(prepared)
    names, dropped = {}, {}
    for placement, on_board in board_maps(prepared, rough).items() if prepared.board.corners is not None else ():
        sides = {}
        for found in (edges["half_step"].get(placement) for edges in (prepared.edges, prepared.swept)):
            for side in () if found is None else np.unique(found.side[found.side >= 0]):
                rows = found.side == side
                sides.setdefault(int(side), on_board(found.points[rows], found.pitch[rows]))
        names[placement], dropped[placement] = nearest_edges(prepared.board, sides)
        for side, why in dropped[placement].items():
            problems[f"{placement} {side}"] = f"placement {placement}: {why.words}"
    return names, dropped, problems


def board_maps(prepared, rough):
    """Where points of each sweep lie on the board, through the first camera that sees it: dict of int to callable.

    From LRF points (n, 3) and their pitch (n,) to the board frame (n, 3); `rough` are poses by camera, and those of
    :func:`rough_poses` are good to about a centimetre.
    """
    maps = {}
    for camera, T_camera_source in rough.items():
        for placement, view in prepared.views[camera].items():
            if view.T_camera_board is not None and placement in prepared.scans and placement not in maps:
                turn = source_of(prepared, camera, placement, platform_of(prepared))
                T = view.T_camera_board.inv() * T_camera_source
                maps[placement] = lambda p_lrf, pitch, T=T, turn=turn: T.apply(turn(p_lrf, pitch))
    return maps


def rough_poses(prepared):
    """Poses ``T_camera_source`` of the cameras from the planes alone, and problems by placement or camera.

    Problems are placements that disagree with all others, and why a camera has no pose.
    """
    rough, problems, misses = {}, {}, {}
    for camera in prepared.views:
        obs = observe(prepared, camera)
        try:
            inliers, outlying = find_outlying_placements(obs)
            rough[camera] = solve_camera(obs.select(inliers), "zhang_pless").transform
        except DegenerateGeometry as error:
            problems[f"camera {camera}"] = str(error)
            continue
        for placement in obs.placements.tolist():
            misses.setdefault(placement, {})[camera] = outlying.get(placement, 0.0)
    for placement, miss in misses.items():
        wrong = [camera for camera, off in miss.items() if off]
        if wrong:
            off = f"its plane is {1000 * max(miss.values()):.0f} mm rms off the"
            words = f"camera {wrong[0]}: {off} scan"
            if len(wrong) == len(miss) > 1:
                words = f"scan: {off} board in the images of all {len(miss)} cameras (another surface, mixed readings)"
            problems[placement] = f"{words}; left out"
    return rough, problems


def nearest_edges(board, sides):
    """Edge names of sides (board-frame points by number), each given once, and the DroppedSide."""
    lines, names, dropped, numbers = board.lines(), {}, {}, list(sides)
    distances = [np.abs(p[:, :2] @ lines[:, :2].T + lines[:, 2]) for p in sides.values()]
    cost = np.array([np.median(d, axis=0) for d in distances]).reshape(-1, len(lines))
    for row, column in zip(*linear_sum_assignment(cost), strict=True):
        number, edge, off = numbers[row], board.edges[column], float(cost[row, column])
        turned, allowed, points = 0.0, NAME_ANGLE, sides[number]
        if len(points) > 2:  # what noise may turn the line through them is allowed
            _, direction, rms = fit_line(points)
            turned = np.arcsin(min(abs(direction[:2] @ lines[column, :2]) / np.linalg.norm(direction[:2]), 1.0))
            allowed = np.hypot(NAME_ANGLE, 3 * rms * np.sqrt(12 / len(points)) / np.ptp(points @ direction))
        if off > NAME_DISTANCE:
            dropped[number] = DroppedSide(edge, off)
        elif turned > allowed:
            dropped[number] = DroppedSide(edge, off, float(turned))
        else:
            names[number] = edge
    return names, dropped


def observe_joint(prepared, views=None):
    """Everything that the joint estimate uses of a session, of the placements that `prepared.problems` does not name.

    `views` are lists of BoardView by camera; those of :func:`all_views` when left out.
    """
    views, session, board = all_views(prepared) if views is None else views, prepared.session, prepared.board
    scans = {p: scan for p, scan in prepared.scans.items() if p not in prepared.problems}
    if board.corners is None and board.pattern is not None:  # of the printed squares: no beam is named after those
        corners = corners_of_lines(side_lines(board.pattern, np.full(4, board.pattern.square)))
    else:
        corners = board.known_corners()
    ranges, spreads = [], [prepared.models[camera].covariance for camera in views]
    for row, scan in enumerate(scans.values()):
        p, pitch, _ = face_points(scan, FACE_POINTS)
        polar = {"range": np.linalg.norm(p, axis=1), "bearing": np.arctan2(p[:, 1], p[:, 0]), "pitch": pitch}
        n = len(pitch)
        ranges.append(polar | {"sigma": np.full(n, scan.sigma_range), "placement": np.full(n, row)})
    return JointObservations(
        placements=np.array(list(scans), int),
        direction=np.array([session.sweep_direction(p) for p in scans], int),
        middle=np.array([float(np.mean(scan.sweep.pitch)) for scan in scans.values()]),
        edges=tuple(board.edges),
        corners=corners,
        cameras=tuple(views),
        mounts=tuple(session.cameras[c].mount for c in views),
        T_head_lrf=session.T_head_lrf,
        lens_covariance=np.array([np.zeros((9, 9)) if C is None else C for C in spreads]) if views else None,
        **stack("face_", ranges),
        **stack("beam_", _beams(prepared, scans)),
        **stack("view_", _views(prepared, views, list(scans))),
    )


def _beams(prepared, placements):
    for row, placement in enumerate(placements):
        cells = cells_of(prepared, placement)
        for side, name in prepared.names.get(placement, {}).items():
            some = cells[thin(np.flatnonzero(cells.side == side), CELLS_PER_EDGE)]
            n, edge = len(some), prepared.board.edges.index(name)
            own = {key: some[key] for key in ("bearing", "pitch", "hit", "radius", "background")}
            yield own | {
                "step": some.step * some.range_m, "edge": np.full(n, edge), "placement": np.full(n, row)
            }  # fmt: skip


def _views(prepared, views, placements):
    pattern = prepared.board.pattern
    for number, (camera, found) in enumerate(views.items()):
        for view in found:
            if view.T_camera_board is None or view.placement not in placements:
                continue
            seen = np.zeros((0, 3))
            if pattern is not None and view.pixels is not None:
                seen = pattern.points()[np.isfinite(view.pixels).all(axis=1)]
            yield {
                "camera": [number], "pitch": [np.nan_to_num(view.pitch)], "pose": [view.T_camera_board.as_matrix()],
                "covariance": [view.covariance], "placement": [placements.index(view.placement)],
                "lens": [pose_by_intrinsics(view.T_camera_board, seen, prepared.models[camera])],
            }  # fmt: skip
