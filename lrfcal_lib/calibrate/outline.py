"""Edge lengths of boards in the cloud by least squares; image edges on the plane of the cloud."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model import geometry
from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.geometry import fit_line, lrf_to_platform
from lrfcal_lib.preprocess.board_in_scan import face_points
from lrfcal_lib.preprocess.edge_cells import edge_cells
from lrfcal_lib.preprocess.edges_in_scan import ScanEdges

LEAST_STRETCH = 0.4  # share of an edge that must be seen before its line decides a corner
FEWEST_CELLS = 8
# information of a side that no beam tells anything about: a metre and a radian are far
FAR = np.diag([1e2, 1.0])
ALONG = np.linspace(0.0, 1.0, 9)  # places along the stretch of an image edge


@dataclass(frozen=True)
class MeasuredBoard:
    """The outline of a board as the cloud shows it.

    Attributes
    ----------
    T_platform_plane : ndarray, shape (4, 4)
        Origin in the middle of the face, z along the normal towards the sensor.
    lines, corners : dict of str to ndarray, shapes (3,) and (2,)
        Sides that were measured, ``a x + b y + c = 0`` in the plane, metres, and where an edge
        meets the one before it.
    lengths, scatter, sigma : dict of str to float
        Metres: edges of which both ends are measured; rms distances of points from the lines (least
        squares only); standard deviations of the lengths, by least squares from that scatter alone.
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
    """A frame (4, 4) in the plane of points: origin in their middle, z towards their origin."""
    normal, distance, _ = geometry.fit_plane(points)
    if distance > 0:
        normal = -normal
        distance = -distance
    across = np.linalg.svd(geometry.hat(normal))[2][0]
    pose = np.eye(4)
    pose[:3, 0] = across
    pose[:3, 1] = np.cross(normal, across)
    pose[:3, 2] = normal
    centre = np.nanmean(points, axis=0)
    pose[:3, 3] = centre - normal * (normal @ centre - distance)
    return pose


def measure_board(face, sides, edges):
    """Measure a board's outline in a cloud: plane of the face, lines through sides, corners.

    `face` are points (n, 3), `sides` edge points (k, 3) by edge name, metres; `edges` all edges in
    order around the board. Standard deviations are those of the points about the lines alone.
    """
    pose = plane_frame(face)
    lines = []
    middles = []
    variances = []  # of shift and turn
    if not sides:
        return MeasuredBoard(pose, {}, {}, {})
    for points in sides.values():
        flat = (points - pose[:3, 3]) @ pose[:3, :2]
        line, middle = _flat_line(flat)
        along = (flat - middle) @ [-line[1], line[0]]
        square = np.nan
        if len(flat) > 1:
            square = np.sum((flat @ line[:2] + line[2]) ** 2) / (len(flat) - 1)
        shift = square / len(flat)
        lines.append(line)
        middles.append(middle)
        variances += [shift, shift * (1 / max(np.mean(along**2), 1e-12))]
    covariance = np.diag(variances)
    outline, sigma = sized(np.array(lines), np.array(middles), covariance, list(sides), edges)
    scatter = {name: fit_line(points)[2] for name, points in sides.items()}
    return MeasuredBoard(pose, *outline, scatter, sigma)


def sized(lines, middle, covariance, names, edges):
    """Sides by name, corners and lengths, and the standard deviations of these by edge.

    `covariance` (2 s, 2 s) is of shifts and turns of the lines (s, 3) about their `middle` (s, 2).
    """

    def outline(lines):
        """Sides, corners (..., 2) of two known neighbours, lengths (...) between these, by edge."""
        sides = dict(zip(names, np.moveaxis(lines, -2, 0), strict=True))
        pairs = list(zip(edges, edges[1:] + edges[:1], strict=True))
        corners = {}
        for edge, after in pairs:
            if edge in sides and after in sides:
                two = np.stack([sides[edge], sides[after]], axis=-2)
                corners[after] = corners_of_lines(two)[..., 1, :]
        lengths = {}
        for edge, after in pairs:
            if edge in corners and after in corners:
                lengths[edge] = np.linalg.norm(corners[after] - corners[edge], axis=-1)
        return sides, corners, lengths

    sides, corners, size = outline(lines)
    steps = 1e-6 * np.eye(len(covariance)).reshape(len(covariance), -1, 2)
    after = outline(moved_lines(lines, middle, steps))[2]
    lengths = {name: float(value) for name, value in size.items()}
    sigma = {}
    for name, value in lengths.items():
        J = (after[name] - value) / 1e-6
        sigma[name] = float(np.sqrt(np.sum(J * (covariance @ J))))
    return (sides, corners, lengths), sigma


def _flat_line(points):
    """The line ``a x + b y + c = 0`` (3,) through points (n, 2) of a plane, and their middle."""
    middle, (x, y), _ = fit_line(points)
    return np.array([y, -x, x * middle[1] - y * middle[0]]), middle


@dataclass(frozen=True)
class NamedSide:
    """A side of the scan that has the name of an edge.

    Attributes
    ----------
    name : str
        Of the board's edge.
    edges : ScanEdges
        That hold its points.
    rows : ndarray of int
        Which of them.
    across : bool
        Whether it was found across the scan lines.
    """

    name: str
    edges: ScanEdges
    rows: np.ndarray
    across: bool


def named_sides(prepared, placement, variant="half_step", stretch=0.0):
    """NamedSide one by one, of a placement; those of which the sweep shows a share at least."""
    along = prepared.edges[variant][placement]
    swept = prepared.swept[variant].get(placement)
    numbers = np.unique(along.side)
    lengths = {}
    if stretch > 0:
        lengths = prepared.board.lengths()
    for number, name in prepared.names.get(placement, {}).items():
        edges = along if number in numbers else swept
        length = next((s.length for s in edges.sides if s.side == number), 0.0)
        if length >= stretch * lengths.get(name, 0.0):
            rows = np.flatnonzero(edges.side == number)
            yield NamedSide(name, edges, rows, across=edges is not along)


def outline_of(prepared, placement, variant="half_step", T_head_lrf=None):
    """Measure the board's outline in the cloud of a placement by least squares: a MeasuredBoard.

    And the edges whose place hangs on the pitch. The platform is the session's own when left out.
    Sides of which less than 40 % is seen are missing: a stub does not carry a line to its corners.
    The second result are the edges found across the scan lines (where the sweep enters or leaves
    the board), a frozenset. DegenerateGeometry if the sweep does not cross enough scan lines to
    span a plane.
    """
    T_head_lrf = platform_of(prepared, T_head_lrf)
    points, pitch, _ = face_points(prepared.scans[placement])
    sides = {}
    across = set()
    for side in named_sides(prepared, placement, variant, LEAST_STRETCH):
        p_lrf = side.edges.points[side.rows]
        sides[side.name] = lrf_to_platform(p_lrf, side.edges.pitch[side.rows], T_head_lrf)
        if side.across:
            across.add(side.name)
    face = lrf_to_platform(points, pitch, T_head_lrf)
    return measure_board(face, sides, prepared.board.edges), frozenset(across)


def platform_of(prepared, T_head_lrf=None):
    """The platform to use: the one given, else the session's, else a tilt axis along x."""
    if T_head_lrf is not None:
        return T_head_lrf
    if prepared.session.T_head_lrf is not None:
        return prepared.session.T_head_lrf
    return RigidTransform.identity()


def cells_of(prepared, placement):
    """Beams about the edges in the sweep of a placement, see :func:`edge_cells`."""
    along = prepared.edges["half_step"][placement]
    swept = prepared.swept["half_step"].get(placement)
    return edge_cells(prepared.scans[placement], along, swept, prepared.session.lrf)


def moved_lines(lines, middle, step):
    """Lines shifted outwards and turned about the middle of their cells."""
    c = np.cos(step[..., 1])
    s = np.sin(step[..., 1])
    at = np.sum(lines[:, :2] * middle, axis=1) + lines[:, 2] - step[..., 0]
    x = c * lines[:, 0] - s * lines[:, 1]
    y = s * lines[:, 0] + c * lines[:, 1]
    return np.stack([x, y, at - (x * middle[:, 0] + y * middle[:, 1])], axis=-1)


def edges_in_cloud(solution, prepared, placement):
    """Face points (n, 3) under a JointSolution, and points of image edges in their plane by
    edge.
    """
    recorded, recorded_pitch, _ = face_points(prepared.scans[placement])
    points = solution.corrections.points(recorded)
    pitch = solution.corrections.pitch(placement, recorded_pitch)
    face = lrf_to_platform(points, pitch, solution.T_head_lrf)
    pose = plane_frame(face)
    sides = {}
    for camera, views in prepared.views.items():
        view = views.get(placement)
        if view is None or camera not in solution.transforms:
            continue
        pitch = solution.corrections.pitch(placement, view.pitch)
        T_platform_camera = solution.camera_at(camera, pitch).inv()
        lens = prepared.models[camera]
        centre = T_platform_camera.translation
        height = (pose[:3, 3] - centre) @ pose[:3, 2]
        for edge in view.edges:  # where lines of sight of a few of its points meet the plane
            normal = edge.line[:2]
            off = edge.ends @ normal + edge.line[2]
            first, last = edge.ends - off[:, None] * normal
            uv = first + ALONG[:, None] * (last - first)
            xy = (uv - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
            rays = np.column_stack([xy, np.ones(len(uv))])
            sight = T_platform_camera.rotation.apply(rays)
            points = centre + (height / (sight @ pose[:3, 2]))[:, None] * sight
            sides.setdefault(edge.name, []).append(points)
    return face, {name: np.concatenate(points) for name, points in sides.items()}
