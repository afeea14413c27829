"""The tilt axis from edges swept at known pitch angles: in space, and projected as printed.

Equations (1) to (15).
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.fit.axis_chart import (
    AXIS_COLUMNS,
    SMALL,
    by_chart,
    chart_parameters,
    move_head,
)
from lrfcal_lib.fit.covariance import dyads, inverse_root, name_words, solve_each
from lrfcal_lib.fit.least_squares import Block, solve
from lrfcal_lib.fit.padding import pad
from lrfcal_lib.fit.residuals import SIGMA_FLOOR
from lrfcal_lib.fit.result import AXIS_NAMES, AXIS_WORDS, Solution
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    TiltAxis,
    apply_pose,
    axis_of,
    cross,
    fit_line,
    fit_plane,
    gradient_by_pose,
    head_from_axis,
    length_of,
    lrf_to_platform,
    move_pose,
    pose_array,
    pose_transform,
    tilt,
    unit_vector,
)
from lrfcal_lib.model.observations import PlatformObservations

# of boards: the right angle of the two edges, their distance (metres)
SIGMA_SKEW = np.radians(0.2)
SIGMA_GAP = 0.002
LEAST_SLOPE = 0.1  # nearer to a coordinate plane (6 degrees) a projected fit is useless
# a combination of the four motions of the axis
WORDS = partial(name_words, names=AXIS_WORDS, share=0.3)
LEAST_SCATTER = 1e-6  # metres


@dataclass(frozen=True)
class PlatformSolution:
    """The estimated tilt axis.

    Attributes
    ----------
    solution : Solution
        Of the four unknowns ``(w_y, w_z, v_y, v_z)`` of ``T_head_lrf``.
    placements : ndarray of int, shape (p,)
        Those that were used.
    skipped : dict of int to str
        The other placements, with the reason.
    """

    solution: Solution
    placements: np.ndarray
    skipped: dict[int, str]

    # what no pitching data can show
    gauge = ("rotation about the tilt axis", "translation along the tilt axis")

    @property
    def T_head_lrf(self) -> RigidTransform:
        """In the gauge of :func:`lrfcal_lib.model.geometry.head_from_axis`."""
        return head_from_axis(self.axis)

    @property
    def axis(self) -> TiltAxis:
        """The tilt axis in the LRF frame."""
        return axis_of(self.solution.transform)


def start_head(T0):
    """Start value of ``T_head_lrf``: given, or an axis through the LRF's origin along its x."""
    return head_from_axis(axis_of(RigidTransform.identity() if T0 is None else T0))


def solve_platform(
    obs: PlatformObservations, T0: RigidTransform | None = None, *, sigma_pitch: float = 0.0
) -> PlatformSolution:
    """The tilt axis from 3D line fits, weighted by propagated noise.

    Parameters
    ----------
    obs : PlatformObservations
    T0 : RigidTransform, optional
        Start value of ``T_head_lrf``; by default the axis lies along the x axis of the LRF.
    sigma_pitch : float
        Standard deviation of a recorded pitch, radians.

    Returns
    -------
    PlatformSolution

    Raises
    ------
    DegenerateGeometry
        When no placement can be used, or when the data leave a motion of the axis open.

    Notes
    -----
    Equations (1) to (15) with total least squares lines instead of projected fits: every placement
    has a board of its own (pose, skew, gap: 8 unknowns, eliminated by a Schur complement), an edge
    point has two distances from its edge, a face point one from the plane. The perpendicularity and
    coplanarity of equations (13) and (14) are residuals with the tolerances of the board. A
    placement with one edge serves too when it has face points.
    """
    gauge = start_head(T0)
    for final in (False, True):  # the second time in the gauge of the axis of the first
        boards = prepare_boards(obs, gauge)
        points = boards.points["used"].sum()
        on_edges = np.sum(boards.points["number"] > 0)
        p = len(boards.placements)
        state = pose_array(gauge), boards.poses, np.zeros((p, 2))
        solution = solve(
            partial(platform_blocks, points=boards.points, sigma_pitch=sigma_pitch),
            state,
            move_platform,
            names=AXIS_NAMES,
            method="platform_3d",
            words=WORDS,
            shared=4,
            read=lambda state: _read_head(state[0]),
            freedom=points + on_edges - 6 * p - 4,  # a board: 8 unknowns, 2 bends
            limit=0.5,
            max_iterations=100,
            n_observations=points,
            required=final,
        )
        gauge = start_head(solution.transform)
    return PlatformSolution(solution, boards.placements, boards.skipped)


@dataclass(frozen=True)
class Boards:
    """Start values of boards, and the points on them.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
    poses : ndarray, shape (p, 3, 4)
        ``T_platform_board``, with x along edge 1 and z along the normal.
    points : dict of str to ndarray, shapes (p, n, ...)
        Columns of the points, padded by placement. `number` is 1 for points of the first edge that
        is there, 2 for those of another, 0 for those on the face.
    skipped : dict of int to str
        Why the other placements cannot be used.
    """

    placements: np.ndarray
    poses: np.ndarray
    points: dict[str, np.ndarray]
    skipped: dict[int, str]


def prepare_boards(obs: PlatformObservations, T_head_lrf: RigidTransform) -> Boards:
    """Boards and the points on them; DegenerateGeometry where no placement can be used."""
    pitch = np.concatenate([obs.edge_pitch, obs.face_pitch])
    points = np.concatenate([obs.edge_points, obs.face_points])
    placements = np.concatenate([obs.edge_placement, obs.face_placement])
    number = np.pad(obs.edge_number, (0, len(obs.face_pitch)))
    p_platform = lrf_to_platform(points, pitch, T_head_lrf)
    boards = {}
    skipped = {}
    place = np.full(len(pitch), -1)
    for placement in np.unique(obs.edge_placement).tolist():
        here = placements == placement
        face, *edges = (np.flatnonzero(here & (number == which)) for which in range(3))
        edges = [rows for rows in edges if len(rows) >= 2]
        try:
            pose = _start_board([p_platform[rows] for rows in edges], p_platform[face])
        except DegenerateGeometry as error:
            skipped[placement] = str(error)
            continue
        for which, rows in enumerate([face, *edges]):
            place[rows] = len(boards)
            number[rows] = which
        boards[placement] = pose
    if not boards:
        raise DegenerateGeometry(f"no placement can be used for the tilt axis: {skipped}")
    padded = pad(
        place,
        len(boards),
        points=points,
        covariance=np.concatenate([obs.edge_covariance, obs.face_covariance]),
        pitch=pitch,
        number=number,
    )
    padded["covariance"] += SIGMA_FLOOR**2 * np.eye(3)  # no board is flat
    return Boards(np.array(list(boards)), np.array(list(boards.values())), padded, skipped)


def _start_board(edges, face):
    """Pose array of the board from its edge and face points in the platform frame."""
    if not edges:
        raise DegenerateGeometry("fewer than two points on either edge")
    point, x, _ = fit_line(edges[0])
    if len(edges) == 2:
        point2, second, _ = fit_line(edges[1])
        z = np.cross(x, second)
        if length_of(z) < np.sin(np.radians(30)):
            raise DegenerateGeometry(
                "the two edges are nearly parallel: edges 1 and 2 must be perpendicular"
            )
        # the origin is where edge 1 comes nearest to edge 2
        along, _ = np.linalg.lstsq(np.column_stack([x, -second]), point2 - point)[0]
        point = point + x * along
    elif len(face) >= 3:
        normal = fit_plane(face)[0]
        z = normal - x * (x @ normal)
    else:
        raise DegenerateGeometry("only one edge, and no points on the face")
    z = unit_vector(z)
    return np.column_stack([x, np.cross(z, x), z, point])


def distances(state, points):
    """Distances (p, n, 2) of points from their edge in the board's plane and across it.

    And their Jacobians by the unknowns, by the point and by the pitch. Edge 1 lies along x of the
    board, edge 2 along y but for the skew and the gap. Points on the face have no edge: the first
    is zero.
    """
    head, boards, bends = state
    second = 1.0 * (points["number"] == 2)
    rotated = points["points"] @ head[:, :3].T
    q = tilt(rotated + head[:, 3], points["pitch"])
    lever = q - boards[:, None, :, 3]
    b = lever @ boards[:, :, :3]
    cosine = second * np.cos(bends[:, :1])
    sine = second * np.sin(bends[:, :1])
    normals = np.zeros(b.shape[:2] + (2, 3))  # board frame
    normals[..., 0, 0] = cosine
    normals[..., 0, 1] = sine + (points["number"] == 1)
    normals[..., 1, 2] = 1.0
    r = np.matvec(normals, b)
    r[..., 1] -= second * bends[:, 1:]
    gradient = normals @ boards[:, None, :, :3].mT  # by q, platform frame
    in_head = tilt(gradient, -points["pitch"][..., None])
    by_head = gradient_by_pose(rotated[..., None, :], in_head)
    by_unknowns = np.zeros(r.shape + (12,))
    by_unknowns[..., :4] = by_head[..., AXIS_COLUMNS]
    by_unknowns[..., 4:10] = -gradient_by_pose(lever[..., None, :], gradient)  # board
    by_unknowns[..., 0, 10] = cosine * b[..., 1] - sine * b[..., 0]
    by_unknowns[..., 1, 11] = -second
    by_pitch = cross(q[..., None, :], gradient)[..., 0]
    return r, by_unknowns, in_head @ head[:, :3], by_pitch


def platform_blocks(state, points, sigma_pitch):
    """All residuals by placement; unknowns: axis 4, then board pose 6, skew and gap."""
    r, J, by_point, by_pitch = distances(state, points)
    pull = points["covariance"] @ by_point.mT
    by_pitch = sigma_pitch * by_pitch
    noise = by_point @ pull + dyads(by_pitch)
    noise[..., 0, 0] += points["number"] == 0  # of no distance at all
    force = solve_each(noise, r)
    moved = points | {
        "points": points["points"] - np.matvec(pull, force),
        "pitch": points["pitch"] - sigma_pitch * np.vecdot(by_pitch, force),
    }
    _, corrected, *_ = distances(state, moved)
    whitener = inverse_root(noise) * points["used"][..., None, None]
    _, _, bends = state
    stiff = np.broadcast_to([1 / SIGMA_SKEW, 1 / SIGMA_GAP], bends.shape)
    return [
        Block.of_groups(r, J, whitener, corrected),
        Block(bends, np.eye(12)[10:], stiff),
    ]


def move_platform(state, step):
    """Retraction of axis, boards, and their skew and gap."""
    head, boards, bends = state
    return (
        move_head(head, step[0, :4]),
        move_pose(boards, step[:, 4:10]),
        bends + step[:, 10:],
    )


def solve_projected(
    obs: PlatformObservations, T0: RigidTransform | None = None, *, printed: bool = False
) -> PlatformSolution:
    """The tilt axis by the paper's projected line fits.

    Placements with an edge parallel to a coordinate plane are skipped: their projected fits would
    divide by zero.

    Parameters
    ----------
    obs : PlatformObservations
        The edge points are used, without their covariance; that of the result comes from the
        scatter of the residuals.
    T0 : RigidTransform, optional
        As of :func:`solve_platform`.
    printed : bool
        The chart, hence the coordinate planes, are the paper's: the LRF lies on the y axis of the
        head, ``t = (0, t_y, 0)``. Otherwise that of this repository, where the LRF is turned least.

    Returns
    -------
    PlatformSolution

    Raises
    ------
    DegenerateGeometry
        When no placement can be used.

    Notes
    -----
    Equation (15) is garbled; it is read as the sum over the placements of the squares of six terms:
    the root mean square errors of the four projected fits (each point's error over the root of
    their number enters, which has the same sum of squares and stays smooth), ``|u1 . u2|`` of the
    unit directions (unit vectors, because the paper's (9) and (10) grow beyond bounds for level
    edges) and the gap D in metres. These have different units and no weights: the result depends on
    that. :func:`lrfcal_lib.solvers.platform.solve_platform` weighs every term by its noise.
    """
    gauge = start_head(T0)
    groups, skipped = _slanted(obs, points_of(pose_array(gauge), obs, printed))
    if not groups:
        raise DegenerateGeometry(
            f"projected fits: no placement can be used: {skipped}; use the 3D fits instead"
        )
    rows = [2 * (len(a) + len(b)) + 2 for a, b in groups.values()]
    scatter = 1.0
    for _ in range(2):  # the second time with the scatter of the first
        solution = solve(
            partial(
                projected_block,
                obs=obs,
                groups=groups.values(),
                scatter=scatter,
                printed=printed,
            ),
            pose_array(gauge),
            move_head,
            names=AXIS_NAMES,
            method="platform_projected",
            words=WORDS,
            groups=np.repeat(list(groups), rows),
            limit=np.inf,
            read=_read_head,
            max_iterations=100,
        )
        freedom = max(len(solution.residuals) - 4, 1)
        scatter = max(float(np.sqrt(solution.chi2 / freedom)), LEAST_SCATTER)
        gauge = start_head(solution.transform)
    return PlatformSolution(solution, np.array(list(groups)), skipped)


def _read_head(head):
    """Transform and parameters of the axis."""
    return pose_transform(head), chart_parameters(head)


def _slanted(obs, p_platform):
    """Rows of edges 1 and 2 of placements whose edges are slanted, and why others are left out."""
    groups = {}
    skipped = {}
    for placement in np.unique(obs.edge_placement).tolist():
        here = obs.edge_placement == placement
        edges = [np.flatnonzero(here & (obs.edge_number == number)) for number in (1, 2)]
        flaw = _flaw([p_platform[rows] for rows in edges])
        if flaw:
            skipped[placement] = flaw
        else:
            groups[placement] = edges
    return groups, skipped


def _flaw(edges):
    """Why points of edges 1 and 2 have no projected fits; None where they have."""
    for number, points in enumerate(edges, start=1):
        if len(points) < 3:
            return f"edge {number} has {len(points)} points, at least 3 needed"
        _, y, z = np.abs(fit_line(points)[1])
        for slope, plane in ((z, "xy"), (y, "xz")):
            if slope < LEAST_SLOPE:
                return (
                    f"edge {number} is parallel to the {plane} plane: its projected fits divide "
                    "by zero"
                )
    return None


def projected_block(head, obs, groups, scatter=1.0, printed=False):
    """The six terms of equation (15) of every placement over their common scatter.

    The Jacobian by the axis chart comes from differences.

    Parameters
    ----------
    head : ndarray, shape (3, 4)
        ``T_head_lrf``.
    obs : PlatformObservations
    groups : iterable of (ndarray, ndarray)
        Rows of the edge points on edges 1 and 2, of every placement.
    scatter : float
        Metres.
    printed : bool
        As of :func:`solve_projected`.
    """

    def terms(heads):
        """Those of heads (k, 3, 4), shape (k, m)."""
        q = points_of(heads, obs, printed)
        every = [_six_terms(q[:, a], q[:, b]) for a, b in groups]
        return np.concatenate(every, axis=1) / scatter

    residuals, jacobian = by_chart(terms, head)
    return Block(residuals, jacobian)


def points_of(heads, obs, printed):
    """Edge points in the platform frames (..., n, 3) of heads (..., 3, 4)."""
    pitch = obs.edge_pitch
    if printed:  # turned about the tilt axis to where a shift is (0, t_y, 0)
        y = heads[..., 1:2, 3]
        z = heads[..., 2:, 3]
        away = np.hypot(y, z) > 10 * SMALL  # an axis through the LRF's origin needs no turn
        pitch = pitch - np.where(away, np.arctan2(z, y), 0.0)
    return tilt(apply_pose(heads, obs.edge_points), pitch)


def _six_terms(first, second):
    """Errors of the four projected fits, u1 . u2, and the gap D of equation (14), shape (k, m)."""
    errors1, u1, p1 = _projected_line(first)
    errors2, u2, p2 = _projected_line(second)
    normal = cross(u1, u2)
    gap = np.vecdot(normal, p1 - p2) / length_of(normal)
    return np.column_stack([errors1, errors2, np.vecdot(u1, u2), gap])


def _projected_line(q):
    """Fit ``x = a z + b`` and ``z = c y + d``, equations (7), (8), to points (k, n, 3) of an edge.

    Returns the errors (k, 2 n) over the root of n, and of equations (9) to (12) the direction ``u ~
    (a, 1 / c, 1)`` as a unit vector and the point ``p = (b, -d / c, 0)``.
    """
    middle = q.mean(axis=1)
    x, y, z = np.moveaxis(q - middle[:, None], -1, 0)
    a = (np.vecdot(z, x) / np.vecdot(z, z))[:, None]
    c = (np.vecdot(y, z) / np.vecdot(y, y))[:, None]
    errors = np.concatenate([x - a * z, z - c * y], axis=1) / np.sqrt(x.shape[1])
    direction = np.concatenate([a, 1 / c, np.ones_like(a)], axis=1)
    return errors, unit_vector(direction), middle - middle[:, 2:] * direction
