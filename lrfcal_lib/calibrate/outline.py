"""Edge lengths of boards in the cloud: by least squares, by likelihood, and with the edges that images show."""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform
from scipy.special import fdtri

from lrfcal_lib.fit.least_squares import Block
from lrfcal_lib.fit.residuals import beam_terms, edge_shift, flip_sigma, pad
from lrfcal_lib.model import geometry
from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.geometry import DegenerateGeometry, fit_line, lrf_to_platform, polar_to_points, tilt
from lrfcal_lib.preprocess.bend import quadratic
from lrfcal_lib.preprocess.board_in_scan import face_points
from lrfcal_lib.preprocess.edges_in_scan import edge_cells

LEAST_STRETCH = 0.4  # share of an edge that must be seen before its line decides a corner
LAPSE = 0.005  # share of beams that something else than the edge decides
FEWEST_CELLS = 8
ROUNDS = 40
FAR = np.diag([1e2, 1.0])  # information of a side that no beam tells anything about: a metre and a radian are far
ALONG = np.linspace(0.0, 1.0, 9)  # places along the stretch of an image edge


@dataclass(frozen=True)
class MeasuredBoard:
    """The outline of a board as the cloud shows it.

    Attributes
    ----------
    T_platform_plane : ndarray, shape (4, 4)
        Origin in the middle of the face, z along the normal towards the sensor.
    lines, corners : dict of str to ndarray, shapes (3,) and (2,)
        Sides that were measured, ``a x + b y + c = 0`` in the plane, metres, and where an edge meets the one before it.
    lengths, scatter, sigma : dict of str to float
        Metres: edges of which both ends are measured; rms distances of points from the lines (least squares only);
        standard deviations of the lengths, by least squares from that scatter alone.
    """

    T_platform_plane: np.ndarray
    lines: dict
    corners: dict
    lengths: dict
    scatter: dict = field(default_factory=dict)
    sigma: dict = field(default_factory=dict)

    def corner_point(self, name):
        """The corner where an edge starts, shape (3,), in the frame of the cloud."""
        return self.T_platform_plane[:3, 3] + self.T_platform_plane[:3, :2] @ self.corners[name]


def plane_frame(points):
    """A frame in the plane of some points, shape (4, 4): origin in their middle, z towards the origin of the points."""
    normal, distance, _ = geometry.fit_plane(points)
    normal, distance = (-normal, -distance) if distance > 0 else (normal, distance)
    across = np.linalg.svd(geometry.hat(normal))[2][0]
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = across, np.cross(normal, across), normal
    centre = np.nanmean(points, axis=0)
    pose[:3, 3] = centre - normal * (normal @ centre - distance)
    return pose


def measure_board(face, sides, edges, each=1):
    """Measure a board's outline in a cloud: plane through the face, lines through its sides, corners where they meet.

    `face` are points (n, 3), `sides` edge points (k, 3) by edge name, metres, of which `each` share one error; `edges`
    all edges in order around the board. Standard deviations are those of the points about the lines alone.
    """
    pose, fits = plane_frame(face), []
    if not sides:
        return MeasuredBoard(pose, {}, {}, {})
    for points in sides.values():
        flat = (points - pose[:3, 3]) @ pose[:3, :2]
        line, middle = _flat_line(flat)
        along, n = (flat - middle) @ [-line[1], line[0]], max(len(flat) / each, 1.0)
        square = np.sum((flat @ line[:2] + line[2]) ** 2) / (len(flat) - each) if len(flat) > each else np.nan
        fits.append((line, middle, square / n * np.array([1.0, 1 / max(np.mean(along**2), 1e-12)])))
    lines, middle, spread = (np.array(part) for part in zip(*fits, strict=True))
    outline, sigma = sized(lines, middle, np.diag(spread.ravel()), list(sides), edges)
    return MeasuredBoard(pose, *outline, {name: fit_line(points)[2] for name, points in sides.items()}, sigma)


def sized(lines, middle, covariance, names, edges):
    """Sides by name, corners and lengths, and the standard deviations of these by edge.

    `covariance` (2 s, 2 s) is of shifts and turns of the lines (s, 3) about their `middle` (s, 2).
    """

    def outline(lines):
        """Sides, corners where two neighbours were found (..., 2), and lengths between these (...), by edge."""
        sides = dict(zip(names, np.moveaxis(lines, -2, 0), strict=True))
        pairs = list(zip(edges, edges[1:] + edges[:1], strict=True))
        both = {after: [sides[k], sides[after]] for k, after in pairs if k in sides and after in sides}
        corners = {name: corners_of_lines(np.stack(two, axis=-2))[..., 1, :] for name, two in both.items()}
        ends = {k: (corners[k], corners[after]) for k, after in pairs if k in corners and after in corners}
        return sides, corners, {name: np.linalg.norm(b - a, axis=-1) for name, (a, b) in ends.items()}

    sides, corners, size = outline(lines)
    steps = 1e-6 * np.eye(len(covariance)).reshape(len(covariance), -1, 2)
    after = outline(moved_lines(lines, middle, steps))[2]
    lengths, sigma = {name: float(value) for name, value in size.items()}, {}
    for name, value in lengths.items():
        J = (after[name] - value) / 1e-6
        sigma[name] = float(np.sqrt(np.sum(J * (covariance @ J))))
    return (sides, corners, lengths), sigma


def _flat_line(points):
    """The line ``a x + b y + c = 0`` (3,) through points (n, 2) of a plane, and their middle."""
    middle, (x, y), _ = fit_line(points)
    return np.array([y, -x, x * middle[1] - y * middle[0]]), middle


def named_sides(prepared, placement, variant="half_step", stretch=0.0):
    """Named sides of a placement of which some share is seen: edge, points, side number, whether across the lines."""
    along, swept = prepared.edges[variant][placement], prepared.swept[variant].get(placement)
    numbers, length = np.unique(along.side), prepared.board.lengths() if stretch else {}
    for side, name in prepared.names.get(placement, {}).items():
        found = along if side in numbers else swept
        seen = next((s.length for s in found.sides if s.side == side), 0.0)
        if seen >= stretch * length.get(name, 0.0):
            yield name, found, side, found is not along


def outline_of(prepared, placement, variant="half_step", T_head_lrf=None):
    """Measure the board's outline in the cloud of a placement by least squares: MeasuredBoard, and edges by the pitch.

    The platform is the session's own when left out. Sides of which less than 40 % is seen are missing: a stub does not
    carry a line to its corners. The second result are the edges found across the scan lines (where the sweep enters or
    leaves the board), a frozenset: their place hangs on the recorded pitch. DegenerateGeometry if the sweep does not
    cross enough scan lines to span a plane.
    """
    T_head_lrf = platform_of(prepared, T_head_lrf)
    points, pitch, _ = face_points(prepared.scans[placement])
    sides, across = {}, set()
    for name, found, side, swept in named_sides(prepared, placement, variant, LEAST_STRETCH):
        rows = found.side == side
        sides[name] = lrf_to_platform(found.points[rows], found.pitch[rows], T_head_lrf)
        across |= {name} if swept else set()
    return measure_board(lrf_to_platform(points, pitch, T_head_lrf), sides, prepared.board.edges), frozenset(across)


def platform_of(prepared, T_head_lrf=None):
    """The platform calibration to use: the one given, else the session's, else a tilt axis along x of the LRF."""
    return next(T for T in (T_head_lrf, prepared.session.T_head_lrf, RigidTransform.identity()) if T is not None)


def cells_of(prepared, placement):
    """Beams about the edges in the sweep of a placement, see :func:`edge_cells`."""
    along, swept = prepared.edges["half_step"][placement], prepared.swept["half_step"].get(placement)
    return edge_cells(prepared.scans[placement], along, swept, prepared.session.lrf)


def likely_outline_of(prepared, placement, model):
    """Measure the board's outline in one sweep by likelihood, with a JointSolution of other placements.

    Returns and raises what :func:`outline_of` does; also raises DegenerateGeometry when no side has enough beams.
    """
    sides, scan = list(named_sides(prepared, placement, stretch=LEAST_STRETCH)), prepared.scans[placement]
    points, pitch, _ = face_points(scan)
    face = points, model.corrections.pitch(placement, pitch), scan.sigma_range
    cells = cells_of(prepared, placement)
    cells.pitch = model.corrections.pitch(placement, cells.pitch)
    names = {side: name for name, _, side, _ in sides}
    measured = measure_outline(cells, face, names, prepared.board.edges, model)
    return measured, frozenset(name for name, _, _, swept in sides if swept)


def measure_outline(cells, face, names, edges, model):
    """Measure a board of unknown size in one sweep.

    `cells` are its beams about the edges, `face` points on it (LRF frame, metres), their pitch (radians)
    and the standard deviation of a range (metres), `names` the edge of each side, `edges` all edges in order around the
    board, `model` a JointSolution: backgrounds are not equally bright, so the log odds of the edge differ from side to
    side. Raises DegenerateGeometry if the face does not span a plane, or no side has enough cells.
    """
    pose, bend = face_surface(face, model)
    found = {side: name for side, name in names.items() if np.sum(cells.side == side) >= FEWEST_CELLS}
    if not found:
        raise DegenerateGeometry(f"no side has {FEWEST_CELLS} beams about it")
    rays = rays_about(cells, list(found), pose, bend, model)
    lines, middle = start_lines(rays)
    lines, information = fit_sides(rays, lines, middle, model)
    covariance = block_diag(*np.linalg.inv(information + FAR))
    slope = edge_shift(model.sensor["edge_log_odds"], rays["radius"], rays["background"])[1]
    slope = np.sum(slope * rays["used"], axis=1) / rays["used"].sum(axis=1)
    # beside the beams' own: the log odds common to all sides, and what differs from side to side
    common = model.sigma.get("edge_log_odds", 0.0) * slope
    spread = model.noise["side_sigma"] * model.unknowns.sides
    covariance[::2, ::2] += np.outer(common, common) + np.diag((spread * slope) ** 2)

    outline, sigma = sized(lines, middle, covariance, list(found.values()), edges)
    by_face = _by_face(pose, face, model)
    sigma = {name: float(np.hypot(value, np.sqrt(by_face) * outline[2][name])) for name, value in sigma.items()}
    return MeasuredBoard(pose, *outline, sigma=sigma)


def face_surface(face, model):
    """The face of a board (see :func:`measure_outline`) as a plane, see :func:`plane_frame`, and its bend (6,).

    Height over the plane is ``bend . (1, x, y, x^2, x y, y^2)``, metres; zero where the points do not ask for it (F
    test at 0.1 %): cardboard bends by a centimetre, and a ray at a slant then meets it elsewhere.
    """
    points, pitch, _ = face
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    p = lrf_to_platform(points - model.sensor["range_offset"] * rays, pitch, model.T_head_lrf)
    pose = plane_frame(p)
    p = (p - pose[:3, 3]) @ pose[:3, :3]
    A, freedom = quadratic(p[:, :2]), max(len(p) - 6, 1)
    flat, bent = (np.linalg.lstsq(A[:, :k], p[:, 2], rcond=None)[0] for k in (3, 6))
    before, after = np.sum((p[:, 2] - A[:, :3] @ flat) ** 2), np.sum((p[:, 2] - A @ bent) ** 2)
    asked = (before - after) / 3 / (after / freedom) > fdtri(3, freedom, 0.999)
    return pose, bent if asked else np.zeros(6)


def rays_about(cells, sides, pose, bend, model):
    """Cells of some sides as rays in the plane's frame, padded by side (s, n), and where they meet the face."""
    cells = cells[np.isin(cells.side, sides)]
    p_lrf = polar_to_points(np.ones(len(cells)), cells.bearing)
    direction = tilt(p_lrf @ model.T_head_lrf.rotation.as_matrix().T, cells.pitch) @ pose[:3, :3]
    origin = (tilt(model.T_head_lrf.translation, cells.pitch) - pose[:3, 3]) @ pose[:3, :3]
    height = 0.0
    for _ in range(4):  # intersect with the height of the bent face at the last place
        at = origin + ((height - origin[:, 2]) / direction[:, 2])[:, None] * direction
        height = quadratic(at[:, :2]) @ bend
    rays = {name: cells[name] for name in ("hit", "radius", "background")}
    rays |= {"at": at[:, :2], "direction": direction, "step": cells.range_m * cells.step}
    return pad(rays | {"placement": np.array([sides.index(side) for side in cells.side])}, len(sides))


def start_lines(rays):
    """A line through the cells of each side (s, 3), and their middle (s, 2): as many lie on either side of the edge."""
    found = []
    for at, hit, used in zip(rays["at"], rays["hit"], rays["used"], strict=True):
        line, middle = _flat_line(at[used])
        if hit[used].any() and not hit[used].all():
            line = line * np.sign(line[:2] @ (at[used & ~hit].mean(axis=0) - at[used & hit].mean(axis=0)))
        found.append((line, middle))
    return tuple(map(np.array, zip(*found, strict=True)))


def side_block(rays, lines, middle, model):
    """Likelihoods of the beams about each side, by shifts outwards (metres) and turns (radians) about its middle."""
    normal, z = lines[:, None, :2], rays["direction"][..., 2]
    across = np.sum(normal * rays["direction"][..., :2], axis=-1)
    factor = np.abs(z) / np.hypot(np.where(rays["used"], z, 1.0), across)
    u = (np.sum(normal * rays["at"], axis=-1) + lines[:, 2:]) * factor  # distance from the edge, positive outside
    shift, _ = edge_shift(model.sensor["edge_log_odds"], rays["radius"], rays["background"])
    softness, radius = np.exp(model.sensor["edge_log_softness"]), np.where(rays["used"], rays["radius"], 1.0)
    sigma, _ = flip_sigma(softness, radius, rays["step"])
    cost, score, information = beam_terms(shift - u, sigma, rays["hit"], LAPSE)
    turned = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    J = np.stack([factor, -factor * np.sum(turned * (rays["at"] - middle[:, None]), axis=-1)], axis=-1)
    root = np.sqrt(information) * rays["used"]
    residuals = np.divide(score, root, out=np.zeros_like(score), where=root * sigma > 1e-7)
    return Block(residuals, root[..., None] * J, np.ones_like(root), cost=cost * rays["used"])


def fit_sides(rays, lines, middle, model):
    """Damped steps of all sides at once: lines (s, 3), and the information (s, 2, 2) on their shifts and turns.

    The Jacobian leaves out how a turn changes the slant of the rays, so this loop's end differs from that of
    :func:`lrfcal_lib.fit.least_squares.minimise` by up to 3 micrometres; with it, by up to 16.
    """
    damping, block = np.full(len(lines), 1e-3), side_block(rays, lines, middle, model)
    for _ in range(ROUNDS):
        transposed = np.swapaxes(block.jacobian, -1, -2)
        information, gradient = transposed @ block.jacobian, transposed @ block.residuals[..., None]
        far = np.eye(2) * (information + FAR)
        step = -np.linalg.solve(information + damping[:, None, None] * far, gradient)[..., 0]
        trial = moved_lines(lines, middle, np.clip(step, -0.01, 0.01))
        good = np.sum(side_block(rays, trial, middle, model).cost, axis=1) <= np.sum(block.cost, axis=1)
        lines = np.where(good[:, None], trial, lines)
        damping = np.clip(np.where(good, damping / 10, damping * 10), 1e-9, 1e9)
        block = side_block(rays, lines, middle, model)
        if np.all(np.abs(step) < [1e-8, 1e-7]):
            break
    return lines, np.swapaxes(block.jacobian, -1, -2) @ block.jacobian


def moved_lines(lines, middle, step):
    """Lines shifted outwards and turned about the middle of their cells."""
    c, s = np.cos(step[..., 1]), np.sin(step[..., 1])
    at = np.sum(lines[:, :2] * middle, axis=1) + lines[:, 2] - step[..., 0]
    x, y = c * lines[:, 0] - s * lines[:, 1], s * lines[:, 0] + c * lines[:, 1]
    return np.stack([x, y, at - (x * middle[:, 0] + y * middle[:, 1])], axis=-1)


def _by_face(pose, face, model):
    """Variance of a metre from the range offset, and the plane's noise: a tilt stretches what is seen at a slant."""
    points, _, sigma = face
    away = np.linalg.norm(points, axis=1)
    cosine = np.median(np.abs(points @ pose[:3, 2]) / away)
    slant = np.sqrt(max(1 - cosine**2, 0.0)) / max(cosine, 0.1)
    spread = np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1)) / 2)
    tilt_sigma = sigma * max(cosine, 0.1) / np.sqrt(len(points)) / max(spread, 1e-3)
    offset = model.sigma.get("range_offset", 0.0) / np.median(away)
    return (slant * tilt_sigma) ** 2 + offset**2


def fused_outline_of(joint, placement):
    """Measure the outline of a board whose size nobody knows: image edges on the plane of the cloud.

    From the estimate without the placement where the JointCalibration has one; every camera's edges count alike.
    Returns a MeasuredBoard, and None: no end hangs on beams or on where a sweep enters or leaves the board.
    DegenerateGeometry if the sweep does not span a plane, or no image shows an edge.
    """
    solution, prepared = joint.without.get(placement, joint.solution), joint.prepared
    face, sides = edges_in_cloud(solution, prepared, placement)
    if not sides:
        raise DegenerateGeometry(f"placement {placement}: no image shows an edge of the board")
    return measure_board(face, sides, prepared.board.edges, len(ALONG)), None


def edges_in_cloud(solution, prepared, placement):
    """Face points (n, 3) of a placement under a JointSolution, and points of image edges in their plane, by edge."""
    recorded, recorded_pitch, _ = face_points(prepared.scans[placement])
    points = solution.corrections.points(recorded)
    pitch = solution.corrections.pitch(placement, recorded_pitch)
    face = lrf_to_platform(points, pitch, solution.T_head_lrf)
    pose, sides = plane_frame(face), {}
    for camera, views in prepared.views.items():
        view = views.get(placement)
        if view is None or camera not in solution.transforms:
            continue
        T_platform_camera = solution.camera_at(camera, solution.corrections.pitch(placement, view.pitch)).inv()
        lens, o = prepared.models[camera], T_platform_camera.translation
        for edge in view.edges:  # where lines of sight of a few of its points meet the plane
            ends = edge.ends - (edge.ends @ edge.line[:2] + edge.line[2])[:, None] * edge.line[:2]
            uv = ends[0] + ALONG[:, None] * (ends[1] - ends[0])
            rays = np.column_stack([(uv - [lens.cx, lens.cy]) / [lens.fx, lens.fy], np.ones(len(uv))])
            d = T_platform_camera.rotation.apply(rays)
            points = o + ((pose[:3, 3] - o) @ pose[:3, 2] / (d @ pose[:3, 2]))[:, None] * d
            sides.setdefault(edge.name, []).append(points)
    return face, {name: np.concatenate(points) for name, points in sides.items()}
